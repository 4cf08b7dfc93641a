"""A field whose numbers stay elsewhere until it is asked, so that many teachers need not be held at once."""

from collections.abc import Callable
from functools import cached_property

import numpy as np
import torch

from fusedrf_cli.engine.fields.base import RadianceField
from fusedrf_cli.engine.fields.occupancy import OccupancyGrid


class StreamedField:
    """Answers as the field that `open` returns, which may read it anew each time it is called.

    Of the field itself only what is asked between two readings is kept: its kind, box and finest voxel.
    Everything else, `occupancy` among it, is the opened field's.
    """

    def __init__(
        self, open: Callable[[], RadianceField], grid: Callable[[], OccupancyGrid | None] = lambda: None
    ):
        """grid: reads the field's occupancy without it, or None."""
        self.open, self._grid = open, grid

    @cached_property
    def kept(self) -> tuple[str, np.ndarray, float]:
        """Its kind, box (6,) and finest voxel, for which it is opened once."""
        field = self.open()
        return field.kind, field.aabb, field.voxel_size

    @property
    def kind(self) -> str:
        """The opened field's."""
        return self.kept[0]

    @property
    def aabb(self) -> np.ndarray:
        """(6,) the opened field's."""
        return self.kept[1]

    @property
    def voxel_size(self) -> float:
        """The opened field's."""
        return self.kept[2]

    @cached_property
    def look_at_box(self) -> np.ndarray:
        """(6,) that of its `grid`."""
        return self.grid.look_at_box

    def query(
        self, points: torch.Tensor, dirs: torch.Tensor, with_colour: bool = True
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """As the opened field's."""
        return self.open().query(points, dirs, with_colour)

    @property
    def grid(self) -> OccupancyGrid:
        """The opened field's, for which it is not opened where that can be read without it."""
        return self._grid() or self.occupancy

    @property
    def occupancy(self) -> OccupancyGrid:
        """The opened field's grid."""
        return self.open().occupancy


def opened(field: RadianceField) -> RadianceField:
    """The field itself, read if need be; hold it no longer than it is used."""
    return field.open() if isinstance(field, StreamedField) else field


def grid_of(field: RadianceField) -> OccupancyGrid:
    """The occupancy of a field, read without the field where that can be."""
    return field.grid if isinstance(field, StreamedField) else field.occupancy


def look_at_box(field: RadianceField) -> np.ndarray:
    """(6,) `OccupancyGrid.look_at_box` of a field."""
    return field.look_at_box if isinstance(field, StreamedField) else field.occupancy.look_at_box
