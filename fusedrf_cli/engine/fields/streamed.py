"""A field whose numbers stay elsewhere until it is asked, so that many teachers need not be held at once."""

from collections.abc import Callable

import torch

from fusedrf_cli.engine.fields.base import RadianceField


class StreamedField:
    """Answers as the field that `open` returns, which may read it anew each time it is called.

    Of the field itself only what is asked between two readings is kept: its kind, box and finest voxel.
    Everything else, `occupancy` among it, is the opened field's.
    """

    def __init__(self, open: Callable[[], RadianceField]):
        field = open()
        self.open, self.kind, self.aabb, self.voxel_size = open, field.kind, field.aabb, field.voxel_size

    def query(
        self, points: torch.Tensor, dirs: torch.Tensor, with_colour: bool = True
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """As the opened field's."""
        return self.open().query(points, dirs, with_colour)

    @property
    def occupancy(self):
        """The opened field's grid."""
        return self.open().occupancy


def opened(field: RadianceField) -> RadianceField:
    """The field itself, read if need be; hold it no longer than it is used."""
    return field.open() if isinstance(field, StreamedField) else field
