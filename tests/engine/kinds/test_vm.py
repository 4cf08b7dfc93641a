"""VM fields as objects: parameters, resampling, several blocks, storage."""

import numpy as np
import pytest
import torch

from fusedrf_cli.engine.fields.occupancy import PROBES, OccupancyConfig, OccupancyGrid
from fusedrf_cli.engine.kinds.vm.bodies import NO_BLOCK
from fusedrf_cli.engine.kinds.vm.field import Block, VMField, VMShape, VMTensor
from tests.engine.conftest import BOX, SIXTY_FOUR, THIRTY_TWO, points_in, random_vm, unit


@pytest.fixture(autouse=True)
def coarse(in_force):
    """Ownership grids small enough to settle in no time."""
    in_force(OccupancyConfig(scene_cells=30))


def ask(field, points):
    dirs = unit(np.random.default_rng(0).normal(size=(len(points), 3)))
    return tuple(a.numpy() for a in field.query(torch.from_numpy(points), torch.from_numpy(dirs)))


# -- parameters ----------------------------------------------------------------------------------------------


def test_sections_are_views_that_fill_the_vector():
    field = random_vm(resolution=(3, 4, 5))
    covered = torch.zeros(field.params.numel())
    assert field.layout.shape == (1, 14) and field.layout[0, 13] == len(field.params)  # no detail
    for offset, (name, view) in zip(field.layout[0, :13], field.sections(0).items(), strict=True):
        assert view.data_ptr() == field.params.data_ptr() + 8 * offset and offset % 16 == 0
        covered[offset : offset + view.numel()] += 1
        assert ("plane" in name, "line" in name, "basis" in name).count(True) == 1
    assert covered.max() == 1 and (covered == 0).sum() < 13 * 16


@pytest.mark.parametrize(
    "options, name",
    [
        ({"density_rank": 12}, "density_rank"),
        ({"colour_rank": 0}, "colour_rank"),
        ({"sh_degree": 4}, "sh_degree"),
        ({"sh_degree": -1}, "sh_degree"),
    ],
)
def test_shapes_the_kernels_cannot_serve_are_refused(options, name):
    with pytest.raises(ValueError, match=name):
        VMShape(**options)


def test_an_untrained_field_is_thin_fog():
    """The shift of the softplus is chosen for a few percent along the diagonal, whatever the box's size."""
    for size in (0.01, 1.0, 300.0):
        field = VMField.create(size * BOX, (9, 9, 9), THIRTY_TWO, torch.Generator().manual_seed(0))
        sigma, rgb = ask(field, points_in(size * BOX, 500))
        diagonal = np.linalg.norm(size * (BOX[3:] - BOX[:3]))
        assert 0.02 < 1 - np.exp(-sigma.mean() * diagonal) < 0.1
        assert (rgb > 0).all() and (rgb < 1).all()


def test_creation_follows_the_seed():
    a, b, c = (
        VMField.create(BOX, (4, 4, 4), SIXTY_FOUR, torch.Generator().manual_seed(s)).params for s in (1, 1, 2)
    )
    assert torch.equal(a, b) and not torch.equal(a, c)


def test_voxel_size_is_the_finest_in_the_fields_frame():
    matrix = np.diag([2.0, 0.5, 3.0, 1.0])
    field = random_vm(resolution=(5, 8, 7), aabb=np.array([0.0, 0, 0, 4, 7, 6]), matrix=matrix)
    assert field.voxel_size == pytest.approx(0.5)


# -- resampling ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_resampling_onto_the_same_is_the_identity(dtype):
    field = random_vm(dtype=dtype)
    same = field.resampled(field.aabb, (5, 8, 7))
    for (name, old), new in zip(field.sections(0).items(), same.sections(0).values(), strict=True):
        torch.testing.assert_close(new, old, rtol=1e-12, atol=1e-14, msg=name)


def test_resampling_is_exact_for_ramps():
    """Planes and lines that are linear stay the same functions on any texels within the box."""
    field = random_vm()
    for view in list(field.sections(0).values())[:-1]:
        grid = torch.meshgrid(
            *[torch.linspace(0, 1, n, dtype=torch.float64) for n in view.shape[:-1]], indexing="ij"
        )
        view.copy_(
            (sum((a + 1) * g for a, g in enumerate(grid)) - 1)[..., None]
            * torch.randn(view.shape[-1]).double()
        )
    smaller = np.array([-0.8, -1.0, -0.9, 0.9, 0.7, 1.0])
    other = field.resampled(smaller, (11, 4, 6)).with_occupancy(OccupancyGrid.full(smaller))
    points = points_in(smaller, 200)
    for found, wanted in zip(ask(other, points), ask(field, points), strict=True):
        np.testing.assert_allclose(found, wanted, rtol=1e-9)


def test_resampling_onto_finer_texels_keeps_the_field():
    field = random_vm(resolution=(3, 4, 5))
    finer = field.resampled(field.aabb, (9, 10, 13))
    points = points_in(BOX, 200)
    for found, wanted in zip(ask(finer, points), ask(field, points), strict=True):
        np.testing.assert_allclose(found, wanted, rtol=1e-9)


def test_a_grown_box_keeps_what_was_and_is_fog_outside():
    field = random_vm(resolution=(5, 8, 7))
    voxel = field.tensors[0].voxel_size
    grown = np.concatenate([BOX[:3] - 2 * voxel, BOX[3:] + 3 * voxel])
    other = field.resampled(grown, (10, 13, 12)).with_occupancy(OccupancyGrid.full(grown))
    points = points_in(BOX, 200)
    for found, wanted in zip(ask(other, points), ask(field, points), strict=True):
        np.testing.assert_allclose(found, wanted, rtol=1e-7)
    outside = np.concatenate([BOX[3:] + voxel * np.array([[1.5, 1.5, 1.5], [2.9, 0.5, 1.0]])])
    tensor = field.tensors[0]
    np.testing.assert_allclose(
        ask(other, outside)[0], tensor.scale * np.log1p(np.exp(tensor.shift)), rtol=1e-12
    )


# -- several blocks ------------------------------------------------------------------------------------------


def placed(x: float) -> np.ndarray:
    matrix = np.eye(4)
    matrix[0, 3] = x
    return matrix


def assembled(*places: float, dtype=torch.float64) -> VMField:
    """A field of one tensor per place along x, a third of its cells occupied."""
    fields = [random_vm(seed=i, cells=4, dtype=dtype) for i in range(len(places))]
    blocks = tuple(Block(i, placed(x), f"block {i}") for i, x in enumerate(places))
    tensors, params = tuple(f.tensors[0] for f in fields), torch.cat([f.params for f in fields])
    return VMField.assembled(fields[0].shape, tensors, blocks, params)


def test_several_blocks_need_owners():
    field = assembled(0.0, 3.0)
    with pytest.raises(ValueError, match="ownership"):
        VMField(field.shape, field.tensors, field.blocks, field.params, field.occupancy)


def test_one_unmoved_block_is_the_field_itself():
    field = random_vm(cells=4)
    again = VMField.assembled(field.shape, field.tensors, field.blocks, field.params)
    assert again.owners is None and again.occupancy.aabb is field.tensors[0].aabb
    points = points_in(BOX, 100)
    assert np.array_equal(ask(again, points)[0], ask(field, points)[0])


def test_blocks_apart_answer_as_if_alone():
    field = assembled(0.0, 10.0)
    for i, x in enumerate((0.0, 10.0)):
        alone, points = random_vm(seed=i, cells=4), points_in(BOX, 300)
        for found, wanted in zip(ask(field, points + [x, 0, 0]), ask(alone, points), strict=True):
            np.testing.assert_allclose(found, wanted, rtol=1e-9, atol=1e-12)


def test_two_overlapping_blocks_are_their_maximum():
    field = assembled(0.0, 0.7)
    points = points_in(field.aabb, 600)
    parts = [ask(random_vm(seed=i, cells=4), points - [x, 0, 0]) for i, x in enumerate((0.0, 0.7))]
    sigma, rgb = ask(field, points)
    second = parts[1][0] > parts[0][0]
    assert 0.1 < second.mean() < 0.9 and (sigma > 0).mean() > 0.2
    np.testing.assert_allclose(sigma, np.where(second, parts[1][0], parts[0][0]), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(
        rgb, np.where(second[:, None], parts[1][1], parts[0][1]), rtol=1e-9, atol=1e-12
    )


def test_owners_are_named_lower_first():
    first, second = assembled(0.0, 0.7, 0.3).owners
    both = second != NO_BLOCK
    assert (
        both.any() and (first[both] < second[both]).all() and (first[~both & (first != NO_BLOCK)] < 3).all()
    )


def test_blocks_in_one_place_are_settled_by_bounded_work(monkeypatch):
    """Where many meet in many cells, neighbours are asked as one: of blocks that differ everywhere alike the
    two densest still own all that they did, and cells that several make up are marked as one."""
    places = (0.0, 0.02, 0.04, 0.06, 0.08)
    whole = assembled(*places)
    asked, peaks = [], VMField.peaks

    def counted(self, lo, cell, cells, offsets, frame=0):
        asked.append(len(cells))
        return peaks(self, lo, cell, cells, offsets, frame)

    monkeypatch.setattr(VMField, "peaks", counted)
    module = "fusedrf_cli.engine.kinds.vm.field."
    limit = 3_000 * len(places) * len(PROBES) * whole.shape.density_rank
    monkeypatch.setattr(module + "MOST_PROBED", limit)
    monkeypatch.setattr(module + "MOST_MARKED", sum(t.occupancy.occupied.sum() for t in whole.tensors) // 4)
    found = assembled(*places)
    assert len(asked) == len(places) and max(asked) <= 3_000
    assert (found.occupancy.occupied >= whole.occupancy.occupied).all()
    crowded = (whole.owners[1] != NO_BLOCK) & (found.owners[1] != NO_BLOCK)
    alike = (whole.owners[0] == found.owners[0]) & (whole.owners[1] == found.owners[1])
    assert crowded.sum() > 3_000 and alike[crowded].mean() > 0.5


# -- storage -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("places", [(0.0,), (0.0, 0.7), (0.0, 0.7, 0.3)])
def test_state_round_trip_is_equal_to_the_bit(places):
    field = assembled(*places, dtype=torch.float32)
    arrays, metadata = field.state()
    again = VMField.from_state({name: a.copy() for name, a in arrays.items()}, metadata)
    arrays_again, metadata_again = again.state()
    assert metadata_again == metadata and arrays_again.keys() == arrays.keys()
    for name in arrays:
        assert arrays[name].tobytes() == arrays_again[name].tobytes(), name
    assert np.array_equal(field.occupancy.occupied, again.occupancy.occupied)
    if field.owners is not None:
        assert all(np.array_equal(a, b) for a, b in zip(field.owners, again.owners, strict=True))


@pytest.mark.parametrize("name", ["tensor_0.density_plane_1", "tensor_1.colour_basis", "tensor_1.occupancy"])
@pytest.mark.parametrize("how", ["missing", "shape"])
def test_an_array_that_does_not_fit_is_named(name, how):
    arrays, metadata = assembled(0.0, 0.7, dtype=torch.float32).state()
    arrays[name] = arrays[name][:-1]
    if how == "missing":
        del arrays[name]
    with pytest.raises(ValueError, match=f"'{name}'"):
        VMField.from_state(arrays, metadata)


def test_without_occupancy_all_is_occupied():
    tensor = VMTensor((2, 2, 2), BOX, 1.0)
    assert tensor.occupancy.occupied.all() and np.array_equal(tensor.occupancy.aabb, BOX)
