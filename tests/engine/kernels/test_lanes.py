"""Networks at several samples at once, and the loops that look ahead for them."""

import numpy as np
import pytest
import torch
from numba import njit

from fusedrf_cli.engine.kernels.lanes import LANES, network_lanes
from fusedrf_cli.engine.kinds.mlp.field import MLPField, MLPShape
from fusedrf_cli.engine.rendering.volume import render_rays

from ..conftest import BOX, points_in, unit
from .interpreted import interpreted

SHAPE = MLPShape(count=3, hidden=16, layers=3, skip=2, colour=8)


def network_of(kind, inputs: int, hidden: int, layers: int, skip: int, outputs: int):
    """Random layers as kernels/networks.py has them: (numbers, starts, layers of (weights, bias))."""
    rng = np.random.default_rng(0)
    shapes = [(inputs, hidden), *[(hidden, hidden)] * (layers - 1), (hidden, outputs)]
    arrays = [rng.normal(size=(n + 1, m)) / n**0.5 for n, m in shapes]
    arrays.append(rng.normal(size=(inputs, hidden)) / inputs**0.5 * (skip > 0))
    starts = np.cumsum([0, *(array.size for array in arrays)])
    return np.concatenate([array.ravel() for array in arrays]).astype(kind), starts[:-1], arrays


def plain(arrays: list[np.ndarray], skip: int, x: np.ndarray) -> np.ndarray:
    """The network in float64 for rows x."""
    h = x
    for i, layer in enumerate(arrays[:-1]):
        h = h @ layer[:-1] + layer[-1]
        h = h + x @ arrays[-1] if skip and i == skip else h
        h = np.maximum(h, 0) if i < len(arrays) - 2 else h
    return h


@pytest.mark.parametrize("kind", [np.float32, np.float64])
@pytest.mark.parametrize(
    ("inputs", "hidden", "layers", "skip", "outputs"), [(24, 16, 3, 2, 8), (8, 32, 1, 0, 24)]
)
def test_each_lane_is_the_network_of_its_sample(kind, inputs, hidden, layers, skip, outputs):
    params, starts, arrays = network_of(kind, inputs, hidden, layers, skip, outputs)
    x = np.random.default_rng(1).normal(size=(LANES, inputs))
    h, out = np.uint64(inputs * LANES), np.uint64((inputs + 2 * hidden) * LANES)

    @njit
    def run(params, starts, values):
        network_lanes(inputs, hidden, layers, skip, outputs, params, starts, values, np.uint64(0), h, out)

    def answers(x):
        values = np.zeros(int(out) + outputs * LANES, kind)
        values[: inputs * LANES] = x.T.ravel()
        run(params, starts, values)
        return values[int(out) :].reshape(outputs, LANES).T

    tolerance = 1e-5 if kind == np.float32 else 1e-13
    np.testing.assert_allclose(answers(x), plain(arrays, skip, x), atol=tolerance)
    others = np.random.default_rng(2).normal(size=x.shape)
    others[3] = x[3]
    np.testing.assert_array_equal(answers(others)[3], answers(x)[3])


@pytest.fixture(scope="module")
def field() -> MLPField:
    """Of random numbers, dense in places."""
    bare = MLPField(SHAPE, BOX, (8, 8, 8), 5.0, 0.0)
    generator = torch.Generator().manual_seed(0)
    return bare.with_params(0.4 * torch.randn(len(bare.params), generator=generator))


def asked(count: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Points in and around the box, and directions."""
    rng = np.random.default_rng(3)
    dirs = unit(rng.normal(size=(count, 3)))
    return torch.from_numpy(points_in(BOX, count, margin=0.1)), torch.from_numpy(dirs)


def test_a_point_does_not_depend_on_its_company(field):
    points, dirs = asked(100)
    sigma, rgb = field.query(points, dirs)
    assert 0 < (sigma > 0).sum() < 100
    for chosen in (slice(0, 1), slice(7, 50), torch.randperm(100)):
        some = field.query(points[chosen], dirs[chosen])
        assert torch.equal(some[0], sigma[chosen])
        assert torch.equal(some[1], rgb[chosen])


def test_points_are_answered_as_the_reference_says(field):
    points, dirs = asked(100)
    inside = field.query(points, dirs)[0] > 0
    points, dirs = points[inside], dirs[inside]
    expected = field.reference(field.params, points, dirs)
    torch.testing.assert_close(field.query(points, dirs), expected, rtol=1e-4, atol=1e-5, check_dtype=False)


def test_neighbours_nearer_than_single_precision_are_told_apart(field):
    """Two numbers of a lane's key hold what one would round away."""
    names = interpreted(field)
    scratch = np.zeros(names["SCRATCH"] + names["LANE_ROOM"], np.float32)
    p, near = (0.5, 0.25, 0.75), (0.5 + 1e-11, 0.25, 0.75)
    names["enter_lane"](field.arrays, field.grid, p, 0, scratch)
    scratch[names["SCRATCH"]] = 1
    assert names["lane_of"](field.arrays, p, scratch) == 0
    assert names["lane_of"](field.arrays, near, scratch) == -1


def test_rays_are_shown_as_without_lanes(field, monkeypatch):
    rng = np.random.default_rng(5)
    rays_o = np.tile([0.5, 0.4, 6.0], (64, 1))
    rays_d = unit(points_in(BOX, 64) - rays_o)
    shown = render_rays(field, rays_o, rays_d)
    assert shown[:, 3].max() > 0.5
    order = rng.permutation(64)
    np.testing.assert_array_equal(render_rays(field, rays_o[order], rays_d[order]), shown[order])
    alone = field.with_params(field.params)
    sizes = alone.device_module.sizes
    assert sizes(alone)["LANES"] == LANES
    monkeypatch.setattr(alone.device_module, "sizes", lambda of: sizes(of) | {"LANES": 0})
    np.testing.assert_allclose(render_rays(alone, rays_o, rays_d), shown, atol=1e-5)
