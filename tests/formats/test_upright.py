"""Which way is up: poses that were made with +z up, turned anyhow, are found again, or a guess is said."""

import json

import numpy as np
import pytest

from formats.camera_set import upward
from formats.captures import read_capture
from formats.upright import EITHER, UNKNOWN, upward_doubt
from tests.formats.test_captures import looking_at, photo

TURN = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
TURN *= np.sign(np.linalg.det(TURN))


def arc(first, last, elevation, roll=0.0, quarter=0, n=24) -> np.ndarray:
    """(n, 4, 4) on an arc of azimuths, looking at one point from so many degrees above it, by 8 more or less;
    held with a roll of so many degrees at random, and turned by a quarter."""
    random, poses = np.random.default_rng(3), []
    for i, azimuth in enumerate(np.radians(np.linspace(first, last, n))):
        e = np.radians(elevation + 8 * np.sin(3.0 * i))
        eye = 4 * np.array([np.cos(azimuth) * np.cos(e), np.sin(azimuth) * np.cos(e), np.sin(e)])
        pose = np.array(looking_at(eye, np.zeros(3)))
        angle = np.radians(roll * random.normal() + 90 * quarter)
        c, s = np.cos(angle), np.sin(angle)
        pose[:3, :3] = pose[:3, :3] @ [[c, -s, 0], [s, c, 0], [0, 0, 1]]
        poses.append(pose)
    return np.array(poses)


def turned(poses: np.ndarray) -> np.ndarray:
    """In a world that lies anyhow, as structure from motion leaves it."""
    return np.array([np.vstack([TURN @ pose[:3], [0, 0, 0, 1]]) for pose in poses])


# Azimuths, degrees above, roll and quarters; by how many degrees up may be off.
HELD = {
    "all round": ((0, 345, 50), 0.01),
    "one side": ((-35, 35, 50), 0.01),
    "one side, by hand": ((-35, 35, 50, 2.0), 4),
    "one side, nearly from above": ((-35, 35, 75, 2.0), 4),
    "one side, level": ((-35, 35, 0, 3.0), 4),
    "round and level": ((0, 345, 0, 3.0), 2),
    "from below": ((-60, 60, -40, 2.0), 2),
    "a narrow arc": ((-10, 10, 50, 1.0), 4),
    "sideways": ((-60, 60, 50, 2.0, 1), 4),
    "sideways the other way": ((-60, 60, 50, 2.0, 3), 4),
    "sideways, all round": ((0, 345, 30, 2.0, 1), 2),
    "upside down": ((0, 345, 50, 2.0, 2), 2),
}


@pytest.mark.parametrize("held, within", HELD.values(), ids=HELD)
def test_up_is_square_to_what_people_hold_level(held, within):
    poses = arc(*held)
    for found, up in ((upward(poses), [0, 0, 1]), (upward(turned(poses)), TURN[:, 2])):
        if held[-1] == 2 and len(held) == 5:  # what is up in all photos is down in the world
            up = -np.array(up)
        assert np.linalg.norm(found) == pytest.approx(1)
        assert np.degrees(np.arccos(np.clip(found @ up, -1, 1))) <= within
    assert upward_doubt(poses) is None


@pytest.mark.parametrize("azimuths", [(0, 345), (-60, 60), (-35, 35)])
@pytest.mark.parametrize("every", [2, 5])
def test_photos_that_were_held_both_ways(azimuths, every):
    """Some upright and some on their side."""
    poses = arc(*azimuths, 50, 2.0)
    poses[::every] = arc(*azimuths, 50, 2.0, 1)[::every]
    found = upward(turned(poses))
    assert np.degrees(np.arccos(np.clip(found @ TURN[:, 2], -1, 1))) < 4 and upward_doubt(poses) is None


def test_photos_that_look_straight_down():
    """As drones take them, turning: their ups cancel out, but not what is behind them."""
    spin = [np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]]) for a in range(9)]
    poses = np.tile(np.eye(4), (9, 1, 1))
    poses[:, :3, :3] = spin
    assert upward(turned(poses)) == pytest.approx(TURN[:, 2])


def test_a_line_of_cameras_does_not_tell():
    """All x axes are one: the mean of the ups is taken, without the part that rolls all of them alike."""
    poses = np.array([looking_at([x, -4, 2.5], [x, 0, 0.4]) for x in np.linspace(-1, 1, 12)])
    assert upward(poses) == pytest.approx(poses[0, :3, 1]) and upward_doubt(poses) == UNKNOWN


def test_cameras_held_anyhow_do_not_tell():
    random = np.random.default_rng(0)
    axes = np.linalg.qr(random.normal(size=(40, 3, 3)))[0]
    poses = np.tile(np.eye(4), (40, 1, 1))
    poses[:, :3, :3] = axes * np.sign(np.linalg.det(axes))[:, None, None]
    mean = poses[:, :3, 1].mean(0)
    assert upward(poses) == pytest.approx(mean / np.linalg.norm(mean)) and upward_doubt(poses) == UNKNOWN


def test_sideways_and_level_may_be_upside_down():
    poses = arc(0, 345, 0, quarter=1)
    assert abs(upward(poses)[2]) > 0.99 and upward_doubt(poses) == EITHER


@pytest.mark.parametrize("line", [False, True])
def test_a_capture_says_that_it_is_a_guess(tmp_path, line):
    poses = [looking_at([x, -4, 2], [x if line else 0, 0, 0]) for x in np.linspace(-2, 2, 6)]
    for i in range(6):
        photo(tmp_path / f"{i}.png", level=20 * i)
    frames = [
        {"file_path": f"{i}.png", "transform_matrix": np.array(p).tolist()} for i, p in enumerate(poses)
    ]
    (tmp_path / "transforms.json").write_text(json.dumps({"fl_x": 80, "frames": frames}))
    assert (UNKNOWN in " ".join(read_capture(tmp_path).notes)) == line
