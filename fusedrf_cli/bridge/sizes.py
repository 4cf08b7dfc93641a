"""How many bytes a field takes in a bundle, told from its contents before its numbers are made."""

import math
from dataclasses import dataclass

import numpy as np

from formats.bundle import BundleWriter
from formats.quantisation import BLOCKS, code_bytes, is_coded
from formats.records import BITS, BYTES_PER_NUMBER, FieldRecord, coded_bytes
from formats.scene import SceneGraph, dump_scene
from fusedrf_cli.engine.fields.base import StoredField
from fusedrf_cli.engine.kinds.builder import Contents, Section
from fusedrf_cli.engine.settings import current


@dataclass(frozen=True)
class HeaderConfig:
    """Bytes of a bundle beside the numbers of its fields."""

    field: int = 512
    """Of a field: its metadata but for arrays, parts and placements."""
    per_part: int = 2000
    """Of a part: its shape, and some 14 arrays' names and offsets."""
    per_array: int = 150
    per_coded: int = 250
    """More where an array is codes and scales."""
    per_placement: int = 700
    besides: int = 1024
    """Of a bundle: settings, figures and file headers."""


class BundleSizes:
    """Bytes of a field in a bundle (engine/kinds/builder.py: StoredSizes)."""

    def of(self, contents: Contents, precision: str) -> int:
        """At most so many bytes for a field of those contents."""
        config = current(HeaderConfig)
        headers = max(config.per_part * contents.parts, config.per_array * len(contents.sections))
        total = config.field + headers + config.per_placement * contents.placements + contents.bits // 8
        return total + sum(section_bytes(section, precision) for section in contents.sections)

    def exactly(self, field: StoredField, precision: str) -> int:
        """The bytes of a field, encoded, with what it shares with others."""
        writer = BundleWriter()
        writer.add_field(FieldRecord(field.kind, *field.state()), precision)
        return sum(map(len, writer.members.values()))

    def per_number(self, precision: str) -> float:
        """About so many bytes for a number."""
        return BYTES_PER_NUMBER[precision]


def section_bytes(section: Section, precision: str) -> int:
    """At most so many bytes for one array: blocks of numbers of which none is used have no codes."""
    most = coded_bytes(section.shape, precision)
    if precision not in BITS or not is_coded(section.shape):
        return most
    most += current(HeaderConfig).per_coded
    if section.used is None or len(section.shape) != 3:
        return most
    numbers = section.shape[2] * stored_texels(section.used)
    left_out = code_bytes(math.prod(section.shape), BITS[precision]) - code_bytes(numbers, BITS[precision])
    return most - left_out


def stored_texels(used: np.ndarray) -> int:
    """Texels in those blocks of a plane (na, nb) of which at least one is used: the others have no codes."""
    blocks, sides = used, []
    for axis, side in enumerate(BLOCKS[3][:2]):
        starts = np.arange(0, used.shape[axis], side)
        blocks = np.logical_or.reduceat(blocks, starts, axis=axis)
        sides.append(np.diff(np.append(starts, used.shape[axis])))
    return int(sides[0] @ blocks @ sides[1])


def graph_bytes(scene: SceneGraph) -> int:
    """At most so many bytes for all of a bundle but its fields, whose nodes and history are those of a
    scene."""
    return current(HeaderConfig).besides + len(dump_scene(scene))


def camera_bytes(cameras: dict | None) -> int:
    """About so many bytes of a bundle for the cameras that it keeps, a little more than they take."""
    return 0 if cameras is None else len(dump_scene(SceneGraph((), cameras=cameras)))
