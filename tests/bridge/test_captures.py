"""`train` on captures of other layouts, with masks and with photos of several sizes."""

import json

import numpy as np
import pytest

from formats.images import read_image, write_png
from fusedrf_cli.bridge.training import TrainPresets
from fusedrf_cli.engine.distillation.config import TrainConfig
from tests.formats.test_captures import looking_at
from tests.formats.test_readers import binary_model

DRAFT = ("--quality", "draft")


@pytest.fixture(autouse=True)
def short(in_force):
    """Steps, not seconds, decide, so that a busy machine changes nothing."""
    settings = TrainConfig(longest=16, steps=300, samples=1 << 12)
    in_force(TrainPresets(draft=settings))


def eyes(count: int) -> list[np.ndarray]:
    turn = 2 * np.pi * np.arange(count) / count
    return [np.array([4 * np.cos(a), 4 * np.sin(a), 1.0]) for a in turn]


def speckled(path, width: int, height: int, seed: int = 0) -> np.ndarray:
    pixels = np.random.default_rng(seed).integers(0, 256, (height, width, 3), np.uint8)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_png(path, pixels)
    return pixels


def test_a_colmap_model_is_trained_on(report, folder):
    names = [f"{i}.png" for i in range(3)]
    binary_model(folder / "garden/sparse/0", names, params=(12, 12, 8, 6), size=(16, 12), apart=0.5)
    for i, name in enumerate(names):
        speckled(folder / "garden/images" / name, 16, 12, i)
    said = report("train", "garden", "-o", "out.rfpack", *DRAFT)
    assert said["views"] == 3 and said["capture"]["kind"] == "colmap"
    assert said["capture"]["sparse_points"] == 3
    assert said["space"] == "unbounded" and len(said["centre"]) == 3 and said["radius"] > 0


@pytest.fixture
def masked(folder):
    """Photos whose masks cut out their middle."""
    return masked_photos(folder, 255)


@pytest.fixture
def crossed(folder):
    """Photos before whose middle somebody passes, which masks exclude."""
    return masked_photos(folder, 0)


def masked_photos(folder, middle: int):
    """Photos of two sizes that show grey; noise lies over it where the masks are dark. These are of one
    level in the middle, and of the opposite one along the border."""
    frames = []
    for i, eye in enumerate(eyes(6)):
        width, height = (24, 16) if i % 2 else (16, 20)
        levels = np.full((height, width), 255 - middle, np.uint8)
        levels[4:-4, 4:-4] = middle
        noise = np.random.default_rng(i).integers(0, 256, (height, width, 3), np.uint8)
        pixels = np.where(levels[..., None] > 0, np.uint8(90), noise)
        (folder / "wall").mkdir(exist_ok=True)
        write_png(folder / f"wall/{i}.png", pixels)
        write_png(folder / f"wall/mask_{i}.png", np.repeat(levels[..., None], 3, 2))
        matrix = looking_at(eye, np.zeros(3))
        frames.append(
            {"file_path": f"{i}.png", "mask_path": f"mask_{i}.png", "transform_matrix": matrix, "fl_x": 20}
        )
    (folder / "wall/transforms.json").write_text(json.dumps({"frames": frames}))
    return folder


def test_what_masks_exclude_is_neither_learnt_nor_measured(report, crossed):
    box = ("--aabb", "-2,-2,-2,2,2,2")
    said = report("train", "wall", "-o", "out.rfpack", "--holdout", "3", *box, *DRAFT)
    assert said["capture"]["masked"] == 6 and said["holdout"]["views"] == 2
    # Noise that covers half of a picture keeps it under 14 dB.
    assert said["training_psnr"] > 18 and said["holdout"]["psnr"] > 15


def test_masks_as_alpha_make_a_box_for_the_object(report, masked):
    said = report("train", "wall", "-o", "out.rfpack", "--masks", "alpha", *DRAFT)
    low, high = np.split(np.array(said["aabb"]), 2)
    # The squares reach 8 pixels from the middle at f = 20 and a distance of 4.1.
    assert (high - low < 6).all() and (low < 0).all() and (high > 0).all()


@pytest.mark.parametrize("masks", ["ignore", "alpha"])
def test_an_object_that_masks_cut_out_stands_free(report, masked, masks):
    """It is learnt in a box of its own, without the place around it, whatever masks mean: nothing is where
    the wider photos show what their masks exclude beside it, though no ray through that need be drawn."""
    said = report("train", "wall", "-o", "out.rfpack", "--masks", masks, *DRAFT)
    low, high = np.split(np.array(said["aabb"]), 2)
    assert said["space"] == "bounded" and (high - low < 4).all() and (low < 0).all() and (high > 0).all()
    assert not report("info", "out.rfpack")["cameras"]["surroundings"]
    words = ("--views", "capture", "--background", "transparent")
    files = report("render", "out.rfpack", "-o", "look", *words)["files"]
    for path in files:
        alpha = read_image(masked / path)[..., 3]
        middle = alpha[5:-5, 5:-5].mean()
        assert middle > 128
        if alpha.shape == (16, 24):
            assert not alpha[:, :2].any() and not alpha[:, -2:].any()


def test_unbounded_space_may_be_asked_for_with_masks(report, masked):
    assert report("train", "wall", "-o", "out.rfpack", "--unbounded", *DRAFT)["space"] == "unbounded"


def test_masks_that_exclude_everything(run, masked):
    for i in range(6):
        width, height = (24, 16) if i % 2 else (16, 20)
        write_png(masked / f"wall/mask_{i}.png", np.zeros((height, width, 3), np.uint8))
    result = run("train", "wall", "-o", "out.rfpack", *DRAFT)
    assert result.exit_code == 3 and "exclude every pixel" in result.stderr
