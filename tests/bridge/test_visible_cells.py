"""What `train` makes of what photos show: the space that is learnt, notes, and memory to decode in."""

from dataclasses import replace

import numpy as np
import pytest

from fusedrf_cli.bridge.scene_bounds import scene_bounds_of
from fusedrf_cli.bridge.training import loading, masks_object, read_views
from fusedrf_cli.progress import NullProgress
from tests.bridge.test_scene_bounds import request
from tests.formats.test_silhouettes import (
    CENTRE,
    RADIUS,
    capture,
    corners,
    free_ball,
    masked,
    on,
    outline,
    room,
)


class ObjectCues(NullProgress):
    def __init__(self):
        super().__init__()
        self.lines = []

    def tell(self, text: str) -> None:
        self.lines.append(text)


def read(folder):
    asked = replace(request(), source=str(folder), unbounded=None, masks="ignore", refine_poses=False)
    progress = ObjectCues()
    found = read_views(asked, progress)
    return found, scene_bounds_of(asked, found, masks_object(asked, found)), progress.lines


def holds_the_ball(box: np.ndarray, slack: float) -> bool:
    low, high = (box.reshape(2, 3) - CENTRE) / (0.97 * RADIUS)  # masks are of whole pixels
    return (low <= -1).all() and (high >= 1).all() and low.min() > -slack and high.max() < slack


def test_alpha_gives_the_box_and_not_its_cells(tmp_path):
    found = capture(tmp_path, free_ball)
    _, bounds, _ = read(tmp_path)
    assert not bounds.unbounded and bounds.cells is None
    assert holds_the_ball(bounds.box, 2.2)
    assert np.ptp(bounds.box.reshape(2, 3), axis=0).prod() <= np.ptp(found.aabb.reshape(2, 3), axis=0).prod()


def test_masks_give_the_cells_too(tmp_path):
    masked(tmp_path, outline)
    _, bounds, lines = read(tmp_path)
    assert bounds.cells is not None and holds_the_ball(bounds.box, 2.2)
    assert any("masks of 12 of 12 photos" in line for line in lines)


@pytest.mark.parametrize("photo, unbounded", [(corners, True), (on(0), True), (on(255), False), (room, True)])
def test_the_space_that_suits(tmp_path, photo, unbounded):
    capture(tmp_path, photo)
    found, bounds, lines = read(tmp_path)
    assert bounds.unbounded == unbounded
    assert lines == list(found.notes) and bool(lines) == (photo is not room)


def test_decoding_is_foretold(tmp_path):
    found = capture(tmp_path, room)
    large = replace(found, train=tuple(replace(view, reduction=100) for view in found.train))
    needs = loading(large)
    assert needs["the photos"] == 12 * 96 * 64 * 4
    assert needs["decoding them"] == 96 * 64 * 100**2 * 8
