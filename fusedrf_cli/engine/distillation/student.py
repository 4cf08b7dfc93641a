"""A student on a grid while it learns: half its resolution first, and the cells it gives up."""

from fusedrf_cli.engine.distillation.matter import EMPTY_BELOW, depths_across
from fusedrf_cli.engine.fields.base import StoredField
from fusedrf_cli.engine.fields.occupancy import PROBES, OccupancyGrid, harmless_depth

COARSE_FROM = 64  # texels along a student's longest axis from which it starts at half of them
LOST_DEPTH = 5e-3  # optical depth that pruning may take off a ray: opacity to half a percent


def starts_coarse(student: StoredField) -> bool:
    """Whether a student is on one grid large enough to have half its resolution first."""
    return student.resolution is not None and max(student.resolution) >= COARSE_FROM


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
    occupied = depth > harmless_depth(depth, EMPTY_BELOW, LOST_DEPTH)
    kept = grid.marked(occupied).dilated().occupied & grid.occupied
    return grid.marked(kept)
