"""Colours of fields times a tint."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from fusedrf_cli.engine.fields.base import RadianceField
from fusedrf_cli.engine.fields.occupancy import OccupancyGrid
from fusedrf_cli.engine.kinds import registry
from fusedrf_cli.engine.kinds.vm.field import VMField
from fusedrf_cli.engine.rendering.volume import render_rays

from ..conftest import rays_at
from .cases import KINDS, coarse_ownership, random_blocks  # noqa: F401  (a fixture)
from .test_references import asked, sent_back

TINT = (0.9, 0.4, 0.0)


LONG = "vm-mlp", "sparse, levels and bands"  # their loops take long to compile


@pytest.fixture(params=[*(pytest.param(name, marks=pytest.mark.slow) for name in LONG), "dense"])
def pair(request) -> tuple[RadianceField, RadianceField]:
    """A field, and the same with a tint."""
    field = KINDS[request.param]()
    return field, registry.kind(field.kind).tinted(field, TINT)


def exactly(numbers) -> torch.Tensor:
    return torch.tensor(numbers, dtype=torch.float64)


def test_a_tint_multiplies_colours_and_nothing_else(pair):
    plain, tinted = pair
    points, dirs = asked(plain, 1000)
    (sigma, rgb), (same, found) = plain.query(points, dirs), tinted.query(points, dirs)
    assert rgb.max() > 0.5
    torch.testing.assert_close(same, sigma, rtol=1e-12, atol=0)
    torch.testing.assert_close(found, rgb * exactly(TINT), rtol=1e-12, atol=0)
    rays = rays_at(plain.aabb, 60)
    before, after = render_rays(plain, *rays), render_rays(tinted, *rays)
    np.testing.assert_allclose(after[:, :3], before[:, :3] * TINT, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(after[:, 3:], before[:, 3:], rtol=1e-6)
    answers = tinted.answers(tinted.params, points, dirs)
    torch.testing.assert_close(answers[1], found, rtol=0, atol=1e-9)


def test_tints_multiply(pair):
    plain, tinted = pair
    kind = registry.kind(plain.kind)
    other = kind.tinted(tinted, (0.5, 0.5, 1.0)).with_occupancy(OccupancyGrid.full(plain.occupancy.aabb, 3))
    points, dirs = asked(plain, 100)
    rgb, found = plain.query(points, dirs)[1], other.query(points, dirs)[1]
    seen = rgb.amax(1) > 0  # more cells are asked than were
    torch.testing.assert_close(found[seen].double(), rgb[seen] * exactly((0.45, 0.2, 0.0)), rtol=1e-5, atol=0)


def tinted_blocks():
    """Three blocks, of which two have tints."""
    field = random_blocks()
    tints = TINT, (1.0, 1.0, 1.0), (0.2, 0.7, 1.0)
    blocks = tuple(replace(b, tint=tint) for b, tint in zip(field.blocks, tints, strict=True))
    return VMField(field.shape, field.tensors, blocks, field.params, field.occupancy, field.owners)


def test_every_block_has_its_own_tint():
    """As the plain torch reference says, which looks the tint of each sample's block up."""
    plain, field = random_blocks(), tinted_blocks()
    points, dirs = asked(field, 1000)
    found, wanted = field.query(points, dirs), field.reference(field.params, points, dirs)
    torch.testing.assert_close(found[1], wanted[1], rtol=0, atol=1e-9)
    rgb = plain.query(points, dirs)[1]
    seen = rgb.amin(1) > 0
    shares = (found[1] / rgb)[seen].numpy().round(9)
    assert {tuple(share) for share in shares} == {block.tint for block in field.blocks}


@pytest.mark.parametrize("kind", ["blocks", "sparse"])
def test_what_is_sent_back_went_through_the_tint(kind):
    field = tinted_blocks() if kind == "blocks" else registry.kind(kind).tinted(KINDS[kind](), TINT)
    np.testing.assert_allclose(*sent_back(field, field.answers), rtol=1e-5, atol=1e-9)


def test_blocks_keep_their_tints_in_a_bundle():
    field = tinted_blocks()
    arrays, metadata = field.state()
    assert "tint" not in metadata["blocks"][1]
    back = type(field).from_state(arrays, metadata)
    assert [block.tint for block in back.blocks] == [block.tint for block in field.blocks]
    for wrong in ([1, 1], [1, 1, 1.5], [float("nan"), 1, 1], "red"):
        metadata["blocks"][0]["tint"] = wrong
        with pytest.raises(ValueError):
            type(field).from_state(arrays, metadata)
