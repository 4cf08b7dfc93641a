"""Wavefront .obj: polygons with texture coordinates, vertex colours and materials."""

import re
from pathlib import Path

import numpy as np

from formats.errors import BadMesh, FormatError, listed
from formats.safe_input import read_input
from formats.surfaces.lines import lines_of, numbers_in, table, western, without_comment
from formats.surfaces.mtl import FIRST_TILE, TILES_ACROSS, Appearances, Material, check_repeated, parse_mtl
from formats.surfaces.named_files import Beside
from formats.surfaces.polygons import triangulated
from formats.surfaces.surface import (
    Notes,
    Paint,
    Surface,
    laid,
    sound_colours,
)

AT_ONCE = 1 << 18
"""Corners of faces that are kept as text."""
FREE_FORM = ("curv", "curv2", "surf", "cstype", "parm", "bzp", "bsp", "cdc", "cdp")
LEFT_OUT = {
    **dict.fromkeys(("l", "p"), "points and lines"),
    **dict.fromkeys(FREE_FORM, "free-form curves and surfaces"),
    "call": "other files that are called",
    "usemap": "pictures that usemap names",
}
FEW = "faces of fewer than three corners"
POLYPAINT = re.compile(rb"^#MRGB +([0-9a-fA-F]+)", re.MULTILINE)
"""ZBrush's colours of vertices: eight digits each, two of them a mask."""


def read_obj(path: Path | str, notes: Notes) -> list[Surface]:
    """All faces, a surface for each material. Raises BadMesh, LimitExceeded, MissingFile."""
    data = read_input(path)
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        raise BadMesh(f"{path}: is text in UTF-16; save the mesh in UTF-8")
    text = _Text(path, notes)
    try:
        text.read(data)
    except (ValueError, OverflowError) as error:
        raise BadMesh(f"{path}: holds {error}; export the mesh again") from error
    painted = b"".join(POLYPAINT.findall(data))
    return _surfaces(text, path, len(data), painted, notes)


class _Text:
    """What the lines of a file say, as arrays."""

    def __init__(self, path: Path | str, notes: Notes):
        self.path, self.notes = path, notes
        self.points: list[str] = []
        self.uvs: list[str] = []
        self.tokens: list[str] = []
        """Corners that are still text."""
        self.relative: list[tuple[int, int]] = []
        """Vertices and coordinates so far, for each of `tokens`, since corners may count back from them."""
        self.corners: list[np.ndarray] = []
        self.counts: list[int] = []
        self.used: list[int] = []
        """Which of `materials` each face has."""
        self.materials: dict[str | None, int] = {None: 0}
        self.libraries: list[str] = []
        self.left_out: dict[str, int] = {}

    def read(self, data: bytes) -> None:
        material, points, uvs = 0, self.points, self.uvs
        for line in lines_of(data):
            word, _, rest = line.partition(" ")
            word = word.lower()
            if word == "v":
                points.append(rest)
            elif word == "vt":
                uvs.append(rest)
            elif word in ("f", "fo"):
                self._face(rest, material)
            elif word == "usemtl":
                material = self.materials.setdefault(rest.strip(), len(self.materials))
            elif word == "mtllib":
                self.libraries.append(rest.strip())
            elif word in LEFT_OUT:
                self.left_out[LEFT_OUT[word]] = self.left_out.get(LEFT_OUT[word], 0) + 1
        self._flush()
        for kind, count in self.left_out.items():
            self.notes.add(f"{kind} are left out ({count} lines)")

    def _face(self, rest: str, material: int) -> None:
        tokens = rest.partition("#")[0].split() if "#" in rest else rest.split()
        if len(tokens) < 3:
            self.left_out[FEW] = self.left_out.get(FEW, 0) + 1
            return
        self.tokens += tokens
        self.relative += [(len(self.points), len(self.uvs))] * len(tokens)
        self.counts.append(len(tokens))
        self.used.append(material)
        if len(self.tokens) > AT_ONCE:
            self._flush()

    def _flush(self) -> None:
        if not self.tokens:
            return
        so_far = np.array(self.relative)
        numbers = _numbers(self.tokens)
        numbers = np.where(numbers > 0, numbers - 1, np.where(numbers < 0, so_far + numbers, -1))
        if (numbers[:, 0] < 0).any():
            raise BadMesh(
                f"{self.path}: a face refers to a vertex that does not exist; export the mesh again"
            )
        self.corners.append(np.minimum(numbers, 2**31 - 1).astype(np.int32))
        self.tokens, self.relative = [], []


def _numbers(tokens: list[str]) -> np.ndarray:
    """(n, 2) vertex and texture coordinate as written, 0 for none, of "1", "1/2", "1/2/3" or "1//3"."""
    text = " ".join(tokens).replace("//", "/0/")
    slashes = {token.count("/") for token in tokens}
    if len(slashes) == 1:
        width = slashes.pop() + 1
        rows = numbers_in(text.replace("/", " "), np.int64)
        if len(rows) == width * len(tokens):
            rows = rows.reshape(-1, width)
            return rows[:, :2] if width > 1 else np.column_stack([rows, np.zeros_like(rows)])
    parts = [(*token.replace("//", "/0/").split("/"), "0")[:2] for token in tokens]
    return np.array([(int(a), int(b or 0)) for a, b in parts], np.int64)


def _points(lines: list[str]) -> tuple[np.ndarray, np.ndarray | None]:
    """(V, 3) positions, and (V, 4) colours where vertices have them: x y z, then w, or r g b, or r g b a."""
    numbers, widths, starts = table(lines)
    if (widths < 3).any():
        raise ValueError("a vertex of fewer than three numbers")
    positions, coloured = numbers[starts[:, None] + np.arange(3)], widths >= 6
    if not coloured.any():
        return positions, None
    colours, rgb = np.ones((len(lines), 3)), numbers[starts[coloured, None] + np.arange(3, 6)]
    colours[coloured] = rgb / (255 if np.nanmax(rgb, initial=0) > 1 else 1)
    return positions, sound_colours(colours)


def _polypaint(digits: bytes, count: int, notes: Notes) -> np.ndarray | None:
    """(V, 4) colours of ZBrush's mask, red, green and blue."""
    if len(digits) != 8 * count:
        notes.add("has colours of ZBrush for other vertices than it has, which are not shown")
        return None
    rows = np.frombuffer(bytes.fromhex(digits.decode()), np.uint8).reshape(-1, 4)
    return sound_colours(rows[:, 1:] / 255)


def _uvs(lines: list[str]) -> np.ndarray:
    """(n, 2), v up; v is 0 where it is not given."""
    numbers, widths, starts = table(lines)
    uvs, both = np.zeros((len(lines), 2)), widths > 1
    uvs[widths > 0, 0] = numbers[starts[widths > 0]]
    uvs[both, 1] = numbers[starts[both] + 1]
    return uvs


def _surfaces(text: _Text, path: Path | str, n_bytes: int, painted: bytes, notes: Notes) -> list[Surface]:
    if not text.counts:
        return []
    counts, used = np.array(text.counts), np.array(text.used)
    try:
        positions, colours = _points(text.points)
        uvs = _uvs(text.uvs)
    except (ValueError, OverflowError) as error:
        raise BadMesh(f"{path}: holds {error}; export the mesh again") from error
    if painted and colours is None:
        colours = _polypaint(painted, len(positions), notes)
    corners = np.concatenate(text.corners)
    corner_indices, polygon = triangulated(path, counts, corners[:, 0], positions, n_bytes)
    beside = Beside(path)
    materials = _materials(text, beside, path, notes)
    names = _chosen(text, materials, notes)
    for name, material in [(n, materials[m]) for n, m in names.items() if m is not None]:
        if material.tiled:
            _cut_into_tiles(name, material, text, used, (counts, corners, uvs), materials, names)
    looks, surfaces = Appearances(materials, beside, notes), []
    for name, index in text.materials.items():
        corner_rows = corner_indices[used[polygon] == index]
        if len(corner_rows):
            surfaces.append(
                _surface(corners[corner_rows], positions, uvs, colours, names[name], looks, notes)
            )
    looks.tell_unused()
    return surfaces


def _surface(corners, positions, uvs, colours, name: str | None, looks: Appearances, notes: Notes) -> Surface:
    """Of faces (F, 3, 2): vertex and coordinate, -1 for none."""
    look = None if name is None else looks.look(name)
    textured = look is not None and any(
        picture is not None
        for paint in (look.paint, look.glow)
        if paint is not None
        for picture in (paint.texture, paint.coverage)
    )
    keys = corners.reshape(-1, 2).astype(np.int64)
    key = keys[:, 0] * (len(uvs) + 2) + keys[:, 1] + 1 if textured else keys[:, 0]
    _, first, faces = np.unique(key, return_index=True, return_inverse=True)
    vertex, coordinate = keys[first].T
    rest = {"faces": faces.reshape(-1, 3).astype(np.int32)}
    if look is not None:
        uv = _coordinates(coordinate, uvs, look, name, notes) if textured else None
        rest["paint"] = look.paint if uv is None else laid(look.paint, uv)
        rest["glow"] = look.glow if uv is None or look.glow is None else laid(look.glow, uv)
        rest["blend"] = look.blend
    if colours is not None:
        if textured:
            notes.add("vertex colours are not used beside its picture", f"material {name[:60]!r}")
        else:
            rest["colours"] = colours[vertex]
            if "paint" in rest and np.ptp(rest["paint"].factor[:3]) < 1 / 512:
                alpha = rest["paint"].factor[3]
                rest["paint"] = Paint(np.array([1, 1, 1, alpha], np.float32))
    return Surface(positions[vertex], **rest)


def _coordinates(coordinate: np.ndarray, uvs: np.ndarray, look, name: str, notes: Notes) -> np.ndarray:
    """(V, 2), v down."""
    missing = (coordinate < 0) | (coordinate >= len(uvs))
    if missing.any():
        notes.add("has a picture, but some faces lack coordinates for it", f"material {name[:60]!r}")
    uv = np.zeros((len(coordinate), 2))
    uv[~missing] = uvs[coordinate[~missing]]
    uv = uv * look.scale + look.offset
    return np.column_stack([uv[:, 0], 1 - uv[:, 1]])


# --- materials ----------------------------------------------------------------------------------------------


def _materials(text: _Text, beside: Beside, path: Path | str, notes: Notes) -> dict[str, Material]:
    """All materials of all libraries, by name."""
    materials: dict[str, Material] = {}
    libraries = text.libraries or ([""] if len(text.materials) > 1 else [])
    for library in libraries:
        for data, file in _libraries(library, beside, path, notes):
            for name, material in parse_mtl(data, notes, file).items():
                check_repeated(materials.setdefault(name, material), material, notes)
    return materials


def _chosen(text: _Text, materials: dict[str, Material], notes: Notes) -> dict[str | None, str | None]:
    """Which material each name that faces use stands for."""
    folded = {_key(name): name for name in materials}
    chosen: dict[str | None, str | None] = {}
    for name in text.materials:
        if name is None:
            chosen[name] = next(iter(materials)) if len(materials) == 1 else None
        else:
            alike = folded.get(_key(name), folded.get(_key(without_comment(name))))
            chosen[name] = name if name in materials else alike
    lost = [name for name, material in chosen.items() if name is not None and material is None]
    if lost:
        notes.add(f"materials that no library holds: {listed(lost)}; their faces are shown white")
    return chosen


def _cut_into_tiles(name, material: Material, text: _Text, used, faces, materials, names) -> None:
    """Give the faces of each tile of the coordinates (<UDIM>: 1001 and on, ten across) a material of its
    own; `used`, `materials` and `names` are changed."""
    counts, corners, uvs = faces
    chosen_faces = np.flatnonzero(used == text.materials[name])
    if not len(chosen_faces):
        return
    first = corners[(np.cumsum(counts) - counts)[chosen_faces][:, None] + np.arange(3), 1]
    uv = np.vstack([uvs, np.zeros(2)])[np.where((first < 0) | (first >= len(uvs)), len(uvs), first)].mean(1)
    uv = np.nan_to_num(uv * material.placed.numbers("-s", 1) + material.placed.numbers("-o", 0))
    across, up = np.clip(np.floor(uv), 0, [TILES_ACROSS - 1, 99]).astype(int).T
    tiles = FIRST_TILE + across + TILES_ACROSS * up
    for tile in np.unique(tiles):
        cut = material.tile(int(tile))
        materials[cut.name] = cut
        names[cut.name] = cut.name
        used[chosen_faces[tiles == tile]] = text.materials.setdefault(cut.name, len(text.materials))
    materials.pop(material.name, None)


def _key(name: str) -> str:
    """Equal for names that differ in case, in quotes, or in how the two files write their letters."""
    return western(name).strip('"').casefold()


def _libraries(named: str, beside: Beside, path: Path | str, notes: Notes) -> list[tuple[bytes, str]]:
    """The files of one `mtllib`: one name that may hold spaces, or several; quotes are dropped. Where none is
    there, the library that is called as the mesh is."""
    paths, lost = [], []
    plain = without_comment(named)
    for names in ([named.strip('"')], [plain], plain.replace('"', " ").split()) if named else []:
        lost = []
        for name in names:
            try:
                paths.append(beside.read(name))
            except FormatError as error:
                lost.append(f"the library of materials {name!r} is not read: {error}")
        if paths:
            break
    for sentence in lost:
        notes.add(sentence)
    if not paths:
        try:
            paths.append(beside.read(Path(path).with_suffix(".mtl").name))
        except FormatError:
            return []
        notes.add(f"{paths[0][1]} is taken for its materials")
    return paths
