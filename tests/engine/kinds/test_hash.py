"""What only the hash grid does: levels come in as texels become finer, and grow with the bytes there are."""

import numpy as np
import pytest
import torch

from fusedrf_cli.engine.distillation.config import TrainConfig
from fusedrf_cli.engine.kinds import registry
from fusedrf_cli.engine.kinds.builder import StorageSetting

from ..conftest import BOX, points_in
from .cases import random_boxed

HASH = registry.kind("hash")


def points(count: int = 300) -> tuple[torch.Tensor, torch.Tensor]:
    """Points in the box, and one direction."""
    dirs = np.tile([0.0, 0.6, 0.8], (count, 1))
    return torch.from_numpy(points_in(BOX, count)), torch.from_numpy(dirs)


def test_levels_finer_than_half_a_texel_are_left_out():
    """By the reference: rows of such a level are of no account, those of the others are."""
    field = random_boxed("hash")
    for texels, left in ((3, 1), (13, 2), (20, 3)):
        coarse = field.resampled(field.box, (texels,) * 3)
        assert torch.equal(coarse.sections()["density_rows"], field.sections()["density_rows"])
        before, first = coarse.reference(coarse.params, *points())[0], 0
        for level, grid in enumerate(field.shape.grids):
            other = coarse.with_params(coarse.params.clone())
            other.sections()["density_rows"][first : first + grid["rows"]] = 1.0
            first += grid["rows"]
            same = torch.equal(other.reference(other.params, *points())[0], before)
            assert same == (level >= left), (texels, level)


def test_more_bytes_are_finer_levels_of_more_rows():
    finest, rows, numbers = [], [], []
    for longest in (16, 64, 256, 1024):
        shape = HASH.shape_at(StorageSetting(), (longest, 8, 8))
        finest.append(shape.finest)
        rows.append(shape.log2_rows)
        numbers.append(HASH.numbers(StorageSetting(), (longest, 8, 8)))
    assert finest == [32, 128, 512, 2048] and rows == [10, 14, 18, 19]
    assert numbers == sorted(set(numbers))


def test_a_grown_field_keeps_the_weights_that_read_its_rows():
    box, generator = np.array([0.0, 0, 0, 1, 1, 1]), torch.Generator().manual_seed(1)
    small = HASH.create(HASH.untrained(box, 16, StorageSetting()), generator)
    large = HASH.grown(small, HASH.untrained(box, 64, StorageSetting()))
    old, new = small.sections(), large.sections()
    assert large.resolution == (64, 64, 64) and new["density_rows"].shape > old["density_rows"].shape
    for name in old.keys() - {"density_rows"}:
        assert torch.equal(old[name], new[name])


def test_the_cube_is_as_wide_as_the_box_is_long():
    """A thin box has no finer vertices across than along."""
    thin = HASH.field(HASH.usual, np.array([-1.0, 0, 0, 3, 1, 0.1]), (40, 10, 4), 1.0)
    low, sides = thin.cube
    assert low.tolist() == [-1, 0, 0] and sides.tolist() == [4, 4, 4]


@pytest.mark.parametrize("kind", ["hash", "mlp"])
def test_learning_begins_with_few_texels_and_all_numbers(kind):
    kind, config = registry.kind(kind), TrainConfig(longest=64)
    field = kind.begun(BOX, config.longest, 16, StorageSetting(), torch.Generator().manual_seed(0))
    assert max(field.resolution) == 16
    assert len(field.params) == kind.numbers(
        StorageSetting(), kind.untrained(BOX, 64, StorageSetting()).resolution
    )


@pytest.mark.parametrize(
    "wrong",
    [{"levels": 0}, {"levels": True}, {"features": 17}, {"finest": 8}, {"log2_rows": 30}, {"hidden": 12}],
)
def test_a_shape_that_no_loop_was_written_for_is_refused(wrong):
    with pytest.raises(ValueError, match=f"'{next(iter(wrong))}' should be a .* from"):
        HASH.field.shape_type(**wrong)
