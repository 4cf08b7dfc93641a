"""Photos made smaller on reading: means of whole pixels, and cameras that show the same."""

import shutil

import numpy as np
import pytest
from PIL import Image as Pillow

from formats.captures import read_capture
from formats.errors import BadIntrinsics
from formats.images import read_image, write_png
from formats.photos import LONGEST, load_ignored, load_images, pictures
from tests.formats.test_captures import PIXEL, POINT, frame, photo, project, real, write
from tests.formats.test_readers import NAMES, binary_model, llff, llff_rows, photos, polycam, turned_photo


def test_a_pixel_is_the_mean_of_whole_ones(tmp_path):
    pixels = np.random.default_rng(0).integers(0, 256, (13, 11, 3), np.uint8)
    write_png(tmp_path / "a.png", pixels)
    read = read_image(tmp_path / "a.png", reduction=3)
    means = pixels[:12, :9].reshape(4, 3, 3, 3, 3).mean((1, 3))
    assert read.shape == (4, 3, 4) and (read[..., 3] == 255).all()
    assert np.abs(read[..., :3] - means).max() < 0.6


def test_colours_count_by_their_alpha(tmp_path):
    """A red pixel beside three that show nothing, whatever colour they hide."""
    pixels = np.zeros((2, 2, 4), np.uint8)
    pixels[..., 1] = 255
    pixels[0, 0] = 255, 0, 0, 255
    write_png(tmp_path / "a.png", pixels)
    assert read_image(tmp_path / "a.png", reduction=2)[0, 0].tolist() == [255, 0, 0, 64]


@pytest.mark.parametrize("orientation", range(1, 9))
def test_photos_are_turned_first(tmp_path, orientation):
    _, upright = turned_photo(tmp_path / "a.png", orientation)
    read = read_image(tmp_path / "a.png", orientation, reduction=7)
    high, wide = (side // 7 for side in upright.shape[:2])
    means = upright[: high * 7, : wide * 7].reshape(high, 7, wide, 7, 3).mean((1, 3))
    assert np.abs(read[..., :3] - means).max() < 0.6


@pytest.mark.parametrize(
    "downscale, width", [(None, 500), (1, 2000), (2, 1000), (3, 666), (4, 500), (8, 250)]
)
def test_a_point_stays_where_it_is_in_the_picture(tmp_path, downscale, width):
    """Left over pixels are cut off, so that the camera is exact: 2000 = 3 * 666 + 2."""
    photo(tmp_path / "a.png", (2000, 1600))
    write(tmp_path, fl_x=1600)
    capture = read_capture(tmp_path, downscale)
    (view,) = capture.train
    factor = downscale or 2
    if downscale is None:
        width = 1000
        assert "2 times smaller, to 1000x800; --downscale 1" in capture.notes[0]
    assert (view.width, view.height, view.reduction) == (width, 1600 // factor, factor)
    assert project(view, POINT) == pytest.approx((1400 / factor, 400 / factor))
    assert capture.summary()["photos"] == f"{width}x{1600 // factor}"
    assert load_images([view]).shape == (1, 1600 // factor, width, 4)


def test_small_photos_stay(tmp_path):
    photo(tmp_path / "a.png", (LONGEST, 8))
    write(tmp_path, fl_x=80)
    capture = read_capture(tmp_path)
    assert capture.train[0].width == LONGEST and capture.notes == ()


COPIES = {"images": (2000, 1600), "images_2": (1000, 800), "images_8": (250, 200)}
COPIED = ["a.png", "b.png", "c.png"]


@pytest.fixture(scope="module")
def copies(tmp_path_factory):
    """A folder of photos and smaller copies of them."""
    folder = tmp_path_factory.mktemp("copies")
    for copy, size in COPIES.items():
        photos(folder / copy, COPIED, size)
    return folder


@pytest.mark.parametrize(
    "downscale, folder, reduction",
    [
        (None, "images_2", 1),
        (1, "images", 1),
        (2, "images_2", 1),
        (4, "images_2", 2),
        (3, "images", 3),
        (16, "images_8", 2),
    ],
)
@pytest.mark.parametrize("kind", ["transforms", "colmap", "llff"])
def test_copies_go_before_making_smaller(tmp_path, copies, kind, downscale, folder, reduction):
    shutil.copytree(copies, tmp_path, dirs_exist_ok=True)
    if kind == "transforms":
        write(tmp_path, frames=[frame(f"images/{name}") for name in COPIED], fl_x=1600, w=2000, h=1600)
    elif kind == "colmap":
        binary_model(tmp_path / "sparse/0", COPIED, params=(1600, 1600, 1000, 800), size=(2000, 1600))
    else:
        np.save(tmp_path / "poses_bounds.npy", llff_rows(3, (2000, 1600), 1600.0))
    view = read_capture(tmp_path, downscale).train[0]
    assert (view.image_path.parent.name, view.reduction) == (folder, reduction)
    factor = 2000 / view.width if downscale != 3 else 3
    assert project(view, POINT) == pytest.approx((1400 / factor, 400 / factor))


@pytest.mark.parametrize("kind", ["transforms", "llff"])
def test_copies_of_another_shape_are_of_other_photos(tmp_path, kind):
    """As they are left from before the photos were cropped."""
    names = ["a.png", "b.png", "c.png"]
    photos(tmp_path / "images", names, (2000, 1600))
    photos(tmp_path / "images_2", names, (1000, 500))
    photos(tmp_path / "images_4", names, (500, 400))
    if kind == "llff":
        np.save(tmp_path / "poses_bounds.npy", llff_rows(3, (2000, 1600), 1600.0))
    else:
        write(tmp_path, frames=[frame(f"images/{name}") for name in names], fl_x=1600, w=2000, h=1600)
    view = read_capture(tmp_path).train[0]
    assert (view.image_path.parent.name, view.width) == ("images_4", 500)


def test_a_copy_that_is_smaller_than_asked(tmp_path):
    photo(tmp_path / "images_8/a.png", (250, 200))
    write(tmp_path, frames=[frame("images/a.png")], fl_x=1600, w=2000, h=1600)
    assert read_capture(tmp_path, 4).train[0].width == 250


def test_a_capture_beside_this_one_is_no_copy_of_it(tmp_path):
    for name in ("garden", "garden_2"):
        photo(tmp_path / name / "a.png", (2000, 1600) if name == "garden" else (500, 400))
        write(tmp_path / name, fl_x=1600, w=2000, h=1600)
    view = read_capture(tmp_path / "garden").train[0]
    assert (view.image_path.parent.name, view.width) == ("garden", 1000)


def test_masks_of_photos_that_are_made_smaller(tmp_path):
    """A mask of the photo's size, whose last columns the smaller photo leaves out."""
    photo(tmp_path / "a.png", (103, 81))
    levels = np.zeros((81, 103), np.uint8)
    levels[2::5, 2::5] = 255
    Pillow.fromarray(levels).save(tmp_path / "mask.png")
    write(tmp_path, frames=[frame("a.png", mask_path="mask.png")], fl_x=80)
    (view,) = read_capture(tmp_path, 5).train
    assert (view.width, view.height) == (20, 16) and not load_ignored(view).any()


def test_polycam(tmp_path):
    polycam(tmp_path)
    assert project(read_capture(tmp_path, 2).train[0], POINT) == pytest.approx(np.array(PIXEL) / 2)


def test_photos_that_are_too_small_for_it(tmp_path):
    binary_model(tmp_path / "sparse/0")
    photos(tmp_path / "images", NAMES)
    with pytest.raises(BadIntrinsics, match=r"10\.png is 100x80 and cannot be made 81 times.*--downscale"):
        read_capture(tmp_path, 81)


def test_maps_beside_photos_are_no_photos(tmp_path):
    llff(tmp_path)
    for name in ("image000_depth", "image001_depth_0001", "image002-mask", "image000.normal"):
        photo(tmp_path / f"images_4/{name}.png", (100, 80))
    assert [view.name for view in read_capture(tmp_path).train] == [f"image{i:03d}" for i in range(3)]
    scans = [f"frame-{i}.{what}.png" for i in range(3) for what in ("color", "depth")]
    photos(tmp_path / "scan", [*scans, "the_depth.png"])
    named = [file.name for file in pictures(tmp_path / "scan")]
    assert named == [*scans[::2], "the_depth.png"]


def test_llff_without_any_photos_says_where_it_looked(tmp_path):
    llff(tmp_path, 3)
    assert read_capture(tmp_path, 4).train[0].width == 100


def test_cup():
    capture = read_capture(real("cup"), 2)
    assert capture.summary()["photos"] == "400x300"
