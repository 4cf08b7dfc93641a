"""How many bytes a field takes in a bundle, told from its shape before its numbers are made."""

import math
from collections.abc import Sequence

import numpy as np

from formats.quantised import BLOCKS, code_bytes, is_coded
from formats.records import BITS, coded_bytes
from formats.scene import SceneGraph, dump_scene, make_node
from fusedrf_cli.engine.composition.trimming import read_texels
from fusedrf_cli.engine.kinds.vm.field import VMShape, VMTensor

HEADER = 512  # of a field: its metadata but for tensors and blocks
HEADER_PER_TENSOR = 2000  # its shape, and 14 arrays' names and offsets
HEADER_PER_PLANE = 250  # of those: as codes and scales
HEADER_PER_BLOCK = 700
BESIDES = 1024  # of a bundle: settings, figures and file headers


def vm_bytes(shape: VMShape, tensors: Sequence[VMTensor], blocks: int, precision: str) -> int:
    """At most so many bytes for a vm field of tensors without unread texels (trimming.py), coded or not."""
    total = HEADER + HEADER_PER_BLOCK * blocks
    for tensor in tensors:
        total += HEADER_PER_TENSOR + tensor.occupancy.occupied.size // 8 + 1
        for name, section in shape.sections(tensor.resolution):
            total += section_bytes(tensor, name, section, precision)
    return total


def section_bytes(tensor: VMTensor, name: str, section: tuple[int, ...], precision: str) -> int:
    """Bytes of one section (TensoRF's planes, lines, basis) of a tensor."""
    most = coded_bytes(section, precision)
    if precision not in BITS or not is_coded(section) or "_plane_" not in name:
        return most
    kept = section[2] * kept_texels(read_texels(tensor, int(name[-1])))
    left_out = code_bytes(int(np.prod(section)), BITS[precision]) - code_bytes(kept, BITS[precision])
    return HEADER_PER_PLANE + most - left_out


def kept_texels(read: np.ndarray) -> int:
    """Texels in those blocks of a plane (na, nb) of which at least one is read: the others have no codes."""
    held, sides = read, []
    for axis, side in enumerate(BLOCKS[3][:2]):
        starts = np.arange(0, read.shape[axis], side)
        held = np.logical_or.reduceat(held, starts, axis=axis)
        sides.append(np.diff(np.append(starts, read.shape[axis])))
    return int(sides[0] @ held @ sides[1])


def graph_bytes(nodes: list[dict]) -> int:
    """At most so many bytes for all of a fused bundle but its field; nodes are those of its history."""
    node = make_node("fused", field=f"fields/{'0' * 16}.safetensors", translation=(math.pi,) * 3)
    return BESIDES + len(dump_scene(SceneGraph((node,), history=({"nodes": nodes},))))
