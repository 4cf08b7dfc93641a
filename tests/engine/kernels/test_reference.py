"""The reference itself against first principles: hand-written loops, quadrature, autograd's own check."""

import numpy as np
import pytest
import torch

from fusedrf_cli.engine.kernels import reference
from tests.engine.conftest import DIRECTIONS_26, random_vm


def test_line_and_plane_between_texels():
    line = torch.tensor([[1.0], [3.0], [0.0]])
    found = reference.linear(line, torch.tensor([0.0, 0.25, 0.5, 0.75, 1.0]))
    assert found[:, 0].tolist() == [1.0, 2.0, 3.0, 1.5, 0.0]
    plane = torch.tensor([[[0.0], [1.0]], [[2.0], [7.0]]])
    assert reference.bilinear(plane, torch.tensor([0.5]), torch.tensor([0.5])).item() == 2.5
    assert reference.bilinear(plane, torch.tensor([1.0]), torch.tensor([0.25])).item() == 3.25


def test_plane_is_grid_sample():
    plane, at = torch.rand(5, 7, 4, dtype=torch.float64), torch.rand(50, 2, dtype=torch.float64)
    wanted = torch.nn.functional.grid_sample(
        plane.permute(2, 0, 1)[None], (2 * at.flip(1) - 1)[None, None], align_corners=True
    )[0, :, 0].T
    torch.testing.assert_close(reference.bilinear(plane, at[:, 0], at[:, 1]), wanted, rtol=1e-12, atol=1e-14)


def test_spherical_harmonics_are_orthonormal():
    """Gauss-Legendre in z times even steps in the angle integrates polynomials of degree 6 without error."""
    z, weights = np.polynomial.legendre.leggauss(8)
    angle = np.arange(16) * 2 * np.pi / 16
    z, angle = (a.ravel() for a in np.meshgrid(z, angle, indexing="ij"))
    r = np.sqrt(1 - z**2)
    dirs = torch.from_numpy(np.stack([r * np.cos(angle), r * np.sin(angle), z], 1))
    basis = reference.sh_basis(16, dirs)
    area = torch.from_numpy(np.repeat(weights, 16) * 2 * np.pi / 16)
    torch.testing.assert_close(
        basis.T @ (area[:, None] * basis), torch.eye(16, dtype=torch.float64), rtol=0, atol=1e-12
    )


def test_spherical_harmonics_of_the_opposite_direction():
    basis, opposite = (reference.sh_basis(16, torch.from_numpy(s * DIRECTIONS_26)) for s in (1, -1))
    degree = torch.tensor([0] + [1] * 3 + [2] * 5 + [3] * 7)
    torch.testing.assert_close(opposite, basis * (-1.0) ** degree, rtol=0, atol=1e-15)
    assert [reference.sh_basis(n, torch.rand(2, 3)).shape for n in (1, 4, 9)] == [(2, 1), (2, 4), (2, 9)]


def test_weights_of_two_samples():
    """Two samples of optical depth ln 2: half is seen of the first, a quarter of the second."""
    weights = reference.composite_weights(torch.tensor([[np.log(2) / 0.1] * 2]), 0.1)
    torch.testing.assert_close(weights, torch.tensor([[0.5, 0.25]], dtype=weights.dtype))


def test_compositing_is_the_product_of_transparencies():
    sigma = torch.rand(20, 30, dtype=torch.float64) * 10
    weights = reference.composite_weights(sigma, 0.1)
    for ray in range(3):
        trans = 1.0
        for k in range(30):
            alpha = 1 - np.exp(-0.1 * float(sigma[ray, k]))
            assert float(weights[ray, k]) == pytest.approx(trans * alpha, rel=1e-9)
            trans *= 1 - alpha
    torch.testing.assert_close(weights.sum(1), 1 - torch.exp(-0.1 * sigma.sum(1)), rtol=1e-12, atol=0)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_dtype_is_kept(dtype):
    field = random_vm(dtype=dtype)
    rays = torch.zeros(2, 3, dtype=torch.float64), torch.from_numpy(DIRECTIONS_26[:2])
    assert reference.render_rays(field, *rays, 0.0, 0.1).dtype == dtype
