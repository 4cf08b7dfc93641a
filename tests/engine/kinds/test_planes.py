"""What only products of planes do: several resolutions follow the field's texels."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from fusedrf_cli.bridge.fusing import best_suited
from fusedrf_cli.engine import spaces
from fusedrf_cli.engine.composition.affine import Placed
from fusedrf_cli.engine.composition.composed import ComposedField
from fusedrf_cli.engine.kinds import registry
from fusedrf_cli.engine.kinds.builder import StorageSetting
from fusedrf_cli.engine.kinds.planes.field import PlanesConfig, PlanesField

from ..conftest import BOX, points_in
from .cases import random_boxed

PLANES = registry.kind("planes")


def test_each_resolution_is_half_of_the_one_before():
    parts = {part.name: part for part in PlanesField.parts_of(PlanesField.shape_type(), (33, 20, 6))}
    wanted = {0: (33, 20, 6), 1: (17, 10, 3), 2: (9, 5, 2)}
    for level, (x, y, z) in wanted.items():
        shapes = [parts[f"density_plane_{level}_{m}"].shape for m in range(3)]
        assert shapes == [(x, y, 16), (x, z, 16), (y, z, 16)]


def test_an_untrained_field_begins_as_k_planes_does():
    plan = PLANES.untrained(BOX, 16, StorageSetting())
    field = PLANES.create(plan, torch.Generator().manual_seed(0))
    low, high = PlanesConfig().first
    for name, view in field.sections().items():
        if "plane" in name:
            assert low <= view.min() < low + 0.05 and high - 0.05 < view.max() <= high


@pytest.mark.parametrize("finer", [2, 4])
def test_texels_between_those_that_there_are_change_no_answer(finer):
    """Planes of nested texels, resampled, are the same functions: all their resolutions."""
    field = random_boxed("planes")
    counts = np.array([5, 9, 9])  # 5, 3, 2 and 9, 5, 3: on each level, texels lie among the finer ones
    field = PlanesField(field.shape, BOX, tuple(counts.tolist()), 3.0, -0.5, occupancy=field.occupancy)
    numbers = torch.randn(field.size, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    field = field.with_params(numbers)
    fine = field.resampled(BOX, tuple(int(n) for n in finer * (counts - 1) + 1))
    points = torch.from_numpy(points_in(BOX, 300))
    dirs = torch.tensor([[0.0, 0.6, 0.8]]).double().expand(300, 3)
    for found, wanted in zip(
        fine.answers(fine.params, points, dirs), field.answers(field.params, points, dirs), strict=True
    ):
        torch.testing.assert_close(found, wanted, rtol=1e-9, atol=1e-9)


def test_they_are_chosen_for_bounded_scenes_in_few_bytes():
    field = random_boxed("vm")
    around = field.with_occupancy(replace(field.occupancy, space=spaces.unbounded))
    bounded, place = (ComposedField([Placed("one", one, np.eye(4))]) for one in (field, around))
    for scene, limit, best in (
        (bounded, 3_000_000, "planes"), (bounded, 20_000_000, "vm"), (place, 3_000_000, "vm"),
    ):  # fmt: skip
        assert best_suited(scene, limit)[0].name == best
    assert best_suited(bounded)[0].name == "blocks"


@pytest.mark.parametrize("wrong", [{"levels": 0}, {"features": 12}, {"features": True}, {"hidden": 12}])
def test_a_shape_that_no_loop_was_written_for_is_refused(wrong):
    with pytest.raises(ValueError, match=f"'{next(iter(wrong))}' should be a .* from"):
        PlanesField.shape_type(**wrong)
