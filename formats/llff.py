"""LLFF's `poses_bounds.npy`: one row per photo, in the order of the file names.

A row holds 3 x 5 numbers, a camera-to-world matrix with the axes down, right and back beside a column of
height, width and focal length of the full-size photos, and then the nearest and the farthest depth of what is
seen.
"""

import io
import warnings
from pathlib import Path
from tokenize import TokenError

import numpy as np

from formats.cameras import checked_focal, checked_size
from formats.errors import BadIntrinsics, BadModel, BadPose
from formats.safe_input import read_input
from formats.views import FARTHEST, View, checked_pose

NAME = "poses_bounds.npy"
MAX_BYTES = 16 * 2**20
COLUMNS = 17
HEADER_ERRORS = (ValueError, TypeError, SyntaxError, EOFError, LookupError, MemoryError, TokenError)
"""What numpy raises on headers that are none; it parses them as Python's literals."""


def read_poses_bounds(path: Path) -> np.ndarray:
    """(N, 17) float64, the header held against the bytes before anything is allocated.

    Raises BadModel, LimitExceeded, MissingFile.
    """
    data = read_input(path, MAX_BYTES)
    file = io.BytesIO(data)
    try:
        version = np.lib.format.read_magic(file)
        read = (
            np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        )
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of headers that Python 2 wrote
            shape, fortran, kind = read(file, max_header_size=10_000)
    except HEADER_ERRORS as error:
        raise BadModel(f"{path}: not an array saved by numpy; export it again") from error
    if len(shape) != 2 or shape[1] != COLUMNS or kind.kind != "f":
        size = "x".join(map(str, shape)) or "one"
        raise BadModel(f"{path}: holds {size} numbers of type {kind}, expected rows of {COLUMNS} floats")
    left = len(data) - file.tell()
    if shape[0] * COLUMNS * kind.itemsize != left:
        raise BadModel(f"{path}: {left:,} bytes cannot hold {shape[0]:,} rows; copy or export it again")
    flat = np.frombuffer(data, kind, offset=file.tell()).astype(np.float64)
    return flat.reshape(shape, order="F" if fortran else "C")


def row_view(where: str, row: np.ndarray) -> View:
    """The camera of a row (17,) at the full photos' size, without a name; errors are led by `where`.

    Raises BadIntrinsics, BadPose.
    """
    matrix, (near, far) = row[:15].reshape(3, 5), row[15:]
    if not np.isfinite(row).all():
        raise BadPose(f"{where}: holds NaN or infinity; export the poses again")
    height, width, focal = matrix[:, 4]
    focal = checked_focal(float(focal), where)
    if not 0 < near < far < FARTHEST:
        raise BadIntrinsics(
            f"{where}: bounds of {near:g} and {far:g}, expected a near and a greater far depth; estimate the "
            "poses again"
        )
    width, height = checked_size(*(round(min(float(side), 1e9)) for side in (width, height)), where)
    down, right, back, eye = matrix[:, :4].T
    pose, repair = checked_pose(np.column_stack([right, -down, back, eye]), where)
    middle, depths = (width / 2, height / 2), {"near": float(near), "far": float(far)}
    return View("", pose, focal, focal, *middle, width, height, **depths, repair=repair)
