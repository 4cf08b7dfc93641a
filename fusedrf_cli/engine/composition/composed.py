"""A composed scene: several placed fields that together are one radiance field."""

from functools import cached_property

import numpy as np
import torch

from fusedrf_cli.engine.composition.affine import Placed
from fusedrf_cli.engine.fields.occupancy import OccupancyGrid, placed_occupancy
from fusedrf_cli.engine.fields.vm import OWNERSHIP_CELLS

OCCUPANCY_CELLS = OWNERSHIP_CELLS  # so that a scene and what it is fused to are framed alike
RULES = ("max", "add")


class ComposedField:
    """The naive composition that fusing is measured against: every field is asked at every sample.

    Under `max` (FusedRF, eq. 2) the field with the highest σ gives σ and colour, ties going to the lower
    index; since all share
    the step that is the highest alpha, without the ties that alpha has in float32. Under `add` (D2NeRF) σ =
    Σσ_i and
    c = Σσ_i c_i / Σσ_i. The frame's origin is the scene's centre, `origin` in the world, so that a scene far
    from the world's
    origin loses no digits: world points and ray origins have `origin` subtracted in float64 before they come
    here.
    """

    kind = "composed"

    def __init__(self, placed: list[Placed], rule: str = "max"):
        """Raises ValueError when there is nothing to compose or the rule is unknown."""
        if not placed:
            raise ValueError("a composed scene needs at least one field")
        if rule not in RULES:
            raise ValueError(f"composition should be one of {', '.join(RULES)}, found '{rule}'")
        boxes = np.stack([p.aabb for p in placed])
        self.origin = (boxes[:, :3].min(0) + boxes[:, 3:].max(0)) / 2
        self.placed, self.rule = [p.moved(self.origin) for p in placed], rule

    @cached_property
    def occupancy(self) -> OccupancyGrid:
        """Cells that any placed field's occupied cells reach."""
        grids = [(p.field.occupancy, p.object_to_world) for p in self.placed]
        return placed_occupancy(grids, OCCUPANCY_CELLS)[0]

    @property
    def aabb(self) -> np.ndarray:
        """(6,) box around all fields, in this frame."""
        return self.occupancy.aabb

    @property
    def voxel_size(self) -> float:
        """The finest detail of any placed field, in world units."""
        return min(p.voxel_size for p in self.placed)

    def query(
        self, points: torch.Tensor, dirs: torch.Tensor, with_colour: bool = True
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """σ (N,) and rgb (N, 3) at points (N, 3) along unit dirs (N, 3)."""
        sigmas, owner = self.sigmas(points, dirs)
        # Sums in double, rounded once: single ones would differ in the last bit with the order of the nodes.
        rgb = torch.zeros(len(points), 3, dtype=torch.float64)
        if self.rule == "max":
            sigma = sigmas.amax(0)
            if with_colour:
                for i in range(len(self.placed)):
                    self._shade(i, (owner == i) & (sigma > 0), points, dirs, None, rgb)
            return sigma, rgb.float()
        sigma = sigmas.double().sum(0)
        if with_colour:
            for i in range(len(self.placed)):
                self._shade(i, sigmas[i] > 0, points, dirs, sigmas[i] / sigma.clamp_min(1e-30), rgb)
        return sigma.float(), rgb.float()

    def sigmas(self, points: torch.Tensor, dirs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """(F, N) density of every placed field at points, and (N,) the index of the densest (lowest on a
        tie).
        """
        sigmas = torch.zeros(len(self.placed), len(points))
        for i, placed in enumerate(self.placed):
            inside = self._inside(placed, points)
            if inside.any():
                x, d, stretch = placed.to_object(points[inside], dirs[inside])
                sigmas[i, inside] = (
                    placed.field.query(x, d, with_colour=False)[0].double() * stretch
                ).float()
        return sigmas, sigmas.argmax(0)

    def _inside(self, placed: Placed, points: torch.Tensor) -> torch.Tensor:
        box = torch.from_numpy(placed.aabb)
        return ((points >= box[:3]) & (points <= box[3:])).all(1)

    def _shade(
        self, i: int, mask: torch.Tensor, points: torch.Tensor, dirs: torch.Tensor, share, rgb: torch.Tensor
    ) -> None:
        """Add field i's colour at the masked points, times its share (N,) where one is given."""
        if mask.any():
            x, d, _ = self.placed[i].to_object(points[mask], dirs[mask])
            colour = self.placed[i].field.query(x, d)[1].double()
            rgb[mask] += colour if share is None else colour * share[mask, None]
