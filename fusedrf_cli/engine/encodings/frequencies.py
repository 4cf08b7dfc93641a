"""Frequencies: with x the point in [-1, 1]³ of the box, x and sin(2^l x), cos(2^l x) for l < COUNT (NeRF,
Mildenhall et al., ECCV 2020, eq. 4, without its π, as its code has it), filled up to a run of eight. With
`frame` x is the point in the coordinates of the field's space, as files of NeRFs have it."""

import math

import msgspec
import torch

from fusedrf_cli.engine.fields.part_options import Frequencies


class Options(msgspec.Struct, forbid_unknown_fields=True):
    """See encodings."""

    count: Frequencies
    frame: bool = False


def sizes(count: int, frame: bool = False) -> dict[str, int]:
    """See encodings."""
    width = -(-(3 + 6 * count) // 8) * 8
    return {"COUNT": count, "NUMBERS": 3 + 6 * count, "WIDTH": width, "FRAME": int(frame)}


def reference(
    field, sections: dict, unit: torch.Tensor, read: None, count: int, frame: bool = False
) -> torch.Tensor:
    """See encodings."""
    x = 2 * unit - 1
    if frame:
        box = torch.as_tensor(field.box).to(unit)
        x = box[:3] + unit * (box[3:] - box[:3])
    waves = [wave(2.0**level * x) for level in range(count) for wave in (torch.sin, torch.cos)]
    filled = x.new_zeros(len(x), sizes(count)["WIDTH"] - 3 - 6 * count)
    return torch.cat([x, *waves, filled], 1)


def bound(sections: dict, read: None, count: int, frame: bool = False) -> torch.Tensor:
    """See encodings; of a point of the cube."""
    return torch.ones(sizes(count)["WIDTH"], dtype=torch.float64)


# -- compiled ------------------------------------------------------------------------------------------------


def forward(field, unit, scratch, out, base):
    """See encodings."""
    for axis in range(3):
        u = unit[0] if axis == 0 else (unit[1] if axis == 1 else unit[2])
        x = field.lo[axis] + u * field.side[axis] if FRAME else 2.0 * u - 1.0
        out[base + axis] = x
        sin, cos = math.sin(x), math.cos(x)
        for level in range(COUNT):
            out[base + 3 + 6 * level + axis] = sin
            out[base + 6 + 6 * level + axis] = cos
            sin, cos = 2 * sin * cos, 1 - 2 * sin * sin  # of twice the angle, in float64
    for r in range(NUMBERS, WIDTH):
        out[base + r] = 0


def backward(field, unit, d, base, scratch, grad):
    """Nothing is learnt."""
