"""What a teacher is asked before distilling: rays with their colours, and points with σ and colour on those
rays.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch

from fusedrf_cli.engine.distillation.sampler import RaySampler
from fusedrf_cli.engine.fields import large_pages
from fusedrf_cli.engine.fields.base import RadianceField
from fusedrf_cli.engine.rendering.volume import (
    RenderConfig,
    reach_of,
    render_rays,
    waves,
    weights_from_depths,
)
from fusedrf_cli.engine.settings import current


@dataclass(frozen=True)
class TeacherConfig:
    """Which samples of a teacher's rays are kept as points."""

    seen: float = 1e-2
    """Transmittance under which what lies behind is not worth learning."""
    occupied_depth: float = 1e-3
    """Optical depth of a step from which a sample counts as density."""
    empty_share: float = 0.15
    """Of the samples with less that are kept: nine in ten are such, and without them floaters stay."""
    rendered_at_once: int = 1 << 17
    """Rays, of those that are rendered alone."""
    reckoned_rays: int = 2000
    """Of which the number of points is reckoned."""


def surface_first(depth: torch.Tensor) -> torch.Tensor:
    """The chances (N,) that samples are kept as points, by their optical depths (N,): all that can be seen of
    density, and a share of the emptiness before it."""
    config = current(TeacherConfig)
    return torch.where(depth > config.occupied_depth, 1.0, config.empty_share)


@dataclass
class TeacherPoints:
    """Samples of a teacher, in the teacher's frame."""

    where: torch.Tensor
    dirs: torch.Tensor
    """(N, 3) float32 samples on rays in front of what is opaque, empty ones among them."""
    sigma: torch.Tensor
    """(N,) float32, per unit of length."""
    rgb: torch.Tensor
    """(N, 3) float32; 0 where there is nothing to see."""
    transmittance: torch.Tensor
    """(N,) float32, of the ray up to the sample."""

    def __len__(self) -> int:
        return len(self.where)

    def columns(self) -> tuple[torch.Tensor, ...]:
        """The fields in their order."""
        return self.where, self.dirs, self.sigma, self.rgb, self.transmittance

    def batch(self, number: int, size: int) -> "TeacherPoints":
        """The number-th run of `size` points, or of all where there are fewer, one run after the other and
        over again.

        In a pool the points lie in random order, so that a run of them is a random choice that costs no
        search in memory."""
        size = min(size, len(self))
        start = number * size % len(self)
        over = start + size - len(self)
        if over <= 0:
            return TeacherPoints(*(column[start : start + size] for column in self.columns()))
        return TeacherPoints(*(torch.cat([column[start:], column[:over]]) for column in self.columns()))


Enough = Callable[[int], bool]
"""Whether so many rays of a teacher do."""


def all_rays(asked: int) -> bool:
    """That no rays are enough but all."""
    return False


@dataclass
class TeacherSamples:
    """Rays of a teacher and the points on them, in the teacher's frame."""

    rays_o: np.ndarray
    rays_d: np.ndarray
    """(R, 3) float64."""
    pixels: torch.Tensor
    """(R, 4) float32: rgb premultiplied by opacity, opacity."""
    points: TeacherPoints

    def and_rendered(self, more: "TeacherSamples") -> "TeacherSamples":
        """With the rays of others, whose points are left out."""
        rays_o, rays_d = (
            np.concatenate(two) for two in ((self.rays_o, more.rays_o), (self.rays_d, more.rays_d))
        )
        return TeacherSamples(rays_o, rays_d, torch.cat([self.pixels, more.pixels]), self.points)


def query_teacher(
    teacher: RadianceField,
    rays_o: np.ndarray,
    rays_d: np.ndarray,
    step: float,
    generator: torch.Generator,
    enough: Enough = all_rays,
) -> TeacherSamples:
    """Render rays (R, 3) through a teacher and keep some samples in front of what is opaque as points, in
    random order; of the rays only the first ones, where these are enough.
    """
    parts, asked, at_once = [], 0, current(RenderConfig).rays_at_once
    while not asked or asked < len(rays_o) and not enough(asked):
        part = slice(asked, asked + at_once)
        parts.append(_ask_part(teacher, rays_o[part], rays_d[part], step, generator))
        asked += at_once
    pixels, *columns = (list(column) for column in zip(*parts, strict=True))
    parts.clear()
    order = torch.randperm(sum(map(len, columns[0])), generator=generator, dtype=torch.int32)
    points = TeacherPoints(*(_shuffled(column, order) for column in columns))
    return TeacherSamples(rays_o[:asked], rays_d[:asked], torch.cat(pixels), points)


def render_teacher(
    teacher: RadianceField, rays_o: np.ndarray, rays_d: np.ndarray, enough: Enough = all_rays
) -> TeacherSamples:
    """Rays (R, 3) through a teacher without any points, as `query_teacher` has them."""
    parts, asked, at_once = [], 0, current(TeacherConfig).rendered_at_once
    while not asked or asked < len(rays_o) and not enough(asked):
        part = slice(asked, asked + at_once)
        parts.append(torch.from_numpy(render_rays(teacher, rays_o[part], rays_d[part])[:, :4]))
        asked += at_once
    none = torch.zeros(0, 3), torch.zeros(0, 3), torch.zeros(0), torch.zeros(0, 3), torch.zeros(0)
    return TeacherSamples(rays_o[:asked], rays_d[:asked], torch.cat(parts), TeacherPoints(*none))


def _shuffled(pieces: list[torch.Tensor], order: torch.Tensor) -> torch.Tensor:
    """The rows of the pieces, which are taken away, each at its place (N,) of the whole."""
    shuffled, start = _like(pieces[0], len(order)), 0
    while pieces:  # one after the other: together they can be a gigabyte, and would be two
        piece = pieces.pop(0)
        shuffled[order[start : start + len(piece)].long()] = piece
        start += len(piece)
    return shuffled


def _like(rows: torch.Tensor, count: int) -> torch.Tensor:
    """Room for so many of such rows. Pages of their own go back to the system with them, whereas freed pieces
    of a heap may stay."""
    return large_pages.zeros(count * rows.shape[1:].numel()).view(count, *rows.shape[1:])


def expected_points(teacher: RadianceField, sampler: RaySampler, rays: int, step: float, seed: int) -> int:
    """About how many points `query_teacher` keeps of so many rays, reckoned from a few of them."""
    config = current(TeacherConfig)
    generator = torch.Generator().manual_seed(seed)
    few = sampler.draw(config.reckoned_rays, generator)
    return len(query_teacher(teacher, *few, step, generator).points) * rays // config.reckoned_rays


def _ask_part(
    teacher: RadianceField,
    rays_o: np.ndarray,
    rays_d: np.ndarray,
    step: float,
    generator: torch.Generator,
) -> tuple[torch.Tensor, ...]:
    teacher_config = current(TeacherConfig)
    config = current(RenderConfig)
    n = len(rays_o)
    trans, pixels = np.ones(n, np.float32), np.zeros((n, 4), np.float32)
    jitter = torch.rand(n, generator=generator, dtype=torch.float64).numpy()
    samples = [(torch.zeros(0, 3), torch.zeros(0, 3), torch.zeros(0), torch.zeros(0, 3), torch.zeros(0))]
    reach = reach_of(len(rays_o), 0.0, np.inf)
    for ray, ts, spans, counts in waves(teacher, rays_o, rays_d, reach, jitter, step, lambda: trans > 1e-3):
        mask = np.arange(ts.shape[1]) < counts[:, None]
        points = torch.from_numpy((rays_o[ray][:, None] + ts[..., None] * rays_d[ray][:, None])[mask])
        dirs = torch.from_numpy(np.broadcast_to(rays_d[ray][:, None], (*ts.shape, 3))[mask])
        densities = teacher.query(points, dirs, with_colour=False)[0].float()
        sigma = np.zeros(ts.shape, np.float32)
        sigma[mask] = densities.numpy()
        weights, after = weights_from_depths(sigma * spans.astype(np.float32), trans[ray])
        before = torch.from_numpy((trans[ray][:, None] - np.cumsum(weights, 1) + weights)[mask])
        trans[ray] = after
        depth = densities * torch.from_numpy(spans[mask]).float()
        chosen = (before > teacher_config.seen) & (
            torch.rand(len(points), generator=generator) < surface_first(depth)
        )
        # most samples are empty, and a colour costs more than a density
        shown = torch.from_numpy(weights[mask] > config.seen_weight) | (chosen & (depth > config.seen_weight))
        colour = torch.zeros(len(points), 3)
        if shown.any():
            colour[shown] = teacher.query(points[shown], dirs[shown])[1].float()
        rgb = np.zeros((*ts.shape, 3), np.float32)
        rgb[mask] = colour.numpy()
        pixels[ray, :3] += (weights[..., None] * rgb).sum(1)
        samples.append(tuple(column[chosen].float() for column in (points, dirs, densities, colour, before)))
    pixels[:, 3] = 1 - trans
    columns = list(zip(*samples, strict=True))
    count = sum(map(len, columns[0]))
    return torch.from_numpy(pixels), *(torch.cat(c, out=_like(c[-1], count)) for c in columns)
