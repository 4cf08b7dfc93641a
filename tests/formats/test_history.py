"""The history of a fused field stays short and tells of the same objects."""

import json

import numpy as np
import pytest

from formats.history import KEPT, distilled, sources, summed_up

NAMES = [f"o{i}" for i in range(12)]


def edits(count: int, seed: int):
    """Random additions, deletions and moves of a dozen objects, as entries of a history."""
    rng = np.random.default_rng(seed)
    yield {"event": "fused", "kind": "blocks", "nodes": [{"name": name, "at": 0} for name in NAMES[:3]]}
    for number in range(1, count):
        name = NAMES[rng.integers(len(NAMES))]
        if rng.random() < 0.3:
            yield {"event": "deleted", "names": [name]}
        elif rng.random() < 0.3:
            other = NAMES[rng.integers(len(NAMES))]
            entry = {"event": "renamed", "nodes": [{"name": other, "at": number}]}
            yield entry | ({"names": [name]} if name != other else {})
        else:
            yield {"event": "added", "nodes": [{"name": name, "at": number}]}


@pytest.mark.parametrize("seed", range(4))
def test_a_short_history_tells_of_the_same_objects(seed):
    whole, short = [], ()
    for entry in edits(400, seed):
        whole.append(entry)
        short = summed_up((*short, entry), ())
        assert distilled(short) == distilled(whole) and len(short) <= 2 * KEPT
        assert list(short[-KEPT:]) == whole[-KEPT:]
    assert short[0]["event"] == "fused" and short[0]["kind"] == "blocks"
    assert short[0]["edits"] + len(short) == len(whole)


def test_two_thousand_edits_take_no_more_than_a_few():
    moved = {"event": "moved", "objects": ["red"], "before": "0" * 64}
    short = ({"event": "fused", "kind": "blocks", "objects": ["red"], "nodes": []},)
    for _ in range(2000):
        short = summed_up((*short, moved), ())
    assert len(json.dumps(short)) < 10_000 and short[0]["edits"] > 1900


def test_what_a_field_was_made_of_is_told_as_long_as_it_is_there():
    made_of = {f"fields/{i}": {"field": "f", "sha256": str(i)} for i in range(3)}
    first = {"event": "fused", "sources": {m: made_of[m] for m in ("fields/0", "fields/1")}}
    added = {"event": "added", "objects": ["a"], "sources": {"fields/2": made_of["fields/2"]}}
    whole = (first, added, *({"event": "moved", "objects": ["a"]},) * 2 * KEPT)
    assert sources(whole) == made_of
    assert sources(summed_up(whole, ("fields/0", "fields/2"))) == {
        m: made_of[m] for m in ("fields/0", "fields/2")
    }
