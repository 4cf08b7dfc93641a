"""Small packs whose every part says which write it came from, so that a mixture of two cannot hide."""

import sys
from pathlib import Path

import numpy as np

from formats.bundle import BundleWriter, read_bundle
from formats.records import FieldRecord
from formats.scene import SceneGraph, make_node

GOLDEN = Path(__file__).parents[1] / "formats" / "golden"
FIELDS = 3
NUMBERS = 4000


def write_generation(path: Path | str, number: int, numbers: int = NUMBERS) -> None:
    """A pack at `path` that says `number`, 0 to 1000, in its history and in every value of three fields."""
    writer = BundleWriter()
    nodes = []
    for i in range(FIELDS):
        record = FieldRecord("dense", {"sigma": np.full(numbers + i, number)}, {"number": number})
        nodes.append(make_node(f"node-{i}", field=writer.add_field(record)))
    writer.write(path, SceneGraph(tuple(nodes), history=({"number": number},)), overwrite=True)


def generation_of(path: Path | str) -> int:
    """The number that all parts of a pack agree on; AssertionError where they do not."""
    bundle = read_bundle(path)
    (entry,) = bundle.scene.history
    assert len(bundle.fields) == FIELDS
    for record in bundle.fields.values():
        assert record.metadata == entry and set(record.arrays["sigma"].ravel().tolist()) == {entry["number"]}
    return entry["number"]


def keep_writing(path: str) -> None:
    """One generation after the other, until somebody ends this."""
    number = 0
    while True:
        number = number % 1000 + 1
        write_generation(path, number)


def keep_reading(path: str, times: str) -> None:
    """Open a pack again and again; tells how many generations were seen."""
    print(len({generation_of(path) for _ in range(int(times))}))


if __name__ == "__main__":
    {"write": keep_writing, "read": keep_reading}[sys.argv[1]](*sys.argv[2:])
