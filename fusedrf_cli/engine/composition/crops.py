"""Crops: the boxes and balls outside of which nothing of a placed field is shown.

They are the placement's, as opacity and tint are: a field keeps all its numbers, and is cut exactly, between
two samples of a ray, wherever a crop's face lies.
"""

from dataclasses import dataclass, replace

import numpy as np
import torch

from fusedrf_cli.engine.fields.base import RadianceField
from fusedrf_cli.engine.fields.occupancy import OccupancyConfig, OccupancyGrid, box_corners, mapped
from fusedrf_cli.engine.fields.streamed import grid_of
from fusedrf_cli.engine.kernels.reference import OCTANTS
from fusedrf_cli.engine.settings import current
from fusedrf_cli.engine.spaces import bounded


@dataclass(frozen=True, eq=False)
class Crop:
    """A box or a ball, of any placement."""

    to_unit: np.ndarray
    """(4, 4) from a frame to one in which it is the cube from -1 to 1 on each axis, or the unit ball."""
    is_ball: bool

    @classmethod
    def of(cls, shape: tuple[float, ...], frame_to_shape: np.ndarray) -> "Crop":
        """A box, xmin to zmax, or a ball, its centre and its radius, in a frame that (4, 4) leads to."""
        numbers, scaled = np.array(shape, np.float64), np.eye(4)
        is_ball = len(numbers) == 4
        half = np.repeat(numbers[3], 3) if is_ball else (numbers[3:] - numbers[:3]) / 2
        middle = numbers[:3] if is_ball else (numbers[3:] + numbers[:3]) / 2
        scaled[:3] = np.column_stack([np.diag(1 / half), -middle / half])
        return cls(scaled @ frame_to_shape, is_ball)

    def within(self, matrix: np.ndarray) -> "Crop":
        """The same for an object that lies in this frame by a (4, 4)."""
        return replace(self, to_unit=self.to_unit @ matrix)

    @property
    def aabb(self) -> np.ndarray:
        """(6,) box of the frame around it."""
        back = np.linalg.inv(self.to_unit)
        reach = np.linalg.norm(back[:3, :3], axis=1) if self.is_ball else np.abs(back[:3, :3]).sum(1)
        return np.concatenate([back[:3, 3] - reach, back[:3, 3] + reach])

    def holds(self, points: torch.Tensor) -> torch.Tensor:
        """(N,) bool: which points (N, 3) of the frame lie in it."""
        matrix = torch.from_numpy(self.to_unit).to(points)
        at = points @ matrix[:3, :3].T + matrix[:3, 3]
        return (at.square().sum(1) if self.is_ball else at.abs().amax(1)) <= 1

    def reaches(self, boxes: np.ndarray) -> np.ndarray:
        """(N,) bool: into which boxes (N, 6) of the frame it may reach; into no others it does."""
        middle, half = (boxes[:, 3:] + boxes[:, :3]) / 2, (boxes[:, 3:] - boxes[:, :3]) / 2
        linear, shift = self.to_unit[:3, :3], self.to_unit[:3, 3]
        nearest = np.maximum(np.abs(middle @ linear.T + shift) - half @ np.abs(linear).T, 0)
        return (np.square(nearest).sum(1) if self.is_ball else nearest.max(1)) <= 1


class Crops:
    """All that a placed field is cropped by, in its frame: it is empty outside of any of them."""

    def __init__(self, items: tuple[Crop, ...] = ()):
        self.items = items
        self._shown: tuple[RadianceField, OccupancyGrid] | None = None

    def __bool__(self) -> bool:
        return bool(self.items)

    def within(self, matrix: np.ndarray) -> "Crops":
        """The same for an object that lies in this frame by a (4, 4)."""
        return Crops(tuple(crop.within(matrix) for crop in self.items)) if self else self

    def and_also(self, others: "Crops") -> "Crops":
        """These and others of the same frame."""
        return Crops((*self.items, *others.items)) if others else self

    def holds(self, points: torch.Tensor) -> torch.Tensor:
        """(N,) bool: which points (N, 3) of the frame lie in all of them."""
        held = torch.ones(len(points), dtype=torch.bool, device=points.device)
        for crop in self.items:
            held &= crop.holds(points)
        return held

    def hold(self, points: np.ndarray) -> np.ndarray:
        """`holds` of an array."""
        return self.holds(torch.from_numpy(points)).numpy()

    @property
    def aabb(self) -> np.ndarray:
        """(6,) box of the frame around what lies in all of them; of no size where that is nothing."""
        boxes = np.stack([crop.aabb for crop in self.items])
        low, high = boxes[:, :3].max(0), boxes[:, 3:].min(0)
        return np.concatenate([np.minimum(low, high), high])

    def shown(self, field: RadianceField) -> OccupancyGrid:
        """`cells_of` a field's occupancy, found once, without reading the field where that can be."""
        if self._shown is None or self._shown[0] is not field:
            self._shown = field, self.cells_of(grid_of(field))
        return self._shown[1]

    def cells_of(self, grid: OccupancyGrid) -> OccupancyGrid:
        """A field's occupancy as far as it is shown: the cells that all of them reach into. Where they lie in
        that part of a space without end whose coordinates are those of the frame, it is that of a box."""
        if not self:
            return grid
        around = self.aabb
        index, kept, space = np.argwhere(grid.occupied), np.zeros_like(grid.occupied), grid.space
        low, high = [around[:3]], [around[3:]]
        for part in np.array_split(index, -(-8 * len(index) // current(OccupancyConfig).points_at_once) or 1):
            boxes = frame_boxes(grid, part)
            reached = np.all([crop.reaches(boxes) for crop in self.items], 0)
            kept[tuple(part[reached].T)] = True
            if reached.any():
                low.append(boxes[reached, :3].min(0))
                high.append(boxes[reached, 3:].max(0))
        corners = box_corners(around)
        if space is bounded or np.allclose(mapped(corners, space), corners, rtol=0, atol=1e-12):
            inside = np.concatenate([np.min(low[1:] or low, 0), np.max(high[1:] or high, 0)])
            looked_at = np.concatenate(
                [np.clip(inside[:3], around[:3], around[3:]), np.clip(inside[3:], around[:3], around[3:])]
            )
            return replace(grid, occupied=kept, space=bounded, looked_at=looked_at)
        shown = replace(grid, occupied=kept)
        return replace(shown, looked_at=shown.within(shown.tight_aabb(0)).look_at_box)


NO_CROPS = Crops()


def frame_boxes(grid: OccupancyGrid, index: np.ndarray) -> np.ndarray:
    """(N, 6) boxes of the frame around cells (N, 3) of a grid."""
    low = grid.aabb[:3] + index * grid.cell
    if grid.space is bounded:
        return np.concatenate([low, low + grid.cell], 1)
    corners = (low[:, None] + OCTANTS * grid.cell).reshape(-1, 3)
    corners = grid.space.inv_contract(torch.from_numpy(corners)).numpy().reshape(-1, 8, 3)
    return np.concatenate([corners.min(1), corners.max(1)], 1)
