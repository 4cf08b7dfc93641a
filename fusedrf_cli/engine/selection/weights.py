"""Which cells the light of rays comes from: sums of the weights of volume rendering (NeRF, eq. 3)."""

import numpy as np
import torch

from fusedrf_cli.engine.composition.composite import Composite, Waves
from fusedrf_cli.engine.fields.base import RadianceField, sampling_step
from fusedrf_cli.engine.fields.computed import exact
from fusedrf_cli.engine.fields.occupancy import OccupancyGrid, mapped
from fusedrf_cli.engine.kernels.bundles import RayBatch
from fusedrf_cli.engine.kernels.instances import Traces
from fusedrf_cli.engine.kernels.primitives import FARTHEST
from fusedrf_cli.engine.kernels.segments import DONE
from fusedrf_cli.engine.rendering.volume import RenderConfig, reach_of, waves, weights_from_depths
from fusedrf_cli.engine.settings import current


def cell_weights(
    field: RadianceField,
    rays_o: np.ndarray,
    rays_d: np.ndarray,
    jitter: np.ndarray,
    inside: np.ndarray,
    cells: OccupancyGrid,
) -> np.ndarray:
    """(2, X, Y, Z) for each cell of a grid, in the coordinates of its space over the field's frame, occupied
    or not, the sum of the weights that samples in it have on those of rays (N, 3) that are not `inside` (N,)
    bool, and on those that are. Samples of a single field lie `jitter` (N,) of a step into each step."""
    if not isinstance(field, Composite) and getattr(field, "device_loops", None) is not None:
        return field.votes(rays_o, rays_d, jitter, inside, sampling_step(field), cells)
    tally, inside = Tally(cells), np.asarray(inside, bool)
    if isinstance(field, Composite):
        for start in range(0, len(rays_o), field.rays_at_once):
            part = slice(start, start + field.rays_at_once)
            count_instances(field, rays_o[part], rays_d[part], inside[part], tally)
    else:
        march(field, rays_o, rays_d, jitter, inside, tally)
    return tally.sums


class Tally:
    """Sums of weights in the cells of a grid."""

    def __init__(self, cells: OccupancyGrid):
        self.cells, self.sums = cells, np.zeros((2, *cells.occupied.shape), np.float32)

    def add(self, points: np.ndarray, weights: np.ndarray, inside: np.ndarray) -> None:
        """Weights (N,) at points (N, 3) of the frame, of rays that are inside (N,) bool or not."""
        index = np.floor((mapped(points, self.cells.space) - self.cells.aabb[:3]) / self.cells.cell)
        held = ((index >= 0) & (index < self.cells.occupied.shape)).all(1)
        i, j, k = index[held].astype(np.int64).T
        np.add.at(self.sums, (inside[held].astype(np.int64), i, j, k), weights[held])


def march(
    field: RadianceField,
    rays_o: np.ndarray,
    rays_d: np.ndarray,
    jitter: np.ndarray,
    inside: np.ndarray,
    tally: Tally,
) -> None:
    """Add the weights of rays through any field, by asking it at each sample."""
    trans, reach = np.ones(len(rays_o), np.float32), reach_of(len(rays_o), 0.0, np.inf)
    early_stop = current(RenderConfig).early_stop
    rays = rays_o, rays_d, reach, jitter, sampling_step(field), lambda: trans > early_stop
    for ray, distances, spans, counts in waves(field, *rays):
        mask = np.arange(distances.shape[1]) < counts[:, None]
        points = rays_o[ray][:, None] + distances[..., None] * rays_d[ray][:, None]
        dirs = np.broadcast_to(rays_d[ray][:, None], points.shape)[mask]
        sigma = np.zeros(distances.shape, np.float32)
        sigma[mask] = field.query(torch.from_numpy(points[mask]), torch.from_numpy(dirs), False)[0].numpy()
        weights, trans[ray] = weights_from_depths(sigma * spans.astype(np.float32), trans[ray])
        tally.add(points[mask], weights[mask], np.broadcast_to(inside[ray][:, None], mask.shape)[mask])


def count_instances(
    scene: Composite, rays_o: np.ndarray, rays_d: np.ndarray, inside: np.ndarray, tally: Tally
) -> None:
    """Add the weights of rays through a scene, with the samples and the step of each instance."""
    reach = np.minimum(reach_of(len(rays_o), 0.0, np.inf), FARTHEST)
    rays, out = RayBatch(exact(rays_o), exact(rays_d), reach), np.zeros((len(rays_o), 5), np.float32)
    counting = WeightWaves(scene, rays, 1.0, current(RenderConfig).early_stop, out)
    counting.inside, counting.tally = inside, tally
    while counting.go_on():
        pass


class WeightWaves(Waves):
    """Rays through a scene whose samples are counted, not coloured: every segment is traced, also that of a
    single instance."""

    inside: np.ndarray
    tally: Tally

    def go_on(self) -> bool:
        """See Waves. A segment that an unbounded instance has alone is a wave of its own."""
        left = self.left
        self.find(left)
        segments, host = self.here(), self.loops.on_host
        alone = left[segments.alone_to[left] > segments.alone_from[left]]
        if len(alone):
            segments.begin[alone], segments.end[alone] = segments.alone_from[alone], segments.alone_to[alone]
            segments.instance[alone] = host(self.unbounded)[alone]
        single = left[segments.instance[left] >= 0]
        segments.meeting[single, 0], segments.n_meeting[single] = segments.instance[single], 1
        self.segments = self.loops.on_device(segments)
        for part in self.parts(left[segments.instance[left] != DONE]):
            self.show_shared(part)
        self.left = self.segment_loops.rays_left(left, self.rays, self.segments, self.out, self.early_stop)
        return len(self.left) > 0

    def add_samples(
        self, shared: np.ndarray, start: np.ndarray, slots: tuple, ends: tuple, traces: Traces
    ) -> None:
        """See Waves: count them."""
        host, (chosen, ray, _) = self.loops.on_host, slots
        weight, count = host(traces.weight), host(traces.count)
        there = np.arange(weight.shape[1]) < count[chosen][:, None]
        slot, sample = np.nonzero(there & (weight[chosen] > 0))
        ray, distance = host(ray)[slot], host(traces.middle)[slot, sample]
        points = host(self.rays.rays_o)[ray] + distance[:, None] * host(self.rays.rays_d)[ray]
        self.tally.add(points, weight[slot, sample], self.inside[ray])
