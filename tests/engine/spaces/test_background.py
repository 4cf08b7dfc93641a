"""A background layer, which colours what rays see that nothing else stops: a field of which the outermost
cells of a contraction alone are occupied, so that its vertices are a cube map."""

import numpy as np
import pytest
import torch

from fusedrf_cli.engine.composition.affine import Placed
from fusedrf_cli.engine.composition.composite import Composite
from fusedrf_cli.engine.fields.occupancy import OccupancyGrid
from fusedrf_cli.engine.kernels.reference import sh_basis
from fusedrf_cli.engine.kinds import registry
from fusedrf_cli.engine.kinds.builder import StorageSetting
from fusedrf_cli.engine.rendering.volume import reach_of, render_rays
from fusedrf_cli.engine.spaces import contracted_linf
from tests.analytic.export import exported
from tests.analytic.fields import Gaussian, Tint
from tests.analytic.rays import unit

from .test_contractions import by_python

CELLS = 16  # so that the layer begins at a size of 4


def layer(dtype=torch.float64):
    """A `dense` field whose colour is one of spherical harmonics, with a gradient over its upper face."""
    kind, box = registry.kind("dense"), contracted_linf.WHOLE
    field = kind.create(kind.untrained(box, CELLS + 1, StorageSetting()), torch.Generator().manual_seed(0))
    occupied = np.ones((CELLS,) * 3, bool)
    occupied[1:-1, 1:-1, 1:-1] = False
    field = field.with_occupancy(OccupancyGrid(box, occupied, contracted_linf))
    field = field.with_params(torch.zeros_like(field.params, dtype=dtype))
    sections = field.sections()
    sections["density"].fill_(float(np.log(np.expm1(0.02 / field.scale)) - field.shift))
    bands = (
        field.shape.coefficients if hasattr(field.shape, "coefficients") else (field.shape.sh_degree + 1) ** 2
    )
    coefficients = torch.randn(3 * bands, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    sections["colour"][..., : 3 * bands] = coefficients.to(dtype)
    x = torch.linspace(-1, 1, CELLS + 1, dtype=torch.float64)
    sections["colour"][:, :, -1, 0] += 3 * x[:, None].to(dtype)
    return field, coefficients.view(3, bands)


def seen_alone(coefficients: torch.Tensor, dirs: np.ndarray) -> np.ndarray:
    """(N, 3) the colours of the layer in directions (N, 3), its upper face a cube map."""
    values = (coefficients[None] * sh_basis(coefficients.shape[1], torch.from_numpy(dirs))[:, None]).sum(2)
    up = dirs[:, 2] >= abs(dirs).max(1)
    across = np.where(up, dirs[:, 0] / abs(dirs).max(1), 0)
    values[:, 0] += torch.from_numpy(np.where(up, 3 * 0.28209479177387814 * across, 0))
    return values.sigmoid().numpy()


def some_dirs(count: int) -> np.ndarray:
    """Directions, none near an edge of the cube, where faces come together."""
    dirs = unit(np.random.default_rng(0).normal(size=(4 * count, 3)))
    sizes = np.sort(abs(dirs), axis=1)
    return dirs[sizes[:, 1] < 0.8 * sizes[:, 2]][:count]


def test_what_nothing_stops_sees_the_layer_in_its_direction():
    field, coefficients = layer()
    dirs, found = some_dirs(12), np.zeros((12, 5))
    by_python(field).render_rays(np.full((12, 3), 0.1), dirs, reach_of(12, 0.0, np.inf), 0.1, 0.0, found)
    assert found[:, 3] == pytest.approx(1, abs=1e-4)
    wanted = seen_alone(coefficients, dirs)
    sure = dirs[:, 2] < abs(dirs).max(1)
    assert found[sure, :3] == pytest.approx(wanted[sure], abs=1e-3)
    assert found[:, :3] == pytest.approx(wanted, abs=0.15)  # between the layer's lower face and its upper one


@pytest.mark.slow
@pytest.mark.parametrize("rule", ["max", "add"])
def test_the_layer_lies_behind_what_a_scene_shows(rule):
    """Far behind, where its node is large."""
    field, _ = layer(torch.float32)
    ball = exported(Gaussian(4.0, tint=Tint.of(0.1, 0.2, 0.9)), "vm", (25, 25, 25))
    far = np.diag([50.0, 50.0, 50.0, 1.0])
    scene = Composite([Placed("sky", field, far), Placed("ball", ball, np.eye(4))], rule)
    dirs = some_dirs(100)
    origins = -3 * dirs + 0.2 * np.random.default_rng(1).normal(size=dirs.shape)
    sky = render_rays(field, origins / 50, dirs, early_stop=0.0)
    shown = render_rays(ball, origins, dirs, early_stop=0.0)
    found = render_rays(scene, origins / 50, dirs, early_stop=0.0)
    assert 0.2 < shown[:, 3].max() < 0.999
    wanted = shown[:, :3] + (1 - shown[:, 3:4]) * sky[:, :3]
    assert found[:, :3] == pytest.approx(wanted, abs=4e-3)
    assert found[:, 3] == pytest.approx(1, abs=1e-3)
