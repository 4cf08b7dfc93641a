"""The VM student of a distillation: how it begins, its resolutions, and the cells it gives up."""

import numpy as np
import torch

from fusedrf_cli.engine.composition.affine import Placed
from fusedrf_cli.engine.composition.blocks import reshaped
from fusedrf_cli.engine.distillation.fit import EMPTY_BELOW, texels
from fusedrf_cli.engine.distillation.settings import DistillSettings
from fusedrf_cli.engine.fields.base import RadianceField
from fusedrf_cli.engine.fields.occupancy import OccupancyGrid, harmless_depth
from fusedrf_cli.engine.kinds.vm.field import PROBES, Block, VMField, VMShape, VMTensor

COARSE_FROM = 64  # texels along a student's longest axis from which it starts at half of them
LOST_DEPTH = 5e-3  # optical depth that pruning may take off a ray: opacity to half a percent


def starts_coarse(student: RadianceField) -> bool:
    """Whether a student is one VM tensor large enough to have half its resolution first."""
    single = type(student) is VMField and len(student.blocks) == 1
    return single and max(student.tensors[0].resolution) >= COARSE_FROM


def resolution_for(aabb: np.ndarray, finest: float, shape: VMShape, max_numbers: int) -> tuple[int, int, int]:
    """Texels per axis: voxels no finer than the teachers' own, and no more numbers than allowed."""
    longest = int(np.ceil((aabb[3:] - aabb[:3]).max() / finest)) + 1
    while longest > 16 and shape.size(texels(aabb, longest)) > max_numbers:
        longest -= max(1, longest // 100)
    return texels(aabb, longest)


def empty_student(
    teacher: RadianceField, settings: DistillSettings, generator: torch.Generator, name: str
) -> VMField:
    """An untrained student over the teacher's box, whose occupancy is the teacher's."""
    box = teacher.occupancy.aabb
    resolution = resolution_for(box, teacher.voxel_size, settings.shape, settings.max_numbers)
    student = VMField.create(box, resolution, settings.shape, generator, name)
    return student.with_occupancy(teacher.occupancy)


def student_from(
    background: Placed, teacher: RadianceField, settings: DistillSettings, generator: torch.Generator
) -> VMField | None:
    """A student over the teacher's box that starts as the background (FusedRF §3), or None where that cannot
    be taken over.

    A VM decomposition follows its axes, so the background must be placed upright: moved and uniformly scaled
    only.
    """
    linear = background.object_to_world[:3, :3]
    scale = linear[0, 0]
    if type(background.field) is not VMField or len(background.field.blocks) != 1 or scale <= 0:
        return None
    if not np.allclose(linear, scale * np.eye(3), atol=1e-9 * scale):
        return None
    source = background.field.tensors[0]
    placed_box = source.aabb * scale + np.tile(background.object_to_world[:3, 3], 2)
    tensor = VMTensor(source.resolution, placed_box, source.scale / scale, source.shift)
    moved = VMField(
        background.field.shape,
        (tensor,),
        (Block(0, np.eye(4), "fused"),),
        background.field.params,
        OccupancyGrid.full(placed_box),
    )
    shape = VMShape(
        *(max(a, b) for a, b in zip(vars(moved.shape).values(), vars(settings.shape).values(), strict=True))
    )
    box = teacher.occupancy.aabb
    resolution = resolution_for(box, teacher.voxel_size, shape, settings.max_numbers)
    student = reshaped(moved, shape).resampled(box, resolution).with_occupancy(teacher.occupancy)
    wake(student, generator)
    return student


def halved(student: VMField) -> VMField:
    """A one-block student at half its resolution, over the same occupancy."""
    resolution = tuple((n + 1) // 2 for n in student.tensors[0].resolution)
    return student.resampled(student.tensors[0].aabb, resolution).with_occupancy(student.occupancy)


def resampled_like(student: VMField, other: VMField) -> VMField:
    """A one-block student's numbers at the resolution of another over the same box."""
    tensor = other.tensors[0]
    return student.resampled(tensor.aabb, tensor.resolution).with_occupancy(student.occupancy)


def wake(student: VMField, generator: torch.Generator) -> None:
    """Small noise on every factor: where plane and line are both 0 the gradient of their product is too, for
    ever.
    """
    for name, section in student.sections(0).items():
        if name != "colour_basis":
            section += 0.03 * torch.randn(section.shape, generator=generator)


def pruned(student: VMField) -> OccupancyGrid:
    """The student's occupancy without the cells in which it turned out to hold nothing."""
    grid = student.occupancy
    cells = np.argwhere(grid.occupied)
    sigma = student.peaks(grid.aabb[:3], grid.cell, cells, PROBES)
    depth = np.zeros(grid.occupied.shape, np.float32)
    depth[tuple(cells.T)] = sigma * grid.cell.min()
    occupied = depth > harmless_depth(depth, EMPTY_BELOW, LOST_DEPTH)
    kept = OccupancyGrid(grid.aabb, occupied).dilated().occupied & grid.occupied
    return OccupancyGrid(grid.aabb, kept)
