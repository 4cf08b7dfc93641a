"""Frequencies of a point of the field's frame that a network moves, and of further coordinates that another
gives it: a scene that moves at one time, by its warp and its sheet through hyperspace (HyperNeRF, Park et
al., SIGGRAPH Asia 2021, sec. 4; D²NeRF, Wu et al., NeurIPS 2022).

The frequencies of p are e(p) = [p, sin p, cos p, sin 2p, cos 2p, ..]. Of e(p) the warp makes w and v, and p'
lies where the twist (w, v) takes p: R p + V v with R = exp [w]ₓ (Lynch and Park, Modern Robotics, 2017, eq.
3.88). The sheet makes `coordinates` numbers h. The features are e(p), where `still` asks for it, e(p'), and
sin h, cos h, sin 2h, cos 2h, .., filled up to a run of eight.

A code of the time, which networks read beside e(p), is the same everywhere: an importer makes a bias of it.
"""

import math
from typing import Annotated, NamedTuple

import msgspec
import numpy as np
import torch
from msgspec import Meta

from fusedrf_cli.engine.fields.box import ParameterBlock
from fusedrf_cli.engine.fields.part_options import Frequencies, Layers, Width
from fusedrf_cli.engine.kernels.networks import network, network_backward

TWIST = 8
"""Outputs of the warp: w, v and two unused."""


class Network(msgspec.Struct, forbid_unknown_fields=True):
    """What moves a point, or gives it coordinates."""

    count: Frequencies
    hidden: Width
    layers: Layers = 1
    skip: Annotated[int, Meta(ge=0, le=15)] = 0

    def __post_init__(self):
        """The first layer reads the input, and there is no other to skip to than the rest."""
        if self.skip >= self.layers:
            raise ValueError(f"'skip' should be a layer behind the first, found {self.skip} of {self.layers}")


class Options(msgspec.Struct, forbid_unknown_fields=True):
    """See encodings."""

    count: Frequencies
    warp: Network
    sheet: Network
    coordinates: Annotated[int, Meta(ge=1, le=64)]
    coordinate_count: Frequencies = 1
    still: bool = False


class Arrays(NamedTuple):
    """What the functions read beside `params`."""

    warp: object  # int64, where each layer of the warp begins, as kernels/networks.py has them
    sheet: object  # the same of the sheet


def sizes(
    count: int, warp: dict, sheet: dict, coordinates: int, coordinate_count: int = 1, still: bool = False
) -> dict[str, int]:
    """See encodings; scratch holds e(p), what both networks' layers and outputs are, and the gradients of
    outputs, of two layers and, twice, of an input."""
    most, hidden = max(count, warp["count"], sheet["count"]), max(warp["hidden"], sheet["hidden"])
    moved = (3 + 6 * count) * still
    own = moved + 3 + 6 * count
    numbers = own + 2 * coordinates * coordinate_count
    sheet_outputs = -(-coordinates // 8) * 8
    rooms = {
        "E": 3 + 6 * most, "WARP_H": warp["layers"] * warp["hidden"], "TWISTED": TWIST,
        "SHEET_H": sheet["layers"] * sheet["hidden"], "SHEETED": sheet_outputs,
        "D_OUT": max(TWIST, sheet_outputs), "D_H": hidden, "D_BEFORE": hidden, "D_E": 2 * (3 + 6 * most),
    }  # fmt: skip
    starts = np.cumsum([0, *rooms.values()]).tolist()
    return {
        "COUNT": count, "MOST": most, "COORDINATES": coordinates, "COORDINATE_COUNT": coordinate_count,
        "STILL": int(still), "MOVED": moved, "OWN": own, "NUMBERS": numbers, "WIDTH": -(-numbers // 8) * 8,
        "WARP_INPUTS": 3 + 6 * warp["count"], "WARP_HIDDEN": warp["hidden"], "WARP_LAYERS": warp["layers"],
        "WARP_SKIP": warp["skip"], "SHEET_INPUTS": 3 + 6 * sheet["count"], "SHEET_HIDDEN": sheet["hidden"],
        "SHEET_LAYERS": sheet["layers"], "SHEET_SKIP": sheet["skip"], "SHEET_OUTPUTS": sheet_outputs,
        **dict(zip(rooms, starts, strict=False)), "ROOM": starts[-1],
    }  # fmt: skip


def network_sections(
    name: str, outputs: int, count: int, hidden: int, layers: int, skip: int
) -> list[ParameterBlock]:
    """(inputs, outputs) of each layer of a network, whose bias is the last row of its array, and those by
    which one reads the input again. Points are moved little at first."""
    inputs = 3 + 6 * count
    shapes = [(inputs, hidden), *[(hidden, hidden)] * (layers - 1), (hidden, outputs)]
    blocks = [
        ParameterBlock(f"{name}_layer_{i}", (n + 1, m), spread=(2 / n) ** 0.5 if i < layers else 1e-2)
        for i, (n, m) in enumerate(shapes)
    ]
    again = ParameterBlock(f"{name}_again", (inputs, hidden), spread=(2 / inputs) ** 0.5)
    return blocks + [again] * (skip > 0)


def sections(resolution: tuple, warp: dict, sheet: dict, coordinates: int, **options) -> list[ParameterBlock]:
    """See encodings."""
    outputs = -(-coordinates // 8) * 8
    return network_sections("warp", TWIST, **warp) + network_sections("sheet", outputs, **sheet)


def arrays(field, starts: np.ndarray, warp: dict, **options) -> Arrays:
    """See encodings."""
    of_warp = warp["layers"] + 1 + (warp["skip"] > 0)
    return Arrays(starts[:of_warp], starts[of_warp:])


def waves_of(x: torch.Tensor, count: int) -> torch.Tensor:
    """e of points (N, 3)."""
    waves = [wave(2.0**level * x) for level in range(count) for wave in (torch.sin, torch.cos)]
    return torch.cat([x, *waves], 1)


def evaluated(
    name: str, sections: dict, e: torch.Tensor, count: int, hidden: int, layers: int, skip: int
) -> torch.Tensor:
    """What a network makes of e (N, ..)."""
    e = e[:, : 3 + 6 * count]
    h = e
    for i in range(layers + 1):
        layer = sections[f"{name}_layer_{i}"]
        h = h @ layer[:-1] + layer[-1]
        if skip and i == skip:
            h = h + e @ sections[f"{name}_again"]
        h = h.relu() if i < layers else h
    return h


def moved_by(x: torch.Tensor, w: torch.Tensor, v: torch.Tensor) -> torch.Tensor:
    """Points (N, 3) moved by twists w, v (N, 3)."""
    t = (w * w).sum(1, keepdim=True)
    near = t < 1e-2
    u = torch.where(near, 1, t)
    angle = u.sqrt()
    a = torch.where(near, 1 - t / 6 + t**2 / 120 - t**3 / 5040, angle.sin() / angle)
    b = torch.where(near, 1 / 2 - t / 24 + t**2 / 720 - t**3 / 40320, (1 - angle.cos()) / u)
    c = torch.where(near, 1 / 6 - t / 120 + t**2 / 5040 - t**3 / 362880, (1 - angle.sin() / angle) / u)
    wx, wv = torch.linalg.cross(w, x), torch.linalg.cross(w, v)
    return x + v + a * wx + b * (torch.linalg.cross(w, wx) + wv) + c * torch.linalg.cross(w, wv)


def reference(
    field, sections: dict, unit: torch.Tensor, read: None, count: int, warp: dict, sheet: dict,
    coordinates: int, coordinate_count: int = 1, still: bool = False,
) -> torch.Tensor:  # fmt: skip
    """See encodings."""
    box = torch.as_tensor(field.box).to(unit)
    x = box[:3] + unit * (box[3:] - box[:3])
    e = waves_of(x, max(count, warp["count"], sheet["count"]))
    twist = evaluated("warp", sections, e, **warp)
    h = evaluated("sheet", sections, e, **sheet)[:, :coordinates]
    more = [wave(2.0**level * h) for level in range(coordinate_count) for wave in (torch.sin, torch.cos)]
    own = [e[:, : 3 + 6 * count]] if still else []
    made = torch.cat([*own, waves_of(moved_by(x, twist[:, :3], twist[:, 3:6]), count), *more], 1)
    return torch.nn.functional.pad(made, (0, -made.shape[1] % 8))


def bound_within(
    reach: float, sections: dict, count: int, warp: dict, sheet: dict, coordinates: int,
    coordinate_count: int = 1, still: bool = False,
) -> torch.Tensor:  # fmt: skip
    """See encodings; a twist moves no point farther than by its v, but for turning it around 0."""
    largest = {name: view.abs().double() for name, view in sections.items()}
    e = torch.ones(1, 3 + 6 * warp["count"], dtype=torch.float64)
    e[:, :3] = reach
    speed = evaluated("warp", largest, e, **warp)[0, 3:6].norm()
    features = torch.ones(sizes(count, warp, sheet, coordinates, coordinate_count, still)["WIDTH"]).double()
    features[:3] = reach
    start = (3 + 6 * count) * still
    features[start : start + 3] = 3**0.5 * reach + speed
    return features


# -- compiled ------------------------------------------------------------------------------------------------


def waves(x, count, out, base):
    """e of a point of the frame into out[base:]."""
    for axis in range(3):
        p = x[0] if axis == 0 else (x[1] if axis == 1 else x[2])
        out[base + axis] = p
        for level in range(count):
            out[base + 3 + 6 * level + axis] = math.sin(p * (1 << level))
            out[base + 6 + 6 * level + axis] = math.cos(p * (1 << level))


def waves_backward(x, d, base, axis):
    """The gradient of a point along an axis, of what `waves` made of it."""
    p = x[0] if axis == 0 else (x[1] if axis == 1 else x[2])
    total = float(d[base + axis])
    for level in range(COUNT):
        sin, cos = math.sin(p * (1 << level)), math.cos(p * (1 << level))
        sent = d[base + 3 + 6 * level + axis] * cos - d[base + 6 + 6 * level + axis] * sin
        total += sent * (1 << level)
    return total


def cross(a, b):
    """a × b."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def inner(a, b):
    """a · b."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def shares_of(t):
    """sin θ/θ, (1 - cos θ)/θ² and (θ - sin θ)/θ³ for t = θ²."""
    if t < 1e-2:
        return (
            1.0 - t / 6.0 + t * t / 120.0 - t * t * t / 5040.0,
            0.5 - t / 24.0 + t * t / 720.0 - t * t * t / 40320.0,
            1.0 / 6.0 - t / 120.0 + t * t / 5040.0 - t * t * t / 362880.0,
        )
    angle = math.sqrt(t)
    a = math.sin(angle) / angle
    return a, (1.0 - math.cos(angle)) / t, (1.0 - a) / t


def slopes_of(t):
    """The derivatives by θ of `shares_of`, over θ."""
    if t < 1e-2:
        return (
            -1.0 / 3.0 + t / 30.0 - t * t / 840.0,
            -1.0 / 12.0 + t / 180.0 - t * t / 6720.0,
            -1.0 / 60.0 + t / 1260.0 - t * t / 60480.0,
        )
    a, b, c = shares_of(t)
    return (math.cos(math.sqrt(t)) - a) / t, (a - 2.0 * b) / t, (b - 3.0 * c) / t


def place(field, unit):
    """The point in the field's frame."""
    return (
        field.lo[0] + unit[0] * field.side[0],
        field.lo[1] + unit[1] * field.side[1],
        field.lo[2] + unit[2] * field.side[2],
    )


def twist(field, x, scratch):
    """(w, v) of a point of the frame; e of it is left in scratch."""
    waves(x, MOST, scratch, AT + E)
    network(
        WARP_INPUTS, WARP_HIDDEN, WARP_LAYERS, WARP_SKIP, 8, field.params, field.warp, scratch,
        np.uint64(AT + E), np.uint64(AT + WARP_H), np.uint64(AT + TWISTED),
    )  # fmt: skip
    at = AT + TWISTED
    w = float(scratch[at]), float(scratch[at + 1]), float(scratch[at + 2])
    return w, (float(scratch[at + 3]), float(scratch[at + 4]), float(scratch[at + 5]))


def moved(x, w, v):
    """Where a twist takes a point."""
    a, b, c = shares_of(inner(w, w))
    wx, wv = cross(w, x), cross(w, v)
    wwx, wwv = cross(w, wx), cross(w, wv)
    return (
        x[0] + v[0] + a * wx[0] + b * (wwx[0] + wv[0]) + c * wwv[0],
        x[1] + v[1] + a * wx[1] + b * (wwx[1] + wv[1]) + c * wwv[1],
        x[2] + v[2] + a * wx[2] + b * (wwx[2] + wv[2]) + c * wwv[2],
    )


def sheet_of(field, scratch):
    """The coordinates of the point of which e is in scratch, into scratch[AT + SHEETED:]."""
    network(
        SHEET_INPUTS, SHEET_HIDDEN, SHEET_LAYERS, SHEET_SKIP, SHEET_OUTPUTS, field.params, field.sheet,
        scratch, np.uint64(AT + E), np.uint64(AT + SHEET_H), np.uint64(AT + SHEETED),
    )  # fmt: skip


def forward(field, unit, scratch, out, base):
    """See encodings."""
    x = place(field, unit)
    w, v = twist(field, x, scratch)
    sheet_of(field, scratch)
    for r in range(MOVED):
        out[base + r] = scratch[AT + E + r]
    waves(moved(x, w, v), COUNT, out, base + MOVED)
    for level in range(COORDINATE_COUNT):
        at = base + OWN + 2 * level * COORDINATES
        for j in range(COORDINATES):
            h = float(scratch[AT + SHEETED + j]) * (1 << level)
            out[at + j], out[at + COORDINATES + j] = math.sin(h), math.cos(h)
    for r in range(NUMBERS, WIDTH):
        out[base + r] = 0


def backward(field, unit, d, base, scratch, grad):
    """See encodings."""
    x, d_out = place(field, unit), AT + D_OUT
    w, v = twist(field, x, scratch)
    y = moved(x, w, v)
    g = (
        waves_backward(y, d, base + MOVED, 0),
        waves_backward(y, d, base + MOVED, 1),
        waves_backward(y, d, base + MOVED, 2),
    )
    d_w, d_v = moved_backward(x, w, v, g)
    for axis in range(3):
        scratch[d_out + axis] = d_w[0] if axis == 0 else (d_w[1] if axis == 1 else d_w[2])
        scratch[d_out + 3 + axis] = d_v[0] if axis == 0 else (d_v[1] if axis == 1 else d_v[2])
    scratch[d_out + 6], scratch[d_out + 7] = 0, 0
    network_backward(
        WARP_INPUTS, WARP_HIDDEN, WARP_LAYERS, WARP_SKIP, 8, field.params, field.warp, scratch,
        np.uint64(AT + E), np.uint64(AT + WARP_H), scratch, np.uint64(d_out), np.uint64(AT + D_H),
        np.uint64(AT + D_BEFORE), np.uint64(AT + D_E), grad,
    )  # fmt: skip
    sheet_backward(field, d, base, scratch, grad)


def moved_backward(x, w, v, g):
    """The gradients of w and v, of g at `moved`."""
    t = inner(w, w)
    a, b, c = shares_of(t)
    slope_a, slope_b, slope_c = slopes_of(t)
    gw, xg, vg, wx, wv = inner(g, w), cross(x, g), cross(v, g), inner(w, x), inner(w, v)
    wwx, wwv = inner(g, x), inner(g, v)
    twice_x, twice_v = gw * wx - wwx * t, gw * wv - wwv * t
    along_w = slope_a * inner(w, xg) + slope_b * (twice_x + inner(w, vg)) + slope_c * twice_v
    along_w -= 2.0 * (b * wwx + c * wwv)
    along_g, across = b * wx + c * wv, cross(g, w)
    d_w = (
        along_w * w[0] + a * xg[0] + b * (x[0] * gw + vg[0]) + c * v[0] * gw + along_g * g[0],
        along_w * w[1] + a * xg[1] + b * (x[1] * gw + vg[1]) + c * v[1] * gw + along_g * g[1],
        along_w * w[2] + a * xg[2] + b * (x[2] * gw + vg[2]) + c * v[2] * gw + along_g * g[2],
    )
    kept = 1.0 - c * t
    d_v = (
        kept * g[0] + b * across[0] + c * gw * w[0],
        kept * g[1] + b * across[1] + c * gw * w[1],
        kept * g[2] + b * across[2] + c * gw * w[2],
    )
    return d_w, d_v


def sheet_backward(field, d, base, scratch, grad):
    """What the coordinates send back."""
    sheet_of(field, scratch)
    for j in range(SHEET_OUTPUTS):
        total = 0.0
        for level in range(COORDINATE_COUNT if j < COORDINATES else 0):
            at = base + OWN + 2 * level * COORDINATES + j
            h = float(scratch[AT + SHEETED + j]) * (1 << level)
            total += (d[at] * math.cos(h) - d[at + COORDINATES] * math.sin(h)) * (1 << level)
        scratch[AT + D_OUT + j] = total
    network_backward(
        SHEET_INPUTS, SHEET_HIDDEN, SHEET_LAYERS, SHEET_SKIP, SHEET_OUTPUTS, field.params, field.sheet,
        scratch, np.uint64(AT + E), np.uint64(AT + SHEET_H), scratch, np.uint64(AT + D_OUT),
        np.uint64(AT + D_H), np.uint64(AT + D_BEFORE), np.uint64(AT + D_E), grad,
    )  # fmt: skip
