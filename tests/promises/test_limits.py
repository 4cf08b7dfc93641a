"""What a pack may cost before it is trusted: hostile sizes are judged by numbers, not by allocating them."""

import json
import subprocess
import sys
import time
from pathlib import Path

import pytest

from formats import errors, field_header, safe_input, scene
from formats.archive import MAX_MEMBERS, write_archive
from formats.bundle import member_name
from formats.camera_set import MAX_CAMERAS
from formats.field_header import MAX_HEADER
from formats.names import MAX_NAME_BYTES
from formats.scene import SceneGraph, dump_scene, make_node, parse_scene, write_scene
from formats.sources import expand_scene
from tests.formats.test_records import HOSTILE as BAD_FIELDS
from tests.formats.test_scene import REFUSED as BAD_SCENES
from tests.formats.test_scene import nested, scene_json
from tests.promises.fuzz import command

ROOT = Path(__file__).parents[2]
# Reads a file by the reader named first, and tells the seconds of computing and the growth in MB.
MEASURED = """
import json, re, sys, time
import formats.bundle
from formats.errors import FormatError
from tests.promises.packs import GOLDEN
formats.bundle.read_bundle(GOLDEN / "lamp.rfpack")  # what is made once is made now
if len(sys.argv) > 2:
    import formats.safe_input
    formats.safe_input.MAX_VALUES = formats.safe_input.MAX_KEYS = float("inf")
def peak():  # getrusage would tell of the process that started this one
    return int(re.search(r"VmHWM:\\s+([0-9]+)", open("/proc/self/status").read())[1]) / 1024
before, began = peak(), time.process_time()
try:
    formats.bundle.read_summary(sys.argv[1])
    formats.bundle.read_bundle(sys.argv[1])
    error = None
except FormatError as found:
    error = type(found).__name__
print(json.dumps({"error": error, "seconds": time.process_time() - began, "grown": peak() - before}))
"""
HEAD = b'{"format": "rfpack", "version": "1.0", '
FULL = 4_190_000  # bytes: almost as much as a scene may have


def many(part: bytes, end: bytes) -> bytes:
    return HEAD + b'"x": [' + part * (FULL // len(part)) + end + b'], "nodes": []}'


def rigged(**columns) -> bytes:
    return scene_json(cameras={"focus": [0, 0, 0], "distance": 1, **columns})


KEYS = b",".join(b'"%d":0' % i for i in range(190_000))
ENTRIES = b",".join(b'{"":%d}' % i for i in range(190_000))
SCENES = {
    "190,000 small objects": HEAD + b'"nodes": [' + ENTRIES + b"]}",
    "4 MB of objects": many(b"{},", b"{}"),
    "4 MB of lists": many(b"[],", b"[]"),
    "4 MB of numbers": many(b"0,", b"0"),
    "4 MB of text": HEAD + b'"nodes": 1, "x": "' + b"a" * FULL + b'"}',
    "4 MB of digits": HEAD + b'"x": ' + b"9" * FULL + b"}",
    "a key twice after 190,000 others": b"{" + KEYS + b',"0":1}',
    "lists in lists": b"[" * FULL,
    "more than 4 MB": b" " * (4 << 20) + b"{}",
    "10,001 nodes": scene_json(*[{"name": str(i)} for i in range(10_001)]),
    "65 levels": nested(65),
    "10,001 cameras": rigged(names=["a"] * 10_001),
    "4 MB of lenses": rigged(lenses=[[1] * 16] * 80_000),
}


def sealed_scene(text: bytes) -> bytes:
    return sealed(("scene.json", text))


def sealed(*members: tuple[str, bytes]) -> bytes:
    import io

    file = io.BytesIO()
    write_archive(file, members)
    return file.getvalue()


EMPTY = ("scene.json", dump_scene(SceneGraph(())))


def sealed_field(data: bytes) -> bytes:
    return sealed(EMPTY, (member_name(data), data))


def header_of(count: int) -> bytes:
    """A field whose header has many empty arrays."""
    entry = {"dtype": "F32", "shape": [0], "data_offsets": [0, 0]}
    text = json.dumps({f"a{i}": entry for i in range(count)}).encode()
    return len(text).to_bytes(8, "little") + text


PACKS = {
    **{name: sealed_scene(text) for name, text in SCENES.items()},
    "a header of 1 TB": sealed_field((1 << 40).to_bytes(8, "little") + bytes(100)),
    "a header of 2 MB": sealed_field(header_of(40_000)),
    "10,000 arrays": sealed_field(header_of(10_000)),
    "an array of 2^93 bytes": sealed_field(BAD_FIELDS["too large"][0]),
    "too many members": sealed(*((f"m{i}", b"") for i in range(MAX_MEMBERS + 1))),
}


def measured(path: Path, *words: str) -> dict:
    run = subprocess.run(
        [sys.executable, "-c", MEASURED, path, *words], cwd=ROOT, capture_output=True, text=True, check=True
    )
    return json.loads(run.stdout)


linux = pytest.mark.skipif(
    not Path("/proc/self/status").exists(), reason="the peak of memory is read in /proc"
)


@linux
@pytest.mark.parametrize("name", PACKS)
def test_a_hostile_pack_is_refused_soon_and_cheaply(tmp_path, name):
    """P14: the bar is 0.5 s and 100 MB; the seconds allowed here leave room for a machine that is busy."""
    (tmp_path / "a").write_bytes(PACKS[name])
    found = measured(tmp_path / "a")
    assert found["error"] is not None and found["seconds"] < 3 and found["grown"] < 100, found


@linux
def test_a_sparse_file_of_a_terabyte_is_refused_by_its_size(tmp_path):
    """P14."""
    with open(tmp_path / "a", "wb") as file:
        file.write(b"PK\3\4")
        file.truncate(1 << 40)
    found = measured(tmp_path / "a")
    assert found["error"] == "LimitExceeded" and found["seconds"] < 1 and found["grown"] < 10


@linux
def test_without_the_limit_on_values_the_cost_is_there(tmp_path):
    """P14 with its defence removed."""
    (tmp_path / "a").write_bytes(PACKS["4 MB of objects"])
    with_limit, without = measured(tmp_path / "a"), measured(tmp_path / "a", "without")
    assert without["grown"] > with_limit["grown"] + 50 and without["seconds"] > 10 * with_limit["seconds"]


# --- graphs -------------------------------------------------------------------------------------------------


def doubling(folder: Path, levels: int) -> Path:
    """Scene files of which each names the next twice."""
    (folder / f"{levels}.json").touch()
    for i in range(levels):
        twice = tuple(make_node(name, source=f"{i + 1}.json") for name in "ab")
        write_scene(folder / f"{i}.json", SceneGraph(twice))
    return folder / "0.json"


def own_parent(folder: Path) -> Path:
    write_scene(folder / "a.json", SceneGraph((make_node("n", source="a.json"),)))
    return folder / "a.json"


def written(text: bytes):
    def write(folder: Path) -> Path:
        (folder / "a.json").write_bytes(text)
        return folder / "a.json"

    return write


def chain(levels: int) -> bytes:
    """As `nested`, deeper than a writer could go."""
    parts = b"".join(b'[{"name": "%d", "children": ' % i for i in range(levels))
    return HEAD + b'"nodes": ' + parts + b"[]" + b"}]" * levels + b"}"


def growing(levels: int) -> bytes:
    """Every level ten times as large as the one around it."""
    root = {"name": "leaf"}
    for i in range(levels):
        root = {"name": str(i), "scale": [10, 10, 10], "children": [root]}
    return scene_json(root)


GRAPHS = {
    "64 levels that double": (lambda folder: doubling(folder, 64), errors.LimitExceeded),
    "its own parent": (own_parent, errors.CyclicScene),
    "10,001 nodes": (written(SCENES["10,001 nodes"]), errors.LimitExceeded),
    "a chain of 10,000": (written(chain(10_000)), errors.BadJson),
    "a chain of 65": (written(nested(65)), errors.LimitExceeded),
    "60 scales of 10": (written(growing(60)), errors.SingularTransform),
    "a node twice": (written(scene_json({"name": "n"}, {"name": "n"})), errors.DuplicateName),
}


@pytest.mark.parametrize("name", GRAPHS)
def test_a_graph_that_is_no_bounded_tree_is_refused_at_once(tmp_path, name):
    """P13: the bar is 1 s of computing; ten times that for a busy machine."""
    write, error = GRAPHS[name]
    path = write(tmp_path)
    began = time.process_time()
    with pytest.raises(error):
        expand_scene(path)
    assert time.process_time() - began < 10


def test_without_a_count_a_graph_unfolds(tmp_path):
    """P13 with its defence removed: nine small files make 766 nodes."""
    path = doubling(tmp_path, 8)
    (tmp_path / "8.json").write_bytes(scene_json({"name": "leaf"}))
    with pytest.raises(errors.LimitExceeded, match="unfold"):
        expand_scene(path, most=400)
    assert sum(1 for _ in expand_scene(path).walk()) == 2 * (2**8 - 1) + 2**8


# --- numbers ------------------------------------------------------------------------------------------------

NUMBERS = {
    **{f"scene, {name}": sealed_scene(data) for name, (data, _) in BAD_SCENES.items()},
    **{f"field, {name}": sealed_field(data) for name, (data, _) in BAD_FIELDS.items()},
}


@pytest.mark.parametrize("name", NUMBERS)
def test_numbers_that_mean_nothing_are_refused_by_the_command_line(tmp_path, name):
    """P12: each fault has its class in tests/formats; here each ends as exit 3 or 4 and one sentence."""
    (tmp_path / "a").write_bytes(NUMBERS[name])
    assert command("validate")(str(tmp_path / "a")) is False


@pytest.mark.parametrize(
    ("name", "attribute", "instead"),
    [("nan", "_refuse", lambda _: 0.0), ("1e999", "_finite", float), ("2^63", "_bounded", int)],
)
def test_without_strict_numbers_they_get_in(monkeypatch, name, attribute, instead):
    """P12 with its defences removed, one by one."""
    data = BAD_SCENES[name][0]
    if name != "nan":
        data = scene_json().replace(b"{", data[:-1] + b", ", 1)
    with pytest.raises(errors.BadJson):
        parse_scene(data, "here")
    monkeypatch.setattr(safe_input, attribute, instead)
    parse_scene(data, "here")


def test_limits_are_those_of_the_specification():
    """The format's limits are its readers' common ground: what one writes, all others read."""
    spec = (ROOT / "formats" / "SPEC.md").read_text()
    for words in (
        "at most 10,001 members",
        "at most 1 MiB",
        "at most 4 MiB",
        "at most 10,000 nodes, 64 levels",
        "of each camera, 1 to 10,000: printable text of 1 to 200 bytes",
    ):
        assert words in spec
    assert (MAX_CAMERAS, MAX_NAME_BYTES) == (10_000, 200)
    assert (MAX_MEMBERS, MAX_HEADER, scene.MAX_SCENE_BYTES) == (10_001, 1 << 20, 4 << 20)
    assert f"{safe_input.MAX_VALUES:,}" in spec and f"{safe_input.MAX_KEYS:,}" in spec
    assert f"{safe_input.MAX_NESTING} levels" in spec
    assert "those of a field 8 GiB" in spec and field_header.MAX_DECODED_BYTES == 8 << 30
