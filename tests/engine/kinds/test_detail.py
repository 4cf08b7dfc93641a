"""The hashed detail of a vm tensor: its rows by the rule of SPEC.md, what keeps it and what leaves it out,
and that it holds what is finer than the texels."""

import json
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
import torch

from formats.errors import FormatError
from formats.records import FieldRecord, decode_field, encode_field
from fusedrf_cli.bridge.field_bundle import stored
from fusedrf_cli.bridge.sizes import BundleSizes
from fusedrf_cli.engine.composition.affine import Placed
from fusedrf_cli.engine.composition.composed import ComposedField
from fusedrf_cli.engine.distillation.optimiser import Adam
from fusedrf_cli.engine.encodings import plane_line
from fusedrf_cli.engine.encodings.hash_runs import EMPTY_FROM, HashGrid, hashed_row
from fusedrf_cli.engine.fields.base import sampling_step
from fusedrf_cli.engine.fields.occupancy import OccupancyConfig
from fusedrf_cli.engine.kinds import field_cutting, registry
from fusedrf_cli.engine.kinds.builder import BuildRequest, Plan, StorageSetting
from fusedrf_cli.engine.kinds.vm.builder import VMBuilderConfig
from fusedrf_cli.engine.kinds.vm.field import DETAIL, VMField, VMShape
from fusedrf_cli.engine.kinds.vm.trimming import (
    queried_rows,
    reshaped,
    truncated,
    without_detail,
    without_unqueried,
)
from fusedrf_cli.engine.selection.cells import CellGrid, Selection
from fusedrf_cli.engine.settings import using
from fusedrf_cli.engine.spaces.bounded import STEP_PER_VOXEL

from ..conftest import BOX, SIXTY_FOUR, THIRTY_TWO, points_in, random_vm, unit
from .cases import HOSTILE_ROWS, damaged_rows, random_detail


def asked(field, count=300, reference=False):
    """What the kernels answer, or the reference, for which no loops of a test's own sizes are compiled."""
    points = torch.from_numpy(points_in(field.aabb, count))
    dirs = torch.from_numpy(unit(np.random.default_rng(0).normal(size=(count, 3))))
    return field.answers(field.params, points, dirs) if reference else field.query(points, dirs)


def same(one, other, reference=False):
    for a, b in zip(asked(one), asked(other, reference=reference), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-9, atol=1e-12)


def by_the_rule(rows: int, i: int, j: int, k: int) -> int:
    """SPEC.md, section 2.4, in integers without an end."""
    q = (2654435761 * i ^ 805459861 * j ^ 3674653429 * (k // 4)) % 2**64
    return 4 * ((q ^ (q >> 15)) % (rows // 4)) + k % 4


@pytest.mark.parametrize("rows", [4, 64, 1 << 20, 1 << 24])
def test_rows_are_those_of_the_rule(rows):
    vertices = np.random.default_rng(0).integers(-3000, 3000, (500, 3))
    found = hashed_row(HashGrid((1.0,), rows), torch.from_numpy(vertices))
    assert found.tolist() == [by_the_rule(rows, *(int(n) for n in vertex)) for vertex in vertices]


def test_an_answer_by_the_rule_alone():
    """One level, a tensor that says the same everywhere: σ and colour from eight rows, in a slow loop."""
    field = random_vm(hashed=HashGrid((0.25,), 16), scale=2.0, shift=1.0)
    sections = field.sections()
    for name, view in sections.items():
        if name != DETAIL:
            view.zero_()
    rows, (x, y, z) = sections[DETAIL].numpy(), (0.3, -0.55, 0.1)
    total = np.zeros(4)
    for corner in product((0, 1), repeat=3):
        place = np.array([x, y, z]) / 0.25
        below = np.floor(place).astype(int)
        share = np.abs(1 - np.array(corner) - (place - below))
        total += share.prod() * rows[by_the_rule(16, *(int(n) for n in below + corner))]
    sigma, rgb = field.query(torch.tensor([[x, y, z]]).double(), torch.tensor([[0.0, 0.0, 1.0]]).double())
    assert sigma.item() == pytest.approx(2.0 * np.log1p(np.exp(total[0] + 1.0)), rel=1e-6)
    np.testing.assert_allclose(rgb[0], 1 / (1 + np.exp(-total[1:])), rtol=1e-6)


@pytest.mark.parametrize("kwargs", [{"spacings": ()}, {"spacings": (0.0,)}, {"rows": 48}, {"rows": 2}])
def test_what_the_kernels_cannot_serve_is_refused(kwargs):
    with pytest.raises(ValueError, match="spacings|rows"):
        HashGrid(**({"spacings": (0.1,), "rows": 64} | kwargs))


def test_it_stays_where_texels_change():
    """Texels at which planes and lines are exact again: the old ones are among the new."""
    field = random_detail(resolution=(5, 8, 7))
    same(field, field.resampled(field.box, (9, 15, 13)).with_occupancy(field.occupancy))
    wider = VMShape(16, 24, 3)
    same(field, reshaped(field, wider), reference=True)
    same(field, truncated(reshaped(field, wider), field.shape))


def test_pictures_sample_it_by_its_spacing_where_that_is_finer_than_texels():
    """Whatever is done to the field."""
    coarse, fine = (random_vm(hashed=HashGrid(spacings, 16)) for spacings in ((9.0,), (0.25, 0.01)))
    coarse, fine = (field.with_occupancy(field.occupancy) for field in (coarse, fine))
    assert sampling_step(coarse) == pytest.approx(STEP_PER_VOXEL * coarse.voxel_size)
    smaller = fine.resampled(fine.aabb, (9, 9, 9)).with_occupancy(fine.occupancy)
    stored = VMField.from_state(*fine.state())
    for field in (fine, smaller, stored, fine.resampled(fine.aabb, (9, 9, 9))):
        assert sampling_step(field) == pytest.approx(2 * 0.01)


def test_what_is_left_without_it_answers_as_planes_and_lines_do():
    field = random_vm(resolution=(9, 8, 7), hashed=HashGrid((0.05,), 1 << 8), scale=300.0, shift=-6.0)
    bare, there = without_detail(field), field.with_params(field.params.clone())
    there.sections()[DETAIL].zero_()
    assert bare.shape == SIXTY_FOUR and len(bare.params) == len(field.params) - (1 << 10)
    same(there, bare, reference=True)
    assert without_detail(bare) is bare


def test_a_reduction_says_what_a_file_will_hold_of_it():
    """Of a field cut out of a place, whose rows are few; far fewer texels leave it out."""
    cut, kind = without_unqueried(sparse_detail(1 << 14, torch.float32)), registry.kind("vm")
    outline = kind.outline(cut)
    assert len(outline.params) == 0
    for voxel, hashed in ((0.0, cut.shape.hashed), (0.6, None)):
        reduction = kind.reduction(outline, voxel, StorageSetting())
        made = reduction.make(cut)
        assert made.shape.hashed == hashed
        for precision in ("float16", "int8"):
            found = len(encode_field(FieldRecord("vm", *made.state()), precision))
            assert found <= BundleSizes().of(reduction.contents, precision) <= 1.3 * found + 8000


def test_it_comes_back_from_a_file_that_older_readers_refuse():
    field = random_detail().with_params(random_detail().params.float())
    data = encode_field(FieldRecord("vm", *field.state()), "float32")
    back = decode_field(data, "somewhere")
    found = VMField.from_state(back.arrays, back.metadata)
    assert found.shape == field.shape
    same(field, found)
    assert b'\\"version\\":3' in data
    plain = encode_field(FieldRecord("vm", *random_vm().state()), "float32")
    assert b'\\"version\\":1' in plain


def sparse_detail(rows=1 << 9, dtype=torch.float64):
    """A tensor of which few cells are occupied, and in half of those planes and lines say that there is
    nothing."""
    hashed = HashGrid((0.31, 0.07), rows)
    field = random_vm(cells=12, hashed=hashed, scale=300.0, shift=-6.0, dtype=dtype)
    held = np.random.default_rng(1).random(field.occupancy.occupied.shape) < 0.01
    return field.with_occupancy(replace(field.occupancy, occupied=held))


def within_cells(field, count=400):
    """Points of every occupied cell, both of its corners among them."""
    grid = field.occupancy
    cells = np.argwhere(grid.occupied)
    inside = np.random.default_rng(2).random((count, len(cells), 3))
    inside[0], inside[1] = 1e-12, 1 - 1e-12
    return torch.from_numpy((grid.aabb[:3] + (cells + inside) * grid.cell).reshape(-1, 3))


def test_rows_that_no_cell_asks_change_no_answer():
    field = sparse_detail()
    trimmed = without_unqueried(field)
    points = within_cells(field)
    dirs = torch.from_numpy(unit(np.random.default_rng(0).normal(size=points.shape)))
    for found, wanted in zip(trimmed.query(points, dirs), field.query(points, dirs), strict=True):
        assert torch.equal(found, wanted)
    left = (trimmed.sections()[DETAIL] != 0).any(1)
    assert 0.02 < left.float().mean() < 0.7


def test_rows_are_asked_if_and_only_if_a_point_with_matter_is_near():
    """By the rule, of points drawn: every row that one of them reads, and next to none besides."""
    field = sparse_detail(1 << 16)
    hashed = field.shape.hashed
    found = queried_rows(field, hashed)
    points = within_cells(field, 3000)
    low, high = torch.from_numpy(field.aabb).view(2, 3)
    factors, unit_points = field.slot_sections()["density"], (points - low) / (high - low)
    dense = plane_line.reference(field, factors, unit_points, None, 8).sum(1) + field.shift > EMPTY_FROM
    assert 0.2 < dense.float().mean() < 0.8
    wanted = np.zeros_like(found)
    for level, spacing in enumerate(hashed.spacings):
        below = torch.floor(points[dense] / spacing).long()
        for corner in product((0, 1), repeat=3):
            rows = hashed_row(hashed, below + torch.tensor(corner))
            wanted[level * hashed.rows + rows.numpy()] = True
    assert not (wanted & ~found).any()
    assert (found & ~wanted).sum() < 0.6 * wanted.sum()  # a cell between texels is asked in whole


def test_all_rows_of_a_level_that_is_met_everywhere_are_kept():
    field = sparse_detail(4)
    assert queried_rows(field, field.shape.hashed).all()


@pytest.mark.parametrize("precision", ["float32", "float16", "int8", "int4"])
def test_a_file_holds_the_rows_that_are_asked_alone(monkeypatch, precision):
    """A quarter of the bytes or less, the same numbers as told, and again the same bytes."""
    monkeypatch.setattr("formats.quantisation.LEAST", {2: 512, 3: 4096})  # so that the detail is coded
    field = sparse_detail(1 << 14, torch.float32)
    trimmed = without_unqueried(field)
    whole, small = (encode_field(FieldRecord("vm", *f.state()), precision) for f in (field, trimmed))
    assert len(small) < 0.25 * len(whole) and b'\\"needs\\":[\\"hashed\\",\\"held\\",\\"runs\\"]' in small
    read = decode_field(small, "somewhere")
    back = VMField.from_state(read.arrays, read.metadata)
    assert torch.equal(back.params, stored(trimmed, precision).params)
    assert encode_field(FieldRecord("vm", *back.state()), precision) == small
    assert np.array_equal(back.held.rows, trimmed.held.rows)
    if precision == "float32":
        assert all(torch.equal(back.sections()[name], view) for name, view in trimmed.sections().items())


@pytest.mark.parametrize("precision", ["int8", "int4"])
def test_cut_numbers_keep_the_codes_that_they_had(monkeypatch, precision):
    """Of a field that was read from 8 or 4 bits, cut to a corner that begins at the eighth texel."""
    monkeypatch.setattr("formats.quantisation.LEAST", {2: 512, 3: 64})
    field = random_vm(
        THIRTY_TWO,
        (30, 30, 30),
        torch.float32,
        hashed=HashGrid((0.31, 0.07), 1 << 14),
        scale=300.0,
        shift=-6.0,
    )
    field = stored(field, precision)
    middle, box = CellGrid.over(field, field.aabb * 0.4, 8), field.box
    part = field_cutting.cut_out(field, box, Selection(middle, np.ones(len(middle.points), bool)))
    first = np.rint(
        (part.aabb[:3] - box[:3]) / ((box[3:] - box[:3]) / (np.array(field.resolution) - 1))
    ).astype(int)
    assert (first % 8 == 0).all() and first.any()
    cut = without_unqueried(part)
    assert torch.equal(stored(cut, precision).params, cut.params)
    own = tuple(slice(a, a + n) for a, n in zip(first[:2], cut.resolution, strict=False))
    plane, whole = cut.sections()["density_plane_0"], field.sections()["density_plane_0"][own]
    assert ((plane == whole) | (plane == 0)).all() and (plane != 0).any()


@pytest.mark.parametrize("name", HOSTILE_ROWS)
def test_held_rows_that_do_not_fit_are_refused(name):
    arrays, metadata = without_unqueried(sparse_detail(1 << 12, torch.float32)).state()
    said = damaged_rows(arrays, "tensor_0.detail", name)
    with pytest.raises(ValueError, match=said):
        VMField.from_state(arrays, metadata)


def test_what_a_small_file_unfolds_to_is_foretold_and_bounded():
    arrays, metadata = without_unqueried(sparse_detail(1 << 14, torch.float32)).state()
    shapes = {name: array.shape for name, array in arrays.items()}
    assert VMField.needs(metadata, shapes, arrays.get).held >= 2 * (1 << 14) * 16
    metadata["tensors"][0]["resolution"] = [8192] * 3
    with pytest.raises(ValueError, match="at most 2,147,483,648 are read"):
        VMField.from_state(arrays, metadata)


@pytest.mark.parametrize(
    "change, said",
    [
        ({"rows": 1 << 25}, "rows"),
        ({"rows": 63}, "power of two"),
        ({"rows": 32}, "should have shape"),
        ({"spacings": [0.1]}, "should have shape"),
        ({"spacings": [0.1] * 9}, "levels"),
        ({"spacings": [-1.0, 0.1]}, "above 0"),
        ({"spacings": [1e-300, 0.1]}, "numbered up to"),
        ({"spacings": [0.31, 9e-7]}, "numbered up to"),
    ],
)
def test_hostile_metadata_is_refused(change, said):
    arrays, metadata = random_detail().state()
    metadata = json.loads(json.dumps(metadata))
    metadata["tensors"][0]["hashed"] |= change
    with pytest.raises(ValueError, match=said):
        VMField.from_state(arrays, metadata)


def test_numbers_that_multiply_past_all_bounds_are_refused():
    arrays, metadata = random_detail().state()
    arrays["tensor_0.detail"] = np.full_like(arrays["tensor_0.detail"], 3e38)
    with pytest.raises(ValueError, match="would reach"):
        VMField.from_state(arrays, metadata)


def test_a_need_that_is_not_known_is_refused():
    record = FieldRecord("vm", {}, {"needs": ["magic"]})
    with pytest.raises(FormatError, match="magic.*update fusedrf"):
        decode_field(encode_field(record), "somewhere")


@pytest.mark.slow
def test_it_learns_what_is_finer_than_texels():
    """A checkerboard of a quarter of a texel: planes and lines can only say its mean, a detail the rest."""
    points = torch.from_numpy(points_in(BOX, 4000))
    wanted = ((points / 0.2).floor().sum(1) % 2)[:, None].expand(-1, 3).float()
    dirs = torch.tensor([[0.0, 0.0, 1.0]]).double().expand(len(points), 3)
    left = {}
    for hashed in (None, HashGrid((0.2 / 3,), 1 << 16, learns_from=2)):
        shape = replace(THIRTY_TWO, hashed=hashed)
        field = VMField.create(shape, BOX, (3, 3, 3), torch.Generator().manual_seed(0))
        for name, view in field.sections().items():
            if name.startswith("density") and name != DETAIL:
                view.fill_(1.0)  # matter, where a detail is asked for
        optimiser = Adam.of(field)
        for _ in range(60):
            error = field.query(points, dirs)[1] - wanted
            field.query_backward(points, dirs, torch.zeros(len(points)), error, optimiser.grads)
            optimiser.step(0.17)
        left[hashed] = error.square().mean().item()
    plain, detailed = left.values()
    assert plain > 0.2 and detailed < 0.05


def student_of(scene: ComposedField, limit: int, **asked) -> Plan:
    """What the largest student of a scene is planned as, in a file of so many bytes."""
    request = BuildRequest(BundleSizes(), limit, **asked)
    coarse = OccupancyConfig(scene_cells=16)
    with using(VMBuilderConfig(VMShape(8, 8, 0), detail_from=80_000), coarse):
        return registry.kind("vm").builder(scene, request).largest()


def test_a_student_with_numbers_to_spare_has_one():
    scene = ComposedField(
        [Placed("one", random_vm(VMShape(8, 8, 0), (120, 90, 105), torch.float32), np.eye(4))]
    )
    plan = student_of(scene, 150_000)
    hashed = plan.storage.hashed
    assert plan.numbers <= plan.allowed and hashed.shape[0] * 4 <= 0.3 * plan.allowed
    assert 2 * hashed.shape[0] * 4 > 0.3 * plan.allowed  # rows are a power of two
    assert hashed.spacings[0] == 2 * hashed.spacings[1] == 4 * hashed.spacings[2]
    assert 0.5 * plan.voxel < hashed.spacings[1] < plan.voxel
    assert student_of(scene, 150_000, seconds=200.0).storage.hashed == hashed
    few, hurried = student_of(scene, 70_000), student_of(scene, 150_000, seconds=60.0)
    whole = student_of(scene, 10_000_000)
    assert few.storage.hashed is hurried.storage.hashed is whole.storage.hashed is None
    assert whole.voxel <= scene.voxel_size * 1.001


def test_a_student_that_grows_keeps_what_it_says():
    """And none of a detail, whose rows are others then."""
    kind, small = registry.kind("vm"), random_vm(SIXTY_FOUR, hashed=HashGrid((0.5,), 64))
    storage = StorageSetting(hashed=HashGrid((0.2, 0.1), 256))
    plan = kind.plan_at(BOX, small.resolution, storage)
    grown = kind.grown(small, plan)
    assert grown.shape.hashed == storage.hashed and not grown.sections()[DETAIL].any()
    for got, said in zip(
        asked(grown, reference=True), asked(without_detail(small), reference=True), strict=True
    ):
        np.testing.assert_allclose(got, said, rtol=1e-9)
