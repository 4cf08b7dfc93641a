"""`eval` for real: against photos and against another scene."""

import json

import numpy as np
import pytest

from formats.images import read_image, write_png


def test_a_field_against_its_own_photos(report):
    """The photos were taken of this very field: 8 bits and float16 are all that differs."""
    for split, count in (("test", 2), ("train", 8), ("all", 10)):
        said = report("eval", "red.rfpack", "--against", "photos", "--split", split)
        assert len(said["views"]) == count and said["mean"]["psnr"] > 40 and said["mean"]["ssim"] > 0.99
    mean = sum(v["psnr"] for v in said["views"]) / 10
    assert said["mean"]["psnr"] == pytest.approx(mean)


def masked(folder, keep: int) -> None:
    """Noise over all but the first `keep` rows of the test photos, whose masks exclude it."""
    path = folder / "photos" / "transforms_test.json"
    document = json.loads(path.read_text())
    for frame in document["frames"]:
        photo = (folder / "photos" / frame["file_path"]).with_suffix(".png")
        pixels = read_image(photo)
        pixels[keep:] = np.random.default_rng(0).integers(0, 256, pixels[keep:].shape, np.uint8)
        levels = np.zeros((24, 24, 3), np.uint8)
        levels[:keep] = 255
        write_png(photo, pixels)
        write_png(photo.with_name(f"mask_{photo.name}"), levels)
        frame["mask_path"] = f"test/mask_{photo.name}"
    path.write_text(json.dumps(document))


def test_what_masks_exclude_does_not_count(report, folder):
    masked(folder, 13)
    said = report("eval", "red.rfpack", "--against", "photos")
    assert len(said["views"]) == 2 and said["mean"]["psnr"] > 40 and said["mean"]["ssim"] > 0.99


def test_masks_that_exclude_everything_leave_nothing_to_compare(run, folder):
    masked(folder, 0)
    result = run("eval", "red.rfpack", "--against", "photos")
    assert result.exit_code == 3 and "the masks exclude every pixel" in result.stderr


def test_another_field_is_worse(report):
    assert report("eval", "blue.rfpack", "--against", "photos")["mean"]["psnr"] < 20


def test_a_scene_against_itself_and_another(report):
    same = report("eval", "scene.json", "--against", "scene.json", "--size", "24x24")
    assert len(same["views"]) == 8 and same["mean"] == {"psnr": 100, "ssim": 1}
    less = report("eval", "pair.json", "--against", "scene.json", "--size", "24x24")
    found = [view["psnr"] for view in less["views"]]
    assert min(found) < 30 and less["mean"]["psnr"] == pytest.approx(np.mean(found))
    assert less["worst_object"]["name"] == "blue"  # which the pair does not have
    assert less["covered"]["psnr"] < less["mean"]["psnr"]


@pytest.mark.parametrize(
    "words, code, says",
    [
        (("photos", "--size", "10x10"), 2, "24x24"),
        (("photos", "--device", "cuda"), 5, "no GPU"),
        (("gone",), 3, "no such file"),
    ],
)
def test_what_cannot_be_compared(run, words, code, says):
    result = run("eval", "red.rfpack", "--against", *words)
    assert result.exit_code == code and says in result.stderr and result.stdout == ""


def test_a_split_without_views_is_said(run, folder):
    (folder / "photos" / "transforms_test.json").unlink()
    result = run("eval", "red.rfpack", "--against", "photos")
    assert result.exit_code == 3 and "no test views" in result.stderr and "--split train" in result.stderr
