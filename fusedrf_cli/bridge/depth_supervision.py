"""Which points of a capture its photos are known to show, so that they tell how far away things are."""

import numpy as np

from formats.views import Capture, View
from fusedrf_cli.bridge.scene_bounds import SceneBounds
from fusedrf_cli.engine.distillation.depth_points import KnownPoints
from fusedrf_cli.engine.kernels.learning import DEPTH_TOLERANCE


def known_points(capture: Capture, bounds: SceneBounds) -> KnownPoints | None:
    """The sparse points that photos to learn from show, in the field's frame, where the capture says which
    (View.seen) and their distance follows to DEPTH_TOLERANCE; None where there are none."""
    if capture.points is None or not bounds.unbounded:
        return None
    seen = [np.empty(0, np.int64) if view.seen is None else view.seen for view in capture.train]
    point, picture = np.concatenate(seen), np.repeat(np.arange(len(seen)), [len(one) for one in seen])
    sure = certain(capture.points.positions, capture.train, point, picture)[point]
    if not sure.any():
        return None
    inverse = np.linalg.inv(bounds.origin[:3, :3])
    points = (capture.points.positions[point[sure]] - bounds.centre) @ inverse.T
    return KnownPoints(points, picture[sure])


def certain(
    positions: np.ndarray, views: tuple[View, ...], point: np.ndarray, picture: np.ndarray
) -> np.ndarray:
    """(P,) bool: which of the positions (P, 3) enough of the views show from directions so far apart that
    their distance follows. `point` and `picture` (N,) tell who shows what.

    Lines of sight that spread by s radians about their mean and are off by e meet to e / (s √n) of their
    length.
    """
    eyes = np.array([view.camera_to_world[:3, 3] for view in views])
    lines = positions[point] - eyes[picture]
    lines /= np.maximum(np.linalg.norm(lines, axis=1, keepdims=True), 1e-12)
    count = np.bincount(point, minlength=len(positions))
    few = np.maximum(count, 1)
    mean = np.stack([np.bincount(point, line, len(positions)) for line in lines.T], 1) / few[:, None]
    spread = np.sqrt(np.maximum(1 - (mean**2).sum(1), 0))
    pixel = np.median([1 / view.fl_x for view in views])
    # A point lies half a pixel from where photos show it, about; one that only two show may be two things.
    return (count >= 3) & (0.5 * pixel < DEPTH_TOLERANCE * spread * np.sqrt(few))
