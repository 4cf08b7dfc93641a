"""Blocks: pointwise what the composed scene says, tensors shared and left alone, and made smaller to fit."""

import numpy as np
import pytest
import torch

from fusedrf_cli.engine.composition.affine import Placed
from fusedrf_cli.engine.composition.composed import ComposedField
from fusedrf_cli.engine.fields.occupancy import OccupancyConfig
from fusedrf_cli.engine.kinds.vm.blocks import (
    MAX_BLOCKS,
    blocks_of,
    common_shape,
    reshaped,
    tensor_field,
    without,
)
from fusedrf_cli.engine.kinds.vm.field import VMShape
from fusedrf_cli.engine.kinds.vm.reference import vm_query
from tests.analytic.rays import SHEAR, affine, turn
from tests.engine.conftest import BOX, SIXTY_FOUR, THIRTY_TWO, Gaussian, points_in, random_vm, unit

SHIFT = np.array([2.0, -1.0, 0.5])
PAIRS = {
    "turned": (affine(turn(33)), affine(turn(-50), (1.0, 0, 0))),
    "mirrored": (affine((-1, 1, 1)), affine(turn(20))),
    "sheared": (affine(SHEAR), affine(0.7, (0.5, 0, 0))),
    "stretched": (affine((0.6, 2.0, 1.0)), affine(turn(70) @ np.diag([1, -1.5, 0.8]))),
    "apart": (affine(1.0, (0, 0, 0)), affine(0.5, (4.0, 1, 0))),
}


@pytest.fixture(autouse=True)
def coarse_ownership(in_force):
    """Grids that are made in no time."""
    in_force(OccupancyConfig(scene_cells=32))


def small(seed: int, **options):
    return random_vm(THIRTY_TWO, dtype=torch.float32, seed=seed, cells=6, **options)


def asked(field, box, count: int = 6000, seed: int = 0):
    """σ and rgb at random points around a box."""
    points = torch.from_numpy(points_in(box, count, seed, margin=0.1))
    return field.query(points, torch.from_numpy(unit(points_in(BOX, count, seed + 9))))


def assert_same(found, wanted):
    """Equal to float32's accuracy, but for a few points on the faces of cells; and no blank test."""
    assert (wanted[0] > 0).float().mean() > 0.02
    near = torch.isclose(found[0], wanted[0], rtol=2e-4, atol=2e-4)
    near &= torch.isclose(found[1], wanted[1], rtol=0, atol=2e-3).all(1)
    assert (~near).sum() <= 3


@pytest.mark.parametrize("name", PAIRS)
def test_two_placed_fields_are_the_composed_scene_point_by_point(name):
    a, b = PAIRS[name]
    composed = ComposedField([Placed("a", small(1), a), Placed("b", small(2), b)])
    field = blocks_of(composed.placed)
    assert_same(asked(field, composed.aabb), asked(composed, composed.aabb))
    assert [block.name for block in field.blocks] == ["a", "b"]


def test_one_placed_field_too():
    composed = ComposedField([Placed("a", small(1), affine(turn(33) @ np.diag([1, -0.5, 2])))])
    assert_same(asked(blocks_of(composed.placed), composed.aabb), asked(composed, composed.aabb))


def test_copies_share_one_tensor():
    chair, table = small(1), small(2)
    spots = [affine(turn(20 * i), (3.0 * i, 0, 0)) for i in range(4)]
    composed = ComposedField(
        [
            *(Placed(f"chair{i}", chair, m) for i, m in enumerate(spots)),
            Placed("table", table, affine(1, (0, 4, 0))),
        ]
    )
    field = blocks_of(composed.placed)
    assert len(field.tensors) == 2 and [b.tensor for b in field.blocks] == [0, 0, 0, 0, 1]
    assert field.params.numel() == chair.params.numel() + table.params.numel()
    assert_same(asked(field, composed.aabb, 20000), asked(composed, composed.aabb, 20000))


def test_blocks_of_blocks_go_by_the_names_of_node_and_block():
    inner = blocks_of([Placed("a", small(1), affine(0.5)), Placed("b", small(2), affine(0.5, (2, 0, 0)))])
    composed = ComposedField(
        [Placed("pair", inner, affine(turn(15))), Placed("c", small(3), affine(1, (-4, 0, 0)))]
    )
    field = blocks_of(composed.placed)
    assert [b.name for b in field.blocks] == ["pair/a", "pair/b", "c"]
    assert_same(asked(field, composed.aabb, 20000), asked(composed, composed.aabb, 20000))
    assert [b.name for b in without(field, {"pair"}).blocks] == ["c"]
    assert [b.name for b in blocks_of([Placed("", inner, affine(1))]).blocks] == ["a", "b"]


def test_without_is_a_fresh_composition_of_the_rest():
    """Bit for bit in the numbers, and the same answers."""
    fields = [small(seed) for seed in (1, 2, 3)]
    all_of_them = [Placed("abc"[i], f, affine(turn(30 * i), (1.5 * i, 0, 0))) for i, f in enumerate(fields)]
    field = blocks_of(all_of_them)
    before = field.params.clone()
    for gone in "abc":
        left = without(field, {gone})
        fresh = blocks_of([p for p in all_of_them if p.name != gone])
        assert torch.equal(left.params, fresh.params)
        assert [b.name for b in left.blocks] == [b.name for b in fresh.blocks]
        for one, other in zip(asked(left, field.aabb), asked(fresh, field.aabb), strict=True):
            assert torch.equal(one, other) and one.any()
    assert torch.equal(field.params, before)
    assert without(field, {"a", "b", "c"}) is None


def test_a_tensor_stays_while_one_copy_does():
    chair = small(1)
    field = blocks_of([Placed("one", chair, np.eye(4)), Placed("two", chair, affine(1, (3, 0, 0)))])
    left = without(field, {"one"})
    assert torch.equal(left.params, chair.params) and left.blocks[0].name == "two"


def at_most(numbers):
    return lambda shape, tensors: sum(t.size(shape) for t in tensors) <= numbers


def test_shrunk_fits_and_resembles():
    smooth = random_vm(THIRTY_TWO, resolution=(3, 3, 3), dtype=torch.float32).resampled(BOX, (30, 33, 33))
    placed = [Placed("a", smooth, affine(turn(20))), Placed("b", small(2), affine(0.5, (3, 0, 0)))]
    field = blocks_of(placed)
    whole = field.params.numel()
    for numbers in (whole // 2, whole // 4):
        less = blocks_of(placed, at_most(numbers))
        assert 0.5 * numbers < less.params.numel() <= numbers
        assert all(min(t.resolution) >= 2 for t in less.tensors)
        wanted, found = asked(field, field.aabb)[0], asked(less, field.aabb)[0]
        assert (found - wanted).abs().mean() < 0.1 * wanted.mean()
    assert torch.equal(blocks_of(placed, at_most(whole)).params, field.params)
    limit = blocks_of([Placed("a", smooth, np.eye(4))], at_most(whole // 4))
    assert 4 * limit.params.numel() <= whole


def test_resampling_to_the_same_resolution_changes_nothing():
    field = blocks_of(
        [Placed("a", small(1), affine(turn(20))), Placed("b", small(2), affine(0.5, (3, 0, 0)))]
    )
    for t, tensor in enumerate(field.tensors):
        same = tensor_field(field, t).resampled(tensor.aabb, tensor.resolution)
        for name, section in field.sections(t).items():
            torch.testing.assert_close(same.sections(0)[name], section, rtol=0, atol=1e-6)


def test_reshaped_changes_no_answer():
    """Of a narrow field and its widened copy, by the torch reference (no kernel of the narrow shape is
    compiled).
    """
    narrow = random_vm(VMShape(8, 8, 0), dtype=torch.float64)
    wide = reshaped(narrow, SIXTY_FOUR)
    points, dirs = points_in(BOX, 500), torch.from_numpy(unit(points_in(BOX, 500, 4)))
    at = torch.from_numpy((points - BOX[:3]) / (BOX[3:] - BOX[:3]))
    tensor = narrow.tensors[0]
    one = vm_query(narrow.sections(0), at, dirs, tensor.scale, tensor.shift)
    other = vm_query(wide.sections(0), at, dirs, tensor.scale, tensor.shift)
    kernel = wide.query(torch.from_numpy(points), dirs)
    for a, b, c in zip(one, other, kernel, strict=True):
        torch.testing.assert_close(b, a, rtol=1e-12, atol=1e-12)
        torch.testing.assert_close(c, a, rtol=1e-9, atol=1e-9)
    assert wide.shape == SIXTY_FOUR and reshaped(wide, SIXTY_FOUR) is wide
    assert wide.params.numel() > narrow.params.numel()


def test_common_shape_holds_all():
    assert common_shape([VMShape(8, 24, 0), VMShape(16, 8, 2)]) == VMShape(16, 24, 2)


def test_tensor_field_is_the_tensor_alone():
    one, two = small(1), small(2)
    field = blocks_of([Placed("a", one, affine(turn(20))), Placed("b", two, affine(0.5, (3, 0, 0)))])
    assert torch.equal(tensor_field(field, 1).params, two.params)
    for a, b in zip(asked(tensor_field(field, 1), BOX), asked(two, BOX), strict=True):
        assert torch.equal(a, b)


def test_what_blocks_cannot_hold_is_refused():
    with pytest.raises(ValueError, match="'fog' is of kind 'analytic'"):
        blocks_of([Placed("fog", Gaussian(), np.eye(4))])
    field = small(1)
    with pytest.raises(ValueError, match="at most 255 blocks, this scene has 256"):
        blocks_of([Placed(f"n{i}", field, np.eye(4)) for i in range(MAX_BLOCKS + 1)])
