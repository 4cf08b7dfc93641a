"""The naive composition: its rules against values by hand, order, empty fields, and scenes far away."""

from itertools import permutations

import numpy as np
import pytest
import torch

from fusedrf_cli.engine.composition.affine import Placed
from fusedrf_cli.engine.composition.composed import ComposedField
from fusedrf_cli.engine.fields.occupancy import OccupancyConfig, seen_box
from fusedrf_cli.engine.rendering.cameras import Camera, framing_camera
from fusedrf_cli.engine.rendering.metrics import psnr
from fusedrf_cli.engine.rendering.volume import render_image, render_rays
from tests.analytic.rays import affine, turn
from tests.engine.conftest import BOX, Ball, Gaussian, Slab, points_in, unit


@pytest.fixture(autouse=True)
def coarse_occupancy(in_force):
    """A grid that is made in no time: analytic fields have full occupancies anyway."""
    in_force(OccupancyConfig(scene_cells=24))


class Painted(Slab):
    """A slab of one colour."""

    def __init__(self, rgb, **options):
        super().__init__(**options)
        self.rgb = rgb

    def colour(self, points, dirs):
        return np.broadcast_to(np.asarray(self.rgb, float), points.shape).copy()


RED = Painted((1, 0, 0), density=3.0, low=-0.5, high=0.3)
BLUE = Painted((0, 0, 1), density=1.0, low=-0.1, high=0.7)
EVEN = Painted((0, 1, 0), density=3.0, low=-0.5, high=0.3)
NOTHING = Painted((1, 1, 1), density=0.0)


def at_x(composed: ComposedField, *x: float) -> tuple[torch.Tensor, torch.Tensor]:
    """σ and rgb at world points on the x axis, seen along +y."""
    points = np.array([[value, 0.0, 0.0] for value in x]) - composed.origin
    return composed.query(torch.from_numpy(points), torch.tensor([[0.0, 1, 0]]).double().expand(len(x), 3))


def placed(*fields, matrix=None) -> list[Placed]:
    return [Placed(f"n{i}", f, np.eye(4) if matrix is None else matrix) for i, f in enumerate(fields)]


def test_max_takes_the_denser_and_its_colour():
    sigma, rgb = at_x(ComposedField(placed(BLUE, RED)), -0.3, 0.1, 0.5, 0.9)
    assert sigma.tolist() == [3, 3, 1, 0]
    assert rgb.tolist() == [[1, 0, 0], [1, 0, 0], [0, 0, 1], [0, 0, 0]]


def test_add_sums_and_mixes_by_density():
    sigma, rgb = at_x(ComposedField(placed(BLUE, RED), "add"), -0.3, 0.1, 0.5, 0.9)
    assert sigma.tolist() == [3, 4, 1, 0]
    assert rgb.tolist() == [[1, 0, 0], [0.75, 0, 0.25], [0, 0, 1], [0, 0, 0]]


def test_density_is_compared_in_the_world():
    """Shrunk to half, blue is 2 dense in the world; shrunk to a quarter 4, and wins against red's 3."""
    for k, winner in ((0.5, [1, 0, 0]), (0.25, [0, 0, 1])):
        sigma, rgb = at_x(ComposedField([*placed(RED), *placed(BLUE, matrix=affine(k, (0, 0, 0)))]), 0.02)
        assert rgb.tolist() == [winner] and sigma.item() == max(3, 1 / k)


@pytest.mark.parametrize("tau_a", [0.1, 0.7, 2.0, 8.0])
@pytest.mark.parametrize("tau_b", [0.1, 2.0])
def test_slabs_through_each_other_have_closed_opacities(tau_a, tau_b):
    """Both slabs are [0, 1] wide in x; max leaves the thicker depth, add the sum."""
    a = Painted((1, 0, 0), density=tau_a, low=0.0, high=1.0)
    b = Painted((0, 0, 1), density=tau_b, low=0.0, high=1.0)
    for rule, depth in (("max", max(tau_a, tau_b)), ("add", tau_a + tau_b)):
        composed = ComposedField(placed(a, b), rule)
        start = np.array([[-3.0, 0.1, 0.2]]) - composed.origin
        out = render_rays(composed, start, np.array([[1.0, 0, 0]]), step=1 / 256, early_stop=1e-7)
        assert out[0, 3] == pytest.approx(1 - np.exp(-depth), abs=0.01 * depth * np.exp(-depth) + 1e-5)


def test_a_tie_goes_to_the_lower_index():
    assert at_x(ComposedField(placed(RED, EVEN)), 0.0)[1].tolist() == [[1, 0, 0]]
    assert at_x(ComposedField(placed(EVEN, RED)), 0.0)[1].tolist() == [[0, 1, 0]]
    dense = [Painted(c, density=s) for c, s in (((1, 0, 0), 1e5), ((0, 0, 1), 2e5))]
    assert at_x(ComposedField(placed(*dense)), 0.0)[1].tolist() == [[0, 0, 1]]  # alpha is 1 of both


def test_order_does_not_matter():
    """All orders of three overlapping fields, bit for bit."""
    three = [
        Placed("a", Gaussian(), affine(1.2)),
        Placed("b", Gaussian(density=4.0, centre=(0.2, 0, 0)), affine(turn(40))),
        Placed("c", Ball(density=2.0), affine((-0.7, 1, 1.1))),
    ]
    points = torch.from_numpy(points_in(BOX, 2000, margin=0.2))
    dirs = torch.from_numpy(unit(points_in(BOX, 2000, seed=5)))
    answers = [ComposedField(list(order)).query(points, dirs) for order in permutations(three)]
    assert answers[0][0].count_nonzero() > 300
    for sigma, rgb in answers[1:]:
        assert torch.equal(sigma, answers[0][0]) and torch.equal(rgb, answers[0][1])


@pytest.mark.parametrize("rule", ["max", "add"])
def test_an_empty_field_changes_nothing(rule):
    points = torch.from_numpy(points_in(BOX, 1000))
    dirs = torch.from_numpy(unit(points_in(BOX, 1000, seed=5)))
    alone = ComposedField(placed(Gaussian(), BLUE), rule).query(points, dirs)
    for fields in ((Gaussian(), BLUE, NOTHING), (NOTHING, Gaussian(), BLUE)):
        sigma, rgb = ComposedField(placed(*fields), rule).query(points, dirs)
        assert torch.equal(sigma, alone[0]) and torch.equal(rgb, alone[1])


def test_nothing_at_all_is_black_and_empty():
    sigma, rgb = ComposedField(placed(NOTHING)).query(torch.zeros(5, 3), torch.eye(3)[[0] * 5])
    assert not sigma.any() and not rgb.any()


@pytest.mark.parametrize("shift", [(1e6, -1e6, 1e6), (123456.7, 0.0, -3e5)])
def test_a_scene_far_away_gives_the_same_picture(shift):
    def picture(offset):
        far = np.eye(4)
        far[:3, 3] = offset
        fields = [
            Placed("a", Gaussian(density=20.0), far @ affine(turn(30))),
            Placed("b", Ball(radius=0.3).occupy(8), far @ affine(0.5, (1, 0, 0))),
        ]
        composed = ComposedField(fields)
        near = framing_camera(np.array([-1.0, -1, -1, 1.5, 1, 1]), 0.4, 0.3, 24, 24)
        camera = Camera(far @ near.camera_to_world, near.fl_x, near.fl_y, near.cx, near.cy, 24, 24)
        return render_image(composed, camera, origin=composed.origin, step=0.02).over((1, 1, 1))

    here = picture((0, 0, 0))
    assert here.std() > 0.05
    assert psnr(picture(shift), here) >= 60


@pytest.mark.parametrize("rule", ["max", "add"])
@pytest.mark.parametrize(
    ("size", "offset"), [(1e-9, (0, 1e-7, 0)), (1e9, (-1e10, 0, 3e12)), (1e4, (5e5, 0, 0))]
)
def test_a_scene_in_any_unit_gives_the_same_picture(size, offset, rule):
    """After a similarity of the world densities are 1/size of what they were, distances `size` times."""

    def picture(size, offset):
        world = affine(size, offset)
        fields = [
            Placed("a", Gaussian(density=20.0), world @ affine(turn(30))),
            Placed("b", Ball(radius=0.3).occupy(8), world @ affine(0.5, (1, 0, 0))),
        ]
        composed = ComposedField(fields, rule)
        near = framing_camera(np.array([-1.0, -1, -1, 1.5, 1, 1]), 0.4, 0.3, 24, 24)
        pose = near.camera_to_world.copy()
        pose[:3, 3] = (world @ pose)[:3, 3]
        camera = Camera(pose, near.fl_x, near.fl_y, near.cx, near.cy, 24, 24)
        shot = render_image(composed, camera, origin=composed.origin)
        return shot.over((1, 1, 1)), shot.depth / size, composed.aabb

    here, deep, box = picture(1.0, (0, 0, 0))
    there, as_deep, box_there = picture(size, offset)
    assert here.std() > 0.05 and psnr(there, here) >= 60
    seen = np.isfinite(deep) & np.isfinite(as_deep)
    np.testing.assert_allclose(as_deep[seen], deep[seen], rtol=1e-2)
    assert 1 <= (box_there[3:] - box_there[:3]).max() < 2.5  # numbers of an ordinary size


def test_a_placement_seen_from_a_frame_far_away_keeps_its_digits():
    frame = affine(2.0**-20, (1e12, -5e11, 310.0))
    found = Placed("a", RED, frame @ affine(turn(20), (0, 0, 0))).moved(frame).object_to_world
    np.testing.assert_allclose(found, affine(turn(20), (0, 0, 0)), atol=1e-12)
    box = np.array([1e12, -5e11, 310.0, 1e12 + 1, -5e11 + 2, 311.0])
    np.testing.assert_array_equal(seen_box(box, frame), np.array([0, 0, 0, 1, 2, 1]) * 2.0**20)


def test_what_cannot_be_composed_is_refused():
    with pytest.raises(ValueError, match="at least one field"):
        ComposedField([])
    with pytest.raises(ValueError, match="max, add, found 'mean'"):
        ComposedField(placed(RED), "mean")
