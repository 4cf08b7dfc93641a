"""Objects that were distilled into a field with others: taken out of it, and edited as nodes."""

import shutil

import numpy as np
import pytest

from formats.bundle import read_bundle
from fusedrf_cli.engine.rendering.metrics import psnr
from tests.bridge.conftest import FIELDS, PLACES, done
from tests.bridge.test_edit import blues, covered

VM = ("--kind", "vm", "--no-finetune", "--max-size", "400kB")
SPARSE = ("--kind", "sparse", "--no-finetune", "--max-size", "600kB")


@pytest.fixture(scope="module")
def fused(shop, tmp_path_factory):
    """The shop with floor, red and blue in one field: vm.rfpack and sparse.rfpack."""
    folder = shutil.copytree(shop, tmp_path_factory.mktemp("distilled") / "shop")
    done(folder, "fuse", "scene.json", "-o", "vm.rfpack", *VM)
    done(folder, "fuse", "scene.json", "-o", "sparse.rfpack", *SPARSE)
    return folder


@pytest.fixture
def folder(tmp_path, fused):
    return shutil.copytree(fused, tmp_path / "shop")


def box_around(name: str) -> np.ndarray:
    return FIELDS[name].aabb + np.tile(PLACES[name], 2)


@pytest.mark.parametrize("kind", ["vm", "sparse"])
@pytest.mark.parametrize("known", [True, False], ids=["its source is known", "its box is known"])
def test_it_is_extracted_by_its_name(report, picture, folder, kind, known):
    """With the numbers of the field, in the cells of its source or its box."""
    before = picture(f"{kind}.rfpack")
    if not known:
        (folder / "blue.rfpack").unlink()
    said = report("extract", f"{kind}.rfpack", "--name", "blue", "-o", "object.rfpack")
    report("extract", f"{kind}.rfpack", "--name", "blue", "--invert", "-o", "rest.rfpack")
    assert said["kind"] == kind and said["nodes"] == 1
    np.testing.assert_allclose(said["box"], box_around("blue"), atol=0.15)
    (node,) = read_bundle(folder / "object.rfpack").scene.nodes
    assert node.name == "blue"
    found, rest = picture("object.rfpack"), picture("rest.rfpack")
    assert blues(found) > 0.8 * blues(before) > 10 and blues(rest) < 3
    assert psnr(found[~covered("blue")], np.ones((1, 3))) > 40
    report("compose", "object.rfpack", "rest.rfpack", "-o", "both.json")
    assert psnr(picture("both.json"), before) > 38
    assert [part["name"] for part in report("info", "rest.rfpack")["objects"]] == ["floor", "red"]


def test_what_others_stood_in_is_what_is_left_of_them(report, picture, folder):
    report("extract", "vm.rfpack", "--name", "floor", "-o", "floor_only.rfpack")
    found = picture("floor_only.rfpack")
    assert blues(found) < 3 and psnr(found, picture("vm.rfpack")) < 25


def test_it_moves_as_a_node_of_the_numbers_of_its_source(report, picture, folder):
    said = report("move", "vm.rfpack", "blue", "-t", "0,0,0.5", "-o", "moved.rfpack")
    assert "filled by nodes" in said["touched"]["how"] and said["warnings"] == []
    scene = read_bundle(folder / "moved.rfpack").scene
    (leaf,) = [leaf for leaf in scene.leaves() if leaf.name == "blue"]
    assert leaf.field in read_bundle(folder / "blue.rfpack").fields
    np.testing.assert_allclose(leaf.object_to_world[:3, 3], np.add(PLACES["blue"], (0, 0, 0.5)))
    report("delete", "vm.rfpack", "blue", "--no-finetune", "-o", "less.rfpack")
    words = ("--name", "blue", "-t", "0.7,0,0.5", "-o", "wanted.rfpack")
    report("add", "less.rfpack", "blue.rfpack", *words)
    assert psnr(picture("moved.rfpack"), picture("wanted.rfpack")) > 50
    report("move", "moved.rfpack", "blue", "-t", "0,0,0.1", "-o", "again.rfpack")


def test_without_its_source_its_cells_move(report, picture, folder):
    (folder / "blue.rfpack").unlink()
    before = picture("vm.rfpack")
    said = report("tint", "vm.rfpack", "blue", "1,0,0.2", "-o", "tinted.rfpack")
    assert any("the source of 'blue' is gone" in warning for warning in said["warnings"])
    after = picture("tinted.rfpack")
    assert blues(before) > 10 and blues(after) < 3
    assert psnr(after[~covered("blue", 0.3)], before[~covered("blue", 0.3)]) > 40


def test_a_copy_of_it_leaves_it_as_it_is(report, picture, folder):
    said = report("duplicate", "vm.rfpack", "blue", "twin", "-t", "0,0,0.8", "-o", "two.rfpack")
    assert "all fields keep their bits" in said["touched"]["how"]
    was, now = (read_bundle(folder / f"{name}.rfpack") for name in ("vm", "two"))
    assert was.fields.keys() < now.fields.keys() and len(now.fields) == len(was.fields) + 1
    names = [part["name"] for part in report("info", "two.rfpack")["objects"]]
    assert names == ["twin", "floor", "red", "blue"]
    report("crop", "two.rfpack", "twin", "0,0,0,0.2", "-o", "cropped.rfpack")


def test_its_name_is_changed_in_the_history_alone(report, run, folder):
    report("rename", "vm.rfpack", "blue", "azure", "-o", "named.rfpack")
    was, now = (read_bundle(folder / f"{name}.rfpack") for name in ("vm", "named"))
    assert was.fields.keys() == now.fields.keys() and was.scene.nodes == now.scene.nodes
    assert [part["name"] for part in report("info", "named.rfpack")["objects"]] == ["floor", "red", "azure"]
    assert run("move", "named.rfpack", "blue", "-t", "1,0,0", "-o", "x.rfpack").exit_code == 3
    report("delete", "named.rfpack", "azure", "--no-finetune", "-o", "less.rfpack")


def test_info_lists_them_under_the_node_of_their_field(report, run):
    parts = report("info", "vm.rfpack")["objects"]
    assert [(part["name"], part["inside"]) for part in parts] == [
        ("floor", "fused"), ("red", "fused"), ("blue", "fused")
    ]  # fmt: skip
    assert "inside" in run("info", "vm.rfpack").stdout
