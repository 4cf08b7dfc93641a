"""The loops of segments.py on a GPU: the same functions, a thread for each ray. Rays, their segments and
their samples stay there; which instance each ray meets comes back, since work is sorted by fields here.
"""

from functools import cache
from types import ModuleType, SimpleNamespace

import numpy as np
from numba import cuda

from fusedrf_cli.engine.kernels import bundles, segments, specialise
from fusedrf_cli.engine.kernels.bundles import RayBatch
from fusedrf_cli.engine.kernels.cuda import CudaConfig, as_device_functions, device, kernel_of, launch
from fusedrf_cli.engine.kernels.segments import (
    Groups,
    Segments,
    goes_on,
    merge_task,
    next_in_any,
    segment_task,
)
from fusedrf_cli.engine.settings import current
from fusedrf_cli.engine.spaces import bounded, unbounded


@cache
def ray_kernels(spaces: tuple[ModuleType, ...] = ()) -> SimpleNamespace:
    """Kernels over the functions of segments.py, in which those of the spaces mean the GPU's."""
    own = {
        s: as_device_functions(specialise.specialised(None, {}, s)[1]) for s in (bounded, unbounded, *spaces)
    }
    tag = "segments_" + "_".join(space.__name__ for space in spaces)
    in_space = next_in_any([own[s]["next_change"] for s in spaces or (unbounded,)], tag, device)
    kernels = {"next_in_box": own[bounded]["next_change"], "next_in_space": in_space}
    kernels |= {name: own[bounded][name] for name in ("ray_in_instance", "cropped_between")}
    plain = {**vars(bundles), **vars(segments)}
    names = as_device_functions({name: value for name, value in plain.items() if name not in kernels})
    names |= kernels | {"cuda": cuda}
    templates = near_thread, merge_thread, add_thread, left_thread
    return SimpleNamespace(**{t.__name__: kernel_of(t, names, tag) for t in templates})


def near_thread(rays, instances, chosen, near, begins, few, few_begin, segments):
    """`next_segments`, with room for the instances near a ray for each of some threads, which share the rays
    out."""
    t, threads = cuda.grid(1), near.shape[0]
    if t < threads:
        for i in range(t, chosen.shape[0], threads):
            segment_task(
                rays, instances, chosen, i, i + 1, near[t], begins[t], few[t], few_begin[t], segments
            )  # fmt: skip


def merge_thread(shared, start, early_stop, groups, traces, segment_end, out):
    """`merge_samples`, a thread for each ray."""
    m = cuda.grid(1)
    if m < shared.shape[0]:
        merge_task(shared, start, m, m + 1, early_stop, groups, traces, segment_end, out)


def add_thread(shared, start, traces, out):
    """`add_colours`, a thread for each ray."""
    m = cuda.grid(1)
    if m < shared.shape[0]:
        for s in range(start[m], start[m + 1]):
            for c in range(3):
                out[shared[m], c] += traces.rgb[s, c]


def left_thread(chosen, rays, segments, rendered, early_stop, left):
    """Whether each ray goes on behind its segment, see `goes_on`."""
    i = cuda.grid(1)
    if i < chosen.shape[0]:
        left[i] = goes_on(chosen[i], rays, segments, rendered, early_stop)


# -- as segments.py has them ---------------------------------------------------------------------------------


def next_segments(
    rays: RayBatch, instances, spaces: tuple[ModuleType, ...], chosen: np.ndarray, segments: Segments
) -> None:
    """See segments.py."""
    count = len(instances.step)
    threads = max(1, min(len(chosen), current(CudaConfig).near_in_flight // count))
    room = [cuda.device_array((threads, count), kind) for kind in (np.int64, np.float64) * 2]
    launch(ray_kernels(spaces).near_thread, threads, (rays, instances, chosen, *room), (segments,))


def merge_samples(
    shared: np.ndarray, start: np.ndarray, early_stop: float, groups: Groups, traces, segment_end, out
) -> None:
    """See segments.py."""
    work = shared, start, early_stop, groups
    launch(ray_kernels().merge_thread, len(shared), work, (traces, segment_end, out))


def add_colours(shared: np.ndarray, start: np.ndarray, traces, out) -> None:
    """See segments.py."""
    launch(ray_kernels().add_thread, len(shared), (shared, start, traces), (out,))


def rays_left(
    chosen: np.ndarray, rays: RayBatch, segments: Segments, rendered, early_stop: float
) -> np.ndarray:
    """See segments.py."""
    left = np.zeros(len(chosen), bool)
    launch(ray_kernels().left_thread, len(chosen), (chosen, rays, segments, rendered, early_stop), (left,))
    return chosen[left]
