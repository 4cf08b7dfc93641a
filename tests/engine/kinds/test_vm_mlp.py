"""The vm-mlp field: its network against a slow loop, storage, general rendering, gradients, a tiny fit."""

import numpy as np
import pytest
import torch

from fusedrf_cli.engine.distillation import passes
from fusedrf_cli.engine.distillation.fit import FitRun, FitSettings, fit
from fusedrf_cli.engine.distillation.passes import Batch, PackedPass, composite
from fusedrf_cli.engine.fields.base import RadianceField
from fusedrf_cli.engine.fields.occupancy import OccupancyGrid
from fusedrf_cli.engine.kernels import autograd, bodies
from fusedrf_cli.engine.kinds.registry import field_kinds
from fusedrf_cli.engine.kinds.vm_mlp.field import ColourNetwork, Encoding, VMMLPField
from fusedrf_cli.engine.rendering.cameras import orbit
from fusedrf_cli.engine.rendering.metrics import psnr
from fusedrf_cli.engine.rendering.volume import render_image, render_rays

from ..conftest import BOX, SIXTY_FOUR, THIRTY_TWO, Ball, points_in, random_vm, rays_at, unit


def random_field(
    dtype=torch.float64, seed=0, cells=None, matrix=None, shape=SIXTY_FOUR, width=8
) -> VMMLPField:
    """A vm-mlp field of random numbers whose colours differ."""
    shape = type(shape)(shape.density_rank, shape.colour_rank, 2)
    generator = torch.Generator().manual_seed(seed)
    factors = random_vm(shape, dtype=dtype, seed=seed, cells=cells, matrix=matrix)
    return VMMLPField(factors, ColourNetwork(27, width, generator).to(dtype))


def slow_colour(field, point: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """rgb (3,) at one point, one neuron after the other."""
    products = autograd.features(field, field.params, torch.from_numpy(point[None]))[0].numpy()
    x = [float(row @ products) for row in field.basis.numpy()]
    local = field.arrays.to_object[0] @ direction
    local = local / np.linalg.norm(local)
    x = [*x, *local]
    values = x + [np.sin(f * v) for f in (1, 2) for v in x] + [np.cos(f * v) for f in (1, 2) for v in x]
    for i, layer in enumerate(field.network.layers):
        weights, bias = layer.weight.detach().numpy(), layer.bias.detach().numpy()
        values = [float(np.dot(w, values) + b) for w, b in zip(weights, bias, strict=True)]
        values = [max(v, 0.0) for v in values] if i < 2 else values
    return 1 / (1 + np.exp(-np.array(values)))


def test_is_a_stored_field_kind_without_a_fused_renderer():
    assert field_kinds()["vm-mlp"] is VMMLPField
    assert isinstance(random_field(), RadianceField)
    assert not hasattr(VMMLPField, "render_rays")


def test_encoding_and_its_gradient():
    x = torch.randn(5, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1), requires_grad=True)
    expected = torch.cat([x, x.sin(), (2 * x).sin(), x.cos(), (2 * x).cos()], 1)
    torch.testing.assert_close(Encoding.apply(x), expected)
    assert torch.autograd.gradcheck(Encoding.apply, x)


@pytest.mark.parametrize("matrix", [None, np.diag([2.0, -1.5, 0.5, 1.0])])
def test_query_equals_a_slow_loop(matrix):
    field = random_field(matrix=matrix)
    low, high = (
        BOX[:3] * np.diag(field.blocks[0].object_to_field)[:3],
        BOX[3:] * np.diag(field.blocks[0].object_to_field)[:3],
    )
    box = np.concatenate([np.minimum(low, high), np.maximum(low, high)])
    field = VMMLPField(field.factors, field.network)
    field.factors.occupancy = OccupancyGrid.full(box)
    points, dirs = (
        points_in(box, 20, margin=0.05),
        unit(points_in(np.array([-1.0] * 3 + [1.0] * 3), 20, seed=5)),
    )
    sigma, rgb = field.query(torch.from_numpy(points), torch.from_numpy(dirs))
    assert torch.equal(sigma, field.factors.query(torch.from_numpy(points), torch.from_numpy(dirs))[0])
    for i in range(20):
        expected = slow_colour(field, points[i], dirs[i]) if sigma[i] > 0 else np.zeros(3)
        np.testing.assert_allclose(rgb[i], expected, atol=1e-9)
    assert not field.query(torch.from_numpy(points), torch.from_numpy(dirs), with_colour=False)[1].any()


def test_state_round_trip():
    field = random_field(torch.float32)
    field = field.with_occupancy(random_vm(cells=4).occupancy)
    arrays, metadata = field.state()
    again = VMMLPField.from_state({name: a.copy() for name, a in arrays.items()}, metadata)
    points = torch.from_numpy(points_in(BOX, 200))
    dirs = torch.from_numpy(unit(points_in(BOX, 200, seed=2)))
    for a, b in zip(field.query(points, dirs), again.query(points, dirs), strict=True):
        assert torch.equal(a, b) and (a > 0).any() and (a == 0).any()
    for a, b in zip(field.network.parameters(), again.network.parameters(), strict=True):
        assert torch.equal(a, b)


@pytest.mark.parametrize(
    "name", ["network.0.bias", "network.1.weight", "network.2.bias", "tensor_0.colour_basis"]
)
def test_an_array_that_does_not_fit_is_named(name):
    arrays, metadata = random_field(torch.float32).state()
    without = {key: a for key, a in arrays.items() if key != name}
    for bad in (without, without | {name: np.zeros((2, 2), np.float32)}):
        with pytest.raises(ValueError, match=name):
            VMMLPField.from_state(bad, metadata)


def test_several_blocks_are_refused():
    field = random_vm()
    field.blocks = field.blocks * 2
    with pytest.raises(ValueError, match="one block, found 2"):
        VMMLPField(field, ColourNetwork(27))


def test_resampling_keeps_the_network_and_the_basis():
    field = random_field(torch.float32)
    box = BOX + np.array([0.1, 0.1, 0.1, -0.1, -0.1, -0.1])
    new = field.resampled(box, (9, 10, 11))
    assert new.network is field.network and torch.equal(new.basis, field.basis)
    assert new.tensors[0].resolution == (9, 10, 11)
    assert new.with_occupancy(OccupancyGrid.full(box)).network is field.network


def test_rendering_equals_a_slow_loop():
    field = random_field(cells=4)
    rays_o, rays_d = rays_at(BOX, 12)
    step = 0.07
    found = render_rays(field, rays_o, rays_d, step=step, early_stop=0.0)
    assert np.isfinite(found).all() and found[:, 3].max() > 0.5
    for ray in range(12):
        o, d, trans, rgb = rays_o[ray], rays_d[ray], 1.0, np.zeros(3)
        faces = np.stack([(BOX[:3] - o) / d, (BOX[3:] - o) / d])
        start, end = faces.min(0).max(), faces.max(0).min()
        for t in np.arange(start + 0.5 * step, end, step):
            point = torch.from_numpy((o + t * d)[None])
            sigma, colour = field.query(point, torch.from_numpy(d[None]))
            weight = trans * (1 - np.exp(-float(sigma[0]) * step))
            trans -= weight
            rgb += weight * colour[0].numpy() * (weight > bodies.COLOUR_FROM)
        np.testing.assert_allclose(found[ray, :4], [*rgb, 1 - trans], atol=2e-5)


def test_composite_of_packed_samples_equals_a_loop_and_its_gradient():
    ray = torch.tensor([0, 0, 0, 2, 2, 4])
    depth = torch.tensor([0.1, 2.0, 0.0, 30.0, 1.0, 0.5], dtype=torch.float64, requires_grad=True)
    weights, opacity = composite(depth.detach(), ray, 5)
    trans = torch.ones(5, dtype=torch.float64)
    for i, r in enumerate(ray):
        assert float(weights[i]) == pytest.approx(
            float(trans[r] * (1 - torch.exp(-depth.detach()[i]))), abs=1e-14
        )
        trans[r] *= torch.exp(-depth[i].detach())
    np.testing.assert_allclose(opacity, 1 - trans, atol=1e-14)
    assert torch.autograd.gradcheck(lambda x: composite(x, ray, 5), depth)


def test_thinned_samples_stand_for_all():
    generator = torch.Generator().manual_seed(2)
    weights = torch.rand(20_000, generator=generator) ** 6 / 20
    ray, jitter = torch.arange(20_000) // 10, torch.rand(2000, generator=generator, dtype=torch.float64)
    seen, share = passes.shaded_samples(weights, ray, jitter)
    assert set(torch.nonzero(weights > 1.001 * passes.THIN_BELOW)[:, 0].tolist()) <= set(seen.tolist())
    assert len(seen) < 0.5 * int((weights > bodies.COLOUR_FROM).sum())
    values = torch.rand(20_000, generator=generator)
    found = ((weights[seen] / share) * values[seen]).sum() / (weights * values).sum()
    assert float(found) == pytest.approx(1, abs=0.03)


def batch_at(field, count=24) -> Batch:
    """Rays at a field with random targets; they never stop early, since the loss jumps where one does."""
    rng = np.random.default_rng(1)
    rays_o, rays_d = rays_at(BOX, count)
    target, background = rng.random((count, 4)), rng.random((count, 3))
    return Batch(rays_o, rays_d, rng.random(count), target, background, 0.3, 0.0, 0.11, -1.0)


def loss_of(field, batch) -> float:
    sums = PackedPass(field).gradient(field, batch, np.zeros((2, field.params.numel())))
    return (sums[0] + batch.opacity_weight * sums[1]) / len(batch.rays_o)


@pytest.mark.parametrize("seed", range(3))
def test_the_whole_pass_s_gradient_against_finite_differences(seed, monkeypatch):
    monkeypatch.setattr(bodies, "COLOUR_FROM", 0.0)  # the loss jumps where a sample crosses it
    monkeypatch.setattr(passes, "THIN_BELOW", 0.0)
    field = random_field(seed=seed, cells=4)
    batch = batch_at(field)
    rows = np.zeros((2, field.params.numel()))
    PackedPass(field).gradient(field, batch, rows)
    generator = torch.Generator().manual_seed(seed)
    weights = list(field.network.parameters())
    for values, gradient in [(field.params, torch.from_numpy(rows.sum(0)))] + [
        (w.data, w.grad.clone()) for w in weights
    ]:
        along = torch.randn(values.shape, generator=generator, dtype=torch.float64)
        step, losses = 1e-6, []
        for sign in (1, -2):
            values += sign * step * along
            losses.append(loss_of(field, batch))
        values += step * along
        assert float((gradient * along).sum()) == pytest.approx(
            (losses[0] - losses[1]) / (2 * step), rel=1e-4, abs=1e-7
        )


def test_a_pass_over_rays_that_hit_nothing():
    field = random_field(torch.float32)
    batch = batch_at(field)._replace(rays_d=-batch_at(field).rays_d)
    batch = batch._replace(
        target=batch.target.astype(np.float32), background=batch.background.astype(np.float32)
    )
    rows = np.zeros((2, field.params.numel()), np.float32)
    sums = PackedPass(field).gradient(field, batch, rows)
    assert np.isfinite(sums).all() and sums[2] == 0 and not rows.any()


def pictures_of_a_ball(count: int, size: int):
    """Cameras around a ball and its pictures (count, size, size, 4) uint8, straight alpha."""
    cameras, images = orbit(BOX, count, size, size), []
    for camera in cameras:
        shown = render_image(Ball(density=20.0), camera)
        alpha = shown.opacity[..., None]
        straight = np.where(alpha > 0, shown.rgb / np.maximum(alpha, 1e-6), 0)
        images.append(np.round(np.concatenate([straight, alpha], -1) * 255).astype(np.uint8))
    return cameras, np.stack(images)


def test_a_tiny_fit_learns_a_ball():
    cameras, images = pictures_of_a_ball(10, 40)
    settings = FitSettings(THIRTY_TWO, longest=32, steps=150, samples=1 << 14, colour="mlp")
    field = fit(cameras[1:], images[1:], BOX, settings)
    assert isinstance(field, VMMLPField)
    alpha = images[0, ..., 3:] / 255
    truth = images[0, ..., :3] / 255 * alpha + 1 - alpha
    shown = psnr(render_image(field, cameras[0]).over((1, 1, 1)), truth)
    blank = psnr(np.ones_like(truth), truth)
    assert shown > max(24, blank + 6)


def test_a_fit_taken_up_from_a_checkpoint_goes_on_as_before():
    cameras, images = pictures_of_a_ball(3, 24)
    settings = FitSettings(THIRTY_TWO, longest=24, steps=40, samples=1 << 11, colour="mlp")
    whole, again = (FitRun.start(cameras, images, BOX, settings, "") for _ in range(2))
    for _ in range(3):
        whole.step(0.0)
    again.restore(*whole.checkpoint())
    for run in (whole, again):
        run.step(0.1)
    expected, found = whole.checkpoint()[0], again.checkpoint()[0]
    assert expected.keys() == found.keys() and "pass.0.exp_avg" in found
    for name in expected.keys() - {"random", "random_of_order"}:
        np.testing.assert_array_equal(found[name], expected[name], name)
