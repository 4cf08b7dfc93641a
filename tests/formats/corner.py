"""Photos of a room's corner with mottled walls, taken from known places, for structure from motion."""

from pathlib import Path

import numpy as np
from PIL import Image
from scipy.ndimage import map_coordinates

from tests.formats.test_captures import looking_at

FOCAL, SIZE = 300.0, (320, 240)
TARGET = np.array([-0.6, 0.6, 0.7])
TEXELS = 600  # of a wall, which is 6 wide


def wall(seed: int) -> np.ndarray:
    """(TEXELS, TEXELS, 3) squares of several sizes."""
    random = np.random.default_rng(seed)
    sizes = (4, 12, 40)
    sums = sum(np.kron(random.random((TEXELS // s, TEXELS // s, 3)), np.ones((s, s, 1))) for s in sizes)
    return sums / sums.max()


WALLS = ((2, 0.0, wall(1)), (1, 2.0, wall(2)), (0, -2.0, wall(3)))
"""The axis at right angles, the place along it and what is on it: the floor, and two walls."""


def poses(count: int) -> np.ndarray:
    """(count, 4, 4) of cameras on an arc, held level, at changing heights."""
    angles = np.radians(np.linspace(-70, -10, count))
    heights = 1.6 + 0.3 * np.sin(np.arange(count))
    eyes = np.stack([3.2 * np.cos(angles), 3.2 * np.sin(angles), heights], 1)
    return np.array([looking_at(eye, TARGET) for eye in eyes])


def picture(pose: np.ndarray) -> np.ndarray:
    """(H, W, 3) uint8 of the corner from a pose."""
    wide, high = SIZE
    y, x = np.mgrid[:high, :wide] + 0.5
    local = np.stack([(x - wide / 2) / FOCAL, (high / 2 - y) / FOCAL, -np.ones_like(x)], -1)
    looks, eye = local @ pose[:3, :3].T, pose[:3, 3]
    shown, nearest = np.zeros((high, wide, 3)), np.full((high, wide), np.inf)
    for axis, place, texture in WALLS:
        t = (place - eye[axis]) / looks[..., axis]
        at = np.delete(eye + t[..., None] * looks, axis, -1)
        texel = (at + 3) / 6 * (TEXELS - 1)
        met = (t > 0) & (t < nearest) & (texel > 0).all(-1) & (texel < TEXELS - 1).all(-1)
        for hue in range(3):
            shown[met, hue] = map_coordinates(texture[..., hue], texel[met].T, order=1)
        nearest[met] = t[met]
    return np.rint(shown * 255).astype(np.uint8)


def write_photos(folder: Path, count: int) -> np.ndarray:
    """`p0.jpg` and so on; returns their poses."""
    folder.mkdir(parents=True, exist_ok=True)
    taken = poses(count)
    for i, pose in enumerate(taken):
        Image.fromarray(picture(pose)).save(folder / f"p{i}.jpg", quality=95)
    return taken


def aligned(found: np.ndarray, true: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of (N, 4, 4) poses behind the similarity that brings `found` onto `true` best: how far each is turned
    (degrees) and moved (true units), and the (3, 3) rotation itself."""
    eyes, goals = found[:, :3, 3], true[:, :3, 3]
    apart, aims = eyes - eyes.mean(0), goals - goals.mean(0)
    u, sizes, vt = np.linalg.svd(aims.T @ apart)
    signs = np.array([1, 1, np.sign(np.linalg.det(u @ vt))])
    turn = u * signs @ vt
    scale = (sizes * signs).sum() / (apart**2).sum()
    moved = np.linalg.norm(scale * apart @ turn.T - aims, axis=1)
    traces = np.einsum("nij,nij->n", turn @ found[:, :3, :3], true[:, :3, :3])
    return np.degrees(np.arccos(np.clip((traces - 1) / 2, -1, 1))), moved, turn
