"""Masks that lie beside photos: in a folder `masks` or `mask`, or among them under names that say so."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from formats.names import folded
from formats.photos import EXTENSIONS, MOVING, folders, with_mask
from formats.views import View

FOLDERS = ("masks", "mask")
PHOTOS = ("images", "input", "photos", "rgb", "color", "corrected_images")
"""Folders of photos, or of smaller copies such as images_4, beside which a folder of masks is looked for."""
NAMED = ("{}_mask", "{}.mask", "{}-mask", "mask_{}", MOVING + "{}")
"""How programs name the mask of a photo, by its name with or without the ending."""


def with_masks_beside(views: Sequence[View], root: Path) -> tuple[tuple[View, ...], tuple[str, ...]]:
    """Views with the masks that lie beside their photos, where none has one yet, and sentences about them.

    `root` is the capture's folder. A mask is called as its photo is, COLMAP's `a.jpg.png` and `a_mask.png`
    too. Raises BadMask, BadImage, as `with_mask`.
    """
    photos = [view for view in views if view.image_path is not None]
    if not photos or any(view.mask_path for view in views):
        return tuple(views), ()
    pictures_of = cache(_PictureFolder.of)
    around = {view.image_path.parent: _places(view.image_path, root) for view in photos}
    masked_views, used, unused, arrays = [], {}, {}, {}
    for view in views:
        mask = None
        for folder, inner in around[view.image_path.parent] if view.image_path else ():
            pictures = pictures_of(folder)
            is_own = folder == view.image_path.parent
            if (mask := pictures.mask_of(view.image_path, inner, is_own)) is not None:
                break
            if not is_own:
                (unused if pictures.files else arrays)[folder] = len(pictures.files) or pictures.arrays
        masked_views.append(view if mask is None else with_mask(view, mask))
        if mask is not None:
            used[mask.parent] = used.get(mask.parent, 0) + 1
    notes = [f"{at}: its masks of {count} of {len(views)} photos are used" for at, count in used.items()]
    notes += [
        f"{at}: holds {count} arrays of numpy, which are not read as masks; save them as PNG, white where a "
        "photo counts"
        for at, count in arrays.items()
        if count and not used
    ]
    notes += [
        f"{at}: lies beside the photos, but none of its {count} pictures is called as one of them, and they "
        "are not used; name masks as their photos"
        for at, count in unused.items()
        if not used
    ]
    return tuple(masked_views), tuple(notes)


def _places(photo: Path, root: Path) -> list[tuple[Path, Path]]:
    """Folders in which the mask of a photo may be, the likeliest first, each with the folder in it where the
    photo lies in one among those of the others."""
    parent, places = photo.parent, []
    for above in (parent, *parent.parents[:2]):
        inside = above == root or above.is_relative_to(root)
        below = photo.relative_to(above).parts[:-1]
        if below and not (inside or _of_photos(below[0])):
            break
        copy = below[0].rpartition("_")[2] if below else ""
        names = [*(f"{name}_{copy}" for name in FOLDERS if copy.isdecimal()), *FOLDERS]
        places += [(folder, Path(*below[1:])) for folder in _named_so(above, names)]
        if above == root or not below and not inside:
            break
    return [*places, (parent, Path())]


def _named_so(folder: Path, names: Sequence[str]) -> list[Path]:
    """The folders in a folder that have one of the names, in any case, in the order of the names."""
    named = [entry for entry in folders(folder) if entry.name.casefold() in names]
    return sorted(named, key=lambda entry: names.index(entry.name.casefold()))


def _of_photos(name: str) -> bool:
    start, _, number = name.lower().rpartition("_")
    return (start if number.isdecimal() else name.lower()) in PHOTOS


@dataclass(frozen=True)
class _PictureFolder:
    """The pictures of a folder and of those in it, by the folder below it and the name without its ending."""

    files: dict[tuple[Path, str], Path]
    arrays: int
    """Files of numpy among them, which are not read."""

    @classmethod
    def of(cls, folder: Path) -> "_PictureFolder":
        """Hidden files are no masks."""
        nested = [folder, *folders(folder)]
        files = [file for at in nested for file in sorted(at.iterdir()) if not file.name.startswith(".")]
        pictures = [file for file in files if file.suffix.lower() in EXTENSIONS]
        named = {(file.parent.relative_to(folder), folded(file.stem)): file for file in pictures}
        return cls(named, sum(file.suffix.lower() in (".npy", ".npz") for file in files))

    def mask_of(self, photo: Path, inner: Path, is_own_folder: bool) -> Path | None:
        """A photo's mask; `own`: this is the photo's own folder, where a mask has a name that says so."""
        names = [] if is_own_folder else [photo.name, photo.stem]
        names += [name.format(base) for name in NAMED for base in (photo.stem, photo.name)]
        folders = (inner, Path()) if inner.parts else (inner,)
        keys = ((folder, folded(name)) for folder in folders for name in names)
        candidates = (self.files.get(key) for key in keys)
        return next((file for file in candidates if file is not None and file != photo), None)
