"""Masks: every kind of picture that keeps one, and every place and name under which it lies."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from formats.captures import read_capture
from formats.errors import BadMask
from formats.images import read_mask
from formats.photos import load_ignored
from tests.formats.test_captures import frame, photo, write
from tests.formats.test_readers import binary_model, llff, photos

KEPT = np.ones((80, 100), bool)
KEPT[20:50, 30:60] = False
LEVELS = np.where(KEPT, 255, 0).astype(np.uint8)
WHITE = np.dstack([np.full((80, 100, 3), 255, np.uint8), LEVELS])
KINDS = {
    "grey": Image.fromarray(LEVELS),
    "0 and 1": Image.fromarray(KEPT.astype(np.uint8)),
    "1 bit": Image.fromarray(LEVELS).convert("1"),
    "16 bits": Image.fromarray(LEVELS.astype(np.uint16) * 257),
    "16 bits, 0 and 1": Image.fromarray(KEPT.astype(np.uint16)),
    "palette": Image.fromarray(LEVELS).quantize(2),
    "colour": Image.fromarray(np.dstack([LEVELS, LEVELS, LEVELS])),
    "alpha of white": Image.fromarray(WHITE),
    "alpha of white, grey": Image.fromarray(WHITE).convert("LA"),
    "alpha of black": Image.fromarray(np.dstack([np.zeros((80, 100, 3), np.uint8), LEVELS])),
    "opaque": Image.fromarray(np.dstack([LEVELS] * 3 + [np.full_like(LEVELS, 255)])),
    "white on nothing": Image.fromarray(np.dstack([LEVELS] * 4)),
    "black on nothing": Image.fromarray(np.dstack([LEVELS] * 3 + [255 - LEVELS])),
}


@pytest.mark.parametrize("mask", KINDS.values(), ids=KINDS)
def test_every_kind_of_picture(tmp_path, mask):
    mask.save(tmp_path / "mask.png")
    assert (read_mask(tmp_path / "mask.png") == KEPT).all()


def test_lossy_masks(tmp_path):
    Image.fromarray(LEVELS).save(tmp_path / "mask.jpg", quality=60)
    found = read_mask(tmp_path / "mask.jpg")
    assert (found != KEPT).mean() < 0.01
    noise = np.random.default_rng(0).integers(0, 12, LEVELS.shape, np.uint8)
    Image.fromarray(noise).save(tmp_path / "black.jpg")
    assert not read_mask(tmp_path / "black.jpg").any()


def capture(folder: Path, kind: str, names: list[str], where: str = "images") -> None:
    if kind == "transforms":
        write(folder, frames=[frame(f"{where}/{name}") for name in names], fl_x=80)
    elif kind == "colmap":
        binary_model(folder / "sparse/0", names)
    else:
        llff(folder, len(names))
    if kind != "llff":
        photos(folder / where, names)


def keep(path: Path, levels: np.ndarray = LEVELS) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(levels).save(path)


@pytest.mark.parametrize("kind", ["transforms", "colmap", "llff"])
@pytest.mark.parametrize(
    "form", ["{name}.png", "{stem}.png", "{stem}.jpg", "{stem}_mask.png", "{stem}.mask.png"]
)
def test_masks_beside_the_photos_of_every_capture(tmp_path, kind, form):
    names = [f"image{i:03d}.png" for i in range(3)]
    capture(tmp_path, kind, names)
    for name in names:
        keep(tmp_path / "masks" / form.format(name=name, stem=name[:-4]))
    read = read_capture(tmp_path)
    assert all(view.mask_path.parent == tmp_path / "masks" for view in read.train)
    assert any("masks of 3 of 3 photos are used" in note for note in read.notes)


@pytest.mark.parametrize(
    "at", ["Masks/A.PNG", "mask/a.png", "images/a_mask.png", "images/dynamic_mask_a.png"]
)
def test_other_places_and_names(tmp_path, at):
    capture(tmp_path, "transforms", ["a.jpg"])
    keep(tmp_path / at, 255 - LEVELS if "dynamic" in at else LEVELS)
    (view,) = read_capture(tmp_path).train
    assert (load_ignored(view) == ~KEPT).all()


def test_masks_of_folders_in_folders(tmp_path):
    capture(tmp_path, "transforms", ["left/1.png", "right/1.png"])
    keep(tmp_path / "masks/left/1.png")
    keep(tmp_path / "masks/right/1.png", 255 - LEVELS)
    left, right = read_capture(tmp_path).train
    assert (load_ignored(left) == ~KEPT).all() and (load_ignored(right) == KEPT).all()


def test_masks_that_are_named_go_before(tmp_path):
    photo(tmp_path / "images/a.png")
    keep(tmp_path / "masks/a.png", 255 - LEVELS)
    keep(tmp_path / "own.png")
    write(tmp_path, frames=[frame("images/a.png", mask_path="own.png")], fl_x=80)
    (view,) = read_capture(tmp_path).train
    assert (load_ignored(view) == ~KEPT).all()


def test_masks_of_other_names_are_told(tmp_path):
    capture(tmp_path, "transforms", ["a.png"])
    keep(tmp_path / "masks/frame_1.png")
    read = read_capture(tmp_path)
    assert read.train[0].mask_path is None
    assert "none of its 1 pictures is called as one of them" in read.notes[0]


def test_masks_of_numpy_are_told(tmp_path):
    capture(tmp_path, "transforms", ["a.png", "b.png", "c.png"])
    (tmp_path / "masks").mkdir()
    for name in "abc":
        np.save(tmp_path / f"masks/{name}.npy", LEVELS > 0)
    read = read_capture(tmp_path)
    assert "masks: holds 3 arrays of numpy, which are not read as masks; save them as PNG" in str(read.notes)
    named = [frame(f"images/{name}.png", mask_path=f"masks/{name}.npy") for name in "abc"]
    write(tmp_path, frames=named, fl_x=80)
    with pytest.raises(BadMask, match=r"a\.npy is an array of numpy, which is not read; save it as PNG"):
        read_capture(tmp_path)


def test_masks_of_another_capture_are_not_taken(tmp_path):
    keep(tmp_path / "masks/a.png")
    photo(tmp_path / "garden/a.png")
    write(tmp_path / "garden", fl_x=80)
    assert read_capture(tmp_path / "garden").train[0].mask_path is None


def test_smaller_masks_of_the_same_shape(tmp_path):
    capture(tmp_path, "transforms", ["a.png"])
    keep(tmp_path / "masks/a.png", LEVELS[::2, ::2])
    (view,) = read_capture(tmp_path).train
    assert (load_ignored(view) == ~KEPT).all()
