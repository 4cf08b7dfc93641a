"""The `assembled` kind: fields of the parts that their files name."""

import copy

import numpy as np
import pytest
import torch

from fusedrf_cli.engine.composition.affine import Placed
from fusedrf_cli.engine.composition.composed import ComposedField
from fusedrf_cli.engine.encodings import hash_grid
from fusedrf_cli.engine.fields.occupancy import OccupancyGrid
from fusedrf_cli.engine.kinds import registry
from fusedrf_cli.engine.kinds.assembled.field import PartsField, PartsShape

from ..conftest import BOX, points_in, unit

LEVELS = hash_grid.levels_of(3, 8, 3, 1.7)
GRID = {
    "density": {"part": "grid", "numbers": 1},
    "colour": {"part": "grid", "numbers": 27},
    "sigma": {"part": "density_sum", "activation": "relu"},
    "rgb": {"part": "sh", "coefficients": 9},
    "colour_activation": "relu",
}
HASH = {
    "density": {"part": "hash_grid", "features": 2, "levels": LEVELS},
    "colour": {"part": "trunk_features"},
    "sigma": {"part": "trunk", "hidden": 16, "outputs": 8, "activation": "exp"},
    "rgb": {"part": "mlp", "hidden": 16, "layers": 2, "frequencies": 0, "direction": "harmonics"},
}
NERF = HASH | {
    "density": {"part": "frequencies", "count": 3, "frame": True},
    "sigma": {"part": "trunk", "hidden": 16, "outputs": 16, "layers": 3, "skip": 1, "activation": "relu"},
}
SHAPES = {"grid": GRID, "hash": HASH, "nerf": NERF}


def field_of(words: dict) -> PartsField:
    """Of random numbers, half of whose cells are empty."""
    bare = PartsField(PartsShape(**copy.deepcopy(words)), BOX, (6, 7, 5), 2.0, 0.1)
    numbers = 0.5 * torch.randn(len(bare.params), generator=torch.Generator().manual_seed(0))
    cells = np.random.default_rng(0).random((4, 3, 5)) < 0.5
    return bare.with_params(numbers).with_occupancy(OccupancyGrid(BOX, cells))


def asked(count: int = 300) -> tuple[torch.Tensor, torch.Tensor]:
    dirs = unit(np.random.default_rng(1).normal(size=(count, 3)))
    return torch.from_numpy(points_in(BOX, count)), torch.from_numpy(dirs)


@pytest.mark.parametrize("name", SHAPES)
def test_a_bundle_gives_the_same_field(name):
    field = field_of(SHAPES[name])
    arrays, metadata = field.state()
    again = PartsField.from_state(arrays, metadata)
    points, dirs = asked()
    for one, other in zip(
        field.answers(field.params, points, dirs), again.answers(again.params, points, dirs), strict=True
    ):
        assert torch.equal(one, other)
    needed = PartsField.needs(metadata, {name: a.shape for name, a in arrays.items()}, arrays.__getitem__)
    assert needed.held >= 4 * again.params.numel()


@pytest.mark.parametrize("name", SHAPES)
def test_a_part_that_is_cut_answers_as_the_whole(name):
    """Also where numbers are of the whole cube, as rows of a hash grid and networks are."""
    field = field_of(SHAPES[name])
    middle = (BOX[:3] + BOX[3:]) / 2
    part = registry.kind("assembled").cropped(field, lambda points: (points > middle).all(1))
    points, dirs = asked(2000)
    inside = torch.from_numpy((points.numpy() > middle + 0.2 * (BOX[3:] - BOX[:3])).all(1))
    whole, cut = (f.answers(f.params, points, dirs) for f in (field, part))
    torch.testing.assert_close(cut[0][inside], whole[0][inside], rtol=1e-4, atol=1e-5)
    assert (cut[0][(points.numpy() < middle).any(1)] == 0).all() and (whole[0][inside] > 0).any()


@pytest.mark.parametrize(
    "slot, changes, says",
    [
        ("density", {"part": "grids"}, "'part' of"),
        ("density", {"part": "sh"}, "'part' of"),
        ("density", {"numbers": 10**9}, "numbers"),
        ("density", {"numbers": 1, "rank": 8}, "rank"),
        ("rgb", {"coefficients": 5}, "coefficients"),
        ("sigma", {"activation": "tanh"}, "activation"),
        ("sigma", {"limits": [0, 1e9]}, "limits"),
        ("colour", {"part": "trunk_features"}, "trunk"),
        ("colour", "grid", "part"),
    ],
)
def test_shapes_that_no_field_has_are_refused(slot, changes, says):
    entry = changes if isinstance(changes, str) else GRID[slot] | changes
    if isinstance(entry, dict) and entry["part"] == "trunk_features":
        entry = {"part": "trunk_features"}
    with pytest.raises((ValueError, AttributeError), match=says):
        PartsShape(**{**GRID, slot: entry})


def test_layers_and_rows_have_limits():
    for words in ({"hidden": 10**6}, {"layers": 10**6}, {"skip": 1}):
        with pytest.raises(ValueError, match=next(iter(words))):
            PartsShape(**{**HASH, "sigma": HASH["sigma"] | words})
    level = LEVELS[0] | {"rows": 6, "hashed": True}
    with pytest.raises(ValueError, match="power of two"):
        PartsShape(**{**HASH, "density": HASH["density"] | {"levels": [level]}})
    with pytest.raises(ValueError, match="colour_activation"):
        PartsShape(**{**GRID, "colour_activation": "tanh"})


def test_a_box_far_from_the_origin_is_not_encoded():
    field = PartsField(PartsShape(**NERF), BOX + 1e5, (2, 2, 2), 1.0)
    with pytest.raises(ValueError, match="within"):
        field.check_answers()


def test_nothing_is_fused_to_it():
    scene = ComposedField([Placed("a", field_of(GRID), np.eye(4))], "max")
    assert registry.kind("assembled").suits(scene).score is None
