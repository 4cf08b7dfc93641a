"""Fields made smaller: what they will be stored with is told before, and bounds what they are stored with."""

from functools import partial

import numpy as np
import pytest
import torch

from fusedrf_cli.bridge.sizes import BundleSizes
from fusedrf_cli.engine.kinds import registry
from fusedrf_cli.engine.kinds.builder import StorageSetting
from fusedrf_cli.engine.kinds.reduction import coarser
from tests.engine.kinds.cases import random_boxed, random_vm, random_vm_mlp
from tests.engine.kinds.sparse_cases import random_sparse

MAKERS = {
    "vm": partial(random_vm, dtype=torch.float32, cells=4),
    "cp": partial(random_boxed, "cp", torch.float32),
    "dense": partial(random_boxed, "dense", torch.float32),
    "dense-mlp": partial(random_boxed, "dense-mlp", torch.float32),
    "vm-mlp": partial(random_vm_mlp, torch.float32, cells=4),
    "planes": partial(random_boxed, "planes", torch.float32),
}


PLAIN = StorageSetting()


def reduced(field, voxel: float, storage: StorageSetting = PLAIN):
    """(reduction, field) of a field for a voxel and a way."""
    kind = registry.kind(field.kind)
    found = kind.reduction(kind.outline(field), voxel, storage)
    return found, found.make(field)


@pytest.mark.parametrize("kind", MAKERS)
def test_coarser_texels_are_told_before_they_are_made(kind):
    field, sizes = MAKERS[kind](), BundleSizes()
    same, whole = reduced(field, 0.0)
    assert same.lossless and whole.resolution == field.resolution
    before = np.inf
    for times in (1.0, 2.0, 4.0, 1e9):
        told, small = reduced(field, times * field.voxel_size)
        assert told.lossless == (times == 1.0) and type(small) is type(field)
        assert small.resolution == coarser(field.aabb, field.resolution, times * field.voxel_size)
        for precision in ("float16", "int8", "int4"):
            assert sizes.exactly(small, precision) <= sizes.of(told.contents, precision)
        size = sizes.of(told.contents, "float16")
        assert size < before
        before = size
    assert small.resolution == (2, 2, 2)


@pytest.mark.parametrize("kind", ["vm", "cp", "dense"])
def test_fewer_bands_are_those_that_the_field_has(kind):
    """Without them it answers as with higher bands that are 0."""
    field = MAKERS[kind]()
    told, small = reduced(field, 0.0, StorageSetting(sh_degree=0))
    assert not told.lossless and small.shape.sh_degree == 0
    again = reduced(small, 0.0, StorageSetting(sh_degree=1))[0]
    assert again.lossless
    rng = np.random.default_rng(0)
    points = torch.from_numpy(field.aabb[:3] + rng.random((200, 3)) * (field.aabb[3:] - field.aabb[:3]))
    dirs = torch.from_numpy(rng.normal(size=(200, 3)))
    dirs /= dirs.norm(dim=1, keepdim=True)
    (sigma, rgb), (found, colour) = (f.reference(f.params, points, dirs) for f in (field, small))
    torch.testing.assert_close(found, sigma)
    assert torch.equal(colour, small.reference(small.params, points, -dirs)[1])
    assert not torch.allclose(rgb, field.reference(field.params, points, -dirs)[1])
    without = field.with_params(field.params.clone())
    drop_bands(without)
    torch.testing.assert_close(without.reference(without.params, points, dirs)[1], colour)


def drop_bands(field) -> None:
    """Set a field's SH bands above the first to 0."""
    own = field.shape.coefficients
    for name, part in field.sections().items():
        if name.endswith("basis"):
            part[:, 1:] = 0
        elif name == "colour":
            part[..., : 3 * own].unflatten(-1, (3, own))[..., 1:] = 0


def test_bricks_are_as_few_as_was_told():
    field, sizes = random_sparse(1, 0, torch.float32), BundleSizes()
    told, same = reduced(field, 0.0)
    assert told.lossless and same is field
    for precision in ("float16", "int8", "int4"):
        assert sizes.exactly(field, precision) <= 1.1 * sizes.of(told.contents, precision)
