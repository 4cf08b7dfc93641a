"""A small random field of each kind, in float64, dense enough to see."""

from dataclasses import fields, replace
from functools import partial

import numpy as np
import torch

from fusedrf_cli.engine.encodings.hash_runs import HashGrid
from fusedrf_cli.engine.fields.box import BoxField
from fusedrf_cli.engine.fields.occupancy import OccupancyGrid
from fusedrf_cli.engine.kinds import registry
from fusedrf_cli.engine.kinds.box_kind import BoxKind
from fusedrf_cli.engine.kinds.builder import StorageSetting
from fusedrf_cli.engine.kinds.vm_mlp.field import VMMLPField, untrained
from tests.analytic.export import with_network

from ..conftest import BOX, SIXTY_FOUR, THIRTY_TWO, random_vm
from .sparse_cases import random_sparse

SLOW_TO_COMPILE = {"cp", "dense-mlp", "hash", "mlp", "planes", "vm-mlp"}
"""Kinds whose loops the quick tests do not wait for, where they try every kind."""


SMALL = {"width": 8, "hidden": 8, "levels": 3, "finest": 40, "log2_rows": 6, "count": 2, "colour": 8}
"""What random fields have of networks and levels."""


def random_detail(**kwargs):
    """A field with a hash grid that about half of its points ask for; 64 rows for thousands of
    vertices."""
    hashed = HashGrid((0.31, 0.07), 64, learns_from=2)
    return random_vm(cells=4, hashed=hashed, scale=300.0, shift=-6.0, **kwargs)


def random_vm_mlp(dtype=torch.float64, seed=0, cells=None, width=8) -> VMMLPField:
    """A vm-mlp field of random numbers whose colours differ; one shape for each type, since each is
    compiled."""
    shape = replace(SIXTY_FOUR if dtype == torch.float64 else THIRTY_TWO, sh_degree=2)
    generator = torch.Generator().manual_seed(seed)
    factors = random_vm(shape, dtype=dtype, seed=seed, cells=cells)
    weights = untrained(27, width, generator)
    return with_network(factors, weights)


def random_boxed(name: str, dtype=torch.float64, seed=0) -> BoxField:
    """A field of a kind over one box, of random numbers under a random occupancy, dense enough to see."""
    kind = registry.kind(name)
    shape = kind.shape(StorageSetting(ranks=(8, 16)))
    words = {field.name for field in fields(shape)} & SMALL.keys()
    shape = replace(shape, **{word: SMALL[word] for word in words})
    generator = torch.Generator().manual_seed(seed)
    grid = OccupancyGrid.full(BOX, 4)
    grid = OccupancyGrid(grid.aabb, np.random.default_rng(seed).random(grid.occupied.shape) < 0.4)
    field = kind.field(shape, BOX, (5, 8, 7), 3.0, -0.5, occupancy=grid)
    numbers = torch.randn(len(field.params), generator=generator, dtype=torch.float64)
    thin = 0.5 if name == "mlp" else 1.0  # its layers would make it opaque at once
    return field.with_params((thin * numbers).to(dtype))


KINDS = {
    "vm": lambda: random_vm(cells=4),
    "vm, detail": random_detail,
    "vm-mlp": lambda: random_vm_mlp(cells=4),
    "sparse": lambda: random_sparse(0, depth=0),
    "sparse, levels and bands": lambda: random_sparse(2, depth=2),
}
BOXED = [name for name in registry.names() if isinstance(registry.kind(name), BoxKind) and name not in KINDS]
KINDS |= {name: partial(random_boxed, name) for name in BOXED}


HOSTILE_ROWS = {
    "too few bits": ("_blocks", lambda a: a[:-1], "told by a bit"),
    "other bits": ("_blocks", np.zeros_like, "should be told"),
    "an empty block": ("_held", np.zeros_like, "none is"),
    "other rows": ("_held", lambda a: a ^ np.uint8(255), "none is|the runs of|beyond|should have shape"),
    "masks of another type": ("_held", lambda a: a.astype(np.int32), "should be told"),
    "no masks": ("_held", None, "should have shape"),
    "other runs": (".runs", lambda a: a[::-1] + np.uint8(1), "the runs of"),
    "fewer numbers": ("", lambda a: a[:-1], "should have shape"),
}
"""What may be wrong with the arrays of held rows: which of them, what becomes of it, and what is said."""


def damaged_rows(arrays: dict[str, np.ndarray], name: str, wrong: str) -> str:
    """Damage the arrays of the held rows of a name; what is to be said."""
    which, change, said = HOSTILE_ROWS[wrong]
    array = arrays.pop(name + which)
    if change is not None:
        arrays[name + which] = change(array)
    return said
