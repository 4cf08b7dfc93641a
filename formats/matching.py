"""Photos matched to the paths that poses give them, by name and never by order.

Poses come from other computers and programs: their paths may be whole ones of those, name folders that are
not here, or differ in the case of letters, the ending, percent signs or how Unicode writes an umlaut.
A photo that lies where its path says goes before one that nearly does; the rest are looked for in the folder
of the capture and below. A path that two photos would suit gets none, nor does a photo serve two paths.
"""

import os
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path, PurePosixPath
from urllib.parse import unquote

from formats.errors import counted, listed
from formats.names import folded
from formats.photos import (
    HEIF,
    Folder,
    chosen_copy,
    is_file,
    is_hidden,
    is_picture,
    natural,
    smaller_copies,
    split_ending,
)

PHOTO_FOLDERS = ("images", "input", "rgb", "photos", "frames", "color", "image", "results")
"""Folders that photos usually lie in, whatever the poses say."""
OTHER_FOLDERS = {"masks", "mask", "depth", "depths", "normals", "semantics", "__macosx", "@eadir"}
"""Folders of pictures that are no photos."""
HOMES = PHOTO_FOLDERS[:2]
"""Those that may hold the photos in folders of their own."""
MAX_LISTED = 200_000
"""At most so many files are looked at for photos that are not where their paths say."""
MAX_DEPTH = 8
NAMED = 5
"""At most so many photos are named."""


@dataclass(frozen=True)
class MatchedPhotos:
    """Photos of paths that were asked for."""

    photos: dict[str, tuple[Path, Folder]]
    """The photo of each path that has one, and the folder that it was taken from."""
    missing: tuple[str, ...]
    """Paths without a photo, in the order asked."""
    notes: tuple[str, ...]
    hint: str
    """What to do, as the end of a sentence, where no photo was found."""


def match_photos(
    where: Path | str,
    base: Path,
    files: Iterable[str],
    downscale: int | None,
    homes: Sequence[str] = ("",),
) -> MatchedPhotos:
    """The photos of `files`: paths with forward slashes, from a folder of `homes` in `base`, the one that
    holds the most of them. Notes begin with `where`, which states the paths.

    Folders like `images_4` beside the photos' are used where they lack none of them, as `chosen_copy` says.
    Beyond `base` and what lies below it only a path that leads there as it is written is followed.
    """
    files, listings = list(dict.fromkeys(filter(None, files))), Listings()
    tries = []
    for home in homes:
        paths = {file: str(PurePosixPath(home, file)) for file in files}
        tries.append((paths, *_as_written(listings, base, paths)))
        if all(tries[-1][1].values()):
            break
    paths, photos_of, ambiguous = max(tries, key=lambda item: sum(map(bool, item[1].values())))
    moved = {}
    # Of a folder that is there some photos may be gone: those are not elsewhere.
    there = {rooted(paths[file])[0] for file in files if photos_of[file] or file in ambiguous}
    if lost := {file: paths[file] for file in files if rooted(paths[file])[0] not in there}:
        used = {photo for several in photos_of.values() for photo in several.values()}
        moved, unclear = _elsewhere(base, lost, used)
        again, more = _as_written(listings, base, moved)
        photos_of, ambiguous = photos_of | again, ambiguous | unclear | more
    photos, notes = {}, []
    for root, group in _groups(
        {file: moved.get(file, paths[file]) for file in files if photos_of[file]}
    ).items():
        folders = listings.copies(base / root)
        folder, note = _folder(folders, [photos_of[file] for file in group], downscale)
        photos |= {
            file: (photos_of[file][folder.path], folder) for file in group if folder.path in photos_of[file]
        }
        notes += [note] if note else []
    missing = tuple(file for file in files if file not in photos)
    notes += _how(base, photos, moved)
    if unclear := _unclear(base, {file: photos for file, photos in ambiguous.items() if file in missing}):
        notes.append(unclear)
    notes += gone([file for file in missing if file not in ambiguous])
    hint = "" if photos else unclear or _instead(base)
    return MatchedPhotos(photos, missing, tuple(f"{where}: {note}" for note in notes), hint)


def find_file(base: Path, file: str) -> Path | None:
    """A file that is no photo, by a path from `base`, or where that is another computer's by its end."""
    parts = PurePosixPath(file).parts
    tails = (base.joinpath(*parts[i:]) for i in range(1, len(parts)) if ".." not in parts[i:])
    return next((path for path in (base / file, *tails) if is_file(path)), None)


def rooted(file: str) -> tuple[str, str]:
    """A photo's path split after its last folder of HOMES, or else before the file name."""
    parts = PurePosixPath(file).parts
    cut = next((i for i in range(len(parts) - 1, 0, -1) if parts[i - 1].casefold() in HOMES), len(parts) - 1)
    return str(PurePosixPath(*parts[:cut])), str(PurePosixPath(*parts[cut:]))


def key(name: str) -> str:
    """A name as it is compared: without percent signs, in one form of Unicode and of letters."""
    return folded(unquote(name)).strip()


def stem_key(name: str) -> str:
    """The same without the ending of a photo."""
    return key(split_ending(name)[0])


class Listings:
    """The pictures of folders and the smaller copies of folders, each of which is listed once."""

    def __init__(self):
        self.of, self._copies = cache(pictures_by_stem), cache(smaller_copies)

    def copies(self, folder: Path) -> list[Folder]:
        """As `formats.photos.copies`."""
        return [Folder(folder), *self._copies(folder.parent).get(folder.name, [])]

    def find(self, folder: Path, name: str) -> list[tuple[int, str]]:
        """The pictures of a folder that suit a name, with how well, 0 for the name itself; the best alone, or
        several that are as good. One without an ending is a PNG first, as Blender's are."""
        beside = self.of(folder)
        suited = beside.get(stem_key(name)) or beside.get(key(name)) or []
        if name in suited or not (suited or is_hidden(name)) and _holds_bytes(folder / name):
            return [(0, name)]
        bare = not split_ending(name)[1]
        ranks = [
            (1 if key(photo) == key(name) or bare and photo == f"{name}.png" else 2, photo)
            for photo in suited
            if len(suited) == 1 or not photo.lower().endswith(HEIF)  # it may not be readable
        ]
        best = min(ranks, default=(0, ""))[0]
        return [item for item in ranks if item[0] == best]


def pictures_by_stem(folder: Path) -> dict[str, list[str]]:
    """Names of a folder's pictures by `stem_key`; hidden and empty files are none."""
    named = defaultdict(list)
    for entry in _entries(folder):
        if is_picture(entry.name) and _holds_bytes(entry.path):
            named[stem_key(entry.name)].append(entry.name)
    return named


def _holds_bytes(path: Path | str) -> bool:
    """Whether this is a file, and not an empty one; False for names that no file system holds."""
    try:
        return os.path.isfile(path) and os.stat(path).st_size > 0
    except (OSError, ValueError):
        return False


def _entries(folder: Path) -> Iterator[os.DirEntry]:
    """What lies in a folder, but hidden files; nothing where it is none."""
    try:
        with os.scandir(folder) as entries:
            visible = [entry for entry in entries if not is_hidden(entry.name)]
    except (OSError, ValueError):
        visible = []
    yield from sorted(visible, key=lambda entry: entry.name)


# --- where the paths say ------------------------------------------------------------------------------------


def _as_written(
    listings: Listings, base: Path, files: dict[str, str]
) -> tuple[dict[str, dict[Path, Path]], dict[str, list[Path]]]:
    """Of paths from `base`, by file: the photo in each folder of copies, by that folder; and files for which
    photos lie there that suit them equally well."""
    photos_of, ambiguous = {file: {} for file in files}, {}
    for root, group in _groups(files).items():
        home = base / root
        # Beside the capture itself lie other captures, not copies of it.
        for copy in listings.copies(home) if home != base else [Folder(home)]:
            suited = {}
            for file in group:
                inner = PurePosixPath(rooted(files[file])[1])
                folder = copy.path / inner.parent
                suited[file] = [(rank, folder / name) for rank, name in listings.find(folder, inner.name)]
            claims, unclear = _claims(suited)
            ambiguous |= unclear
            for file, photo in claims.items():
                photos_of[file][copy.path] = photo
    return photos_of, {file: photos for file, photos in ambiguous.items() if not photos_of[file]}


def _groups(files: dict[str, str]) -> dict[str, list[str]]:
    """Files by the folder of photos that their paths name."""
    groups = defaultdict(list)
    for file, path in files.items():
        groups[rooted(path)[0]].append(file)
    return groups


def _claims(suited: dict[str, list[tuple]]) -> tuple[dict[str, Path], dict[str, list[Path]]]:
    """The photo of each file out of those that suit it, (rank, photo), all of one rank; a photo goes to the
    file of the least rank. And files for which that leaves several, or a photo that others want as much."""
    least: dict[Path, list] = {}
    for file, photos in suited.items():
        for rank, photo in photos:
            best = least.setdefault(photo, [rank, []])
            if rank < best[0]:
                best[:] = rank, []
            if rank == best[0]:
                best[1].append(file)
    claims, unclear = {}, {}
    for file, photos in suited.items():
        claimed = [photo for rank, photo in photos if rank == least[photo][0]]
        if len(claimed) == 1 and len(least[claimed[0]][1]) == 1:
            claims[file] = claimed[0]
        elif claimed:
            unclear[file] = claimed
    return claims, unclear


def _folder(
    folders: list[Folder], photos_by_folder: Sequence[dict[Path, Path]], downscale: int | None
) -> tuple[Folder, str | None]:
    """The folder to read photos from, out of one and its copies: one that has as many of them as any; and a
    sentence where it is a copy, or where a copy lacks some. `photos_by_folder` are the photos by folder."""
    candidates = [
        (folder, [photos[folder.path] for photos in photos_by_folder if folder.path in photos])
        for folder in folders
    ]
    candidates = [(folder, photos) for folder, photos in candidates if photos]
    most = max(len(photos) for _, photos in candidates)
    chosen = chosen_copy(
        [(folder, photos[0]) for folder, photos in candidates if len(photos) == most], downscale
    )
    best = chosen_copy([(folder, photos[0]) for folder, photos in candidates], downscale)
    if chosen.factor > 1:
        return chosen, f"photos are read from {chosen.path.name} instead of {folders[0].path.name}"
    if best.path != chosen.path:
        count = next(len(photos) for folder, photos in candidates if folder.path == best.path)
        return chosen, (
            f"{best.path.name} has {count} of {most} photos and is not used; they are read from "
            f"{chosen.path.name}"
        )
    return chosen, None


# --- elsewhere ----------------------------------------------------------------------------------------------


def _elsewhere(
    base: Path, files: dict[str, str], used: set[Path]
) -> tuple[dict[str, str], dict[str, list[Path]]]:
    """For files whose paths do not lead to their photos, the paths from `base` at which photos below it lie
    whose names suit them; and those for which photos of several folders do.

    Folders that the path has and the photo lacks, or the other way round, are passed over, but not both: a
    photo in `right/` is none of `left/`.
    """
    beside, inside = defaultdict(set), defaultdict(set)
    for photo, folders in _tree(base):
        if base.joinpath(*photo) not in used:
            stem, named = stem_key(photo[-1]), tuple(map(key, folders))
            below = _below(named)
            beside[named, stem].add(folders)
            beside[below, stem].add(folders)
            for i in range(1, len(below) + 1):
                inside[below[i:], stem].add(folders)
    suited = {file: _suited(beside, inside, path) for file, path in files.items()}
    # Where photos lie as their paths say from some folder on, others of that folder do not lie deeper.
    sure = {rooted(files[file])[0] for file, (deeper, folders) in suited.items() if folders and not deeper}
    moved, unclear = {}, {}
    for file, (deeper, folders) in suited.items():
        paths = sorted("/".join((*parts, PurePosixPath(file).name)) for parts in folders)
        if not paths or deeper and rooted(files[file])[0] in sure:
            continue
        if len(paths) == 1:
            moved[file] = paths[0]
        else:
            unclear[file] = [base / path for path in paths]
    return moved, unclear


def _suited(beside: dict, inside: dict, path: str) -> tuple[bool, set[tuple[str, ...]]]:
    """The folders of the photos whose path shares the longest end with `path`, and whether these lie in
    folders that it does not name. `beside` has the folders of photos by the whole of their keys and the
    photo's, `inside` by their ends."""
    *stated, name = PurePosixPath(path).parts
    stated = tuple(map(key, stated))
    for i in range(len(stated) + 1):
        for stem in (stem_key(name), key(name)):
            if folders := beside.get((stated[i:], stem)):
                return False, folders
            if stated[i:] == _below(stated) and (folders := inside.get((stated[i:], stem))):
                return True, folders
    return False, set()


def _below(folders: tuple[str, ...]) -> tuple[str, ...]:
    """Folders below the one that photos usually lie in."""
    return folders[1:] if folders and folders[0] in PHOTO_FOLDERS else folders


def _tree(base: Path) -> Iterator[tuple[tuple[str, ...], tuple[str, ...]]]:
    """The parts of the path of each picture below `base`, and the folders that it or its full-size original
    lies in; what is nearer comes first. Links are followed where they stay below it or have the name of a
    folder of photos, and into no folder twice."""
    root = os.path.realpath(base)
    waiting, entered, count = [((), ())], {root}, 0
    for path, folders in waiting:
        inner = [entry for entry in _entries(base.joinpath(*path))]
        named = {entry.name for entry in inner}
        for entry in inner:
            count += 1
            if count > MAX_LISTED:
                return
            if is_picture(entry.name):
                if _holds_bytes(entry.path):
                    yield (*path, entry.name), folders
            elif len(path) < MAX_DEPTH and key(entry.name) not in OTHER_FOLDERS and _is_folder(entry):
                real = os.path.realpath(entry.path)
                below = Path(real).is_relative_to(root) or key(entry.name) in PHOTO_FOLDERS
                if below and real not in entered:
                    entered.add(real)
                    waiting.append(((*path, entry.name), (*folders, _original(entry.name, named))))


def _is_folder(entry: os.DirEntry) -> bool:
    try:
        return entry.is_dir()
    except OSError:  # a link that leads in a circle
        return False


def _original(name: str, beside: set[str]) -> str:
    """`images` of `images_4`: the folder whose smaller copies a folder holds, or itself."""
    plain, _, factor = name.rpartition("_")
    return plain if factor.isdecimal() and (plain in beside or plain == "images") else name


# --- what is said -------------------------------------------------------------------------------------------


def _how(base: Path, photos: dict[str, tuple[Path, Folder]], moved: dict[str, str]) -> Iterator[str]:
    """Sentences about photos that are not quite where their paths say."""
    other = [file for file in photos if file in moved]
    if other:
        yield (
            f"{counted(len(other), 'photo is', 'photos are')} not where the file says and taken by name from "
            f"elsewhere, such as {_local(base, photos[other[0]][0])} for {other[0]}"
        )
    renamed = [file for file, (photo, _) in photos.items() if file not in moved and _differs(file, photo)]
    if renamed:
        count = counted(len(renamed), "photo has", "photos have")
        yield (
            f"{count} another ending or other letters than the file says, such as "
            f"{photos[renamed[0]][0].name} for {PurePosixPath(renamed[0]).name}"
        )


def _unclear(base: Path, ambiguous: dict[str, list[Path]]) -> str:
    """A sentence about files that several photos suit, and photos that suit several files; empty without."""
    if not ambiguous:
        return ""
    file, photos = next(iter(ambiguous.items()))
    several = "more than one photo suits" if len(photos) > 1 else "its photo suits other paths too"
    return (
        f"{counted(len(ambiguous), 'path has', 'paths have')} no photo alone, such as {file}: {several} "
        f"({' and '.join(_local(base, photo) for photo in photos[:2])}); give photos the names of the paths"
    )


def _instead(base: Path) -> str:
    """What lies in a folder in which no photo was found, and what to do, as the end of a sentence."""
    listing = sorted(("/".join(photo) for photo, _ in _tree(base)), key=natural)
    there = f"holds {len(listing)} others, such as {listing[0]}" if listing else "holds no photos"
    return f"{base} {there}; put the photos there under the names that the poses have"


def gone(missing: Sequence[str]) -> list[str]:
    """A sentence about photos that are left out since they are not there or of 0 bytes."""
    if not missing:
        return []
    count = counted(len(missing), "photo is not there or empty", "photos are not there or empty")
    return [f"{count} and left out: {listed(missing, NAMED)}"]


def _differs(file: str, photo: Path) -> bool:
    """Whether a photo has another name than a path says, other than an ending where that has none."""
    name = PurePosixPath(file).name
    return photo.name != name and not (photo.name.startswith(f"{name}.") and not split_ending(name)[1])


def _local(base: Path, photo: Path) -> str:
    return str(photo.relative_to(base) if photo.is_relative_to(base) else photo)
