"""Which rows a file holds: there and back, of any number of rows."""

import numpy as np
import pytest

from fusedrf_cli.engine.fields.stored_rows import StoredRows, folded, unfolded


@pytest.mark.parametrize("count", [4, 60, 64, 68, 4096, 5000])
def test_rows_come_back(count):
    numbers = np.random.default_rng(count).normal(size=(count, 3)).astype(np.float32)
    numbers[np.random.default_rng(1).random(count // 4).repeat(4) < 0.9] = 0
    numbers[-1] = 1.0
    arrays = folded("rows", numbers)
    assert np.array_equal(unfolded("rows", (count, 3), arrays), numbers)
    held = StoredRows.other_than_0(numbers)
    assert held.count == 4 * numbers.reshape(-1, 12).any(1).sum() and held.lengths.sum() == held.count
    if count > 1000:
        assert len(arrays["rows"]) == held.count < 0.3 * count


def test_rows_that_are_mostly_there_are_stored_whole():
    numbers = np.ones((256, 4), np.float32)
    numbers[:32] = 0
    assert folded("rows", numbers).keys() == {"rows"} and folded("rows", numbers[:63]).keys() == {"rows"}


def test_the_first_rows_are_held_alone():
    held = StoredRows.other_than_0(np.ones((200, 2)))
    assert held.first(72).count == 72 and held.first(0).count == 0 and held.first(200).count == 200
    assert not held.first(72).rows[72:].any()


def test_rows_beyond_the_last_are_refused():
    numbers = np.zeros((72, 2), np.float32)
    numbers[70] = 1
    state = StoredRows.other_than_0(numbers).state()
    with pytest.raises(ValueError, match="beyond the 68"):
        StoredRows.from_state(state["blocks"], state["held"], 68)


def test_no_rows_take_more_to_tell_than_those_that_are_spread():
    """Of all choices of as many runs of some, drawn at random and the densest."""
    rng = np.random.default_rng(0)
    some = StoredRows(rng.random(16 * 40) < 0.6, 64 * 40)
    for count in (4, 100, 160, 400, some.count):
        spread = some.spread(count)
        assert spread.count == count and not (spread.runs & ~some.runs).any()
        for order in (np.arange(some.count // 4), *(rng.permutation(some.count // 4) for _ in range(20))):
            runs = np.zeros_like(some.runs)
            runs[np.flatnonzero(some.runs)[order[: count // 4]]] = True
            assert StoredRows(runs, some.all).told(4) <= spread.told(4)
