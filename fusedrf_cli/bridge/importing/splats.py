"""Gaussian splats (Kerbl et al. 2023) of any format that formats/splats reads."""

import numpy as np

from formats.splats.reading import read_splats
from formats.splats.splats import UP_Z
from fusedrf_cli.bridge.importing.parts import Imported, ImportedNode
from fusedrf_cli.bridge.memory import Memory
from fusedrf_cli.engine.kinds.splats.field import SplatsField
from fusedrf_cli.errors import InvalidInput

PER_SPLAT = 1500
"""Bytes while a field is made of a splat, and written."""


def read(path: str, memory: Memory) -> tuple[Imported, tuple[float, ...] | None]:
    """The field of a file, and which way is up in it where that is not +z. Raises FormatError."""
    splats = read_splats(path)
    if not len(splats):
        raise InvalidInput(f"{path}: holds no splats")
    memory.expect(
        {f"{len(splats):,} splats": float(PER_SPLAT * len(splats))},
        advice="close other programs, or raise --memory",
    )
    numbers = splats.centres, splats.scales, splats.rotations, splats.opacities, splats.harmonics
    field = SplatsField(*(np.ascontiguousarray(values, np.float32) for values in numbers))
    up = None if splats.up == UP_Z else splats.up
    return Imported([ImportedNode(field)], [f"a file of {splats.kind}", *splats.notes]), up
