"""Edits of objects whose files have a frame of their own, in which their fields do not lie as they are."""

import shutil

import numpy as np
import pytest

from formats.bundle import read_bundle
from formats.scene import SceneGraph, make_node, write_scene
from tests.bridge.conftest import PLACES, done

OWN = {"translation": (3, -2, 5), "rotation": (0.0, 0.6, 0.0, 0.8), "scale": (0.25, 0.25, 0.25)}
TWICE = ("-s", "2", "-t", "0,0,0.1")
KINDS = {"instances": ("--kind", "blocks"), "vm": ("--kind", "vm", "--no-finetune", "--max-size", "400kB")}


@pytest.fixture(scope="module")
def fused(shop, tmp_path_factory):
    """The shop with a blue box in a frame of its own, own.rfpack, which stands four times as large on the
    floor in instances.rfpack and vm.rfpack."""
    folder = shutil.copytree(shop, tmp_path_factory.mktemp("own") / "shop")
    write_scene(folder / "own.json", SceneGraph((make_node("blue", source="blue.rfpack", **OWN),)))
    done(folder, "fuse", "own.json", "-o", "own.rfpack", "--kind", "blocks")
    floor = make_node("floor", source="floor.rfpack", background=True, translation=PLACES["floor"])
    thing = make_node("thing", source="own.rfpack", **PLACE)
    write_scene(folder / "room.json", SceneGraph((floor, thing)))
    for name, words in KINDS.items():
        done(folder, "fuse", "room.json", "-o", f"{name}.rfpack", *words)
    return folder


PLACE = {"translation": (-12.0, 8.0, -19.5), "scale": (4.0, 4.0, 4.0)}
AT = make_node("thing", **PLACE).node_to_parent
"""Where the frame of own.rfpack lies in the world."""


@pytest.fixture
def folder(tmp_path, fused):
    return shutil.copytree(fused, tmp_path / "shop")


def leaf_of(folder, bundle: str, name: str):
    """The node of a name that holds a field."""
    return next(leaf for leaf in read_bundle(folder / bundle).scene.leaves() if leaf.name == name)


@pytest.mark.parametrize("kind", KINDS)
def test_what_replaces_one_stands_where_its_file_was_placed(report, folder, kind):
    report("replace", f"{kind}.rfpack", "thing", "red.rfpack", "-o", "other.rfpack")
    np.testing.assert_allclose(leaf_of(folder, "other.rfpack", "thing").object_to_world, AT, atol=1e-9)


@pytest.mark.parametrize("kind", KINDS)
def test_and_where_it_was_moved_to(report, folder, kind):
    report("rename", f"{kind}.rfpack", "thing", "box", "-o", "named.rfpack")
    report("move", "named.rfpack", "box", *TWICE, "-o", "moved.rfpack")
    report("fuse", "moved.rfpack", "--kind", "blocks", "--from-scratch", "-o", "again.rfpack")
    moved = leaf_of(folder, "moved.rfpack", "box").object_to_world
    before = AT @ make_node("blue", **OWN).node_to_parent
    report("replace", "again.rfpack", "box", "red.rfpack", "-o", "other.rfpack")
    expected = moved @ np.linalg.inv(before) @ AT
    assert np.abs(expected - AT).max() > 1
    np.testing.assert_allclose(leaf_of(folder, "other.rfpack", "box").object_to_world, expected, atol=1e-9)


@pytest.mark.parametrize("kind", KINDS)
def test_a_file_of_its_own_frame_replaces_as_it_lies_in_it(report, folder, kind):
    report("replace", f"{kind}.rfpack", "thing", "own.rfpack", "-o", "same.rfpack")
    at = AT @ make_node("blue", **OWN).node_to_parent
    np.testing.assert_allclose(leaf_of(folder, "same.rfpack", "thing").object_to_world, at, atol=1e-9)


def test_a_crop_lies_in_the_frame_of_the_file(report, folder, picture):
    box = next(node["aabb"] for node in report("info", "own.rfpack")["nodes"])
    world = next(node["world_aabb"] for node in report("info", "own.rfpack")["nodes"])
    assert box != world  # of own.rfpack itself the node is a part, in a frame of its own
    told = {node["name"]: node for node in report("info", "instances.rfpack")["nodes"]}["thing"]["aabb"]
    np.testing.assert_allclose(told, world)
    middle = (np.array(told[:3]) + told[3:]) / 2
    half = ",".join(map(str, [*told[:3], middle[0], *told[4:]]))
    report("crop", "instances.rfpack", "thing", half, "-o", "cropped.rfpack")
    words = ("own.rfpack", "--name", "thing", "-s", "4", "-t", "-12,8,-19.5", "--crop", half)
    report("compose", "floor.rfpack", "-t", ",".join(map(str, PLACES["floor"])), *words, "-o", "wanted.json")
    cropped = picture("cropped.rfpack")
    np.testing.assert_array_equal(cropped, picture("wanted.json"))
    assert np.abs(cropped - picture("instances.rfpack")).max() > 0.1
    ball = ",".join(map(str, [*middle, 0.05]))
    report("crop", "cropped.rfpack", "thing", ball, "-o", "ball.rfpack")
    report("crop", "instances.rfpack", "thing", ball, "-o", "once.rfpack")
    np.testing.assert_array_equal(picture("ball.rfpack"), picture("once.rfpack"))
    report("crop", "ball.rfpack", "thing", "-o", "whole.rfpack")
    np.testing.assert_array_equal(picture("whole.rfpack"), picture("instances.rfpack"))
    report("replace", "ball.rfpack", "thing", "red.rfpack", "-o", "other.rfpack")
    np.testing.assert_allclose(leaf_of(folder, "other.rfpack", "thing").object_to_world, AT, atol=1e-9)


def test_the_word_is_handed_on_and_moves_nothing(report, folder, picture):
    """Without it the same pictures: readers that do not know it lose nothing else."""
    report("duplicate", "instances.rfpack", "thing", "two", "-t", "0.5,0,0", "-o", "both.rfpack")
    scene = read_bundle(folder / "both.rfpack").scene
    words = {node.name: node.source_matrix for node, _, _ in scene.walk()}
    assert scene.version == "1.6" and words["floor"] is None
    np.testing.assert_allclose(words["thing"], make_node("blue", **OWN).node_to_parent, atol=1e-12)
    assert words["two"] == words["thing"]
