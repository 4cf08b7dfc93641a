"""`train` for real, on eight pictures of 24 x 24."""

import errno
import json
import os
import shutil
import tempfile
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from safetensors.numpy import save

from formats import atomic
from formats.bundle import read_bundle
from formats.camera_set import read_camera_set
from formats.checkpoints import read_checkpoint, write_checkpoint
from fusedrf_cli import signals
from fusedrf_cli.bridge.runtime import RuntimeConfig
from fusedrf_cli.bridge.training import TrainPresets
from fusedrf_cli.engine.distillation.config import TrainConfig
from fusedrf_cli.engine.distillation.fit import FitRun
from fusedrf_cli.engine.distillation.poses import changed_each, turns
from fusedrf_cli.engine.fields.computed import ComputedField
from fusedrf_cli.engine.settings import using
from tests.bridge.conftest import done, part

WORDS = ("--sh-degree", "1", "--aabb", "-0.5,-0.5,-0.5,0.5,0.5,0.5", "--precision", "float32")
LONGER = TrainPresets(normal=TrainConfig(longest=24, steps=300, samples=1 << 13))


def train(report, output="out.rfpack", *more):
    return report("train", "photos", "-o", output, *WORDS, *more)


def test_photos_become_a_field(report, folder, in_force):
    in_force(LONGER)
    said = train(report)
    assert said["views"] == 8 and said["steps"] == 300 and said["kind"] == "vm" and said["holdout"] is None
    assert said["bytes"] == (folder / "out.rfpack").stat().st_size
    (record,) = read_bundle(folder / "out.rfpack").fields.values()
    assert record.kind == "vm" and record.metadata["shape"]["sh_degree"] == 1
    assert said["training_psnr"] > 18
    assert report("eval", "out.rfpack", "--against", "photos")["mean"]["psnr"] > 18


def test_the_same_seed_gives_the_same_bytes(report, folder):
    for name, seed in (("a", "1"), ("b", "1"), ("c", "2")):
        train(report, f"{name}.rfpack", "--seed", seed)
    a, b, c = (next(iter(read_bundle(folder / f"{n}.rfpack").fields)) for n in "abc")
    assert a == b != c


@pytest.fixture(scope="module")
def straight(shop, tmp_path_factory) -> list[str]:
    """Members of the bundle of a run that nobody interrupted. They are named by their content's hash: the
    same name is the same numbers."""
    folder = shutil.copytree(shop, tmp_path_factory.mktemp("straight") / "shop")
    train(partial(done, folder))
    return list(read_bundle(folder / "out.rfpack").fields)


@pytest.mark.parametrize("at", [1, 6, 30, 54])
def test_an_interrupted_run_goes_on_to_the_same_bytes(report, run, folder, interrupted_in_step, straight, at):
    """Interrupted in the midst of a step, at the first, and at 10, 50 and 90 % of a run."""
    with interrupted_in_step(at):
        result = run("train", "photos", "-o", "out.rfpack", *WORDS)
    assert result.exit_code == 130 and "--resume" in result.stderr
    assert not (folder / "out.rfpack").exists() and (folder / "out.rfpack.checkpoint").exists()
    assert train(report, "out.rfpack", "--resume")["steps"] == 60
    assert not (folder / "out.rfpack.checkpoint").exists()
    assert list(read_bundle(folder / "out.rfpack").fields) == straight


def test_an_interrupt_before_all_goes_on_to_the_same_bytes(report, run, folder, straight, monkeypatch):
    def stop(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(FitRun, "share", stop)
        assert run("train", "photos", "-o", "out.rfpack", *WORDS).exit_code == 130
    train(report, "out.rfpack", "--resume")
    assert list(read_bundle(folder / "out.rfpack").fields) == straight


def test_a_run_that_is_killed_goes_on_from_where_it_was_saved_last(
    report, run, folder, straight, monkeypatch, in_force
):
    class Killed(BaseException):
        """Nothing that anyone catches."""

    step, steps = FitRun.step, []

    def killed(self, share):
        steps.append(share)
        if len(steps) == 30:
            raise Killed
        step(self, share)

    with monkeypatch.context() as patch, using(RuntimeConfig(saved_every=0.0)):
        patch.setattr(FitRun, "step", killed)
        with pytest.raises(Killed):
            run("train", "photos", "-o", "out.rfpack", *WORDS)
    assert not (folder / "out.rfpack").exists()
    train(report, "out.rfpack", "--resume")
    assert list(read_bundle(folder / "out.rfpack").fields) == straight


def test_a_second_interrupt_does_not_wait(run, folder, interrupted_in_step):
    """It tears a step, so that nothing is left to go on from."""
    with interrupted_in_step(6, times=2):
        result = run("train", "photos", "-o", "out.rfpack", *WORDS)
    assert result.exit_code == 130 and "--resume" not in result.stderr
    assert not list(folder.glob("out.*"))


def test_two_signals_at_once_are_one_to_a_process_that_obeys(run, folder, interrupted_in_step, monkeypatch):
    """As `timeout` sends them: the state is saved all the same."""
    monkeypatch.setattr(signals, "_obeying", True)
    monkeypatch.setattr(signals, "_raised", None)
    with interrupted_in_step(6, times=2):
        result = run("train", "photos", "-o", "out.rfpack", *WORDS)
    assert result.exit_code == 130 and "--resume" in result.stderr
    assert (folder / "out.rfpack.checkpoint").exists()


@pytest.mark.parametrize("at", [2, 5])
def test_the_state_before_a_refresh_that_is_cut_off_goes_on_to_the_same_bytes(
    report, run, folder, straight, monkeypatch, at
):
    """What a process that has to be ended in a long loop saves, from another thread."""

    class Ended(BaseException):
        """Nothing that anyone catches."""

    refresh, calls = FitRun.refresh, []

    def ended(self, share):
        calls.append(share)
        refresh(self, share)
        if len(calls) == at:
            signals.last()
            raise Ended

    with monkeypatch.context() as patch:
        patch.setattr(FitRun, "refresh", ended)
        with pytest.raises(Ended):
            run("train", "photos", "-o", "out.rfpack", *WORDS)
    assert "--resume" in signals.remains
    train(report, "out.rfpack", "--resume")
    assert list(read_bundle(folder / "out.rfpack").fields) == straight


def test_bad_steps_are_told(report, run, folder, monkeypatch):
    train_rays, calls = ComputedField.train_rays, []

    def bad_twice(field, batch, grads, loss):
        calls.append(0)
        train_rays(field, batch, grads, loss)
        loss *= float("inf") if len(calls) in (5, 25) else 1

    with monkeypatch.context() as patch:
        patch.setattr(ComputedField, "train_rays", bad_twice)
        said = train(report, "out.rfpack")
    assert said["skipped_steps"] == 2 and said["roll_backs"] == 0
    assert any("2 steps were not finite" in warning for warning in said["warnings"])
    assert "skipped_steps" not in train(report, "fine.rfpack")


def test_a_plain_keyboard_interrupt_leaves_a_checkpoint_too(run, folder, monkeypatch):
    def stop(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(FitRun, "refresh_occupancy", stop)
    assert run("train", "photos", "-o", "out.rfpack", *WORDS).exit_code == 130
    assert (folder / "out.rfpack.checkpoint").exists()


def test_refined_poses_are_told_kept_and_measured_apart(report, folder, monkeypatch):
    """Every round moves the cameras by known steps, which add up in the report and in the bundle; those held
    out stay."""
    train(report, "as_given.rfpack", "--holdout", "4")

    def refine_poses(run, share):
        turn, move = (np.tile(axis, (len(run.pool.pixel), 1)) for axis in ((0, 0, 0.001), (0.002, 0, 0)))
        run.pool.set_poses(changed_each(run.pool.poses, np.concatenate([turn, move], 1)))

    monkeypatch.setattr(FitRun, "refine_poses", refine_poses)
    said = train(report, "out.rfpack", "--holdout", "4", "--refine-poses")
    given, kept = (
        read_camera_set(read_bundle(folder / f"{n}.rfpack").scene.cameras) for n in ("as_given", "out")
    )
    rounds = round(said["poses"]["turned_degrees"] / np.degrees(0.001))
    assert rounds >= 4
    for before, after in zip(given.train, kept.train, strict=True):
        expected = before.camera_to_world.copy()
        expected[:3, :3] = turns(np.array([[0, 0, 0.001 * rounds]]))[0] @ expected[:3, :3]
        expected[0, 3] += said["poses"]["moved"]
        np.testing.assert_allclose(after.camera_to_world, expected, atol=1e-5)
    for before, after in zip(given.test, kept.test, strict=True):
        np.testing.assert_array_equal(after.camera_to_world, before.camera_to_world)
    aligned = said["holdout"]["aligned"]
    assert aligned["views"] == said["holdout"]["views"]  # what alignment finds: test_pose_refinement.py


def test_poses_of_a_mesh_are_exact(run, folder):
    (folder / "mesh.obj").write_bytes(b"")
    result = run("train", "mesh.obj", "-o", "mesh.rfpack", "--refine-poses")
    assert result.exit_code == 2 and "exact poses" in result.stderr


@pytest.mark.parametrize("at", [6, 54])
def test_poses_are_kept_over_an_interrupt(report, run, folder, interrupted_in_step, at):
    words = ("train", "photos", *WORDS, "--refine-poses", "-o")
    report(*words, "straight.rfpack")
    with interrupted_in_step(at):
        result = run(*words, "out.rfpack")
    assert result.exit_code == 130
    report(*words, "out.rfpack", "--resume")
    assert (
        read_bundle(folder / "out.rfpack").fields.keys()
        == read_bundle(folder / "straight.rfpack").fields.keys()
    )


def test_holdout_measures_on_views_left_out(report):
    said = train(report, "out.rfpack", "--holdout", "4")
    assert said["views"] + said["holdout"]["views"] >= 8 and said["holdout"]["views"] >= 2
    assert said["holdout"]["psnr"] > 9


def test_max_size_makes_it_smaller(report):
    whole = train(report, "whole.rfpack")["bytes"]
    less = train(report, "less.rfpack", "--max-size", "100kB")
    assert less["bytes"] < min(whole, 100_000) and max(less["resolution"]) < 24


def test_a_size_that_nothing_fits_is_refused(run, folder):
    result = run("train", "photos", "-o", "no.rfpack", *WORDS, "--max-size", "1kB")
    assert result.exit_code == 2 and "--max-size is too small" in result.stderr
    assert not (folder / "no.rfpack").exists()


def test_a_missed_target_is_exit_7_and_the_output_is_there(run, folder):
    result = run("train", "photos", "-o", "out.rfpack", *WORDS, "--target-psnr", "80", "--json")
    assert result.exit_code == 7 and "--target-psnr asked for 80" in result.stderr
    assert json.loads(result.stdout)["bytes"] == (folder / "out.rfpack").stat().st_size


def test_divergence_is_exit_6(run, folder, monkeypatch):
    monkeypatch.setattr(ComputedField, "train_rays", lambda field, batch, grads, loss: loss.fill(np.nan))
    result = run("train", "photos", "-o", "out.rfpack", *WORDS)
    assert result.exit_code == 6 and "diverged" in result.stderr and not (folder / "out.rfpack").exists()
    assert "44 steps" in result.stderr and "3 returns" in result.stderr


def test_a_checkpoint_of_something_else_is_refused(run, folder):
    path = folder / "out.rfpack.checkpoint"
    old = save({}, {"fusedrf": "{}"})
    contents = (b"junk", 3, "not a readable"), (old, 4, "earlier"), (None, 3, "no checkpoint")
    for content, code, says in contents:
        path.unlink(missing_ok=True)
        if content:
            path.write_bytes(content)
        result = run("train", "photos", "-o", "out.rfpack", *WORDS, "--resume")
        assert result.exit_code == code and says in result.stderr
    write_checkpoint(path, {}, {"command": "train", "kind": "vm"})
    result = run("train", "photos", "-o", "out.rfpack", *WORDS, "--resume")
    assert result.exit_code == 3 and "other settings" in result.stderr


def test_a_checkpoint_whose_parts_do_not_fit_is_refused(run, folder, interrupted_in_step):
    """Under a right checksum: before anything is learnt from it, and whatever it holds."""
    with interrupted_in_step(2):
        run("train", "photos", "-o", "out.rfpack", *WORDS)
    path = folder / "out.rfpack.checkpoint"
    arrays, state = read_checkpoint(path)
    wrong = [
        (arrays, state | {"steps": "1"}),
        (arrays, state | {"drawn": 10**9}),
        (arrays, state | {"refreshes": [[]]}),
        (arrays | {"moment1": arrays["moment1"][:1]}, state),
        (arrays | {"keys_of_order": arrays["keys_of_order"][:1]}, state),
        (arrays | {"rotation": arrays["rotation"][:1]}, state),
        (arrays | {"random": arrays["random"][:9]}, state),
    ]
    for content in wrong:
        write_checkpoint(path, *content)
        result = run("train", "photos", "-o", "out.rfpack", *WORDS, "--resume")
        assert result.exit_code == 3 and "other settings" in result.stderr


@pytest.mark.parametrize(
    "found, own, alike",
    [
        *(
            (3, 5, True),
            (-3, 5, False),
            (3.5, 5, False),
            (True, 5, False),
            ("3", 5, False),
            (2**60, 5, False),
        ),
        *((3, 0.5, True), (-3.5, 0.5, True), (None, 0.5, False), ([], 0.5, False), (float("nan"), 0.5, True)),
        *((None, None, True), (0.5, None, True), ("x", None, False), ({}, None, False)),
        *(([1], [], True), ({}, [], False), ("b", "a", True), (1, "a", False), (1, True, False)),
        *(({"a": 1, "b": 2}, {"a": 3}, True), ({}, {"a": 3}, False), ({"a": "x"}, {"a": 3}, False)),
        ({"field": 7}, {"field": {}}, True),
    ],
)
def test_states_are_held_against_a_runs_own(found, own, alike):
    try:
        part("runtime").check_alike(found, own, "a state")
        assert alike
    except ValueError:
        assert not alike


def test_a_checkpoint_in_the_way_is_left_alone(run, folder):
    """What an earlier run learnt is not overwritten unasked."""
    path = folder / "out.rfpack.checkpoint"
    path.write_bytes(b"an hour")
    result = run("train", "photos", "-o", "out.rfpack", *WORDS)
    assert result.exit_code == 1 and "--resume" in result.stderr and path.read_bytes() == b"an hour"
    assert run("train", "photos", "-o", "out.rfpack", *WORDS, "-w").exit_code == 0 and not path.exists()


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EROFS])
def test_a_full_disk_meanwhile_is_told_once_and_no_end(report, monkeypatch, in_force, code):
    """P5: a folder may have become read-only, too."""
    tries = []

    def full(path, arrays, state):
        tries.append(state["steps"])
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(part("runtime"), "write_checkpoint", full)
    in_force(RuntimeConfig(saved_every=0.0))
    said = train(report)
    assert len(tries) > 5 and said["steps"] == 60
    assert len([text for text in said["warnings"] if "learning goes on" in text]) == 1


def test_an_interrupt_on_a_full_disk_saves_elsewhere(
    report, run, folder, interrupted_in_step, straight, monkeypatch
):
    write, room = part("runtime").write_checkpoint, folder.parent / "room"
    room.mkdir()

    def full(path, *words):
        if Path(path).parent.resolve() == folder.resolve() or str(path).startswith("out"):
            raise OSError(errno.ENOSPC, "No space left on device")
        write(path, *words)

    with monkeypatch.context() as patch:
        patch.setattr(part("runtime"), "write_checkpoint", full)
        patch.setattr(tempfile, "tempdir", str(room))
        with interrupted_in_step(30):
            result = run("train", "photos", "-o", "out.rfpack", *WORDS)
    (saved,) = room.glob("fusedrf-saved-*/out.rfpack.checkpoint")
    assert result.exit_code == 130 and str(saved) in result.stderr and "move it to" in result.stderr
    shutil.move(saved, folder / "out.rfpack.checkpoint")
    train(report, "out.rfpack", "--resume")
    assert list(read_bundle(folder / "out.rfpack").fields) == straight


def test_an_output_that_cannot_be_written_in_the_end_is_written_elsewhere(run, folder, straight, monkeypatch):
    """P5: its folder is gone by then."""
    place, room = folder / "sub", folder.parent / "room"
    place.mkdir()
    room.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(room))
    monkeypatch.setattr(FitRun, "forget", lambda run: shutil.rmtree(place))
    result = run("train", "photos", "-o", "sub/out.rfpack", *WORDS)
    (saved,) = room.glob("fusedrf-saved-*/out.rfpack")
    assert result.exit_code == 5 and str(saved) in result.stderr
    assert list(read_bundle(saved).fields) == straight


def test_an_interrupt_while_measuring_loses_nothing(run, folder, monkeypatch):
    def stop(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(part("trained_sources"), "measure", stop)
    result = run("train", "photos", "-o", "out.rfpack", *WORDS, "--holdout", "4")
    assert result.exit_code == 130 and "out.rfpack is written whole" in result.stderr
    read_bundle(folder / "out.rfpack")
    assert not (folder / "out.rfpack.checkpoint").exists()


@pytest.mark.parametrize("device, code", [("cuda", 5), ("cpu", 0)])
def test_a_gpu_that_is_not_there_is_told(run, device, code, monkeypatch):
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    result = run("train", "photos", "-o", "out.rfpack", *WORDS, "--device", device)
    assert result.exit_code == code and ("--device cpu" in result.stderr) == (code == 5)


def test_the_compiler_for_gpus_is_asked_for(run, monkeypatch):
    monkeypatch.setattr("torch.cuda.is_available", lambda: True)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    result = run("train", "photos", "-o", "out.rfpack", *WORDS, "--device", "cuda")
    assert result.exit_code == 5 and "fusedrf[gpu]" in result.stderr


def test_an_option_that_a_kind_does_not_heed_is_refused(run):
    result = run("train", "photos", "-o", "out.rfpack", *WORDS, "--kind", "vm-mlp")
    assert result.exit_code == 2 and "--sh-degree does not apply to kind 'vm-mlp'" in result.stderr


def test_an_output_in_the_way_is_left_alone(run, folder):
    (folder / "out.rfpack").write_text("mine")
    assert run("train", "photos", "-o", "out.rfpack", *WORDS).exit_code != 0
    assert (folder / "out.rfpack").read_text() == "mine"


def test_a_disk_without_room_is_found_before_training(run, folder, monkeypatch):
    """P5."""
    monkeypatch.setattr(atomic.shutil, "disk_usage", lambda _: SimpleNamespace(free=5000))
    monkeypatch.setattr(FitRun, "start", lambda *_: pytest.fail("it was trained"))
    result = run("train", "photos", "-o", "out.rfpack", *WORDS)
    assert result.exit_code == 5 and "the disk has 5,000 left" in result.stderr
    assert not (folder / "out.rfpack").exists()
