"""Colours of fields times a tint."""

import numpy as np
import pytest
import torch

from fusedrf_cli.engine.fields.base import RadianceField
from fusedrf_cli.engine.fields.occupancy import OccupancyGrid
from fusedrf_cli.engine.kinds import registry
from fusedrf_cli.engine.rendering.volume import render_rays

from ..conftest import rays_at
from .cases import KINDS  # noqa: F401  (a fixture)
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


def test_what_is_sent_back_went_through_the_tint():
    field = registry.kind("sparse").tinted(KINDS["sparse"](), TINT)
    np.testing.assert_allclose(*sent_back(field, field.answers), rtol=1e-5, atol=1e-9)
