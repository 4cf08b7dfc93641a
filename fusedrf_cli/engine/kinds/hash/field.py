"""The `hash` field: a hash grid (Instant-NGP, Müller et al. 2022) of which the density is a weighted sum, and
a small network of its numbers and the direction that makes the colour (K-Planes' explicit density,
Fridovich-Keil et al., CVPR 2023, sec. 3.3)."""

from dataclasses import dataclass

import numpy as np

from fusedrf_cli.engine.decoders import density_linear, sh_mlp
from fusedrf_cli.engine.encodings import hash_grid, trunk_features
from fusedrf_cli.engine.fields.assembled import AssembledField, Slot, check_counts
from fusedrf_cli.engine.fields.box import ParameterBlock
from fusedrf_cli.engine.fields.computed import runs_of
from fusedrf_cli.engine.fields.stored_rows import RUN
from fusedrf_cli.engine.kernels.primitives import LINE
from fusedrf_cli.engine.settings import current

ROWS = "density_rows"
BASE = 16  # vertices along an axis of the coarsest level


@dataclass(frozen=True)
class HashConfig:
    """How such a field learns; rates are relative to the optimiser's."""

    rows_rate: float = 2.0
    density_rate: float = 1.0
    network_rate: float = 0.1
    kept: float = 0.6
    """Of the rows, late in learning from photos."""


@dataclass(frozen=True)
class HashShape:
    """Levels of the grid, numbers of a row, vertices along an axis of the finest level and rows of a level at
    most, and the width of the network's hidden layer."""

    levels: int = 8
    features: int = 4
    finest: int = 512
    log2_rows: int = 17
    hidden: int = 32

    def __post_init__(self):
        """Refuse what the kernels were not written for."""
        check_counts(
            self,
            {"levels": (1, 32, 1), "features": (1, 16, 1), "finest": (BASE, 1 << 18, 1),
             "log2_rows": (3, 24, 1), "hidden": (8, 256, 8)},
        )  # fmt: skip

    @property
    def lines_are_runs(self) -> bool:
        """Whether the rows of a run fill cache lines: then they can be left out, and stay so."""
        return RUN * self.features % LINE == 0

    @property
    def grids(self) -> list[dict]:
        """The levels, from the coarsest to the finest."""
        growth = (self.finest / BASE) ** (1 / max(self.levels - 1, 1))
        return hash_grid.levels_of(self.levels, self.log2_rows, BASE, growth)


class HashField(AssembledField):
    """A hash grid over the cube around a box."""

    kind = "hash"
    shape_type = HashShape
    hashed_part = ROWS
    over_texels = False
    few_rows = False
    """Whether rows of 0 stay so when it learns."""

    @classmethod
    def slots_of(cls, shape: HashShape) -> dict[str, Slot]:
        """See AssembledField."""
        config = current(HashConfig)
        rows = {"features": shape.features, "levels": shape.grids, "grows": True}
        width = hash_grid.sizes(**rows)["WIDTH"]
        return {
            "density": Slot(hash_grid, rows, ROWS.removesuffix("rows"), config.rows_rate),
            "colour": Slot(trunk_features, {"outputs": width}),
            "sigma": Slot(density_linear, {"width": width}, "sigma_", config.density_rate),
            "rgb": Slot(sh_mlp, {"width": width, "hidden": shape.hidden}, "rgb_", config.network_rate),
        }

    def lines_learnt(self, part: ParameterBlock) -> np.ndarray | None:
        """See BoxField."""
        if not self.few_rows or part.name != ROWS:
            return None
        lines = self.sections()[ROWS].detach().cpu().view(-1, LINE)
        return LINE * np.flatnonzero(lines.any(1).numpy())

    @classmethod
    def from_state(cls, arrays: dict[str, np.ndarray], metadata: dict) -> "HashField":
        """See BoxField; rows that a file leaves out are not learnt either."""
        field = super().from_state(arrays, metadata)
        field.few_rows = runs_of(ROWS) in arrays and field.shape.lines_are_runs
        return field

    @property
    def used_levels(self) -> list[dict]:
        """Those that its texels do not leave out."""
        levels = self.shape.grids
        return levels[: hash_grid.used_of(self.resolution, levels, True)]

    @property
    def cube(self) -> tuple[np.ndarray, np.ndarray]:
        """See Assembled: the cube at the box's lower corner, as wide as that is on its longest axis."""
        return self.box[:3].copy(), np.full(3, (self.box[3:] - self.box[:3]).max())
