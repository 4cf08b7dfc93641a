"""Crops of placed fields: what a ray and a point meet is what the whole field has there, or nothing."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from fusedrf_cli.engine.composition.affine import Placed
from fusedrf_cli.engine.composition.composed import ComposedField
from fusedrf_cli.engine.composition.composite import Composite
from fusedrf_cli.engine.composition.crops import Crop, Crops
from fusedrf_cli.engine.composition.differentiable import query
from fusedrf_cli.engine.fields.base import sampling_step
from fusedrf_cli.engine.fields.occupancy import OccupancyConfig
from fusedrf_cli.engine.rendering.volume import march_rays, reach_of, render_rays
from fusedrf_cli.engine.spaces import bounded, contracted_l2, contracted_linf, ndc, unbounded
from tests.analytic.export import exported
from tests.analytic.fields import BOX, Box, chord_of_box
from tests.analytic.rays import affine, moved_rays, points_in, rays_at, turn, unit
from tests.engine.composition.test_composite import (
    MIRRORED,
    PAIRS,
    SPOTS,
    TURNED,
    blob,
    naively,
    same_rays,
    some_rays,
    surroundings,
)
from tests.engine.spaces.test_contractions import hashed_in
from tests.engine.spaces.test_contractions import some_rays as space_rays

FIELDS = {"vm": lambda: blob("vm"), "all of space": surroundings}
AT = affine(TURNED)
SHAPES = {
    "a box": Crop.of((-0.3, -0.5, -0.2, 0.25, 0.1, 0.5), np.eye(4)),
    "a turned box": Crop.of((-0.2, -0.3, -0.4, 0.3, 0.2, 0.3), affine(turn(35), (0.05, 0, 0.1))),
    "a ball": Crop.of((0.1, -0.1, 0.15, 0.3), np.eye(4)),
    "a stretched ball": Crop.of((0.1, -0.1, 0.1, 0.4), affine(turn(20) @ np.diag([1, 0.7, 2]), (0, 0, 0))),
}
BOTH = Crops((SHAPES["a turned box"], SHAPES["a ball"]))
FAR = Crops((Crop.of((-3.0, -2.0, -2.5, 0.6, 4.0, 2.0), np.eye(4)),))
"""Of all of space: it reaches out of the core."""
EACH = {name: Crops((crop,)) for name, crop in SHAPES.items()} | {"both": BOTH}


@pytest.fixture(autouse=True)
def coarse_occupancy(in_force):
    in_force(OccupancyConfig(scene_cells=24))


class Pointwise:
    """A field that is asked point by point, and says that it is empty outside of its crops."""

    kind = "pointwise"

    def __init__(self, field, crops: Crops):
        self.field, self.crops, self.occupancy = field, crops, field.occupancy

    def query(self, points, dirs, with_colour=True):
        sigma, rgb = self.field.query(points, dirs, with_colour)
        outside = ~np.all([inside(crop, points.numpy()) for crop in self.crops.items], 0)
        sigma[outside] = 0
        return sigma, rgb


def inside(crop: Crop, points: np.ndarray) -> np.ndarray:
    """(N,) bool, by the definition of a cube and of a ball."""
    at = np.concatenate([points, np.ones((len(points), 1))], 1) @ crop.to_unit[:3].T
    return np.hypot.reduce(at, axis=1) <= 1 if crop.is_ball else (np.abs(at) <= 1).all(1)


def slowly(field, crops: Crops, rays_o: np.ndarray, rays_d: np.ndarray) -> np.ndarray:
    """(N, 5) of rays of a field's frame by its own samples, one by one."""
    out = np.zeros((len(rays_o), 5), np.float32)
    reach = reach_of(len(out), 0.0, np.inf)
    march_rays(Pointwise(field, crops), rays_o, rays_d, reach, sampling_step(field), 0.0, out)
    return out


def rays_to(crops: Crops, count: int = 300) -> tuple[np.ndarray, np.ndarray]:
    """Rays of a field's frame to points in and beside its crops, from without."""
    return rays_at(crops.aabb + 0.1 * np.repeat([-1, 1], 3), count, away=2.5)


# -- shapes --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", SHAPES)
def test_a_shape_holds_what_its_numbers_say(shape):
    """The points of boxes and balls by their corners and radii, and the box around them."""
    crop, points = SHAPES[shape], points_in(np.array([-1.0, -1, -1, 1, 1, 1]), 5000)
    numbers, frame = {
        "a box": ((-0.3, -0.5, -0.2, 0.25, 0.1, 0.5), np.eye(4)),
        "a turned box": ((-0.2, -0.3, -0.4, 0.3, 0.2, 0.3), affine(turn(35), (0.05, 0, 0.1))),
        "a ball": ((0.1, -0.1, 0.15, 0.3), np.eye(4)),
        "a stretched ball": (
            (0.1, -0.1, 0.1, 0.4),
            affine(turn(20) @ np.diag([1, 0.7, 2]), (0, 0, 0)),
        ),
    }[shape]
    at, numbers = points @ frame[:3, :3].T + frame[:3, 3], np.array(numbers)
    if len(numbers) == 4:
        wanted = np.linalg.norm(at - numbers[:3], axis=1) <= numbers[3]
    else:
        wanted = ((at >= numbers[:3]) & (at <= numbers[3:])).all(1)
    held = crop.holds(torch.from_numpy(points)).numpy()
    assert np.array_equal(held, wanted) and 0.01 < held.mean() < 0.5
    low, high = points[held].min(0), points[held].max(0)
    assert (crop.aabb[:3] <= low).all() and (high <= crop.aabb[3:]).all()
    assert np.abs(np.concatenate([low, high]) - crop.aabb).max() < 0.2


@pytest.mark.parametrize("field", FIELDS)
@pytest.mark.parametrize("crops", EACH)
def test_cells_that_are_shown_are_those_with_points_in_the_crops(field, crops):
    field, crops = FIELDS[field](), EACH[crops]
    shown = crops.shown(field)
    points = points_in(np.array([-0.99, -0.99, -0.99, 0.99, 0.99, 0.99]), 20000)
    there = crops.hold(points) & field.occupancy.contains(points)
    assert there.sum() > 50 and shown.contains(points[there]).all()
    assert shown.space is bounded  # in the core coordinates are the frame's
    box = shown.look_at_box
    assert (points[there] >= box[:3]).all() and (points[there] <= box[3:]).all()
    assert (crops.aabb[:3] <= box[:3]).all() and (box[3:] <= crops.aabb[3:]).all()
    away = np.linalg.norm(shown.cell)
    beside = ~crops.hold(points) & np.all([~near(crops, points, away)], 0)
    assert not shown.contains(points[beside]).any()
    assert crops.shown(field) is shown


def near(crops: Crops, points: np.ndarray, away: float) -> np.ndarray:
    """(N,) bool: whether the crops' box, and so much around it, holds points."""
    return ((points >= crops.aabb[:3] - away) & (points <= crops.aabb[3:] + away)).all(1)


def test_a_crop_that_reaches_out_of_the_core_stays_in_all_of_space():
    placed = Placed("one", surroundings(), np.eye(4), crops=FAR)
    assert placed.unbounded and placed.occupancy.space is unbounded
    assert np.array_equal(placed.aabb, unbounded.LOOK_AT_BOX)
    assert not replace(placed, crops=BOTH).unbounded
    beside = replace(placed, crops=Crops((Crop.of((5.0, 0, 0, 1), np.eye(4)),)))
    assert beside.aabb[0] > 2 and beside.aabb[3] < 10


# -- rays ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", ["a box", "a turned box", "a ball"])
def test_even_density_is_seen_through_as_much_of_it_as_the_crop_holds(shape):
    """Against the closed form, but for the sample at either end."""
    crop, density = SHAPES[shape], 3.0
    field = exported(Box(density, half=(0.7, 0.7, 0.7)), "vm", (9, 9, 9))
    scene = Composite([Placed("one", field, AT, crops=Crops((crop,)))])
    rays_o, rays_d = rays_to(Crops((crop,)))
    world_o, world_d, _ = moved_rays(AT, rays_o, rays_d)
    step = sampling_step(scene) / 16
    found = render_rays(scene, *same_rays(scene, world_o, world_d), step=step, early_stop=0.0)
    own_o, own_d, longer = moved_rays(crop.to_unit, rays_o, rays_d)
    if crop.is_ball:
        middle = (own_o * own_d).sum(1)
        chord = 2 * np.sqrt(np.maximum(1 + middle**2 - (own_o**2).sum(1), 0))
    else:
        chord = chord_of_box(-np.ones(3), np.ones(3), own_o, own_d)
    seen = -np.log1p(-found[:, 3].astype(float))
    assert np.abs(seen - density * chord / longer).max() < 1.1 * density * sampling_step(field) / 16
    assert (chord > 0.1).mean() > 0.3


@pytest.mark.parametrize("field", FIELDS)
@pytest.mark.parametrize("crops", EACH)
def test_rays_meet_the_samples_of_the_whole_field_that_lie_in_the_crops(field, crops):
    """No sample moves, and none that is not held counts, wherever the node lies."""
    field, crops = FIELDS[field](), EACH[crops]
    rays_o, rays_d = rays_to(crops)
    wanted = slowly(field, crops, rays_o, rays_d)
    scene = Composite([Placed("one", field, AT, crops=crops)])
    world_o, world_d, longer = moved_rays(AT, rays_o, rays_d)
    found = render_rays(scene, *same_rays(scene, world_o, world_d), step=sampling_step(scene), early_stop=0.0)
    if scene.origin.shape == (3,):
        found[:, 4] /= longer
    assert wanted[:, 3].max() > 0.02 and (wanted[:, 3] == 0).any()
    # a sample on a face may be on either side of it
    same = np.abs(found - wanted).max(1) < 3e-3
    assert same.mean() > 0.98
    assert np.abs(found - wanted)[same][:, 3].max() < 2e-5


def test_a_far_crop_of_all_of_space_shows_its_samples():
    field = surroundings()
    rays_o, rays_d = rays_at(np.array([-2.0, -2, -2, 2, 2, 2]), 300, away=0.5)
    wanted = slowly(field, FAR, rays_o, rays_d)
    scene = Composite([Placed("one", field, np.eye(4), crops=FAR)])
    found = render_rays(scene, rays_o, rays_d, early_stop=0.0)
    whole = render_rays(Composite([Placed("one", field, np.eye(4))]), rays_o, rays_d, early_stop=0.0)
    assert (np.abs(whole - found)[:, 3] > 0.01).mean() > 0.5 and wanted[:, 3].max() > 0.1
    same = np.abs(found - wanted)[:, :4].max(1) < 3e-3
    assert same.mean() > 0.98 and np.abs(found - wanted)[same][:, 3].max() < 2e-5


@pytest.mark.slow  # loops of each space are compiled
@pytest.mark.parametrize("space", [contracted_l2, contracted_linf, ndc], ids=["L2", "Linf", "NDC"])
def test_crops_are_of_the_frame_where_its_rays_are_curved(space):
    """A ball around half of the places that a field has numbers for."""
    field = hashed_in(space, torch.float32)
    rays_o, rays_d = space_rays(space, 200)
    places = space.inv_contract(torch.from_numpy(field.occupancy.centres())).numpy()
    middle = np.median(places, 0)
    crops = Crops((Crop.of((*middle, np.median(np.linalg.norm(places - middle, axis=1))), np.eye(4)),))
    wanted = slowly(field, crops, rays_o, rays_d)
    scene = Composite([Placed("one", field, np.eye(4), crops=crops)], origin=np.eye(4))
    found = render_rays(scene, rays_o, rays_d, early_stop=0.0)
    uncropped = Composite([Placed("one", field, np.eye(4))], origin=np.eye(4))
    whole = render_rays(uncropped, rays_o, rays_d, early_stop=0.0)
    assert wanted[:, 3].max() > 0.05 and (np.abs(whole - wanted)[:, 3] > 0.01).mean() > 0.1
    same = np.abs(found - wanted)[:, :4].max(1) < 3e-3
    assert same.mean() > 0.95 and np.abs(found - wanted)[same][:, 3].max() < 1e-3


@pytest.mark.parametrize("kind", ["vm", "sparse", "all of space"])
def test_a_crop_around_all_of_it_changes_no_bit(kind):
    field = surroundings() if kind == "all of space" else blob(kind)
    around = Crops((Crop.of((-2e3, -2e3, -2e3, 2e3, 2e3, 2e3), np.eye(4)),))
    rays = rays_at(BOX, 200)
    whole, same = (Composite([Placed("one", field, np.eye(4), crops=c)]) for c in (Crops(), around))
    wanted = render_rays(whole, *same_rays(whole, *rays))
    assert wanted[:, 3].max() > 0.1
    assert np.array_equal(render_rays(same, *same_rays(same, *rays)), wanted)


@pytest.mark.parametrize("kind", ["vm", "sparse", "all of space"])
def test_two_crops_that_touch_make_up_the_whole(kind):
    """Every sample is in one of them: optical depths add up."""
    field = surroundings() if kind == "all of space" else blob(kind)
    frame, wide = affine(turn(25), (0.05, -0.1, 0)), 2e3
    halves = [
        Crops((Crop.of((low, -wide, -wide, high, wide, wide), frame),))
        for low, high in ((-wide, 0.0), (0.0, wide))
    ]
    rays_o, rays_d = rays_at(BOX, 300)

    def depths(crops: Crops) -> np.ndarray:
        scene = Composite([Placed("one", field, np.eye(4), crops=crops)])
        shown = render_rays(scene, *same_rays(scene, rays_o, rays_d), early_stop=0.0)
        return -np.log(np.maximum(1 - shown[:, 3].astype(float), 1e-3))

    whole, (one, other) = depths(Crops()), map(depths, halves)
    told = (whole < 4) & (whole > 0)
    assert told.sum() > 100 and (one[told] > 0.01).any() and (other[told] > 0.01).any()
    np.testing.assert_allclose((one + other)[told], whole[told], atol=2e-4)


# -- scenes --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("rule", ["max", "add"])
@pytest.mark.parametrize("spots", SPOTS)
@pytest.mark.parametrize("pair", ["vm and vm", "vm and sparse", "unbounded and vm"])
def test_composite_and_naive_composition_agree(pair, spots, rule):
    (one, other), (here, there) = PAIRS[pair](), SPOTS[spots]
    cropped = Crops((SHAPES["a ball"],)), Crops((SHAPES["a turned box"],))
    placed = [Placed("n0", one, here, crops=cropped[0]), Placed("n1", other, there, 0.8, crops=cropped[1])]
    composite, naive = Composite(placed, rule), ComposedField(placed, rule)
    points = torch.from_numpy(points_in(naive.occupancy.look_at_box, 3000))
    dirs = torch.from_numpy(unit(np.random.default_rng(1).normal(size=(3000, 3))))
    (sigma, rgb), (wanted, colour) = composite.query(points, dirs), naive.query(points, dirs)
    assert (wanted > 0).float().mean() > 0.01
    assert sigma.numpy() == pytest.approx(wanted.numpy(), rel=1e-5, abs=1e-5)
    assert ((rgb - colour).abs().amax(1) < 1e-4)[wanted > 1e-3].float().mean() > 0.999
    sigma, _ = query(naive, points, dirs)
    assert sigma.numpy() == pytest.approx(wanted.numpy(), rel=1e-3, abs=1e-4)
    rays_o, rays_d = same_rays(naive, *some_rays(200))
    truth = naively(naive, rays_o, rays_d, min(sampling_step(naive) / 8, 0.004))
    found = render_rays(composite, rays_o, rays_d, step=sampling_step(composite) / 16, early_stop=1e-4)
    assert truth[:, 3].max() > 0.1
    assert np.sqrt(np.mean((found - truth)[:, :4] ** 2)) < 3e-3  # 50 dB


@pytest.mark.parametrize("outer, inner", [("max", "add"), ("add", "max"), ("max", "max")])
def test_a_groups_crops_hold_for_what_is_in_it(outer, inner):
    """Crops of a node, of a group around it and of both, against the definition."""
    group_at, own_at = affine(MIRRORED, (0.1, 0.2, -0.1)), affine(0.8 * turn(50), (0.1, -0.05, 0.1))
    group_crops, own_crops = Crops((SHAPES["a turned box"],)), Crops((SHAPES["a ball"],))
    inside_it = ComposedField(
        [Placed("a", blob("vm"), own_at, crops=own_crops), Placed("b", blob("vm", "blue"), np.eye(4))],
        inner,
        origin=np.zeros(3),
    )
    placed = [Placed("g", inside_it, group_at, crops=group_crops), Placed("n", blob("sparse"), AT)]
    points = points_in(np.array([-0.5, -0.5, -0.5, 0.5, 0.5, 0.5]), 4000)
    dirs = torch.zeros(4000, 3).double() + np.sqrt(1 / 3)
    group = np.linalg.inv(group_at)
    at = points @ group[:3, :3].T + group[:3, 3]
    own = np.linalg.inv(own_at)
    within = inside(SHAPES["a turned box"], at)
    within_a = within & inside(SHAPES["a ball"], at @ own[:3, :3].T + own[:3, 3])

    def asked(one: Placed) -> np.ndarray:
        return one.query(torch.from_numpy(points), dirs)[0].numpy()

    a = asked(Placed("a", blob("vm"), group_at @ own_at)) * within_a
    b, n = asked(Placed("b", blob("vm", "blue"), group_at)) * within, asked(placed[1])
    both = {"max": np.maximum, "add": np.add}
    wanted = both[outer](both[inner](a, b), n)
    assert (a > 0.1).sum() > 20 and (b > 0.1).sum() > 20 and within.mean() < 0.8
    for made in (Composite, ComposedField):
        scene = made(placed, outer)
        sigma, _ = scene.query(torch.from_numpy(points - scene.origin), dirs)
        np.testing.assert_allclose(sigma.numpy(), wanted, rtol=1e-4, atol=1e-4)
    leaves = ComposedField(placed, outer).leaves()
    assert [len(leaf.crops.items) for leaf in leaves] == [2, 1, 0]


def test_nodes_with_crops_of_their_own_share_a_field():
    field = blob("vm")
    placed = [Placed(name, field, AT, crops=crops) for name, crops in EACH.items()]
    scene = Composite(placed)
    assert len({id(one) for one in scene.fields}) == 1
    assert len(scene.instances.skip) == field.occupancy.occupied.size
    assert list(scene.instances.first_crop) == [0, 1, 2, 3, 4, 6]


def test_what_a_crop_leaves_is_posed_with_its_node():
    scene = Composite(
        [Placed("one", blob("vm"), AT, crops=BOTH), Placed("two", blob("vm"), SPOTS["apart"][1])]
    )
    there = affine(turn(80), (0.4, 0.1, 0.2))
    wanted = Composite([replace(scene.placed[0], object_to_world=there), scene.placed[1]], origin=np.zeros(3))
    rays = some_rays()
    assert np.array_equal(render_rays(scene.posed({"one": there}), *rays), render_rays(wanted, *rays))
