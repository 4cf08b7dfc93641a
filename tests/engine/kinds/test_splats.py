"""Splats as a field: closed forms of single Gaussians, the torch reference, a sorted splatter, placements."""

import numpy as np
import pytest
import torch

from formats.rotations import matrices
from formats.splats.placing import placed
from formats.splats.splats import DOWN_Y, Splats
from fusedrf_cli.engine.composition.affine import Placed
from fusedrf_cli.engine.composition.composed import ComposedField
from fusedrf_cli.engine.composition.composite import Composite
from fusedrf_cli.engine.kinds import registry
from fusedrf_cli.engine.kinds.splats.field import ARRAYS, SplatsField
from fusedrf_cli.engine.rendering.cameras import framing_camera
from fusedrf_cli.engine.rendering.metrics import psnr
from fusedrf_cli.engine.rendering.volume import render_image, render_rays

from ..splats.sorted_splatter import Camera, rendered

THIN = 1e-4
"""Share of a disc's radius that it is thick."""


def splats(count: int, seed: int = 0, bands: int = 4, **given) -> Splats:
    """So many in the unit cube, the first a thin disc; `given` replaces arrays."""
    rng = np.random.default_rng(seed)
    scales = np.exp(rng.uniform(-4, -2, (count, 3)))
    scales[0] = 0.2, 0.1, 0.2 * THIN
    rotations = rng.normal(size=(count, 4))
    arrays = {
        "centres": rng.uniform(-1, 1, (count, 3)), "scales": scales,
        "rotations": rotations / np.linalg.norm(rotations, axis=1, keepdims=True),
        "opacities": rng.uniform(0.02, 1, count), "harmonics": rng.normal(size=(count, bands, 3)) * 0.4,
    } | given  # fmt: skip
    return Splats(**{name: np.asarray(a, np.float32) for name, a in arrays.items()}, kind="made", up=DOWN_Y)


def field_of(these: Splats) -> SplatsField:
    return SplatsField(*(getattr(these, name) for name in ARRAYS))


def unit(values: np.ndarray) -> np.ndarray:
    return values / np.linalg.norm(values, axis=-1, keepdims=True)


@pytest.fixture(scope="module")
def field() -> SplatsField:
    return field_of(splats(60))


def test_it_answers_as_its_reference(field):
    rng = np.random.default_rng(1)
    near = field.centres[rng.integers(len(field.centres), size=500)] + rng.normal(size=(500, 3)) * 0.05
    points = torch.from_numpy(np.clip(near, field.box[:3], field.box[3:] - 1e-9))
    dirs = torch.from_numpy(unit(rng.normal(size=(500, 3))))
    sigma, rgb = field.query(points, dirs)
    expected = field.reference(field.params, points, dirs)
    inside = torch.from_numpy(field.occupancy.contains(points.numpy()))
    halves = [field.reference(field.params, points[i::2], dirs[i::2])[0] for i in (0, 1)]
    torch.testing.assert_close(torch.stack(halves, 1).view(-1), expected[0])
    assert inside.double().mean() > 0.5 and (expected[0] > 0).double().mean() > 0.3
    np.testing.assert_allclose(sigma[inside], expected[0][inside], rtol=2e-3, atol=2e-3 * float(sigma.max()))
    dense = inside & (expected[0] > 0.1)
    np.testing.assert_allclose(rgb[dense], expected[1][dense], atol=5e-3)


@pytest.mark.parametrize("offset", [0.0, 0.31, 0.77])
@pytest.mark.parametrize("thickness", [1.0, 0.05, THIN])
def test_samples_a_step_apart_have_a_splats_whole_depth(offset, thickness):
    """α = o exp(-r²/2) of a splat that a ray passes at r standard deviations, however thin it is and wherever
    the samples lie: the optical depths of samples a step apart add up to -ln(1 - α)."""
    wxyz = unit(np.array([[0.9, 0.1, 0.2, -0.3]]))
    turn = matrices(wxyz[:, [1, 2, 3, 0]])[0]
    scales = np.array([[0.1, 0.1, 0.1 * thickness]])
    one = splats(1, scales=scales, rotations=wxyz, centres=[[0.3, -0.2, 0.1]], opacities=[0.8])
    field = field_of(one)
    middle, d = one.centres[0].astype(float), unit(np.array([0.2, 0.3, 1.0]))
    along = np.arange(-200, 200)[:, None] * field.step + offset * field.step
    for r in (0.0, 1.0, 2.0):
        across = turn @ np.array([r, 0, 0]) * 0.1
        line = torch.from_numpy(middle + across + along * d)
        sigma = field.query(line, torch.from_numpy(np.tile(d, (len(line), 1))), False)[0]
        whitened = (turn.T @ np.stack([across, d], 1)).T / scales
        u, v = whitened
        apart = np.linalg.norm(np.cross(u, v)) / np.linalg.norm(v)
        assert float(sigma.sum()) * field.step == pytest.approx(
            -np.log1p(-0.8 * np.exp(-(apart**2) / 2)), rel=5e-3
        )


def test_pictures_are_those_of_a_sorted_splatter():
    these = splats(40, seed=3, opacities=np.linspace(0.1, 0.99, 40))
    field = field_of(these)
    camera = framing_camera(field.occupancy.look_at_box, 0.7, 0.4, 96, 96)
    colour, alpha = rendered(these, Camera(camera.camera_to_world, camera.fl_x, 96, 96), low_pass=0.0)
    picture = render_image(field, camera)
    expected = np.clip(colour + (1 - alpha[..., None]), 0, 1)
    assert psnr(picture.over(), expected) > 34
    assert np.abs(picture.opacity - alpha).mean() < 0.01


def test_a_placed_field_shows_placed_splats():
    """Any affine map: turned, stretched, mirrored."""
    matrix = np.eye(4)
    matrix[:3] = [[0.9, -0.5, 0.1, 0.4], [0.6, 1.3, 0.0, -0.2], [0.1, 0.2, -0.7, 0.3]]
    these = splats(30, seed=5, bands=1)
    moved = field_of(placed(these, matrix))
    scene = Composite([Placed("a", field_of(these), matrix)])
    camera = framing_camera(moved.occupancy.look_at_box, 0.3, 0.2, 64, 64)
    one, other = render_image(scene, camera, origin=scene.origin), render_image(moved, camera)
    assert psnr(one.over(), other.over()) > 38


def test_a_bundle_gives_the_same_field(field):
    arrays, metadata = field.state()
    again = SplatsField.from_state(arrays, metadata)
    np.testing.assert_array_equal(again.centres, field.centres)
    np.testing.assert_allclose(again.params, field.params, rtol=1e-4, atol=1e-5)
    half = field.occupancy.occupied.copy()
    half[: len(half) // 2] = False
    cut = field.with_occupancy(field.occupancy.marked(half))
    stored = SplatsField.from_state(*cut.state())
    np.testing.assert_array_equal(stored.occupancy.occupied, cut.occupancy.occupied)
    arrays, metadata = cut.state()
    assert ("occupancy.bricks" in arrays) == (metadata.get("needs") == ["held"])


@pytest.mark.parametrize(
    "name, value",
    [
        ("centres", np.full((60, 3), 0x7FC00000, np.int32)),
        ("centres", np.zeros((60, 2), np.int32)),
        ("scales", np.full((60, 3), np.inf, np.float32)),
        ("rotations", np.zeros((60, 4), np.float32)),
        ("harmonics", np.zeros((60, 5), np.float32)),
        ("opacities", np.zeros((59, 1), np.float32)),
    ],
)
def test_what_makes_no_field_is_refused(field, name, value):
    arrays, metadata = field.state()
    with pytest.raises(ValueError, match=name):
        SplatsField.from_state(arrays | {name: value}, metadata)


def test_splats_in_more_cells_than_could_be_listed_are_refused(field):
    """60 splats that fill 384³ cells would be listed 3.4 billion times."""
    arrays, metadata = field.state()
    cells = {"aabb": [-1.0, -1, -1, 1, 1, 1], "counts": [384] * 3}
    large = arrays | {"scales": np.full((60, 3), 10, np.float32)}
    with pytest.raises(ValueError, match="in at most 536,870,912 cells, found 3,397,386,240"):
        SplatsField.from_state(large, metadata | {"cells": cells})


def test_splats_that_no_cell_shows_are_left_out(field):
    """And the others show the same."""
    half = field.occupancy.occupied.copy()
    half[half.shape[0] // 2 :] = False
    cut = field.with_occupancy(field.occupancy.marked(half))
    small = registry.kind("splats").trimmed(cut)
    assert 0 < len(small.centres) < len(field.centres)
    rays_o = np.random.default_rng(2).uniform(-1, 1, (50, 3)) + [0, 0, 5.0]
    rays_d = np.tile([0.0, 0, -1], (50, 1))
    shown = [render_rays(one, rays_o, rays_d) for one in (small, cut)]
    np.testing.assert_allclose(*shown, atol=1e-6)


def test_nothing_is_fused_to_splats(field):
    scene = ComposedField([Placed("a", field, np.eye(4))], "max")
    assert registry.kind("splats").suits(scene).score is None
