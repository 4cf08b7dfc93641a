"""The truths themselves: closed depths and pixels against brute-force integration, exports against what they
export."""

import numpy as np
import pytest
import torch

from tests.analytic import scenes
from tests.analytic.export import EXPORTERS, NotExportable, exported
from tests.analytic.fields import Ball, Box, Gaussian, Slab, Tint
from tests.analytic.rays import points_in, rays_at, unit
from tests.bundles import field_kinds

SCENES = {
    "S1": scenes.s1_slabs(0.7, 2.0),
    "S1 through": scenes.s1_slabs(0.7, 2.0, overlap=True),
    "S2": scenes.s2_blobs(4.0),
    "S4": scenes.s4_twins(0.5, 3.0),
    "S5": scenes.s5_comb(0.5, count=2, wires=True),
    "S6": scenes.s6_room(),
    "S8": scenes.s8_boxes(8, 30),
    "S10": scenes.s10_chain(4)[0],
}
AROUND = np.array([-1.5, -1.5, -1.0, 1.5, 1.5, 1.0])


def summed(scene, rays_o, rays_d, rule, reach=40.0, samples=8_000):
    """(N, 4) pixels by brute force."""
    t = (np.arange(samples) + 0.5) / samples * reach
    out = []
    for o, d in zip(rays_o, rays_d, strict=True):
        sigma, rgb = scene.answer(o + t[:, None] * d, np.tile(d, (samples, 1)), rule)
        through = np.exp(-np.cumsum(sigma) * reach / samples)
        weights = np.concatenate([[1.0], through[:-1]]) - through
        out.append([*(weights[:, None] * rgb).sum(0), weights.sum()])
    return np.array(out)


@pytest.mark.parametrize("rule", ["max", "add"])
@pytest.mark.parametrize("name", ["S1", "S1 through", "S4", "S6", "S8"])
def test_pixels_are_the_volume_integral(name, rule):
    rays_o, rays_d = rays_at(AROUND, 3, seed=2, away=6.0)
    np.testing.assert_allclose(
        SCENES[name].pixels(rays_o, rays_d, rule), summed(SCENES[name], rays_o, rays_d, rule), atol=0.05
    )


def test_a_slab_dims_by_its_angle():
    """exp(-τ / cos θ), by hand."""
    angle = 0.6
    d = np.array([[np.cos(angle), np.sin(angle), 0.0]])
    found = scenes.s1_slabs(0.7, 2.0).pixels(-6 * d, d)
    assert found[0, 3] == pytest.approx(1 - np.exp(-2.7 / np.cos(angle)), rel=1e-12)


@pytest.mark.parametrize("name", SCENES)
def test_depths_are_the_integral_of_sigma(name):
    scene = SCENES[name]
    centre = scene.parts[0].object_to_world[:3, 3]
    rays_o, rays_d = rays_at(AROUND + np.tile(centre, 2), 4, seed=4, away=5.0)
    t = (np.arange(10_000) + 0.5) / 10_000 * 14.0
    for o, d, depth in zip(rays_o, rays_d, scene.depths(rays_o, rays_d).T, strict=True):
        sigmas = scene.sigmas(o + t[:, None] * d, np.tile(d, (len(t), 1)))
        spread = sigmas.max(1) * 14.0 / 10_000  # a face lies somewhere in a sample
        assert (np.abs(sigmas.sum(1) * 14.0 / 10_000 - depth) <= 2 * spread + 1e-6).all()


FIELDS = {
    "box": Box(3.0, (0.5, 0.4, 0.3), tint=Tint.of(0.2, 0.5, 0.9)),
    "noisy": Box(3.0, 0.5, noise=0.02, tint=scenes.RED),
    "slab": Slab(tint=scenes.GREEN),
    "blob": Gaussian(tint=scenes.SAND),
    "cube": scenes.s3_cube(1).parts[0].field,
    "banded": scenes.s3_cube(2).parts[0].field,
}


@pytest.mark.parametrize("kind", sorted(EXPORTERS))
@pytest.mark.parametrize("name", FIELDS)
def test_exports_answer_as_what_they_export(name, kind):
    field = FIELDS[name]
    if (name, kind) == ("banded", "vm-mlp"):
        with pytest.raises(NotExportable, match="degree 2"):
            exported(field, kind)
        return
    found = exported(field, kind, resolution=(64,) * 3 if name == "blob" else (16,) * 3)
    points = points_in(field.matter, 4000, seed=1)
    dirs = unit(points_in(field.matter, 4000, seed=2))
    sigma, rgb = found.query(torch.from_numpy(points), torch.from_numpy(dirs))
    loose = 0.02 if name == "blob" else 2e-6  # a parabola between texels
    np.testing.assert_allclose(sigma, field.sigma(points), rtol=loose, atol=1e-6)
    np.testing.assert_allclose(rgb, field.colour(points, dirs), atol=3e-6)


def test_noise_swings_by_its_share():
    points = points_in(FIELDS["noisy"].aabb, 20_000)
    swing = FIELDS["noisy"].sigma(points) / 3.0 - 1
    assert 0.015 < swing.max() < 0.021 and -0.021 < swing.min() < -0.015


def test_every_stored_kind_is_told_of():
    """A kind without an exporter names itself, and one that cannot hold a field says why."""
    assert set(EXPORTERS) <= set(field_kinds())
    with pytest.raises(NotExportable, match="'marble'"):
        exported(FIELDS["box"], "marble")
    with pytest.raises(NotExportable, match="Ball"):
        exported(Ball(), "vm")


def test_equal_fields_are_exported_once():
    placed = scenes.s5_comb(0.5).placed("vm")
    assert len(placed) == 8 and len({id(p.field) for p in placed}) == 1
