"""Streamed SOG: many SOGs in levels of detail, named by a lod-meta.json. The finest level is read, and the
surroundings.

https://developer.playcanvas.com/user-manual/gaussian-splatting/formats/streamed-sog/
"""

from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import msgspec

from formats.errors import BadSplats, MissingFile, NewerVersion
from formats.safe_input import parse_json, read_input
from formats.splats.sog import read_sog
from formats.splats.splats import MAX_FILE, Splats, check_count, joined
from formats.surfaces.named_files import Beside

VERSION = 1
FINEST = "0"


class Place(msgspec.Struct):
    """Splats of a node in a level: so many of a file, one after the other."""

    file: Annotated[int, msgspec.Meta(ge=0)]


class Node(msgspec.Struct):
    """A node of the tree; of a leaf its splats by level."""

    children: list["Node"] = []
    lods: dict[str, Place] = {}


class Index(msgspec.Struct):
    """lod-meta.json. Early ones have no version."""

    filenames: list[str]
    tree: Node
    version: int = VERSION
    environment: str | None = None


def is_index(head: bytes) -> bool:
    """Whether a file that begins so is a lod-meta.json."""
    return head.lstrip()[:1] == b"{" and b'"lodLevels"' in head and b'"filenames"' in head


def read_streamed(path: Path | str, data: bytes) -> Splats:
    """Raises BadJson, BadSplats, LimitExceeded, MissingFile, NewerVersion, OutsideFolder."""
    try:
        index = msgspec.convert(parse_json(data, str(path)), Index)
    except msgspec.ValidationError as error:
        raise BadSplats(f"{path}: is no lod-meta.json of a streamed SOG: {error}; export it again") from error
    if index.version != VERSION:
        raise NewerVersion(
            f"{path}: is a streamed SOG of version {index.version}, and {VERSION} is read; update fusedrf, "
            "or save it as one .ply"
        )
    pieces, notes, total = [], {}, 0
    for part in _parts(path, index):
        piece = read_sog(part, read_input(part, MAX_FILE))
        pieces.append(piece)
        notes |= dict.fromkeys(note.removeprefix(f"{part}: ") for note in piece.notes)
        total += len(piece)
        check_count(path, total)
    return joined(path, "a streamed SOG, read in its finest level", pieces, list(notes))


def _parts(path: Path | str, index: Index) -> list[Path]:
    """The meta.json of each SOG of the finest level, and that of the surroundings."""
    levels = defaultdict(set)
    for node in _nodes(index.tree):
        for level, place in node.lods.items():
            levels[place.file].add(level)
    finest = sorted(file for file, found in levels.items() if FINEST in found)
    if not finest or finest[-1] >= len(index.filenames) or any(len(levels[file]) > 1 for file in finest):
        raise BadSplats(f"{path}: has no files that are of its finest level alone; export it again")
    names = [index.filenames[file] for file in finest] + ([index.environment] if index.environment else [])
    beside = Beside(path)
    parts = [beside.find(name) for name in names]
    for name, part in zip(names, parts, strict=True):  # all have one name, in folders of their own
        if part.parent.name.lower() != (Path(path).parent / name).parent.name.lower():
            raise MissingFile(f"{path}: names {name[:80]!r}, which is not there; copy its whole folder")
    if len({part.resolve() for part in parts}) < len(parts):
        raise BadSplats(f"{path}: names a file twice; export it again")
    return parts


def _nodes(node: Node) -> Iterator[Node]:
    yield node
    for child in node.children:
        yield from _nodes(child)
