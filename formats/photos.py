"""Photos of a capture: finding them, scaling cameras to them, and decoding them with their masks.

A camera is given for photos of a certain size. The photos on disk may be smaller copies in a folder
`images_2`, `images_4` or `images_8` beside `images`, have another extension, or be stored sideways with an
EXIF orientation; the camera is scaled to the photo that is read. Large photos are made smaller on reading, by
a whole factor: each pixel is the mean of so many a side.
"""

import re
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
from formats.images import Header, oriented, read_image, read_image_header, read_mask
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
SAMPLED = 6
"""Number of photos that are examined for a plain background."""
PLAIN = 3
"""Levels of 255 by which a plain background may vary."""
BORDER_KEPT = 0.3
"""Masks that keep less than this share of the photos' borders cut out an object; others hide passers-by."""
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
    return any(pictures(place.path) for place in (Folder(folder), *copies(images)))


def pictures(folder: Path) -> list[Path]:
    """The pictures of a folder by name, as LLFF counts them; none where there is no folder. A phone's HEIC
    photo beside the same one in another format is left out."""
    if not folder.is_dir():
        return []
    files = sorted(file for file in folder.iterdir() if is_picture(file.name) and is_file(file))
    stems = {file.stem for file in files if file.suffix.lower() not in HEIF}
    return [file for file in files if file.suffix.lower() not in HEIF or file.stem not in stems]


def find_photo(folder: Path, name: str) -> Path | None:
    """The photo `name` of a folder, with the extension it has on disk; None where there is none."""
    exact = folder / name
    if not (name and exact.name):
        return None
    if is_file(exact):
        return exact
    stem = split_ending(exact.name)[0]
    endings = (form(ending) for ending in EXTENSIONS for form in (str.lower, str.upper))
    candidates = (exact.with_name(stem + ending) for ending in endings)
    return next((candidate for candidate in candidates if is_file(candidate)), None)


def is_file(path: Path) -> bool:
    """Whether this is a file; False for names that the file system cannot hold."""
    try:
        return path.is_file()
    except (OSError, ValueError):  # too long, or with a NUL in it
        return False


def copies(folder: Path) -> list[Folder]:
    """`folder`, and the folders of smaller copies beside it, `folder_2` before `folder_8`."""
    try:
        found = [place for place in folder.parent.glob(f"{_escaped(folder.name)}_*") if place.is_dir()]
    except (OSError, ValueError):
        found = []
    numbered = [(place.name[len(folder.name) + 1 :], place) for place in found]
    factors = sorted((int(n), place) for n, place in numbered if n.isdecimal() and int(n) > 0)
    return [Folder(folder), *(Folder(place, factor) for factor, place in factors)]


def _escaped(name: str) -> str:
    return re.sub(r"([*?\[])", r"[\1]", name)


def chosen_copy(places: list[tuple[Folder, Path]], downscale: int | None) -> Folder | None:
    """Of folders in the order of their factors, each with one of its photos: the one with the largest photos
    of at most LONGEST a side, or else with the smallest; where `downscale` is given, the one with the
    smallest photos out of which that can be made, or else with the largest."""
    if downscale is not None:
        whole = [place for place, _ in places if downscale % place.factor == 0]
        return whole[-1] if whole else places[0][0] if places else None
    for place, photo in places[:-1]:
        try:
            header = read_image_header(photo)
        except FormatError:  # which its frame tells
            continue
        if max(header.width, header.height) <= LONGEST:
            return place
    return places[-1][0] if places else None


# --- fitting to cameras -------------------------------------------------------------------------------------


def on_photo(
    view: View, photo: Path, header: Header, where: str, mask: Path | None = None, reduction: int = 1
) -> View:
    """The view with its camera scaled to the photo on disk, which is made `reduction` times smaller.

    Tools disagree on whether poses refer to the pixels as stored or as turned by EXIF: the orientation whose
    aspect ratio equals the camera's is used, and the pixels as stored where both do. Raises BadIntrinsics
    where neither does, and BadMask where the mask has neither the photo's nor the camera's size.
    """
    for orientation in (1, header.orientation):
        size = (header.width, header.height)[:: -1 if orientation >= 5 else 1]
        if _same_shape(size, (view.width, view.height)):
            break
    else:
        raise BadIntrinsics(
            f"{where}: w and h say {view.width}x{view.height}, but {photo.name} is {header.width}x"
            f"{header.height}, another shape; use the photos that the poses were estimated from"
        )
    if reduction > min(size):
        raise BadIntrinsics(
            f"{where}: {photo.name} is {header.width}x{header.height} and cannot be made {reduction} times "
            "smaller; give a smaller --downscale"
        )
    fitted = replace(view.stretched(*size), image_path=photo, orientation=orientation).reduced(reduction)
    if mask is None:
        return fitted
    found = read_image_header(mask)
    if (found.width, found.height) not in (size, (view.width, view.height)):
        raise BadMask(
            f"{where}: the mask {mask} is {found.width}x{found.height}, but {photo.name} is {size[0]}x"
            f"{size[1]}; make masks of the photo's size"
        )
    return replace(fitted, mask_path=mask)


def _same_shape(a: tuple[int, int], b: tuple[int, int]) -> bool:
    """Whether two sizes have the same aspect ratio, up to rounding."""
    return abs(a[0] * b[1] / (a[1] * b[0]) - 1) <= MAX_ASPECT_ERROR


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
        pixels[part] = _decoded(view).reshape(-1, 4)
        if view.mask_path:
            ignored[part] = load_ignored(view).ravel()

    with ThreadPoolExecutor() as threads:
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
    """(H, W) bool, True where the view's mask is dark; None where it has none. A larger mask is sampled at
    the photo's pixel centres. Raises BadMask, BadImage, MissingFile."""
    if view.mask_path is None:
        return None
    kept = read_mask(view.mask_path)
    high, wide = kept.shape
    rows, columns = _sampled(high, view.height, view.reduction), _sampled(wide, view.width, view.reduction)
    if not _same_shape((wide, high), (view.width, view.height)) and view.reduction == 1:
        raise BadMask(
            f"{view.mask_path} is {wide}x{high} now, expected {view.width}x{view.height}; read it again"
        )
    return ~kept[rows[:, None], columns]


def _sampled(stored: int, shown: int, reduction: int) -> np.ndarray:
    """(shown,) where the centres of a view's pixels lie in a mask of `stored` pixels along that side. A mask
    of the photo's size has up to `reduction` - 1 more at its end, which the view leaves out."""
    covered = shown * reduction
    span = covered if 0 <= stored - covered < reduction else stored
    return ((np.arange(shown) + 0.5) * span / shown).astype(int)


def plain_background(views: Sequence[View]) -> bool:
    """Whether SAMPLED of the photos all have one and the same colour along their borders, as pictures of an
    object without surroundings do."""
    chosen = [views[i] for i in np.unique(np.linspace(0, len(views) - 1, SAMPLED).astype(int))]
    lowest, highest = np.full(3, 255), np.zeros(3, int)
    for view in chosen:
        picture = _decoded(view)[..., :3]
        border = np.concatenate([picture[0], picture[-1], picture[:, 0], picture[:, -1]])
        lowest, highest = np.minimum(lowest, border.min(0)), np.maximum(highest, border.max(0))
        if (highest - lowest > PLAIN).any():
            return False
    return True


def object_boxes(views: Sequence[View]) -> list[tuple[int, int, int, int]] | None:
    """Left, top, right, bottom of what the mask of each view keeps, where masks cut out an object: all views
    have one, and most of the border of the photos is ignored. None otherwise."""
    if not all(view.mask_path for view in views):
        return None
    with ThreadPoolExecutor() as threads:
        found = list(threads.map(_kept_box, views))
    if np.mean([share for _, share in found]) > BORDER_KEPT:
        return None
    return [box for box, _ in found]


def _kept_box(view: View) -> tuple[tuple[int, int, int, int], float]:
    """Bounds of what a mask keeps (of the photo, if nothing), and the kept share of the border."""
    kept = ~load_ignored(view)
    border = float(np.mean(np.concatenate([kept[0], kept[-1], kept[:, 0], kept[:, -1]])))
    if not kept.any():
        return (0, 0, view.width, view.height), border
    rows, columns = np.flatnonzero(kept.any(1)), np.flatnonzero(kept.any(0))
    return (int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1), border


def _named(view: View) -> Path | str:
    return view.image_path or view.name


def _decoded(view: View) -> np.ndarray:
    """(H, W, 4) uint8 of one view's photo."""
    if view.pixels is None and view.image_path is None:
        raise MissingFile(f"view {view.name}: has a camera but no photo")
    if view.pixels is not None:
        pixels = oriented(view.pixels, view.orientation)
    else:
        pixels = read_image(view.image_path, view.orientation, view.reduction)
    if pixels.shape != (view.height, view.width, 4):
        height, width = pixels.shape[:2]
        raise MixedSizes(
            f"{_named(view)} is {width}x{height} now, expected {view.width}x{view.height}; read it again"
        )
    return pixels
