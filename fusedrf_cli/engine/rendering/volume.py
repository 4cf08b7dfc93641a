"""Volume rendering (NeRF, eq. 3): alpha_i = 1 - exp(-σ_i δ), w_i = T_i alpha_i, C = Σ w_i c_i, with T_i the
product before the sample."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import torch

from fusedrf_cli.engine.fields.base import RadianceField, sampling_step
from fusedrf_cli.engine.kernels import cpu
from fusedrf_cli.engine.rendering.cameras import TILE, Camera, tile_order
from fusedrf_cli.engine.settings import current


@dataclass(frozen=True)
class RenderConfig:
    """How rays are marched, and how many at a time."""

    early_stop: float = 1e-3
    """Remaining transmittance; bounds the error of a pixel by a quarter of an 8-bit level."""
    seen_weight: float = 1e-6
    """Samples lighter than this stay black."""
    rays_at_once: int = 1 << 14
    """Of any field: waves through many fields would take more memory than these do."""
    work_at_once: int = 1 << 24
    """Samples that compiled loops take, at most, before an interrupt is heard: seconds on one core."""
    work_at_once_cuda: int = 1 << 28
    """The same on a GPU."""
    colours: int = 500
    """Of a ray, at most: each stands for a share of the light (SHARED_COLOUR_FROM of
    loops.py)."""
    halvings: int = 6
    """Of the rays done at once, where memory is short."""
    samples_per_wave: int = 32
    pixels_at_once: int = 1 << 18


@dataclass(frozen=True)
class RenderedImage:
    """Float32 pictures of one view."""

    rgb: np.ndarray
    """(H, W, 3), premultiplied by the opacity."""
    opacity: np.ndarray
    """(H, W) in [0, 1]."""
    depth: np.ndarray
    """(H, W) mean distance along the ray in world units; inf where nothing is hit."""

    def over(self, background: tuple[float, float, float] = (1.0, 1.0, 1.0)) -> np.ndarray:
        """(H, W, 3) composited over a colour, by default white, in [0, 1]."""
        return np.clip(self.rgb + (1 - self.opacity[..., None]) * np.asarray(background, np.float32), 0, 1)


def render_rays(
    field: RadianceField,
    rays_o: np.ndarray,
    rays_d: np.ndarray,
    *,
    near: float | np.ndarray = 0.0,
    far: float | np.ndarray = np.inf,
    step: float | None = None,
    early_stop: float | None = None,
) -> np.ndarray:
    """Render rays (N, 3) float64 of the field's frame, from distance `near` to `far`, of all rays or of each
    (N,): (N, 5) float32 premultiplied rgb, opacity, Σ w t.

    A ray's numbers do not depend on which others it is rendered with. So many are done at once as
    `RenderConfig` says, where memory is short, fewer; it says the `early_stop` of None, too. MemoryError (or
    torch's own) when even that does not help. Raises ValueError for a direction of no length, along which
    there is no end, or one that is not finite.
    """
    config = current(RenderConfig)
    check_directions(rays_d)
    early_stop = config.early_stop if early_stop is None else early_stop
    step, reach = step or sampling_step(field), reach_of(len(rays_o), near, far)
    out = np.zeros((len(rays_o), 5), np.float32)
    compiled = getattr(field, "device_loops", True) is not None
    fast = getattr(field, "render_rays", None) if compiled else None

    def render(part: slice) -> None:
        if fast is not None:
            fast(rays_o[part], rays_d[part], reach[part], step, early_stop, out[part])
        else:
            march_rays(field, rays_o[part], rays_d[part], reach[part], step, early_stop, out[part])

    at_once = getattr(field, "rays_at_once", config.rays_at_once)
    if fast is not None and not hasattr(field, "rays_at_once"):
        at_once = rays_at_once(field, step)
    for start in range(0, len(rays_o), at_once):
        in_halves(render, start, min(start + at_once, len(rays_o)))
    return out


def rays_at_once(field: RadianceField, step: float) -> int:
    """How many rays of a computed field take all samples of `work_at_once`, if none of them ends early."""
    config = current(RenderConfig)
    most = config.work_at_once if field.device_loops is cpu else config.work_at_once_cuda
    samples = field.occupancy.most_samples(step)
    shading = field.loops.names["SHADING_COST"] * min(samples, config.colours)
    return max(1, most // max(samples + shading, 1))


def reach_of(rays: int, near: float | np.ndarray, far: float | np.ndarray) -> np.ndarray:
    """(N, 2) float64: from which distance to which each of so many rays is followed."""
    reach = np.empty((rays, 2))
    reach[:, 0], reach[:, 1] = near, far
    return reach


def check_directions(rays_d: np.ndarray) -> None:
    """Raise ValueError for directions (N, 3) of no length, or that are not finite."""
    lengths = np.einsum("ni,ni->n", rays_d, rays_d)
    sound = (lengths > 0) & (lengths < np.inf)
    if not sound.all():
        raise ValueError(f"ray {np.argmax(~sound)} has no direction")


def in_halves(render: Callable[[slice], None], start: int, stop: int, halvings: int | None = None) -> None:
    """render(slice(start, stop)), or its halves one after the other where memory does not suffice; parts are
    halved so often at most."""
    halvings = current(RenderConfig).halvings if halvings is None else halvings
    try:
        return render(slice(start, stop))
    except Exception as error:
        if not is_out_of_memory(error) or not halvings or stop - start < 2:
            raise
    # Only here is the exception gone, and with it the arrays of the attempt that its traceback held.
    middle = (start + stop) // 2
    in_halves(render, start, middle, halvings - 1)
    in_halves(render, middle, stop, halvings - 1)


def is_out_of_memory(error: BaseException) -> bool:
    """Whether an error says that memory could not be had, here or on a GPU; torch says so by a RuntimeError,
    the GPU's compiler by an error of CUDA's."""
    of_cuda = "CudaAPIError", "CudaDriverError", "CudaRuntimeError"  # numba-cuda, which may not be there
    message = str(error).lower().replace("_", " ")
    return isinstance(error, MemoryError) or (
        isinstance(error, RuntimeError)
        and ("alloc" in message or "out of memory" in message)
        or type(error).__name__ in of_cuda
        and "out of memory" in message
    )


def march_rays(
    field: RadianceField,
    rays_o: np.ndarray,
    rays_d: np.ndarray,
    reach: np.ndarray,
    step: float,
    early_stop: float,
    out: np.ndarray,
) -> None:
    """The general path for any field: waves of some samples per living ray, into out (N, 5)."""
    n, seen_weight = len(rays_o), current(RenderConfig).seen_weight
    trans = np.ones(n, np.float32)
    total = np.zeros((n, 5), np.float32)
    for ray, ts, spans, counts in waves(
        field, rays_o, rays_d, reach, np.full(n, 0.5), step, lambda: trans > early_stop
    ):
        mask = np.arange(ts.shape[1]) < counts[:, None]
        points = rays_o[ray][:, None] + ts[..., None] * rays_d[ray][:, None]
        dirs = np.broadcast_to(rays_d[ray][:, None], points.shape)
        sigma = np.zeros(ts.shape, np.float32)
        densities, _ = field.query(
            torch.from_numpy(points[mask]), torch.from_numpy(dirs[mask]), with_colour=False
        )
        sigma[mask] = densities.numpy()
        weights, trans[ray] = weights_from_depths(sigma * spans.astype(np.float32), trans[ray])
        seen = weights > seen_weight
        colour = np.zeros((*ts.shape, 3), np.float32)
        if seen.any():
            _, rgb = field.query(torch.from_numpy(points[seen]), torch.from_numpy(dirs[seen]))
            colour[seen] = rgb.numpy()
        total[ray, :3] += (weights[..., None] * colour).sum(1)
        # Along columns, so that every ray is summed in one order however long its wave's longest ray is.
        total[ray, 4] += np.add.reduce(np.asfortranarray(weights * ts), axis=1)
    total[:, 3] = 1 - trans
    out[:] = total


def weights_from_depths(depths: np.ndarray, trans: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Weights (N, K) of consecutive samples of optical depths (N, K) that start with transmittance trans
    (N,), and the transmittance behind them."""
    transmittance = trans[:, None] * np.exp(-np.cumsum(depths, 1))
    before = np.concatenate([trans[:, None], transmittance[:, :-1]], 1)
    return before - transmittance, transmittance[:, -1]


def waves(
    field: RadianceField,
    rays_o: np.ndarray,
    rays_d: np.ndarray,
    reach: np.ndarray,
    jitter: np.ndarray,
    step: float,
    alive: Callable[[], np.ndarray],
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]]:
    """March rays, from and to their distances reach (N, 2), in waves: yields (indices of rays with samples
    (M,), distances (M, K), the lengths of the ray that these samples stand for (M, K), how many of them count
    (M,))."""
    n = len(rays_o)
    start = np.zeros(n, np.int64)
    ts, spans, counts = *np.zeros((2, n, current(RenderConfig).samples_per_wave)), np.zeros(n, np.int64)
    loops = cpu.loops_for(None, (), field.occupancy.space)
    while True:
        samples = ts, spans, counts
        loops.march(field.occupancy.arrays, rays_o, rays_d, reach, jitter, step, start, alive(), *samples)
        ray = np.flatnonzero(counts)
        if not len(ray):
            return
        longest = counts.max()
        yield ray, ts[ray, :longest], spans[ray, :longest], counts[ray]


def render_image(
    field: RadianceField,
    camera: Camera,
    *,
    origin: np.ndarray | None = None,
    near: float = 0.0,
    far: float = np.inf,
    step: float | None = None,
    early_stop: float | None = None,
) -> RenderedImage:
    """Render what one view shows from the distance `near` to `far` along its rays; origin is where the
    field's frame lies in the world: its origin's position (3,), or its placement (4, 4); float64, so that
    scenes far away hold."""
    shape = camera.height, camera.width
    picture = RenderedImage(
        np.empty((*shape, 3), np.float32), np.empty(shape, np.float32), np.empty(shape, np.float32)
    )
    top = 0
    how = {"origin": origin, "near": near, "far": far, "step": step, "early_stop": early_stop}
    for band in render_bands(field, camera, **how):
        rows = slice(top, top := top + len(band.rgb))
        picture.rgb[rows], picture.opacity[rows], picture.depth[rows] = band.rgb, band.opacity, band.depth
    return picture


def render_bands(
    field: RadianceField,
    camera: Camera,
    *,
    origin: np.ndarray | None = None,
    near: float = 0.0,
    far: float = np.inf,
    step: float | None = None,
    early_stop: float | None = None,
) -> Iterator[RenderedImage]:
    """The view of `render_image` as bands of whole rows from the top, for pictures that memory does not hold;
    put together they are that picture to the bit."""
    rows = max(TILE, current(RenderConfig).pixels_at_once // camera.width // TILE * TILE)
    for top in range(0, camera.height, rows):
        order = tile_order(camera.width, min(rows, camera.height - top))
        rays_o, rays_d, per_length = rays_from(origin, camera, slice(top, top + rows), order)
        reach = {"near": near * per_length, "far": far * per_length}
        columns = render_rays(field, rays_o, rays_d, **reach, step=step, early_stop=early_stop)
        columns[:, 4] /= per_length
        pixels = np.empty_like(columns)
        pixels[order] = columns
        pixels = pixels.reshape(-1, camera.width, 5)
        opacity = pixels[..., 3]
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = np.where(opacity > 1e-3, pixels[..., 4] / opacity, np.inf).astype(np.float32)
        yield RenderedImage(pixels[..., :3], opacity, depth)


def rays_from(
    origin: np.ndarray | None, camera: Camera, rows: slice, order: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray | float]:
    """`seen_from` of a camera's rays. A frame that is turned and scaled alike along all axes, as an unbounded
    scene's is, has a camera of its own: that is one pass over the rays less."""
    if origin is not None and origin.shape == (4, 4):
        squares = origin[:3, :3].T @ origin[:3, :3]
        if np.allclose(squares, squares[0, 0] * np.eye(3), rtol=0, atol=1e-12 * squares[0, 0]):
            return *camera.seen_from(origin).rays(rows, order), 1 / np.sqrt(squares[0, 0])
    return seen_from(origin, *camera.rays(rows, order))


def seen_from(
    origin: np.ndarray | None, rays_o: np.ndarray, rays_d: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray | float]:
    """World rays (N, 3), unit directions, in a frame that lies at `origin` (see `render_image`), and how much
    of its length a unit of the world's is along each. Optical depths are the same in both."""
    if origin is None:
        return rays_o, rays_d, 1.0
    if origin.shape == (3,):
        return rays_o - origin, rays_d, 1.0
    if np.array_equal(origin[:3, :3], np.eye(3)):
        return rays_o - origin[:3, 3], rays_d, 1.0
    inverse = np.linalg.inv(origin[:3, :3])
    directions = rays_d @ inverse.T
    lengths = np.linalg.norm(directions, axis=1)
    return (rays_o - origin[:3, 3]) @ inverse.T, directions / lengths[:, None], lengths
