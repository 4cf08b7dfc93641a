"""A decoder that several dense-mlp fields share."""

from dataclasses import replace

import numpy as np
import torch

from fusedrf_cli.engine.distillation.optimiser import Adam
from fusedrf_cli.engine.kinds.dense_mlp.field import DenseMLPField, DenseMLPShape
from tests.engine.conftest import BOX, points_in, unit

SHAPE = DenseMLPShape(8, 8)


def a_field(seed: int, shape: DenseMLPShape = SHAPE) -> DenseMLPField:
    return DenseMLPField.create(shape, BOX, (5, 6, 7), torch.Generator().manual_seed(seed))


def decoder(field: DenseMLPField) -> dict[str, np.ndarray]:
    arrays = field.state()[0].items()
    return {name: array.copy() for name, array in arrays if name.startswith("decoder.")}


def test_a_shared_decoder_learns_no_further():
    sharing = a_field(0, replace(SHAPE, shared=True))
    shared = decoder(sharing)
    dirs = torch.from_numpy(unit(np.random.default_rng(0).normal(size=(50, 3))))
    optimiser, before = Adam.of(sharing), sharing.params.clone()
    points = torch.from_numpy(points_in(BOX, 50))
    sharing.query_backward(points, dirs, torch.ones(50), torch.ones(50, 3), optimiser.grads)
    optimiser.step(0.1)
    assert not torch.equal(sharing.params, before)
    assert all(np.array_equal(array, shared[name]) for name, array in decoder(sharing).items())
