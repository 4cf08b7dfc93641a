"""Which format of splats a file has, told by its content and never by its name; and its splats."""

import os
import re
from collections.abc import Callable
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import numpy as np

from formats.errors import BadSplats
from formats.ply_elements import MAX_HEADER
from formats.safe_input import open_input, read_input
from formats.splats.dot_splat import is_splat, read_splat
from formats.splats.gltf import names_splats, read_gltf_splats
from formats.splats.ksplat import is_ksplat, read_ksplat
from formats.splats.ply import is_ply, read_ply
from formats.splats.sog import is_meta, is_sog, read_sog
from formats.splats.splats import MAX_FILE, Splats
from formats.splats.spz import is_spz, read_spz
from formats.splats.streamed import is_index, read_streamed

HEAD = max(MAX_HEADER, 1 << 17)
"""Bytes of a file that are looked at first."""
MAX_JSON = 64 << 20
MAX_FILES = 2000
"""Point clouds of a run that are looked at."""
GIVE = "a .ply of 3DGS, .spz, .sog, .splat, .ksplat or .glb"


class Unread(NamedTuple):
    """A format of splats that is known and not read."""

    start: bytes
    """A pattern of its first bytes."""
    what: str
    """With its article."""
    cure: str
    """What to do, as an order."""


UNREAD = (
    Unread(rb"RAD0", "a .rad of Spark", "give the file that it was made from"),
    Unread(rb"spx[\1-\3]", "an .spx of Reall3D", "save it as a .ply, as by `gsbox x2p -i FILE -o new.ply`"),
    Unread(
        rb'\s*\{(?=.*"totalLevels?")(?=.*"totalSplats")',
        "an .lcc of XGRIDS",
        "save it as a .ply, as by `splat-transform FILE --select-lod 0 new.ply`",
    ),
    Unread(
        rb"ply[\r\n](?=.*element codebook_centers\b)",
        "a quantised .ply of Reduced-3DGS",
        "give the one that it was made from",
    ),
    Unread(
        rb"ply[\r\n](?=.*property \S+ f_anchor_feat_0\b)",
        "a .ply of Scaffold-GS, of which networks make splats",
        "give splats that need none",
    ),
    Unread(
        rb"ply[\r\n](?=.*property \S+ trbf_center\b)",
        "a .ply of Spacetime Gaussians, which move and whose colours networks make",
        "save one moment of it as a .ply of 3DGS",
    ),
    Unread(
        rb'\s*\{(?=.*"means")(?=.*"opacities")(?=.*"sh0")(?=.*"dtype")',
        "the meta.json of gsplat's PNG compression",
        "give the checkpoint or the .ply that it was made from",
    ),
)


def is_splats(path: Path | str) -> bool:
    """Whether a file holds Gaussian splats in a format that is read. Raises BadSplats for one of UNREAD,
    MissingFile, NotAFile, ResourceError."""
    return _reader(path) is not None


def read_splats(path: Path | str) -> Splats:
    """The splats of a .ply (plain or compressed), .spz, .sog (streamed too), .splat, .ksplat, .gltf or .glb.
    Raises BadSplats, LimitExceeded, NewerVersion, MissingFile, NotAFile, ResourceError; of glTF also what
    `read_gltf` raises."""
    reader = _reader(path)
    if reader is None:
        raise BadSplats(f"{path}: holds no Gaussian splats that can be read; give {GIVE}")
    with np.errstate(all="ignore"):  # numbers that are none or beyond any measure are left out, and told
        return reader(path, read_input(path, MAX_FILE))


def newest_point_cloud(folder: Path | str) -> Path | None:
    """The splats of the highest iteration in the folder of a run of 3DGS, or those of a folder that is a SOG;
    None in any other."""
    places = islice(Path(folder).glob("point_cloud/iteration_*/point_cloud.ply"), MAX_FILES)
    steps = {
        int(found[1]): place
        for place in places
        if (found := re.fullmatch(r"iteration_(\d{1,18})", place.parent.name)) and is_splats(place)
    }
    if steps:
        return steps[max(steps)]
    places = [Path(folder) / name for name in ("lod-meta.json", "meta.json")]
    return next((place for place in places if place.is_file() and is_splats(place)), None)


def is_moved(path: Path) -> bool:
    """Whether the splats of a run are moved by a network beside them, as 4DGaussians' and those of
    Deformable-3DGS are."""
    if path.with_name("deformation.pth").is_file():
        return True
    in_run = path.parent.name.startswith("iteration_") and len(path.parents) > 2
    return in_run and any(islice(path.parents[2].glob("deform/iteration_*/deform.pth"), 1))


@np.errstate(all="ignore")
def _reader(path: Path | str) -> Callable[[Path | str, bytes], Splats] | None:
    with open_input(path) as file:
        head, size = file.read(HEAD), os.fstat(file.fileno()).st_size
    if found := next((kind for kind in UNREAD if re.match(kind.start, head, re.DOTALL)), None):
        raise BadSplats(f"{path}: is {found.what}, which is not read; {found.cure}")
    if is_ply(head):
        return read_ply
    if is_spz(head):
        return read_spz
    if names_splats(_json(path, head)):
        return read_gltf_splats
    if is_index(head):
        return read_streamed
    if is_sog(path) if head.startswith(b"PK\3\4") else is_meta(head):
        return read_sog
    if is_ksplat(head, size):
        return read_ksplat
    return read_splat if is_splat(head, size) else None


def _json(path: Path | str, head: bytes) -> bytes:
    """The JSON of a .glb or .gltf, or of any file that begins so, up to MAX_JSON; nothing of others."""
    binary = head.startswith(b"glTF")
    if not binary and head.removeprefix(b"\xef\xbb\xbf").lstrip()[:1] != b"{":
        return b""
    start, length = (20, int.from_bytes(head[12:16], "little")) if binary else (0, MAX_JSON)
    with open_input(path) as file:
        file.seek(start)
        return file.read(min(length, MAX_JSON))
