"""The protocol and the registry of field kinds."""

import pytest
import torch

from fusedrf_cli.engine.fields.base import RadianceField, SamplingConfig, check_samples, is_occupied
from fusedrf_cli.engine.kinds.vm.field import VMField
from tests.analytic.export import vm_field
from tests.analytic.fields import Box
from tests.bundles import field_kinds
from tests.engine.conftest import BOX, Ball, points_in, random_vm


def test_kinds_are_registered_and_can_be_stored():
    kinds = field_kinds()
    assert kinds["vm"] is VMField
    assert all(kind.kind == name for name, kind in kinds.items())
    assert all(hasattr(kind, "state") and hasattr(kind, "from_state") for kind in kinds.values())


def test_fields_keep_the_protocol():
    points = torch.from_numpy(points_in(BOX, 9))
    dirs = torch.nn.functional.normalize(points)
    for field in (random_vm(), Ball()):
        assert isinstance(field, RadianceField)
        sigma, rgb = field.query(points, dirs)
        assert sigma.shape == (9,) and rgb.shape == (9, 3)
        assert (sigma >= 0).all() and (rgb >= 0).all() and (rgb <= 1).all()
        assert torch.equal(field.query(points, dirs, with_colour=False)[0], sigma)
        assert field.aabb.shape == (6,) and field.voxel_size > 0


def test_matter_is_what_can_be_seen_through_the_whole_box():
    """An optical depth of 1e-4 along the diagonal is nothing; a thousand times as much is thin fog."""
    for field, found in ((Box(1e-5), False), (Box(1e-2), True), (Ball(), True), (Ball(radius=0.0), False)):
        assert is_occupied(field) == found
    assert is_occupied(vm_field(Box(1e-2))) and not is_occupied(vm_field(Box(0.0)))


def test_how_many_samples_are_too_many_is_a_setting(in_force):
    check_samples(1000, "the field")
    with pytest.raises(ValueError, match="the field would take up to 1,001 samples, expected at most 1,000"):
        check_samples(1001, "the field", 1000)
    in_force(SamplingConfig(most_samples=999))
    with pytest.raises(ValueError, match="expected at most 999"):
        check_samples(1000, "the field")
