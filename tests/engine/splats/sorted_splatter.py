"""A plain splatter, to compare fields of splats with: Kerbl et al. 2023 (3D Gaussian Splatting) after
Zwicker et al. 2001 (EWA splatting), without tiles.

Centres are projected, and covariances by the Jacobian of the projection at the centre, whose slopes are held
at 1.3 times those of the picture's border, as in the authors' program. Splats are sorted by the depth of
their centres and composited from the front; alpha is at most 0.99, below 1/255 nothing, and a pixel is done
when less than 1/10,000 of its light is left.
"""

from typing import NamedTuple

import numpy as np

from formats.rotations import matrices
from formats.splats.harmonics import basis

MOST, LEAST, DONE = 0.99, 1 / 255, 1e-4
NEAR = 0.2
MARGIN = 1.3
LOW_PASS = 0.3
"""Variance in pixels² that the authors add to each projected splat."""


class Camera(NamedTuple):
    """A pinhole; pixel centres are at +0.5."""

    camera_to_world: np.ndarray
    """(4, 4), OpenGL axes: x right, y up, looking along -z."""
    focal: float
    """In pixels; the principal point is the middle of the picture."""
    width: int
    height: int


def rendered(splats, camera: Camera, low_pass: float = LOW_PASS, near: float = NEAR) -> tuple:
    """(H, W, 3) premultiplied colour and (H, W) alpha of splats (formats.splats.splats.Splats)."""
    means, covariances, depths = projected(splats, camera, near)
    covariances[:, [0, 1], [0, 1]] += low_pass
    colours = seen_colours(splats, camera)
    picture = np.zeros((camera.height, camera.width, 3))
    light = np.ones((camera.height, camera.width))
    done = np.zeros((camera.height, camera.width), bool)
    for i in np.argsort(depths, kind="stable"):
        if depths[i] < near or splats.opacities[i] < LEAST:
            continue
        window = _window(means[i], covariances[i], float(splats.opacities[i]), camera)
        if window is None:
            continue
        rows, columns = window
        y, x = np.mgrid[rows, columns] + 0.5
        offset = np.stack([x - means[i, 0], y - means[i, 1]], -1)
        power = np.einsum("yxi,ij,yxj->yx", offset, np.linalg.inv(covariances[i]), offset)
        alpha = np.minimum(MOST, splats.opacities[i] * np.exp(-power / 2))
        before = light[rows, columns]
        done[rows, columns] |= (alpha >= LEAST) & (before * (1 - alpha) < DONE)
        alpha[(alpha < LEAST) | done[rows, columns]] = 0
        picture[rows, columns] += (before * alpha)[..., None] * colours[i]
        light[rows, columns] = before * (1 - alpha)
    return picture, 1 - light


def _window(mean, covariance, opacity: float, camera: Camera) -> tuple[slice, slice] | None:
    """Rows and columns of the pixels in which alpha may be LEAST or more."""
    reach = np.sqrt(2 * np.log(opacity / LEAST) * np.diag(covariance))
    low = np.maximum(np.ceil(mean - reach - 0.5), 0).astype(int)
    high = np.minimum(np.floor(mean + reach - 0.5) + 1, [camera.width, camera.height]).astype(int)
    return (slice(low[1], high[1]), slice(low[0], high[0])) if (low < high).all() else None


def projected(splats, camera: Camera, near: float = NEAR) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(N, 2) centres in pixels, (N, 2, 2) covariances, (N,) depths; what lies before `near` is void."""
    world_to_camera = np.diag([1.0, -1, -1]) @ camera.camera_to_world[:3, :3].T  # x right, y down, z front
    points = (splats.centres - camera.camera_to_world[:3, 3]) @ world_to_camera.T
    x, y, z = points.T
    z = np.maximum(z, near)
    middle = np.array([camera.width, camera.height]) / 2
    means = camera.focal * points[:, :2] / z[:, None] + middle
    slopes = np.clip(
        points[:, :2] / z[:, None], -MARGIN * middle / camera.focal, MARGIN * middle / camera.focal
    )
    jacobians = np.zeros((len(z), 2, 3))
    jacobians[:, 0, 0] = jacobians[:, 1, 1] = camera.focal / z
    jacobians[:, :, 2] = -camera.focal * slopes / z[:, None]
    axes = matrices(np.roll(splats.rotations, -1, axis=1)) * splats.scales[:, None].astype(float)
    axes = jacobians @ (world_to_camera @ axes)
    return means, axes @ axes.transpose(0, 2, 1), points[:, 2]


def seen_colours(splats, camera: Camera) -> np.ndarray:
    """(N, 3) of each splat along the direction from the camera to its centre."""
    directions = splats.centres - camera.camera_to_world[:3, 3]
    directions = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    values = basis(directions)[:, : splats.harmonics.shape[1]]
    return np.maximum(0, 0.5 + np.einsum("nk,nkc->nc", values, splats.harmonics))
