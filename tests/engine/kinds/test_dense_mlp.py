"""The decoder of dense-mlp fields: one that several share, and one that learns what harmonics show."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from fusedrf_cli.bridge.sizes import BundleSizes
from fusedrf_cli.engine.composition.composed import ComposedField
from fusedrf_cli.engine.distillation.optimiser import Adam
from fusedrf_cli.engine.kinds import registry
from fusedrf_cli.engine.kinds.builder import BuildRequest
from fusedrf_cli.engine.kinds.dense_mlp.field import DenseMLPField, DenseMLPShape
from tests.engine.composition.test_resample import ball, likeness, placed
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


@pytest.mark.parametrize(("width", "degree"), [(8, 0), (16, 1), (32, 2), (64, 3)])
def test_features_have_room_for_harmonics(width, degree):
    shape = DenseMLPShape(width)
    assert shape.sh_degree == degree and shape.numbers == 3 * (degree + 1) ** 2 <= width


@pytest.mark.slow
def test_a_student_begins_as_what_harmonics_show():
    """Density and features of a dense student, and a decoder that shows them before it has learnt from any
    picture."""
    scene = ComposedField([placed(ball(voxel=0.06))])
    made = {}
    for kind in ("dense", "dense-mlp"):
        builder = registry.kind(kind).builder(scene, BuildRequest(BundleSizes(), 3_000_000))
        plan = builder.plan(builder.plain(), 20_000)
        made[kind] = builder.fitted(plan)
    dense, network = made.values()
    assert dense.resolution == network.resolution
    (density, colour), (same, features, *_) = (one.sections().values() for one in (dense, network))
    assert torch.equal(same, density)
    assert torch.equal(features[dense.used][:, :12], colour[dense.used][:, :12])
    whole = builder.build(builder.plain(), 3_000_000)
    assert likeness(whole.field, scene, 64) > 28
