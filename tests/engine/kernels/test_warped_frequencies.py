"""Twists of warped points against matrix exponentials, from the smallest to whole turns."""

import numpy as np
import pytest
import torch
from scipy.linalg import expm

from fusedrf_cli.engine.encodings import warped_frequencies


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-4, 0.0999, 0.1001, 1.3, 6.0])
def test_a_twist_moves_a_point_as_its_exponential_does(angle):
    rng = np.random.default_rng(0)
    x, v, g, axis = rng.normal(size=(4, 3))
    w = angle * axis / np.linalg.norm(axis)
    matrix = np.zeros((4, 4))
    matrix[:3, :3] = [[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]]
    matrix[:3, 3] = v
    expected = (expm(matrix) @ [*x, 1])[:3]
    np.testing.assert_allclose(warped_frequencies.moved(tuple(x), tuple(w), tuple(v)), expected, atol=1e-12)
    leaves = [torch.from_numpy(value)[None].requires_grad_() for value in (w, v)]
    moved = warped_frequencies.moved_by(torch.from_numpy(x)[None], *leaves)
    np.testing.assert_allclose(moved[0].detach(), expected, atol=1e-12)
    moved.backward(torch.from_numpy(g)[None])
    sent = warped_frequencies.moved_backward(tuple(x), tuple(w), tuple(v), tuple(g))
    for found, leaf in zip(sent, leaves, strict=True):
        np.testing.assert_allclose(found, leaf.grad[0], rtol=1e-8, atol=1e-10)
