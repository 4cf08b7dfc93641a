"""Closed meshes tell what lies inside them, in any unit and anywhere."""

import numpy as np
import pytest

from formats.closed_meshes import Hull

CORNERS = np.stack(np.meshgrid([-1.0, 1.0], [-1.0, 1.0], [-1.0, 1.0], indexing="ij"), -1).reshape(-1, 3)
FACES = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]


@pytest.mark.parametrize(
    ("unit", "at"),
    [
        (1.0, (0, 0, 0)),
        (1e-9, (0, 0, 0)),
        (1e9, (1e10, 0, 0)),
        (1.0, (432100, 5411200, 310)),
        (1e3, (1e12, 0, 0)),
    ],
)
def test_a_cube_holds_what_lies_between_its_faces(tmp_path, unit, at):
    """Its faces do not share their corners, as exporters write them."""
    corners = unit * CORNERS[np.array(FACES).ravel()] + at
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in corners.tolist()]
    lines += [f"f {i} {i + 1} {i + 2} {i + 3}" for i in range(1, len(corners), 4)]
    (tmp_path / "cube.obj").write_text("\n".join(lines) + "\n")
    spots = np.random.default_rng(0).uniform(-1.5, 1.5, (500, 3))
    found = Hull(tmp_path / "cube.obj").contains(unit * spots + at)
    clear = np.abs(np.abs(spots).max(1) - 1) > 1e-3
    assert np.array_equal(found[clear], (np.abs(spots).max(1) < 1)[clear]) and 0 < found.sum() < 500
