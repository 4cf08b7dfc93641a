"""Photos of a capture: finding them, scaling cameras to them, and decoding them with their masks.

A camera is given for photos of a certain size. The photos on disk may be smaller copies in a folder
`images_2`, `images_4` or `images_8` beside `images`, have another extension, or be stored sideways with an
EXIF orientation; the camera is scaled to the photo that is read. Large photos are made smaller on reading, by
a whole factor: each pixel is the mean of so many a side.
"""

import re
from collections import defaultdict
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from formats.errors import (
    BadIntrinsics,
    BadMask,
    FormatError,
    MissingFile,
    MixedSizes,
    NoViews,
    ResourceError,
)
from formats.images import (
    Header,
    check_whole,
    decoded_at_once,
    decoding_bytes,
    oriented,
    read_alpha,
    read_image,
    read_image_header,
    read_mask,
)
from formats.views import View

EXTENSIONS = (
    *(".png", ".jpg", ".jpeg", ".jpe", ".jfif", ".webp", ".bmp", ".tga", ".tif", ".tiff"),
    *(".avif", ".heic", ".heif"),
)
"""Endings of photos, in letters of any case."""
HEIF = EXTENSIONS[-2:]
UNREAD = (".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2", ".raw", ".exr", ".gif")
"""Endings that poses may name for photos which were converted since."""
LONGEST = 1080
"""Pixels of a photo's longer side past which a smaller copy is taken where there is one, and otherwise the
photo is made smaller; unless a factor is asked for."""
MAX_ASPECT_ERROR = 0.02
"""Relative difference allowed between the aspect ratios of a photo and its camera, for rounded sizes."""
OPAQUE = 128
"""Alpha from which on a pixel of a photo counts where its transparent ones are ignored."""
MOVING = "dynamic_mask_"
"""instant-ngp's masks begin so, and are white where the photo must be ignored."""
MAP = re.compile(
    r"(.+?)[._-](?:masks?|depths?|normals?|disp|disparity|alpha|seg|segmentation|semantics?|confidence)"
    r"(?:[._-]?\d+)?",
    re.IGNORECASE,
)
"""Names, without the ending, of pictures that are no photos but belong to one: depths, normals, masks."""
COLOUR = re.compile(r"[._-](?:colou?r|rgb)$", re.IGNORECASE)
"""What such photos may be called themselves, beside them."""
DIGITS = re.compile(r"(\d+)")


# --- finding ------------------------------------------------------------------------------------------------


def natural(text: str) -> list:
    """Sort key that takes runs of digits as numbers: r_2 before r_10."""
    parts = [(part.isdecimal(), part.lstrip("0")) for part in DIGITS.split(text)]
    # A number is compared by its length and digits: there is no limit to how many it has.
    return [(len(digits), digits) if number else (-1, digits) for number, digits in parts]


def split_ending(name: str) -> tuple[str, str]:
    """A photo's name without its ending, and that; with "" where it has none that photos have."""
    stem, dot, ending = name.rpartition(".")
    return (stem, f".{ending}") if stem and f"{dot}{ending}".lower() in (*EXTENSIONS, *UNREAD) else (name, "")


def is_hidden(name: str) -> bool:
    """Whether a file is hidden, as the `._` files beside each photo are that a Mac leaves behind."""
    return name.startswith(".")


def is_picture(name: str) -> bool:
    """Whether a file is a picture, by its name."""
    return not is_hidden(name) and Path(name).suffix.lower() in EXTENSIONS


@dataclass(frozen=True)
class Folder:
    """A folder of photos."""

    path: Path
    factor: int = 1
    """How many times smaller a side of them is than of the full-size photos: 4 of `images_4`."""

    def reduction(self, header: Header, downscale: int | None) -> int:
        """By how much one of its photos is to be made smaller; `downscale` is for the full-size photo, None:
        as much as LONGEST asks for."""
        if downscale is None:
            return -(-max(header.width, header.height) // LONGEST)
        return max(1, downscale // self.factor)


def has_pictures(folder: Path) -> bool:
    """Whether pictures lie in the folder, in its `images`, or in reduced copies of those."""
    images = folder / "images"
    return any(pictures(copy.path) for copy in (Folder(folder), *copies(images)))


def pictures(folder: Path) -> list[Path]:
    """The pictures of a folder by name, as LLFF counts them; none where there is no folder. A phone's HEIC
    photo beside the same one in another format is left out, and so are maps of depth and masks of a photo."""
    if not folder.is_dir():
        return []
    files = sorted(file for file in folder.iterdir() if is_picture(file.name) and is_file(file))
    stems = {file.stem for file in files if file.suffix.lower() not in HEIF}
    files = [file for file in files if file.suffix.lower() not in HEIF or file.stem not in stems]
    known = {COLOUR.sub("", file.stem) for file in files}
    matches = [MAP.fullmatch(file.stem) for file in files]
    return [file for file, of in zip(files, matches, strict=True) if of is None or of[1] not in known]


def folders(path: Path) -> list[Path]:
    """The visible folders in a folder, in natural order; none where it cannot be read."""
    try:
        entries = [entry for entry in path.iterdir() if not is_hidden(entry.name) and entry.is_dir()]
    except (OSError, ValueError):
        return []
    return sorted(entries, key=lambda entry: natural(entry.name))


def visible_files(folder: Path, ending: str) -> list[Path]:
    """The visible files in a folder whose names end so, in natural order."""
    entries = [file for file in folder.glob(f"*{ending}") if not is_hidden(file.name)]
    return sorted(entries, key=lambda entry: natural(entry.name))


def is_file(path: Path) -> bool:
    """Whether this is a file; False for names that the file system cannot hold."""
    try:
        return path.is_file()
    except (OSError, ValueError):  # too long, or with a NUL in it
        return False


def copies(folder: Path) -> list[Folder]:
    """`folder`, and the folders of smaller copies beside it, `folder_2` before `folder_8`."""
    return [Folder(folder), *smaller_copies(folder.parent).get(folder.name, [])]


def smaller_copies(parent: Path) -> dict[str, list[Folder]]:
    """Folders in a folder that are called `name_2` and so on, by that name, in the order of their factors."""
    named = defaultdict(list)
    for folder in folders(parent):
        plain, _, factor = folder.name.rpartition("_")
        if factor.isdecimal() and int(factor) > 0:
            named[plain].append(Folder(folder, int(factor)))
    return named


def chosen_copy(folders: list[tuple[Folder, Path]], downscale: int | None) -> Folder | None:
    """Of folders in the order of their factors, each with one of its photos: the one with the largest photos
    of at most LONGEST a side, or else with the smallest; where `downscale` is given, the one with the
    smallest photos out of which that can be made, or else with the largest. Copies of another shape than the
    full-size photos are of others."""
    folders = [(folder, photo) for folder, photo in folders if _of_one_shape(folders[0], (folder, photo))]
    if downscale is not None:
        divisors = [folder for folder, _ in folders if downscale % folder.factor == 0]
        return divisors[-1] if divisors else folders[0][0] if folders else None
    for folder, photo in folders[:-1]:
        try:
            header = read_image_header(photo)
        except FormatError:  # which its frame tells
            continue
        if max(header.width, header.height) <= LONGEST:
            return folder
    return folders[-1][0] if folders else None


def _of_one_shape(whole: tuple[Folder, Path], other: tuple[Folder, Path]) -> bool:
    """Whether two photos have one shape, if turned by EXIF, or whether nobody knows."""
    if whole[0].factor > 1 or whole is other:
        return True
    try:
        sizes = [sorted(read_image_header(photo)[:2]) for _, photo in (whole, other)]
    except FormatError:  # which its frame tells
        return True
    slack = 1 + 1 / sizes[1][0]  # a side is rounded
    return _shape_error(*sizes) <= slack * (1 + MAX_ASPECT_ERROR)


# --- fitting to cameras -------------------------------------------------------------------------------------


def on_photo(
    view: View, photo: Path, header: Header, where: str, mask: Path | None = None, reduction: int = 1
) -> View:
    """The view with its camera scaled to the photo on disk, which is made `reduction` times smaller.

    Tools disagree on whether poses refer to the pixels as stored or as turned by EXIF: the orientation whose
    aspect ratio is nearer to the camera's is used, and the pixels as stored where both are as near (see
    `alike_turned`). Raises BadImage where the photo is cut off, BadIntrinsics where neither fits, and BadMask
    where the mask has another shape.
    """
    check_whole(photo)
    stored, camera = (header.width, header.height), (view.width, view.height)
    turned = stored[:: -1 if header.orientation >= 5 else 1]
    choices = ((1, stored), (header.orientation, turned))
    orientation, size = min(choices, key=lambda choice: _shape_error(choice[1], camera))
    if not _same_shape(size, camera):
        raise BadIntrinsics(
            f"{where}: w and h say {view.width}x{view.height}, but {photo.name} is {header.width}x"
            f"{header.height}, another shape; use the photos that the poses were estimated from"
        )
    if reduction > min(size):
        raise BadIntrinsics(
            f"{where}: {photo.name} is {header.width}x{header.height} and cannot be made {reduction} times "
            "smaller; give a smaller --downscale"
        )
    fitted = replace(
        view.stretched(*size),
        image_path=photo,
        orientation=orientation,
        exif=header.orientation,
        alpha=header.alpha,
    ).reduced(reduction)
    return fitted if mask is None else with_mask(fitted, mask, where)


def with_mask(view: View, mask: Path, where: str | None = None) -> View:
    """The view with a mask; BadMask where that has another shape than its photo."""
    if mask.suffix.lower() in (".npy", ".npz"):
        raise BadMask(
            f"{where or mask}: the mask {mask} is an array of numpy, which is not read; save it as PNG, "
            "white where the photo counts"
        )
    header, size, photo = read_image_header(mask), (view.width, view.height), view.image_path
    actual = (header.width, header.height)
    turns = [actual, actual[::-1]] if view.orientation >= 5 else [actual]
    slack = 1 + (view.reduction > 1) / min(size)  # what is cut off of a photo that is made smaller
    if min(_shape_error(sides, size) for sides in turns) > slack * (1 + MAX_ASPECT_ERROR):
        wide, high = (side * view.reduction for side in size)
        raise BadMask(
            f"{where or photo}: the mask {mask} is {actual[0]}x{actual[1]}, but {photo.name} is "
            f"{wide}x{high}; make masks of the photo's size"
        )
    return replace(view, mask_path=mask)


def alike_turned(views: Sequence[View]) -> tuple[tuple[View, ...], str | None]:
    """Views whose photos are all read as stored or all as their EXIF turns them, as those say whose shape
    tells it; and a sentence where nothing tells, but it matters."""
    orientations = [view.orientation for view in views if view.exif >= 5 and view.width != view.height]
    turned = sum(orientation != 1 for orientation in orientations)
    open_ = [view for view in views if view.exif != 1 and (view.exif < 5 or view.width == view.height)]
    if not open_ or 2 * turned < len(orientations):
        return tuple(views), None
    if not orientations:
        return tuple(views), (
            f"EXIF turns {len(open_)} of {len(views)} photos, such as {open_[0].image_path.name}, and their "
            "shape does not tell whether the poses are of them so: they are read as stored"
        )
    chosen = {id(view) for view in open_}
    return tuple(replace(v, orientation=v.exif) if id(v) in chosen else v for v in views), None


def _shape_error(a: tuple[int, int], b: tuple[int, int]) -> float:
    """The ratio of two sizes' aspect ratios, 1 or more."""
    ratio = a[0] * b[1] / (a[1] * b[0])
    return max(ratio, 1 / ratio)


def _same_shape(a: tuple[int, int], b: tuple[int, int]) -> bool:
    """Whether two sizes have the same aspect ratio, up to rounding."""
    return _shape_error(a, b) <= 1 + MAX_ASPECT_ERROR


# --- decoding -----------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Photos:
    """Decoded photos of any sizes, pixel after pixel, row by row, photo after photo."""

    pixels: np.ndarray
    """(P, 4) uint8, straight alpha."""
    first: np.ndarray
    """(n + 1,) int64: photo i has the pixels first[i] to first[i + 1]."""
    ignored: np.ndarray | None
    """(P,) bool: pixels that a mask excludes; None where no photo has a mask."""

    def photo(self, i: int, view: View) -> np.ndarray:
        """(H, W, 4) of photo i, which is `view`'s."""
        return self.pixels[self.first[i] : self.first[i + 1]].reshape(view.height, view.width, 4)


def load_photos(views: Sequence[View], masks: str = "ignore") -> Photos:
    """The photos of views, which may differ in size, in their order.

    What masks exclude is marked as ignored, or with `masks` "alpha" made transparent.

    Raises NoViews, BadImage, BadMask, LimitExceeded, MissingFile, MixedSizes (a photo changed since its
    capture was read), ResourceError (memory).
    """
    if not views:
        raise NoViews("no views are given to load, expected at least one")
    first = np.cumsum([0, *(view.width * view.height for view in views)])
    masked = any(view.mask_path for view in views)
    try:
        pixels = np.empty((first[-1], 4), np.uint8)
        ignored = np.zeros(first[-1], bool) if masked else None
    except MemoryError as error:
        raise ResourceError(
            f"{_named(views[0])} and the others need {first[-1] * 5:,} bytes of memory; use smaller photos"
        ) from error

    def load(view: View, span: tuple[int, int]) -> None:
        part = slice(*span)
        decoded(view, pixels[part].reshape(view.height, view.width, 4))
        if view.mask_path:
            ignored[part] = load_ignored(view).ravel()

    with decoders(views) as threads:
        for _ in threads.map(load, views, pairwise(first.tolist())):
            pass
    if masks == "alpha" and ignored is not None:
        pixels[ignored, 3] = 0
        ignored = None
    return Photos(pixels, first, ignored)


def load_images(views: Sequence[View]) -> np.ndarray:
    """(n, H, W, 4) uint8, straight alpha (255 for opaque photos), in the order of `views`.

    Raises MixedSizes before anything is decoded, otherwise as `load_photos`; masks are not read.
    """
    for view in views:
        if (view.width, view.height) != (views[0].width, views[0].height):
            raise MixedSizes(
                f"{_named(views[0])} is {views[0].width}x{views[0].height} but {_named(view)} is "
                f"{view.width}x{view.height}; bring all photos of a capture to one size"
            )
    photos = load_photos([replace(view, mask_path=None) for view in views])
    return photos.pixels.reshape(len(views), views[0].height, views[0].width, 4)


def load_ignored(view: View) -> np.ndarray | None:
    """(H, W) bool, True where the view's mask is dark; None where it has none. A mask of another size is
    sampled at the photo's pixel centres. Raises BadMask, BadImage, MissingFile."""
    if view.mask_path is None:
        return None
    if view.mask_path == view.image_path:
        mask = oriented(read_alpha(view.mask_path) >= OPAQUE, view.orientation)
    else:
        mask = read_mask(view.mask_path) != view.mask_path.name.startswith(MOVING)
        if not _same_shape(mask.shape[::-1], (view.width, view.height)) and view.orientation >= 5:
            mask = oriented(mask, view.orientation)
    high, wide = mask.shape
    rows, columns = _sampled(high, view.height, view.reduction), _sampled(wide, view.width, view.reduction)
    if not _same_shape((wide, high), (view.width, view.height)) and view.reduction == 1:
        raise BadMask(
            f"{view.mask_path} is {wide}x{high} now, expected {view.width}x{view.height}; read it again"
        )
    return ~mask[rows[:, None], columns]


def _sampled(stored: int, shown: int, reduction: int) -> np.ndarray:
    """(shown,) where the centres of a view's pixels lie in a mask of `stored` pixels along that side. A mask
    of the photo's size has up to `reduction` - 1 more at its end, which the view leaves out."""
    covered = shown * reduction
    span = covered if 0 <= stored - covered < reduction else stored
    return ((np.arange(shown) + 0.5) * span / shown).astype(int)


def loading_bytes(views: Sequence[View]) -> int:
    """Memory that decoding photos takes at most, beside their pixels."""
    return decoding_bytes(*_largest(views))


def decoders(views: Sequence[View]) -> ThreadPoolExecutor:
    """Threads for work that decodes a view's photo or mask each, fewer where photos are large."""
    return ThreadPoolExecutor(decoded_at_once(*_largest(views)))


def _largest(views: Sequence[View]) -> tuple[int, int]:
    """Stored sides, about, of the largest photo."""
    largest = max(views, key=lambda view: view.width * view.height * view.reduction**2)
    return largest.width * largest.reduction, largest.height * largest.reduction


def _named(view: View) -> Path | str:
    return view.image_path or view.name


def decoded(view: View, out: np.ndarray | None = None) -> np.ndarray:
    """(H, W, 4) uint8 of one view's photo, in `out` where that is given. Raises as `load_photos`."""
    out = np.empty((view.height, view.width, 4), np.uint8) if out is None else out
    if view.pixels is not None:
        out[:] = oriented(view.pixels, view.orientation)
        return out
    if view.image_path is None:
        raise MissingFile(f"view {view.name}: has a camera but no photo")
    return read_image(view.image_path, view.orientation, view.reduction, view.alpha, out, view.premultiplied)
