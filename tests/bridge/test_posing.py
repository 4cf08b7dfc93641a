"""`pose`, and `train` on photos without poses: what is written, kept and told. Poses come from a stand-in."""

import json
import shutil

import numpy as np
import pytest
from PIL import Image as Pillow

from formats.captures import read_capture
from formats.points import SparsePoints
from formats.posing import PosedPhotos
from formats.views import View
from fusedrf_cli.bridge.training import TrainPresets
from fusedrf_cli.engine.distillation.config import TrainConfig
from tests.bridge.conftest import part
from tests.bridge.test_captures import DRAFT, eyes
from tests.formats.test_captures import looking_at


@pytest.fixture(autouse=True)
def short(monkeypatch, tmp_path, in_force):
    in_force(TrainPresets(draft=TrainConfig(longest=16, steps=50, samples=1 << 12)))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


@pytest.fixture
def holiday(folder, monkeypatch):
    """Six photos without poses. Five of them "find" their place; `calls` counts how often that was asked."""
    for i in range(6):
        pixels = np.random.default_rng(i).integers(0, 256, (12, 16, 3), np.uint8)
        (folder / "holiday").mkdir(exist_ok=True)
        Pillow.fromarray(pixels).save(folder / f"holiday/p{i}.png")
    calls = []

    def estimate(source, photos, threads, progress):
        calls.append(threads)
        poses = np.array([looking_at(eye, np.zeros(3)) for eye in eyes(5)])
        views = [
            View(photo.stem, pose, 12, 12, 8, 6, 16, 12, image_path=photo, seen=np.arange(i, 99, 2))
            for i, (photo, pose) in enumerate(zip(photos, poses, strict=False))
        ]
        points = SparsePoints(np.random.default_rng(0).normal(size=(99, 3)), np.zeros((99, 3), np.uint8))
        return PosedPhotos(tuple(views), points, ("p5.png",), ("p5.png",), (5,), 0.5)

    monkeypatch.setattr(part("posing"), "estimate", estimate)
    monkeypatch.setattr(part("posing"), "check_extra", lambda source: None)
    monkeypatch.setattr(part("posing"), "version", lambda package: "4")
    return calls


def test_a_capture_is_written_beside_the_photos(report, holiday, folder):
    before = sorted((folder / "holiday").iterdir())
    said = report("pose", "holiday", "-o", "garden", "--threads", "3")
    assert holiday == [3] and sorted((folder / "holiday").iterdir()) == before
    assert (said["photos"], said["posed"], said["left_out"], said["models"]) == (6, 5, ["p5.png"], [5])
    assert said["sparse_points"] == 99 and "z is up" in said["world"] and "arbitrary" in said["world"]
    (warning,) = said["warnings"]
    assert "1 of 6 photos found no pose and were left out: p5.png; p5.png are blurred or plain" in warning
    document = json.loads((folder / "garden/transforms.json").read_text())
    assert [frame["file_path"] for frame in document["frames"]] == [f"../holiday/p{i}.png" for i in range(5)]
    seen = [view.seen.tolist() for view in read_capture(folder / "garden").train]
    assert seen == [[*range(i, 99, 2)] for i in range(5)]
    assert report("train", "garden", "-o", "out.rfpack", *DRAFT)["views"] == 5
    assert len(holiday) == 1


def test_an_output_that_exists_is_refused_before_any_work(run, holiday, folder):
    (folder / "garden").mkdir()
    (folder / "garden/notes").write_text("mine")
    result = run("pose", "holiday", "-o", "garden")
    assert result.exit_code == 1 and "overwrite" in result.stderr and holiday == []


def test_train_keeps_the_poses_that_it_estimates(report, holiday, folder, tmp_path):
    said = report("train", "holiday", "-o", "out.rfpack", *DRAFT)
    assert said["views"] == 5 and said["capture"]["sparse_points"] == 99 and len(holiday) == 1
    assert "5 of 6 photos were taken is estimated" in said["capture"]["notes"][0]
    assert any("p5.png" in warning for warning in said["warnings"])
    (kept,) = (tmp_path / "cache/fusedrf/poses").iterdir()
    assert str(kept) in said["capture"]["notes"][0] and len(read_capture(kept).train) == 5
    again = report("train", "holiday", "-o", "out.rfpack", "-w", *DRAFT)
    assert len(holiday) == 1 and again["centre"] == said["centre"] and again["warnings"]
    # A photo that changed, or came, asks for them again.
    shutil.copy(folder / "holiday/p0.png", folder / "holiday/p7.png")
    report("train", "holiday", "-o", "out.rfpack", "-w", *DRAFT)
    assert len(holiday) == 2


def test_a_cache_that_cannot_be_written(report, holiday, tmp_path, monkeypatch):
    (tmp_path / "cache").write_text("a file is in the way")
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    said = report("train", "holiday", "-o", "out.rfpack", *DRAFT)
    assert said["views"] == 5 and str(tmp_path / "fusedrf-poses-") in said["capture"]["notes"][0]


def test_downscale_is_told(report, holiday):
    said = report("train", "holiday", "-o", "out.rfpack", "--downscale", "2", *DRAFT)
    assert said["capture"]["photos"] == "8x6"
    assert any("2 times smaller, to 8x6" in note for note in said["capture"]["notes"])
