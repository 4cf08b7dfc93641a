"""A bundle whose nodes are fields of four kinds: every edit is one of its graph, exact to the bit."""

import shutil
from functools import partial

import numpy as np
import pytest
import torch

from formats.bundle import FieldSet, OpenBundle, read_bundle
from formats.scene import SceneGraph, make_node, write_scene
from fusedrf_cli.bridge.field_bundle import write_field
from fusedrf_cli.bridge.scene import load_scene, make_field, stored_grid
from tests.bridge.conftest import done, invoke
from tests.engine.conftest import BOX
from tests.engine.kinds.cases import random_boxed, random_vm
from tests.engine.kinds.sparse_cases import random_sparse

MAKERS = {
    "vm": partial(random_vm, dtype=torch.float32, cells=4),
    "dense": partial(random_boxed, "dense", torch.float32),
    "sparse": partial(random_sparse, 0, 0, torch.float32),
    "cp": partial(random_boxed, "cp", torch.float32),
}
PRECISIONS = {"vm": "float16", "dense": "int8", "sparse": "float32", "cp": "float16"}
AT = {"dense": "3,0,0", "sparse": "0,3,0", "cp": "0,0,3"}
EDITS = {
    "move": ("cp", "-t", "0.25,0,-0.5", "-r", "0,0,30", "-s", "2"),
    "duplicate": ("sparse", "twin", "-t", "0.5,0,0"),
    "rename": ("dense", "grid"),
    "delete": ("vm",),
    "crop": ("sparse", "0,0,0.4,2"),
    "tint": ("cp", "1,0.5,0", "--opacity", "0.5"),
    "replace": ("vm", "dense.rfpack"),
    "add": ("cp.rfpack", "--name", "fifth", "-t", "0,0,-3", "-r", "10,20,30"),
}
EVENTS = {"move": "moved", "duplicate": "duplicated", "rename": "renamed", "delete": "deleted"}
EVENTS |= {"crop": "cropped", "tint": "tinted", "replace": "replaced", "add": "added"}


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A folder with a bundle of each kind, and four.rfpack of all of them."""
    folder = tmp_path_factory.mktemp("four")
    for kind, make in MAKERS.items():
        write_field(str(folder / f"{kind}.rfpack"), make(), kind, precision=PRECISIONS[kind], overwrite=False)
    shutil.copy(folder / "vm.rfpack", folder / "four.rfpack")
    for kind, at in AT.items():
        words = ("--name", kind, "-t", at, "-o", "four.rfpack", "-w")
        done(folder, "add", "four.rfpack", f"{kind}.rfpack", *words)
    return folder


@pytest.fixture
def folder(made, tmp_path):
    return shutil.copytree(made, tmp_path / "four")


def members(path) -> set[str]:
    """The fields of a bundle; their names are made of their bytes."""
    return set(read_bundle(path).fields)


def placed(path) -> dict[str, np.ndarray]:
    """Where each leaf lies."""
    return {leaf.name: leaf.object_to_world for leaf in read_bundle(path).scene.leaves()}


def test_fields_of_four_kinds_stand_in_one_bundle_as_they_were(folder, run, report):
    bundle = OpenBundle(folder / "four.rfpack")
    assert {header.kind for header in bundle.headers.values()} == set(MAKERS)
    alone = set().union(*(members(folder / f"{kind}.rfpack") for kind in MAKERS))
    assert members(folder / "four.rfpack") == alone
    assert run("validate", "four.rfpack").exit_code == 0
    said = report("info", "four.rfpack")
    assert [part["kind"] for part in said["objects"]] == list(MAKERS) and len(said["nodes"]) == 4
    assert all("nodes" not in entry for entry in said["history"])


@pytest.mark.parametrize("verb", EDITS)
def test_an_edit_changes_the_graph_alone_and_is_undone_to_the_bit(folder, report, verb):
    before = (folder / "four.rfpack").read_bytes()
    said = report(verb, "four.rfpack", *EDITS[verb], "-o", "four.rfpack", "-w", "--undoable")
    assert said["touched"]["how"].startswith("an edit of the scene graph")
    assert members(folder / "four.rfpack") <= set().union(*(members(folder / f"{k}.rfpack") for k in MAKERS))
    told = report("history", "four.rfpack")
    assert told["history"][-1]["event"] == EVENTS[verb] and told["undoable"] == 1
    assert told["history"][-1]["objects"]
    report("undo", "four.rfpack", "-o", "four.rfpack", "-w")
    assert (folder / "four.rfpack").read_bytes() == before


READ = {"replace": {"dense"}, "add": {"cp"}}
"""Kinds of the fields that an edit reads: what it brings. No other edit reads any."""


@pytest.mark.parametrize("verb", EDITS)
def test_an_edit_reads_no_field_that_it_can_do_without(folder, report, monkeypatch, verb):
    read = record_of_reading(monkeypatch)
    report(verb, "four.rfpack", *EDITS[verb], "-o", "out.rfpack")
    assert set(read) == READ.get(verb, set()) and len(read) <= 1


def test_words_are_checked_before_any_field_is_read(folder, run, monkeypatch):
    read = record_of_reading(monkeypatch)
    for words in (("rename", "four.rfpack", "none", "x"), ("extract", "four.rfpack", "--name", "none")):
        result = run(*words, "-o", "out.rfpack")
        assert result.exit_code == 3 and "there is no" in result.stderr and "cp, dense" in result.stderr
    assert run("extract", "four.rfpack", "-o", "out.rfpack").exit_code == 2
    assert read == []


def record_of_reading(monkeypatch) -> list[str]:
    """The kinds of the fields that are read from now on."""
    read, field = [], FieldSet.field

    def recorded(self, member: str):
        read.append(self.headers[member].kind)
        return field(self, member)

    monkeypatch.setattr(FieldSet, "field", recorded)
    return read


@pytest.mark.parametrize("kind", MAKERS)
def test_where_a_field_lies_is_told_by_its_grid_alone(folder, kind):
    bundle = OpenBundle(folder / f"{kind}.rfpack")
    (leaf,) = bundle.scene.leaves()
    grid = stored_grid(bundle, leaf.field)
    whole = make_field(bundle.field(leaf.field), kind).occupancy
    assert grid.space is whole.space and np.array_equal(grid.look_at_box, whole.look_at_box)
    assert np.array_equal(grid.occupied, whole.occupied) and np.array_equal(grid.aabb, whole.aabb)


def test_edits_say_what_they_say(folder, report):
    was = placed(folder / "four.rfpack")
    for verb, words in EDITS.items():
        report(verb, "four.rfpack", *words, "-o", f"{verb}.rfpack")
    assert list(placed(folder / "rename.rfpack")) == ["vm", "grid", "sparse", "cp"]
    assert list(placed(folder / "delete.rfpack")) == ["dense", "sparse", "cp"]
    assert len(members(folder / "delete.rfpack")) == 3
    twin = placed(folder / "duplicate.rfpack")["twin"]
    np.testing.assert_array_equal(twin[:3, 3], was["sparse"][:3, 3] + [0.5, 0, 0])
    assert members(folder / "duplicate.rfpack") == members(folder / "four.rfpack")
    leaves = {
        v: {leaf.name: leaf for leaf in read_bundle(folder / f"{v}.rfpack").scene.leaves()} for v in EDITS
    }
    assert leaves["crop"]["sparse"].crops[0].shape == (0, 0, 0.4, 2)
    assert (leaves["tint"]["cp"].tint, leaves["tint"]["cp"].opacity) == ((1, 0.5, 0), 0.5)
    assert leaves["replace"]["vm"].field == leaves["replace"]["dense"].field
    assert leaves["add"]["fifth"].field == leaves["add"]["cp"].field
    report("crop", "crop.rfpack", "sparse", "-o", "whole.rfpack")
    report("tint", "tint.rfpack", "cp", "-o", "plain.rfpack")
    for name in ("whole", "plain"):
        assert (
            read_bundle(folder / f"{name}.rfpack").scene.nodes
            == read_bundle(folder / "four.rfpack").scene.nodes
        )


def test_an_object_turns_about_the_middle_of_what_it_shows(folder, report):
    box = report("move", "four.rfpack", "cp", "-t", "0,0,0", "-o", "still.rfpack")["touched"]["aabb"]
    report("move", "four.rfpack", "cp", *EDITS["move"][1:], "-o", "moved.rfpack")
    before, after = (placed(folder / f"{n}.rfpack")["cp"] for n in ("four", "moved"))
    middle = np.append((np.array(box[:3]) + box[3:]) / 2, 1)
    at = np.linalg.solve(before, middle)
    np.testing.assert_allclose((after @ at)[:3], middle[:3] + [0.25, 0, -0.5], atol=1e-12)
    assert np.linalg.det(after[:3, :3]) == pytest.approx(8)


def test_what_comes_as_several_nodes_is_one_group(folder, report, run):
    words = ("--name", "all", "-t", "10,0,0", "-s", "2", "-o", "two.rfpack")
    report("add", "vm.rfpack", "four.rfpack", *words)
    scene, inner = read_bundle(folder / "two.rfpack").scene, placed(folder / "four.rfpack")
    assert [node.name for node in scene.nodes] == ["vm", "all"]
    assert [leaf.name for leaf in scene.leaves()] == ["vm", *(f"all/{name}" for name in inner)]
    outer = np.diag([2.0, 2, 2, 1]) + np.array([[0, 0, 0, 10], *[[0] * 4] * 3])
    for name, at in inner.items():
        np.testing.assert_allclose(placed(folder / "two.rfpack")[f"all/{name}"], outer @ at, atol=1e-12)
    assert members(folder / "two.rfpack") == members(folder / "four.rfpack")
    report("move", "two.rfpack", "all", "-t", "0,0,5", "-o", "moved.rfpack")
    report("move", "moved.rfpack", "all/cp", "-t", "1,0,0", "-o", "moved.rfpack", "-w")
    shift = placed(folder / "moved.rfpack")["all/cp"] - placed(folder / "two.rfpack")["all/cp"]
    np.testing.assert_allclose(shift[:3, 3], [1, 0, 5], atol=1e-12)
    report("duplicate", "two.rfpack", "all", "again", "-t", "0,9,0", "-o", "three.rfpack")
    assert "again/cp" in placed(folder / "three.rfpack") and len(members(folder / "three.rfpack")) == 4
    report("rename", "two.rfpack", "all", "some", "-o", "named.rfpack")
    assert list(placed(folder / "named.rfpack")) == ["vm", *(f"some/{name}" for name in inner)]
    report("delete", "two.rfpack", "all/vm", "all/dense", "all/sparse", "all/cp", "-o", "one.rfpack")
    assert [node.name for node in read_bundle(folder / "one.rfpack").scene.nodes] == ["vm"]
    report("delete", "two.rfpack", "all", "-o", "one.rfpack", "-w")
    assert list(placed(folder / "one.rfpack")) == ["vm"]
    result = run("add", "two.rfpack", "cp.rfpack", "--name", "all/cp", "-o", "no.rfpack")
    assert result.exit_code == 3 and "there is a 'all/cp' already" in result.stderr


def test_a_bundle_of_nodes_is_placed_whole(folder, report):
    nodes = [
        make_node("a", source="four.rfpack", translation=(0, 0, 1)),
        make_node("b", source="four.rfpack"),
    ]
    write_scene(folder / "scene.json", SceneGraph(tuple(nodes)))
    loaded = load_scene(str(folder / "scene.json"))
    assert [p.name for p in loaded.placed] == [f"{n}/{kind}" for n in "ab" for kind in MAKERS]
    assert len({id(p.field) for p in loaded.placed}) == 4
    report("add", "vm.rfpack", "scene.json", "--name", "both", "-o", "all.rfpack")
    assert members(folder / "all.rfpack") == members(folder / "four.rfpack")
    np.testing.assert_array_equal(placed(folder / "all.rfpack")["both/a/cp"][:3, 3], [0, 0, 4])


def test_fields_of_any_kinds_are_fused_without_learning(folder, report, run):
    """A bundle of its own, which says what the scene says, groups of another rule too."""
    pair = [
        make_node(kind, source=f"{kind}.rfpack", translation=(i, 0, 0)) for i, kind in enumerate(("cp", "vm"))
    ]
    write_scene(folder / "pair.json", SceneGraph(tuple(pair), "add"))
    shown = {"tint": [1, 0.5, 0], "crop": [0, 0, 0, 5]}
    nodes = (
        make_node("moving", source="pair.json", translation=(0, 1, 0), showing=shown),
        make_node("still", source="dense.rfpack", scale=(2, 2, 2), background=True),
        make_node("twin", source="dense.rfpack"),
    )
    write_scene(folder / "scene.json", SceneGraph(nodes))
    said = report("fuse", "scene.json", "--kind", "blocks", "-o", "all.rfpack")
    assert (said["kind"], said["nodes"], said["fields"]) == ("blocks", 4, 3)
    assert members(folder / "all.rfpack") == set().union(
        *(members(folder / f"{k}.rfpack") for k in ("cp", "vm", "dense"))
    )
    scene = read_bundle(folder / "all.rfpack").scene
    assert scene.version == "1.4" and scene.nodes[0].composition == "add" and scene.nodes[1].background
    one, other = (load_scene(str(folder / name)) for name in ("scene.json", "all.rfpack"))
    assert [p.name for p in one.placed] == [p.name for p in other.placed]
    for a, b in zip(one.fields, other.fields, strict=True):
        np.testing.assert_allclose(a.placed.object_to_world, b.placed.object_to_world, atol=1e-12)
        assert (a.member, a.whole, a.groups) == (b.member, b.whole, b.groups)
    result = run("fuse", "dense.rfpack", "--kind", "blocks", "--ranks", "8,16", "-o", "x.rfpack")
    assert result.exit_code == 2 and "--ranks does not apply to kind dense" in result.stderr


@pytest.fixture
def wide(folder):
    """wide.json: of four kinds, on texels finer than what they show, and a copy of one that is half as large;
    returns their bytes."""
    nodes = []
    for kind, make in MAKERS.items():
        field = make() if kind == "sparse" else make().resampled(BOX, (33, 33, 33))
        name = str(folder / f"{kind}.rfpack")
        write_field(name, field, kind, precision=PRECISIONS[kind], overwrite=True)
        nodes.append(make_node(kind, source=f"{kind}.rfpack", translation=(2.5 * len(nodes), 0, 0)))
    nodes.append(make_node("twin", source="vm.rfpack", translation=(2, 2, 0), scale=(0.5, 0.5, 0.5)))
    write_scene(folder / "wide.json", SceneGraph(tuple(nodes)))
    return sum((folder / f"{kind}.rfpack").stat().st_size for kind in MAKERS)


@pytest.mark.slow
def test_fields_of_any_kinds_are_made_smaller(folder, report, run, wide):
    """By a common voxel, each in its own kind and place; what they were made of is found again."""
    whole = report("fuse", "wide.json", "-o", "whole.rfpack")
    assert whole["bytes"] > 0.9 * wide and (whole["nodes"], whole["fields"]) == (5, 4)
    said = report("fuse", "wide.json", "-o", "half.rfpack", "--max-size", str(wide // 2))
    assert said["bytes"] <= wide // 2 and (said["nodes"], said["fields"]) == (5, 4)
    assert [one["kind"] for one in said["chosen"]["fields"]] == list(MAKERS)
    assert said["psnr"]["stored"] > 30
    bundles = [OpenBundle(folder / f"{name}.rfpack") for name in ("whole", "half")]
    for one, other in zip(*(bundle.scene.leaves() for bundle in bundles), strict=True):
        assert one.name == other.name
        np.testing.assert_array_equal(one.object_to_world, other.object_to_world)
    (entry,) = bundles[1].scene.history
    files = {f"{kind}.rfpack" for kind in MAKERS}
    assert {told["source"] for told in entry["sources"].values()} <= files and entry["sources"]
    report("fuse", "half.rfpack", "-o", "again.rfpack")
    assert members(folder / "again.rfpack") == members(folder / "whole.rfpack")
    told = run("fuse", "wide.json", "-o", "x.rfpack", "--ranks", "8,16", "--max-size", str(wide // 2))
    assert "--ranks does not apply to fields of kind cp, dense, sparse" in told.stderr
    (folder / "dense.rfpack").unlink()
    itself = report("fuse", "half.rfpack", "-o", "itself.rfpack")
    assert any("the source of 'dense' is not found" in warning for warning in itself["warnings"])
    assert members(folder / "itself.rfpack") == members(folder / "half.rfpack")


@pytest.mark.slow
def test_answers_are_those_of_the_composition_before_and_after(folder, report):
    """σ(x, d) of a moved node is that at M⁻¹ x along M⁻¹ d, times |M⁻¹ d|; all other nodes answer as they
    did, to the bit."""
    report("move", "four.rfpack", "cp", *EDITS["move"][1:], "-o", "moved.rfpack")
    before, after = (
        {p.name: p for p in load_scene(str(folder / f"{n}.rfpack")).placed} for n in ("four", "moved")
    )
    rng = np.random.default_rng(0)
    dirs = torch.from_numpy(rng.normal(size=(500, 3)))
    dirs /= dirs.norm(dim=1, keepdim=True)
    for name, one in before.items():
        points = torch.from_numpy(one.aabb[:3] + rng.random((500, 3)) * (one.aabb[3:] - one.aabb[:3]))
        x, d, stretch = one.to_object(points, dirs)
        sigma, rgb = one.field.query(x, d)
        other = after[name]
        assert torch.equal(torch.stack(other.field.query(x, d)[:1]), sigma[None])
        move = torch.from_numpy(other.object_to_world @ one.world_to_object)
        moved, along = points @ move[:3, :3].T + move[:3, 3], dirs @ move[:3, :3].T
        x2, d2, stretch2 = other.to_object(moved, along / along.norm(dim=1, keepdim=True))
        torch.testing.assert_close(x2, x, rtol=0, atol=1e-9)
        torch.testing.assert_close(stretch2, stretch / along.norm(dim=1), rtol=1e-9, atol=0)
        torch.testing.assert_close(other.field.query(x2, d2)[1], rgb, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(
    "words, says",
    [
        (
            ("move", "four.rfpack", "chair", "-t", "1,0,0"),
            "there is no 'chair'; it holds cp, dense, sparse, vm",
        ),
        (
            ("rename", "four.rfpack", "cp", "vm"),
            "there is a 'vm' already; choose another name, or rename or delete",
        ),
        (("delete", "four.rfpack", "cp", "dense", "sparse", "vm"), "would leave nothing"),
        (
            ("crop", "four.rfpack", "cp", "50,50,50,1"),
            "its crop holds nothing of it; in the frame of the node that is cropped it lies within -",
        ),
        (("add", "four.rfpack", "gone.rfpack", "--name", "x"), "no such file"),
    ],
)
def test_what_cannot_be_done_is_one_sentence(folder, words, says):
    result = invoke(folder, *words, "-o", "out.rfpack")
    assert result.exit_code == 3 and says in result.stderr and result.stderr.count("\n") == 1
    assert not (folder / "out.rfpack").exists()
