"""`train A B --shared-decoder` for real: fields of two captures of 24 x 24, of a red and of a blue box."""

import shutil

import numpy as np
import pytest

from formats.bundle import OpenBundle, read_bundle
from formats.checkpoints import read_checkpoint, write_checkpoint
from fusedrf_cli.bridge.memory import Memory, together
from fusedrf_cli.bridge.training import TrainPresets
from fusedrf_cli.engine.distillation.config import TrainConfig
from fusedrf_cli.engine.distillation.fit import FitRun
from fusedrf_cli.engine.settings import using
from tests.bridge.conftest import FIELDS, done, write_views

WORDS = ("train", "photos", "bluish", "--shared-decoder", "-o", "out.rfpack")
LONGER = TrainPresets(normal=TrainConfig(longest=24, steps=300, samples=1 << 13))
NO_RUN = "it was trained"


@pytest.fixture(scope="module")
def made(shop, tmp_path_factory):
    """The shop with photos of the blue box, too, and two.rfpack of both, with the report that was given."""
    folder = shutil.copytree(shop, tmp_path_factory.mktemp("made") / "shop")
    write_views(folder / "bluish", FIELDS["blue"])
    with using(LONGER):
        said = done(folder, *WORDS[:-1], "two.rfpack", "--holdout", "4")
    return folder, said


@pytest.fixture
def folder(made, tmp_path):
    return shutil.copytree(made[0], tmp_path / "shop")


def members(path) -> tuple[list[str], list[str]]:
    """The fields of a bundle, and what they share."""
    headers = OpenBundle(path).headers
    shared = [name for name, header in headers.items() if header.kind == "part"]
    return sorted(headers.keys() - set(shared)), shared


def test_both_fields_show_their_captures_by_one_decoder(made, report, run, folder):
    said = made[1]
    assert list(said["sources"]) == ["photos", "bluish"] and said["kind"] == "dense-mlp"
    assert said["bytes"] == (folder / "two.rfpack").stat().st_size
    for own in said["sources"].values():
        assert own["steps"] == 300 and own["views"] + own["holdout"]["views"] == 10
        assert own["training_psnr"] > 20 and own["holdout"]["psnr"] > 20
    fields, shared = members(folder / "two.rfpack")
    assert len(fields) == 2 and len(shared) == 1
    assert read_bundle(folder / "two.rfpack").scene.cameras is None  # those of which capture?
    decoders = [
        {name: array for name, array in record.arrays.items() if name.startswith("decoder.")}
        for record in read_bundle(folder / "two.rfpack").fields.values()
        if record.kind == "dense-mlp"
    ]
    assert len(decoders) == 2 and len(decoders[0]) == 4
    assert all(np.array_equal(array, decoders[1][name]) for name, array in decoders[0].items())
    assert run("validate", "two.rfpack").exit_code == 0
    for name, other in (("photos", "bluish"), ("bluish", "photos")):  # each alone, from all cameras
        report("delete", "two.rfpack", other, "-o", "one.rfpack", "-w")
        assert members(folder / "one.rfpack")[1] == shared
        assert report("eval", "one.rfpack", "--against", name)["mean"]["psnr"] > 20
        assert report("eval", "one.rfpack", "--against", other)["mean"]["psnr"] < 15


def test_a_report_for_people_has_a_part_for_each(run):
    result = run(*WORDS)
    assert "it keeps the cameras of none" in result.stderr
    said = result.stdout
    assert "\n  photos:\n" in said and "\n  bluish:\n" in said and said.count("training psnr: ") == 2


def test_two_copies_of_a_capture_learn_what_one_does_alone(report, in_force):
    in_force(LONGER)
    alone = report("train", "photos", "--kind", "dense-mlp", "--holdout", "4", "-o", "alone.rfpack")
    both = report("train", "photos", "photos", *WORDS[3:], "--holdout", "4")["sources"]
    assert list(both) == ["photos", "photos-2"]
    for own in both.values():
        assert own["holdout"]["psnr"] == pytest.approx(alone["holdout"]["psnr"], abs=1.0)


def test_the_same_seed_gives_the_same_bytes(report, folder):
    for name, seed in (("a", "1"), ("b", "1"), ("c", "2")):
        report(*WORDS[:-1], f"{name}.rfpack", "--seed", seed)
    a, b, c = ((folder / f"{name}.rfpack").read_bytes() for name in "abc")
    assert a == b != c


@pytest.fixture(scope="module")
def straight(made, tmp_path_factory) -> bytes:
    """The bundle of a run that nobody interrupted."""
    folder = shutil.copytree(made[0], tmp_path_factory.mktemp("straight") / "shop")
    done(folder, *WORDS)
    return (folder / "out.rfpack").read_bytes()


@pytest.mark.parametrize("at", [1, 61, 118])
def test_an_interrupted_run_goes_on_to_the_same_bytes(report, run, folder, interrupted_in_step, straight, at):
    with interrupted_in_step(at):
        result = run(*WORDS)
    assert result.exit_code == 130 and "--resume" in result.stderr
    assert not (folder / "out.rfpack").exists() and (folder / "out.rfpack.checkpoint").exists()
    said = report(*WORDS, "--resume")
    assert [own["steps"] for own in said["sources"].values()] == [60, 60]
    assert (folder / "out.rfpack").read_bytes() == straight
    assert not (folder / "out.rfpack.checkpoint").exists()


def test_a_checkpoint_of_other_sources_is_refused(run, folder, interrupted_in_step):
    with interrupted_in_step(9):
        run(*WORDS)
    arrays, state = read_checkpoint(folder / "out.rfpack.checkpoint")
    alone = ("train", "photos", "--kind", "dense-mlp", "-o", "out.rfpack")
    for words in (alone, ("train", "photos", *WORDS[1:])):
        result = run(*words, "--resume")
        assert result.exit_code == 3 and "other settings" in result.stderr
    runs = state["runs"]
    for wrong in ({"0": runs["0"]}, runs | {"1": {}}, 3):
        write_checkpoint(folder / "out.rfpack.checkpoint", arrays, state | {"runs": wrong})
        result = run(*WORDS, "--resume")
        assert result.exit_code == 3 and "other settings" in result.stderr


def test_a_size_is_shared_evenly(report, run, folder):
    whole = report(*WORDS)
    size = 2 * whole["bytes"] // 3
    less = report(*WORDS, "--max-size", str(size), "-w")
    assert less["bytes"] <= size
    longest = [max(own["resolution"]) for own in less["sources"].values()]
    assert max(longest) < 24 and np.ptp(longest) <= 4
    result = run(*WORDS, "-w", "--max-size", "10kB")
    assert result.exit_code == 2 and "photos: --max-size is too small" in result.stderr
    assert "equal parts" in result.stderr


def test_a_missed_target_names_the_field(run, folder, report, in_force):
    result = run(*WORDS, "--target-psnr", "80")
    assert result.exit_code == 7 and "out.rfpack: node 'photos': reached" in result.stderr
    in_force(TrainPresets(normal=TrainConfig(longest=24, steps=600, samples=1 << 13)))
    said = report(*WORDS, "--target-psnr", "14", "-w")
    assert all(own["training_psnr"] > 14 and own["steps"] < 600 for own in said["sources"].values())


def test_a_time_budget_is_that_of_both(report, in_force):
    in_force(TrainPresets(draft=TrainConfig(longest=24, steps=10**6, samples=1 << 13)))
    said = report(*WORDS, "--quality", "draft", "--time-budget", "1")
    assert said["seconds"]["training"] < 60 and all(own["steps"] > 1 for own in said["sources"].values())


@pytest.mark.parametrize(
    "words, says",
    [
        (
            ("--kind", "vm"),
            "--kind vm has no decoder that fields can share; with --shared-decoder take dense-mlp",
        ),
        (("--kind", "cp"), "--kind cp has no decoder"),
        (("--sh-degree", "1"), "--sh-degree does not apply to kind 'dense-mlp'"),
        (("--ranks", "8,8"), "--ranks does not apply"),
    ],
)
def test_what_cannot_be_shared_is_refused(run, folder, monkeypatch, words, says):
    monkeypatch.setattr(FitRun, "start", lambda *_: pytest.fail(NO_RUN))
    result = run(*WORDS, *words)
    assert result.exit_code == 2 and says in result.stderr and result.stderr.count("\n") == 1
    assert not (folder / "out.rfpack").exists()


def test_one_source_that_cannot_be_refined_is_named(run, folder, monkeypatch):
    monkeypatch.setattr(FitRun, "start", lambda *_: pytest.fail(NO_RUN))
    (folder / "cube.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    result = run("train", "photos", "cube.obj", *WORDS[3:], "--refine-poses")
    assert result.exit_code == 2 and "cube.obj: the views of a mesh have exact poses" in result.stderr


def test_memory_is_expected_of_all_together(run, folder, monkeypatch):
    needed, expect = [], Memory.expect
    monkeypatch.setattr(Memory, "expect", lambda self, *stages, **more: needed.append(stages))
    for words in (WORDS, ("train", "photos", "--kind", "dense-mlp", "-o", "out.rfpack")):
        assert run(*words, "-w").exit_code == 0
    both, alone = (max(sum(stage.values()) for stage in stages) for stages in needed)
    assert 1.1 * alone < both < 2 * alone
    parts = together({"a": 1.0, "its occupancy": 5.0}, {"a": 2.0, "its occupancy": 3.0, "b": 4.0})
    assert parts == {"a": 3.0, "its occupancy": 5.0, "b": 4.0}
    monkeypatch.setattr(Memory, "expect", expect)
    monkeypatch.setattr(FitRun, "start", lambda *_: pytest.fail(NO_RUN))
    result = run(*WORDS, "-w", "--memory", "20MB")
    assert result.exit_code == 5 and "needs about" in result.stderr


# -- what becomes of the bundle ------------------------------------------------------------------------------


EDITS = {
    "move": ("bluish", "-t", "2,0,0", "-r", "0,0,30"),
    "duplicate": ("bluish", "twin", "-t", "0.5,0,0"),
    "rename": ("bluish", "other"),
    "tint": ("bluish", "1,0.5,0"),
    "crop": ("bluish", "0,0,0,0.2"),
    "add": ("red.rfpack", "--name", "red", "-t", "0,0,2"),
}


@pytest.mark.parametrize("verb", EDITS)
def test_edits_keep_what_is_shared_stored_once(report, run, folder, verb):
    before = members(folder / "two.rfpack")
    report(verb, "two.rfpack", *EDITS[verb], "-o", "more.rfpack")
    fields, shared = members(folder / "more.rfpack")
    assert shared == before[1] and set(before[0]) <= set(fields)
    assert run("validate", "more.rfpack").exit_code == 0


def test_nodes_of_two_bundles_keep_what_they_share(report, folder, picture):
    """One of both is added to another bundle, then the other one."""
    for name, other in (("photos", "bluish"), ("bluish", "photos")):
        report("delete", "two.rfpack", other, "-o", f"{name}.rfpack")
    shutil.copy(folder / "floor.rfpack", folder / "scene.rfpack")
    for name, at in (("photos", "0.5,0,0"), ("bluish", "-0.5,0,0")):
        report("add", "scene.rfpack", f"{name}.rfpack", "--name", name, "-t", at, "-o", "scene.rfpack", "-w")
    fields, shared = members(folder / "scene.rfpack")
    assert len(fields) == 3 and shared == members(folder / "two.rfpack")[1]
    placed = ("photos.rfpack", "-t", "0.5,0,0", "bluish.rfpack", "-t", "-0.5,0,0")
    report("compose", "floor.rfpack", *placed, "-o", "same.json")
    np.testing.assert_allclose(picture("scene.rfpack"), picture("same.json"), atol=1 / 255)


@pytest.mark.parametrize("size", [None, 0.6])
def test_fused_fields_have_one_decoder_still(report, folder, size):
    """Also where the fields are stored in fewer bytes, and learn anew what they lost by it."""
    report("move", "two.rfpack", "bluish", "-t", "0.7,0,0", "-o", "apart.rfpack")
    before = (folder / "apart.rfpack").stat().st_size
    words = () if size is None else ("--max-size", str(int(size * before)))
    said = report("fuse", "apart.rfpack", "--kind", "blocks", "-o", "fused.rfpack", *words)
    fields, shared = members(folder / "fused.rfpack")
    assert len(fields) == 2 and shared == members(folder / "two.rfpack")[1]
    assert size is None or said["bytes"] <= size * before


def test_one_of_the_fields_is_converted(report, folder):
    report("delete", "two.rfpack", "bluish", "-o", "one.rfpack")
    said = report("convert", "one.rfpack", "--kind", "vm", "--max-size", "300kB", "-o", "vm.rfpack")
    assert said["from"] == "dense-mlp" and said["psnr"] > 20 and members(folder / "vm.rfpack")[1] == []
