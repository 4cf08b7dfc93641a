"""A small random field of each kind, in float64, dense enough to see."""

import numpy as np
import pytest
import torch

from fusedrf_cli.engine.composition.affine import Placed
from fusedrf_cli.engine.kinds.vm.blocks import blocks_of
from fusedrf_cli.engine.kinds.vm_mlp.field import VMMLPField, untrained
from tests.analytic.rays import affine, turn

from ..conftest import SIXTY_FOUR, random_vm
from .sparse_cases import random_sparse


def random_blocks():
    """Three overlapping, turned and stretched tensors in one field."""
    spots = affine(turn(30)), affine((0.7, -1.2, 0.9), (0.4, 0, 0)), affine(0.8, (-0.3, 0.2, 0))
    fields = [random_vm(SIXTY_FOUR, seed=seed, cells=5) for seed in range(3)]
    return blocks_of([Placed(f"n{i}", f, m) for i, (f, m) in enumerate(zip(fields, spots, strict=True))])


def random_vm_mlp(
    dtype=torch.float64, seed=0, cells=None, matrix=None, shape=SIXTY_FOUR, width=8
) -> VMMLPField:
    """A vm-mlp field of random numbers whose colours differ."""
    shape = type(shape)(shape.density_rank, shape.colour_rank, 2)
    generator = torch.Generator().manual_seed(seed)
    factors = random_vm(shape, dtype=dtype, seed=seed, cells=cells, matrix=matrix)
    weights = untrained(27, width, generator)
    return VMMLPField(factors, {name: view.to(dtype) for name, view in weights.items()})


KINDS = {
    "vm": lambda: random_vm(cells=4),
    "vm placed": lambda: random_vm(cells=4, matrix=affine(turn(25) @ np.diag([1, -0.8, 1.1]), (0.1, 0, 0))),
    "blocks": random_blocks,
    "vm-mlp": lambda: random_vm_mlp(cells=4, matrix=affine(turn(25) @ np.diag([1, -0.8, 1.1]), (0.1, 0, 0))),
    "sparse": lambda: random_sparse(0, depth=0),
    "sparse, levels and bands": lambda: random_sparse(2, depth=2),
}


@pytest.fixture(autouse=True)
def coarse_ownership(monkeypatch):
    """A grid that is made in no time."""
    monkeypatch.setattr("fusedrf_cli.engine.kinds.vm.field.OWNERSHIP_CELLS", 24)
