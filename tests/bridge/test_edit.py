"""`add` and `delete` for real: what was not touched stays, and what was is right."""

import shutil
from dataclasses import replace

import numpy as np
import pytest

from formats.bundle import BundleWriter, OpenBundle, read_bundle
from formats.history import distilled
from fusedrf_cli.engine.rendering.cameras import orbit
from fusedrf_cli.engine.rendering.metrics import psnr
from tests.bridge.conftest import FIELDS, PLACES, blues, done, part, write_views

VM = ("--kind", "vm", "--no-finetune", "--max-size", "400kB")
AT = ("--name", "blue", "-t", "0.7,0,0")


@pytest.fixture(scope="module")
def fused(shop, tmp_path_factory):
    """The shop with blocks.rfpack (floor and red), vm.rfpack (floor, red and blue in one tensor), and
    kept.rfpack (the same,
    its sources inside)."""
    folder = shutil.copytree(shop, tmp_path_factory.mktemp("fused") / "shop")
    done(folder, "fuse", "pair.json", "-o", "blocks.rfpack")
    done(folder, "fuse", "scene.json", "-o", "vm.rfpack", *VM)
    done(folder, "fuse", "scene.json", "-o", "kept.rfpack", *VM, "--keep-sources")
    return folder


@pytest.fixture
def folder(tmp_path, fused):
    return shutil.copytree(fused, tmp_path / "shop")


def covered(name: str, grown: float = 0.15) -> np.ndarray:
    """(48, 48) pixels of the `picture` camera that may see the object's box, a margin included."""
    camera = orbit(np.array([-1.4, -0.8, -0.9, 1.4, 0.8, 0.4]), 1, 48, 48)[0]
    box = FIELDS[name].aabb + np.tile(PLACES[name], 2) + grown * np.array([-1, -1, -1, 1, 1, 1])
    rays_o, rays_d = camera.rays()
    with np.errstate(divide="ignore"):
        a, b = (box[:3] - rays_o) / rays_d, (box[3:] - rays_o) / rays_d
    return (np.minimum(a, b).max(1) < np.maximum(a, b).min(1)).reshape(48, 48)


def test_added_and_deleted_is_as_before(report, picture, folder):
    """Outside of the new object's box the picture stays, with it it is the scene's, and without it the graph
    and the fields are as they were."""
    before = picture("blocks.rfpack")
    said = report("add", "blocks.rfpack", "blue.rfpack", *AT, "-o", "more.rfpack")
    assert said["touched"]["nodes"] == 3
    np.testing.assert_allclose(said["touched"]["aabb"], [0.4, -0.3, -0.3, 1.0, 0.3, 0.3], atol=1e-6)
    more = picture("more.rfpack")
    away = ~covered("blue")
    assert psnr(more[away], before[away]) >= 45 and blues(more) > 20 and blues(before) == 0
    assert psnr(more, picture("scene.json")) > 40
    report("delete", "more.rfpack", "blue", "-o", "less.rfpack")
    assert psnr(picture("less.rfpack"), before) >= 50
    one, more, other = (read_bundle(folder / f"{n}.rfpack") for n in ("blocks", "more", "less"))
    assert one.fields.keys() == other.fields.keys() < more.fields.keys()  # made of their bytes
    assert one.scene.nodes == other.scene.nodes
    assert more.fields.keys() - one.fields.keys() == read_bundle(folder / "blue.rfpack").fields.keys()


def test_history_tells_of_every_edit(report, folder):
    report("add", "blocks.rfpack", "blue.rfpack", *AT, "-o", "more.rfpack")
    report("delete", "more.rfpack", "red", "-o", "less.rfpack")
    history = read_bundle(folder / "less.rfpack").scene.history
    assert [entry["event"] for entry in history] == ["fused", "added", "deleted"]
    assert history[1]["objects"] == ["blue"] and history[2]["names"] == ["red"]
    assert not any("nodes" in entry for entry in history)  # where they stand is told by the graph alone
    # the name is free again
    report("add", "less.rfpack", "red.rfpack", "--name", "red", "-o", "again.rfpack")


def test_a_node_goes_and_the_others_stay(report, picture):
    report("delete", "blocks.rfpack", "red", "-o", "less.rfpack")
    away = ~covered("red")
    assert psnr(picture("less.rfpack")[away], picture("blocks.rfpack")[away]) >= 40  # on another lattice
    assert psnr(picture("less.rfpack")[~away], picture("blocks.rfpack")[~away]) < 25


@pytest.mark.parametrize("bundle", ["vm.rfpack", "kept.rfpack"])
def test_a_distilled_object_is_cut_out_and_the_rest_learnt_again(report, picture, folder, bundle):
    """The sources lie beside the bundle, or inside it where they were kept."""
    gone, wanted = covered("blue", -0.1), picture("pair.json")
    if bundle == "kept.rfpack":
        for name in FIELDS:
            (folder / f"{name}.rfpack").unlink()
    before = picture(bundle)
    said = report("delete", bundle, "blue", "-o", "less.rfpack", "--no-finetune")
    assert (
        said["warnings"] == [] and read_bundle(folder / "less.rfpack").scene.history[-1]["restored"] is True
    )
    after, away = picture("less.rfpack"), ~covered("blue", 0.3)
    assert psnr(after[gone], wanted[gone]) > psnr(before[gone], wanted[gone]) + 3
    assert psnr(after[away], before[away]) >= 40


def test_without_its_sources_a_hole_stays_and_is_said(report, picture, folder):
    gone, wanted, before = covered("blue", -0.1), picture("pair.json"), picture("vm.rfpack")
    (folder / "floor.rfpack").write_bytes(b"another file")
    said = report("delete", "vm.rfpack", "blue", "-o", "less.rfpack", "--no-finetune")
    assert any("the source of 'floor' is gone, has changed" in w for w in said["warnings"])
    assert read_bundle(folder / "less.rfpack").scene.history[-1]["restored"] is False
    after = picture("less.rfpack")
    assert psnr(after[gone], wanted[gone]) > psnr(before[gone], wanted[gone]) + 1


def test_sources_outside_are_read_only_where_allowed(report, folder):
    (folder / "inner").mkdir()
    report("fuse", "scene.json", "-o", "inner/vm.rfpack", *VM)
    said = report("delete", "inner/vm.rfpack", "blue", "-o", "a.rfpack", "--no-finetune")
    assert said["warnings"]
    said = report("delete", "inner/vm.rfpack", "blue", "-o", "b.rfpack", "--no-finetune", "--allow-outside")
    assert not said["warnings"]


def test_an_object_added_to_a_distilled_field_can_go_again(report, picture):
    before = picture("vm.rfpack")
    report("add", "vm.rfpack", "red.rfpack", "--name", "second", "-t", "0,0,0.4", "-o", "more.rfpack")
    assert psnr(picture("more.rfpack"), before) < 30
    report("delete", "more.rfpack", "second", "-o", "less.rfpack")
    assert psnr(picture("less.rfpack"), before) >= 50


@pytest.mark.parametrize(
    "words, says",
    [
        (("add", "blocks.rfpack", "blue.rfpack", "--name", "red"), "a 'red' already"),
        (("add", "scene.json", "blue.rfpack", "--name", "new"), "not a bundle"),
        (("delete", "blocks.rfpack", "ghost"), "no 'ghost'; it holds floor, red"),
        (("delete", "blocks.rfpack", "red", "floor"), "would leave nothing"),
        (("delete", "vm.rfpack", "red", "floor", "blue"), "would leave nothing"),
        (("delete", "scene.json", "red"), "not a bundle"),
        (("add", "blocks.rfpack", "gone.rfpack", "--name", "new"), "no such file"),
    ],
)
def test_what_cannot_be_edited_is_exit_3(run, folder, words, says):
    result = run(*words, "-o", "out.rfpack")
    assert result.exit_code == 3 and says in result.stderr and not (folder / "out.rfpack").exists()


def test_no_cuda_and_no_silent_overwriting(run, folder):
    assert run("delete", "blocks.rfpack", "red", "-o", "x.rfpack", "--device", "cuda").exit_code == 5
    size = (folder / "vm.rfpack").stat().st_size
    assert run("delete", "blocks.rfpack", "red", "-o", "vm.rfpack").exit_code != 0
    assert (folder / "vm.rfpack").stat().st_size == size


def test_photos_of_the_place_show_what_an_object_hid(report, picture, folder):
    """Where a source is gone, and so is what it hid, its photos will do."""
    gone, wanted, before = covered("blue", -0.1), picture("pair.json"), picture("vm.rfpack")
    write_views(folder / "place", FIELDS["floor"], PLACES["floor"], 48, 16)
    (folder / "floor.rfpack").write_bytes(b"another file")
    words = ("--refit", "place", "--no-finetune")
    said = report("delete", "vm.rfpack", "blue", *words, "-o", "less.rfpack")
    assert said["restored"] is True and said["photos"] == 32
    after, away = picture("less.rfpack"), ~covered("blue", 0.3)
    assert psnr(after[gone], wanted[gone]) > psnr(before[gone], wanted[gone]) + 3
    assert psnr(after[away], before[away]) >= 40


def test_several_distilled_objects_are_cut_out_of_their_field_alone(report, picture, folder):
    """Also where the first of them takes all of the field away: what stands beside it keeps its bytes."""
    report("add", "vm.rfpack", "red.rfpack", "--name", "garden", "-t", "0.7,0,0", "-o", "beside.rfpack")
    bundle, writer = OpenBundle(folder / "beside.rfpack"), BundleWriter()
    floor = distilled(bundle.scene.history)["floor"] | {"aabb": [-9.0, -9.0, -9.0, 9.0, 9.0, 9.0]}
    for member in bundle.headers:
        writer.copy_field(bundle, member)
    history = (*bundle.scene.history, {"event": "renamed", "names": [], "nodes": [floor]})
    writer.write(folder / "wide.rfpack", replace(bundle.scene, history=history))
    report("delete", "wide.rfpack", "floor", "red", "blue", "-o", "less.rfpack")
    (leaf,) = read_bundle(folder / "less.rfpack").scene.leaves()
    assert leaf.name == "garden" and leaf.field in read_bundle(folder / "red.rfpack").fields


def test_a_node_and_a_distilled_object_are_deleted_together(report, folder):
    """What is touched is the box around both."""
    report("add", "vm.rfpack", "red.rfpack", "--name", "second", "-t", "0,0,2", "-o", "more.rfpack")
    said = report("delete", "more.rfpack", "blue", "second", "-o", "less.rfpack")
    low, high = np.split(np.array(said["touched"]["aabb"]), 2)
    assert (low <= [-0.3, -0.3, -0.3]).all() and (high >= [1.0, 0.3, 2.3]).all()


def test_photos_are_learnt_from_once(report, picture, folder, monkeypatch):
    write_views(folder / "place", FIELDS["floor"], PLACES["floor"], 24, 5)
    (folder / "floor.rfpack").write_bytes(b"another file")
    learnt, deleting = [], part("deleting")
    once = deleting.learnt_from
    monkeypatch.setattr(deleting, "learnt_from", lambda *words: learnt.append(words) or once(*words))
    words = ("--refit", "place", "--no-finetune")
    said = report("delete", "vm.rfpack", "red", "blue", *words, "-o", "less.rfpack")
    assert said["restored"] is True and len(learnt) == 1


def test_one_more_of_the_same_object_costs_a_placement(report, picture, folder):
    """As where both were fused at once: its numbers are stored once."""
    report("fuse", "pair.json", "-o", "one.rfpack", "--kind", "blocks")
    report("add", "one.rfpack", "red.rfpack", "--name", "second", "-t", "0.7,0,0", "-o", "two.rfpack")
    before, after = ((folder / name).stat().st_size for name in ("one.rfpack", "two.rfpack"))
    assert after - before < 2000
    report("add", "one.rfpack", "blue.rfpack", "--name", "second", "-t", "0.7,0,0", "-o", "other.rfpack")
    assert (folder / "other.rfpack").stat().st_size - before > 10_000
    words = ("floor.rfpack", "-t", "0,0,-0.7", "red.rfpack", "-t", "-0.5,0,0", "red.rfpack", "-t", "0.7,0,0")
    report("compose", *words, "-o", "three.json")
    assert psnr(picture("two.rfpack"), picture("three.json")) > 40


def test_an_object_that_would_lie_on_its_side_is_told(report, folder):
    """By the rotation that makes it stand, which is then taken without a word."""
    blue, writer = OpenBundle(folder / "blue.rfpack"), BundleWriter()
    for member in blue.headers:
        writer.copy_field(blue, member)
    writer.write(folder / "lying.rfpack", replace(blue.scene, up=(0.6, 0.0, -0.8)))
    said = report("add", "blocks.rfpack", "lying.rfpack", *AT, "-o", "more.rfpack")
    (note,) = said["warnings"]
    assert note.startswith("lying.rfpack: 0.6,0,-0.8 is up") and "-r 180,-36.8699,0 makes" in note
    turned = ("-r", "180,-36.8699,0", *AT)
    assert not report("add", "blocks.rfpack", "lying.rfpack", *turned, "-o", "more.rfpack", "-w")["warnings"]
