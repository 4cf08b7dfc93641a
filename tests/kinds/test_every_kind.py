"""What every kind of field does, whoever wrote it: fused, edited, trained and charted as whole commands."""

import shutil
from dataclasses import asdict
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from formats.bundle import read_bundle
from fusedrf_cli import verbs
from fusedrf_cli.bridge.scene import load_scene
from fusedrf_cli.engine.fields.streamed import opened
from fusedrf_cli.engine.kinds import registry
from fusedrf_cli.engine.kinds.sparse.builder import SparseBuilder
from fusedrf_cli.engine.rendering.metrics import psnr
from fusedrf_cli.engine.settings import using
from fusedrf_cli.errors import UsageProblem
from fusedrf_cli.requests import FuseRequest
from fusedrf_cli.verbs import checked
from tests.bridge.conftest import TinySettings, done, write_scene_of
from tests.bridge.test_edit import AT, blues, covered

QUICK = {"blocks", "vm"}  # the others' loops take half a minute each to compile
LEARNT = [name for name in registry.names() if name not in registry.IMPORTED]
KINDS = [name if name in QUICK else pytest.param(name, marks=pytest.mark.slow) for name in LEARNT]
SIZE = 900_000
PHOTOS = ("train", "photos", "-o", "out.rfpack", "--aabb", "-0.5,-0.5,-0.5,0.5,0.5,0.5")


@pytest.fixture(scope="module", autouse=True)
def short(tiny):  # noqa: F811
    # a network takes its time
    with pytest.MonkeyPatch.context() as patch, using(TinySettings(points_per_step=1 << 11)):
        patch.setattr(SparseBuilder, "distil_config", TinySettings(steps=0, rgb_steps=10, rgb_rate=0.015))
        yield


@pytest.fixture(scope="module")
def made(short, shop, tmp_path_factory):
    """made(kind): a bundle of floor and red fused to it, sources inside, and what fusing said; made once."""

    @cache
    def made(kind: str) -> tuple[Path, dict]:
        folder = shutil.copytree(shop, tmp_path_factory.mktemp(kind) / "shop")
        words = ("--kind", kind, "--max-size", str(SIZE), "--keep-sources")
        return folder / "fused.rfpack", done(folder, "fuse", "pair.json", "-o", "fused.rfpack", *words)

    return made


@pytest.fixture
def fused(made, folder, kind):
    """What the fusing said; fused.rfpack lies in the folder."""
    bundle, said = made(kind)
    shutil.copy(bundle, folder)
    return said


@pytest.mark.parametrize("kind", KINDS)
def test_a_scene_becomes_a_field_of_it(fused, folder, picture, kind):
    inside = sum((folder / f"{name}.rfpack").stat().st_size for name in ("floor", "red"))
    assert fused["kind"] == kind and fused["bytes"] <= SIZE + inside
    assert fused["chosen"]["why"] and f"--kind {kind}" in fused["chosen"]["flags"]
    own = registry.kind(kind).field
    assert own is None or type(opened(load_scene(str(folder / "fused.rfpack")).placed[0].field)) is own
    assert psnr(picture("fused.rfpack"), picture("pair.json")) > 18
    assert fused["memory"]["predicted_bytes"] > 0


@pytest.mark.parametrize("kind", KINDS)
def test_equal_seeds_give_equal_bytes(report, folder, kind):
    for name in ("one", "two"):
        words = ("--kind", kind, "--max-size", str(SIZE), "--no-finetune", "--seed", "4")
        report("fuse", "pair.json", "-o", f"{name}.rfpack", *words)
    assert (folder / "one.rfpack").read_bytes() == (folder / "two.rfpack").read_bytes()


@pytest.mark.parametrize("kind", KINDS)
def test_an_object_comes_and_goes(fused, report, picture, folder, kind):
    """It shows where it was put and nowhere else; taken out, all is as it was, to the bit."""
    before = picture("fused.rfpack")
    report("add", "fused.rfpack", "blue.rfpack", *AT, "-o", "more.rfpack")
    more, away = picture("more.rfpack"), ~covered("blue")
    assert psnr(more[away], before[away]) >= 35  # on another lattice
    assert more[covered("blue", -0.1)].mean(0)[2] > before[covered("blue", -0.1)].mean(0)[2] - 0.05
    assert blues(more) > 10 and blues(before) == 0
    report("delete", "more.rfpack", "blue", "-o", "less.rfpack")
    assert np.array_equal(picture("less.rfpack"), before)
    fused, less = (read_bundle(folder / f"{name}.rfpack") for name in ("fused", "less"))
    assert fused.fields.keys() == less.fields.keys() and fused.scene.nodes == less.scene.nodes
    assert [entry["event"] for entry in less.scene.history] == ["fused", "added", "deleted"]


@pytest.mark.parametrize("kind", KINDS)
def test_what_was_distilled_is_cut_out(fused, report, picture, folder, kind):
    """Cells are emptied, and what its source shows there is a node; nothing else changes."""
    write_scene_of(folder, "floor", file="floor.json")
    before, gone = picture("fused.rfpack"), covered("red", -0.1)
    said = report("delete", "fused.rfpack", "red", "-o", "less.rfpack")
    less, wanted = picture("less.rfpack"), picture("floor.json")
    assert said["restored"] and said["warnings"] == []
    assert psnr(less[gone], wanted[gone]) > psnr(before[gone], wanted[gone]) + 3


@pytest.mark.parametrize("kind", KINDS)
def test_photos_become_a_field_of_it_or_a_clear_sentence(run, report, folder, kind):
    if not registry.kind(kind).trains:
        result = run(*PHOTOS, "--kind", kind)
        assert result.exit_code == 2 and f"{kind!r} is not one of" in result.stderr
        with pytest.raises(UsageProblem, match="does not begin from photos"):
            verbs.train("photos", "out.rfpack", kind=kind)
        assert not (folder / "out.rfpack").exists()
        return
    said = report(*PHOTOS, "--kind", kind)
    assert said["kind"] == kind and said["steps"] == 60
    assert said["bytes"] == (folder / "out.rfpack").stat().st_size
    assert np.isfinite(said["training_psnr"])


@pytest.mark.parametrize("kind", KINDS)
def test_a_target_that_is_easy_takes_few_bytes(report, kind):
    words = ("--kind", kind, "--max-size", str(SIZE), "--target-psnr", "16", "--no-finetune")
    said = report("fuse", "pair.json", "-o", "small.rfpack", *words)
    assert said["psnr"]["stored"] >= 16 and said["bytes"] < SIZE


@pytest.mark.parametrize("kind", KINDS)
def test_its_sweeps_are_keywords_of_fuse(kind):
    groups = registry.kind(kind).sweeps(30.0)
    first = [asdict(next(sweep)) for found in groups.values() for sweep in found]
    words = {"scene": "scene.json", "output": "fused.rfpack", "kind": kind}
    assert first and all(checked(FuseRequest, words | rung) for rung in first)


def test_a_kind_that_nobody_has_is_a_clear_sentence(run, folder):
    for words in (("fuse", "pair.json", "-o", "no.rfpack"), PHOTOS):
        result = run(*words, "--kind", "voxels")
        assert result.exit_code == 2 and "'voxels' is not one of" in result.stderr


def test_auto_says_why(report):
    said = report("fuse", "pair.json", "-o", "fused.rfpack")
    assert said["kind"] == "blocks" and "a field of its own" in said["kind_because"]
