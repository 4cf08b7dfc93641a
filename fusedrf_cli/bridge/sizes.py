"""How many bytes a field takes in a bundle, told from its shape before its numbers are made, or from them."""

from dataclasses import dataclass

import numpy as np
import torch

from formats.quantised import BLOCKS, code_bytes, is_coded, scales_shape
from formats.records import FieldRecord, decode_field, encode_field
from fusedrf_cli.engine.composition.trimming import read_texels
from fusedrf_cli.engine.fields.vm import VMField, VMShape, VMTensor

BITS = {"int8": 8, "int4": 4}
FLOAT_BYTES = {"float16": 2, "float32": 4}
HEADER = 4096  # of a field: its metadata but for the tensors
HEADER_PER_TENSOR = 3072  # 13 sections' names and offsets, twice where they are coded
HEADER_PER_BLOCK = 512
GRAPH = 4096  # of a bundle: scene graph and file headers but for the history


def vm_bytes(shape: VMShape, tensors: list[VMTensor], blocks: int, precision: str) -> int:
    """At most so many bytes for a vm field of tensors without unread texels (trimming.py), coded or not."""
    total = HEADER + HEADER_PER_BLOCK * blocks
    for tensor in tensors:
        total += HEADER_PER_TENSOR + tensor.occupancy.occupied.size // 8 + 1
        for name, section in shape.sections(tensor.resolution):
            total += section_bytes(tensor, name, section, precision)
    return total


def section_bytes(tensor: VMTensor, name: str, section: tuple[int, ...], precision: str) -> int:
    """Bytes of one section (TensoRF's planes, lines, basis) of a tensor."""
    numbers = int(np.prod(section))
    if precision not in BITS:
        return numbers * FLOAT_BYTES[precision]
    if not is_coded(section):
        return numbers * FLOAT_BYTES["float16"]
    scales = scales_shape(section)
    kept = numbers
    if "_plane_" in name:
        kept = section[2] * kept_texels(read_texels(tensor, int(name[-1])), scales[:2])
    return code_bytes(kept, BITS[precision]) + int(np.prod(scales)) * FLOAT_BYTES["float16"]


def kept_texels(read: np.ndarray, blocks: tuple[int, int]) -> int:
    """Texels in those of the blocks (counts per axis) of a plane (na, nb) of which at least one is read."""
    held, sides = read, []
    for axis, (n, count) in enumerate(zip(read.shape, blocks, strict=True)):
        starts = np.arange(count) * BLOCKS[3][axis]
        held = np.logical_or.reduceat(held, starts, axis=axis)
        sides.append(np.diff(np.append(starts, n)))
    return int(sides[0] @ held @ sides[1])


@dataclass(frozen=True)
class Stored:
    """A field as it will come back from a bundle, and its bytes there."""

    field: VMField
    bytes: int


def stored(field: VMField, precision: str) -> Stored:
    """Write a vm field to bytes and read its numbers back."""
    arrays, metadata = field.state()
    data = encode_field(FieldRecord(field.kind, arrays, metadata), precision)
    read = decode_field(data, "the field as it is stored").arrays
    params = field.params.clone()
    back = VMField(field.shape, field.tensors, field.blocks, params, field.occupancy, field.owners)
    for t in range(len(back.tensors)):
        for name, view in back.sections(t).items():
            view.copy_(torch.from_numpy(read[f"tensor_{t}.{name}"]))
    return Stored(back, len(data))
