"""The vm-mlp field: its network against a slow loop, storage, general rendering, gradients, a tiny fit."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from fusedrf_cli.engine.decoders import mlp
from fusedrf_cli.engine.distillation.config import TrainConfig
from fusedrf_cli.engine.distillation.fit import FitRun, fit
from fusedrf_cli.engine.distillation.optimiser import Adam
from fusedrf_cli.engine.encodings import plane_line
from fusedrf_cli.engine.fields.base import RadianceField
from fusedrf_cli.engine.fields.computed import Batch
from fusedrf_cli.engine.fields.occupancy import OccupancyGrid
from fusedrf_cli.engine.kernels import loops
from fusedrf_cli.engine.kinds.vm.field import VMConfig
from fusedrf_cli.engine.kinds.vm.trimming import reshaped
from fusedrf_cli.engine.kinds.vm_mlp.field import VMMLPField
from fusedrf_cli.engine.rendering.cameras import orbit
from fusedrf_cli.engine.rendering.metrics import psnr
from fusedrf_cli.engine.rendering.volume import reach_of, render_image
from tests.analytic.export import way_of
from tests.bundles import field_kinds

from ..conftest import BOX, SIXTY_FOUR, THIRTY_TWO, Ball, points_in, random_vm, rays_at, unit
from .cases import random_vm_mlp as random_field


def slow_colour(field, point: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """rgb (3,) at one point, one neuron after the other."""
    box = field.box
    inside = (point - box[:3]) / (box[3:] - box[:3])
    factors = field.slot_sections()["colour"]
    products = plane_line.reference(None, factors, torch.from_numpy(inside[None]), None, 16)[0].numpy()
    x = [*(float(row @ products) for row in field.basis.numpy()), *direction]
    values = x + [np.sin(f * v) for f in (1, 2) for v in x] + [np.cos(f * v) for f in (1, 2) for v in x]
    for i in range(3):
        weights, bias = field.weights[f"{i}.weight"].numpy(), field.weights[f"{i}.bias"].numpy()
        values = [float(np.dot(w, values) + b) for w, b in zip(weights, bias, strict=True)]
        values = [max(v, 0.0) for v in values] if i < 2 else values
    return 1 / (1 + np.exp(-np.array(values)))


def test_is_a_stored_field_kind():
    assert field_kinds()["vm-mlp"] is VMMLPField
    assert isinstance(random_field(), RadianceField)


def test_query_equals_a_slow_loop():
    field = random_field().with_occupancy(OccupancyGrid.full(BOX))
    points = torch.from_numpy(points_in(BOX, 20, margin=0.05))
    dirs = torch.from_numpy(unit(points_in(np.array([-1.0] * 3 + [1.0] * 3), 20, seed=5)))
    sigma, rgb = field.query(points, dirs)
    alone = reshaped(random_vm(replace(SIXTY_FOUR, sh_degree=2)), SIXTY_FOUR).query(points, dirs)[0]
    torch.testing.assert_close(sigma, alone, rtol=1e-12, atol=0)
    for i in range(20):
        expected = slow_colour(field, points[i].numpy(), dirs[i].numpy()) if sigma[i] > 0 else np.zeros(3)
        np.testing.assert_allclose(rgb[i], expected, atol=1e-9)
    assert not field.query(points, dirs, with_colour=False)[1].any()


def test_state_round_trip():
    field = random_field(torch.float32)
    field = field.with_occupancy(random_vm(cells=4).occupancy)
    arrays, metadata = field.state()
    again = VMMLPField.from_state({name: a.copy() for name, a in arrays.items()}, metadata)
    points = torch.from_numpy(points_in(BOX, 200))
    dirs = torch.from_numpy(unit(points_in(BOX, 200, seed=2)))
    for a, b in zip(field.query(points, dirs), again.query(points, dirs), strict=True):
        assert torch.equal(a, b) and (a > 0).any() and (a == 0).any()
    assert all(map(torch.equal, field.weights.values(), again.weights.values()))


@pytest.mark.parametrize(
    "name", ["network.0.bias", "network.1.weight", "network.2.bias", "tensor_0.colour_basis"]
)
def test_an_array_that_does_not_fit_is_named(name):
    arrays, metadata = random_field(torch.float32).state()
    without = {key: a for key, a in arrays.items() if key != name}
    for bad in (without, without | {name: np.zeros((2, 2), np.float32)}):
        with pytest.raises(ValueError, match=name):
            VMMLPField.from_state(bad, metadata)


def test_what_a_vm_field_may_be_and_this_not_is_refused():
    arrays, metadata = random_field(torch.float32).state()
    (tensor,), (block,) = metadata["tensors"], metadata["blocks"]
    for change, said in (
        ({"blocks": [block, block]}, "found 1 and 2"),
        (
            {"blocks": [block | {"object_to_field": np.diag([2.0, 1, 1, 1]).tolist()}]},
            "place it as it is",
        ),
        ({"tensors": [tensor | {"hashed": {"spacings": [0.1], "rows": 64}}]}, "no hash grid"),
    ):
        with pytest.raises(ValueError, match=said):
            VMMLPField.from_state(arrays, metadata | change)


def test_the_name_of_what_it_is_stays():
    field = random_field(torch.float32)
    field.name = "lamp"
    arrays, metadata = field.resampled(BOX, (6, 6, 6)).state()
    assert metadata["blocks"][0]["name"] == "lamp" and VMMLPField.from_state(arrays, metadata).name == "lamp"


def test_resampling_keeps_the_network_and_the_basis():
    field = random_field(torch.float32)
    box = BOX + np.array([0.1, 0.1, 0.1, -0.1, -0.1, -0.1])
    new = field.resampled(box, (9, 10, 11))
    assert new.resolution == (9, 10, 11) and torch.equal(new.basis, field.basis)
    for other in (new, new.with_occupancy(OccupancyGrid.full(box))):
        assert all(map(torch.equal, field.weights.values(), other.weights.values()))


def test_rendering_equals_a_slow_loop():
    """Samples too light to be shaded take the colour of the next that is, at the end that of the last."""
    field = random_field(cells=4)
    rays_o, rays_d = rays_at(BOX, 12)
    step = 0.07
    found = np.zeros((12, 5))
    field.render_rays(rays_o, rays_d, reach_of(len(found), 0.0, np.inf), step, 0.0, found)
    assert found[:, 3].max() > 0.5
    for ray in range(12):
        o, d, trans, rgb, waiting = rays_o[ray], rays_d[ray], 1.0, np.zeros(3), 0.0
        shown, enough = np.zeros(3), loops.COLOUR_FROM
        faces = np.stack([(BOX[:3] - o) / d, (BOX[3:] - o) / d])
        start, end = faces.min(0).max(), faces.max(0).min()
        for t in np.arange(start + 0.5 * step, end, step):
            point = torch.from_numpy((o + t * d)[None])
            sigma, colour = field.query(point, torch.from_numpy(d[None]))
            weight = trans * (1 - np.exp(-float(sigma[0]) * step))
            trans -= weight
            waiting += weight
            if waiting > enough:
                shown, enough = colour[0].numpy(), loops.SHARED_COLOUR_FROM
                rgb += waiting * shown
                waiting = 0.0
        rgb += waiting * shown
        np.testing.assert_allclose(found[ray, :4], [*rgb, 1 - trans], rtol=1e-9, atol=1e-12)


def batch_at(field, count=24) -> Batch:
    """Rays at a field with random targets; they never stop early, since the loss jumps where one does."""
    rng = np.random.default_rng(1)
    rays_o, rays_d = rays_at(BOX, count)
    target, background = rng.random((count, 4)), rng.random((count, 3))
    return Batch(rays_o, rays_d, rng.random(count), target, background, 0.3, 0.0, 0.11, -1.0)


def trained(field, batch) -> tuple[np.ndarray, np.ndarray]:
    """Gradient (P,) and sums (3,) of a batch."""
    grads, loss = np.zeros((2, field.params.numel()), field.real), np.zeros((2, 3))
    field.train_rays(batch, grads, loss)
    return grads.sum(0), loss.sum(0)


@pytest.fixture
def every_sample(monkeypatch):
    """All samples are shaded: the loss jumps where a weight crosses the threshold."""
    sizes = mlp.sizes
    monkeypatch.setattr(mlp, "sizes", lambda **options: sizes(**options) | {"LEARN_FROM": 0.0})


@pytest.mark.parametrize("seed", range(3))
def test_gradients_of_pictures_are_finite_differences(seed, every_sample):
    field = random_field(seed=seed, cells=4)
    batch = batch_at(field)
    gradient, _ = trained(field, batch)
    gradient = torch.from_numpy(gradient)
    generator = torch.Generator().manual_seed(seed)

    def loss() -> float:
        sums = trained(field, batch)[1]
        return (sums[0] + batch.opacity_weight * sums[1]) / len(batch.rays_o)

    for group in field.groups():
        values, sent = field.params[group.low : group.high], gradient[group.low : group.high]
        along = torch.randn(values.shape, generator=generator, dtype=torch.float64) * (sent != 0)
        step, losses = 1e-6, []
        for sign in (1, -2):
            values += sign * step * along
            losses.append(loss())
        values += step * along
        assert float((sent * along).sum()) == pytest.approx(
            (losses[0] - losses[1]) / (2 * step), rel=1e-4, abs=1e-7
        )


def test_gradients_of_answers_are_finite_differences():
    field = random_field(cells=4)
    rng = np.random.default_rng(3)
    points, dirs = torch.from_numpy(points_in(BOX, 40)), torch.from_numpy(unit(rng.normal(size=(40, 3))))
    d_sigma, d_rgb = torch.from_numpy(rng.normal(size=40)), torch.from_numpy(rng.normal(size=(40, 3)))
    grads = np.zeros((2, field.params.numel()))
    field.query_backward(points, dirs, d_sigma, d_rgb, grads)
    along = torch.from_numpy(rng.normal(size=field.params.numel()) * (grads.sum(0) != 0))
    values = []
    for sign in (1, -2):
        field.params += sign * 1e-6 * along
        sigma, rgb = field.query(points, dirs)
        values.append(float((sigma * d_sigma).sum() + (rgb * d_rgb).sum()))
    assert float(torch.from_numpy(grads.sum(0)) @ along) == pytest.approx(
        (values[0] - values[1]) / 2e-6, rel=1e-5
    )


def test_what_fills_a_layer_up_stays_zero(every_sample):
    """A width that is no multiple of 8: training moves the weights and nothing beside them."""
    field = random_field(width=5)
    views = list(field.weights.values())
    inside = torch.zeros_like(field.params)
    other = field.with_params(inside)
    for view in other.weights.values():
        view += 1
    start = int(field.starts[13])
    assert sum(view.numel() for view in views) == int(inside[start:].sum())
    optimiser, before = Adam(field, 2), field.params.clone()
    batch = batch_at(field)
    for _ in range(3):
        field.train_rays(batch, optimiser.grads, np.zeros((2, 3)))
        optimiser.step(0.1)
    assert (field.params != before)[start:].float().mean() > 0.3
    assert not field.params[start:][inside[start:] == 0].any()


def test_the_network_learns_at_a_rate_of_its_own():
    field = random_field(torch.float32)
    factors, basis, network = field.groups()
    assert (factors.rate, basis.rate) == (1.0, VMConfig.basis_rate) and network.rate == pytest.approx(
        VMConfig.basis_rate / 3
    )
    assert (factors.low, basis.low, network.low) == (0, field.starts[12], field.starts[13])
    assert network.high == field.params.numel() and network.low % 16 == network.high % 16 == 0


def test_rays_that_meet_nothing_teach_nothing(every_sample):
    field = random_field()
    batch = batch_at(field)._replace(rays_d=-batch_at(field).rays_d)
    gradient, sums = trained(field, batch)
    assert np.isfinite(sums).all() and sums[2] == 0 and not gradient.any()


def pictures_of_a_ball(count: int, size: int):
    """Cameras around a ball and its pictures (count, size, size, 4) uint8, straight alpha."""
    cameras, images = orbit(BOX, count, size, size), []
    for camera in cameras:
        shown = render_image(Ball(density=20.0), camera)
        alpha = shown.opacity[..., None]
        straight = np.where(alpha > 0, shown.rgb / np.maximum(alpha, 1e-6), 0)
        images.append(np.round(np.concatenate([straight, alpha], -1) * 255).astype(np.uint8))
    return cameras, np.stack(images)


@pytest.mark.slow
def test_a_tiny_fit_learns_a_ball():
    cameras, images = pictures_of_a_ball(10, 40)
    settings = TrainConfig("vm-mlp", way_of(THIRTY_TWO), longest=32, steps=150, samples=1 << 14)
    field = fit(cameras[1:], images[1:], BOX, settings)
    assert isinstance(field, VMMLPField)
    alpha = images[0, ..., 3:] / 255
    truth = images[0, ..., :3] / 255 * alpha + 1 - alpha
    shown = psnr(render_image(field, cameras[0]).over((1, 1, 1)), truth)
    blank = psnr(np.ones_like(truth), truth)
    assert shown > max(24, blank + 6)


@pytest.mark.slow
def test_a_fit_taken_up_from_a_checkpoint_goes_on_as_before():
    cameras, images = pictures_of_a_ball(3, 24)
    settings = TrainConfig("vm-mlp", way_of(THIRTY_TWO), longest=24, steps=40, samples=1 << 11)
    whole, again = (FitRun.start(cameras, images, BOX, settings, "") for _ in range(2))
    for _ in range(3):
        whole.step(0.0)
    again.restore(*whole.checkpoint())
    for run in (whole, again):
        run.step(0.1)
    expected, found = whole.checkpoint()[0], again.checkpoint()[0]
    assert expected.keys() == found.keys()
    for name in expected:
        np.testing.assert_array_equal(found[name], expected[name], name)
