"""How much work a ray may be: bounded when a field is opened, and cut so that an interrupt is heard."""

from functools import partial

import numpy as np
import pytest
import torch

from fusedrf_cli.engine.fields.base import SamplingConfig
from fusedrf_cli.engine.fields.occupancy import OccupancyGrid
from fusedrf_cli.engine.kernels import cpu
from fusedrf_cli.engine.kinds import registry
from fusedrf_cli.engine.rendering.volume import RenderConfig, is_out_of_memory, rays_at_once, render_rays
from fusedrf_cli.engine.spaces import bounded, unbounded
from tests.engine.conftest import random_vm
from tests.engine.kinds.cases import BOXED, random_boxed
from tests.engine.kinds.sparse_cases import random_sparse

FIELDS = {"vm": random_vm, "sparse": random_sparse}
FIELDS |= {name: partial(random_boxed, name) for name in BOXED}


def thin(name: str, side: float) -> tuple[dict, dict]:
    """Arrays and metadata of a field whose box is so thin along x."""
    arrays, metadata = FIELDS[name]().state()
    if name == "sparse":
        metadata["top"][0] = side / metadata["counts"][0]
    boxes = [metadata, *metadata.get("tensors", ()), *([metadata["cells"]] if "cells" in metadata else ())]
    for part in boxes:
        part["aabb"] = [*part["aabb"][:3], part["aabb"][0] + side, *part["aabb"][4:]]
    return arrays, metadata


@pytest.mark.parametrize("name", FIELDS)
def test_a_field_through_which_a_ray_would_take_for_ever_is_refused(name):
    kind = registry.kind(name).field
    kind.from_state(*FIELDS[name]().state())
    for side in (1e-9, 1e-300):
        with pytest.raises(ValueError, match="a ray through .* would take up to|should be|as many top cells"):
            kind.from_state(*thin(name, side))


def test_a_detail_that_is_too_fine_is_refused():
    from tests.engine.kinds.cases import random_detail

    arrays, metadata = random_detail().state()
    metadata["tensors"][0]["hashed"]["spacings"][-1] = 4e-6
    with pytest.raises(ValueError, match="a ray through the field"):
        registry.kind("vm").field.from_state(arrays, metadata)


def test_cubic_voxels_are_always_bearable():
    """8,192 texels along each side, the most that a stored field has."""
    box = np.array([0.0, 0, 0, 1, 1, 1])
    assert bounded.most_samples(box, bounded.picture_step(1 / 8191)) < SamplingConfig.most_samples


@pytest.mark.parametrize("space", [bounded, unbounded])
@pytest.mark.parametrize("strided", [False, True])
def test_no_ray_takes_more_samples_than_told(space, strided):
    """Counted along rays through grids of cells at random."""
    rng = np.random.default_rng(3)
    box = unbounded.WHOLE if space is unbounded else np.array([-1.0, -0.5, -2, 1, 0.5, 2])
    occupied = rng.random((7, 5, 9)) < 0.3
    stride = rng.integers(1, 6, occupied.shape).astype(np.uint16) if strided else None
    grid = OccupancyGrid(box, occupied, space, stride, 0.01 if strided else 0.0)
    rays_o, rays_d = rng.normal(0, 3, (200, 3)), rng.normal(0, 1, (200, 3))
    rays_d /= np.linalg.norm(rays_d, axis=1, keepdims=True)
    rays_o -= rays_d * 5
    counts, start = np.zeros(200, np.int64), np.zeros(200, np.int64)
    places = np.zeros((2, 200, 4000))
    reach = np.tile([0.0, np.inf], (200, 1))
    loops = cpu.loops_for(None, (), space)
    how = np.full(200, 0.5), 0.01, start, start == 0
    loops.march(grid.arrays, rays_o, rays_d, reach, *how, *places, counts)
    most = grid.most_samples(0.01)
    assert (start == -1).all() and counts.max() <= most and most <= space.most_samples(box, 0.01)


def test_rays_are_done_in_pieces_and_show_the_same(monkeypatch, in_force):
    """So that an interrupt is heard between two of them."""
    field = random_vm(dtype=torch.float32)
    rng = np.random.default_rng(0)
    rays = rng.normal(0, 0.2, (3000, 3)) - [0, 0, 3], np.tile([0.0, 0, 1], (3000, 1))
    whole, pieces, shown = render_rays(field, *rays), [], type(field).render_rays

    def noted(self, rays_o, *words):
        pieces.append(len(rays_o))
        return shown(self, rays_o, *words)

    step = 0.5 * field.voxel_size
    monkeypatch.setattr(type(field), "render_rays", noted)
    in_force(RenderConfig(work_at_once=1000 * field.occupancy.most_samples(step)))
    assert rays_at_once(field, step) == 1000
    assert np.array_equal(render_rays(field, *rays), whole) and pieces == [1000] * 3


def test_memory_that_a_gpu_lacks_is_lack_of_memory():
    class CudaAPIError(Exception):
        """As numba-cuda has it, which need not be here."""

    class Other(Exception):
        """Of something else."""

    assert is_out_of_memory(CudaAPIError(2, "Call to cuMemAlloc results in CUDA_ERROR_OUT_OF_MEMORY"))
    assert is_out_of_memory(torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB"))
    assert not is_out_of_memory(CudaAPIError(700, "CUDA_ERROR_ILLEGAL_ADDRESS"))
    assert not is_out_of_memory(Other("out of memory"))
