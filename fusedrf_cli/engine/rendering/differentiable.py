"""Rendering as a function of torch, differentiable in fields' numbers, rays, cameras' poses and placements.

Samples are found by the compiled march and lie where those of `volume.render_rays` lie; how far along a ray
they lie is differentiated too, since a ray's first sample depends on where it enters the box. Which samples
there are is a constant.
"""

from typing import NamedTuple

import numpy as np
import torch

from fusedrf_cli.engine.composition.affine import Placed
from fusedrf_cli.engine.composition.composed import ComposedField
from fusedrf_cli.engine.composition.differentiable import (
    Poses,
    bounds,
    device_of,
    needs_gradient,
    parts,
    query,
    structure,
)
from fusedrf_cli.engine.fields.base import RadianceField, sampling_step
from fusedrf_cli.engine.fields.differentiable import settle
from fusedrf_cli.engine.kernels.reference import exact, interval
from fusedrf_cli.engine.rendering import volume
from fusedrf_cli.engine.rendering.cameras import Camera
from fusedrf_cli.engine.rendering.volume import RenderConfig, reach_of, waves, weights_from_depths
from fusedrf_cli.engine.settings import current
from fusedrf_cli.engine.spaces import bounded


class Picture(NamedTuple):
    """One view as tensors on the field's device."""

    rgb: torch.Tensor
    """(H, W, 3), premultiplied by the opacity."""
    opacity: torch.Tensor
    """(H, W) in [0, 1]."""
    depth: torch.Tensor
    """(H, W) mean distance along the ray in world units; inf where nothing is hit."""

    def over(self, background: tuple[float, float, float]) -> torch.Tensor:
        """(H, W, 3) composited over a colour, in [0, 1]."""
        return self.rgb + (1 - self.opacity[..., None]) * self.rgb.new_tensor(background)


def render_rays(
    field: RadianceField | Placed,
    rays_o: torch.Tensor,
    rays_d: torch.Tensor,
    *,
    poses: Poses | None = None,
    origin: np.ndarray | None = None,
    near: float = 0.0,
    step: float | None = None,
    early_stop: float | None = None,
) -> torch.Tensor:
    """Render rays (N, 3), directions of unit length, of the frame of a field, placed or composed or neither:
    (N, 5) premultiplied rgb, opacity and Σ w t, on the field's device. With `origin`, where that frame lies
    (a position (3,), or a placement (4, 4)), rays and t are the world's.

    Differentiable in the fields' numbers, rays_o, rays_d and `poses` (composition/differentiable.py). Where
    nothing needs a gradient it is `volume.render_rays`, which is faster: it leaves out the colour of the
    lightest samples, and samples coarse blocks and bricks less often. Samples behind which less than
    `early_stop` of the light is left are not asked. step None: half the field's finest voxel. Raises
    ValueError for a direction of no length.
    """
    if isinstance(field, Placed):
        field = ComposedField([field])
        poses, origin = shifted(poses, field.origin), field.origin
    rays_o, rays_d, per_length = seen_from(origin, rays_o, rays_d)
    structured, device = structure(field, poses), device_of(field)
    if per_length is not None and isinstance(field, ComposedField) and structured.occupancy.space is bounded:
        unit = float(np.linalg.norm(origin[:3, 0]))
        near, step = near / unit, step and step / unit
    step = step or sampling_step(structured)
    host = [np.ascontiguousarray(x.detach().cpu().numpy(), np.float64) for x in (rays_o, rays_d)]
    if not needs_gradient(field, rays_o, rays_d, *(poses or {}).values()):
        for part in parts(field):
            settle(part)
        pixels = volume.render_rays(structured, *host, near=near, step=step, early_stop=early_stop)
        return in_lengths(torch.from_numpy(pixels).to(device), per_length)
    volume.check_directions(host[1])
    ray, ts, spans = visible_samples(structured, *host, near, step, early_stop)
    ray, ts, spans = torch.from_numpy(ray).to(device), exact(ts, device), exact(spans, device)
    rays_o, rays_d = exact(rays_o, device), exact(rays_d, device)
    if structured.occupancy.space is bounded:  # an unbounded one has no first face for a ray to enter by
        start, _ = interval(rays_o, rays_d, bounds(field, poses), near)
        ts = ts + (start - start.detach())[ray]
    dirs = rays_d[ray]
    sigma, rgb = query(field, rays_o[ray] + ts[:, None] * dirs, dirs, poses)
    weights = composite(sigma * spans.to(sigma.dtype), ray, len(rays_o))
    columns = torch.cat([rgb, torch.ones_like(sigma)[:, None], ts.to(sigma.dtype)[:, None]], 1)
    pixels = sigma.new_zeros(len(rays_o), 5).index_add(0, ray, weights[:, None] * columns)
    return in_lengths(pixels, per_length)


def seen_from(
    origin: np.ndarray | None, points: torch.Tensor, dirs: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor | None]:
    """World points and unit dirs (N, 3) in a frame that lies at `origin` (see `render_rays`), and how long
    (N,) a unit of the world's is there along each; None: as long."""
    if origin is None:
        return points, dirs, None
    frame_origin = exact(origin, points.device)
    if frame_origin.shape == (3,):
        return exact(points, points.device) - frame_origin, dirs, None
    inverse = torch.linalg.inv(frame_origin[:3, :3])
    directions = exact(dirs, dirs.device) @ inverse.T
    lengths = directions.norm(dim=1)
    return (
        (exact(points, points.device) - frame_origin[:3, 3]) @ inverse.T,
        directions / lengths[:, None],
        lengths,
    )


def in_lengths(columns: torch.Tensor, per_length: torch.Tensor | None) -> torch.Tensor:
    """(N, 5) rays' columns with distances in a unit of which `per_length` (N,) make up one of another."""
    if per_length is None:
        return columns
    return torch.cat([columns[:, :4], columns[:, 4:] / per_length[:, None].to(columns)], 1)


def shifted(poses: Poses | None, origin: np.ndarray) -> dict[str, torch.Tensor]:
    """Placements seen from a frame that lies at `origin`: a position (3,), or a placement (4, 4)."""
    if origin.shape == (4, 4):
        inverse = torch.from_numpy(np.linalg.inv(origin))
        return {name: inverse.to(pose) @ pose for name, pose in (poses or {}).items()}
    offset = torch.nn.functional.pad(torch.from_numpy(origin)[:, None], (3, 0, 0, 1))
    return {name: pose - offset.to(pose) for name, pose in (poses or {}).items()}


@torch.no_grad()
def visible_samples(
    field: RadianceField,
    rays_o: np.ndarray,
    rays_d: np.ndarray,
    near: float,
    step: float,
    early_stop: float | None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rays (S,) int64, ascending, distances (S,) and the lengths (S,) that they stand for of the samples up
    to where a ray is opaque, in order."""
    early_stop = current(RenderConfig).early_stop if early_stop is None else early_stop
    trans = np.ones(len(rays_o))
    rays, distances, lengths = [np.zeros(0, np.int64)], [np.zeros(0)], [np.zeros(0)]
    middle = np.full(len(rays_o), 0.5)
    reach = reach_of(len(rays_o), near, np.inf)
    for ray, ts, spans, counts in waves(
        field, rays_o, rays_d, reach, middle, step, lambda: trans > early_stop
    ):
        row, slot = np.nonzero(np.arange(ts.shape[1]) < counts[:, None])
        dirs = rays_d[ray[row]]
        points = rays_o[ray[row]] + ts[row, slot, None] * dirs
        sigma = np.zeros(ts.shape)
        densities, _ = query(field, torch.from_numpy(points), torch.from_numpy(dirs), with_colour=False)
        sigma[row, slot] = densities.cpu().numpy()
        weights, after = weights_from_depths(sigma * spans, trans[ray])
        before = trans[ray, None] - (np.cumsum(weights, 1) - weights)
        visible = before[row, slot] > early_stop
        trans[ray] = after
        rays.append(ray[row[visible]])
        distances.append(ts[row[visible], slot[visible]])
        lengths.append(spans[row[visible], slot[visible]])
    ray, ts, spans = (np.concatenate(column) for column in (rays, distances, lengths))
    order = np.argsort(ray, kind="stable")
    return ray[order], ts[order], spans[order]


def composite(depth: torch.Tensor, ray: torch.Tensor, n: int) -> torch.Tensor:
    """Weights (S,) of packed samples of optical depths (S,) on n rays; the samples' rays (S,) ascend.

    The depth before a sample is the running sum over all less its value at the ray's first, hence float64.
    """
    deep = exact(depth, depth.device)
    before = deep.cumsum(0) - deep
    counts = torch.bincount(ray, minlength=n)
    first = (counts.cumsum(0) - counts)[ray]
    return (torch.exp(before[first] - before) * -torch.expm1(-deep)).to(depth.dtype)


def camera_rays(camera: Camera, pose: torch.Tensor | None = None) -> tuple[torch.Tensor, torch.Tensor]:
    """rays_o and rays_d, each (H W, 3) float64 in world space, rays_d of unit length, row by row, of a camera
    at `pose` (4, 4), camera to world; None: its own. Differentiable in `pose`."""
    pose = torch.from_numpy(np.asarray(camera.camera_to_world, np.float64)) if pose is None else pose
    pose = exact(pose, pose.device)
    dirs = exact(camera.local_directions().reshape(-1, 3), pose.device) @ pose[:3, :3].T
    return pose[:3, 3].expand_as(dirs), torch.nn.functional.normalize(dirs, dim=1)


def render_image(
    field: RadianceField | Placed,
    camera: Camera,
    *,
    pose: torch.Tensor | None = None,
    poses: Poses | None = None,
    origin: np.ndarray | None = None,
    near: float = 0.0,
    step: float | None = None,
    early_stop: float | None = None,
) -> Picture:
    """Render one view from `pose` (4, 4), camera to world, in place of the camera's own; see `render_rays`
    for origin. Differentiable as that is, and in `pose`."""
    rays_o, rays_d = camera_rays(camera, pose)
    how = {"poses": poses, "origin": origin, "near": near, "step": step, "early_stop": early_stop}
    columns = render_rays(field, rays_o, rays_d, **how).view(camera.height, camera.width, 5)
    opacity = columns[..., 3]
    depth = torch.where(opacity > 1e-3, columns[..., 4] / opacity.clamp_min(1e-3), torch.inf)
    return Picture(columns[..., :3], opacity, depth)
