"""Unbounded space: its map, its rays, and what a field in it shows, against closed forms."""

import numpy as np
import pytest
import torch

from fusedrf_cli.engine.fields.computed import Batch
from fusedrf_cli.engine.fields.differentiable import query
from fusedrf_cli.engine.fields.occupancy import OccupancyGrid
from fusedrf_cli.engine.kernels.specialise import specialised
from fusedrf_cli.engine.kinds import registry
from fusedrf_cli.engine.kinds.student import Way
from fusedrf_cli.engine.kinds.vm.field import VMField
from fusedrf_cli.engine.rendering.volume import march_rays, render_rays
from fusedrf_cli.engine.spaces import space_named, unbounded
from fusedrf_cli.engine.spaces.unbounded import FAR, PIECES, WHOLE

GRID = OccupancyGrid.full(WHOLE, space=unbounded)
SPACE = specialised(None, {}, unbounded)[1]


def rays(count: int):
    """Rays of all kinds: from near and far, along axes and diagonals, through edges and corners."""
    rng = np.random.default_rng(0)
    for i in range(count):
        o, d = rng.normal(size=3) * 10 ** rng.uniform(-1, 1.5), rng.normal(size=3)
        if i % 5 == 0:
            d[rng.integers(3)] = 0
        if i % 7 == 0:
            o, d = np.round(o), np.round(2 * d)
        if d.any():
            yield o, d / np.linalg.norm(d)


def pieces(o, d, near=0.0):
    """The pieces of a ray that hold anything, in order."""
    found = [SPACE["piece"](k, GRID.arrays, tuple(o), tuple(d), near) for k in range(PIECES)]
    return [piece for piece in found if piece[3] > piece[2]]


def mapped(x: np.ndarray) -> np.ndarray:
    """The map of a point as it is written in the paper."""
    size = np.abs(x)
    if size.max() <= 1:
        return x
    out = x / size.max()
    axis = int(size.argmax())
    out[axis] = (2 - 1 / size[axis]) * np.sign(x[axis])
    return out


def test_pieces_are_straight_and_follow_each_other_out_to_the_end():
    for o, d in rays(1500):
        end, found = 0.0, pieces(o, d)
        assert len(found) <= 5
        for q, way, u0, u1, course in found:
            start = SPACE["distance"](course, u0)
            assert start == pytest.approx(end, rel=1e-9, abs=1e-9)
            for share in (0.01, 0.3, 0.77, 0.99):
                u = u0 + share * (u1 - u0)
                x = o + SPACE["distance"](course, u) * d
                assert np.array(q) + u * np.array(way) == pytest.approx(mapped(x), abs=1e-9)
            end = SPACE["distance"](course, u1)
        if found:
            assert np.abs(o + end * d).max() == pytest.approx(FAR, rel=1e-6)


@pytest.mark.parametrize("share", [0.3, 1e-4])
def test_a_span_is_a_difference_of_distances(share):
    for o, d in rays(300):
        for _, _, u0, u1, course in pieces(o, d):
            u, e = (u0 + u1) / 2, share * (u1 - u0)
            moved = SPACE["distance"](course, u + e / 2) - SPACE["distance"](course, u - e / 2)
            assert SPACE["span"](course, u, e) == pytest.approx(moved, rel=1e-6, abs=1e-8)


@pytest.mark.parametrize("step", [0.31, 0.01])
def test_spans_of_the_samples_of_a_piece_make_up_all_of_it(step):
    for o, d in rays(300):
        for _, _, u0, u1, course in pieces(o, d):
            samples = np.arange(u0 + step / 2, u1, step)
            if len(samples):
                spans = [SPACE["span"](course, float(u), step) for u in samples]
                length = SPACE["distance"](course, u1) - SPACE["distance"](course, u0)
                assert sum(spans) == pytest.approx(length, rel=1e-9)


@pytest.mark.parametrize("radius", [0.5, 1.0, 10.0, 100.0, 900.0])
def test_the_map_has_an_inverse_in_every_form(radius):
    rng = np.random.default_rng(1)
    points = rng.normal(size=(200, 3))
    points *= radius / np.abs(points).max(1, keepdims=True)
    inside = np.array([mapped(x) for x in points])
    assert np.array([SPACE["point"](tuple(x)) for x in points]) == pytest.approx(inside)
    assert unbounded.contracted(torch.from_numpy(points)).numpy() == pytest.approx(inside)
    assert np.array([SPACE["frame_point"](tuple(y)) for y in inside]) == pytest.approx(points, rel=1e-9)
    assert unbounded.placed(torch.from_numpy(inside)).numpy() == pytest.approx(points, rel=1e-9)


def even(sigma: float, resolution: int = 64) -> VMField:
    """A field that is everywhere as dense, in float64, grey."""
    plan = registry.kind("vm").plan_at(WHOLE, (resolution,) * 3, Way(ranks=(8, 8), sh_degree=0))
    field = registry.kind("vm").create(plan, torch.Generator().manual_seed(0)).with_occupancy(GRID)
    tensor = field.tensors[0]
    object.__setattr__(tensor, "shift", float(np.log(np.expm1(sigma / tensor.scale))))
    return field.with_params(torch.zeros_like(field.params, dtype=torch.float64))


@pytest.mark.parametrize("end, off", [(10.0, 0.01), (100.0, 0.15), (1000.0, 0.15)])
def test_fog_is_as_thick_as_its_formula_says(end, off):
    """Fog of even density, and empty cells that end it at a distance: the opacity is 1 - exp(-σ r), and the
    depth that of the exponential, as far as the few steps far out tell it; densities are per length of the
    frame, also there."""
    sigma = 0.5 / end
    field = even(sigma)
    o, d = np.array([[0.1, 0.2, -0.3]]), np.array([[1.0, 0.3, -0.2]])
    d /= np.linalg.norm(d)
    shown = np.zeros((128,) * 3, bool)
    cells = GRID.aabb[0] + (np.arange(128) + 0.5) / 32
    last = 2 - 1 / end if end < FAR else 2.0
    shown[cells < last] = True
    grid = OccupancyGrid(WHOLE, shown, unbounded)
    edge = GRID.aabb[0] + (np.flatnonzero(cells < last)[-1] + 1) / 32  # of the cells, along x
    n = min(1 / (2 - edge) if edge < 2 else FAR, FAR)
    reach = (n - o[0, 0]) / d[0, 0]
    out = render_rays(field.with_occupancy(grid), o, d, step=1e-3, early_stop=0.0)[0]
    assert out[3] == pytest.approx(-np.expm1(-sigma * reach), abs=2e-3)
    wanted = (1 - np.exp(-sigma * reach) * (1 + sigma * reach)) / sigma
    assert out[4] == pytest.approx(wanted, rel=off)


def random_field(seed: int = 0) -> VMField:
    """A small random field over all of space, in float64, of which a third of the cells is empty."""
    generator = torch.Generator().manual_seed(seed)
    kind = registry.kind("vm")
    field = kind.create(kind.plan_at(WHOLE, (9, 9, 9), Way(ranks=(8, 8))), generator)
    occupied = np.random.default_rng(seed).random((8, 8, 8)) < 0.7
    numbers = torch.randn(len(field.params), generator=generator, dtype=torch.float64)
    return field.with_occupancy(OccupancyGrid(WHOLE, occupied, unbounded)).with_params(0.5 * numbers)


def test_waves_and_the_one_pass_show_the_same():
    field = random_field()
    o = np.array([o for o, _ in rays(200)])
    d = np.array([d for _, d in rays(200)])
    out = np.zeros((len(o), 5), np.float32)
    march_rays(field, o, d, 0.0, 0.02, 1e-3, out)
    whole = render_rays(field, o, d, step=0.02)
    assert whole[:, 3].max() > 0.5
    assert out[:, :4] == pytest.approx(whole[:, :4], abs=2e-3)
    assert out[:, 4] == pytest.approx(whole[:, 4], rel=2e-2, abs=1e-3)


def test_gradients_reach_numbers_far_out():
    """The gradient of a training step against differences, for rays that end in every slab."""
    field = random_field()
    rng = np.random.default_rng(3)
    d = rng.normal(size=(12, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    o, jitter = rng.normal(size=(12, 3)), rng.random(12)
    target, behind = rng.random((12, 4)), rng.random((12, 3))
    batch = Batch(o, d, jitter, target, behind, 0.1, 0.0, 0.05, 0.0)

    def loss(params: torch.Tensor) -> float:
        sums = np.zeros((1, 3))
        field.with_params(params).train_rays(batch, np.zeros((1, len(params))), sums)
        return float(sums[0, 0] + 0.1 * sums[0, 1]) / 12

    grads = np.zeros((1, len(field.params)))
    field.train_rays(batch, grads, np.zeros((1, 3)))
    moved = np.argsort(-abs(grads[0]))[:200:20]
    for at in moved:
        step = torch.zeros_like(field.params)
        step[at] = 1e-5
        slope = (loss(field.params + step) - loss(field.params - step)) / 2e-5
        # colours of weights below the loops' threshold are left out: a jump where one passes it
        assert grads[0, at] == pytest.approx(slope, rel=2e-2, abs=1e-6)


def test_gradients_in_points_cross_no_border_wrongly():
    """In each region, far from its borders: differences of the compiled answer against the reference's
    gradient."""
    field = random_field().with_occupancy(GRID)
    points = torch.tensor([[0.3, 0.2, -0.4], [7.0, 2.0, -3.0], [-2.0, 90.0, 30.0], [4.0, -5.0, -700.0]])
    points = points.double().requires_grad_()
    dirs = torch.nn.functional.normalize(torch.ones(4, 3, dtype=torch.float64), dim=1)
    sigma, rgb = query(field, points, dirs)
    (found,) = torch.autograd.grad((sigma.sum() + rgb.sum()), points)
    for i in range(4):
        for axis in range(3):
            step = torch.zeros(4, 3, dtype=torch.float64)
            step[i, axis] = 1e-5 * float(points[i].detach().abs().max())
            answers = [field.query(points.detach() + s, dirs) for s in (step, -step)]
            slope = sum(float(a.sum() - b.sum()) for a, b in zip(*answers, strict=True))
            assert found[i, axis] == pytest.approx(slope / (2 * float(step[i, axis])), rel=1e-4, abs=1e-9)


@pytest.mark.parametrize("kind", [name for name in registry.names() if registry.kind(name).trains])
def test_every_kind_keeps_its_space(kind):
    made = registry.kind(kind)
    field = made.create(made.untrained(WHOLE, 16, Way()), torch.Generator().manual_seed(0))
    field = field.with_occupancy(OccupancyGrid.full(WHOLE, 4, unbounded))
    back = type(field).from_state(*field.state())
    assert back.space is unbounded and back.occupancy.space is unbounded
    grown = made.grown(back, made.untrained(WHOLE, 20, Way()))
    assert grown.space is unbounded
    point, way = torch.tensor([[30.0, -4.0, 2.0]]).double(), torch.tensor([[0.0, 0.0, 1.0]]).double()
    assert float(back.query(point, way)[0]) > 0


def test_a_space_of_another_name_is_refused():
    with pytest.raises(ValueError, match="space should be one of bounded, unbounded, found 'round'"):
        space_named("round")
