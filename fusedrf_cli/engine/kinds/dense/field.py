"""The `dense` field: a grid of vertices with density and spherical-harmonic colour (Plenoxels, Fridovich-Keil
et al. CVPR 2022; DVGO, Sun et al. CVPR 2022), interpolated before the activation.

Vertices that touch no occupied cell say nothing and are not stored."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch

from fusedrf_cli.engine.fields.box import LINE, BoxField, Part
from fusedrf_cli.engine.fields.computed import Group
from fusedrf_cli.engine.fields.occupancy import OccupancyGrid
from fusedrf_cli.engine.kinds.dense import bodies, reference

DENSITY_RATE, COLOUR_RATE = 60.0, 10.0  # a vertex is touched seldom; slower ones leave haze for long


@dataclass(frozen=True)
class DenseShape:
    """What a vertex holds."""

    sh_degree: int = 1

    def __post_init__(self):
        """Refuse degrees that the kernels were not written for."""
        if self.sh_degree not in range(4):
            raise ValueError(f"'sh_degree' should be 0, 1, 2 or 3, found {self.sh_degree}")

    @property
    def coefficients(self) -> int:
        """SH coefficients per channel."""
        return (self.sh_degree + 1) ** 2

    @property
    def numbers(self) -> int:
        """Numbers of a vertex besides its density."""
        return 3 * self.coefficients

    @property
    def width(self) -> int:
        """Floats of a vertex's row of colour in memory."""
        return -(-self.numbers // 8) * 8


class DenseField(BoxField):
    """Vertices of a grid over one box."""

    kind = "dense"
    bodies = bodies
    shape_type = DenseShape

    @classmethod
    def parts_of(cls, shape: DenseShape, resolution: tuple[int, int, int]) -> list[Part]:
        """See BoxField."""
        density = Part("density", resolution, (0, 1, 2), DENSITY_RATE)
        return [density, Part("colour", (*resolution, shape.width), (0, 1, 2), COLOUR_RATE)]

    def kernel_arrays(self, params: object) -> bodies.Arrays:
        """See ComputedField."""
        return bodies.Arrays(params, int(self.starts[1]), *self.corners, self.activation)

    def reference(self, params: torch.Tensor, points: torch.Tensor, dirs: torch.Tensor):
        """See reference.py."""
        return reference.query(self, params, points, dirs)

    # -- learning: only vertices that are asked -------------------------------------------------------------

    def with_occupancy(self, occupancy: OccupancyGrid) -> "DenseField":
        """See ComputedField."""
        return super().with_occupancy(occupancy)._afresh("lines")

    @cached_property
    def lines(self) -> list[np.ndarray]:
        """Of density and of rows: where the cache lines of the used vertices begin."""
        vertices, width = np.flatnonzero(self.used), self.shape.width
        rows = vertices[:, None] * width + np.arange(0, width, LINE)
        return [np.unique(at // LINE) * LINE for at in (vertices, rows.ravel())]

    def groups(self) -> list[Group]:
        """See ComputedField."""
        density, rows, *rest = super().groups()
        reached = zip((density, rows), self.lines, strict=True)
        return [*(replace(group, lines=group.low + lines) for group, lines in reached), *rest]

    # -- storing: only vertices that are asked --------------------------------------------------------------

    @property
    def used(self) -> np.ndarray:
        """(nx, ny, nz) bool: the vertices of voxels that an occupied cell reaches into."""
        return used_vertices(self.occupancy, self.box, self.resolution)

    def stored_part(self, part: Part) -> tuple[int, ...]:
        """See BoxField: rows of the used vertices, in order."""
        if not part.axes:
            return part.shape
        count = int(np.count_nonzero(self.used))
        return (count,) if len(part.shape) == 3 else (count, self.shape.numbers)

    def pack(self, part: Part, values: torch.Tensor) -> torch.Tensor:
        """See BoxField."""
        if not part.axes:
            return values
        kept = values[torch.from_numpy(self.used)]
        return kept if len(part.shape) == 3 else kept[:, : self.shape.numbers]

    def unpack(self, part: Part, stored: torch.Tensor) -> torch.Tensor:
        """See BoxField; what is not stored is 0."""
        if not part.axes:
            return stored
        whole = torch.zeros(part.shape)
        if len(part.shape) == 4:
            stored = torch.nn.functional.pad(stored, (0, self.shape.width - stored.shape[1]))
        whole[torch.from_numpy(self.used)] = stored
        return whole

    def check_answers(self) -> None:
        """See BoxField."""
        peak = {name: float(view.abs().amax()) for name, view in self.sections().items()}
        self.check_density(peak["density"])
        self.check_logit(3 * self.shape.coefficients * peak["colour"])


def used_vertices(occupancy, box: np.ndarray, resolution: tuple[int, int, int]) -> np.ndarray:
    """(nx, ny, nz) bool: vertices of a grid over a box (6,) within a voxel of an occupied cell."""
    spans = []
    for axis in range(3):
        at = np.linspace(box[axis], box[axis + 3], resolution[axis])
        voxel = (box[axis + 3] - box[axis]) / (resolution[axis] - 1)
        cells = occupancy.occupied.shape[axis]
        place = (np.stack([at - voxel, at + voxel]) - occupancy.aabb[axis]) / occupancy.cell[axis]
        low, high = np.floor(place[0]).astype(int), np.floor(place[1]).astype(int)
        spans.append((np.clip(low, 0, cells), np.clip(high + 1, 0, cells)))
    found = occupancy.occupied
    for axis, (low, high) in enumerate(spans):  # the box of cells around a vertex is a product of three runs
        total = np.concatenate([np.zeros_like(found.take([0], axis), int), np.cumsum(found, axis)], axis)
        found = total.take(high, axis) > total.take(low, axis)
    return found
