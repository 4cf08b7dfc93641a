"""Splats in a .ply: as 3DGS writes them, and in SuperSplat's compressed form of chunks of 256.

https://github.com/graphdeco-inria/gaussian-splatting (scene/gaussian_model.py, `save_ply`);
https://github.com/playcanvas/splat-transform (decompress-ply.ts).
"""

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from formats.errors import BadSplats
from formats.ply_elements import AXES, MAX_HEADER, read_elements, rgb_of
from formats.splats.splats import (
    ANTIALIASED,
    DOWN_Y,
    UP_Z,
    Splats,
    check_count,
    coefficients_of,
    gathered,
    not_honoured,
    of_colours,
    sigmoid,
    sizes_of,
)

HEADER = re.compile(
    rb"ply[\r\n](?=.*property \S+ scale_0\b)(?=.*property \S+ (?:rot_0|opacity)\b)|"
    rb"ply[\r\n](?=.*property \S+ packed_position\b)(?=.*property \S+ packed_rotation\b)",
    re.DOTALL,
)
CHUNK = 256
UPRIGHT = re.compile(r"comment\s+vertical axis:\s*(z|\S+\s+\S+\s+\S+)\s*$", re.IGNORECASE)
"""Nerfstudio's, whose world has z up, and Brush's, which writes the direction where it was told it. Otherwise
Brush writes y, whichever way is up."""
FILTER = "filter_3D"
"""Of Mip-Splatting, the least size that cameras told apart (Yu et al. 2024, eq. 8)."""
PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
SMOOTHED = re.compile(r"comment\s+(splatrendermode:\s*mip|antialiased\s+1)\s*$", re.IGNORECASE)
"""Brush's way to say that splats were trained with antialiasing, and Postshot's."""


def is_ply(head: bytes) -> bool:
    """Whether a file that begins so has the properties of splats."""
    return head.startswith(b"ply") and bool(HEADER.match(head[:MAX_HEADER].partition(b"end_header")[0]))


def read_ply(path: Path | str, data: bytes) -> Splats:
    """Raises BadSplats, LimitExceeded."""
    lines, elements = read_elements(path, data, BadSplats)
    tables = dict(elements)
    vertices, notes = tables.pop("vertex", {}), []
    check_count(path, len(next(iter(vertices.values()), ())))
    compressed = set(PACKED) <= set(vertices)
    chunks, rest = (tables.pop("chunk", {}), tables.pop("sh", {})) if compressed else ({}, {})
    not_honoured(tables, notes, "elements")
    if any(SMOOTHED.match(line) for line in lines):
        notes.append(ANTIALIASED)
    if compressed:
        columns = _Columns(path, chunks), _Columns(path, vertices), _Columns(path, rest)
        return _compressed(path, *columns, notes)
    return _plain(path, _Columns(path, vertices), _up(lines), notes)


def _up(lines: list[str]) -> tuple[float, float, float]:
    """What is up by the comments of a header."""
    for words in (found[1].split() for found in map(UPRIGHT.match, lines) if found):
        if len(words) == 1:
            return UP_Z
        try:
            axis = np.array([float(word) for word in words])
        except ValueError:
            continue
        length = np.linalg.norm(axis)
        if 0 < length < np.inf:
            return tuple((axis / length).tolist())
    return DOWN_Y


class _Columns(dict):
    """The columns of an element by their names."""

    def __init__(self, path: Path | str, columns: dict):
        super().__init__(columns)
        self.path = path

    def rows(self, names: Sequence[str], kind: type = np.float32) -> np.ndarray:
        """(N, n) of n columns of that kind; of floats any width will do."""
        for name in names:
            if not isinstance(self.get(name), np.ndarray):
                raise BadSplats(f"{self.path}: its splats lack {name!r}; export it again")
            found, wanted = self[name].dtype, np.dtype(kind)
            fits = found.kind == wanted.kind and found.itemsize in (wanted.itemsize, 8)
            if len(self[name]) and not fits:
                raise BadSplats(
                    f"{self.path}: stores {name!r} as {found.name}, expected {kind.__name__}; export it as "
                    "3DGS does"
                )
        return np.stack([self[name].astype(kind) for name in names], 1)


def _series(columns: dict, stem: str) -> list[str]:
    """stem0, stem1 and so on, as far as they are there."""
    names = []
    while f"{stem}{len(names)}" in columns:
        names.append(f"{stem}{len(names)}")
    return names


# --- as 3DGS writes it --------------------------------------------------------------------------------------


def _plain(path, vertices: _Columns, up: tuple[float, float, float], notes: list[str]) -> Splats:
    centres = vertices.rows(AXES)
    axes, rest = _series(vertices, "scale_")[:3], _series(vertices, "f_rest_")
    opacities = sigmoid(vertices.rows(["opacity"])[:, 0])
    scales = sizes_of(vertices.rows(axes or ["scale_0"]), notes)
    if FILTER in vertices:
        scales, opacities = _filtered(scales, opacities, vertices.rows([FILTER]))
    harmonics = _harmonics(path, vertices, rest, notes)
    known = {*AXES, *axes, *rest, "opacity", FILTER, "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"}
    known |= {"rot_0", "rot_1", "rot_2", "rot_3", "red", "green", "blue", "alpha"}
    not_honoured([name for name in vertices if name not in known], notes, "properties")
    return gathered(
        path,
        "a .ply of 3D Gaussian splats",
        centres=centres,
        scales=scales,
        rotations=vertices.rows([f"rot_{i}" for i in range(4)]),
        opacities=opacities,
        harmonics=harmonics,
        up=up,
        notes=notes,
    )


def _harmonics(path, vertices: _Columns, rest: list[str], notes: list[str]) -> np.ndarray:
    """(N, K, 3); `f_rest_*` are all coefficients of red, then those of green, then those of blue."""
    if "f_dc_0" in vertices:
        first = vertices.rows(["f_dc_0", "f_dc_1", "f_dc_2"]).astype(np.float32)[:, None]
    elif (colours := rgb_of(vertices)) is not None:
        first = of_colours(colours[0] / colours[1])
    else:
        raise BadSplats(f"{path}: its splats lack a colour ('f_dc_0'); export it again")
    if missing := [name for name in vertices if name.startswith("f_rest_") and name not in rest]:
        raise BadSplats(
            f"{path}: has {missing[0]!r}, but only {len(rest)} of those before it; export it again"
        )
    stored, kept = coefficients_of(path, len(rest), notes)
    harmonics = np.empty((len(first), 1 + kept, 3), np.float32)
    harmonics[:, :1] = first
    for channel in range(3):
        for k in range(kept):
            harmonics[:, 1 + k, channel] = vertices.rows([rest[channel * stored + k]])[:, 0]
    return harmonics


def _filtered(scales: np.ndarray, opacities: np.ndarray, least: np.ndarray) -> tuple:
    """Scales and opacities of splats blurred by Mip-Splatting's 3D filter, which keeps what they weigh."""
    wider = np.sqrt(scales**2 + least.astype(np.float64) ** 2)
    return wider, opacities * np.prod(scales / wider, 1)


# --- compressed ---------------------------------------------------------------------------------------------


def _compressed(path, chunks: _Columns, vertices: _Columns, rest: _Columns, notes: list[str]) -> Splats:
    """Numbers of 8 to 11 bits between the least and the largest of a chunk of 256 splats."""
    packed = vertices.rows(PACKED, np.uint32)
    if len(chunks.rows(["min_x"])) != -(-len(packed) // CHUNK):
        raise BadSplats(
            f"{path}: has {len(chunks['min_x']):,} chunks for {len(packed):,} splats, expected one for "
            f"{CHUNK}; export it again"
        )
    position, rotation, scale, colour = packed.T
    colours = _bits(colour, (24, 16, 8, 0), (8, 8, 8, 8))
    rgb = colours[:, :3]
    if "min_r" in chunks:
        rgb = _spread(chunks, ("r", "g", "b"), rgb)
    scales = np.exp(_spread(chunks, ("scale_x", "scale_y", "scale_z"), _bits_11_10_11(scale)))
    return gathered(
        path,
        "a compressed .ply of 3D Gaussian splats",
        centres=_spread(chunks, AXES, _bits_11_10_11(position)),
        scales=scales,
        rotations=_smallest_three(rotation),
        opacities=colours[:, 3],
        harmonics=_with_rest(path, of_colours(rgb), rest, notes),
        notes=notes,
    )


def _bits(values: np.ndarray, shifts: Sequence[int], widths: Sequence[int]) -> np.ndarray:
    """(N, n) float64 in [0, 1] of fields of whole numbers."""
    fields = [
        (values >> np.uint32(shift) & np.uint32(2**width - 1)) / (2**width - 1)
        for shift, width in zip(shifts, widths, strict=True)
    ]
    return np.stack(fields, 1)


def _bits_11_10_11(values: np.ndarray) -> np.ndarray:
    return _bits(values, (21, 11, 0), (11, 10, 11))


def _spread(chunks: _Columns, names: Sequence[str], shares: np.ndarray) -> np.ndarray:
    """(N, n) float64 between `min_` and `max_` of the chunk that a splat is in."""
    chunk = np.arange(len(shares)) // CHUNK
    low = chunks.rows([f"min_{name}" for name in names]).astype(np.float64)[chunk]
    high = chunks.rows([f"max_{name}" for name in names]).astype(np.float64)[chunk]
    return low * (1 - shares) + high * shares


def _smallest_three(values: np.ndarray) -> np.ndarray:
    """(N, 4) w, x, y, z: two bits say which is the largest, the others have ten bits each."""
    others = (_bits(values, (20, 10, 0), (10, 10, 10)) - 0.5) * np.sqrt(2)
    largest = np.sqrt(np.maximum(0, 1 - (others**2).sum(1)))
    which = (values >> np.uint32(30)).astype(int)
    quaternions = np.empty((len(values), 4))
    for i in range(4):
        quaternions[which == i] = np.insert(others[which == i], i, largest[which == i], axis=1)
    return quaternions


def _with_rest(path, first: np.ndarray, rest: _Columns, notes: list[str]) -> np.ndarray:
    """(N, K, 3) with the bytes of the element `sh`, which stand for numbers between -4 and 4."""
    names = _series(rest, "f_rest_")
    stored, kept = coefficients_of(path, len(names), notes)
    if not kept:
        return first
    table = rest.rows(names, np.uint8)
    if len(table) != len(first):
        raise BadSplats(
            f"{path}: has {len(table):,} rows of harmonics for {len(first):,} splats; export it again"
        )
    middle = (np.arange(256) + 0.5) / 256
    middle[[0, 255]] = 0, 1
    numbers = ((middle - 0.5) * 8).astype(np.float32)[table].reshape(-1, 3, stored)
    return np.concatenate([first, numbers[:, :, :kept].transpose(0, 2, 1)], 1)
