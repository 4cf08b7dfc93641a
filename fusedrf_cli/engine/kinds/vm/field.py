"""The `vm` field: vector-matrix decomposed grids (TensoRF, Chen et al. ECCV 2022) with spherical-harmonic
colour, in unbounded scenes with a hash grid for what is finer than the texels.

In files it is one *tensor*, placed by one *block* (SPEC, section 2): other numbers of them are what earlier
versions wrote for several objects, and are read as nodes of the scene graph (formats/blocks.py).
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from math import prod

import numpy as np
import torch

from fusedrf_cli.engine.composition.affine import WHITE
from fusedrf_cli.engine.decoders import density_sum, sh_basis
from fusedrf_cli.engine.encodings import plane_line, plane_line_hash
from fusedrf_cli.engine.encodings.hash_runs import HashGrid
from fusedrf_cli.engine.fields.assembled import AssembledField, RankedShape, Slot
from fusedrf_cli.engine.fields.base import FieldMemory
from fusedrf_cli.engine.fields.box import LINE, checked_box, whole_numbers
from fusedrf_cli.engine.fields.cell_bits import few_cells, packed_bits
from fusedrf_cli.engine.fields.computed import (
    PER_CELL,
    PER_CELL_MADE,
    Reads,
    runs_of,
)
from fusedrf_cli.engine.fields.occupancy import OccupancyGrid
from fusedrf_cli.engine.fields.stored_rows import folded
from fusedrf_cli.engine.settings import current
from fusedrf_cli.engine.spaces import bounded, name_of


@dataclass(frozen=True)
class VMConfig:
    """How a field of planes and lines learns and is stored."""

    basis_rate: float = 0.15
    """Of the factors'; at a third of it, as in TensoRF, a fox after a minute shows 0.5 dB less."""


DETAIL = "density_detail"  # the rows of the hash grid


@dataclass(frozen=True)
class VMShape(RankedShape):
    """Components per mode, and what is finer than the texels."""

    hashed: HashGrid | None = None


class VMField(AssembledField):
    """Planes and lines over one box; its occupancy has the same box."""

    kind = "vm"
    shape_type = VMShape
    hashed_part = DETAIL

    @classmethod
    def slots_of(cls, shape: VMShape) -> dict[str, Slot]:
        """See AssembledField."""
        config = current(VMConfig)
        density, basis = {"rank": shape.density_rank}, {"coefficients": shape.coefficients}
        encoding = plane_line
        if shape.hashed is not None:
            encoding, density = plane_line_hash, density | {"hashed": shape.hashed}
        return {
            "density": Slot(encoding, density, "density_"),
            "colour": Slot(plane_line, {"rank": shape.colour_rank}, "colour_"),
            "sigma": Slot(density_sum),
            "rgb": Slot(sh_basis, {"width": 3 * shape.colour_rank} | basis, "colour_", config.basis_rate),
        }

    @classmethod
    def create(
        cls, shape: VMShape, box: np.ndarray, resolution: tuple[int, int, int], generator: torch.Generator
    ) -> "VMField":
        """See BoxField; the colour basis is uniform as a linear layer's."""
        field = super().create(shape, box, resolution, generator)
        bound = (3 * shape.colour_rank) ** -0.5
        field.basis.uniform_(-bound, bound, generator=generator)
        return field

    def with_occupancy(self, occupancy: OccupancyGrid) -> "VMField":
        """See ComputedField."""
        return super().with_occupancy(replace(occupancy, aabb=self.box))

    @property
    def basis(self) -> torch.Tensor:
        """(3, coefficients, 3 rank) view of the matrix that makes coefficients of colour products."""
        return self.sections()["colour_basis"]

    @property
    def sampling_step(self) -> float:
        """See fields/base.py; where rows are finer than texels, theirs."""
        step = self.space.picture_step(self.voxel_size)
        return step if self.shape.hashed is None else min(step, self.shape.hashed.picture_step)

    # -- storing ---------------------------------------------------------------------------------------------

    @classmethod
    def stored_name(cls, name: str) -> str:
        """See BoxField."""
        return "tensor_0." + ("detail" if name == DETAIL else name)

    def numbers(self) -> dict[str, np.ndarray]:
        """The arrays of numbers that files have, by name; of a hash grid that few cells can ask the rows
        other than 0."""
        own = self.sections().items()
        arrays = {self.stored_name(name): view.detach().cpu().numpy() for name, view in own}
        rows = self.stored_name(DETAIL)
        if rows in arrays:  # as files have always had them, last
            arrays |= folded(rows, arrays.pop(rows))
        return arrays

    def state(self) -> tuple[dict[str, np.ndarray], dict]:
        """See BoxField."""
        arrays = self.numbers()
        hashed, held = self.shape.hashed, runs_of(self.stored_name(DETAIL)) in arrays
        few = 0 if held else few_cells(sum(array.size for array in arrays.values()))
        cells = packed_bits(self.stored_name("occupancy"), self.occupancy.occupied, few)
        needs = {"hashed"} if hashed else set()
        needs |= ({"held", "runs"} if held else set()) | ({"held"} if len(cells) > 1 else set())
        shape = {name: getattr(self.shape, name) for name in ("density_rank", "colour_rank", "sh_degree")}
        tensor = {
            "resolution": list(self.resolution),
            "aabb": self.box.tolist(),
            "scale": self.scale,
            "shift": self.shift,
            "occupancy": list(self.occupancy.occupied.shape),
            **({} if self.space is bounded else {"space": name_of(self.space)}),
        }
        if hashed is not None:
            tensor["hashed"] = {"spacings": list(hashed.spacings), "rows": hashed.rows}
        block = {"tensor": 0, "object_to_field": np.eye(4).tolist(), "name": self.name}
        metadata = {"aabb": self.box.tolist(), "shape": shape, "tensors": [tensor], "blocks": [block]}
        return arrays | cells, ({"needs": sorted(needs)} if needs else {}) | metadata

    @classmethod
    def needs(cls, metadata: dict, shapes: Mapping[str, tuple[int, ...]], array: Reads) -> FieldMemory:
        """See `Kind.field_memory`."""
        own, rows = box_metadata(cls.kind, metadata), cls.stored_name(DETAIL)
        hashed = own["shape"].get("hashed")
        whole = dict(shapes) | ({} if hashed is None else {rows: hashed.shape})  # a file may have few of them
        stored = [shape for name, shape in whole.items() if ".occupancy" not in name]
        numbers = sum(-(-prod(shape) // LINE) * LINE for shape in stored)
        cells = prod(whole_numbers(own["cells"]["counts"], 1, "cells"))
        return FieldMemory(4 * numbers + PER_CELL * cells, PER_CELL_MADE * cells)

    @classmethod
    def stored_occupancy(cls, metadata: dict, arrays: Mapping[str, np.ndarray]) -> OccupancyGrid:
        """See Kind."""
        return cls.stored_cells(box_metadata(cls.kind, metadata)["cells"], arrays)

    @classmethod
    def from_state(cls, arrays: dict[str, np.ndarray], metadata: dict) -> "VMField":
        """See BoxField."""
        field = super().from_state(arrays, box_metadata(cls.kind, metadata))
        field.name = str(metadata["blocks"][0]["name"])
        return field


def box_metadata(kind: str, metadata: dict) -> dict:
    """The metadata of a stored field of one tensor as BoxField's. Raises ValueError where there are several
    tensors, or the one is placed anywhere but in the field's own frame."""
    tensors, blocks = metadata["tensors"], metadata["blocks"]
    if len(tensors) != 1 or len(blocks) != 1 or blocks[0]["tensor"] != 0:
        raise ValueError(
            f"a {kind} field has one tensor and one block of it, found {len(tensors)} and {len(blocks)}: "
            "several are read as nodes of a scene"
        )
    (tensor,), (block,) = tensors, blocks
    if not np.array_equal(block["object_to_field"], np.eye(4)) or tuple(block.get("tint", WHITE)) != WHITE:
        raise ValueError(
            f"block 0 of a {kind} field should place it as it is, without a tint: that is a node's to say"
        )
    aabb = checked_box(tensor["aabb"], "tensor 0: aabb").tolist()
    shape = dict(metadata["shape"])
    if "hashed" in tensor:
        shape["hashed"] = hashed_of(tensor["hashed"], np.asarray(aabb))
    cells = {"aabb": aabb, "counts": tensor["occupancy"], "space": tensor.get("space", "bounded")}
    own = {name: tensor[name] for name in ("resolution", "scale", "shift")}
    return own | {"aabb": aabb, "cells": cells, "shape": shape}


def hashed_of(stored: dict, box: np.ndarray) -> HashGrid:
    """A hash grid as metadata tell it, of a field over a box (6,). Raises ValueError naming what does not
    fit."""
    spacings, rows = stored["spacings"], stored["rows"]
    max_levels, max_rows = 8, 1 << 24
    # along an axis: past it, float32 would not tell where between two a point is
    max_vertex = 1 << 20
    if type(rows) is not int or not 0 < rows <= max_rows or not 1 <= len(spacings) <= max_levels:
        raise ValueError(
            f"a hash grid has 1 to {max_levels} levels of at most {max_rows} rows, found {len(spacings)} of "
            f"{rows}"
        )
    hashed = HashGrid(tuple(float(h) for h in spacings), rows)
    if not np.abs(box).max() <= max_vertex * min(hashed.spacings):
        raise ValueError(
            f"the vertices of a hash grid should be numbered up to {max_vertex}, but its box reaches to "
            f"{np.abs(box).max():g} and its 'spacings' are {list(hashed.spacings)}"
        )
    return hashed
