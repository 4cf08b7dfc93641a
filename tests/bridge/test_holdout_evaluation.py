"""How held-out photos are measured, with and without a field, against values worked out by hand."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from formats.images import write_png
from formats.views import Capture, View
from fusedrf_cli.bridge.holdout_evaluation import (
    mean_colour,
    measure,
    nearest,
    nearest_photo,
    warn_of_holdout,
)
from fusedrf_cli.engine.distillation.ray_dataset import Pictures
from fusedrf_cli.progress import NullProgress
from tests.bridge.conftest import FIELDS
from tests.formats.test_captures import looking_at

TINY = (6, 4)


def view(name: str, eye, grey, size=TINY, at=(0, 0, 0), mask_path=None) -> View:
    """A camera that stands at `eye` and looks at a point, behind a photo of one grey in [0, 255]."""
    width, height = size
    pixels = np.full((height, width, 4), grey, np.uint8)
    pixels[..., 3] = 255
    pose = looking_at(np.array(eye, float), np.array(at, float))
    return View(
        name, pose, 20.0, 20.0, width / 2, height / 2, width, height, pixels=pixels, mask_path=mask_path
    )


def capture(train, test) -> Capture:
    box = np.array([-0.5, -0.5, -0.5, 0.5, 0.5, 0.5])
    return Capture(Path("x"), "transforms", tuple(train), tuple(test), box, opaque=True)


def pictures(views, ignored=None) -> Pictures:
    return Pictures(np.concatenate([v.pixels.reshape(-1, 4) for v in views]), ignored)


RING = [(4, 0, 1), (0, 4, 1), (-4, 0, 1), (0, -4, 1)]


def test_baselines_by_hand():
    """Photos of grey 0, 51, 102 and 153 stand at four corners; one of 61 is held out beside the second, one
    of 153 and of twice the size beside the fourth."""
    train = [view(str(i), eye, 51 * i) for i, eye in enumerate(RING)]
    test = [view("a", (0.3, 4, 1), 61), view("b", (0.1, -4, 1), 153, (12, 8))]
    subject = capture(train, test)
    assert [nearest(v, subject) for v in test] == [1, 3]
    assert nearest_photo(test[1], subject, pictures(train)).shape == (8, 12, 3)
    found = measure(FIELDS["red"], subject, pictures(train), np.eye(4), 30.0)
    copied = (-20 * np.log10(10 / 255) + 100) / 2
    flat = np.mean([-20 * np.log10(abs(76.5 - grey) / 255) for grey in (61, 153)])
    assert found["baseline_psnr"]["nearest_photo"] == pytest.approx(copied, abs=1e-3)
    assert found["baseline_psnr"]["mean_colour"] == pytest.approx(flat, abs=1e-3)
    assert found["views"] == 2 and found["psnr_gap"] == pytest.approx(30 - found["psnr"])
    # One affine map makes a photo of one colour out of anything.
    assert found["colour_corrected_psnr"] > 90 > found["psnr"]


def test_the_nearest_camera_looks_the_same_way_too():
    """Two cameras stand on either side of a third at the same distance; one of them looks elsewhere."""
    aside, alike = view("aside", (3.9, 0, 1), 0, at=(4, 9, 1)), view("alike", (4, 0.1, 1), 0)
    subject = capture([aside, alike, view("c", RING[1], 0)], [])
    assert nearest(view("x", (4, 0, 1), 0), subject) == 1


def test_pixels_that_masks_exclude_count_nowhere(tmp_path):
    """The left half of each photo is excluded: training photos are white there, the held-out one noise."""
    levels = np.zeros((4, 6, 3), np.uint8)
    levels[:, 3:] = 255
    write_png(tmp_path / "mask.png", levels)
    train = [view(str(i), eye, 100, mask_path=tmp_path / "mask.png") for i, eye in enumerate(RING)]
    for v in train:
        v.pixels[:, :3, :3] = 255
    test = view("a", (0.3, 4, 1), 120, mask_path=tmp_path / "mask.png")
    test.pixels[:, :3, :3] = np.random.default_rng(0).integers(0, 256, (4, 3, 3))
    subject = capture(train, [test])
    ignored = np.tile(levels[..., 0].ravel() == 0, 4)
    clear = pictures(train)
    clear.pixels[ignored, 3] = 0  # as with --masks alpha
    for known in (pictures(train, ignored), clear):
        np.testing.assert_allclose(mean_colour(subject, known), 100 / 255, rtol=1e-6)
        found = measure(FIELDS["red"], subject, known, np.eye(4), 30.0)
        assert found["baseline_psnr"]["nearest_photo"] == pytest.approx(-20 * np.log10(20 / 255), abs=1e-3)
    write_png(tmp_path / "mask.png", np.zeros_like(levels))
    assert measure(FIELDS["red"], subject, clear, np.eye(4), 30.0)["views"] == 0


def test_photos_with_alpha_count_whole():
    """Over white, and transparent pixels too: no mask made them."""
    one = view("a", RING[0], 0)
    one.pixels[:2, :, 3] = 0
    subject = replace(capture([one], []), opaque=False)
    np.testing.assert_allclose(mean_colour(subject, pictures([one])), 0.5)


@pytest.mark.parametrize(
    ("reached", "corrected", "mean", "copied", "says"),
    [
        (25.0, 25.9, 12.0, 16.5, []),
        (16.0, 17.0, 12.0, 16.5, ["a copy of the nearest training photo (16.5 dB)"]),
        (14.5, 15.0, 15.1, 14.0, ["the mean colour of the training photos (15.1 dB)"]),
        (20.0, 21.6, 12.0, 16.5, ["exposure or white balance varies"]),
        (16.0, 20.0, 12.0, 16.5, ["the field is broken", "exposure or white balance varies"]),
        (float("nan"), float("nan"), float("nan"), float("nan"), []),  # masks excluded every photo
    ],
)
def test_what_is_said_of_a_field(reached, corrected, mean, copied, says):
    progress = NullProgress()
    baselines = {"mean_colour": mean, "nearest_photo": copied}
    figures = {"psnr": reached, "colour_corrected_psnr": corrected, "baseline_psnr": baselines}
    warn_of_holdout("out.rfpack", figures, progress)
    assert len(progress.warnings) == len(says)
    assert all(part in text for part, text in zip(says, progress.warnings, strict=True))
