"""The basis is that of Kerbl et al. 2023, and turned coefficients show the same colours elsewhere."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.special import sph_harm_y

from formats.splats.harmonics import basis, turned


def directions(count: int = 50) -> np.ndarray:
    rows = np.random.default_rng(3).normal(size=(count, 3))
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


def test_the_basis_is_made_of_complex_harmonics():
    """√2 Im Y_l^|m| for m < 0 and √2 Re Y_l^m for m > 0, with the Condon-Shortley phase."""
    x, y, z = directions().T
    theta, phi = np.arccos(z), np.arctan2(y, x)
    columns = []
    for degree in range(4):
        for m in range(-degree, degree + 1):
            values = sph_harm_y(degree, abs(m), theta, phi)
            part = values.imag if m < 0 else values.real
            columns.append(part * (np.sqrt(2) if m else 1))
    np.testing.assert_allclose(basis(directions()), np.stack(columns, 1), atol=1e-14)


@pytest.mark.parametrize("count", [1, 4, 9, 16])
@pytest.mark.parametrize("mirror", [1, -1])
def test_turned_colours_are_seen_along_turned_directions(count, mirror):
    turn = Rotation.from_rotvec([0.3, -1.2, 2.0]).as_matrix() * [1, 1, mirror]
    harmonics = np.random.default_rng(0).normal(size=(4, count, 3)).astype(np.float32)
    seen = np.einsum("dk,nkc->ndc", basis(directions())[:, :count], harmonics)
    along = np.einsum("dk,nkc->ndc", basis(directions() @ turn.T)[:, :count], turned(harmonics, turn))
    np.testing.assert_allclose(along, seen, atol=1e-5)


def test_degree_one_turns_as_a_vector_does():
    """c_1 to c_3 are the parts of -y, z and -x of a vector."""
    turn = Rotation.from_rotvec([0.5, 0.1, -0.4]).as_matrix()
    vector = np.array([0.2, -0.7, 0.4])
    as_harmonics = [[0, -v[1], v[2], -v[0]] for v in (vector, turn @ vector)]
    before, after = (np.repeat(np.array([h], np.float32)[..., None], 3, 2) for h in as_harmonics)
    np.testing.assert_allclose(turned(before, turn), after, atol=1e-6)
