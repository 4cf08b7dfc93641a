"""The frames of a list of poses and their photos: each is read once, and a few that are broken are left out
and named."""

import os
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

from formats.cameras import frame_names
from formats.errors import BadPose, FormatError, NoViews, ResourceError, counted
from formats.images import Header, read_image_header
from formats.matching import match_photos
from formats.photos import Folder, natural, on_photo
from formats.views import View

FEW = 5
"""Broken frames are left out where there are at most one in so many."""
NAMED = 3
"""At most so many of them are named with what is wrong."""

Frame, Read = TypeVar("Frame"), TypeVar("Read")
Pose = TypeVar("Pose")
"""What a list says of one photo."""
Camera = Callable[[Pose, Header, Folder], tuple[str, View, Path | None]]
"""How errors name a pose, its view and its mask, by the header and the folder of its photo."""


def once(
    where: object,
    frames: Sequence[Frame],
    file_of: Callable[[Frame], str],
    pose_of: Callable[[Frame], object],
) -> tuple[list[Frame], list[str]]:
    """The frames without those that repeat the photo and the pose (hashable) of one before, and a note on
    these."""
    known, sound, repeated = set(), [], []
    for frame in frames:
        count = (file_of(frame), pose_of(frame))
        if count in known:
            repeated.append(count[0])
        else:
            known.add(count)
            sound.append(frame)
    if not repeated:
        return sound, []
    count = counted(len(repeated), "frame is", "frames are")
    return sound, [f"{where}: {count} listed again, such as {repeated[0]}, and read once"]


def read_sound(
    where: object, frames: Sequence[Frame], read: Callable[[Frame], Read], file_of: Callable[[Frame], str]
) -> tuple[list[Read], list[str]]:
    """The views that `read` makes of frames, without a few that it refuses, and notes on these.

    Frames that give one photo different poses are refused. Raises the first error where more than one frame
    in FEW has one, and ResourceError always.
    """
    counts, views, errors = Counter(map(file_of, frames)), [], []
    for frame in frames:
        try:
            if counts[file_of(frame)] > 1:
                raise BadPose(
                    f"{where}: {file_of(frame)} is listed {counts[file_of(frame)]} times, with different "
                    "poses; remove the wrong ones"
                )
            views.append(read(frame))
        except ResourceError:
            raise
        except FormatError as error:
            errors.append(error)
    if len(errors) * FEW > len(frames):
        raise errors[0]
    notes = [f"{error} (its frame is left out)" for error in errors[:NAMED]]
    if len(errors) > NAMED:
        notes.append(f"{len(errors)} of {len(frames)} frames are left out for such reasons")
    return views, notes


def repair_notes(where: object, views: Iterable[View]) -> list[str]:
    """What was mended of the views' poses, a sentence for each kind of repair."""
    named: dict[str, list[str]] = {}
    for view in views:
        if view.repair:
            named.setdefault(view.repair, []).append(view.name)
    return [
        f"{where}: the poses of {counted(len(names), 'photo', 'photos')}, such as {names[0]}, {repair}"
        for repair, names in named.items()
    ]


# --- photos -------------------------------------------------------------------------------------------------


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
