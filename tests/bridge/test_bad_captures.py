"""Captures that nothing can be learnt from: each ends in one sentence that names file, photo and cure."""

import json
import shutil
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from PIL import Image as Pillow

from tests.bridge.test_captures import eyes, speckled
from tests.formats.test_captures import looking_at
from tests.formats.test_readers import binary_model, changed, llff, llff_rows

NAMES = ["a.png", "b.png", "c.png"]


def colmap(folder: Path, size=(100, 80), **words) -> None:
    binary_model(folder / "sparse/0", NAMES, apart=0.5, **words)
    for i, name in enumerate(NAMES):
        speckled(folder / "images" / name, *size, i)


def transforms(folder: Path, count: int = 4, same: bool = False, **keys) -> None:
    """Photos p0.jpg and so on, and cameras around them."""
    frames = []
    for i, eye in enumerate(eyes(count)):
        pixels = np.random.default_rng(i).integers(0, 256, (80, 100, 3), np.uint8)
        folder.mkdir(exist_ok=True)
        Pillow.fromarray(pixels).save(folder / f"p{i}.jpg")
        pose = looking_at(eyes(count)[0] if same else eye, np.zeros(3))
        frames.append({"file_path": f"p{i}.jpg", "transform_matrix": pose, "fl_x": 80, **keys})
    (folder / "transforms.json").write_text(json.dumps({"frames": frames}))


def missing_photos(folder: Path) -> None:
    colmap(folder)
    shutil.rmtree(folder / "images")


def wrong_bounds(folder: Path) -> None:
    llff(folder, rows=changed(15, 40.0))


def too_few_for_llff(folder: Path) -> None:
    llff(folder, rows=llff_rows(5))
    for file in sorted((folder / "images_4").iterdir())[2:]:
        file.unlink()


def cut_off(folder: Path) -> None:
    transforms(folder)
    data = (folder / "p2.jpg").read_bytes()
    (folder / "p2.jpg").write_bytes(data[: len(data) // 2])


def wrong_mask(folder: Path) -> None:
    transforms(folder, mask_path="mask.png")
    Pillow.new("L", (50, 50), 255).save(folder / "mask.png")


def photos_alone(folder: Path, count: int = 3) -> None:
    for i in range(count):
        speckled(folder / f"p{i}.png", 32, 24, i)


TABLE = {
    "photos of a model that are missing": (missing_photos, ("sparse/0", "a.png", "put the photos there")),
    "photos of a model that are of another shape": (
        lambda folder: colmap(folder, size=(80, 100)),
        ("images.bin", "(a.png)", "100x80", "80x100", "use the photos"),
    ),
    "an unknown camera": (
        lambda folder: colmap(folder, model=7),
        ("cameras.bin: camera 5", "FOV", "image_undistorter"),
    ),
    "bounds that do not fit": (
        wrong_bounds,
        ("poses_bounds.npy: row 1", "bounds of 40 and 30", "image001.png", "estimate"),
    ),
    "poses that do not fit": (too_few_for_llff, ("poses_bounds.npy", "5 poses", "2 in images_4", "restore")),
    "cameras at one point": (
        lambda folder: transforms(folder, same=True),
        (
            "garden/transforms.json",
            "all 4 photos, p0 to p3",
            "one point",
            "take photos from different places",
        ),
    ),
    "photos that differ from their cameras": (
        lambda folder: transforms(folder, w=80, h=100),
        ("transforms.json: frame 0 (p0.jpg)", "80x100", "100x80", "use the photos"),
    ),
    "a photo that is cut off": (cut_off, ("p2.jpg", "the file is cut off", "copy it again", "remove it")),
    "two photos": (
        lambda folder: transforms(folder, count=2),
        ("transforms.json", "has 2 photos", "3 or more", "add photos"),
    ),
    "a mask of another size": (
        wrong_mask,
        (
            "transforms.json: frame 0 (p0.jpg)",
            "mask.png is 50x50",
            "100x80",
            "make masks of the photo's size",
        ),
    ),
    "two photos without poses": (
        lambda folder: photos_alone(folder, 2),
        ("garden", "holds 2 photos", "3 or more", "take more"),
    ),
}


@pytest.mark.parametrize("make, said", TABLE.values(), ids=TABLE)
def test_one_sentence(run, folder, make, said):
    make(folder / "garden")
    one_sentence(run("train", "garden", "-o", "out.rfpack"), said)
    assert not (folder / "out.rfpack").exists()


def test_photos_too_small_to_be_made_smaller(run, folder):
    colmap(folder / "garden", size=(50, 40))
    result = run("train", "garden", "-o", "out.rfpack", "--downscale", "64")
    one_sentence(result, ("images.bin: image 1 (a.png)", "a.png is 50x40", "give a smaller --downscale"))


def one_sentence(result, said) -> None:
    assert result.exit_code in (1, 3), result.stderr
    assert result.stderr.startswith("Error: ") and result.stderr.count("\n") == 1
    for part in said:
        assert part in result.stderr
    assert result.stdout == ""


@pytest.mark.parametrize("command", ["pose", "train"])
def test_without_the_extra(run, folder, monkeypatch, command):
    monkeypatch.setattr("formats.posing.find_spec", lambda name: None)
    photos_alone(folder / "garden")
    result = run(command, "garden", "-o", "out")
    one_sentence(result, ("garden", 'pip install "fusedrf[capture]"'))


@pytest.mark.skipif(find_spec("pycolmap") is None, reason="pycolmap is not installed (fusedrf[capture])")
@pytest.mark.parametrize("command", ["pose", "train"])
def test_photos_that_find_no_place(run, folder, command):
    photos_alone(folder / "garden")
    result = run(command, "garden", "-o", "out")
    last = result.stderr.splitlines()[-1]
    assert result.exit_code == 3 and last.startswith("Error: garden: none of its 3 photos")
    assert "overlap too little" in last and "take more" in last and not (folder / "out").exists()
