"""The layout of a capture's cameras, and a box large enough for what their photos show.

Poses are (N, 4, 4) float64, camera-to-world, looking along -z. World axes, units and origin stay as they are.
"""

from dataclasses import dataclass

import numpy as np

PAIRS_FROM = 200
"""At most so many cameras, evenly spaced in the list, are paired with each other."""
PARALLEL = np.radians(3)
"""Pairs of optical axes that cross at a smaller angle are not used."""
FORWARD = np.radians(30)
"""Captures whose axes all lie within this of their mean are called forward-facing."""
REACH = 5.0
"""Half the side of a default box in distances between cameras and focus, where there are no sparse points."""
REACHES = (3.0, 15.0)
"""The least and the greatest value of the same where it follows from sparse points."""
SHOWN = 0.98
"""Share of the sparse points that a default box holds."""
OUTLIERS = 0.001
"""Share of a view's points that may lie nearer than its `near`, and farther than its `far`."""
BORDER = 0.02
"""Share of the longest side of what is shown that a box reaches beyond it."""
MARGIN = 1.25
"""Factor on the extent of the sparse points, since other parts of the scene may reach farther."""


@dataclass(frozen=True, eq=False)
class SceneFrame:
    """Where a capture's cameras look, in world units."""

    layout: str
    """"inward": the axes meet before the cameras; "forward-facing": all look one way; "outward": the rest."""
    focus: np.ndarray
    """(3,) float64: where the axes meet, or the cameras' middle where they look outward."""
    distance: float
    """The median of the cameras' distances from the focus."""
    spread: float
    """Radians from the mean direction within which 95 % of the cameras look."""


def scene_frame(poses: np.ndarray, depth: float | None = None) -> SceneFrame:
    """The frame of (N, 4, 4) poses; `depth` is how far before the cameras things lie, where that is known.

    The focus is the median, over pairs of cameras, of the point nearest to both optical axes; pairs that are
    near parallel, or whose point lies behind a camera, do not count.
    """
    eyes, looks = poses[:, :3, 3], -poses[:, :3, 2]
    spread = _spread(looks)
    points, ahead = _crossings(eyes, looks)
    extent = float(np.median(np.linalg.norm(eyes - np.median(eyes, 0), axis=1)))
    if spread < FORWARD:
        return _forward(eyes, looks, points[ahead], spread, depth, extent)
    if ahead.sum() * 2 < len(ahead) or not ahead.any():
        focus = eyes.mean(0)
        return SceneFrame("outward", focus, extent or depth or 1.0, spread)
    focus = np.median(points[ahead], 0)
    distance = float(np.median(np.linalg.norm(eyes - focus, axis=1)))
    return SceneFrame("inward", focus, distance or depth or 1.0, spread)


def _forward(eyes, looks, points, spread: float, depth: float | None, extent: float) -> SceneFrame:
    """Axes that hardly cross: known depths are preferred to their crossings."""
    middle, look = np.median(eyes, 0), looks.mean(0) / np.linalg.norm(looks.mean(0))
    if depth is None and len(points):
        depth = float(np.median((points - middle) @ look))
    if depth is None or depth <= 0:
        depth = 4 * extent or 1.0
    return SceneFrame("forward-facing", middle + depth * look, depth, spread)


def _spread(looks: np.ndarray) -> float:
    mean = looks.mean(0)
    length = np.linalg.norm(mean)
    if length < 1e-6:
        return float(np.pi)
    return float(np.quantile(np.arccos(np.clip(looks @ (mean / length), -1, 1)), 0.95))


def _crossings(eyes: np.ndarray, looks: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The point nearest to both axes (P, 3) of the pairs that cross at an angle, and whether it lies before
    both cameras (P,)."""
    chosen = evenly(len(eyes), PAIRS_FROM)
    eyes, looks = eyes[chosen], looks[chosen]
    i, j = np.triu_indices(len(eyes), 1)
    cosine = np.einsum("pk,pk->p", looks[i], looks[j])
    sine2 = 1 - cosine**2
    crossing = sine2 > np.sin(PARALLEL) ** 2
    i, j, cosine, sine2 = i[crossing], j[crossing], cosine[crossing], sine2[crossing]
    between = eyes[j] - eyes[i]
    along_i = np.einsum("pk,pk->p", between, looks[i])
    along_j = np.einsum("pk,pk->p", between, looks[j])
    t_i = (along_i - cosine * along_j) / sine2
    t_j = (cosine * along_i - along_j) / sine2
    middle = (eyes[i] + t_i[:, None] * looks[i] + eyes[j] + t_j[:, None] * looks[j]) / 2
    return middle, (t_i > 0) & (t_j > 0)


def nearest_point(eyes: np.ndarray, axes: np.ndarray) -> np.ndarray:
    """(3,) the point with the least sum of squared distances to lines through eyes (N, 3) along unit axes."""
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    middle = eyes.mean(0)
    # About the cameras' middle, so that axes which never meet leave the point there, not at infinity.
    offset = np.einsum("nij,nj->i", across, eyes - middle)
    return middle + np.linalg.lstsq(across.sum(0), offset, rcond=1e-6)[0]


def default_box(frame: SceneFrame, poses: np.ndarray, points: np.ndarray | None) -> np.ndarray:
    """(6,) cube around the focus that is large enough for what photos without alpha show.

    What lies outside a box can only be learnt as floaters inside it, before the cameras; so the box reaches
    well past the cameras: as far as nearly all sparse points (N, 3) where there are any, else REACH.
    """
    unit = frame.distance
    if frame.layout == "outward":
        unit = max(unit, float(np.linalg.norm(poses[:, :3, 3] - frame.focus, axis=1).max()))
    reach = REACH
    if points is not None and len(points):
        far = np.quantile(np.abs(points - frame.focus).max(1), SHOWN) / unit
        reach = float(np.clip(MARGIN * far, *REACHES))
    return np.concatenate([frame.focus - reach * unit, frame.focus + reach * unit])


def box_around(points: np.ndarray) -> np.ndarray:
    """(6,) box of (N, 3) points, and BORDER of its longest side more."""
    low, high = points.min(0), points.max(0)
    margin = BORDER * (high - low).max()
    return np.concatenate([low - margin, high + margin])


def evenly(count: int, most: int) -> np.ndarray:
    """At most so many of 0 to count - 1, evenly spaced, rising."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).astype(int))


def sphere(count: int) -> np.ndarray:
    """(count, 3) unit vectors, evenly spaced on a sphere along a spiral, the highest first."""
    step = np.arange(count)
    z, turn = 1 - (2 * step + 1) / max(count, 1), step * np.pi * (3 - 5**0.5)
    ring = np.sqrt(1 - z * z)
    return np.stack([ring * np.cos(turn), ring * np.sin(turn), z], 1)


def depth_range(pose: np.ndarray, points: np.ndarray) -> tuple[float | None, float | None]:
    """Depths before a camera between which points (N, 3) lie, but for outliers; None where none does."""
    depth = (pose[:3, 3] - points) @ pose[:3, 2]
    depth = depth[depth > 0]
    if not len(depth):
        return None, None
    near, far = np.quantile(depth, [OUTLIERS, 1 - OUTLIERS])
    return float(near), float(far)
