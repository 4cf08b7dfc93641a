"""Pictures as functions of torch: against the one-pass renderer, and their gradients in float64 against
finite differences, by camera poses, placements and numbers, for each kind."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from fusedrf_cli.engine import kernels
from fusedrf_cli.engine.composition.affine import Placed, rigid_motion
from fusedrf_cli.engine.composition.composed import ComposedField
from fusedrf_cli.engine.fields.computed import ComputedField
from fusedrf_cli.engine.fields.occupancy import OccupancyConfig
from fusedrf_cli.engine.rendering import volume
from fusedrf_cli.engine.rendering.cameras import Camera, framing_camera
from fusedrf_cli.engine.rendering.differentiable import (
    camera_rays,
    composite,
    render_image,
    render_rays,
)
from tests.analytic.rays import affine, turn

from ..conftest import Gaussian, random_vm, rays_at
from ..kinds.cases import KINDS, SLOW_TO_COMPILE  # noqa: F401  (a fixture)

STEP = 0.04
CHECK = {"fast_mode": True, "eps": 1e-7, "atol": 1e-6, "rtol": 1e-6}


@pytest.fixture(autouse=True)
def coarse_occupancy(in_force):
    """A grid that is made in no time."""
    in_force(OccupancyConfig(scene_cells=24))


TRIED = [pytest.param(name, marks=pytest.mark.slow) if name in SLOW_TO_COMPILE else name for name in KINDS]


@pytest.fixture(params=TRIED)
def field(request):
    return KINDS[request.param]()


def rays(field, count: int = 6) -> list[torch.Tensor]:
    return [torch.from_numpy(x) for x in rays_at(field.aabb, count)]


def eye(field) -> Camera:
    return framing_camera(field.aabb, 0.7, 0.4, 4, 3)


def scene(field, rule: str = "max") -> ComposedField:
    """A field beside, and partly in, a vm field, both turned and one stretched."""
    centred = np.eye(4)
    centred[:3, 3] = -(field.aabb[:3] + field.aabb[3:]) / 2
    placed = Placed("one", field, affine(turn(20), (0.2, 0, 0)) @ centred)
    other = Placed("other", random_vm(seed=5, cells=4), affine((0.8, -1.1, 0.9), (0.5, 0.4, 0)))
    return ComposedField([placed, other], rule)


def matrix(composed: ComposedField, name: str) -> torch.Tensor:
    return torch.from_numpy(next(p.object_to_world for p in composed.placed if p.name == name))


def test_gradient_by_a_camera_s_pose(field):
    """Turned and shifted as a whole, and entry by entry."""
    camera = eye(field)
    start = torch.from_numpy(camera.camera_to_world)

    def picture(pose):
        shot = render_image(field, camera, pose=pose, step=STEP)
        return shot.rgb, shot.opacity

    twist = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda t: picture(rigid_motion(t) @ start), twist, **CHECK)
    assert torch.autograd.gradcheck(picture, start.clone().requires_grad_(), **CHECK)
    picture(rigid_motion(twist) @ start)[0].sum().backward()
    assert (twist.grad.abs() > 1e-3).all()


@pytest.mark.parametrize("rule", ["max", "add"])
def test_gradient_by_a_placement(field, rule):
    composed = scene(field, rule)
    rays_o, rays_d = rays(composed)

    def picture(one, other):
        return render_rays(composed, rays_o, rays_d, poses={"one": one, "other": other}, step=STEP)

    poses = [matrix(composed, name).clone().requires_grad_() for name in ("one", "other")]
    assert torch.autograd.gradcheck(picture, poses, **CHECK)
    picture(*poses)[:, :4].sum().backward()
    assert all((pose.grad[:3].abs() > 1e-6).all() and not pose.grad[3].any() for pose in poses)


def test_gradient_by_the_numbers_of_a_placed_field(field):
    place = affine(turn(20) @ np.diag([1.1, 0.9, -1]), (0.2, 0, 0))
    rays_o, rays_d = (torch.from_numpy(x) for x in rays_at(Placed("one", field, place).aabb, 6))

    def picture(params):
        return render_rays(Placed("one", field.with_params(params), place), rays_o, rays_d, step=STEP)

    params = field.params.clone().requires_grad_()
    assert torch.autograd.gradcheck(picture, params, **CHECK)
    picture(params).sum().backward()
    assert (params.grad != 0).sum() > 50


@pytest.mark.parametrize("rule", ["max", "add"])
def test_gradient_through_opacity_and_tint(rule):
    """By placements, numbers and rays of a scene whose instances are shown fainter, or denser, and tinted."""
    plain = scene(random_vm(), rule)
    shown = [(0.4, (0.2, 1.0, 0.5)), (1.7, (0.9, 0.3, 0.0))]
    composed = ComposedField(
        [
            replace(p, opacity=opacity, tint=tint)
            for p, (opacity, tint) in zip(plain.placed, shown, strict=True)
        ],
        rule,
        np.zeros(3),
    )
    rays_o, rays_d = rays(composed)

    def picture(one, other, params, origins):
        placed = [replace(composed.placed[0], field=composed.placed[0].field.with_params(params))]
        now = ComposedField([*placed, composed.placed[1]], rule, np.zeros(3))
        return render_rays(now, origins, rays_d, poses={"one": one, "other": other}, step=STEP)

    leaves = [matrix(composed, name) for name in ("one", "other")]
    leaves = [x.clone().requires_grad_() for x in (*leaves, composed.placed[0].field.params, rays_o)]
    assert torch.autograd.gradcheck(picture, leaves, **CHECK)
    found = picture(*leaves)
    found[:, :4].sum().backward()
    assert (leaves[2].grad != 0).sum() > 50 and all((x.grad.abs() > 1e-6).any() for x in leaves)
    assert (found.detach() - render_rays(plain, rays_o, rays_d, step=STEP)).abs().max() > 0.05


def test_a_frame_of_another_size_has_near_and_step_in_units_of_the_world():
    """Also where the scene was composed in another frame than that in which it is said to lie."""
    composed, size = scene(random_vm()), 4.0
    rays_o, rays_d = rays(composed)
    rays_o.requires_grad_()
    here = render_rays(composed, rays_o, rays_d, near=2.3, step=STEP).detach()
    origin = affine(size, (10, -20, 30))
    world = rays_o.detach() * size + torch.from_numpy(origin[:3, 3])
    there = render_rays(
        composed, world.requires_grad_(), rays_d, origin=origin, near=2.3 * size, step=STEP * size
    ).detach()
    torch.testing.assert_close(there[:, :4], here[:, :4], rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(there[:, 4], size * here[:, 4], rtol=1e-6, atol=1e-6)
    assert not torch.equal(here, render_rays(composed, rays_o, rays_d, step=STEP).detach())


def test_gradient_by_the_rays(field):
    leaves = [x.requires_grad_() for x in rays(field)]
    assert torch.autograd.gradcheck(lambda o, d: render_rays(field, o, d, step=STEP), leaves, **CHECK)


def test_pictures_are_those_of_the_one_pass_renderer(field):
    """But for the colours of the lightest samples, and that one takes fewer samples in coarse blocks and
    bricks."""
    rays_o, rays_d = rays(field, 100)
    step = 0.1 * field.voxel_size
    fast = render_rays(field, rays_o, rays_d, step=step)
    wanted = volume.render_rays(field, rays_o.numpy(), rays_d.numpy(), step=step)
    assert torch.equal(fast, torch.from_numpy(wanted))
    found = render_rays(field, rays_o.clone().requires_grad_(), rays_d, step=step)
    assert found.requires_grad and 0.1 < found[:, 3].mean() < 0.999
    apart = (found.detach().float() - fast)[:, :4].abs()
    assert apart.max() < 0.05 and apart.mean() < 2e-3


@pytest.mark.parametrize("rule", ["max", "add"])
def test_a_composed_picture_is_the_general_renderer_s(field, rule):
    composed = scene(field, rule)
    rays_o, rays_d = rays(composed, 60)
    every = {"step": STEP, "early_stop": 0.0}
    wanted = render_rays(composed, rays_o, rays_d, **every)
    found = render_rays(composed, rays_o, rays_d.clone().requires_grad_(), **every).detach().float()
    assert 0.1 < found[:, 3].mean() < 0.999
    torch.testing.assert_close(found, wanted, rtol=0, atol=1e-4)
    moved = {"one": rigid_motion(torch.tensor([0.1, 0, 0, 0.3, 0, 0.0]).double()) @ matrix(composed, "one")}
    elsewhere = render_rays(composed, rays_o, rays_d, poses=moved, **every)
    again = {name: pose.clone().requires_grad_() for name, pose in moved.items()}
    found = render_rays(composed, rays_o, rays_d, poses=again, **every).detach().float()
    torch.testing.assert_close(found, elsewhere, rtol=0, atol=1e-4)
    assert (elsewhere - wanted).abs().max() > 0.1
    fresh = ComposedField(
        [Placed(p.name, p.field, np.asarray(moved.get(p.name, p.object_to_world))) for p in composed.placed],
        rule,
    )
    shift = torch.from_numpy(fresh.origin)
    torch.testing.assert_close(
        render_rays(fresh, rays_o - shift, rays_d, step=STEP / 8),
        render_rays(composed, rays_o, rays_d, poses=moved, step=STEP / 8),
        rtol=0,
        atol=0.02,
    )


def test_where_there_are_no_compiled_loops_pictures_are_equal(field, monkeypatch):
    rays_o, rays_d = rays(field, 30)
    leaf = rays_o.clone().requires_grad_()
    wanted = render_rays(field, leaf, rays_d, step=STEP, early_stop=0.0).detach()
    monkeypatch.setattr(kernels, "device_loops", lambda device: None)
    monkeypatch.setattr(ComputedField, "loops", None)
    slow = field.with_params(field.params)
    found = render_rays(slow, rays_o, rays_d, step=STEP, early_stop=0.0)
    torch.testing.assert_close(found.double(), wanted, rtol=0, atol=1e-4)
    leaf = rays_o.clone().requires_grad_()
    found = render_rays(slow, leaf, rays_d, step=STEP, early_stop=0.0).detach()
    torch.testing.assert_close(found, wanted, rtol=1e-6, atol=1e-6)


def test_cameras_see_along_their_own_rays():
    lens = (0.1, -0.05, 0.01, 0.002, -0.003)
    plain = framing_camera(np.array([-1.0, -1, -1, 1, 1, 1]), 0.3, 0.5, 5, 4)
    bent = Camera(plain.camera_to_world, plain.fl_x, plain.fl_y, plain.cx, plain.cy, 5, 4, lens)
    for camera in (plain, bent):
        for found, wanted in zip(camera_rays(camera), camera.rays(), strict=True):
            np.testing.assert_allclose(found.numpy(), wanted, atol=1e-14)


def test_a_picture_is_the_one_pass_renderer_s(field):
    camera = framing_camera(field.aabb, 0.7, 0.4, 20, 16)
    wanted = volume.render_image(field, camera, step=STEP)
    found = render_image(field, camera, step=STEP)
    for name in ("rgb", "opacity", "depth"):
        np.testing.assert_allclose(getattr(found, name), getattr(wanted, name), rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(found.over((1, 0.5, 0)), wanted.over((1, 0.5, 0)), atol=1e-6)
    origin = np.array([100.0, -50, 3])
    pose = torch.from_numpy(camera.camera_to_world.copy())
    pose[:3, 3] += torch.from_numpy(origin)
    far = render_image(field, camera, pose=pose, origin=origin, step=STEP)
    np.testing.assert_allclose(far.opacity, wanted.opacity, atol=1e-3)


def test_weights_of_packed_samples_are_a_loop_s_and_differentiable():
    ray = torch.tensor([0, 0, 0, 2, 2, 4])
    depth = torch.tensor([0.1, 2.0, 0.0, 30.0, 1.0, 0.5], dtype=torch.float64, requires_grad=True)
    trans = torch.ones(5, dtype=torch.float64)
    for i, weight in enumerate(composite(depth.detach(), ray, 5)):
        alpha = 1 - torch.exp(-depth[i].detach())
        assert float(weight) == pytest.approx(float(trans[ray[i]] * alpha), abs=1e-14)
        trans[ray[i]] *= 1 - alpha
    assert torch.autograd.gradcheck(lambda d: composite(d, ray, 5), depth)


def test_numbers_that_an_optimiser_moved_are_shown_as_they_are_asked(field):
    """Also those that follow from others, which the optimiser knows nothing of."""
    rays_o, rays_d = rays(field, 40)
    field.params.requires_grad_()
    with torch.no_grad():
        field.params += torch.randn(field.params.shape, generator=torch.Generator().manual_seed(1))
        followed, stale = (field.with_params(field.params.detach().clone()) for _ in range(2))
        followed.settle()
        shown, wanted, torn = (render_rays(f, rays_o, rays_d, step=STEP) for f in (field, followed, stale))
    assert torch.equal(shown, wanted)
    assert torch.equal(torn, wanted) == all(low == high for low, high in field.dependent())


def test_rays_that_hit_nothing_are_black_and_have_no_gradient(field):
    rays_o, rays_d = rays(field)
    leaf = field.params.clone().requires_grad_()
    found = render_rays(field.with_params(leaf), rays_o, -rays_d)
    found.sum().backward()
    assert not found.any() and not leaf.grad.any()


def test_what_cannot_be_done_is_said():
    field = random_vm()
    composed = ComposedField([Placed("one", field, np.eye(4))])
    rays_o, rays_d = rays(field)
    with pytest.raises(ValueError, match="no 'chair' to place; this scene places 'one'"):
        render_rays(composed, rays_o, rays_d, poses={"chair": torch.eye(4)})
    for placed, known in ((composed.placed[0], "'one'"), (field, "nothing")):
        with pytest.raises(ValueError, match=f"no 'chair' to place; this scene places {known}"):
            render_rays(placed, rays_o, rays_d, poses={"chair": torch.eye(4)})
    with pytest.raises(ValueError, match="'one' is singular"):
        render_rays(composed, rays_o, rays_d, poses={"one": torch.diag(torch.tensor([1.0, 1, 0, 1]))})
    with pytest.raises(ValueError, match="ray 0 has no direction"):
        render_rays(field, rays_o.requires_grad_(), 0 * rays_d)
    with pytest.raises(ValueError, match="'analytic' have no reference"):
        render_rays(Gaussian(), rays_o, rays_d)
