""".splat: 32 bytes a splat and nothing else, so that a file is told by what its numbers can be.

https://github.com/antimatter15/splat: float32 position and scale, colour and opacity as bytes, and a rotation
w, x, y, z as bytes around 128.
"""

from pathlib import Path

import numpy as np

from formats.errors import BadSplats
from formats.splats.splats import Splats, check_count, gathered, of_colours

ROW = np.dtype([("centre", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("rotation", "u1", 4)])
SAMPLE = 4096
"""Splats that are looked at."""
LIKELY = 0.9
"""Share of them that have to be likely, since a few are damaged in real files."""
UNITS = 0.15
"""How far from 1 a quaternion's length may be, which is rounded to 1/128."""
FARTHEST, SMALLEST, LARGEST = 1e7, 1e-12, 1e5


def is_splat(head: bytes, size: int) -> bool:
    """Whether a file of `size` bytes that begins so can be one."""
    if size < ROW.itemsize:
        return False
    rows = np.frombuffer(head, ROW, min(len(head) // ROW.itemsize, SAMPLE))
    likely = (np.abs(rows["centre"]) < FARTHEST).all(1)
    likely &= (rows["scale"] >= 0).all(1) & (rows["scale"].max(1) > SMALLEST)
    likely &= (rows["scale"] < LARGEST).all(1)
    lengths = np.linalg.norm(_rotations(rows), axis=1)
    likely &= (np.abs(lengths - 1) < UNITS) | (lengths == 0)
    return len(rows) > 0 and likely.mean() >= LIKELY


def _rotations(rows: np.ndarray) -> np.ndarray:
    return (rows["rotation"].astype(np.float32) - 128) / 128


def read_splat(path: Path | str, data: bytes) -> Splats:
    """Raises BadSplats, LimitExceeded."""
    count, rest = divmod(len(data), ROW.itemsize)
    if rest:
        raise BadSplats(f"{path}: {len(data):,} bytes are no whole splats of 32 bytes; copy it again")
    check_count(path, count)
    rows = np.frombuffer(data, ROW)
    rgba = rows["rgba"] / 255
    return gathered(
        path,
        "a .splat file",
        centres=rows["centre"],
        scales=rows["scale"],
        rotations=_rotations(rows),
        opacities=rgba[:, 3],
        harmonics=of_colours(rgba[:, :3]),
    )
