"""What photos show of nothing: alpha, grounds and masks of a ball and of a room, whose outlines are known."""

import io
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from formats.captures import read_capture
from formats.photos import load_ignored, load_photos
from formats.views import View
from tests.formats.test_captures import looking_at

WIDE, HIGH, FOCAL = 96, 64, 80.0
CENTRE, RADIUS = np.array([0.3, -0.2, 0.5]), 0.6
EYES = [(4 * np.cos(a), 4 * np.sin(a), 1.5 + np.sin(3 * a)) for a in 2 * np.pi * np.arange(12) / 12]


def view(i: int, scale: float = 1.0, shift=(0.0, 0.0, 0.0)) -> View:
    pose = np.array(looking_at(EYES[i], (0, 0, 0.4)))
    pose[:3, 3] = pose[:3, 3] * scale + shift
    return View(str(i), pose, FOCAL, FOCAL, WIDE / 2, HIGH / 2, WIDE, HIGH)


def ball(i: int, centre=CENTRE) -> np.ndarray:
    """(H, W) bool: which pixels' rays meet the ball."""
    one = view(i)
    x, y = np.meshgrid((np.arange(WIDE) + 0.5 - one.cx) / FOCAL, (one.cy - np.arange(HIGH) - 0.5) / FOCAL)
    rays = np.stack([x, y, -np.ones_like(x)], -1) @ one.camera_to_world[:3, :3].T
    to_ball = centre - one.camera_to_world[:3, 3]
    aside = np.linalg.norm(np.cross(to_ball, rays), axis=-1) / np.linalg.norm(rays, axis=-1)
    return aside < RADIUS


def room(i: int) -> np.ndarray:
    """(H, W, 3) uint8 without a plain border."""
    return np.random.default_rng(i).integers(20, 230, (HIGH, WIDE, 3), np.uint8)


def with_alpha(pixels: np.ndarray, alpha) -> np.ndarray:
    return np.dstack([pixels, np.broadcast_to(np.asarray(alpha), (HIGH, WIDE)).astype(np.uint8)])


def capture(folder: Path, photo: Callable, name="transforms.json", scale=1.0, shift=(0, 0, 0), **keys):
    """What is read of photos of twelve cameras around the ball."""
    frames = []
    (folder / "images").mkdir(parents=True, exist_ok=True)
    for i in range(len(EYES)):
        Image.fromarray(photo(i)).save(folder / f"images/p{i:02d}.png")
        pose = view(i, scale, shift).camera_to_world.tolist()
        frames.append({"file_path": f"images/p{i:02d}.png", "transform_matrix": pose})
    (folder / name).write_text(json.dumps({"fl_x": FOCAL, **keys, "frames": frames}))
    return read_capture(folder)


def free_ball(i: int) -> np.ndarray:
    return with_alpha(room(i), 255 * ball(i))


# --- alpha --------------------------------------------------------------------------------------------------


def stray(i: int) -> np.ndarray:
    alpha = np.full((HIGH, WIDE), 255)
    alpha[3, 5], alpha[10, 0] = 254, 0
    return with_alpha(room(i), alpha)


SILENT = {
    "opaque all over": lambda i: with_alpha(room(i), 255),
    "one of many": lambda i: with_alpha(room(i), 255) if i == 3 else room(i),
    "stray pixels": stray,
    "nearly opaque all over": lambda i: with_alpha(room(i), 254),
    "half transparent all over": lambda i: np.dstack([room(i), np.minimum(stray(i)[..., 3], 100)]),
    "transparent all over": lambda i: with_alpha(room(i), 0),
}


@pytest.mark.parametrize("photo", SILENT.values(), ids=SILENT)
def test_alpha_that_says_nothing_changes_nothing(tmp_path, photo):
    plain, read = capture(tmp_path / "rgb", room), capture(tmp_path / "rgba", photo)
    assert read.opaque and read.frame.layout == plain.frame.layout == "inward"
    assert (read.aabb == plain.aabb).all() and "alpha channel" in read.notes[0]
    assert (load_photos(read.train).pixels == load_photos(plain.train).pixels).all()
    assert load_photos(read.train).ignored is None


def corners(i: int) -> np.ndarray:
    x, y = np.meshgrid((np.arange(WIDE) + 0.5) / WIDE * 2 - 1, (np.arange(HIGH) + 0.5) / HIGH * 2 - 1)
    return with_alpha(room(i), 255 * (np.hypot(x, y) < 1.2))


def vignette(i: int) -> np.ndarray:
    x, y = np.meshgrid((np.arange(WIDE) + 0.5) / WIDE * 2 - 1, (np.arange(HIGH) + 0.5) / HIGH * 2 - 1)
    return with_alpha(room(i), np.clip(255 * (1.6 - 1.2 * np.hypot(x, y)), 0, 255))


def bars(i: int) -> np.ndarray:
    alpha = np.full((HIGH, WIDE), 255)
    alpha[:8] = alpha[-8:] = 0
    return with_alpha(room(i), alpha)


def lens(i: int) -> np.ndarray:
    x, y = np.meshgrid(np.arange(WIDE) + 0.5 - WIDE / 2, np.arange(HIGH) + 0.5 - HIGH / 2)
    return with_alpha(room(i), 255 * (np.hypot(x, y) < 31))


def sign(i: int) -> np.ndarray:
    alpha = np.full((HIGH, WIDE), 255)
    alpha[40:, :30] = 0
    return with_alpha(room(i), alpha)


def sky(i: int) -> np.ndarray:
    alpha = np.full((HIGH, WIDE), 255)
    alpha[: 20 + i] = 0
    return with_alpha(room(i), alpha)


def hidden_ball(i: int) -> np.ndarray:
    return with_alpha(room(i), 255 * ~ball(i))


@pytest.mark.parametrize("photo", [corners, vignette, bars, lens, sign, sky, hidden_ball])
def test_alpha_around_photos_is_a_mask(tmp_path, photo):
    read = capture(tmp_path, photo)
    assert read.opaque and read.frame is not None and "ignored" in read.notes[0]
    loaded = load_photos(read.train)
    expected = np.concatenate([photo(i)[..., 3].ravel() < 128 for i in range(12)])
    assert (loaded.ignored == expected).all() and (loaded.pixels[:, 3] == 255).all()


def test_one_cut_out_photo_among_photos_of_a_room(tmp_path):
    read = capture(tmp_path, lambda i: free_ball(i) if i == 3 else room(i))
    assert read.opaque and read.frame is not None
    assert [load_ignored(v) is not None for v in read.train] == [i == 3 for i in range(12)]
    assert (load_ignored(read.train[3]) == ~ball(3)).all()


@pytest.mark.parametrize(
    "scale, shift", [(1, (0, 0, 0)), (10, (0, 0, 0)), (1, (20, 5, 0)), (0.01, (3, 0, 0))]
)
@pytest.mark.parametrize("name", ["transforms.json", "transforms_train.json"])
def test_the_box_of_what_alpha_shows(tmp_path, scale, shift, name):
    read = capture(tmp_path, free_ball, name, scale, shift, aabb_scale=16)
    assert not read.opaque and read.frame is None and read.notes == ()
    low, high = ((read.aabb.reshape(2, 3) - shift) / scale - CENTRE) / RADIUS
    assert (low <= -1).all() and (high >= 1).all()
    assert low.min() > -2.2 and high.max() < 2.2  # from twelve cameras that all look down


def test_a_wrong_outline_does_not_widen_the_box(tmp_path):
    right = capture(tmp_path / "right", free_ball)
    read = capture(tmp_path / "wrong", lambda i: with_alpha(room(i), 255 * (i == 4 or ball(i))))
    assert not read.opaque and np.abs(read.aabb - right.aabb).max() < 0.3
    assert "1 of 12 photos show no transparency" in read.notes[0]


def test_the_box_where_photos_cut_the_object_off(tmp_path):
    """Some of them, at their borders: the others tell how large it is."""
    centre = np.array([1.9, -0.2, 0.5])
    cut = [any(ball(i, centre)[at].any() for at in (0, -1, (..., 0), (..., -1))) for i in range(12)]
    assert 4 <= sum(cut) <= 9
    read = capture(tmp_path, lambda i: with_alpha(room(i), 255 * ball(i, centre)))
    low, high = (read.aabb.reshape(2, 3) - centre) / RADIUS
    assert (low <= -1).all() and (high >= 1).all() and low.min() > -3 and high.max() < 3


def test_photos_without_alpha_among_those_that_it_cuts_out(tmp_path):
    read = capture(tmp_path, lambda i: room(i) if i in (0, 7) else free_ball(i))
    assert len(read.train) == 10 and "2 of 12 photos have no alpha and are left out" in read.notes[0]


def test_photos_that_show_nothing_of_it_tell_nothing(tmp_path):
    read = capture(tmp_path, lambda i: free_ball(i) if i < 8 else with_alpha(room(i), 0))
    assert not read.opaque and len(read.train) == 12 and read.notes == ()


# --- grounds ------------------------------------------------------------------------------------------------


def on(ground: int, jitter: int = 0) -> Callable:
    def photo(i: int) -> np.ndarray:
        noise = np.random.default_rng(i).integers(-jitter, jitter + 1, (HIGH, WIDE, 3))
        return np.where(ball(i)[..., None], room(i), np.clip(ground + noise, 0, 255)).astype(np.uint8)

    return photo


@pytest.mark.parametrize("jitter", [0, 4])
def test_an_object_on_white_is_learnt_in_a_box(tmp_path, jitter):
    read = capture(tmp_path, on(255, jitter))
    assert read.opaque and read.frame is None and "on white" in read.notes[0]
    low, high = (read.aabb.reshape(2, 3) - CENTRE) / RADIUS
    assert (low <= -1).all() and (high >= 1).all() and low.min() > -4.5 and high.max() < 4.5


def test_white_photos_that_were_compressed(tmp_path):
    """JPEG rings around the object, up to a border that is near."""

    def photo(i: int) -> np.ndarray:
        file = io.BytesIO()
        pixels = np.where(ball(i)[..., None], np.array([210, 60, 50]), 255).astype(np.uint8)
        pixels[:2, 40:44] = 240
        Image.fromarray(pixels).save(file, "JPEG", quality=60)
        return np.array(Image.open(file))

    read = capture(tmp_path, photo)
    assert read.frame is None and "on white" in read.notes[0]


def test_some_photos_on_white_cut_the_object_off(tmp_path):
    def photo(i: int) -> np.ndarray:
        pixels = on(255)(i)
        pixels[40:] = room(i)[40:] if i in (0, 4, 8) else pixels[40:]
        return pixels

    read = capture(tmp_path, photo)
    assert read.frame is None and "most photos show an object on white" in read.notes[0]
    low, high = (read.aabb.reshape(2, 3) - CENTRE) / RADIUS
    assert (low <= -1).all() and (high >= 1).all() and low.min() > -6 and high.max() < 6


def test_aabb_scale_is_the_box_of_an_object_on_white(tmp_path):
    read = capture(tmp_path, on(255), "transforms_train.json", aabb_scale=4)
    assert read.kind == "blender" and read.aabb == pytest.approx(np.repeat([-1, 1], 3) * 4 / 0.66)


def framed(level: int) -> Callable:
    def photo(i: int) -> np.ndarray:
        pixels = np.full((HIGH, WIDE, 3), level, np.uint8)
        pixels[6:-6, 6:-6] = room(i)[6:-6, 6:-6]
        return pixels

    return photo


def scanned(i: int) -> np.ndarray:
    """Prints of two shapes on a white sheet."""
    pixels, across = np.full((HIGH, WIDE, 3), 255, np.uint8), 6 + 20 * (i % 2)
    pixels[6:-6, across:-across] = room(i)[6:-6, across:-across]
    return pixels


SURROUNDED = {
    "prints of two shapes": scanned,
    "black ground": on(0),
    "grey ground": on(128),
    "black frame": framed(0),
    "white frame": framed(255),
}


@pytest.mark.parametrize("photo", SURROUNDED.values(), ids=SURROUNDED)
def test_other_borders_of_one_colour_are_surroundings(tmp_path, photo):
    read = capture(tmp_path, photo)
    assert read.opaque and read.frame.layout == "inward" and "--bounded" in read.notes[0]


def soft_ball(i: int) -> np.ndarray:
    """Straight alpha that is soft all over."""
    alpha = np.where(ball(i), np.random.default_rng(i).integers(30, 256, (HIGH, WIDE)), 0)
    return with_alpha(room(i), alpha)


def test_colours_that_were_multiplied_by_alpha(tmp_path):
    def multiplied(i: int) -> np.ndarray:
        pixels = soft_ball(i)
        pixels[..., :3] = np.rint(pixels[..., :3] * (pixels[..., 3:] / 255.0))
        return pixels

    straight, read = capture(tmp_path / "a", soft_ball), capture(tmp_path / "b", multiplied)
    assert not any("multiplied" in note for note in straight.notes)
    assert "colours of the photos were multiplied by their alpha" in " ".join(read.notes)
    expected, found = (load_photos(c.train).pixels.astype(int) for c in (straight, read))
    shown = expected[:, 3] > 0
    assert np.array_equal(expected[:, 3], found[:, 3])
    assert (np.abs(expected - found)[shown, :3] <= 255 / expected[shown, 3:] / 2 + 1).all()


@pytest.mark.parametrize("across", [False, True])
def test_bars_on_two_sides_are_told(tmp_path, across):
    def barred(i: int) -> np.ndarray:
        pixels = room(i)
        lines = pixels.swapaxes(0, 1) if across else pixels
        lines[:6] = lines[-6:] = 0
        return pixels

    where = "left and right" if across else "above and below"
    read = capture(tmp_path, barred)
    assert f"bars {where} of one colour (0, 0, 0)" in " ".join(read.notes)
    assert read.opaque and len(read.train) == 12


# --- masks --------------------------------------------------------------------------------------------------


def masked(folder: Path, mask: Callable, **keys):
    (folder / "masks").mkdir(parents=True)
    for i in range(12):
        if (levels := mask(i)) is not None:
            Image.fromarray(levels).save(folder / f"masks/p{i:02d}.png")
    return capture(folder, room, **keys)


def outline(i: int) -> np.ndarray:
    return np.where(ball(i), 255, 0).astype(np.uint8)


def passer_by(i: int) -> np.ndarray:
    levels = np.full((HIGH, WIDE), 255, np.uint8)
    levels[20:40, 30:60] = 0
    return levels


def test_photos_without_a_mask_are_left_out_where_masks_cut_an_object_out(tmp_path):
    read = masked(tmp_path, lambda i: None if i == 4 else outline(i))
    assert [v.name for v in read.train] == [f"p{i:02d}" for i in range(12) if i != 4]
    low, high = (read.object_aabb.reshape(2, 3) - CENTRE) / RADIUS
    assert (low <= -1).all() and (high >= 1).all() and low.min() > -2.2 and high.max() < 2.2
    assert "1 of 12 photos have no mask and are left out" in " ".join(read.notes)


def test_photos_without_a_mask_are_used_where_masks_hide_passers_by(tmp_path):
    for name, bare in (("most", (4,)), ("few", range(2, 12))):
        read = masked(tmp_path / name, lambda i, bare=bare: None if i in bare else passer_by(i))
        assert len(read.train) == 12 and read.object_aabb is None
        assert f"{len(bare)} of 12 photos have no mask and are used" in " ".join(read.notes)


def test_masks_that_exclude_all_or_nothing(tmp_path):
    black = masked(tmp_path / "black", lambda i: outline(i) * 0)
    assert black.object_aabb is None and "12 of 12 photos exclude all" in " ".join(black.notes)
    one = masked(tmp_path / "one", lambda i: outline(i) * (i != 3))
    assert one.object_aabb is not None and "1 of 12 photos exclude all" in " ".join(one.notes)
    white = masked(tmp_path / "white", lambda i: outline(i) | 255)
    assert white.object_aabb is None and not load_photos(white.train).ignored.any()


# --- views --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "lens",
    [
        {},
        {"distortion": (-0.1, 0.02, 0.001, 0.01, -0.02)},
        {"distortion": (0.2, 0.05, 0.01, 0.001, 0.002, 0.01, 0.1, 0.02, 0.01)},
        {"distortion": (0.05, -0.01, 0.002, 0.0), "fisheye": True},
    ],
)
def test_points_are_shown_where_rays_of_pixels_go(lens):
    """Against the engine's rays, which invert the lens by Newton steps."""
    from dataclasses import replace

    from fusedrf_cli.bridge.pictures import camera_of

    one = replace(view(2), **lens)
    rays_o, rays_d = camera_of(one).rays()
    column, row, _, inside = one.shown(rays_o + 3 * rays_d)
    rows, columns = np.mgrid[:HIGH, :WIDE] + 0.5
    assert np.abs(column - columns.ravel()).max() < 1e-6 and np.abs(row - rows.ravel()).max() < 1e-6
    assert inside.all() and not one.shown(rays_o - 3 * rays_d)[3].any()
