"""`info`: what a bundle or a scene holds, for people and as JSON."""

import json

import numpy as np

from formats.bundle import read_summary
from formats.records import FieldRecord
from tests.bundles import write_single
from tests.formats.test_captures import frame, write
from tests.formats.test_readers import noisy


def test_info_as_json_is_the_summary(run):
    result = run("info", "chair.rfpack", "--json")
    assert json.loads(result.stdout) == {**read_summary("chair.rfpack"), "warnings": []}


def test_info_of_a_pipe_is_info_of_the_file(run, folder):
    run("compose", "table.rfpack", "--background-node", "chair.rfpack", "-t", "1,2,3", "-o", "scene.json")
    of_file = json.loads(run("info", "scene.json", "--json").stdout)
    of_pipe = json.loads(run("info", "-", "--json", stdin=(folder / "scene.json").read_bytes()).stdout)
    assert of_pipe == {**of_file, "path": "-"}


def test_info_for_people_shows_the_tree(run):
    run("compose", "table.rfpack", "--background-node", "chair.rfpack", "-t", "1,2.5,3", "-o", "scene.json")
    lines = run("info", "scene.json").stdout.splitlines()
    assert lines[-3:] == [
        "  name   source        background  at",
        "  table  table.rfpack  yes         0 0 0",
        "  chair  chair.rfpack              1 2.5 3",
    ]


def test_info_for_people_shows_the_fields(run):
    lines = run("info", "chair.rfpack").stdout.splitlines()
    assert "  chair  vm                -1 -1 -1 1 1 2" not in lines
    assert any(
        line.split() == ["chair", "vm", "0", "0", "0", "-1", "-1", "-1", "1", "1", "2"] for line in lines
    )
    assert any(line.endswith(" 96") and "fields/" in line for line in lines)


def test_info_says_what_of_a_scene_no_command_takes(run, folder):
    (folder / "frames").mkdir()
    sources = {"gone": "gone.rfpack", "folder": "frames", "chair": "chair.rfpack", "far": "../a.rfpack"}
    nodes = [{"name": name, "source": source} for name, source in sources.items()]
    scene = {"format": "rfpack", "version": "1.0", "nodes": nodes}
    said = json.loads(run("info", "-", "--json", stdin=json.dumps(scene)).stdout)["notes"]
    (folder / "scene.json").write_text(json.dumps(scene))
    result = run("info", "scene.json")
    assert result.exit_code == 0 and [line.strip() for line in result.stdout.splitlines()[-3:]] == [
        f"scene.json: node 'gone': source 'gone.rfpack' does not exist; put it at {folder / 'gone.rfpack'}, "
        "or name another source",
        "scene.json: node 'folder': source 'frames' is no bundle and no scene; train it to a .rfpack first",
        "scene.json: node 'far': source '../a.rfpack' leads out of the scene's folder; move the file in, or "
        "give --allow-outside",
    ]
    assert [note.removeprefix("standard input") for note in said] == [
        line.strip().removeprefix("scene.json") for line in result.stdout.splitlines()[-3:]
    ]
    (folder / "scene.json").write_text(json.dumps(scene | {"nodes": [{"name": "a"}]}))
    assert "the scene places nothing; give a node a 'source'" in run("info", "scene.json").stdout


def test_info_of_rubbish_is_one_line(run, folder):
    (folder / "rubbish").write_bytes(b"\x00" * 100)
    result = run("info", "rubbish")
    assert result.exit_code == 3 and result.stderr.count("\n") == 1
    assert run("info", "-", stdin="{").exit_code == 3


def test_info_lists_the_objects_of_a_fused_bundle(run, folder):
    """Nodes, of old fields of blocks too, and the place of what was distilled; --json has all of it."""
    place = [[1, 0, 0, 2.5], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    nodes = [{"name": n, "object_to_world": place, "aabb": [0, 0, 0, 1, 2, 3]} for n in ("cup", "jug")]
    history = ({"event": "fused", "nodes": nodes}, {"event": "deleted", "names": ["jug"]})
    arrays = {"tensor_0.plane": np.ones((4, 4), np.float32)}
    block = {"name": "cup", "tensor": 0, "object_to_field": place}
    blocks = {"blocks": [block], "tensors": [{"aabb": [0, 0, 0, 9, 9, 9]}]}
    for name, kind, metadata in (("blocks", "vm", blocks), ("distilled", "lamp", {})):
        record = FieldRecord(kind, arrays, {"aabb": [0, 0, 0, 9, 9, 9], **metadata})
        write_single(folder / f"{name}.rfpack", record, "fused", history=history)
    lines = run("info", "blocks.rfpack").stdout.splitlines()
    start = lines.index("nodes:")
    assert [line.split()[:5] for line in lines[start + 1 : start + 3]] == [
        ["name", "kind", "at", "box"],
        ["cup", "vm", "2.5", "0", "0"],
    ]
    assert "objects:" not in lines  # which are the nodes
    assert "  deleted  jug" in lines
    lines = run("info", "distilled.rfpack").stdout.splitlines()
    row = lines[lines.index("objects:") + 2].split()
    assert row == ["cup", "lamp", "fused", "2.5", "0", "0", "1", "2", "3"]
    (cup,) = json.loads(run("info", "distilled.rfpack", "--json").stdout)["objects"]
    assert (cup["name"], cup["bytes"], cup["size"]) == ("cup", None, [1, 2, 3])


def test_info_does_not_tell_a_trained_field_twice(run):
    assert "objects:" not in run("info", "chair.rfpack").stdout
    (chair,) = json.loads(run("info", "chair.rfpack", "--json").stdout)["objects"]
    assert chair["name"] == "chair" and chair["bytes"] > 0


def test_info_of_a_capture_and_of_a_film(run, folder):
    """For people only what there is, tables cut; the JSON has all of it."""
    for i in range(9):
        noisy(folder / f"garden/images/{i}.png")
    frames = [frame(f"images/{i}.png", fl_x=80 + i) for i in range(9)]
    write(folder / "garden", frames=frames)
    lines = run("info", "garden").stdout.splitlines()
    assert "photos: to learn from 9, held out 0" in lines and "  1 more" in lines
    assert not any(line.startswith("masks") for line in lines)
    told = json.loads(run("info", "garden", "--json").stdout)
    assert len(told["lenses"]) == 9 and told["masks"] == 0 and "one point" in told["notes"][-1]
    notes = lines[lines.index("notes:") + 1 :]
    assert notes == [f"  {note}" for note in told["notes"]]
    (folder / "walk.mp4").write_bytes(b"\0\0\0\x20ftypisom")
    result = run("info", "walk.mp4")
    assert result.exit_code == 3 and "a film" in result.stderr and result.stderr.count("\n") == 1
