"""Gaussian splats (Kerbl et al. 2023) of any format that formats/splats reads."""

from collections.abc import Sequence
from contextlib import AbstractContextManager
from pathlib import Path

import numpy as np

from formats.splats.reading import read_splats
from formats.splats.splats import Splats, admitted
from fusedrf_cli.bridge.importing.parts import Imported, ImportedNode
from fusedrf_cli.bridge.memory import Memory
from fusedrf_cli.engine.fields.occupancy import placed_box
from fusedrf_cli.engine.kinds.splats.device_functions import REACH
from fusedrf_cli.engine.kinds.splats.field import SplatsField

PER_SPLAT = 2000
"""Bytes while a field is made of a splat, and written."""
ADVICE = "close other programs, or raise --memory"

MOST_SHELLS = 4
INNER = 0.8
"""Share of the splats around which a box lies; a shell's box is its longest side wider on every side, so that
none of a solid and few of a cloud are left out, and a tenth may lie far away on one side."""
WIDER = 4
"""Times as wide as the former box, up to which all splats are one field: cells for those far away, or as
large as the surroundings, would be too coarse for the others."""


def read(path: Path | str, memory: Memory) -> Imported:
    """The fields of a file. Raises FormatError."""
    memory.expect({"the file": float(Path(path).stat().st_size)}, advice=ADVICE)
    with as_fits(memory):
        splats = read_splats(path)
    return fields_of(splats, notes=[f"it is {splats.kind}"])


def as_fits(memory: Memory) -> AbstractContextManager[None]:
    """Splats read in it are as many as memory has room for. Raises ResourceProblem."""
    return admitted(
        lambda count: memory.expect({f"{count:,} splats": float(PER_SPLAT * count)}, advice=ADVICE)
    )


def fields_of(splats: Splats, placement: np.ndarray | None = None, notes: Sequence[str] = ()) -> Imported:
    """The fields of splats, which `placement` (4, 4) puts into the world that `splats.up` is of."""
    shells = shells_of(boxes_around(splats))
    nodes = [
        ImportedNode(
            field_of(splats, shell),
            np.eye(4) if placement is None else placement,
            suffix=f"-{i + 1}" if len(shells) > 1 else "",
        )
        for i, shell in enumerate(shells)
    ]
    notes, framing = [*notes, *splats.notes], None
    if len(shells) > 1:
        middle = placed_box(nodes[0].field.occupancy.look_at_box, nodes[0].object_to_world)
        framing = tuple(middle.tolist())
        counts = ", ".join(f"{len(shell):,}" for shell in shells)
        notes.append(
            f"it becomes {len(shells)} fields that add up, from the middle outwards: {counts} splats"
        )
    return Imported(nodes, notes, "add", splats.up, framing)


def field_of(splats: Splats, index: np.ndarray) -> SplatsField:
    """Some of the splats as a field."""
    numbers = splats.centres, splats.scales, splats.rotations, splats.opacities, splats.harmonics
    return SplatsField(*(np.ascontiguousarray(values[index], np.float32) for values in numbers))


def boxes_around(splats: Splats) -> np.ndarray:
    """(N, 6) about as far as each splat reaches."""
    wide = REACH * splats.scales.max(1, keepdims=True)
    return np.concatenate([splats.centres - wide, splats.centres + wide], 1).astype(np.float64)


def shells_of(boxes: np.ndarray) -> list[np.ndarray]:
    """The numbers of splats with boxes (N, 6), in shells: each takes those that lie in the box around most
    that are left, and the last one the rest."""
    left, shells = np.arange(len(boxes)), []
    while len(shells) < MOST_SHELLS - 1 and len(left):
        own = boxes[left]
        low, high = np.quantile(own[:, :3], (1 - INNER) / 2, 0), np.quantile(own[:, 3:], (1 + INNER) / 2, 0)
        longest = (high - low).max()
        if (own[:, 3:].max(0) - own[:, :3].min(0)).max() <= WIDER * longest:
            break
        inside = ((own[:, :3] >= low - longest) & (own[:, 3:] <= high + longest)).all(1)
        shells.append(left[inside])
        left = left[~inside]
    return [shell for shell in (*shells, left) if len(shell)]
