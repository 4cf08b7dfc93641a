"""Spaces beside ours: their maps against other people's formulas, their rays, and what fields in them show
and learn. But for slow tests the loops are run by Python, so that nothing is compiled."""

from dataclasses import dataclass
from functools import cache
from types import FunctionType, ModuleType

import numpy as np
import pytest
import torch

from fusedrf_cli.engine.composition.affine import Placed
from fusedrf_cli.engine.composition.composed import ComposedField
from fusedrf_cli.engine.composition.composite import Composite
from fusedrf_cli.engine.decoders import density_sum, rgb, sh_mlp, trunk
from fusedrf_cli.engine.encodings import grid, hash_grid, trunk_features
from fusedrf_cli.engine.fields.assembled import AssembledField, Slot
from fusedrf_cli.engine.fields.base import sampling_step
from fusedrf_cli.engine.fields.computed import Batch
from fusedrf_cli.engine.fields.differentiable import query
from fusedrf_cli.engine.fields.occupancy import OccupancyConfig, OccupancyGrid
from fusedrf_cli.engine.kernels import specialise
from fusedrf_cli.engine.kernels.instances import Instances
from fusedrf_cli.engine.kernels.primitives import FARTHEST
from fusedrf_cli.engine.kinds.sparse.field import SparseField, SparseShape
from fusedrf_cli.engine.rendering.volume import march_rays, reach_of, render_rays
from fusedrf_cli.engine.spaces import (
    bounded,
    contracted_l2,
    contracted_linf,
    name_of,
    ndc,
    space_named,
    space_of,
    unbounded,
)
from tests.analytic.export import exported
from tests.analytic.fields import Gaussian, Tint
from tests.analytic.rays import affine, turn, unit

from ..kernels.interpreted import interpreted
from ..kinds.sparse_cases import random_sparse

DVGO = {"shell": 0.2, "contracted_density": 1.0}
CURVED = {
    "L2": contracted_l2,
    "Linf": contracted_linf,
    "DVGO L2": space_of(contracted_l2, **DVGO),
    "DVGO Linf": space_of(contracted_linf, **DVGO),
    "svox2": space_of(contracted_l2, contracted_density=2.0),
    "stretched": space_of(contracted_linf, stretch_x=0.6, stretch_y=2.0, **DVGO),
}
NEW = CURVED | {"NDC": ndc, "NDC of a camera": space_of(ndc, scale_x=2.1, scale_y=2.8)}
ALL = {"box": bounded, "unbounded": unbounded} | NEW
curved, new = (pytest.mark.parametrize("space", s.values(), ids=s) for s in (CURVED, NEW))
every = pytest.mark.parametrize("space", ALL.values(), ids=ALL)


@cache
def functions_of(space) -> dict:
    """A space's functions, run by Python."""
    names, functions = specialise.namespace(None, space)
    for name, value in {**names, **functions}.items():
        function = getattr(value, "py_func", functions.get(name))
        if function is not None:
            names[name] = FunctionType(function.__code__, names, name, function.__defaults__)
    return names


def points_of(space, count: int = 300, seed: int = 0) -> np.ndarray:
    """Points near and far; of a box and of NDC, those of their coordinates."""
    rng = np.random.default_rng(seed)
    if space is bounded or "ndc" in space.__name__:
        return space.inv_contract(torch.from_numpy(rng.uniform(-1.1, 0.95, (count, 3)))).numpy()
    return rng.normal(size=(count, 3)) * 10 ** rng.uniform(-1, 2, (count, 1))


# -- maps ----------------------------------------------------------------------------------------------------


def scene_contraction(x: np.ndarray, order: float) -> np.ndarray:
    """nerfstudio's SceneContraction of a point."""
    mag = np.linalg.norm(x, ord=order)
    return x if mag < 1 else (2 - (1 / mag)) * (x / mag)


def dvgo_contraction(x: np.ndarray, order: float, bg_len: float) -> np.ndarray:
    """DirectContractedVoxGO's, of a normalised point."""
    norm = np.linalg.norm(x, ord=order)
    return x if norm <= 1 else x / norm * ((1 + bg_len) - bg_len / norm)


def ndc_of(x: np.ndarray, height: int, width: int, focal: float) -> np.ndarray:
    """NeRF's, by its projection matrix (appendix C, eq. 8 to 11), the near plane at 1 and the far one at
    infinity."""
    matrix = np.array(
        [[focal / (width / 2), 0, 0, 0], [0, focal / (height / 2), 0, 0], [0, 0, -1, -2.0], [0, 0, -1, 0]]
    )
    clip = matrix @ [*x, 1]
    return clip[:3] / clip[3]


FORMULAS = {
    "L2": lambda x: scene_contraction(x, 2),
    "Linf": lambda x: scene_contraction(x, np.inf),
    "DVGO L2": lambda x: dvgo_contraction(x, 2, 0.2),
    "DVGO Linf": lambda x: dvgo_contraction(x, np.inf, 0.2),
    "svox2": lambda x: scene_contraction(x, 2),
    "stretched": lambda x: dvgo_contraction(x * [0.6, 2.0, 1.0], np.inf, 0.2),
    "NDC": lambda x: ndc_of(x, 2, 2, 1.0),
    "NDC of a camera": lambda x: ndc_of(x, 300, 400, 420.0),
}


@pytest.mark.parametrize("name", NEW)
def test_the_map_is_that_of_others_and_has_an_inverse_in_every_form(name):
    space, points = NEW[name], points_of(NEW[name])
    expected = np.array([FORMULAS[name](x) for x in points])
    names = functions_of(space)
    assert np.array([names["point"](tuple(x)) for x in points]) == pytest.approx(expected, abs=1e-12)
    assert space.contract(torch.from_numpy(points)).numpy() == pytest.approx(expected, abs=1e-12)
    assert np.array([names["frame_point"](tuple(q)) for q in expected]) == pytest.approx(points, rel=1e-9)
    assert space.inv_contract(torch.from_numpy(expected)).numpy() == pytest.approx(points, rel=1e-9)


def test_rays_of_ndc_are_those_of_nerf():
    """ndc_rays of nerf-pytorch, transcribed: where the point at t' of its ray, from 0 to 1 of the way to
    infinity, lies in our coordinates."""
    height, width, focal, near = 300, 400, 420.0, 1.0
    space, rng = NEW["NDC of a camera"], np.random.default_rng(0)
    for _ in range(50):
        o, d = 0.3 * rng.normal(size=3), np.array([*(0.3 * rng.normal(size=2)), -1.0])
        t = -(near + o[2]) / d[2]
        o = o + t * d
        o0 = -1 / (width / (2 * focal)) * o[0] / o[2]
        o1 = -1 / (height / (2 * focal)) * o[1] / o[2]
        o2 = 1 + 2 * near / o[2]
        d0 = -1 / (width / (2 * focal)) * (d[0] / d[2] - o[0] / o[2])
        d1 = -1 / (height / (2 * focal)) * (d[1] / d[2] - o[1] / o[2])
        d2 = -2 * near / o[2]
        for share in (0.0, 0.3, 0.9):  # t' = 1 - o_z / (o_z + t d_z), eq. 22
            along = o[2] * share / (d[2] * (1 - share))
            found = space.contract(torch.from_numpy(o + along * d)[None])[0].numpy()
            assert found == pytest.approx(np.array([o0, o1, o2]) + share * np.array([d0, d1, d2]), abs=1e-9)


@new
def test_densities_are_per_length_of_the_frame_or_of_the_coordinates(space):
    """Mip-NeRF 360's and nerfacto's are per length of the frame, whatever the contraction; DVGO's and those
    in NDC per length of the coordinates along the ray: the Jacobian by differences; those of svox2's spheres
    per unit of 1/|x|, on the way out."""
    points, rng = points_of(space), np.random.default_rng(1)
    dirs = unit(rng.normal(size=points.shape))
    at = space.contract(torch.from_numpy(points))
    expected = np.ones(len(points))
    if "ndc" in space.__name__ or getattr(space, "CONTRACTED_DENSITY", 0):
        move = 1e-6 * np.linalg.norm(points, axis=1, keepdims=True) * dirs
        ahead, behind = (space.contract(torch.from_numpy(points + s * move)) for s in (1, -1))
        expected = (ahead - behind).norm(dim=1).numpy() / np.linalg.norm(2 * move, axis=1)
    if space is NEW["svox2"]:
        ahead, behind = (1 / np.linalg.norm(points + s * move, axis=1) for s in (1, -1))
        outside = np.linalg.norm(points, axis=1) > 1
        expected = outside * np.maximum(behind - ahead, 0) / np.linalg.norm(2 * move, axis=1)
    found = [
        functions_of(space)["rate"](tuple(q), tuple(d))
        for q, d in zip(at.tolist(), dirs.tolist(), strict=True)
    ]
    assert np.array(found) == pytest.approx(expected, rel=1e-5)
    assert space.density_rates(at, torch.from_numpy(dirs)).numpy() == pytest.approx(expected, rel=1e-5)


@new
def test_maps_are_differentiable(space):
    points = torch.from_numpy(points_of(space, 20)).requires_grad_()
    dirs = torch.from_numpy(unit(np.random.default_rng(1).normal(size=(20, 3)))).requires_grad_()
    assert torch.autograd.gradcheck(space.contract, points, eps=1e-7, atol=1e-5)

    def rates(x, d):
        return space.density_rates(space.contract(x), d) * (d.sum() + x.sum())

    assert torch.autograd.gradcheck(rates, (points, dirs), eps=1e-7, atol=1e-3, rtol=1e-4)


# -- rays ----------------------------------------------------------------------------------------------------


def rays_of(space, count: int):
    """Origins near and far, directions of any length, along axes and past and through the origin; in NDC
    from beside the camera, forwards."""
    rng = np.random.default_rng(0)
    for i in range(count):
        o, d = rng.normal(size=3) * 10 ** rng.uniform(-1, 1.5), rng.normal(size=3)
        if "ndc" in space.__name__:
            yield 0.03 * o, 0.4 * d - [0, 0, 1]
            continue
        if i % 4 == 0:
            d[rng.integers(3)] = 0
        if i % 7 == 0:
            o, d = np.round(o), np.round(2 * d)
        if i % 9 == 0:
            d = -o
        if d.any():
            yield o, d


def pieces_of(space, o, d, grid=None, near=0.0, far=FARTHEST):
    """The pieces of a ray that hold anything, in order."""
    grid = grid or OccupancyGrid.full(space.WHOLE, 1, space)
    found = [
        functions_of(space)["piece"](k, grid.arrays, tuple(o), tuple(d), near, far)
        for k in range(space.PIECES)
    ]
    return [piece for piece in found if piece[3] > piece[2]]


@curved
def test_pieces_follow_each_other_and_are_no_longer_in_the_coordinates_than_in_u(space):
    names, in_u, in_coordinates = functions_of(space), 0.0, 0.0
    for o, d in rays_of(space, 60):
        end, total = 0.0, 0.0
        for origin, way, u0, u1, course in pieces_of(space, o, d):
            assert u0 == 0.0
            assert names["distance"](course, u0) == pytest.approx(end, rel=1e-9, abs=1e-9) or not end
            u = np.linspace(u0, u1, 100)
            t = np.array([names["distance"](course, x) for x in u])
            q = np.array([names["position_at"](origin, way, x) for x in u])
            assert q == pytest.approx(space.contract(torch.from_numpy(o + t[:, None] * d)).numpy(), abs=1e-9)
            lengths = np.linalg.norm(np.diff(q, axis=0), axis=1)
            assert (lengths <= (u[1] - u[0]) * (1 + 1e-6) + 1e-12).all()
            for k in (1, 37, 98):
                assert names["length_at"](course, t[k]) == pytest.approx(u[k], rel=1e-6, abs=1e-9)
            end, total = t[-1], total + u1
            in_u, in_coordinates = in_u + u1, in_coordinates + lengths.sum()
        assert total <= space.most_samples(space.WHOLE, 1e-3) * 1e-3
        if end:
            assert float(space.contract(torch.from_numpy(o + end * d)[None]).norm()) > 1 + 0.99 * space.SHELL
    assert in_u < 1.15 * in_coordinates


@new
@pytest.mark.parametrize("step", [0.3, 0.02])
def test_spans_of_the_samples_of_a_piece_make_up_all_of_it(space, step):
    names = functions_of(space)
    for o, d in rays_of(space, 60):
        for _, _, u0, u1, course in pieces_of(space, o, d):
            samples = np.arange(u0 + step / 2, u1, step)
            if len(samples) and "ndc" not in space.__name__:
                length = names["distance"](course, u1) - names["distance"](course, u0)
                assert sum(names["span"](course, float(u), step) for u in samples) == pytest.approx(
                    length, rel=1e-9
                )
            for u in samples[:3]:
                low, high = names["interval"](course, float(u), step)
                assert high - low == pytest.approx(names["span"](course, float(u), step), rel=1e-6, abs=1e-12)


def random_grid(space, seed: int = 0, share: float = 0.1) -> OccupancyGrid:
    """A grid over most of a space of which few cells are occupied."""
    box = 0.9 * space.WHOLE
    return OccupancyGrid(box, np.random.default_rng(seed).random((9, 10, 11)) < share, space)


def marched(names, grid, o, d, step, jitter=0.5, near=0.0) -> tuple[np.ndarray, np.ndarray]:
    """Distances and spans of all samples of a ray."""
    ts, spans, counts, start = *np.zeros((2, 1, 4000)), np.zeros(1, np.int64), np.zeros(1, np.int64)
    reach = np.array([[near, FARTHEST]])
    names["march_ray"](grid, o[None], d[None], reach, np.array([jitter]), step, 0, start, ts, spans, counts)
    assert start[0] == -1
    return ts[0, : counts[0]], spans[0, : counts[0]]


@new
def test_what_is_skipped_is_empty(space):
    """All samples of the lattice in occupied cells are taken, and no others."""
    names, grid, step, taken = functions_of(space), random_grid(space), 0.013, 0
    full = OccupancyGrid.full(space.WHOLE, 1, space)
    for o, d in rays_of(space, 40):
        d = d / np.linalg.norm(d)
        ts, _ = marched(names, grid.arrays, o, d, step)
        if space in NEW.values() and "ndc" in space.__name__:  # whose lattice begins at the box
            full = OccupancyGrid.full(grid.aabb, 1, space)
        every, _ = marched(names, full.arrays, o, d, step)
        at = space.contract(torch.from_numpy(o + every[:, None] * d)).numpy()
        assert ts == pytest.approx(every[grid.contains(at)], rel=1e-12)
        taken += len(ts)
    assert taken > 100


@new
def test_no_sample_lies_before_the_next_change_or_behind_the_last(space):
    """`next_change` against the samples in occupied cells: it may be early by half a step, never late."""
    names, grid, step, found = functions_of(space), random_grid(space, share=0.06), 0.02, 0
    zeros = np.zeros((1, 4))
    instances = Instances(
        np.eye(4)[None, :3], grid.aabb[None, :3], grid.aabb[None, 3:], grid.cell[None],
        np.array([grid.occupied.shape]), np.zeros(1, np.int64), grid.skip.ravel(), np.array([step]), zeros,
        np.zeros(1, np.int64), np.ones((1, 4)), np.zeros(2, np.int64), np.empty((0, 13)),
    )  # fmt: skip
    for o, d in rays_of(space, 40):
        d = d / np.linalg.norm(d)
        ts, spans = marched(names, grid.arrays, o, d, step / 4)
        begin = names["next_change"](instances, 0, tuple(o), tuple(d), 0.0, FARTHEST, -1.0)
        if not len(ts):
            continue
        assert begin <= ts[0]
        slower = names["next_change"](instances, 0, tuple(o), tuple(2 * d), 0.0, FARTHEST, -1.0)
        assert slower == pytest.approx(begin / 2, rel=1e-6, abs=1e-9)
        end = names["next_change"](instances, 0, tuple(o), tuple(d), ts[0], FARTHEST, 0.1)
        apart = np.flatnonzero(np.diff(ts) > 0.1)
        last = ts[apart[0]] if len(apart) else ts[-1]
        assert end >= ts[0] and end >= last - spans[min(len(spans) - 1, np.searchsorted(ts, last))]
        found += 1
    assert found >= 5


# -- fields --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Shape:
    """Nothing to choose."""


class HashGrid(AssembledField):
    """A hash grid, a trunk and a network for colour, as Instant-NGP's and nerfacto's fields are."""

    kind, shape_type = "hashed", Shape

    @classmethod
    def slots_of(cls, shape):
        levels = {"features": 2, "levels": hash_grid.levels_of(4, 6, 3, 1.7)}
        return {
            "density": Slot(hash_grid, levels, "density_"),
            "colour": Slot(trunk_features, {"outputs": 8}, "colour_"),
            "sigma": Slot(trunk, {"width": 8, "hidden": 8, "outputs": 8, "activation": "exp"}, "sigma_"),
            "rgb": Slot(sh_mlp, {"width": 8, "hidden": 8}, "rgb_"),
        }


class Even(AssembledField):
    """Of one density and colour."""

    kind, shape_type = "even", Shape

    @classmethod
    def slots_of(cls, shape):
        return {
            "density": Slot(grid, {"numbers": 1}, "density_"),
            "colour": Slot(grid, {"numbers": 3}, "colour_"),
            "sigma": Slot(density_sum, {"activation": "relu"}),
            "rgb": Slot(rgb, {"width": 8}),
        }


class Interpreted:
    """Loops of a field, run by Python; every sample has a colour of its own."""

    def __init__(self, field):
        self.names = interpreted(field)
        self.names.update(COLOUR_FROM=0.0, SHARED_COLOUR_FROM=0.0, LEARN_FROM=0.0, REST_FROM=0.0)

    def each(self, item, field, grid, asked, count, out, per_task=100):
        self.names["item"] = self.names[item]
        self.names["each"](field, grid, asked, count, per_task, 1, out)

    def sweep(self, item, field, grid, batch, count, most, out):
        self.names["item"] = self.names[item]
        self.names["sweep"](field, grid, batch, count, most, *out)


def hashed_in(space, dtype=torch.float64, share: float = 0.6) -> HashGrid:
    """A random field over most of a space, of which some cells are empty. Where σ is per length of the frame
    it is thin, since rays go far."""
    box = 0.85 * getattr(space, "WHOLE", np.array([-1.0] * 3 + [1.0] * 3))
    per_length = space in (contracted_l2, contracted_linf)
    bare = HashGrid(Shape(), box, (12, 12, 12), 0.1 if per_length else 1.0, -1.0)
    generator = torch.Generator().manual_seed(0)
    field = bare.with_params(
        (0.5 * torch.randn(len(bare.params), generator=generator, dtype=torch.float64)).to(dtype)
    )
    occupied = np.random.default_rng(0).random((6, 6, 6)) < share
    return field.with_occupancy(OccupancyGrid(box, occupied, space))


def by_python(field):
    """The field with loops that Python runs."""
    field.__dict__["loops"] = Interpreted(field)
    return field


def some_rays(space, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Rays through the middle of a space, from inside its core and from outside."""
    rng = np.random.default_rng(5)
    if "ndc" in space.__name__:
        return 0.1 * rng.normal(size=(count, 3)), unit(
            np.array([0, 0, -1.0]) + 0.3 * rng.normal(size=(count, 3))
        )
    o = rng.normal(size=(count, 3)) * np.linspace(0.3, 2, count)[:, None]
    return o, unit(0.4 * rng.normal(size=(count, 3)) - o)


@every
def test_a_hash_grid_answers_in_the_space_as_its_reference(space):
    field = by_python(hashed_in(space))
    points = torch.from_numpy(points_of(space, 60))
    dirs = torch.from_numpy(unit(np.random.default_rng(1).normal(size=(60, 3))))
    sigma, colour = field.query(points, dirs)
    expected, wanted = field.answers(field.params, points, dirs)
    assert (sigma > 0).sum() >= 5
    torch.testing.assert_close(sigma, expected, rtol=1e-9, atol=1e-12)
    torch.testing.assert_close(colour, wanted, rtol=1e-9, atol=1e-9)
    sent = torch.randn(60, dtype=torch.float64), torch.randn(60, 3, dtype=torch.float64)
    rows, params = np.zeros((1, len(field.params))), field.params.clone().requires_grad_()
    field.query_backward(points, dirs, *sent, rows)
    torch.autograd.backward(field.answers(params, points, dirs), sent)
    np.testing.assert_allclose(rows[0], params.grad, rtol=1e-7, atol=1e-9)


def lengths_of(field, o, d, ts, step) -> np.ndarray:
    """How much of a ray, by the unit that the field's numbers are of, its samples (K,) at distances ts stand
    for, by the space's `optical_length`."""
    names, found = interpreted(field), np.zeros(len(ts))
    for _, _, u0, u1, course in pieces_of(field.space, o, d, field.occupancy):
        for i in np.flatnonzero(
            (ts >= names["distance"](course, u0)) & (ts <= names["distance"](course, u1))
        ):
            q = field.space.contract(torch.from_numpy(o + ts[i] * d)[None])[0].tolist()
            u = names["length_at"](course, ts[i])
            found[i] = names["optical_length"](course, tuple(q), tuple(d), u, 1, 1, step)
    return found


def pictured(field, params, o, d, jitter, step) -> torch.Tensor:
    """(N, 4) premultiplied colour and opacity of rays by the rule of volume rendering as it is written, at
    the samples of the march."""
    names, rows = functions_of(field.space), []
    for i in range(len(o)):
        ts, _ = marched(names, field.grid, o[i], d[i], step, jitter[i])
        dirs = torch.from_numpy(np.tile(d[i], (len(ts), 1)))
        at = field.space.contract(torch.from_numpy(o[i] + ts[:, None] * d[i]))
        sigma, colour = field.reference(params, at, dirs)
        depth = sigma * torch.from_numpy(lengths_of(field, o[i], d[i], ts, step))
        weights = torch.exp(depth - depth.cumsum(0)) * -torch.expm1(-depth)
        rows.append(torch.cat([(weights[:, None] * colour).sum(0), weights.sum(0, keepdim=True)]))
    return torch.stack(rows)


@every
def test_a_hash_grid_is_rendered_and_learns_in_the_space_as_torch_says(space):
    field, (o, d), step = by_python(hashed_in(space)), some_rays(space, 5), 0.11
    found = np.zeros((5, 5))
    field.render_rays(o, d, reach_of(5, 0.0, np.inf), step, 0.0, found)
    with torch.no_grad():
        wanted = pictured(field, field.params, o, d, np.full(5, 0.5), step)
    assert 0.1 < wanted[:, 3].max()
    assert found[:, :4] == pytest.approx(wanted.numpy(), abs=1e-9)

    rng, params = np.random.default_rng(3), field.params.clone().requires_grad_()
    jitter, target, behind = rng.random(5), rng.random((5, 4)), rng.random((5, 3))
    batch = Batch(o, d, jitter, target, behind, 0.1, 0.0, step, 0.0)
    grads, sums = np.zeros((1, len(params))), np.zeros((1, 3))
    field.train_rays(batch, grads, sums)
    shown = pictured(field, params, o, d, jitter, step)
    colour = shown[:, :3] + (1 - shown[:, 3:]) * torch.from_numpy(behind)
    off = torch.from_numpy(target) - torch.cat([colour, shown[:, 3:]], 1)
    loss = (off[:, :3] ** 2).mean() + 0.1 * (off[:, 3] ** 2).mean()
    loss.backward()
    assert (sums[0, 0] + 0.1 * sums[0, 1]) / 5 == pytest.approx(float(loss.detach()), rel=1e-9)
    np.testing.assert_allclose(grads[0], params.grad, rtol=1e-6, atol=1e-9)


@new
def test_fog_is_as_thick_as_its_formula_says(space):
    """The optical depth of one density along curved rays, up to a size of the coordinates, by quadrature: of
    the length of the ray in the frame, or in the coordinates."""
    sigma, box = 0.25, 0.55 * space.WHOLE
    field = Even(Shape(), box, (2, 2, 2), 1.0, 0.0, occupancy=OccupancyGrid.full(box, 1, space))
    field = field.with_params(torch.zeros_like(field.params, dtype=torch.float64))
    field.slot_sections()["density"][""].fill_(sigma)
    field, (o, d) = by_python(field), some_rays(space, 6)
    found = np.zeros((6, 5))
    field.render_rays(o, d, reach_of(6, 0.0, np.inf), 0.01, 0.0, found)
    for i in range(6):
        t = np.concatenate([np.linspace(0, 3, 60_001), np.geomspace(3, 900, 60_000)[1:]])
        q = space.contract(torch.from_numpy(o[i] + t[:, None] * d[i])).numpy()
        middle = 0.5 * (q[1:] + q[:-1])
        inside = ((middle >= box[:3]) & (middle < box[3:])).all(1)
        lengths = np.diff(t)
        if "ndc" in space.__name__ or getattr(space, "CONTRACTED_DENSITY", 0):
            lengths = np.linalg.norm(np.diff(q, axis=0), axis=1)
        if space is NEW["svox2"]:
            lengths = np.maximum(np.diff(np.maximum(np.linalg.norm(q, axis=1), 1)), 0)
        assert -np.log(1 - found[i, 3]) == pytest.approx(sigma * lengths[inside].sum(), rel=0.02, abs=2e-3)


# -- files ---------------------------------------------------------------------------------------------------


@every
def test_a_stored_field_keeps_its_space(space):
    field = hashed_in(space, torch.float32)
    assert space_named(name_of(space)) is space
    back = HashGrid.from_state(*field.state())
    assert back.space is space
    for name, numbers in field.sections().items():
        assert torch.equal(back.sections()[name], numbers)


@pytest.mark.parametrize(
    "entry",
    [
        {"name": "ndc", "scale_x": 0},
        {"name": "ndc", "scale_x": "2"},
        {"name": "contracted_l2", "shell": 2.0},
        {"name": "unbounded", "shell": 0.2},
        {"shell": 0.2},
        ["ndc"],
        {"name": ["ndc"]},
        {"name": "ndc", "scale_x": float("nan")},
    ],
)
def test_what_is_no_space_is_refused(entry):
    with pytest.raises(ValueError, match="space"):
        space_named(entry)


def test_kinds_that_follow_straight_lines_are_refused_in_curved_spaces():
    device_module = ModuleType("straight")
    exec(
        "def next_index(field, grid, place, many, steps, k, p, way, u, u0, step):\n    return k + 1",
        vars(device_module),
    )
    with pytest.raises(ValueError, match="straight follows straight rays"):
        specialise.specialised(device_module, {}, contracted_l2)
    tree = random_sparse().fine
    with pytest.raises(ValueError, match="bricks cannot lie in space 'contracted_linf'"):
        SparseField(SparseShape(0), tree, 1.0, space=contracted_linf)


# -- compiled ------------------------------------------------------------------------------------------------


@pytest.mark.slow
@every
def test_compiled_loops_answer_render_and_learn_as_interpreted_ones(space):
    field, (o, d) = hashed_in(space), some_rays(space, 5)
    points = torch.from_numpy(points_of(space, 200))
    dirs = torch.nn.functional.normalize(torch.ones(200, 3, dtype=torch.float64), dim=1)
    sigma, rgb = query(field, points, dirs)
    expected = field.answers(field.params, points, dirs)
    torch.testing.assert_close((sigma, rgb), expected, rtol=1e-7, atol=1e-9)
    rng = np.random.default_rng(3)
    batch = Batch(o, d, rng.random(5), rng.random((5, 4)), rng.random((5, 3)), 0.1, 0.0, 0.11, 0.0)
    results = []
    for one in (field, by_python(hashed_in(space))):
        picture, grads = np.zeros((5, 5)), np.zeros((1, len(field.params)))
        one.render_rays(o, d, reach_of(5, 0.0, np.inf), 0.11, 0.0, picture)
        one.train_rays(batch, grads, np.zeros((1, 3)))
        results.append((picture, grads))
    assert results[0][0][:, 3] == pytest.approx(results[1][0][:, 3], abs=1e-6)
    assert results[0][0][:, :3] == pytest.approx(results[1][0][:, :3], abs=2e-2)
    assert np.corrcoef(results[0][1], results[1][1])[0, 1] > 0.99


MIXED = {"L2": contracted_l2, "unbounded": unbounded, "NDC": ndc}
SCENES = {**{name: {name: space} for name, space in ALL.items()}, "mixed": MIXED}


@pytest.mark.slow
@pytest.mark.parametrize("spaces", SCENES.values(), ids=SCENES)
@pytest.mark.parametrize("rule", ["max", "add"])
def test_hash_grids_and_a_ball_show_what_the_naive_composition_shows(spaces, rule, in_force):
    """Fields in a space, or in several, and a `vm` field in a box, turned and stretched: by the composite and
    naively, at steps that are fine for cells with hard edges far out, where a step is many units long."""
    in_force(OccupancyConfig(scene_cells=24))
    forwards = "NDC" in next(iter(spaces))
    frame = np.eye(4) if forwards else affine(turn(20))
    ball = exported(Gaussian(20.0, tint=Tint.of(0.1, 0.2, 0.9)), "vm", (25, 25, 25))
    spot = (0.2, 0.1, -2.0) if forwards else (0.3, 0.1, 0.2)
    placed = [Placed(name, hashed_in(space, torch.float32), frame) for name, space in spaces.items()]
    placed.append(Placed("ball", ball, affine(0.5 * turn(40), spot)))
    composite, naive = Composite(placed, rule), ComposedField(placed, rule)
    naive.__dict__["occupancy"] = naive.occupancy.marked(np.ones_like(naive.occupancy.occupied))
    rays_o, rays_d = some_rays(next(iter(spaces.values())), 300)
    if naive.origin.shape == (3,):
        rays_o = rays_o - naive.origin
    else:
        inverse = np.linalg.inv(naive.origin)
        rays_o, rays_d = rays_o @ inverse[:3, :3].T + inverse[:3, 3], rays_d @ inverse[:3, :3].T
    wanted = np.zeros((300, 5), np.float32)
    march_rays(naive, rays_o, rays_d, reach_of(300, 0.0, np.inf), 0.002, 1e-4, wanted)
    found = render_rays(composite, rays_o, rays_d, step=sampling_step(composite) / 64, early_stop=1e-4)
    off = np.square(found - wanted)[:, :4].mean()
    assert wanted[:, 3].std() > 0.1
    assert -10 * np.log10(off) > (40 if len(spaces) > 1 else 50)  # unbounded scenes in one another: 029
