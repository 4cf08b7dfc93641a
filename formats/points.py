"""Sparse points of structure from motion: positions with colours, read from a .ply file."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from formats.atomic import atomic_writer
from formats.errors import BadModel, counted
from formats.ply_elements import AXES, read_elements, rgb_of
from formats.safe_input import read_input

MAX_POINTS = 5_000_000
"""Of more points every second, third and so on is read."""


@dataclass(frozen=True, eq=False)
class SparsePoints:
    """Points on surfaces, in world units; finite."""

    positions: np.ndarray
    """(N, 3) float64."""
    colours: np.ndarray
    """(N, 3) uint8 sRGB; white where the file has none."""
    thinned: int = 1
    """One out of so many of the file's points is here, from the first on."""
    damaged: int = 0
    """Points of the file that are left out, since they are NaN, infinite or beyond 1e30."""

    def moved(self, matrix: np.ndarray) -> "SparsePoints":
        """The same points behind an affine (3, 4) or (4, 4)."""
        return replace(self, positions=self.positions @ matrix[:3, :3].T + matrix[:3, 3])


def stride(count: int, most: int = MAX_POINTS) -> int:
    """How many points of a file one is read of, so that there are at most so many."""
    return max(1, -(-count // most))


def points_notes(path: Path | str, points: SparsePoints | None) -> list[str]:
    """Sentences where not all points of a file were read."""
    notes = []
    if points is not None and points.thinned > 1:
        notes.append(
            f"{path}: of its many sparse points one in {points.thinned} is read, "
            f"{len(points.positions):,} in all"
        )
    if points is not None and points.damaged:
        count = counted(points.damaged, "sparse point is", "sparse points are")
        notes.append(f"{path}: {count} NaN, infinite or beyond 1e30, and left out")
    return notes


def read_ply_points(path: Path | str, most: int = MAX_POINTS) -> SparsePoints:
    """The vertices of a .ply, text or binary, without those that are NaN, infinite or beyond 1e30; of more
    than `most` only some (`thinned`). Other elements are ignored.

    Raises BadModel, LimitExceeded (before anything is allocated), MissingFile.
    """
    _, elements = read_elements(path, read_input(path), BadModel)
    columns = next((columns for name, columns in elements if name == "vertex"), {})
    if not all(isinstance(columns.get(axis), np.ndarray) for axis in AXES):
        raise BadModel(f"{path}: its vertices lack x, y or z; export the points again")
    step = stride(len(columns["x"]), most)
    columns = {name: column[::step] for name, column in columns.items() if isinstance(column, np.ndarray)}
    positions = np.stack([columns[axis].astype(np.float64) for axis in AXES], 1)
    rgb, most_rgb = rgb_of(columns) or (np.ones_like(positions), 1)
    colours = np.clip(np.nan_to_num(rgb) * (255 / most_rgb), 0, 255).astype(np.uint8)
    sound = (np.abs(positions) < 1e30).all(1)
    return SparsePoints(positions[sound], colours[sound], step, int((~sound).sum()))


def write_ply_points(path: Path | str, points: SparsePoints) -> None:
    """A binary .ply of float32 positions and colours. Raises ResourceError."""
    kinds = [(axis, "<f4") for axis in "xyz"] + [(hue, "u1") for hue in ("red", "green", "blue")]
    table = np.empty(len(points.positions), kinds)
    for i, axis in enumerate("xyz"):
        table[axis] = points.positions[:, i]
    for i, hue in enumerate(("red", "green", "blue")):
        table[hue] = points.colours[:, i]
    properties = [f"property {'float' if kind == '<f4' else 'uchar'} {name}" for name, kind in kinds]
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(table)}", *properties]
    with atomic_writer(path) as file:
        file.write("\n".join([*head, "end_header", ""]).encode() + table.tobytes())
