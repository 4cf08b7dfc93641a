"""What a teacher is asked before distilling: rays with their colours, and points with σ and colour on those
rays.
"""

from dataclasses import dataclass

import numpy as np
import torch

from fusedrf_cli.engine.fields.base import RadianceField
from fusedrf_cli.engine.rendering.volume import waves, weights_from_sigma

SEEN = 1e-2  # transmittance under which what lies behind is not worth learning
WHOLE_SCENE_SHARE = (
    0.5  # of the rays; the others are shared out over the objects, so that a small one is not missed
)
BELOW_SHARE = 0.1  # of the rays that look from under the horizon


@dataclass
class TeacherPool:
    """Rays of a teacher and the points on them, in the teacher's frame."""

    rays_o: np.ndarray
    rays_d: np.ndarray
    """(R, 3) float64."""
    pixels: torch.Tensor
    """(R, 4) float32: rgb premultiplied by opacity, opacity."""
    points: torch.Tensor
    dirs: torch.Tensor
    """(N, 3) float64 samples on the rays in front of what is opaque, empty ones among them."""
    sigma: torch.Tensor
    rgb: torch.Tensor
    """(N,), (N, 3) float32, what the teacher answered there."""


def random_rays(
    boxes: list[np.ndarray], count: int, generator: torch.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """rays_o, rays_d (count, 3) float64 from a shell around boxes[0] and the others in turn, each towards a
    random point of its box.
    """
    others = boxes[1:] or boxes
    whole = int(count * WHOLE_SCENE_SHARE)
    counts = [whole] + [
        (count - whole) // len(others) + (i < (count - whole) % len(others)) for i in range(len(others))
    ]
    rays_o, rays_d = [], []
    for box, n in zip([boxes[0], *others], counts, strict=True):
        uniform = torch.rand(n, 7, generator=generator, dtype=torch.float64).numpy()
        lo, hi = box[:3], box[3:]
        centre, radius = (lo + hi) / 2, np.linalg.norm(hi - lo) / 2
        z = np.where(uniform[:, 0] < BELOW_SHARE, -uniform[:, 1], uniform[:, 1])
        ring, angle = np.sqrt(1 - z * z), 2 * np.pi * uniform[:, 2]
        away = np.stack([ring * np.cos(angle), ring * np.sin(angle), z], 1)
        origin = centre + away * (radius * (1.2 + 2.0 * uniform[:, 3:4]))
        direction = lo + uniform[:, 4:7] * (hi - lo) - origin
        rays_o.append(origin)
        rays_d.append(direction / np.linalg.norm(direction, axis=1, keepdims=True))
    order = torch.randperm(count, generator=generator).numpy()
    return np.concatenate(rays_o)[order], np.concatenate(rays_d)[order]


def ask(
    teacher: RadianceField,
    rays_o: np.ndarray,
    rays_d: np.ndarray,
    step: float,
    generator: torch.Generator,
    keep_points: float = 1.0,
    at_once: int = 1 << 16,
) -> TeacherPool:
    """Render rays (R, 3) through a teacher and keep a share of the samples in front of what is opaque as
    points.
    """
    parts = []
    for start in range(0, len(rays_o), at_once):
        part = slice(start, start + at_once)
        parts.append(_ask_part(teacher, rays_o[part], rays_d[part], step, generator, keep_points))
    pixels, points, dirs, sigma, rgb = (torch.cat(column) for column in zip(*parts, strict=True))
    return TeacherPool(rays_o, rays_d, pixels, points, dirs, sigma, rgb)


def _ask_part(
    teacher: RadianceField,
    rays_o: np.ndarray,
    rays_d: np.ndarray,
    step: float,
    generator: torch.Generator,
    keep: float,
) -> tuple[torch.Tensor, ...]:
    n = len(rays_o)
    trans, pixels = np.ones(n, np.float32), np.zeros((n, 4), np.float32)
    jitter = torch.rand(n, generator=generator, dtype=torch.float64).numpy()
    kept = []
    for ray, ts, counts in waves(teacher, rays_o, rays_d, 0.0, jitter, step, lambda: trans > 1e-3):
        mask = np.arange(ts.shape[1]) < counts[:, None]
        points = torch.from_numpy((rays_o[ray][:, None] + ts[..., None] * rays_d[ray][:, None])[mask])
        dirs = torch.from_numpy(np.broadcast_to(rays_d[ray][:, None], (*ts.shape, 3))[mask])
        found, colour = teacher.query(points, dirs)
        sigma, rgb = np.zeros(ts.shape, np.float32), np.zeros((*ts.shape, 3), np.float32)
        sigma[mask], rgb[mask] = found.numpy(), colour.numpy()
        before = trans[ray]
        weights, trans[ray] = weights_from_sigma(sigma, step, before)
        pixels[ray, :3] += (weights[..., None] * rgb).sum(1)
        seen = (before[:, None] - np.cumsum(weights, 1) + weights)[mask] > SEEN
        chosen = torch.from_numpy(seen) & (torch.rand(len(points), generator=generator) < keep)
        kept.append((points[chosen], dirs[chosen], found[chosen].float(), colour[chosen].float()))
    pixels[:, 3] = 1 - trans
    nothing = (torch.zeros(0, 3, dtype=torch.float64),) * 2 + (torch.zeros(0), torch.zeros(0, 3))
    return torch.from_numpy(pixels), *(torch.cat(column) for column in zip(*(kept or [nothing]), strict=True))
