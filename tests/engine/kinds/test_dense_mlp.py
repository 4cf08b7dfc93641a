"""A decoder that several dense-mlp fields share."""

import numpy as np
import pytest
import torch

from fusedrf_cli.engine.distillation.optimiser import Adam
from fusedrf_cli.engine.kinds.dense_mlp.field import DenseMLPField, DenseMLPShape
from tests.engine.conftest import BOX, points_in, unit

SHAPE = DenseMLPShape(8, 8)


def a_field(seed: int, shape: DenseMLPShape = SHAPE) -> DenseMLPField:
    return DenseMLPField.create(shape, BOX, (5, 6, 7), torch.Generator().manual_seed(seed))


def decoder(field: DenseMLPField) -> dict[str, np.ndarray]:
    return {name: array for name, array in field.state()[0].items() if name.startswith("decoder.")}


def test_a_shared_decoder_is_the_others_and_learns_no_further():
    one, two = a_field(0), a_field(1)
    sharing = two.sharing(one)
    assert all(np.array_equal(array, decoder(one)[name]) for name, array in decoder(sharing).items())
    dirs = torch.from_numpy(unit(np.random.default_rng(0).normal(size=(50, 3))))
    optimiser, before = Adam.of(sharing), sharing.params.clone()
    points = torch.from_numpy(points_in(BOX, 50))
    sharing.query_backward(points, dirs, torch.ones(50), torch.ones(50, 3), optimiser.grads)
    optimiser.step(0.1)
    assert not torch.equal(sharing.params, before)
    assert all(np.array_equal(array, decoder(one)[name]) for name, array in decoder(sharing).items())


def test_a_decoder_that_does_not_fit_is_refused():
    with pytest.raises(ValueError, match="takes 16 features through 8 numbers, expected 8 through 8"):
        a_field(0).sharing(a_field(1, DenseMLPShape(16, 8)))
