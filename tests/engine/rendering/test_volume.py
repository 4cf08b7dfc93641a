"""Rendering of any field: closed forms, the fast and the general path, early stop, pictures."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from fusedrf_cli.engine.fields.base import RadianceField
from fusedrf_cli.engine.fields.occupancy import OccupancyGrid
from fusedrf_cli.engine.rendering.cameras import framing_camera
from fusedrf_cli.engine.rendering.volume import (
    RenderConfig,
    rays_from,
    render_image,
    render_rays,
    weights_from_depths,
)
from tests.engine.conftest import (
    BOX,
    DIRECTIONS_26,
    THIRTY_TWO,
    Ball,
    Gaussian,
    Slab,
    Slow,
    points_in,
    random_vm,
    rays_at,
)


def transmittance_error(field, rays, step) -> np.ndarray:
    out = render_rays(field, *rays, step=step, early_stop=0.0)
    return np.abs(1 - out[:, 3] - np.exp(-field.depth(*rays)))


@pytest.mark.parametrize("field", [Slab(), Ball(), Gaussian()], ids=lambda field: type(field).__name__)
def test_closed_forms(field):
    """A step δ leaves at most half a step of optical depth at each face of an even medium, and far less in a
    smooth one."""
    rays = rays_at(BOX, 300)
    rays[0][:40] = points_in(BOX, 40)  # from inside
    assert isinstance(field, RadianceField)
    for step in (0.04, 0.01):
        error = transmittance_error(field, rays, step)
        if isinstance(field, Gaussian):
            outside = error[40:]  # a ray from inside has half a sample's end
            assert outside.max() < 1e-5 and error.max() < 0.5 * field.density * step
        else:
            assert error.max() < field.density * step + 1e-6 and error.mean() < 0.25 * field.density * step


def test_smooth_fields_converge_with_the_square_of_the_step():
    """Midpoint samples: halving the step divides the error of a ray that begins within the matter by four."""
    field = Gaussian(width=0.3, density=1.0, aabb=5 * BOX)
    rays = points_in(BOX, 100), np.tile(DIRECTIONS_26, (4, 1))[:100]
    coarse, fine = (transmittance_error(field, rays, step).mean() for step in (0.2, 0.1))
    assert 3 < coarse / fine < 5


def test_known_colour_and_depth():
    """Before a thick wall: its colour where it begins, in full, at the distance of the wall."""
    wall = Slab(density=2000.0, low=0.2, high=0.9)
    wall.colour = lambda points, dirs: np.tile([0.2, 0.5, 0.9], (len(points), 1))
    out = render_rays(wall, np.array([[-4.0, 0.1, 0.2]]), np.array([[1.0, 0, 0]]), step=0.004)
    np.testing.assert_allclose(out[0, :4], [0.2, 0.5, 0.9, 1], atol=2e-3)
    assert out[0, 4] == pytest.approx(4.2, abs=0.02)


def test_an_even_medium_has_exponential_depth():
    """∫ σ e^(-σ t) t dt over a slab, seen along its normal."""
    slab = Slab(density=1.5, low=0.0, high=0.8)
    out = render_rays(slab, np.array([[-1.0, 0.0, 0.0]]), np.array([[1.0, 0, 0]]), step=1e-3, early_stop=0.0)
    thick = np.exp(-1.5 * 0.8)
    assert out[0, 3] == pytest.approx(1 - thick, abs=1e-3)
    assert out[0, 4] == pytest.approx((1 - thick) / 1.5 - 0.8 * thick + (1 - thick), abs=2e-3)


@pytest.mark.parametrize("cells", [None, 7])
def test_the_general_path_is_the_fast_one(cells):
    field = random_vm(THIRTY_TWO, dtype=torch.float32, cells=cells)
    rays = rays_at(BOX, 150)
    rays[0][:26], rays[1][:26] = points_in(BOX, 26), DIRECTIONS_26
    fast, slow = (render_rays(f, *rays, early_stop=0.0) for f in (field, Slow(field)))
    assert fast[:, 3].max() > 0.3 and fast.dtype == np.float32
    np.testing.assert_allclose(slow, fast, rtol=1e-4, atol=2e-4)


def test_skipping_empty_cells_changes_nothing():
    """The samples lie where they lay: a ball in a full grid and in a grid of its own cells give the same
    bits."""
    rays = rays_at(BOX, 200)
    whole = render_rays(Ball(), *rays, early_stop=0.0)
    tight = render_rays(Ball().occupy(24), *rays, early_stop=0.0)
    np.testing.assert_allclose(
        tight, whole, rtol=0, atol=1e-6
    )  # waves are cut elsewhere, so sums round elsewhere


@pytest.mark.parametrize("early_stop", [0.3, 1e-2, 1e-3])
@pytest.mark.parametrize("fast", [True, False])
def test_early_stop_is_bounded(early_stop, fast):
    field = random_vm(THIRTY_TWO, dtype=torch.float32, scale=12.0)
    field = field if fast else Slow(field)
    rays = rays_at(BOX, 200)
    whole, stopped = (render_rays(field, *rays, early_stop=e) for e in (0.0, early_stop))
    assert (1 - whole[:, 3] < early_stop).any()
    assert np.abs(whole[:, :4] - stopped[:, :4]).max() <= early_stop + 1e-6


def test_near_leaves_out_what_lies_before():
    slab = Slab(low=-0.5, high=0.5, density=1.0)
    ray = np.array([[-3.0, 0, 0]]), np.array([[1.0, 0, 0]])
    for near, left in ((0.0, 1.0), (2.0, 1.0), (3.0, 0.5), (3.4, 0.1), (9.0, 0.0)):
        found = render_rays(slab, *ray, near=near, step=1e-3, early_stop=0.0)
        assert found[0, 3] == pytest.approx(1 - np.exp(-left), abs=1.1e-3)


def test_no_rays_and_rays_that_miss():
    for field in (Ball(), random_vm(THIRTY_TWO, dtype=torch.float32)):
        assert render_rays(field, np.zeros((0, 3)), np.zeros((0, 3))).shape == (0, 5)
        away = render_rays(field, np.array([[5.0, 0, 0], [5.0, 0, 0]]), np.array([[1.0, 0, 0], [0, 1, 0]]))
        assert (away == 0).all()


def test_weights_continue_a_wave():
    sigma, step = np.random.default_rng(0).random((5, 12)) * 9, 0.05
    whole, behind = weights_from_depths(sigma * step, np.ones(5))
    first, between = weights_from_depths(sigma[:, :5] * step, np.ones(5))
    second, last = weights_from_depths(sigma[:, 5:] * step, between)
    np.testing.assert_allclose(np.concatenate([first, second], 1), whole, rtol=1e-9)
    np.testing.assert_allclose(last, behind)
    np.testing.assert_allclose(whole.sum(1) + behind, 1)


@pytest.mark.parametrize("size", [(1, 1), (1, 9), (13, 7)])
def test_pictures_of_any_size(size, in_force):
    """A picture is its rays, row by row, whatever bands it is rendered in."""
    field, camera = random_vm(THIRTY_TWO, dtype=torch.float32), framing_camera(BOX, 0.7, 0.4, *size)
    picture = render_image(field, camera)
    rays = render_rays(field, *camera.rays()).reshape(size[1], size[0], 5)
    assert np.array_equal(picture.rgb, rays[..., :3]) and np.array_equal(picture.opacity, rays[..., 3])
    in_force(RenderConfig(pixels_at_once=3))
    assert np.array_equal(render_image(field, camera).rgb, picture.rgb)


def test_depth_and_background():
    ball, camera = Ball(density=200.0), framing_camera(BOX, 0.3, 0.2, 15, 15)
    picture = render_image(ball, camera)
    assert np.isinf(picture.depth[0, 0]) and picture.opacity[0, 0] == 0
    eye = camera.camera_to_world[:3, 3]
    rays_o, rays_d = camera.rays()
    middle = 7 * 15 + 7
    to = eye - ball.centre
    along = to @ rays_d[middle]
    hit = -along - np.sqrt(along**2 - to @ to + ball.radius**2)
    assert picture.depth[7, 7] == pytest.approx(hit, abs=0.03)
    white = picture.over((1.0, 1.0, 1.0))
    assert (white[0, 0] == 1).all() and (picture.over((0.0, 0.0, 0.0))[0, 0] == 0).all()
    np.testing.assert_allclose(
        white - picture.over((0, 0, 0)), 1 - picture.opacity[..., None].repeat(3, -1), atol=1e-6
    )


@pytest.mark.parametrize("stretch", [(1, 1, 1), (2.5, 2.5, 2.5), (2.5, 2.5, -2.5), (1, 1, 1.01)], ids=str)
@pytest.mark.parametrize("distance", [1.0, 1e6])
def test_rays_in_a_frame_are_the_rays_of_the_world_seen_from_it(stretch, distance):
    """Whether the frame has a camera of its own or is stretched, points along its rays are those of the
    world's: o + t d there is at t over the length of a unit here."""
    turn = np.linalg.qr(np.random.default_rng(4).normal(size=(3, 3)))[0]
    origin = np.eye(4)
    origin[:3, :3], origin[:3, 3] = turn * np.array(stretch), distance * np.array([1, -2, 3])
    camera = framing_camera(BOX, 0.7, 0.4, 9, 7)
    camera = replace(camera, distortion=(-0.12, 0.05, -0.01, 0.003, -0.002))
    camera.camera_to_world[:3, 3] += origin[:3, 3]
    order = np.random.default_rng(5).permutation(4 * 9)
    world_o, world_d = camera.rays(slice(2, 6), order)
    rays_o, rays_d, per_length = rays_from(origin, camera, slice(2, 6), order)
    np.testing.assert_allclose(np.linalg.norm(rays_d, axis=1), 1, rtol=1e-12)
    for t in (0.0, 3.0):
        here = rays_o + (t * per_length * rays_d.T).T
        there = np.linalg.inv(origin[:3, :3]) @ (world_o - origin[:3, 3] + t * world_d).T
        np.testing.assert_allclose(here, there.T, atol=1e-12)


def test_a_scene_far_from_the_origin_looks_the_same():
    """The origin is taken off in float64: at 10⁶ units the picture is that at 0 to the rounding of the
    camera's place."""
    field, camera = random_vm(THIRTY_TWO, dtype=torch.float32), framing_camera(BOX, 0.7, 0.4, 12, 9)
    far = np.array([1e6, -2e6, 5e5])
    pose = camera.camera_to_world.copy()
    pose[:3, 3] += far
    moved = type(camera)(**{**vars(camera), "camera_to_world": pose})
    difference = render_image(field, moved, origin=far).rgb - render_image(field, camera).rgb
    assert np.abs(difference).max() < 1e-3  # 60 dB


def test_crossing_a_face_is_continuous():
    """A camera that goes through a face of the box in small steps sees no jump."""
    field = random_vm(THIRTY_TWO, dtype=torch.float32)
    x = BOX[0] + np.linspace(-0.02, 0.02, 41)
    origins = np.stack([x, np.full(41, 0.1), np.full(41, 0.2)], 1)
    seen = render_rays(field, origins, np.tile([[0.8, 0.6, 0.0]], (41, 1)), step=0.002, early_stop=0.0)
    assert np.abs(np.diff(seen[:, :4], axis=0)).max() < 0.01


def test_an_empty_field_is_invisible():
    field = Ball()
    field.occupancy = OccupancyGrid(BOX, np.zeros((8, 8, 8), bool))
    assert (render_rays(field, *rays_at(BOX, 20)) == 0).all()
