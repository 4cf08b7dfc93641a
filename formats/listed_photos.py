"""The photos that a list of poses names, with their cameras."""

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

from formats.cameras import frame_names
from formats.errors import NoViews
from formats.frame_list import once, read_sound, repair_notes
from formats.images import Header, read_image_header
from formats.matching import match_photos
from formats.photos import Folder, natural, on_photo
from formats.views import View

Pose = TypeVar("Pose")
"""What a list says of one photo."""
Camera = Callable[[Pose, Header, Folder], tuple[str, View, Path | None]]
"""How errors name a pose, its view and its mask, by the header and the folder of its photo."""


@dataclass(frozen=True)
class SplitPart:
    """The views of one split, the missing photos, and notes on where photos are read from."""

    views: tuple[View, ...] = ()
    missing: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()


def read_listed(
    where: Path,
    base: Path,
    splits: Sequence[Sequence[tuple[str, Pose]]],
    camera: Camera,
    downscale: int | None,
    homes: Sequence[str] = ("",),
    pose_of: Callable[[Pose], object] | None = None,
) -> list[SplitPart]:
    """Views of the photos of each split, by the natural order of their paths, with cameras scaled to what is
    read of them. `where` lists the paths, from one of `homes` in the folder `base`.

    A photo that is listed again with the same pose, of which `pose_of` makes something hashable, is read
    once. Raises NoViews where no photo is there.
    """
    files = [file for split in splits for file, _ in split]
    matched = match_photos(where, base, files, downscale, homes)
    if not matched.photos:
        named = min(filter(None, files), key=natural, default="none")
        raise NoViews(
            f"{where}: names {len(matched.missing)} photos such as {named}, but none of them is there: "
            f"{matched.hint}"
        )

    def photo_of(file: str) -> str:  # however its path is written
        return os.path.normpath(matched.photos[file][0])

    def read(named: tuple[str, str, Pose]) -> View:
        name, file, pose = named
        photo, folder = matched.photos[file]
        header = read_image_header(photo)
        camera_where, view, mask = camera(pose, header, folder)
        reduction = folder.reduction(header, downscale)
        return on_photo(replace(view, name=name), photo, header, camera_where, mask, reduction)

    parts, notes = [], list(matched.notes)
    for split in splits:
        split = sorted(split, key=lambda item: natural(item[0]))
        items = [item for item in split if item[0] in matched.photos]
        if pose_of is not None:
            items, repeated = once(
                where, items, lambda item: photo_of(item[0]), lambda item: pose_of(item[1])
            )
            notes += repeated
        names = frame_names([file for file, _ in items])
        named = [(name, *item) for name, item in zip(names, items, strict=True)]
        views, broken = read_sound(where, named, read, lambda named: photo_of(named[1]))
        missing = tuple(file for file, _ in split if file not in matched.photos)
        parts.append(SplitPart(tuple(views), missing, (*notes, *broken, *repair_notes(where, views))))
        notes = []
    return parts
