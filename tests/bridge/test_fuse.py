"""`fuse` for real: blocks, a distilled tensor, limits, and what is refused."""

import json
import re
import shutil
from pathlib import Path
from types import SimpleNamespace

import pytest

from formats import bundle
from formats.bundle import read_bundle
from formats.scene import SceneGraph, make_node, write_scene
from fusedrf_cli.bridge.fusing import FusingConfig
from fusedrf_cli.bridge.sources import load_to_fuse
from fusedrf_cli.engine.rendering.metrics import PSNR_CAP, psnr
from fusedrf_cli.engine.settings import using
from fusedrf_cli.progress import NullProgress
from fusedrf_cli.requests import FuseRequest
from tests.bridge.conftest import done, part, write_scene_of

VM = ("--kind", "vm", "--no-finetune", "--max-size", "300kB")


def test_a_scene_becomes_blocks_that_look_the_same(report, folder, picture):
    said = report("fuse", "scene.json", "-o", "fused.rfpack")
    assert said["kind"] == "blocks" and said["psnr"]["before_rgb"] == PSNR_CAP
    assert said["bytes"] == (folder / "fused.rfpack").stat().st_size
    for how in ((), ("--reference",)):
        assert psnr(picture("fused.rfpack", *how), picture("scene.json", *how)) == PSNR_CAP
    scene = read_bundle(folder / "fused.rfpack").scene
    (entry,) = scene.history
    names = ["floor", "red", "blue"]
    assert entry["event"] == "fused" and entry["objects"] == names and "nodes" not in entry
    assert [node.name for node in scene.nodes] == names and scene.nodes[0].background
    own = set().union(*(read_bundle(folder / f"{name}.rfpack").fields for name in names))
    assert read_bundle(folder / "fused.rfpack").fields.keys() == own  # their very bytes


def test_every_source_is_opened_once(report, monkeypatch):
    opened, once = [], bundle.read_archive
    monkeypatch.setattr(
        bundle, "read_archive", lambda path, **words: opened.append(Path(path).name) or once(path, **words)
    )
    report("fuse", "pair.json", "-o", "once.rfpack", "--kind", "blocks")
    assert sorted(opened) == ["floor.rfpack", "red.rfpack"]


def test_the_same_scene_gives_the_same_bytes(report, folder):
    for name in ("one", "two"):
        report("fuse", "scene.json", "-o", f"{name}.rfpack")
        report("fuse", "pair.json", "-o", f"{name}-vm.rfpack", *VM, "--seed", "3")
    for kind in ("", "-vm"):
        assert (folder / f"one{kind}.rfpack").read_bytes() == (folder / f"two{kind}.rfpack").read_bytes()


def test_a_scene_becomes_one_tensor(report, folder, picture):
    said = report(
        "fuse", "scene.json", "-o", "fused.rfpack", "--kind", "vm", "--keep-sources", "--max-size", "300kB"
    )
    assert said["kind"] == "vm" and said["psnr"]["after_rgb"] is not None
    assert max(said["psnr"]["before_rgb"], said["psnr"]["after_rgb"]) > 17
    bundle = read_bundle(folder / "fused.rfpack")
    assert len(bundle.fields) == 4 and all(n["kept"] for n in bundle.scene.history[0]["nodes"])
    assert "floor" in said["chosen"]["start"]
    assert psnr(picture("fused.rfpack"), picture("scene.json")) > 17


@pytest.mark.parametrize("kind", ["blocks", "vm"])
def test_the_file_is_no_larger_than_asked(report, folder, kind):
    whole = report("fuse", "pair.json", "-o", "whole.rfpack")["bytes"]
    limit = {"blocks": 10_000 + whole // 2, "vm": 70_000 + whole // 3}[kind]
    said = report(
        "fuse", "pair.json", "-o", "less.rfpack", "--kind", kind, "--no-finetune", "--max-size", str(limit)
    )
    assert said["bytes"] <= limit and (kind == "vm" or said["bytes"] < whole)


def test_a_default_limit_in_the_way_is_said(report):
    """With the size that would keep the sources, and only where nothing else changes them."""
    whole = report("fuse", "pair.json", "-o", "whole.rfpack")
    with using(FusingConfig(default_max_size=whole["bytes"] // 2)):
        said = report("fuse", "pair.json", "-o", "less.rfpack", "--no-finetune")["warnings"][-1]
        size = re.search("--max-size ([0-9]+MB) would keep the sources as they are", said)[1]
        again = report("fuse", "pair.json", "-o", "again.rfpack", "--max-size", size)
        coarse = report("fuse", "pair.json", "-o", "coarse.rfpack", "--precision", "int4", "--no-finetune")
    assert again["bytes"] == whole["bytes"] and not whole["warnings"] and not again["warnings"]
    assert not any("would keep" in warning for warning in coarse["warnings"])


def test_total_seconds_count_reading(folder, monkeypatch):
    """By a clock that moves while sources are read alone."""
    monkeypatch.chdir(folder)
    now, fusing = [0.0], part("fusing")
    monkeypatch.setattr(fusing, "time", SimpleNamespace(monotonic=lambda: now[0]))

    def load(*words):
        now[0] = 100.0
        return load_to_fuse(*words)

    request = FuseRequest(scene="pair.json", output="out.rfpack")
    assert fusing.fuse(request, NullProgress(), load=load)["total_seconds"] == 100


def test_a_scene_that_adds_up_stays_its_nodes(report, run, folder):
    write_scene_of(folder, "floor", "red", file="fog.json", composition="add")
    assert report("fuse", "fog.json", "-o", "nodes.rfpack")["kind"] == "blocks"
    scene, sources = read_bundle(folder / "nodes.rfpack").scene, ("floor", "red")
    assert scene.composition == "add" and [node.name for node in scene.nodes] == list(sources)
    own = set().union(*(read_bundle(folder / f"{name}.rfpack").fields for name in sources))
    assert read_bundle(folder / "nodes.rfpack").fields.keys() == own
    assert report("fuse", "fog.json", "-o", "fog.rfpack", *VM)["kind"] == "vm"
    result = run("fuse", "fog.json", "-o", "x.rfpack", "--max-size", "2kB")
    assert result.exit_code == 2 and "--max-size is too small" in result.stderr


def test_a_missed_target_is_exit_7_and_the_output_is_there(run, folder):
    result = run("fuse", "pair.json", "-o", "fused.rfpack", *VM, "--target-psnr", "90", "--json")
    assert result.exit_code == 7 and "--target-psnr asked for 90" in result.stderr
    assert json.loads(result.stdout)["bytes"] == (folder / "fused.rfpack").stat().st_size
    assert run("fuse", "pair.json", "-o", "other.rfpack", "--target-psnr", "10").exit_code == 0


def test_a_target_takes_the_fewest_bytes_that_reach_it(report, folder, picture):
    whole = report("fuse", "pair.json", "-o", "whole.rfpack", "--max-size", "10MB")
    said = report("fuse", "pair.json", "-o", "small.rfpack", "--target-psnr", "33")
    psnrs = said["psnr"]
    assert max(psnrs["before_rgb"], psnrs["after_rgb"] or 0) >= 33 and said["bytes"] < 0.5 * whole["bytes"]
    assert said["bytes"] == (folder / "small.rfpack").stat().st_size
    chosen = said["chosen"]
    assert chosen["precision"] == "int4" and "smallest" in chosen["why"]
    assert chosen["next_larger"]["bytes"] > said["bytes"] > 0.8 * chosen["next_smaller"]["bytes"]  # at most
    assert psnr(picture("small.rfpack"), picture("pair.json")) > 28
    report("fuse", "pair.json", "-o", "again.rfpack", *chosen["flags"].split())
    same = [list(read_bundle(folder / f"{name}.rfpack").fields) for name in ("again", "small")]
    assert same[0] == same[1]


def test_what_cannot_be_reached_gives_the_best_there_is(run, folder):
    result = run("fuse", "pair.json", "-o", "best.rfpack", "--target-psnr", "150", "--no-finetune", "--json")
    assert result.exit_code == 7 and json.loads(result.stdout)["psnr"]["before_rgb"] > 40


def test_what_is_asked_for_is_kept(report):
    """All in one command, since other ranks and degrees are compiled."""
    asked = {"--precision": "int8", "--ranks": "8,8", "--sh-degree": "0"}
    words = [word for pair in asked.items() for word in pair]
    said = report("fuse", "pair.json", "-o", "asked.rfpack", "--no-finetune", *words)
    flags = said["chosen"]["flags"].split()
    assert {flag: flags[flags.index(flag) + 1] for flag in asked} == asked


def test_a_stretched_object_is_warned_of(report, folder):
    nodes = (
        make_node("floor", source="floor.rfpack"),
        make_node("red", source="red.rfpack", scale=(1, 1, 2)),
    )
    write_scene(folder / "tall.json", SceneGraph(nodes))
    said = report("fuse", "tall.json", "-o", "tall.rfpack", *VM)
    assert any("'red' is stretched by 2.00" in w for w in said["warnings"])


@pytest.mark.parametrize("kind", ["blocks", "vm"])
def test_a_size_that_nothing_fits_is_refused(run, folder, kind):
    result = run("fuse", "pair.json", "-o", "no.rfpack", "--kind", kind, "--no-finetune", "--max-size", "12")
    assert result.exit_code == 2 and "--max-size is too small" in result.stderr
    assert not (folder / "no.rfpack").exists()


WITH_RGB = ("fuse", "pair.json", "--kind", "vm", "--max-size", "300kB", "-o")


@pytest.fixture(scope="module")
def straight(shop, tmp_path_factory) -> bytes:
    """The bundle of a run that nobody interrupted."""
    folder = shutil.copytree(shop, tmp_path_factory.mktemp("straight") / "shop")
    done(folder, *WITH_RGB, "fused.rfpack")
    return (folder / "fused.rfpack").read_bytes()


@pytest.mark.parametrize("at", [6, 30, 55])
def test_a_fuse_goes_on_to_the_same_bytes(report, run, folder, interrupted_in_step, straight, at):
    """In the midst of a step at 10, 50 (points) and 90 % (pictures) of 60 steps, and once more after it."""
    with interrupted_in_step(at):
        assert run(*WITH_RGB, "fused.rfpack").exit_code == 130
    with interrupted_in_step(1):
        assert run(*WITH_RGB, "fused.rfpack", "--resume").exit_code == 130
    said = report(*WITH_RGB, "fused.rfpack", "--resume")
    assert said["psnr"]["after_rgb"] is not None and not (folder / "fused.rfpack.checkpoint").exists()
    assert (folder / "fused.rfpack").read_bytes() == straight


@pytest.mark.slow
def test_a_kind_that_is_made_goes_on_to_the_same_bytes(report, run, folder, interrupted_in_step):
    """It learns from pictures alone; another kind does not go on from its numbers."""
    words = ("fuse", "pair.json", "--kind", "sparse", "--max-size", "100kB", "-o")
    report(*words, "straight.rfpack")
    with interrupted_in_step(5):
        result = run(*words, "fused.rfpack")
    assert result.exit_code == 130 and "--resume" in result.stderr
    wrong = run("fuse", "pair.json", *VM, "-o", "fused.rfpack", "--resume")
    assert wrong.exit_code == 3 and "other settings" in wrong.stderr
    report(*words, "fused.rfpack", "--resume")
    assert (folder / "fused.rfpack").read_bytes() == (folder / "straight.rfpack").read_bytes()


def test_an_interrupt_after_the_choice_leaves_the_output(report, run, folder, monkeypatch):
    def stop(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(part("building").Maker, "evaluate", stop)
        result = run("fuse", "pair.json", *VM, "-o", "fused.rfpack")
    assert result.exit_code == 130 and "fused.rfpack is written whole" in result.stderr
    assert report("eval", "fused.rfpack", "--against", "pair.json", "--size", "16x16")


def test_an_interrupted_fuse_goes_on(run, folder, monkeypatch):
    def stop(*_, **__):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("fusedrf_cli.engine.distillation.distill.query_teacher", stop)
        assert run("fuse", "pair.json", "-o", "fused.rfpack", *VM).exit_code == 130
    assert not (folder / "fused.rfpack").exists() and (folder / "fused.rfpack.checkpoint").exists()
    for other in (("--max-size", "80kB"), ("--seed", "5"), ("--finetune",), ("--from-scratch",)):
        wrong = run("fuse", "pair.json", "-o", "fused.rfpack", *VM, "--resume", *other)
        assert wrong.exit_code == 3 and "other settings" in wrong.stderr, other
    assert run("fuse", "pair.json", "-o", "fused.rfpack", *VM, "--resume").exit_code == 0
    assert not (folder / "fused.rfpack.checkpoint").exists()


@pytest.mark.parametrize(
    "words, code, says",
    [
        (("scene.json", "--resume", "--kind", "vm"), 3, "no checkpoint"),
        (("nowhere.json",), 3, "no such file"),
        (("scene.json", "--device", "cuda"), 5, "no GPU"),
        (("scene.json", "--kind", "voxels"), 2, "voxels"),
    ],
)
def test_what_cannot_be_fused(run, folder, words, code, says):
    result = run("fuse", *words, "-o", "fused.rfpack")
    assert result.exit_code == code and says in result.stderr and result.stdout == ""
    assert not (folder / "fused.rfpack").exists()


def test_an_output_in_the_way_is_left_alone(run, folder):
    (folder / "fused.rfpack").write_text("mine")
    assert run("fuse", "scene.json", "-o", "fused.rfpack").exit_code != 0
    assert (folder / "fused.rfpack").read_text() == "mine"
    assert run("fuse", "scene.json", "-o", "fused.rfpack", "-w").exit_code == 0
