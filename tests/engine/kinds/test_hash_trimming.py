"""What of a hash grid files hold: rows that a cell asks, and of a smaller one those that say most."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
import torch

from formats.records import FieldRecord, decode_field, encode_field
from fusedrf_cli.bridge.field_bundle import stored
from fusedrf_cli.bridge.sizes import BundleSizes
from fusedrf_cli.engine.distillation.optimiser import Adam
from fusedrf_cli.engine.encodings.hash_grid import row_of
from fusedrf_cli.engine.kinds import registry
from fusedrf_cli.engine.kinds.builder import StorageSetting
from fusedrf_cli.engine.kinds.hash.field import ROWS, HashField, HashShape
from fusedrf_cli.engine.kinds.hash.trimming import rows_used, with_fewer_rows, without_unasked
from tests.formats.spec_reader import answer

from ..conftest import BOX, points_in, unit
from .cases import HOSTILE_ROWS, damaged_rows, random_boxed

HASH = registry.kind("hash")
COARSE, FINE = HashShape(3, 4, 40, 6, 8), HashShape(3, 4, 40, 14, 8)
"""Of few rows a level, which all vertices share, and of enough for each."""


def few_cells(shape: HashShape = FINE, dtype=torch.float64, texels=(30, 24, 28)) -> HashField:
    """A random field of which one cell in a hundred has density."""
    field = random_boxed("hash", dtype)
    grid = field.occupancy
    held = np.random.default_rng(1).random((12, 10, 11)) < 0.01
    bare = HashField(shape, BOX, texels, 3.0, -0.5, occupancy=replace(grid, occupied=held))
    numbers = torch.randn(bare.size, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    return bare.with_params(numbers.to(dtype))


def within_cells(field: HashField, count: int = 400) -> torch.Tensor:
    """Points of every occupied cell, both of its corners among them."""
    grid = field.occupancy
    cells = np.argwhere(grid.occupied)
    inside = np.random.default_rng(2).random((count, len(cells), 3))
    inside[0], inside[1] = 1e-12, 1 - 1e-12
    return torch.from_numpy((grid.aabb[:3] + (cells + inside) * grid.cell).reshape(-1, 3))


def answers(field: HashField, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """By the reference, for directions of all sides."""
    dirs = torch.from_numpy(unit(np.random.default_rng(0).normal(size=points.shape)))
    return field.answers(field.params, points, dirs)


@pytest.mark.parametrize("shape", [COARSE, FINE])
def test_rows_that_no_cell_asks_change_no_answer(shape):
    field = few_cells(shape)
    trimmed, points = HASH.trimmed(field), within_cells(field)
    for found, wanted in zip(answers(trimmed, points), answers(field, points), strict=True):
        assert torch.equal(found, wanted)


def test_rows_are_asked_if_and_only_if_a_point_of_a_cell_is_near():
    """By the rule, of points drawn: every row that one of them reads, and next to none besides."""
    field = few_cells()
    kept = (without_unasked(field).sections()[ROWS] != 0).any(1).numpy()
    low, sides = field.cube
    unit_points = (within_cells(field, 3000).numpy() - low) / sides
    wanted, first = np.zeros_like(kept), 0
    for level in field.shape.grids:
        below = np.floor(unit_points * level["scale"] + level["offset"]).astype(np.int64)
        for corner in product((0, 1), repeat=3):
            wanted[first + row_of(level, torch.from_numpy(below + corner)).numpy()] = True
        first += level["rows"]
    assert 0.02 < wanted.mean() < 0.5
    assert not (wanted & ~kept).any() and (kept & ~wanted).sum() < 0.1 * wanted.sum()


@pytest.mark.parametrize("precision", ["float32", "float16", "int8", "int4"])
def test_a_file_holds_the_rows_that_are_asked_alone(monkeypatch, precision):
    """Half of the bytes or less, the same numbers, again the same bytes, and read by the specification."""
    monkeypatch.setattr("formats.quantisation.LEAST", {2: 512, 3: 4096})  # so that the rows are coded
    field = few_cells(dtype=torch.float32)
    trimmed = HASH.trimmed(field)
    whole, small = (encode_field(FieldRecord("hash", *f.state()), precision) for f in (field, trimmed))
    assert len(small) < 0.5 * len(whole) and b'\\"needs\\":[\\"held\\",\\"runs\\"]' in small
    read = decode_field(small, "somewhere")
    back = HashField.from_state(read.arrays, read.metadata)
    assert torch.equal(back.params, stored(trimmed, precision).params)
    assert encode_field(FieldRecord("hash", *back.state()), precision) == small
    points = within_cells(field, 20)
    dirs = unit(np.random.default_rng(0).normal(size=points.shape))
    told = answer(("hash", read.metadata, read.arrays), points.numpy(), dirs)
    for found, wanted in zip(answers(back, points), told, strict=True):
        np.testing.assert_allclose(found.numpy(), wanted, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("precision", ["float32", "int8", "int4"])
def test_wider_texels_keep_the_rows_that_say_most(monkeypatch, precision):
    """Half as many of four times wider ones, with their own numbers, in no more than the bytes that were
    foretold."""
    monkeypatch.setattr("formats.quantisation.LEAST", {2: 512, 3: 4096})
    field = HASH.trimmed(few_cells(dtype=torch.float32))
    outline, sizes = HASH.outline(field), []
    held = runs_of_rows(field).any(1)
    for times in (1, 2, 4, 8, 1e9):
        reduction = HASH.reduction(outline, times * field.voxel_size, StorageSetting(precision))
        small = reduction.make(field)
        assert reduction.lossless == (times == 1) and small.resolution == field.resolution
        runs, kept = runs_of_rows(small), runs_of_rows(small).any(1)
        assert torch.equal(runs[kept], runs_of_rows(field)[kept])
        assert abs(int(kept.sum()) - max(int(held.sum() / times**0.5), 1)) <= 1  # rounding of a share
        say = runs_of_rows(field).square().sum(1)
        assert not (held & ~kept).any() or say[kept].min() >= say[held & ~kept].max()
        foretold = BundleSizes().of(reduction.contents, precision)
        actual = BundleSizes().exactly(small, precision)
        assert actual <= foretold < 1.1 * actual + 2500  # of headers
        sizes.append(actual)
    assert sizes == sorted(sizes, reverse=True) and len(set(sizes)) == len(sizes)


def runs_of_rows(field: HashField) -> torch.Tensor:
    """(R / 4, 16) numbers of four rows of a level that are held together."""
    return field.sections()[ROWS].view(-1, 16)


def test_rows_that_were_left_out_are_not_learnt_again():
    """By a step on points all over the box: what is asked of them is 0 for good, all else moves."""
    field = few_cells(dtype=torch.float32)
    few = with_fewer_rows(field, rows_used(field) // 8)
    left_out, optimiser = ~runs_of_rows(few).any(1), Adam.of(few)
    points = within_cells(few, 40)
    dirs = torch.from_numpy(unit(np.random.default_rng(0).normal(size=points.shape)))
    sent = torch.ones(len(points)), torch.ones(len(points), 3)
    few.query_backward(points, dirs, *sent, optimiser.grads)
    before = runs_of_rows(few).clone()
    optimiser.step(0.1)
    moved = (runs_of_rows(few) != before).any(1)
    assert 0.8 < left_out.float().mean() < 0.9 and not moved[left_out].any() and moved.sum() > 10
    whole = Adam.of(field)
    field.query_backward(points, dirs, *sent, whole.grads)
    asked = whole.gradient.sum(0)[: runs_of_rows(field).numel()].view(-1, 16)
    assert asked[left_out].any()


@pytest.mark.parametrize("name", HOSTILE_ROWS)
def test_held_rows_that_do_not_fit_are_refused(name):
    arrays, metadata = HASH.trimmed(few_cells(dtype=torch.float32)).state()
    said = damaged_rows(arrays, "density_rows", name)
    with pytest.raises(ValueError, match=said):
        HashField.from_state(arrays, metadata)


def test_what_a_small_file_unfolds_to_is_bounded_and_foretold():
    arrays, metadata = HASH.trimmed(few_cells(dtype=torch.float32)).state()
    metadata["shape"] |= {"log2_rows": 24, "levels": 32, "features": 16, "finest": 1 << 18}
    shapes = {name: array.shape for name, array in arrays.items()}
    assert HashField.needs(metadata, shapes, arrays.get).held > 4 * 16 * 20 * (1 << 24)
    with pytest.raises(ValueError, match="at most 2,147,483,648 are read"):
        HashField.from_state(arrays, metadata)


def test_an_object_that_is_cut_out_is_a_small_file():
    """Of a field as large as a captured scene's a hundredth, whose vertices share rows with all others: two
    fifths of the bytes."""
    shape = HASH.shape_at(StorageSetting(), (256, 256, 256))
    field = HASH.field.create(shape, BOX, (256, 256, 256), torch.Generator().manual_seed(0))
    corner = field.box.copy()
    corner[3:] = corner[:3] + 0.2 * (corner[3:] - corner[:3])
    part = HASH.trimmed(
        HASH.cropped(field, lambda points: ((points > corner[:3]) & (points < corner[3:])).all(1))
    )
    whole, small = (BundleSizes().exactly(f, "int8") for f in (field, part))
    assert small < 0.4 * whole
    points = torch.from_numpy(points_in(corner, 500))
    for found, wanted in zip(answers(part, points), answers(field, points), strict=True):
        inside = found[..., 0] > 0 if found.dim() > 1 else found > 0
        assert inside.float().mean() > 0.5 and torch.equal(found[inside], wanted[inside])
