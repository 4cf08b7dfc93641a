"""The protocol every radiance field keeps."""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
import torch

from fusedrf_cli.engine.fields.occupancy import PROBES, OccupancyGrid
from fusedrf_cli.engine.settings import current


@runtime_checkable
class RadianceField(Protocol):
    """A volume that answers how dense, and what colour seen from here."""

    kind: str
    occupancy: OccupancyGrid

    @property
    def aabb(self) -> np.ndarray:
        """(6,) float64 box outside of which the field is empty, in the field's frame."""
        ...

    @property
    def voxel_size(self) -> float:
        """The finest detail the field can hold, in units of its frame; see `sampling_step`."""
        ...

    def query(
        self, points: torch.Tensor, dirs: torch.Tensor, with_colour: bool = True
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """σ (N,) per unit of length and rgb (N, 3) in [0, 1] at points (N, 3), seen along unit dirs (N,
        3)."""
        ...


@dataclass(frozen=True)
class FieldMemory:
    """Bytes of memory that a stored field takes, told by its header: few bytes of a file can say many
    numbers."""

    held: int
    """While it is there, were all of its numbers written."""
    reading: int
    """More, beside its arrays, while it is made of them."""
    unwritten: int = 0
    """Of `held`, pages of zeros that no file has numbers for: they take no memory before they are copied."""

    @property
    def resident(self) -> int:
        """While it is only read."""
        return self.held - self.unwritten


class StoredField(RadianceField, Protocol):
    """A field kind that bundles can hold."""

    def state(self) -> tuple[dict[str, np.ndarray], dict]:
        """Named arrays and JSON-able metadata from which `from_state` makes the field again."""
        ...

    @classmethod
    def from_state(cls, arrays: dict[str, np.ndarray], metadata: dict) -> "StoredField":
        """Inverse of `state`. Raises ValueError naming the array or key that does not fit."""
        ...


def sampling_step(field: RadianceField) -> float:
    """The distance, in the coordinates of its space, at which pictures sample a field; where its grid says
    how far apart samples may lie in which cells, their smallest distance. A field without a grid of its own
    says so itself."""
    if (step := getattr(field, "sampling_step", None)) is not None:
        return step
    grid = field.occupancy
    return grid.unit or grid.space.picture_step(field.voxel_size)


@dataclass(frozen=True)
class SamplingConfig:
    """How many samples a ray may take, and how cells are probed."""

    most_samples: int = 1 << 16
    """Of a ray in a field over one grid: twice as many as one of 8,192 texels a side needs."""
    most_of_bricks: int = 1 << 20
    """The same of bricks: most samples of a ray meet none of them."""
    nothing: float = 1e-4
    """Optical depth through a whole box under which a field shows nothing."""
    probed_at_once: int = 1 << 16


def check_samples(samples: float, what: str, most: int | None = None) -> None:
    """Raise ValueError where a ray would take more samples than `most`, by default `most_samples`: of a box
    that is far thinner, or has far finer texels, along one axis than along another."""
    most = current(SamplingConfig).most_samples if most is None else most
    if not samples <= most:
        raise ValueError(
            f"a ray through {what} would take up to {samples:,.0f} samples, expected at most {most:,}: it is "
            "too thin, or its texels too fine, along one axis"
        )


def is_occupied(field: RadianceField) -> bool:
    """Whether a field is dense enough anywhere to be seen, by asking it in the middle and at eight points of
    every occupied cell."""
    config = current(SamplingConfig)
    grid = field.occupancy
    middles, through = grid.centres(), np.linalg.norm(grid.aabb[3:] - grid.aabb[:3])
    offsets = np.concatenate([np.zeros((1, 3)), PROBES - 0.5]) * grid.cell
    for start in range(0, len(middles), config.probed_at_once):
        for offset in offsets:
            at = torch.from_numpy(middles[start : start + config.probed_at_once] + offset)
            points = grid.space.inv_contract(at)
            sigma, _ = field.query(points, torch.eye(3, dtype=torch.float64)[[0] * len(points)], False)
            if bool((sigma / grid.space.rates(at) * through > config.nothing).any()):
                return True
    return False
