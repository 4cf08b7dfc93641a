"""Edits of sparse fields are exactly local: numbers outside the touched box are the same bits."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from formats.records import as_stored
from fusedrf_cli.engine.composition.region import MaxOf
from fusedrf_cli.engine.fields.occupancy import OccupancyGrid
from fusedrf_cli.engine.kinds.sparse.bodies import SIDE
from fusedrf_cli.engine.kinds.sparse.bricks import Lattice
from fusedrf_cli.engine.kinds.sparse.editing import added, emptied, runs_box
from fusedrf_cli.engine.kinds.sparse.field import SparseField, SparseShape
from fusedrf_cli.engine.kinds.sparse.resample import resampled
from fusedrf_cli.engine.rendering.cameras import scattered
from fusedrf_cli.engine.rendering.metrics import psnr
from fusedrf_cli.engine.rendering.volume import render_image
from fusedrf_cli.engine.spaces import unbounded
from tests.analytic.fields import Tint
from tests.engine.composition.test_resample import ball, placed

BLUE = Tint.of(0.1, 0.2, 0.8)


@pytest.fixture(scope="module", params=[0, 1])
def red(request) -> SparseField:
    """A red ball."""
    return resampled(ball(voxel=0.06), SparseShape(request.param), 10**6)


def numbers_by_place(field: SparseField) -> dict:
    """Bytes of every free row and band by its place, rounded to what tells vertices apart."""
    found = {}
    for name, lattice, rows in (("rows", field.fine, field.rows), ("bands", field.coarse, field.bands)):
        if lattice is not None:
            for place, row in zip(np.round(lattice.places[: lattice.free], 6), rows.numpy(), strict=False):
                found[name, *place] = row.tobytes()
    return found


def outside(name_and_place: tuple, box: np.ndarray) -> bool:
    return bool(((np.array(name_and_place[1:]) < box[:3]) | (np.array(name_and_place[1:]) > box[3:])).any())


def likeness(field, truth, over) -> float:
    cameras = scattered(over, 4, 48, 48, seed=5)
    return psnr(*(np.stack([render_image(f, c).over((1, 1, 1)) for c in cameras]) for f in (field, truth)))


class Truth(MaxOf):
    """Placed fields in a common frame, for rendering."""

    def __init__(self, *fields):
        super().__init__(list(fields))
        boxes = np.stack([p.aabb for p in fields])
        self.aabb = np.concatenate([boxes[:, :3].min(0), boxes[:, 3:].max(0)])
        self.kind, self.occupancy, self.voxel_size = "truth", OccupancyGrid.full(self.aabb, 8), 0.02


@pytest.mark.parametrize("scale, at", [(0.5, (0.7, 0, 0)), (0.1, (0.75, 0.1, 0)), (2.0, (3.5, 0, 0))])
def test_what_is_added_shows_and_touches_nothing_else(red, scale, at):
    """Smaller and wider voxels than the field's, inside its box and far outside."""
    blue = placed(ball(voxel=0.06, tint=BLUE), scale, at)
    more = added(red, blue)
    before, after = numbers_by_place(red), numbers_by_place(more)
    kept = [key for key in before if outside(key, blue.aabb)]
    assert len(kept) > 50
    changed = [key for key in kept if key in after and after[key] != before[key]]
    assert not changed and sum(key in after for key in kept) > 0.99 * len(kept)
    truth = Truth(placed(ball(voxel=0.06)), blue)
    assert likeness(more, truth, blue.aabb) > 24 and likeness(red, truth, blue.aabb) < 20


def test_in_eight_bits_too_an_edit_touches_only_what_is_near():
    """Numbers share scales with others of their eight top cells alone. An object is put in at one end, one
    beyond the other end, so that the box grows by an odd number of top cells, and the first taken out."""

    def coded(field: SparseField) -> SparseField:
        return field.stored(lambda array, name, runs: as_stored(array, "int8", name, runs))

    first = coded(resampled(ball(voxel=0.03), SparseShape(1), 10**6))
    low, top = first.aabb[0], first.tree.top[0]
    small, far = (placed(ball(voxel=0.03, tint=BLUE), 0.1, (x, 0.1, 0)) for x in (0.9, low - 5.9 * top))
    fields = [first, coded(added(first, small))]
    fields.append(coded(added(fields[-1], far)))
    assert (fields[-1].tree.counts[0] - first.tree.counts[0]) % 2 == 1
    fields.append(coded(emptied(fields[-1], small.aabb, [])))
    for old, new, box in zip(fields, fields[1:], (small.aabb, far.aabb, small.aabb), strict=False):
        before, after = numbers_by_place(old), numbers_by_place(new)
        low, high = runs_box(new, box).reshape(2, 3)
        places = np.array([key[1:] for key in before])
        away = ((places < low) | (places > high)).any(1)
        kept = [key for key, far_off in zip(before, away, strict=True) if far_off]
        assert len(kept) > 0.3 * len(before) and all(after[key] == before[key] for key in kept)


def test_the_box_of_runs_holds_what_space_makes_of_it(red, rng):
    """In a place too, where boxes far out become thin ones: every point in the box lies in the found one."""
    tree = replace(red.tree, lo=np.full(3, -2.0), top=np.full(3, 4 / 40), counts=(40, 40, 40))
    field = SparseField(red.shape, Lattice(tree, SIDE), 1.0, space=unbounded)
    for low, high in (([0.2, -0.3, 0.1], [0.5, 0.3, 0.4]), ([-4, 0.5, 1.5], [-1, 3, 9])):
        found = runs_box(field, np.array([*low, *high], float))
        points = torch.from_numpy(rng.uniform(low, high, (500, 3)))
        cells = torch.floor((unbounded.contracted(points) + 2) * 10)
        for corner in (0, 1):  # of the top cell around each point
            corners = unbounded.placed((cells + corner) / 10 - 2).numpy()
            assert ((corners >= found[:3] - 1e-9) & (corners <= found[3:] + 1e-9)).all()


def test_added_and_deleted_it_is_as_before(red):
    """Where nothing was hidden, bit for bit outside the object's box, and nothing inside."""
    blue = placed(ball(voxel=0.06, tint=BLUE), 0.3, (1.2, 0.5, 0))
    less = emptied(added(red, blue), blue.aabb, [])
    before, after = numbers_by_place(red), numbers_by_place(less)
    assert {k: v for k, v in after.items() if outside(k, blue.aabb)} == {
        k: v for k, v in before.items() if outside(k, blue.aabb)
    }
    points = torch.from_numpy(np.random.default_rng(0).uniform(blue.aabb[:3], blue.aabb[3:], (2000, 3)))
    dirs = torch.eye(3, dtype=torch.float64)[[0] * 2000]
    np.testing.assert_array_equal(less.query(points, dirs, False)[0], red.query(points, dirs, False)[0])


def test_what_was_hidden_comes_back(red):
    """A ball over the red one's side, taken out again with the red one at hand."""
    red_ball = placed(ball(voxel=0.06))
    blue = placed(ball(voxel=0.06, tint=BLUE, density=200.0), 0.5, (0.7, 0, 0))
    less = emptied(added(red, blue), blue.aabb, [red_ball])
    kept = {k: v for k, v in numbers_by_place(red).items() if outside(k, blue.aabb)}
    after = numbers_by_place(less)
    assert all(after[key] == value for key, value in kept.items() if key in after)
    assert likeness(less, red, red.aabb) > 30


def test_without_anything_left_there_is_no_field(red):
    assert emptied(red, red.aabb, []) is None
