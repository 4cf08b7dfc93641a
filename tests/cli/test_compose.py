import json
import os

import numpy as np
import pytest

from formats.bundle import read_bundle
from formats.scene import parse_scene, read_scene
from tests.bundles import write_single


def test_each_input_keeps_the_words_after_it(run):
    words = "table.rfpack --background-node chair.rfpack -t 1,0,0 -s 2 chair.rfpack --name stool -r 0,0,90"
    assert run("compose", *words.split(), "-o", "scene.json").exit_code == 0
    table, chair, stool = read_scene("scene.json").leaves()
    assert [leaf.name for leaf in (table, chair, stool)] == ["table", "chair", "stool"]
    assert [leaf.background for leaf in (table, chair, stool)] == [True, False, False]
    np.testing.assert_array_equal(table.object_to_world, np.eye(4))
    np.testing.assert_array_equal(
        chair.object_to_world, [[2, 0, 0, 1], [0, 2, 0, 0], [0, 0, 2, 0], [0, 0, 0, 1]]
    )
    turned = [[0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    np.testing.assert_allclose(stool.object_to_world, turned, atol=1e-15)


@pytest.mark.parametrize(
    "spelling", [["-t", "-1,0,0"], ["-t-1,0,0"], ["--translate=-1,0,0"], ["--translate", "-1,0,0"]]
)
def test_a_word_may_be_spelled_in_every_way_of_options(run, spelling):
    scene = run("compose", "-o", "-", "table.rfpack", "chair.rfpack", *spelling).stdout_bytes
    assert [node["translation"] for node in json.loads(scene)["nodes"] if "translation" in node] == [
        [-1, 0, 0]
    ]
    assert json.loads(scene)["nodes"][1]["name"] == "chair"


def test_the_order_of_words_does_not_matter(run):
    one = run("compose", "chair.rfpack", "-t", "1,2,3", "-s", "2", "-o", "-").stdout
    two = run("compose", "chair.rfpack", "-s", "2", "--composition", "max", "-t", "1,2,3", "-o", "-").stdout
    assert one == two


def test_a_matrix_is_written_as_it_was_given(run, folder):
    (folder / "shear.txt").write_text("1 0.5 0 0  0 1 0 0  0 0 1 0  0 0 0 1")
    run("compose", "chair.rfpack", "--matrix", "shear.txt", "-o", "scene.json")
    (leaf,) = read_scene("scene.json").leaves()
    np.testing.assert_array_equal(leaf.object_to_world, [[1, 0.5, 0, 0], *np.eye(4)[1:]])


def test_names_are_stems_numbered_past_those_given(run):
    words = "chair.rfpack chair.rfpack table.rfpack --name chair-2 chair.rfpack".split()
    scene = json.loads(run("compose", *words, "-o", "-").stdout)
    assert [node["name"] for node in scene["nodes"]] == ["chair", "chair-3", "chair-2", "chair-4"]


def test_stdout_carries_the_scene_and_nothing_else(run):
    result = run("compose", "chair.rfpack", "-o", "-", "--composition", "add", "--json")
    assert parse_scene(result.stdout_bytes, "stdout").composition == "add"
    assert result.stderr == ""


def test_the_report_says_what_was_written(run, folder):
    report = json.loads(run("compose", "chair.rfpack", "-o", "scene.json", "--json").stdout)
    size = (folder / "chair.rfpack").stat().st_size
    assert report == {
        "output": "scene.json",
        "bytes": (folder / "scene.json").stat().st_size,
        "nodes": [{"name": "chair", "source": "chair.rfpack", "source_bytes": size}],
        "warnings": [],
    }


def test_sources_are_relative_to_the_scene_not_to_the_caller(run, folder, monkeypatch):
    (folder / "sub").mkdir()
    monkeypatch.chdir(folder / "sub")
    assert (
        run("compose", "../chair.rfpack", str(folder / "table.rfpack"), "-o", "../scene.json").exit_code == 0
    )
    assert [leaf.source for leaf in read_scene("../scene.json").leaves()] == ["chair.rfpack", "table.rfpack"]


def test_a_source_outside_the_folder_needs_permission(run, folder):
    (folder / "sub").mkdir()
    refused = run("compose", "chair.rfpack", "-o", "sub/scene.json")
    assert refused.exit_code == 3 and "--allow-outside" in refused.stderr
    assert not (folder / "sub" / "scene.json").exists()
    assert run("compose", "chair.rfpack", "-o", "sub/scene.json", "--allow-outside").exit_code == 0
    assert [leaf.source for leaf in read_scene("sub/scene.json").leaves()] == ["../chair.rfpack"]


def test_a_link_for_a_folder_does_not_mislead_the_path(run, folder):
    (folder / "deep" / "er").mkdir(parents=True)
    os.symlink(folder / "deep" / "er", folder / "link")
    assert run("compose", "chair.rfpack", "-o", "link/scene.json", "--allow-outside").exit_code == 0
    (leaf,) = read_scene("link/scene.json").leaves()
    assert (folder / "deep" / "er" / leaf.source).samefile(folder / "chair.rfpack")


def test_a_scene_may_be_composed_again(run):
    run("compose", "chair.rfpack", "-o", "inner.json")
    assert run("compose", "inner.json", "-t", "1,0,0", "table.rfpack", "-o", "outer.json").exit_code == 0
    again = run("compose", "outer.json", "-o", "inner.json", "-w")
    assert again.exit_code == 3 and "leads back to itself" in again.stderr
    assert [leaf.source for leaf in read_scene("inner.json").leaves()] == ["chair.rfpack"]


@pytest.mark.parametrize(
    "words, code, say",
    [
        ("-t 1,0,0 chair.rfpack", 2, "belongs to the input before it"),
        ("--background-node chair.rfpack", 2, "belongs to the input before it"),
        ("chair.rfpack -t 1,0,0 -t 2,0,0", 2, "chair.rfpack: --translate is given twice"),
        ("chair.rfpack --background-node --background-node", 2, "--background-node is given twice"),
        ("chair.rfpack -t 1,0", 2, "'1,0' is not three finite numbers"),
        ("chair.rfpack -s 1e-13", 3, "chair"),
        ("chair.rfpack --name a table.rfpack --name a", 3, "'a' appears twice"),
        ("README", 3, "README"),
        ("", 2, "Missing argument"),
    ],
)
def test_what_cannot_be_composed_is_refused(run, folder, words, code, say):
    (folder / "README").write_text("not a bundle")
    result = run("compose", *words.split(), "-o", "scene.json")
    assert (result.exit_code, result.stderr.count("\n")) == (code, 1)
    assert say in result.stderr
    assert not (folder / "scene.json").exists()


def test_an_existing_scene_is_kept_unless_overwritten(run, folder):
    (folder / "scene.json").write_text("mine")
    result = run("compose", "chair.rfpack", "-o", "scene.json")
    assert result.exit_code == 1 and "--overwrite" in result.stderr
    assert (folder / "scene.json").read_text() == "mine"
    assert run("compose", "chair.rfpack", "-o", "scene.json", "-w").exit_code == 0


def test_a_source_that_would_lie_on_its_side_is_told_once(run, folder):
    """-y is up in a splat file's world; who turns it upright, or asks for +z, is told nothing."""
    record = next(iter(read_bundle("chair.rfpack").fields.values()))
    write_single("plant.rfpack", record, "plant", up=(0.0, -1.0, 0.0))
    inputs = ["chair.rfpack", "plant.rfpack", "-t", "1,0,0", "-r", "0,0,20", "plant.rfpack"]
    result = run("compose", *inputs, "-o", "scene.json")
    told = "plant.rfpack: -y is up in it, and +z in the scene; -r -90,0,0 makes it stand upright"
    assert result.exit_code == 0 and result.stderr.count("\n") == 1 and told in result.stderr
    upright = run("compose", "plant.rfpack", "-r", "-90,0,30", "-o", "-")
    assert upright.stderr == "" and json.loads(upright.stdout)["nodes"]
    said = json.loads(run("info", "plant.rfpack", "--json").stdout)
    assert said["up"] == [0.0, -1.0, 0.0]


def test_a_scene_has_the_up_that_all_its_sources_have(run, folder):
    """As placed: turned about it they stand, turned alike they have another."""
    record = next(iter(read_bundle("chair.rfpack").fields.values()))
    for name in ("plant", "pot"):
        write_single(f"{name}.rfpack", record, name, up=(0.0, -1.0, 0.0))

    def composed(*inputs):
        result = run("compose", *inputs, "-o", "-")
        assert result.exit_code == 0
        return json.loads(result.stdout).get("up"), result.stderr

    same = composed("plant.rfpack", "pot.rfpack", "-t", "1,0,0", "-r", "0,50,0", "-s", "0.1,2,1")
    assert same == ([0.0, -1.0, 0.0], "")
    up, told = composed("plant.rfpack", "-r", "0,0,90", "pot.rfpack", "-r", "0,0,80")
    assert up == pytest.approx([1, 0, 0]) and not told
    up, told = composed("plant.rfpack", "pot.rfpack", "-r", "-90,0,0")
    assert up is None and told.count("makes it stand upright") == 1
