"""The frames of a list of poses: each is read once, and a few that are broken are left out and named."""

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from typing import TypeVar

from formats.errors import BadPose, FormatError, ResourceError, counted
from formats.views import View

FEW = 5
"""Broken frames are left out where there are at most one in so many."""
NAMED = 3
"""At most so many of them are named with what is wrong."""

Frame, Read = TypeVar("Frame"), TypeVar("Read")


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
