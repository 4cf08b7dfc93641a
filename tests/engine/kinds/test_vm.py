"""VM fields as objects: parameters, resampling, storage."""

import numpy as np
import pytest
import torch

from fusedrf_cli.engine.fields.occupancy import OccupancyGrid
from fusedrf_cli.engine.kinds.vm.field import VMField, VMShape
from tests.engine.conftest import BOX, SIXTY_FOUR, THIRTY_TWO, points_in, random_vm, unit


def ask(field, points):
    dirs = unit(np.random.default_rng(0).normal(size=(len(points), 3)))
    return tuple(a.numpy() for a in field.query(torch.from_numpy(points), torch.from_numpy(dirs)))


# -- parameters ----------------------------------------------------------------------------------------------


def test_sections_are_views_that_fill_the_vector():
    field = random_vm(resolution=(3, 4, 5))
    covered = torch.zeros(field.params.numel())
    assert len(field.starts) == 14 and field.starts[-1] == len(field.params)
    for offset, (name, view) in zip(field.starts[:-1], field.sections().items(), strict=True):
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
        field = VMField.create(THIRTY_TWO, size * BOX, (9, 9, 9), torch.Generator().manual_seed(0))
        sigma, rgb = ask(field, points_in(size * BOX, 500))
        diagonal = np.linalg.norm(size * (BOX[3:] - BOX[:3]))
        assert 0.02 < 1 - np.exp(-sigma.mean() * diagonal) < 0.1
        assert (rgb > 0).all() and (rgb < 1).all()


def test_creation_follows_the_seed():
    a, b, c = (
        VMField.create(SIXTY_FOUR, BOX, (4, 4, 4), torch.Generator().manual_seed(s)).params for s in (1, 1, 2)
    )
    assert torch.equal(a, b) and not torch.equal(a, c)


def test_voxel_size_is_the_finest():
    field = random_vm(resolution=(5, 8, 7), aabb=np.array([0.0, 0, 0, 4, 7, 3]))
    assert field.voxel_size == pytest.approx(0.5)


# -- resampling ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_resampling_onto_the_same_is_the_identity(dtype):
    field = random_vm(dtype=dtype)
    same = field.resampled(field.aabb, (5, 8, 7))
    for (name, old), new in zip(field.sections().items(), same.sections().values(), strict=True):
        torch.testing.assert_close(new, old, rtol=1e-12, atol=1e-14, msg=name)


def test_resampling_is_exact_for_ramps():
    """Planes and lines that are linear stay the same functions on any texels within the box."""
    field = random_vm()
    for view in list(field.sections().values())[:-1]:
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
    voxel = (BOX[3:] - BOX[:3]) / (np.array(field.resolution) - 1)
    grown = np.concatenate([BOX[:3] - 2 * voxel, BOX[3:] + 3 * voxel])
    other = field.resampled(grown, (10, 13, 12)).with_occupancy(OccupancyGrid.full(grown))
    points = points_in(BOX, 200)
    for found, wanted in zip(ask(other, points), ask(field, points), strict=True):
        np.testing.assert_allclose(found, wanted, rtol=1e-7)
    outside = np.concatenate([BOX[3:] + voxel * np.array([[1.5, 1.5, 1.5], [2.9, 0.5, 1.0]])])
    np.testing.assert_allclose(
        ask(other, outside)[0], field.scale * np.log1p(np.exp(field.shift)), rtol=1e-12
    )


# -- storage -------------------------------------------------------------------------------------------------


def test_state_round_trip_is_equal_to_the_bit():
    field = random_vm(dtype=torch.float32, cells=6)
    arrays, metadata = field.state()
    again = VMField.from_state({name: a.copy() for name, a in arrays.items()}, metadata)
    arrays_again, metadata_again = again.state()
    assert metadata_again == metadata and [*arrays_again] == [*arrays]
    for name in arrays:
        assert arrays[name].tobytes() == arrays_again[name].tobytes(), name
    assert np.array_equal(field.occupancy.occupied, again.occupancy.occupied) and again.name == "one"


def test_files_keep_their_words():
    """Those of version 1.0, which readers of any version know."""
    arrays, metadata = random_vm(SIXTY_FOUR, dtype=torch.float32, cells=4).state()
    factors = [
        f"{what}_{of}_{m}" for what in ("density", "colour") for of in ("plane", "line") for m in range(3)
    ]
    assert [*arrays] == [f"tensor_0.{name}" for name in (*factors, "colour_basis", "occupancy")]
    assert metadata == {
        "aabb": BOX.tolist(),
        "shape": {"density_rank": 8, "colour_rank": 16, "sh_degree": 3},
        "tensors": [
            {
                "resolution": [5, 8, 7],
                "aabb": BOX.tolist(),
                "scale": 3.0,
                "shift": -1.0,
                "occupancy": list(OccupancyGrid.full(BOX, 4).occupied.shape),
            }
        ],
        "blocks": [{"tensor": 0, "object_to_field": np.eye(4).tolist(), "name": "one"}],
    }


@pytest.mark.parametrize("name", ["tensor_0.density_plane_1", "tensor_0.colour_basis", "tensor_0.occupancy"])
@pytest.mark.parametrize("how", ["missing", "shape"])
def test_an_array_that_does_not_fit_is_named(name, how):
    arrays, metadata = random_vm(dtype=torch.float32, cells=4).state()
    arrays[name] = arrays[name][:-1]
    if how == "missing":
        del arrays[name]
    with pytest.raises(ValueError, match=f"'{name}'"):
        VMField.from_state(arrays, metadata)


def test_what_is_no_field_of_one_object_is_refused():
    """Several are read as nodes of a scene, before a field is made of any."""
    arrays, metadata = random_vm(dtype=torch.float32).state()
    (tensor,), (block,) = metadata["tensors"], metadata["blocks"]
    turned = block | {"object_to_field": np.diag([2.0, 1, 1, 1]).tolist()}
    for change, said in [
        ({"tensors": [tensor, tensor]}, "one tensor and one block of it, found 2 and 1"),
        ({"blocks": [block, block]}, "found 1 and 2"),
        ({"blocks": []}, "found 1 and 0"),
        ({"blocks": [block | {"tensor": 1}]}, "one block of it"),
        ({"blocks": [turned]}, "place it as it is"),
        ({"blocks": [block | {"tint": [1.0, 0.5, 1.0]}]}, "without a tint"),
    ]:
        with pytest.raises(ValueError, match=said):
            VMField.from_state(arrays, metadata | change)
