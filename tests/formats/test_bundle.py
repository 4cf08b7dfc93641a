"""The bundle: golden bytes, round trips, and no damaged byte that goes unseen."""

import hashlib
import io
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from formats import errors
from formats.archive import parse_archive, write_archive
from formats.bundle import (
    Bundle,
    BundleWriter,
    OpenBundle,
    is_bundle,
    member_name,
    read_bundle,
    read_headers,
    read_summary,
    sha256_of,
    world_aabb,
)
from formats.records import FieldRecord, encode_field
from formats.scene import SceneGraph, dump_scene, make_node, write_scene
from tests.bundles import parse_bundle, write_single

ROOT = Path(__file__).parents[2]
GOLDEN = Path(__file__).parent / "golden" / "lamp.rfpack"
SPEC = Path(__file__).parents[2] / "formats" / "SPEC.md"
LAMP = FieldRecord("dense", {"sigma": np.array([[[0.5]], [[2.0]]])}, {"aabb": [0, 0, 0, 2, 1, 1]})


def lamp_writer() -> tuple[BundleWriter, SceneGraph]:
    writer = BundleWriter()
    member = writer.add_field(LAMP)
    return writer, SceneGraph((make_node("lamp", field=member, translation=[1, 0, 0.5]),))


def sealed(*members: tuple[str, bytes]) -> bytes:
    file = io.BytesIO()
    write_archive(file, members)
    return file.getvalue()


def assert_same(bundle: Bundle, scene: SceneGraph, records: dict[str, FieldRecord]):
    assert bundle.scene == scene and bundle.fields.keys() == records.keys()
    for name, record in records.items():
        found = bundle.fields[name]
        assert (found.kind, found.metadata) == (record.kind, record.metadata)
        assert found.arrays.keys() == record.arrays.keys()
        for key, array in record.arrays.items():
            np.testing.assert_array_equal(found.arrays[key], array)


def test_the_writer_makes_the_golden_bytes(tmp_path):
    """P16."""
    writer, scene = lamp_writer()
    writer.write(tmp_path / "a", scene)
    assert (tmp_path / "a").read_bytes() == GOLDEN.read_bytes()


def test_the_golden_bundle_reads(tmp_path):
    """P1."""
    writer, scene = lamp_writer()
    assert_same(read_bundle(GOLDEN), scene, {scene.nodes[0].field: LAMP})


def test_the_specification_prints_the_golden_bytes():
    rows = re.findall(r"^([0-9a-f]{8})  ((?:[0-9a-f]{2} ?)+) ", SPEC.read_text(), re.MULTILINE)
    assert [int(at, 16) for at, _ in rows] == list(range(0, GOLDEN.stat().st_size, 16))
    assert bytes.fromhex("".join(row for _, row in rows)) == GOLDEN.read_bytes()


def test_every_flipped_bit_is_refused():
    """P4."""
    data = bytearray(GOLDEN.read_bytes())
    for at in range(len(data)):
        for mask in (1, 2, 4, 8, 16, 32, 64, 128, 255):
            data[at] ^= mask
            with pytest.raises(errors.FormatError):
                parse_bundle(data, "here")
            data[at] ^= mask
    parse_bundle(data, "here")


def test_every_truncation_and_addition_is_refused(tmp_path):
    """P4."""
    data, path = GOLDEN.read_bytes(), tmp_path / "a"
    for length in range(len(data)):
        path.write_bytes(data[:length])
        with pytest.raises(errors.FormatError, match=re.escape(str(path))):
            read_bundle(path)
    for at in range(len(data) + 1):
        with pytest.raises(errors.FormatError):
            parse_bundle(data[:at] + b"\0" + data[at:], "here")


@settings(max_examples=200, deadline=None)
@given(st.data())
def test_hostile_content_under_good_checksums_is_read_or_refused(data):
    """P18: Bytes changed before sealing: outer checks pass, so the inner ones must hold by themselves."""
    views = parse_archive(memoryview(GOLDEN.read_bytes()), "here")
    members = {name: bytearray(view) for name, view in views.items()}
    target = members[data.draw(st.sampled_from(sorted(members)))]
    for _ in range(data.draw(st.integers(1, 4))):
        target[data.draw(st.integers(0, len(target) - 1))] = data.draw(st.integers(0, 255))
    (scene_name, scene), (old, field) = members.items()
    new = f"fields/{hashlib.sha256(field).hexdigest()[:16]}.safetensors"
    hostile = sealed((scene_name, scene.replace(old.encode(), new.encode())), (new, field))
    try:
        parse_bundle(hostile, "here")
    except errors.FormatError as error:
        assert str(error).isprintable()


@settings(max_examples=25, deadline=None)
@given(st.lists(st.lists(st.floats(-100, 100, width=16), min_size=1, max_size=9), min_size=1, max_size=4))
def test_round_trip(tmp_path_factory, values):
    path = tmp_path_factory.mktemp("round") / "a.rfpack"
    writer = BundleWriter()
    records = [FieldRecord("vm", {"planes": np.array(v, np.float32)}, {"rank": len(v)}) for v in values]
    members = {writer.add_field(record): record for record in records}
    scene = SceneGraph(
        tuple(make_node(str(i), field=name) for i, name in enumerate(members)), "add", ({"a": 1},)
    )
    writer.write(path, scene)
    assert_same(read_bundle(path), scene, members)
    again = BundleWriter()
    for record in reversed(read_bundle(path).fields.values()):
        again.add_field(record)
    before = path.read_bytes()
    again.write(path, read_bundle(path).scene, overwrite=True)
    assert path.read_bytes() == before


def test_one_field_in_one_call(tmp_path):
    write_single(tmp_path / "a", LAMP, "lamp", precision="float32", history=[{"verb": "train"}])
    bundle = read_bundle(tmp_path / "a")
    assert bundle.scene.history == ({"verb": "train"},)
    (leaf,) = bundle.scene.leaves()
    np.testing.assert_array_equal(bundle.fields[leaf.field].arrays["sigma"], LAMP.arrays["sigma"])


def test_equal_fields_share_a_member():
    writer = BundleWriter()
    copy = FieldRecord(LAMP.kind, {"sigma": LAMP.arrays["sigma"].copy()}, dict(LAMP.metadata))
    assert writer.add_field(LAMP) == writer.add_field(copy) and len(writer.members) == 1


def test_fields_travel_byte_for_byte(tmp_path):
    writer = BundleWriter()
    member = writer.copy_field(GOLDEN, field_member(LAMP)[0])
    assert writer.members[member] == field_member(LAMP)[1]
    with pytest.raises(errors.MissingMember):
        writer.copy_field(GOLDEN, "fields/0000000000000000.safetensors")


def test_refused_before_anything_is_written(tmp_path):
    writer, scene = lamp_writer()
    path = tmp_path / "a"
    with pytest.raises(errors.MissingMember, match="'lamp'"):
        BundleWriter().write(path, scene)
    with pytest.raises(errors.ResourceError):
        writer.write(tmp_path / "absent" / "a", scene)
    assert not path.exists()
    path.write_bytes(b"precious")
    with pytest.raises(errors.OutputExists):
        writer.write(path, scene)
    assert path.read_bytes() == b"precious"


def field_member(record):
    """The member name and bytes of one field."""
    data = encode_field(record)
    return member_name(data), data


NAME, FIELD = field_member(LAMP)
SCENE = ("scene.json", dump_scene(lamp_writer()[1]))
EMPTY = ("scene.json", dump_scene(SceneGraph(())))
OTHER, OTHER_FIELD = field_member(FieldRecord("vm", {}))
REFUSED = {
    "scene not first": (sealed((NAME, FIELD), SCENE), errors.UnknownMember),
    "no scene": (sealed((NAME, FIELD)), errors.UnknownMember),
    "stranger": (sealed(EMPTY, ("readme.txt", b"")), errors.UnknownMember),
    "field of another name": (sealed(EMPTY, (OTHER, FIELD)), errors.ChecksumMismatch),
    "field missing": (sealed(SCENE), errors.MissingMember),
    "order": (sealed(EMPTY, *sorted([(NAME, FIELD), (OTHER, OTHER_FIELD)], reverse=True)), errors.BadHeader),
    "newer": (sealed(("scene.json", EMPTY[1].replace(b'"1.0"', b'"9.0"'))), errors.NewerVersion),
}


@pytest.mark.parametrize(("data", "error"), REFUSED.values(), ids=REFUSED)
def test_refused(data, error):
    with pytest.raises(error, match="^here") as caught:
        parse_bundle(data, "here")
    assert type(caught.value) is error


def test_unverified_reading_still_checks_the_structure(tmp_path):
    data = bytearray(GOLDEN.read_bytes())
    data[0x233] ^= 0x80
    (tmp_path / "a").write_bytes(data)
    with pytest.raises(errors.ChecksumMismatch):
        read_bundle(tmp_path / "a")
    (record,) = read_bundle(tmp_path / "a", verify=False).fields.values()
    assert record.arrays["sigma"].ravel().tolist() == [0.5, -2.0]


def test_an_open_bundle_survives_its_replacement(tmp_path):
    """P7, P10."""
    writer, scene = lamp_writer()
    writer.write(tmp_path / "a", scene)
    bundle = read_bundle(tmp_path / "a")
    writer.write(tmp_path / "a", SceneGraph(()), overwrite=True)
    assert_same(bundle, scene, {NAME: LAMP})


def test_summary_of_a_bundle():
    summary = read_summary(GOLDEN)
    (node,), (field,) = summary["nodes"], summary["fields"]
    assert summary["bytes"] == GOLDEN.stat().st_size and summary["format"] == "rfpack"
    assert (node["name"], node["kind"], node["depth"]) == ("lamp", "dense", 1)
    assert node["world_aabb"] == [1, 0, 0.5, 3, 1, 1.5]
    assert (field["member"], field["bytes"], field["parameters"]) == (NAME, len(FIELD), 2)
    assert field["arrays"] == {"sigma": {"dtype": "float16", "shape": [2, 1, 1]}}


def test_summary_of_a_scene_and_of_neither(tmp_path):
    write_scene(tmp_path / "s", SceneGraph((make_node("a", source="a.rfpack"),)))
    summary = read_summary(tmp_path / "s")
    assert (summary["format"], summary["nodes"][0]["source"], summary["fields"]) == ("scene", "a.rfpack", [])
    (tmp_path / "p").write_bytes(b"\x89PNG")
    with pytest.raises(errors.NotABundle):
        read_summary(tmp_path / "p")


def test_world_box_holds_all_corners():
    object_to_world = make_node(
        "n", matrix=[[1, 2, 0, 5], [0, 1, -1, 0], [3, 0, 1, 0], [0, 0, 0, 1]]
    ).node_to_parent
    box = [-1, 0, 2, 1, 1, 3]
    corners = np.array(
        [[box[3 * i], box[3 * j + 1], box[3 * k + 2], 1] for i in (0, 1) for j in (0, 1) for k in (0, 1)]
    )
    placed = (corners @ object_to_world.T)[:, :3]
    np.testing.assert_allclose(world_aabb(box, object_to_world), [*placed.min(axis=0), *placed.max(axis=0)])


def test_content_tells_a_bundle(tmp_path):
    (tmp_path / "photo.jpg").write_bytes(GOLDEN.read_bytes())
    (tmp_path / "fake.rfpack").write_bytes(b"hello")
    assert is_bundle(tmp_path / "photo.jpg")
    assert not any(map(is_bundle, (tmp_path / "fake.rfpack", tmp_path, tmp_path / "absent")))
    assert sha256_of(GOLDEN) == hashlib.sha256(GOLDEN.read_bytes()).hexdigest()


def test_opening_a_bundle_loads_no_engine_and_runs_no_code():
    """P17."""
    heavy = {"torch", "click", "fusedrf_cli", "trimesh", "imageio", "scipy", "skimage", "numba", "PIL"}
    code = (
        # The schema's own annotations are compiled once, whatever the file.
        "import sys\nimport formats.bundle\nimport formats.scene\nevents = []\n"
        "formats.scene.dump_scene(formats.scene.SceneGraph(()))\n"
        "sys.addaudithook(lambda event, _: events.append(event))\n"
        f"formats.bundle.read_bundle({str(GOLDEN)!r})\n"
        f"print(sorted({heavy!r} & sys.modules.keys()))\n"
        "bad = ('exec', 'compile', 'pickle', 'socket', 'subprocess', 'os.system')\n"
        "print([e for e in events if e.startswith(bad)])\n"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout == "[]\n[]\n"


def sharing(seed: int) -> FieldRecord:
    """A field with numbers of its own and a part that does not depend on the seed."""
    own = np.full((2, 3), seed, np.float32)
    return FieldRecord(
        "dense", {"own": own, "decoder.weight": np.eye(3, dtype=np.float32)}, {"shared": ["decoder"]}
    )


def test_what_fields_share_lies_in_a_bundle_once_and_comes_back_with_each(tmp_path):
    writer = BundleWriter()
    members = [writer.add_field(sharing(seed)) for seed in (1, 2)]
    assert len(writer.members) == 3
    writer.write(tmp_path / "a.rfpack", SceneGraph(tuple(make_node(m[7:11], field=m) for m in members)))
    for seed, member in zip((1, 2), members, strict=True):
        found = OpenBundle(tmp_path / "a.rfpack").field(member)
        assert np.array_equal(found.arrays["own"], np.full((2, 3), seed))
        assert np.array_equal(found.arrays["decoder.weight"], np.eye(3))
        assert list(found.metadata["shared"]) == ["decoder"]
        whole = read_bundle(tmp_path / "a.rfpack").fields[member]
        assert np.array_equal(whole.arrays["decoder.weight"], np.eye(3))
    copier = BundleWriter()
    copier.copy_field(tmp_path / "a.rfpack", members[0])
    assert len(copier.members) == 2


def test_a_field_read_and_written_again_shares_the_same_part(tmp_path):
    writer = BundleWriter()
    member = writer.add_field(sharing(1))
    writer.write(tmp_path / "a.rfpack", SceneGraph((make_node("a", field=member),)))
    assert BundleWriter().add_field(OpenBundle(tmp_path / "a.rfpack").field(member)) == member


@pytest.mark.parametrize(
    "shared", [{"decoder": "fields/" + "0" * 16 + ".safetensors"}, {"decoder": 3}, ["decoder"]]
)
def test_a_part_that_is_not_there_is_refused_by_name(tmp_path, shared):
    data = encode_field(FieldRecord("dense", {"own": np.zeros(1, np.float32)}, {"shared": shared}))
    writer = BundleWriter()
    writer.members[member_name(data)] = data
    writer.write(tmp_path / "a.rfpack", SceneGraph((make_node("a", field=member_name(data)),)))
    for read in (read_bundle, read_headers, lambda path: OpenBundle(path).field(member_name(data))):
        with pytest.raises(errors.FormatError, match="shared|shares"):
            read(tmp_path / "a.rfpack")


def test_an_opened_bundle_stays_the_version_that_was_opened(tmp_path):
    """P7: whatever takes its name meanwhile, good or damaged, what is read later was verified."""
    path, versions = tmp_path / "a.rfpack", []
    for number in (1.0, 2.0):
        record = FieldRecord("dense", {"sigma": np.full((4, 4, 4), number, np.float32)}, {})
        write_single(path, record, "node", overwrite=True)
        versions.append(path.read_bytes())
    path.write_bytes(versions[0])
    bundle = OpenBundle(path)
    (member,) = bundle.headers
    for other in (versions[1], versions[0][:-300] + b"\0" * 300, b""):
        (tmp_path / "other").write_bytes(other)
        os.replace(tmp_path / "other", path)
        assert (bundle.field(member).arrays["sigma"] == 1).all()
        assert bundle.sha256 == hashlib.sha256(versions[0]).hexdigest() and bundle.size == len(versions[0])
        copied = BundleWriter()
        assert copied.copy_field(bundle, member) == member_name(copied.members[member])
    assert bytes(bundle.data(member)) in versions[0]


def test_more_bundles_than_a_process_may_open_by_default(tmp_path):
    """Each stays open as long as its scene."""
    code = (
        "import resource, sys\nresource.setrlimit(resource.RLIMIT_NOFILE, (40, 4000))\n"
        f"from formats.bundle import OpenBundle\nheld = [OpenBundle({str(GOLDEN)!r}) for _ in range(100)]\n"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
    assert run.returncode == 0, run.stderr
