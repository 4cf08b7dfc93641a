"""Laws that a field of every kind keeps: rendering, learning, storing, moving."""

from inspect import isfunction

import numpy as np
import pytest
import torch

from formats.records import FieldRecord, as_stored, decode_field, encode_field
from fusedrf_cli.bridge.scene import make_field
from fusedrf_cli.engine.fields.computed import Batch, ComputedField
from fusedrf_cli.engine.rendering.volume import march_rays, reach_of, render_rays
from fusedrf_cli.errors import InvalidInput
from tests.bundles import field_kinds
from tests.engine.conftest import points_in, rays_at, unit
from tests.engine.kinds.cases import KINDS, SLOW_TO_COMPILE  # noqa: F401  (a fixture)

# a tensor that is placed in a frame whose grid was not made from it does not come back with the same grid
FIELDS = {name: make for name, make in KINDS.items() if "placed" not in name}


TRIED = [pytest.param(name, marks=pytest.mark.slow) if name in SLOW_TO_COMPILE else name for name in FIELDS]


@pytest.fixture(params=TRIED)
def field(request):
    return FIELDS[request.param]()


def asked(field, count: int = 400):
    dirs = unit(np.random.default_rng(3).normal(size=(count, 3)))
    return torch.from_numpy(points_in(field.aabb, count, margin=0.05)), torch.from_numpy(dirs)


def answers(field, points, dirs):
    """Of a field in float32, by the reference: its loops are compiled for float64 alone."""
    return field.answers(field.params, points.float(), dirs.float())


def test_every_kind_of_field_is_tried():
    assert {make().kind for make in FIELDS.values()} == set(field_kinds())


def test_no_kind_hides_what_every_computed_field_does():
    """A property of the same name once did: the weights of cells were those of a network."""
    methods = [name for name, value in vars(ComputedField).items() if isfunction(value)]
    assert len(methods) > 5
    for make in FIELDS.values():
        for name in methods:
            assert isfunction(getattr(type(make()), name)), (make().kind, name)


def test_one_pass_renders_what_the_general_renderer_does(field):
    """At steps so fine that it does not matter for how many of them a sample stands; both composite by the
    same rule, one without the colours of samples that weigh next to nothing."""
    rays_o, rays_d = rays_at(field.aabb, 150)
    step = 0.05 * field.voxel_size
    fast = render_rays(field, rays_o, rays_d, step=step)
    slow = np.zeros_like(fast)
    march_rays(field, rays_o, rays_d, reach_of(len(rays_o), 0.0, np.inf), step, 1e-3, slow)
    assert fast[:, 3].max() > 0.5
    np.testing.assert_allclose(fast, slow, atol=0.04)


def test_the_gradient_of_a_loss_is_that_of_finite_differences(field):
    """Of single numbers that the rays meet."""
    rays_o, rays_d = rays_at(field.aabb, 24)
    target = np.random.default_rng(1).random((24, 4))
    batch = Batch(
        rays_o, rays_d, np.full(24, 0.5), target, np.ones((24, 3)), 0.1, 0.0, 0.5 * field.voxel_size, 1e-3
    )

    def loss_of(params: torch.Tensor) -> tuple[float, np.ndarray]:
        held = field.with_params(params)
        held.settle()
        grads, loss = np.zeros((1, len(params))), np.zeros((1, 3))
        held.train_rays(batch, grads, loss)
        return (loss[0, 0] + 0.1 * loss[0, 1]) / 24, grads[0]

    _, gradient = loss_of(field.params)
    free = np.ones(len(gradient), bool)
    for low, high in field.dependent():
        free[low:high] = False
    most = np.argsort(-np.abs(np.where(free, gradient, 0)))[:12]
    assert abs(gradient[most[-1]]) > 0
    for i in most:
        ends = []
        for sign in (1, -1):
            params = field.params.clone()
            params[i] += sign * 1e-6
            ends.append(loss_of(params)[0])
        wanted = (ends[0] - ends[1]) / 2e-6
        assert gradient[i] == pytest.approx(wanted, rel=1e-4, abs=1e-8)


def test_a_bundle_gives_back_what_it_was_given(field):
    points, dirs = asked(field)
    record = FieldRecord(field.kind, *field.state())
    arrays = {
        name: np.asarray(a, np.float32) if a.dtype.kind == "f" else a for name, a in record.arrays.items()
    }
    back = make_field(FieldRecord(field.kind, arrays, record.metadata), "bundle")
    for found, wanted in zip(answers(back, points, dirs), field.query(points, dirs), strict=True):
        torch.testing.assert_close(found.double(), wanted, rtol=1e-3, atol=1e-3)
    again = {**arrays, **dict(back.state()[0].items())}
    assert all(np.array_equal(again[name], arrays[name]) for name in arrays)


def test_as_stored_is_as_it_comes_back(field):
    """In every precision, to the bit."""
    single = field.with_params(field.params.float())
    points, dirs = asked(field)
    for precision in ("float32", "float16", "int8", "int4"):
        told = single.stored(lambda array, name, runs, p=precision: as_stored(array, p, name, runs))
        data = encode_field(FieldRecord(field.kind, *single.state()), precision)
        read = make_field(decode_field(data, "bundle"), "bundle")
        for found, wanted in zip(*(answers(one, points, dirs) for one in (told, read)), strict=True):
            assert torch.equal(found, wanted)


@pytest.mark.parametrize("fault", ["missing", "shape", "infinite", "metadata"])
def test_a_hostile_state_is_refused_in_a_sentence(field, fault):
    arrays, metadata = field.state()
    floats = [name for name, array in arrays.items() if array.dtype.kind == "f" and array.size]
    for name in floats:
        broken, words = dict(arrays), dict(metadata)
        if fault == "missing":
            del broken[name]
        elif fault == "shape":
            broken[name] = arrays[name][..., :-1]
        elif fault == "infinite":
            broken[name] = np.full_like(arrays[name], 1e38)
        else:
            words = {key: None for key in metadata}
        with pytest.raises(InvalidInput, match=f"the '{field.kind}' field is malformed"):
            make_field(FieldRecord(field.kind, broken, words), "bundle")
