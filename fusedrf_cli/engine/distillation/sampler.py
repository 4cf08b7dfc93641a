"""Random rays that a scene is learnt along."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from fusedrf_cli.engine.composition.composed import ComposedField
from fusedrf_cli.engine.rendering.cameras import Camera
from fusedrf_cli.engine.settings import current


@dataclass(frozen=True)
class SamplerConfig:
    """Where the rays of a student come from."""

    whole_scene_share: float = 0.5
    """Of the rays; the others are shared out over the objects, so that a small one is not missed."""
    below_share: float = 0.1
    """Of the rays that look from under the horizon."""


@dataclass(frozen=True, eq=False)
class RaySampler:
    """Draws rays at a whole scene and at its objects."""

    boxes: Sequence[np.ndarray]
    """(6,) the scene's, and its objects'."""
    views: Sequence[Camera] = ()
    """Without distortion, of those who look at the whole scene; of none, they stand anywhere around it. What
    fills all of space is only known from where it was photographed."""

    @classmethod
    def of(cls, scene: ComposedField, views: Sequence[Camera] = ()) -> "RaySampler":
        """Of a composed scene, in an order of its objects that does not depend on the nodes', so that equal
        scenes draw equal rays; views are from where places in it were photographed, and count for nothing
        where it has none."""
        fills = any(p.unbounded for p in scene.placed)
        views = tuple(views) if fills else ()
        objects = (p.aabb for p in scene.placed if not (views and p.unbounded))
        return cls([scene.occupancy.look_at_box, *sorted(objects, key=list)], views)

    def draw(self, count: int, generator: torch.Generator) -> tuple[np.ndarray, np.ndarray]:
        """rays_o, rays_d (count, 3) float64, rays_d of unit length, in random order."""
        others = self.boxes[1:] or ([] if self.views else self.boxes)
        n_scene = int(count * current(SamplerConfig).whole_scene_share) if others else count
        parts = [
            through(self.views, n_scene, generator)
            if self.views
            else around(self.boxes[0], n_scene, generator)
        ]
        for i, box in enumerate(others):
            n_object = (count - n_scene) // len(others) + (i < (count - n_scene) % len(others))
            parts.append(around(box, n_object, generator))
        order = torch.randperm(count, generator=generator).numpy()
        rays_o, rays_d = (np.concatenate(column)[order] for column in zip(*parts, strict=True))
        return rays_o, rays_d


def around(box: np.ndarray, count: int, generator: torch.Generator) -> tuple[np.ndarray, np.ndarray]:
    """rays_o, rays_d (count, 3) float64 from a shell around a box (6,), each towards a random point of it."""
    uniform = torch.rand(count, 7, generator=generator, dtype=torch.float64).numpy()
    lo, hi = box[:3], box[3:]
    centre, radius = (lo + hi) / 2, np.linalg.norm(hi - lo) / 2
    z = np.where(uniform[:, 0] < current(SamplerConfig).below_share, -uniform[:, 1], uniform[:, 1])
    ring, angle = np.sqrt(1 - z * z), 2 * np.pi * uniform[:, 2]
    away = np.stack([ring * np.cos(angle), ring * np.sin(angle), z], 1)
    rays_o = centre + away * (radius * (1.2 + 2.0 * uniform[:, 3:4]))
    rays_d = lo + uniform[:, 4:7] * (hi - lo) - rays_o
    return rays_o, rays_d / np.linalg.norm(rays_d, axis=1, keepdims=True)


def through(views: Sequence[Camera], count: int, generator: torch.Generator) -> tuple[np.ndarray, np.ndarray]:
    """rays_o, rays_d (count, 3) float64 through random points of the pictures of random views."""
    uniform = torch.rand(count, 3, generator=generator, dtype=torch.float64).numpy()
    at = np.minimum((uniform[:, 0] * len(views)).astype(int), len(views) - 1)
    poses = np.stack([view.camera_to_world for view in views])[at]
    lens = np.array([(v.fl_x, v.fl_y, v.cx, v.cy, v.width, v.height) for v in views])[at]
    x, y = ((uniform[:, 1:] * lens[:, 4:] - lens[:, 2:4]) / lens[:, :2]).T
    rays_d = np.einsum("nij,nj->ni", poses[:, :3, :3], np.stack([x, -y, -np.ones(count)], 1))
    return poses[:, :3, 3].copy(), rays_d / np.linalg.norm(rays_d, axis=1, keepdims=True)
