"""The history of a fused field stays short and tells of the same objects."""

import json

import numpy as np
import pytest

from formats.bundle import read_bundle
from fusedrf_cli.bridge.history import KEPT, nodes_of, summed_up

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
        short = summed_up((*short, entry))
        assert nodes_of(short) == nodes_of(whole) and len(short) <= 2 * KEPT
        assert list(short[-KEPT:]) == whole[-KEPT:]
    assert short[0]["event"] == "fused" and short[0]["kind"] == "blocks"
    assert short[0]["edits"] + len(short) == len(whole)


def test_two_thousand_edits_take_no_more_than_a_few(report, folder):
    """By the bytes of the history that a real edit leaves, once it was summed up."""
    report("fuse", "pair.json", "-o", "a.rfpack")
    report("move", "a.rfpack", "red", "-t", "0.1,0,0", "-o", "b.rfpack")
    fused, moved = read_bundle(folder / "b.rfpack").scene.history
    short = (fused,)
    for _ in range(2000):
        short = summed_up((*short, moved))
    assert len(json.dumps(short)) < 100_000 and short[0]["edits"] > 1900
