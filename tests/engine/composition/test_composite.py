"""The composite against the naive composition, which asks every field at every sample, and against slow loops
of its own: any kinds, rules and spaces mixed."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch

from fusedrf_cli.engine.composition.affine import Placed
from fusedrf_cli.engine.composition.composed import ComposedField
from fusedrf_cli.engine.composition.composite import Composite, can_be_composite
from fusedrf_cli.engine.fields.base import sampling_step
from fusedrf_cli.engine.fields.occupancy import OccupancyConfig, OccupancyGrid
from fusedrf_cli.engine.kernels.instances import MAX_TRACED
from fusedrf_cli.engine.rendering.volume import march_rays, reach_of, render_rays
from fusedrf_cli.engine.spaces import unbounded
from tests.analytic.export import exported
from tests.analytic.fields import Box, Gaussian, Tint
from tests.analytic.rays import affine, moved_rays, points_in, rays_at, turn, unit
from tests.engine.conftest import BOX

TINTS = {"red": Tint.of(0.9, 0.15, 0.1), "blue": Tint.of(0.1, 0.2, 0.9)}
TURNED, MIRRORED = turn(40) @ np.diag([0.8, 1.3, 1.0]), turn(-25) @ np.diag([-1.0, 0.7, 0.9])
SMALL = 0.4 * turn(70, (0, 1, 1))


@pytest.fixture(autouse=True)
def coarse_occupancy(in_force):
    """A grid of the naive composition that is made in no time."""
    in_force(OccupancyConfig(scene_cells=24))


@cache
def blob(kind: str, tint: str = "red", density: float = 0.0):
    """A soft ball as a field of a kind, of which cells are occupied where it shows."""
    density = density or (30.0 if tint == "red" else 20.0)
    made = exported(Gaussian(density, tint=TINTS[tint]), kind, (25, 25, 25))
    return with_cells(made)


def with_cells(field, cells: int = 12):
    """The field under a grid that leaves out what is hardly there."""
    grid = OccupancyGrid.full(field.occupancy.aabb, cells)
    sigma, _ = field.query(torch.from_numpy(grid.centres()), torch.zeros(cells**3, 3).double() + 0.6)
    return field.with_occupancy(grid.marked((sigma > 1e-2).numpy().reshape(grid.occupied.shape)).dilated())


@cache
def surroundings(seed: int = 0):
    """A random field over all of space, of which a third of the cells is empty."""
    from tests.engine.spaces.test_unbounded import random_field

    field = random_field(seed)
    return field.with_params(field.params.float())


PAIRS = {
    "vm and vm": lambda: (blob("vm"), blob("vm", "blue")),
    "vm and sparse": lambda: (blob("vm"), blob("sparse", "blue")),
    "sparse and sparse": lambda: (blob("sparse"), blob("sparse", "blue")),
    "unbounded and vm": lambda: (surroundings(), blob("vm", "blue")),
    "unbounded and sparse": lambda: (surroundings(), blob("sparse", "blue")),
    "unbounded and unbounded": lambda: (surroundings(), surroundings(1)),
    "assembled and sparse": lambda: (blob("vm-mlp"), blob("sparse", "blue")),
}
TRIED = [pytest.param(pair, marks=pytest.mark.slow if "assembled" in pair else ()) for pair in PAIRS]
SPOTS = {
    "apart": (affine(TURNED), affine(MIRRORED, (2.0, 0.3, -0.4))),
    "in one another": (affine(TURNED), affine(SMALL, (0.35, 0.0, 0.1))),
    "the same place": (affine(MIRRORED), affine(MIRRORED)),
}


def scenes(pair: str, spots: str, rule: str) -> tuple[Composite, ComposedField]:
    """Two placed fields, one as it is, composed by both: by the second one sampled evenly, in all of space
    too."""
    (one, other), (here, there) = PAIRS[pair](), SPOTS[spots]
    placed = [Placed("n0", one, here), Placed("n1", other, there, 0.8, (0.9, 0.4, 1.0))]
    naive = ComposedField(placed, rule)
    naive.__dict__["occupancy"] = naive.occupancy.marked(naive.occupancy.occupied)
    return Composite(placed, rule), naive


def some_rays(count: int = 300, seed: int = 0, away: float = 3.5) -> tuple[np.ndarray, np.ndarray]:
    """Rays to random points of a box around most of the scenes."""
    return rays_at(np.array([-1, -1, -1, 2.2, 1, 1.0]), count, seed, away)


def same_rays(scene: ComposedField, rays_o: np.ndarray, rays_d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """World rays in a scene's frame."""
    if scene.origin.shape == (3,):
        return rays_o - scene.origin, rays_d
    return moved_rays(np.linalg.inv(scene.origin), rays_o, rays_d)[:2]


def naively(scene: ComposedField, rays_o, rays_d, step: float) -> np.ndarray:
    """The naive composition's picture of rays by samples a step apart: (N, 5)."""
    out = np.zeros((len(rays_o), 5), np.float32)
    march_rays(scene, rays_o, rays_d, reach_of(len(out), 0.0, np.inf), step, 1e-4, out)
    return out


# -- against the naive composition ---------------------------------------------------------------------------


@pytest.mark.parametrize("rule", ["max", "add"])
@pytest.mark.parametrize("spots", SPOTS)
@pytest.mark.parametrize("pair", TRIED)
def test_points_are_answered_as_the_naive_composition_answers_them(pair, spots, rule):
    composite, naive = scenes(pair, spots, rule)
    points = torch.from_numpy(points_in(np.array([-1, -1, -1, 2.2, 1, 1.0]), 3000))
    dirs = torch.from_numpy(unit(np.random.default_rng(1).normal(size=(3000, 3))))
    (sigma, rgb), (wanted, colour) = composite.query(points, dirs), naive.query(points, dirs)
    assert (wanted > 0).float().mean() > 0.1
    assert sigma.numpy() == pytest.approx(wanted.numpy(), rel=1e-5, abs=1e-5)
    seen = wanted > 1e-3  # in the last digits of a tie another may be denser
    close = (rgb - colour).abs().amax(1) < 1e-4
    assert close[seen].float().mean() > 0.999
    assert torch.equal(composite.query(points, dirs, with_colour=False)[0], sigma)


@pytest.mark.parametrize("rule", ["max", "add"])
@pytest.mark.parametrize("spots", SPOTS)
@pytest.mark.parametrize("pair", TRIED)
def test_pictures_come_to_those_of_the_naive_composition(pair, spots, rule):
    """Its samples lie elsewhere, so that the two agree as these come to lie closer."""
    composite, naive = scenes(pair, spots, rule)
    rays_o, rays_d = same_rays(naive, *some_rays(200))
    truth, off = naively(naive, rays_o, rays_d, min(sampling_step(naive) / 8, 0.004)), []
    # at whose own step nothing is seen of random numbers
    coarse = 8 if naive.occupancy.space is unbounded else 1
    for finer in (coarse, 4 * coarse):
        step = sampling_step(composite) / finer
        found = render_rays(composite, rays_o, rays_d, step=step, early_stop=1e-4)
        off.append(np.abs(found - truth)[:, :4])
    assert truth[:, 3].max() > 0.5
    assert np.sqrt(np.mean(off[1] ** 2)) < 5e-3
    assert off[1].mean() < 0.6 * off[0].mean() + 1e-4


# -- laws ----------------------------------------------------------------------------------------------------


def assert_same(found: np.ndarray, wanted: np.ndarray, tolerance: float = 1e-5) -> None:
    """Colours, opacities and distances by weight of two pictures (N, 5) are the same."""
    assert wanted[:, 3].max() > 0.3
    scale = np.maximum(np.abs(wanted).max(0), 1)
    assert np.abs((found - wanted) / scale).max() < tolerance


@pytest.mark.parametrize("kind", ["vm", "sparse"])
def test_a_scene_of_one_field_shows_that_field(kind):
    field = blob(kind)
    scene, rays = Composite([Placed("one", field, np.eye(4))]), rays_at(BOX, 200)
    wanted = render_rays(field, *rays)
    moved = same_rays(scene, *rays)
    assert_same(render_rays(scene, *moved), wanted)


@pytest.mark.parametrize("matrix", [TURNED, MIRRORED, 1e-3 * turn(10)], ids=["turned", "mirrored", "small"])
def test_a_placed_field_shows_what_it_shows_in_its_own_frame(matrix):
    """Optical depths do not depend on the frame."""
    field, pose = blob("vm"), affine(matrix, (3.0, -2.0, 1.0))
    rays = rays_at(BOX, 200)
    wanted = render_rays(field, *rays)
    scene = Composite([Placed("one", field, pose), Placed("far", field, affine(1.0, (1e3, 0, 0)))])
    world_o, world_d, longer = moved_rays(pose, *rays)
    found = render_rays(scene, *same_rays(scene, world_o, world_d), step=sampling_step(scene))
    found[:, 4] /= longer
    assert_same(found, wanted)


def test_a_scene_a_million_of_its_sizes_away_is_the_same():
    near, _ = scenes("vm and sparse", "in one another", "max")
    away = np.array([1e6, -2e6, 0.5e6])
    shift = away_by(near.origin + away)
    placed = [replace(p, object_to_world=p.object_to_world + shift) for p in near.placed]
    far, (rays_o, rays_d) = Composite(placed), same_rays(near, *some_rays())
    moved = rays_o + (near.origin + away) - far.origin
    assert_same(render_rays(far, moved, rays_d), render_rays(near, rays_o, rays_d), 1e-4)


def away_by(shift: np.ndarray) -> np.ndarray:
    """(4, 4) that adds a shift to a placement."""
    found = np.zeros((4, 4))
    found[:3, 3] = shift
    return found


def test_rays_from_a_million_sizes_away_show_the_same():
    scene, _ = scenes("vm and sparse", "in one another", "max")
    rays_o, rays_d = same_rays(scene, *some_rays())
    near, far = (render_rays(scene, o, rays_d) for o in (rays_o, rays_o - 1e6 * rays_d))
    far[:, 4] -= 1e6 * far[:, 3]
    assert np.abs(near - far)[:, :4].max() < 1e-4


@pytest.mark.parametrize("pair", ["vm and sparse", "unbounded and vm"])
def test_only_what_lies_between_two_distances_shows(pair):
    """What is shown up to a distance and what is shown from there on make up the whole."""
    scene, _ = scenes(pair, "in one another", "max")
    rays_o, rays_d = same_rays(scene, *some_rays())
    how = {"step": sampling_step(scene) / 20, "early_stop": 0.0}
    whole = render_rays(scene, rays_o, rays_d, **how)
    t = whole[:, 4] / np.maximum(whole[:, 3], 1e-3)
    before = render_rays(scene, rays_o, rays_d, far=t, **how)
    behind = render_rays(scene, rays_o, rays_d, near=t, **how)
    together = 1 - (1 - before[:, 3]) * (1 - behind[:, 3])
    assert np.abs(together - whole[:, 3]).mean() < 5e-3
    assert (before[:, 3] > 0.1).any() and (behind[:, 3] > 0.1).any()


@pytest.mark.parametrize("count", [3, 12, 30])
def test_many_in_one_place_are_one_or_their_sum(count):
    """Under `max` equal fields are one of them; under `add` optical depths are so many times as much."""
    field, rays = blob("vm", density=2.0), rays_at(BOX, 150)
    alone = render_rays(field, *rays, early_stop=0.0)
    placed = [Placed(f"n{i}", field, np.eye(4)) for i in range(count)]
    for rule, wanted in (("max", alone[:, 3]), ("add", 1 - (1 - alone[:, 3]) ** count)):
        scene = Composite(placed, rule)
        found = render_rays(scene, *same_rays(scene, *rays), early_stop=0.0)
        assert found[:, 3] == pytest.approx(wanted, abs=2e-5)
        assert found[:, :3] == pytest.approx(wanted[:, None] * [0.9, 0.15, 0.1], abs=1.5e-4 * count)


def test_a_slot_of_more_samples_than_it_holds_goes_on_in_the_next_wave():
    scene, naive = scenes("vm and vm", "the same place", "add")
    rays_o, rays_d = same_rays(scene, *some_rays())
    step = sampling_step(scene) / 20
    longest = np.diff(sphere_hit(scene.instances.spheres[0], rays_o, rays_d), axis=0).max()
    assert longest / step > 4 * MAX_TRACED
    found = render_rays(scene, rays_o, rays_d, step=step, early_stop=0.0)
    assert found[:, 3] == pytest.approx(naively(naive, rays_o, rays_d, step)[:, 3], abs=2e-3)


def sphere_hit(sphere: np.ndarray, rays_o: np.ndarray, rays_d: np.ndarray) -> np.ndarray:
    """(2, N) where rays enter and leave a sphere, alike where they miss it."""
    middle = ((sphere[:3] - rays_o) * rays_d).sum(1)
    half = np.sqrt(
        np.maximum(sphere[3] ** 2 - ((rays_o + middle[:, None] * rays_d - sphere[:3]) ** 2).sum(1), 0)
    )
    return np.stack([middle - half, middle + half])


@pytest.mark.parametrize("pair", ["vm and sparse", "unbounded and vm"])
def test_a_ray_does_not_depend_on_its_company(pair):
    scene, _ = scenes(pair, "in one another", "max")
    rays_o, rays_d = same_rays(scene, *some_rays(600))
    together = render_rays(scene, rays_o, rays_d)
    order = np.random.default_rng(3).permutation(600)
    assert np.array_equal(render_rays(scene, rays_o[order], rays_d[order]), together[order])
    assert np.array_equal(render_rays(scene, rays_o[:7], rays_d[:7]), together[:7])


@pytest.mark.parametrize("threads", [1, 2, 5])
def test_segments_do_not_depend_on_the_number_of_threads(threads, monkeypatch):
    scene, _ = scenes("unbounded and vm", "in one another", "max")
    rays_o, rays_d = same_rays(scene, *some_rays(2000))
    wanted = render_rays(scene, rays_o, rays_d)
    monkeypatch.setattr("fusedrf_cli.engine.kernels.segments.get_num_threads", lambda: threads)
    assert np.array_equal(render_rays(scene, rays_o, rays_d), wanted)


def test_rays_through_a_crowd_do_not_depend_on_their_company():
    """Which instances are looked for, and in what order, goes by rays that lie side by side."""
    rng, field = np.random.default_rng(4), blob("vm")
    spots = [affine(0.3 * turn(rng.uniform(0, 360)), rng.uniform(-1.5, 1.5, 3)) for _ in range(40)]
    placed = [Placed(f"n{i}", field, spot) for i, spot in enumerate([*spots, spots[7]])]
    scene = Composite([Placed("around", surroundings(), np.eye(4)), *placed])
    rays_o, rays_d = same_rays(scene, *some_rays(600))
    together, order = render_rays(scene, rays_o, rays_d), rng.permutation(600)
    assert np.array_equal(render_rays(scene, rays_o[order], rays_d[order]), together[order])
    assert np.array_equal(render_rays(scene, rays_o[:1], rays_d[:1]), together[:1])
    crowd, naive = Composite(placed), ComposedField(placed)
    rays = same_rays(crowd, *some_rays(200))
    truth = naively(naive, *rays, sampling_step(crowd) / 8)
    found = render_rays(crowd, *rays, step=sampling_step(crowd) / 4, early_stop=1e-4)
    assert truth[:, 3].max() > 0.5 and np.sqrt(np.mean((found - truth)[:, :4] ** 2)) < 1e-2


def test_copies_that_are_posed_otherwise_lie_there():
    scene, _ = scenes("vm and sparse", "apart", "max")
    rays_o, rays_d = same_rays(scene, *some_rays())
    render_rays(scene, rays_o, rays_d)  # what is kept of the old places must not stay
    posed = scene.posed({"n1": scene.placed[0].object_to_world})
    wanted = Composite(
        [*scene.placed[:1], Placed("n1", scene.placed[1].field, scene.placed[0].object_to_world)]
    )
    shift = wanted.origin
    assert_same(render_rays(posed, rays_o, rays_d), render_rays(wanted, rays_o - shift, rays_d))


# -- groups and refusals -------------------------------------------------------------------------------------


def nested(kind: type, outer: str, inner: str) -> ComposedField:
    """A field, and two that are one group by a rule of its own, which is turned."""
    a, b = affine(1.0, (0.2, 0, 0)), affine(SMALL, (-0.1, 0.2, 0))
    group = ComposedField([Placed("a", blob("vm"), a), Placed("b", blob("sparse", "blue"), b)], inner)
    frame = np.eye(4)
    frame[:3, 3] = group.origin
    return kind(
        [Placed("n", blob("vm", "blue"), affine(MIRRORED)), Placed("g", group, affine(TURNED) @ frame)], outer
    )


@pytest.mark.parametrize("outer, inner", [("max", "add"), ("add", "max"), ("max", "max"), ("add", "add")])
def test_groups_have_rules_of_their_own(outer, inner):
    composite, naive = nested(Composite, outer, inner), nested(ComposedField, outer, inner)
    assert len(composite.groups) == (2 if outer != inner else 1)
    points = torch.from_numpy(points_in(BOX, 2000))
    dirs = torch.from_numpy(unit(np.random.default_rng(1).normal(size=(2000, 3))))
    (sigma, rgb), (wanted, colour) = composite.query(points, dirs), naive.query(points, dirs)
    assert sigma.numpy() == pytest.approx(wanted.numpy(), rel=1e-5, abs=1e-5)
    assert ((rgb - colour).abs().amax(1) < 1e-4)[wanted > 1e-3].float().mean() > 0.999
    rays_o, rays_d = same_rays(composite, *some_rays())
    step = sampling_step(composite) / 4
    off = render_rays(composite, rays_o, rays_d, step=step) - naively(naive, rays_o, rays_d, step)
    assert np.sqrt(np.mean(off[:, :4] ** 2)) < 2e-3


def test_what_cannot_be_a_composite_says_so():
    analytic = [Placed("fog", Gaussian(), np.eye(4))]
    deep = [Placed("deep", nested(ComposedField, "max", "add"), np.eye(4))]
    assert not can_be_composite(analytic) and not can_be_composite(deep, "add")
    assert can_be_composite(deep, "max")
    with pytest.raises(TypeError):
        Composite(analytic)


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_of_equal_densities_the_first_shows(order):
    """Not now this and now that one, as roundings have it."""
    tints = [exported(Box(8.0, tint=t), "vm", (9, 9, 9)) for t in TINTS.values()]
    spots = affine(1.0, (0, 0, 0)), affine(turn(30, (0, 0, 1)), (0.1, 0.05, 0))
    scene = Composite([Placed(str(i), tints[i], m) for i, m in zip(order, spots, strict=True)])
    rays_o, rays_d = rays_at(np.array([-0.1, -0.1, -0.4, 0.1, 0.1, 0.4]), 200)
    found = render_rays(scene, *same_rays(scene, rays_o, rays_d))
    down = np.abs(rays_d[:, 2]) > 0.98  # by the common top or bottom, where both begin
    points = torch.from_numpy(points_in(np.array([-0.2, -0.2, -0.4, 0.2, 0.2, 0.4]), 500) - scene.origin)
    _, rgb = scene.query(points, torch.zeros(500, 3).double() + 0.6)
    first = 0 if order[0] == 0 else 2
    assert (rgb[:, first] > 0.8).all()
    assert down.sum() >= 3 and (found[down, first] > 0.8).all()
