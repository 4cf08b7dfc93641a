"""Placing a radiance field by an invertible affine map, so that every ray keeps its optical depth.

With x_world = M x_object + t and a unit world direction d: x_object = M^-1 (x_world - t), v = M^-1 d, the
direction in the object's frame is v/|v|, and σ_world(x, d) = σ_object(x_object) |v| (DESIGN, Conventions).
That is exact for any invertible M; a uniform scale k gives σ_object / k. Matrices are (4, 4) float64; columns
act on points.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from types import ModuleType

import numpy as np
import torch

from fusedrf_cli.engine.composition.crops import NO_CROPS, Crops
from fusedrf_cli.engine.fields.base import RadianceField
from fusedrf_cli.engine.fields.occupancy import OccupancyGrid, seen_placement, squeezed, transformed_aabb
from fusedrf_cli.engine.fields.streamed import look_at_box
from fusedrf_cli.engine.kernels.reference import exact
from fusedrf_cli.engine.spaces import bounded

WHITE = (1.0, 1.0, 1.0)  # the tint that changes nothing
CONDITION_LIMIT = 1e6  # a flatter placement cannot be inverted to float32's accuracy


@dataclass(frozen=True)
class Placed:
    """A field placed in a world frame, as `ComposedField` and `Composite` show it there."""

    name: str
    field: RadianceField
    object_to_world: np.ndarray
    opacity: float = 1.0
    """Its density is multiplied by this."""
    tint: tuple[float, float, float] = WHITE
    """Its colours are multiplied by these, red, green and blue."""
    crops: Crops = NO_CROPS
    """It is empty outside of these, which lie in the object's frame."""

    def __post_init__(self):
        """Raises ValueError for a map that is singular or nearly so."""
        if self.condition > CONDITION_LIMIT:
            raise ValueError(
                f"the placement of '{self.name}' is singular: its condition number is {self.condition:.3g}"
            )

    @cached_property
    def condition(self) -> float:
        """Largest over smallest singular value of the linear part."""
        sizes = np.linalg.svd(self.object_to_world[:3, :3], compute_uv=False)
        return float(sizes[0] / sizes[-1]) if sizes[-1] > 0 else np.inf

    @cached_property
    def world_to_object(self) -> np.ndarray:
        """(4, 4) inverse, in float64."""
        return np.linalg.inv(self.object_to_world)

    @cached_property
    def aabb(self) -> np.ndarray:
        """(6,) world box around the occupied cells that are shown, or, where it fills all of space, around
        the middle of its core."""
        shown = self.occupancy.look_at_box if self.crops else look_at_box(self.field)
        return transformed_aabb(shown, self.object_to_world)

    @property
    def occupancy(self) -> OccupancyGrid:
        """The field's, as far as it is shown."""
        return self.crops.shown(self.field) if self.crops else self.field.occupancy

    @cached_property
    def unbounded(self) -> bool:
        """Whether the field lies in a space without end, and what is shown of it not in a box."""
        return self.occupancy.space is not bounded

    @property
    def space(self) -> ModuleType:
        """That the field lies in."""
        return self.field.occupancy.space

    @property
    def as_it_is(self) -> bool:
        """Whether its density and its colours are the field's own."""
        return self.opacity == 1 and tuple(self.tint) == WHITE and not self.crops

    def reaches(self, box: np.ndarray) -> bool:
        """Whether there may be anything of it in a box (6,) of the world."""
        return self.unbounded or bool((self.aabb[:3] <= box[3:]).all() and (box[:3] <= self.aabb[3:]).all())

    @property
    def voxel_size(self) -> float:
        """The field's finest detail in world units."""
        return self.field.voxel_size * squeezed(self.object_to_world)

    def to_object(
        self, points: torch.Tensor, dirs: torch.Tensor, pose: torch.Tensor | None = None
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """World points and unit dirs (N, 3) to the object's frame: points, unit dirs, and |M^-1 d| (N,); all
        float64 where the device has it. Differentiable, also in another placement `pose` (4, 4), where one is
        given in place of the field's own.
        """
        device = points.device
        if pose is None:
            matrix = exact(self.world_to_object, device)
            linear, shift = matrix[:3, :3], matrix[:3, 3]
        else:
            pose = exact(pose, device)
            linear = torch.linalg.inv(pose[:3, :3])
            shift = -linear @ pose[:3, 3]
        v = exact(dirs, device) @ linear.T
        stretch = v.norm(dim=1)
        return exact(points, device) @ linear.T + shift, v / stretch[:, None], stretch

    def query(
        self, points: torch.Tensor, dirs: torch.Tensor, with_colour: bool = True
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """σ (N,) float64 per unit of the world and rgb (N, 3) float32 at points (N, 3) along unit dirs (N,
        3) of the world. Not differentiable."""
        x, d, stretch = self.to_object(points, dirs)
        sigma, rgb = self.field.query(x, d, with_colour)
        return self.shown(x, sigma.double() * stretch, rgb.float())

    def shown(
        self, x: torch.Tensor, sigma: torch.Tensor, rgb: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Densities (N,) at points (N, 3) of the object's frame times its opacity, 0 outside of its crops,
        and colours (N, 3) times its tint."""
        if self.as_it_is:
            return sigma, rgb
        if self.crops:
            sigma = torch.where(self.crops.holds(x.detach()), sigma, 0)
        return sigma * self.opacity, rgb * rgb.new_tensor(self.tint)

    def moved(self, origin: np.ndarray) -> "Placed":
        """The same placement seen from a frame that lies at `origin`: a position (3,), or a placement (4,
        4)."""
        return replace(self, object_to_world=seen_placement(self.object_to_world, origin))

    def within(self, outer: "Placed") -> "Placed":
        """Itself where the composed scene that it is part of is placed, in the frame of that."""
        return Placed(
            f"{outer.name}/{self.name}",
            self.field,
            outer.object_to_world @ self.object_to_world,
            outer.opacity * self.opacity,
            tuple(np.multiply(outer.tint, self.tint).tolist()),
            self.crops.and_also(outer.crops.within(self.object_to_world)),
        )


def rigid_motion(twist: torch.Tensor) -> torch.Tensor:
    """(4, 4) motion of a twist (6,), differentiable: the turn about the axis twist[:3] by its length in
    radians, and, where there is no turn, the shift twist[3:]; the matrix exponential of se(3)."""
    x, y, z, *shift = twist.unbind()
    zero = torch.zeros_like(x)
    rows = [[zero, -z, y, shift[0]], [z, zero, -x, shift[1]], [-y, x, zero, shift[2]], [zero] * 4]
    motion = torch.linalg.matrix_exp(torch.stack([torch.stack(row) for row in rows]))
    return torch.cat([motion[:3], motion.new_tensor([[0, 0, 0, 1]])])  # not off by a rounding
