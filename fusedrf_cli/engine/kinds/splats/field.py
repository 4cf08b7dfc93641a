"""The `splats` field: Gaussians as 3D Gaussian splatting learns them (Kerbl et al. 2023), read-only, as a
density that depends on the direction (device_functions.py)."""

from collections.abc import Mapping
from functools import cached_property

import numpy as np
import torch

from fusedrf_cli.engine.fields.base import FieldMemory
from fusedrf_cli.engine.fields.box import LINE, checked_box, whole_numbers
from fusedrf_cli.engine.fields.cell_bits import few_cells, packed_bits, unpack_bits
from fusedrf_cli.engine.fields.computed import (
    PER_CELL,
    PER_CELL_MADE,
    ComputedField,
    Reads,
)
from fusedrf_cli.engine.fields.occupancy import OccupancyGrid, cell_counts
from fusedrf_cli.engine.kernels.reference import sh_basis
from fusedrf_cli.engine.kinds.splats import device_functions
from fusedrf_cli.engine.kinds.splats.cells import members_of
from fusedrf_cli.engine.kinds.splats.device_functions import EDGE, MOST_OPAQUE, REACH, ROW, TABLE, Arrays

FAINTEST = 1 / 255  # opacity from which splatting draws
STEPS_PER_CELL = 2
MOST_CELLS = 384
"""Along the longest side."""
PER_SPLAT = 120
"""Cells that a splat may be in, on the mean: with more, cells are made larger."""
MOST_PER_SPLAT, MOST_IN_CELLS = 512, 1 << 29
"""Cells that a splat of a file may be in, on the mean, or all of them together, whichever is more: that 8³
cells have, and what a few large ones that were cut out of many may be in."""

PAIRS = 1 << 22
"""Points times splats of the reference at once."""
ARRAYS = "centres", "scales", "rotations", "opacities", "harmonics"


class SplatsField(ComputedField):
    """N Gaussians: centres (N, 3), standard deviations `scales` (N, 3) along their own axes, which
    `rotations` (N, 4), unit quaternions w x y z, turn to the frame's; opacities (N,) in [0, 1]; harmonics
    (N, K, 3), K 1, 4, 9 or 16, the colour seen along d being max(0, 1/2 + Σ_k Y_k(d) harmonics_k)."""

    kind = "splats"
    device_module = device_functions

    def __init__(
        self,
        centres: np.ndarray,
        scales: np.ndarray,
        rotations: np.ndarray,
        opacities: np.ndarray,
        harmonics: np.ndarray,
        occupancy: OccupancyGrid | None = None,
        cells: OccupancyGrid | None = None,
    ):
        """cells: the grid that tells which splats are where, occupied or not; None: as suits them. occupancy
        None: where there are any. Raises ValueError where splats are in far more cells than they may be."""
        self.centres, self.scales, self.rotations = centres, scales, rotations
        self.opacities, self.harmonics = opacities, harmonics
        self.cells = cells or cells_for(self)
        check_spans(self)
        self.first, self.members = members_of(centres, self.axes, self.extents, self.cells, self.step)
        self.params = torch.from_numpy(rows_of(self))
        held = (np.diff(self.first) > 0).reshape(self.cells.occupied.shape)
        self.occupancy = self.cells.marked(held) if occupancy is None else occupancy

    # -- what the loops read ---------------------------------------------------------------------------------

    def kernel_arrays(self, params: object) -> Arrays:
        """See ComputedField."""
        return Arrays(
            params, np.int64(len(self.centres) * ROW), self.first, self.members, self.cells.aabb[:3].copy(),
            self.cells.cell, np.array(self.cells.occupied.shape, np.int64), self.real.type(self.step),
            ramp_table().astype(self.real),
        )  # fmt: skip

    @property
    def coefficients(self) -> int:
        """SH coefficients per channel."""
        return self.harmonics.shape[1]

    @cached_property
    def axes(self) -> np.ndarray:
        """(N, 3, 3) float64 unit axes of the splats, in rows."""
        from scipy.spatial.transform import Rotation

        turned = Rotation.from_quat(self.rotations.astype(np.float64), scalar_first=True).as_matrix()
        return np.ascontiguousarray(turned.transpose(0, 2, 1))

    @cached_property
    def radius(self) -> np.ndarray:
        """(N,) standard deviations from a splat's centre at which its opacity is FAINTEST; below 0 where it
        never is as much."""
        return np.where(
            self.opacities > FAINTEST, np.sqrt(2 * np.log(np.maximum(self.opacities / FAINTEST, 1))), -1.0
        )

    @cached_property
    def extents(self) -> np.ndarray:
        """(N, 3) how far a splat reaches along its axes, across a ray or along it."""
        return np.where(self.radius > 0, np.maximum(self.radius, REACH), -np.inf)[:, None] * self.scales

    @property
    def step(self) -> float:
        """At which pictures sample it."""
        return float(self.cells.cell.min()) / STEPS_PER_CELL

    @property
    def sampling_step(self) -> float:
        """See fields/base.py."""
        return self.step

    @property
    def voxel_size(self) -> float:
        """See RadianceField."""
        return 2 * self.step

    @property
    def box(self) -> np.ndarray:
        """(6,) that of its cells."""
        return self.cells.aabb

    over_texels = False

    @property
    def resolution(self) -> tuple[int, ...]:
        """Corners of its cells per axis, on which parts of it are cut."""
        return tuple(n + 1 for n in self.cells.occupied.shape)

    @property
    def held(self) -> np.ndarray:
        """(N,) bool: the splats that reach into an occupied cell."""
        at = ((self.occupancy.centres() - self.box[:3]) / self.cells.cell).astype(np.int64)
        last = np.array(self.cells.occupied.shape) - 1
        numbers = np.ravel_multi_index(tuple(np.clip(at, 0, last).T), self.cells.occupied.shape)
        cells = np.zeros(len(self.first) - 1, bool)
        cells[numbers] = True
        held = np.zeros(len(self.centres), bool)
        held[self.members[np.repeat(cells, np.diff(self.first))]] = True
        return held

    def reference(
        self, params: torch.Tensor, points: torch.Tensor, dirs: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """See ComputedField: all splats for every point, of which there may be few at once."""
        count = len(self.centres)
        parts = zip(*(values.split(max(1, PAIRS // count)) for values in (points, dirs)), strict=True)
        if len(points) > max(1, PAIRS // count):
            return tuple(map(torch.cat, zip(*(self.reference(params, *part) for part in parts), strict=True)))
        rows = params[: count * ROW].view(count, ROW)
        colours = params[count * ROW : count * (ROW + 3 * self.coefficients)].view(
            count, self.coefficients, 3
        )
        at, along = points.to(params), dirs.to(params)
        u = torch.einsum("nij,pnj->pni", rows[:, 3:12].view(count, 3, 3), at[:, None] - rows[:, :3])
        v = torch.einsum("nij,pj->pni", rows[:, 3:12].view(count, 3, 3), along)
        length = v.norm(dim=2)
        apart = torch.linalg.cross(u, v).square().sum(2) / length.square()
        s, wide = (u * v).sum(2) / length, self.step * length
        alpha = (rows[:, 12] * torch.exp(-0.5 * apart)).clamp_max(MOST_OPAQUE)
        share = (ramp(s + wide) - 2 * ramp(s) + ramp(s - wide)) / wide
        near = (apart <= rows[:, 13]) & (s.abs() - wide <= REACH)
        sigma = torch.where(near, -torch.log1p(-alpha) * share / self.step, 0)
        basis = sh_basis(self.coefficients, along)
        rgb = (0.5 + torch.einsum("pk,nkc->pnc", basis, colours)).relu()
        total = sigma.sum(1)
        mean = (sigma[..., None] * rgb).sum(1) / total.clamp_min(1e-30)[:, None]
        return total, torch.where((total > 0)[:, None], mean, 0)

    # -- storing ---------------------------------------------------------------------------------------------

    def state(self) -> tuple[dict[str, np.ndarray], dict]:
        """See StoredField. Centres are stored as the bits of their float32, whatever the precision: a step of
        float16 is larger than a splat."""
        arrays = {
            "centres": self.centres.astype(np.float32).view(np.int32), "scales": np.log(self.scales),
            "rotations": self.rotations, "opacities": self.opacities[:, None],
            "harmonics": self.harmonics.reshape(len(self.centres), -1),
        }  # fmt: skip
        cells = {"aabb": self.cells.aabb.tolist(), "counts": list(self.cells.occupied.shape)}
        metadata = {"splats": len(self.centres), "cells": cells}
        as_held = np.array_equal(self.occupancy.occupied.ravel(), np.diff(self.first) > 0)
        if not (as_held and np.array_equal(self.occupancy.aabb, self.box)):
            few = few_cells(sum(array.size for array in arrays.values()))
            packed = packed_bits("occupancy", self.occupancy.occupied, few)
            arrays, metadata = arrays | packed, ({"needs": ["held"]} if len(packed) > 1 else {}) | metadata
            metadata["occupancy"] = {
                "aabb": self.occupancy.aabb.tolist(), "counts": list(self.occupancy.occupied.shape)
            }  # fmt: skip
        return arrays, metadata

    @classmethod
    def needs(cls, metadata: dict, shapes: Mapping[str, tuple[int, ...]], array: Reads) -> FieldMemory:
        """See `Kind.field_memory`."""
        count, numbers = shapes["centres"][0], shapes["harmonics"][1]
        cells = int(np.prod(whole_numbers(metadata["cells"]["counts"], 1, "cells")))
        held = 4 * count * (ROW + 2 * numbers + 11) + 4 * PER_SPLAT * count + (8 + PER_CELL) * cells
        return FieldMemory(held, 200 * count + PER_CELL_MADE * cells)

    @classmethod
    def from_state(cls, arrays: dict[str, np.ndarray], metadata: dict) -> "SplatsField":
        """Inverse of `state`. Raises ValueError, KeyError or TypeError for what does not fit."""
        count = len(arrays["centres"])
        if count == 0 or arrays["centres"].dtype != np.int32:
            raise ValueError("array 'centres' should hold the bits of at least one float32 position")
        shapes = {
            "centres": (count, 3),
            "scales": (count, 3),
            "rotations": (count, 4),
            "opacities": (count, 1),
        }
        for name, shape in shapes.items():
            if arrays[name].shape != shape:
                raise ValueError(
                    f"array '{name}' should have shape {list(shape)}, found {list(arrays[name].shape)}"
                )
        harmonics = arrays["harmonics"]
        if harmonics.ndim != 2 or harmonics.shape[0] != count or harmonics.shape[1] not in (3, 12, 27, 48):
            raise ValueError(f"array 'harmonics' has shape {list(harmonics.shape)} for {count} splats")
        centres = np.ascontiguousarray(arrays["centres"]).view(np.float32)
        scales = np.exp(arrays["scales"].astype(np.float32))
        if not (np.isfinite(centres).all() and np.isfinite(scales).all() and (scales > 0).all()):
            raise ValueError("arrays 'centres' and 'scales' should be finite, and no scale 0")
        rotations = arrays["rotations"].astype(np.float32)
        norms = np.linalg.norm(rotations, axis=1, keepdims=True)
        if not ((norms > 0.5) & (norms < 2)).all():
            raise ValueError("array 'rotations' should hold unit quaternions")
        opacities = np.clip(arrays["opacities"][:, 0].astype(np.float32), 0, 1)
        cells = OccupancyGrid(
            checked_box(metadata["cells"]["aabb"], "cells"),
            np.zeros(checked_counts(metadata["cells"]["counts"]), bool),
        )
        occupancy = None
        if "occupancy" in metadata:
            stored = metadata["occupancy"]
            counts = list(whole_numbers(stored["counts"], 1, "occupancy"))
            occupancy = OccupancyGrid(
                checked_box(stored["aabb"], "occupancy"), unpack_bits(arrays, "occupancy", counts)
            )
        colours = harmonics.astype(np.float32).reshape(count, -1, 3)
        return cls(centres, scales, rotations / norms, opacities, colours, occupancy, cells)


def ramp_table() -> np.ndarray:
    """(TABLE + 1,) Ψ between -EDGE and EDGE."""
    return ramp(torch.linspace(-EDGE, EDGE, TABLE + 1, dtype=torch.float64)).numpy()


def ramp(x: torch.Tensor) -> torch.Tensor:
    """Ψ(x) = x Φ(x) + φ(x)."""
    return x * torch.special.ndtr(x) + torch.exp(-0.5 * x * x) / (2 * torch.pi) ** 0.5


def checked_counts(values: list) -> tuple[int, int, int]:
    """Cells per axis, of a grid that splats are counted in."""
    counts = whole_numbers(values, 1, "cells")
    if max(counts) > 2 * MOST_CELLS:
        raise ValueError(f"cells should be at most {2 * MOST_CELLS} along an axis, found {list(counts)}")
    return counts


def rows_of(field: SplatsField) -> np.ndarray:
    """(P,) the numbers that the loops read."""
    count = len(field.centres)
    rows = np.zeros((count, ROW), np.float32)
    rows[:, :3] = field.centres
    rows[:, 3:12] = (field.axes / field.scales[:, :, None]).reshape(count, 9)
    rows[:, 12] = field.opacities
    rows[:, 13] = np.where(field.radius > 0, field.radius**2, -1)
    size = count * (ROW + 3 * field.coefficients)
    params = np.zeros(-(-size // LINE) * LINE, np.float32)
    params[: rows.size] = rows.reshape(-1)
    params[rows.size : size] = field.harmonics.reshape(-1)
    return params


def boxes_of(field: SplatsField) -> np.ndarray:
    """(N, 6) around each splat as far as it reaches; minima above maxima of one that is never drawn."""
    wide = np.einsum("nka,nk->na", np.abs(field.axes), field.extents)
    return np.concatenate([field.centres - wide, field.centres + wide], 1)


def check_spans(field: SplatsField) -> None:
    """Raise ValueError where splats are in more cells than could be listed in reasonable time and memory."""
    cells = field.cells
    edges = (boxes_of(field)[field.radius > 0].reshape(-1, 2, 3) - cells.aabb[:3]) / cells.cell
    first, last = np.clip(np.floor(edges), 0, np.array(cells.occupied.shape) - 1).transpose(1, 0, 2)
    spanned, most = (last - first + 1).prod(1).sum(), max(MOST_PER_SPLAT * len(edges), MOST_IN_CELLS)
    if spanned > most:
        raise ValueError(f"splats should be in at most {most:,} cells, found {spanned:,.0f}")


def cells_for(field: SplatsField) -> OccupancyGrid:
    """A grid around all splats, whose cells are as fine as lets one be in PER_SPLAT of them on the mean."""
    boxes = boxes_of(field)[field.radius > 0]
    if not len(boxes):
        boxes = np.concatenate([field.centres[:1], field.centres[:1] + field.scales[:1]], 1).astype(
            np.float64
        )
    box = np.concatenate([boxes[:, :3].min(0), boxes[:, 3:].max(0)])
    sides = box[3:] - box[:3]
    box[3:] += np.maximum(1e-3 * sides.max() - sides, 0)
    for longest in (MOST_CELLS, 256, 192, 128, 96, 64, 48, 32, 16, 8):
        counts = cell_counts(box, longest)
        cell = (box[3:] - box[:3]) / counts
        spans = (boxes[:, 3:] - boxes[:, :3]) / cell + 1
        if spans.prod(1).sum() <= PER_SPLAT * len(boxes):
            break
    return OccupancyGrid(box, np.zeros(counts, bool))
