"""Where photos were taken from, found anew by how a field shows what they show: structure from motion, or a
phone's own tracking, is off by some pixels, which would be learnt as blur."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from fusedrf_cli.engine.fields.base import RadianceField
from fusedrf_cli.engine.rendering.cameras import Camera
from fusedrf_cli.engine.rendering.volume import render_rays
from fusedrf_cli.engine.settings import current


@dataclass(frozen=True)
class PoseConfig:
    """How poses are refined."""

    at: tuple[float, ...] = (0.08, 0.11, 0.14, 0.18, 0.23, 0.29, 0.36, 0.44, 0.53, 0.63)
    """Shares of a run: while the field is coarse, poses are found from afar."""
    rays: int = 20_000
    """That one round renders seven times, and once more."""
    rays_of_each: tuple[int, int] = (150, 400)
    """Of each photo, at least and at most."""
    tried_by: tuple[float, float] = (4.0, 1.0)
    """Pixels by which a pose is changed to see what that changes in its picture: at first, at last."""
    opaque: float = 0.98
    """Opacity of a ray that shows the field, and no edge before what lies behind it."""
    few: int = 48
    """Rays that tell too little."""
    damping: float = 0.02
    """Of the squared slopes, that are added to them: a parameter that changes little stays."""
    fair: float = 0.2
    """Difference of colours that counts half: a photo shows things that the field does not hold."""
    sure: float = 2.0
    """Times what the noise of so few rays alone would change, under which a pose stays as it is; what is more
    is drawn towards that (the positive part of James and Stein's estimate)."""
    parts: tuple[float, ...] = (1.0, 0.3)
    """Of a step that are tried, one after the other, until one helps."""
    largest: float = 8.0
    """Probes by which a pose changes in one round at most."""


class Poses(NamedTuple):
    """Of n photos, in the field's frame."""

    rotation: np.ndarray
    """(n, 3, 3) float64, camera to frame."""
    position: np.ndarray
    """(n, 3) float64."""


def poses_of(cameras: list[Camera]) -> Poses:
    """Where cameras are, in the frame that they are given in."""
    placed = np.stack([camera.camera_to_world for camera in cameras])
    return Poses(placed[:, :3, :3], placed[:, :3, 3])


def refined(
    field: RadianceField,
    rays: tuple[np.ndarray, np.ndarray],
    photos: torch.Tensor,
    near: float,
    probe: np.ndarray,
) -> np.ndarray:
    """(n, 6) float64: by which angles about the frame's axes (3, radians) each of n photos' cameras is to be
    turned, and by how much moved (3), so that the field shows their colours better: one damped step of Gauss
    and Newton, with slopes from differences. All 0 where that does not help.

    rays: origins and unit directions (n * m, 3), m of each photo in order; photos (n, m, 3) their colours in
    [0, 1], not finite where they do not count. probe (n,): the angle in radians by which each is tried.
    """
    config = current(PoseConfig)
    n, m, _ = photos.shape
    o, d = (part.reshape(n, m, 3) for part in rays)
    truth = photos.double().numpy()

    def shown(change: np.ndarray, which: np.ndarray) -> np.ndarray:
        """(k, m, 5) what those photos' poses (k,) show when they are changed."""
        turned = d[which] @ turns(change[which, :3]).transpose(0, 2, 1)
        moved = o[which] + change[which, None, 3:]
        rendered = render_rays(field, moved.reshape(-1, 3), turned.reshape(-1, 3), near=near)
        return rendered.reshape(-1, m, 5).astype(np.float64)

    every = np.arange(n)
    now = shown(np.zeros((n, 6)), every)
    counts = np.isfinite(truth).all(2) & (now[..., 3] > config.opaque)
    truth = np.nan_to_num(truth)
    missed = np.where(counts[..., None], now[..., :3] - truth, 0)
    fair = counts / (1 + (missed**2).sum(2) / config.fair**2)
    # moved by so much, what is seen moves about as if turned by one radian
    afar = np.array(
        [np.median(row[c, 4] / row[c, 3]) if c.any() else 1.0 for row, c in zip(now, counts, strict=True)]
    )
    scale = np.concatenate([np.tile(probe[:, None], 3), np.tile((probe * afar)[:, None], 3)], 1)
    slopes = np.stack([shown(scale * axis, every)[..., :3] - now[..., :3] for axis in np.eye(6)], -1)
    step = scale * step_of(slopes, missed, fair)

    def error(colours: np.ndarray, which: np.ndarray) -> np.ndarray:
        """(k,) of those photos, robust."""
        return (fair[which] * ((colours - truth[which]) ** 2).sum(2)).sum(1)

    before = error(now[..., :3], every)
    change, untold = np.zeros((n, 6)), np.flatnonzero(counts.sum(1) >= config.few)
    for part in config.parts:
        if len(untold):
            helps = error(shown(part * step, untold)[..., :3], untold) < before[untold]
            change[untold[helps]] = part * step[untold[helps]]
            untold = untold[~helps]
    return change


def step_of(slopes: np.ndarray, missed: np.ndarray, fair: np.ndarray) -> np.ndarray:
    """(n, 6) of n photos, in probes: by how much all six parameters change, damped, drawn towards none by as
    much as noise alone would change, and held to `largest`.

    slopes (n, m, 3, 6) of the colours of their m rays, missed (n, m, 3) by how much these are off, fair
    (n, m) how much each ray counts.
    """
    config = current(PoseConfig)
    square = np.einsum("nm,nmcp,nmcq->npq", fair, slopes, slopes)
    square += config.damping * np.einsum("npp->np", square)[:, :, None] * np.eye(6) + 1e-9 * np.eye(6)
    step = -np.linalg.solve(square, np.einsum("nm,nmcp,nmc->np", fair, slopes, missed)[..., None])[..., 0]
    certainty = np.einsum("np,npq,nq->n", step, square, step)
    left = np.maximum((fair * (missed**2).sum(2)).sum(1) - certainty, 0)
    noise = left / np.maximum(3 * (fair > 0).sum(1) - 6, 1)
    step *= np.maximum(0, 1 - config.sure * 6 * noise / np.maximum(certainty, 1e-300))[:, None]
    return step * np.minimum(1, config.largest / np.maximum(abs(step).max(1, keepdims=True), 1e-12))


def turns(angles: np.ndarray) -> np.ndarray:
    """(n, 3, 3) rotations about axes (n, 3) whose lengths are the angles, in radians."""
    return Rotation.from_rotvec(angles).as_matrix()


def changed_each(poses: Poses, change: np.ndarray) -> Poses:
    """Poses after changes (n, 6) as `refined` gives them."""
    return Poses(turns(change[:, :3]) @ poses.rotation, poses.position + change[:, 3:])


def changed(poses: Poses, change: np.ndarray) -> Poses:
    """Poses after changes (n, 6), without the turn, the move and the scale that these have in common, in
    first order: all cameras moved together show the same of a field that moves with them."""
    offsets = poses.position - poses.position.mean(0)
    turn = change[:, :3].mean(0)
    move = change[:, 3:] - change[:, 3:].mean(0) - np.cross(turn, offsets)
    move -= (move * offsets).sum() / max((offsets**2).sum(), 1e-300) * offsets
    return changed_each(poses, np.concatenate([change[:, :3] - turn, move], 1))


def angles_between(one: Poses, other: Poses) -> np.ndarray:
    """(n,) by how many radians cameras are turned against each other."""
    return (Rotation.from_matrix(one.rotation).inv() * Rotation.from_matrix(other.rotation)).magnitude()
