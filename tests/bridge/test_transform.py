"""`move`, `duplicate` and `rename` for real."""

import shutil

import numpy as np
import pytest

from formats.bundle import read_bundle
from formats.scene import SceneGraph, make_node, write_scene
from fusedrf_cli.bridge.scene import load_scene
from fusedrf_cli.engine.rendering.metrics import psnr
from tests.bridge.conftest import done

UP = ("-t", "0.1,0.2,0.5")


@pytest.fixture(scope="module")
def fused(shop, tmp_path_factory):
    """The shop with blocks.rfpack (floor and red) and vm.rfpack (the same in one tensor)."""
    folder = shutil.copytree(shop, tmp_path_factory.mktemp("fused") / "shop")
    done(folder, "fuse", "pair.json", "-o", "blocks.rfpack", "--precision", "int8")
    done(
        folder, "fuse", "pair.json", "-o", "vm.rfpack", "--kind", "vm", "--no-finetune", "--max-size", "400kB"
    )
    return folder


@pytest.fixture
def folder(tmp_path, fused):
    return shutil.copytree(fused, tmp_path / "shop")


def numbers(folder, bundle: str) -> set[str]:
    """The fields of a bundle, by members, whose names are made of their bytes."""
    return set(read_bundle(folder / bundle).fields)


def test_a_moved_object_is_where_the_scene_would_have_it(report, picture, folder):
    nodes = [
        make_node("floor", source="floor.rfpack", translation=(0, 0, -0.7), background=True),
        make_node("red", source="red.rfpack", translation=(-0.4, 0.2, 0.5)),
    ]
    write_scene(folder / "wanted.json", SceneGraph(tuple(nodes)))
    said = report("move", "blocks.rfpack", "red", *UP, "-o", "moved.rfpack")
    assert (
        psnr(picture("moved.rfpack"), picture("wanted.json"))
        > 45
        > psnr(picture("moved.rfpack"), picture("blocks.rfpack"))
    )
    np.testing.assert_allclose(said["touched"]["aabb"], [-0.8, -0.3, -0.3, -0.1, 0.5, 0.8], atol=1e-6)
    assert numbers(folder, "moved.rfpack") == numbers(folder, "blocks.rfpack") != set()


def test_there_and_back_is_as_before(report, picture, folder):
    report("move", "blocks.rfpack", "red", *UP, "-r", "0,0,30", "-s", "1.5", "-o", "moved.rfpack")
    matrix = "-t", "-0.1,-0.2,-0.5", "-r", "0,0,-30", "-s", "0.66666666666666667"
    report("move", "moved.rfpack", "red", *matrix, "-o", "back.rfpack")
    assert psnr(picture("back.rfpack"), picture("blocks.rfpack")) > 45
    assert numbers(folder, "back.rfpack") == numbers(folder, "blocks.rfpack")


def test_an_object_turns_about_its_middle(report, folder):
    said = report("move", "blocks.rfpack", "red", "-r", "0,0,90", "-s", "2", "-o", "moved.rfpack")
    np.testing.assert_allclose(said["touched"]["aabb"], [-1.1, -0.6, -0.6, 0.1, 0.6, 0.6], atol=1e-6)
    matrix = ",".join(map(str, np.diag([2.0, 2, 2, 1]).ravel()))
    report("move", "blocks.rfpack", "red", "--matrix", matrix, "-o", "scaled.rfpack")
    np.testing.assert_allclose(
        box_of(folder / "scaled.rfpack", "red"), [-1.6, -0.6, -0.6, -0.4, 0.6, 0.6], atol=1e-6
    )


def test_a_copy_shares_its_numbers_and_can_go_by_itself(report, picture, folder):
    before = (folder / "blocks.rfpack").stat().st_size
    said = report("duplicate", "blocks.rfpack", "red", "twin", *UP, "-o", "two.rfpack")
    assert said["bytes"] - before < 4000 and said["touched"]["nodes"] == 3
    assert numbers(folder, "two.rfpack") == numbers(folder, "blocks.rfpack")
    assert psnr(picture("two.rfpack"), picture("blocks.rfpack")) < 40
    report("delete", "two.rfpack", "twin", "-o", "one.rfpack")
    assert psnr(picture("one.rfpack"), picture("blocks.rfpack")) > 45
    report("delete", "two.rfpack", "red", "-o", "other.rfpack")
    report("move", "blocks.rfpack", "red", *UP, "-o", "moved.rfpack")
    assert psnr(picture("other.rfpack"), picture("moved.rfpack")) > 45


def test_a_renamed_object_goes_by_its_new_name(report, run, picture, folder):
    report("rename", "blocks.rfpack", "red", "box", "-o", "named.rfpack")
    assert np.array_equal(picture("named.rfpack"), picture("blocks.rfpack"))
    gone = run("delete", "named.rfpack", "red", "-o", "less.rfpack")
    assert gone.exit_code == 3 and "there is no 'red'; it holds box, floor" in gone.stderr
    report("delete", "named.rfpack", "box", "-o", "less.rfpack")
    history = read_bundle(folder / "less.rfpack").scene.history
    assert [entry["event"] for entry in history] == ["fused", "renamed", "deleted"]


@pytest.mark.parametrize(
    "words, code, says",
    [
        (("move", "blocks.rfpack", "red"), 2, "say where to"),
        (("move", "blocks.rfpack", "chair", *UP), 3, "there is no 'chair'; it holds floor, red"),
        (("move", "red.rfpack", "blue", *UP), 3, "there is no 'blue'"),
        (("duplicate", "blocks.rfpack", "red", "floor"), 3, "there is a 'floor' already"),
        (("rename", "blocks.rfpack", "red", "red"), 2, "'red' is its name already"),
        (("rename", "blocks.rfpack", "red", ""), 3, "node name '' is no name"),
        (("move", "pair.json", "red", *UP), 3, "not a bundle"),
        (("move", "blocks.rfpack", "red", "--matrix", ",".join("0" * 16)), 2, "matrix"),
    ],
)
def test_what_cannot_be_done_is_one_sentence(run, folder, words, code, says):
    before = sorted(folder.iterdir())
    result = run(*words, "-o", "out.rfpack")
    assert result.exit_code == code and says in result.stderr and result.stderr.count("\n") <= 2
    assert sorted(folder.iterdir()) == before


def test_edits_are_undone_as_they_were_made(report, run, folder):
    report("fuse", "scene.json", "-o", "fused.rfpack", "--kind", "blocks")
    was = [(folder / "fused.rfpack").read_bytes()]
    edits = [
        ("move", "fused.rfpack", "red", "-t", "0.1,0,0"),
        ("delete", "fused.rfpack", "blue"),
        ("add", "fused.rfpack", "blue.rfpack", "--name", "azure", "-t", "0.5,0,0"),
        ("replace", "fused.rfpack", "red", "blue.rfpack"),
    ]
    for words in edits:
        report(*words, "-o", "fused.rfpack", "-w", "--undoable")
        was.append((folder / "fused.rfpack").read_bytes())
    told = report("history", "fused.rfpack")
    assert [entry["event"] for entry in told["history"]][1:] == ["moved", "deleted", "added", "replaced"]
    assert [entry["objects"] for entry in told["history"]][1:] == [["red"], ["blue"], ["azure"], ["red"]]
    assert told["undoable"] == 4 and told["history"][3]["objects"] == ["azure"]
    said = report("rename", "fused.rfpack", "red", "rot", "-o", "other.rfpack", "--undoable")
    assert said["warnings"] == []
    said = report("rename", "other.rfpack", "rot", "rouge", "-o", "other.rfpack", "-w")
    assert "neither this edit nor the 5 before it can be undone" in said["warnings"][0]
    for before in reversed(was[:-1]):
        report("undo", "fused.rfpack", "-o", "fused.rfpack", "-w")
        assert (folder / "fused.rfpack").read_bytes() == before
    result = run("undo", "fused.rfpack", "-o", "fused.rfpack", "-w")
    assert result.exit_code == 3 and "nothing to undo" in result.stderr
    report("move", "fused.rfpack", "red", "-t", "0.1,0,0", "-o", "fused.rfpack", "-w")
    result = run("undo", "fused.rfpack", "-o", "fused.rfpack", "-w")
    assert result.exit_code == 3 and "--undoable" in result.stderr


@pytest.mark.parametrize("name", ["fused", "restored"])
def test_an_object_may_have_any_name(report, picture, folder, name):
    """Those too by which a field calls tensors of its own."""
    report("rename", "blocks.rfpack", "red", name, "-o", "named.rfpack")
    report("duplicate", "blocks.rfpack", "red", name, *UP, "-o", "two.rfpack")
    report("move", "named.rfpack", name, *UP, "-o", "moved.rfpack")
    report("delete", "two.rfpack", "red", "-o", "one.rfpack")
    assert np.array_equal(picture("one.rfpack"), picture("moved.rfpack"))
    report("rename", "named.rfpack", name, "red", "-o", "back.rfpack")
    assert parts_of(folder / "back.rfpack") == parts_of(folder / "blocks.rfpack")
    report("delete", "blocks.rfpack", "red", "-o", "floor.rfpack", "-w")
    report("delete", "two.rfpack", "red", name, "-o", "none.rfpack")
    assert np.array_equal(picture("none.rfpack"), picture("floor.rfpack"))


@pytest.mark.parametrize("name", ["fused", "restored"])
def test_a_fused_object_may_have_any_name(report, picture, folder, name):
    shutil.copy(folder / "red.rfpack", folder / f"{name}.rfpack")
    words = ("floor.rfpack", "-t", "0,0,-0.7", f"{name}.rfpack", "-t", "-0.5,0,0")
    report("compose", *words, "-o", "scene.json", "-w")
    report("fuse", "scene.json", "-o", "both.rfpack")
    assert parts_of(folder / "both.rfpack") == ["floor", name]
    report("delete", "both.rfpack", name, "-o", "less.rfpack")
    report("delete", "blocks.rfpack", "red", "-o", "floor.rfpack", "-w")
    assert np.array_equal(picture("less.rfpack"), picture("floor.rfpack"))


def parts_of(path) -> list[str]:
    """Names of a bundle's nodes."""
    return [leaf.name for leaf in read_bundle(path).scene.leaves()]


def box_of(path, name: str) -> np.ndarray:
    """(6,) around a node, in the world."""
    return next(p.aabb for p in load_scene(str(path)).placed if p.name == name)


def test_what_replaces_an_object_stands_as_it_did(report, run, folder, picture):
    report("fuse", "scene.json", "-o", "fused.rfpack", "--kind", "blocks")
    report("move", "fused.rfpack", "red", "-t", "0,0.1,0.2", "-s", "1.2", "-o", "moved.rfpack")
    report("replace", "moved.rfpack", "red", "blue.rfpack", "-o", "other.rfpack")
    report("delete", "moved.rfpack", "red", "-o", "without.rfpack")
    words = ("--name", "red", "-t", "-0.5,0.1,0.2", "-s", "1.2", "-o", "again.rfpack")
    report("add", "without.rfpack", "blue.rfpack", *words)
    np.testing.assert_array_equal(picture("other.rfpack"), picture("again.rfpack"))
    result = run("replace", "fused.rfpack", "green", "blue.rfpack", "-o", "x.rfpack")
    assert result.exit_code == 3 and "there is no 'green'" in result.stderr
