"""A student on a grid while it learns: half its resolution first, and the cells it gives up."""

from fusedrf_cli.engine.distillation.occupancy_update import OccupancyUpdateConfig, depths_across
from fusedrf_cli.engine.fields.base import StoredField
from fusedrf_cli.engine.fields.occupancy import PROBES, OccupancyGrid, harmless_depth
from fusedrf_cli.engine.settings import current


def starts_coarse(student: StoredField, coarse_from: int | None) -> bool:
    """Whether a student is on one grid large enough, in texels, to have half its resolution first."""
    return None not in (student.resolution, coarse_from) and max(student.resolution) >= coarse_from


def halved(student: StoredField) -> StoredField:
    """A student on one grid at half its resolution, over the same occupancy."""
    resolution = tuple((int(n) + 1) // 2 for n in student.resolution)
    return student.resampled(student.aabb, resolution).with_occupancy(student.occupancy)


def resampled_like(student: StoredField, other: StoredField) -> StoredField:
    """A student's numbers at the resolution of another over the same box."""
    return student.resampled(other.aabb, other.resolution).with_occupancy(student.occupancy)


def pruned(student: StoredField) -> OccupancyGrid:
    """The student's occupancy without the cells in which it turned out to hold nothing."""
    grid, depth = student.occupancy, depths_across(student, PROBES)
    lost = 5e-3  # optical depth that pruning may take off a ray: opacity to half a percent
    occupied = depth > harmless_depth(depth, current(OccupancyUpdateConfig).empty_below, lost)
    remaining = grid.marked(occupied).dilated().occupied & grid.occupied
    return grid.marked(remaining)
