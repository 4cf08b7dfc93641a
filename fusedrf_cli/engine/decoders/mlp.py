"""Colour by a network of features and direction. With a matrix B (ROWS, WIDTH) it reads
x = [B features, D(d), p]: D is the direction itself or its 16 spherical harmonics, p, where it is asked for,
the point in [-1, 1]³ of the box. Its input is [x, sin x, sin 2x, .., cos x, cos 2x, ..] (INPUTS numbers),
LAYERS rectified layers of HIDDEN outputs and one of three logits follow.

TensoRF's MLP_Fea (Chen et al., ECCV 2022) has 27 rows, two frequencies and two layers; DVGO (Sun et al., CVPR
2022) and NeRF (Mildenhall et al., ECCV 2020) read the features themselves, without rows; Instant-NGP (Müller
et al. 2022, sec. 5.4) does with harmonics. DVGO may take the first three rows of B features as `diffuse`
logits, which are added to the network's. With `dimmed` f the feature of that number darkens the colour: it is
sigmoid(logit) (1 - sigmoid(feature f)) (the shadows of D²NeRF, Wu et al., NeurIPS 2022, eq. 6).

The inputs lie in blocks as wide as x, where others interleave frequencies, and encode features and direction
by as many as they like: an importer permutes the columns of the first layer, and leaves 0 what is not there.
Where only the direction is encoded D(d) is `waves`, [d, sin d, sin 2d, .., cos d, cos 2d, ..], made once for
a ray, and x itself is the input.
"""

import math
from typing import Annotated, Literal, NamedTuple

import msgspec
import numpy as np
import torch

from fusedrf_cli.engine.decoders.sh_mlp import HARMONICS, OUTPUTS
from fusedrf_cli.engine.fields.box import ParameterBlock
from fusedrf_cli.engine.fields.part_options import Frequencies, Layers, Width
from fusedrf_cli.engine.kernels import reference as torch_reference
from fusedrf_cli.engine.kernels.networks import network, network_backward
from fusedrf_cli.engine.kernels.primitives import add_scaled, dot, scatter, sh_basis


class Options(msgspec.Struct, forbid_unknown_fields=True):
    """See decoders."""

    hidden: Width
    layers: Layers = 2
    rows: Annotated[int, msgspec.Meta(ge=0, le=256)] = 0
    frequencies: Frequencies = 2
    direction: Literal["raw", "harmonics", "waves"] = "raw"
    point: bool = False
    diffuse: bool = False
    limits: tuple[float, float] | None = None
    """Between which the rows of B features are kept."""
    dimmed: Annotated[int, msgspec.Meta(ge=0, le=1024)] = 0
    """0: none."""


class Arrays(NamedTuple):
    """What the functions read beside `params`."""

    basis: object  # int64, where B begins
    layers: object  # (LAYERS + 1,) int64, where a layer's (inputs, outputs) begin, and behind them its bias


def core_of(width: int, rows: int, direction: str, point: bool) -> int:
    """Numbers of x, but for the sines and cosines of `waves`."""
    return (rows or width) + (HARMONICS if direction == "harmonics" else 3) + 3 * point


def inputs_of(width: int, rows: int, frequencies: int, direction: str, point: bool) -> int:
    """Numbers that the first layer reads."""
    core = core_of(width, rows, direction, point)
    return core + 6 * frequencies if direction == "waves" else (1 + 2 * frequencies) * core


def layer_shapes(
    width: int, rows: int, hidden: int, layers: int = 2, frequencies: int = 2, direction: str = "raw",
    point: bool = False, **shown,
) -> list[tuple[int, int]]:  # fmt: skip
    """(inputs, outputs) of each layer in memory: outputs are filled up to runs of eight with zeros."""
    wide = -(-hidden // 8) * 8
    inputs = inputs_of(width, rows, frequencies, direction, point)
    return [(inputs, wide), *[(wide, wide)] * (layers - 1), (wide, OUTPUTS)]


def sizes(
    width: int, rows: int, hidden: int, layers: int = 2, frequencies: int = 2, direction: str = "raw",
    point: bool = False, diffuse: bool = False, limits: tuple[float, float] | None = None, dimmed: int = 0,
) -> dict[str, int | float]:  # fmt: skip
    """See decoders; scratch holds the direction and the point, and the gradients of the layers' outputs, of
    the input, of x and of the features. Features, input and the layers' outputs are kept."""
    shapes = layer_shapes(width, rows, hidden, layers, frequencies, direction, point)
    (inputs, wide), core = shapes[0], core_of(width, rows, direction, point)
    waves = frequencies if direction == "waves" else 0
    if direction == "waves":
        core, frequencies = inputs, 0
    rooms = {
        "DIRECTION": max(HARMONICS, 3 + 6 * waves), "POINT": 8, "D_LAST": OUTPUTS, "D_HIDDEN": wide,
        "D_BEFORE": wide, "D_INPUT": inputs, "D_X": core, "D_ROWS": width,
    }  # fmt: skip
    starts = np.cumsum([0, *rooms.values()]).tolist()
    offsets = np.cumsum([width, inputs, layers * wide, OUTPUTS]).tolist()
    return {
        "WIDTH": width, "BASIS": int(rows > 0), "ROWS": rows or width, "INPUTS": inputs, "HIDDEN": wide,
        "LAYERS": layers, "FREQUENCIES": frequencies, "CORE": core,
        "AS_HARMONICS": int(direction == "harmonics"), "WAVES": waves,
        "DIRECTIONS": core - (rows or width) - 3 * point, "POINTS": 3 * point, "DIFFUSE": int(diffuse),
        "DIMMED": dimmed,
        "LIMITED": int(limits is not None), "LOWEST": float((limits or (0, 0))[0]),
        "HIGHEST": float((limits or (0, 0))[1]),
        **dict(zip(rooms, starts, strict=False)), "ROOM": starts[-1],
        "INPUT": offsets[0], "FIRST": offsets[1], "LAST": offsets[2], "KEPT": offsets[3],
        "LEARN_FROM": 1 / 64, "SHADING_COST": 8,
    }  # fmt: skip


def sections(resolution: tuple[int, int, int], width: int, rows: int, **options) -> list[ParameterBlock]:
    """See decoders; a layer's bias is the last row of its array. Layers learn slower than B."""
    basis = [ParameterBlock("basis", (rows, width))] if rows else []
    named = enumerate(layer_shapes(width, rows, **options))
    return basis + [
        ParameterBlock(f"layer_{i}", (inputs + 1, outputs), rate=1 / 3) for i, (inputs, outputs) in named
    ]


def arrays(field, starts: np.ndarray, rows: int, **options) -> Arrays:
    """See decoders."""
    return Arrays(np.int64(starts[0]), starts[1:] if rows else starts)


def reference(
    field, sections: dict, features: torch.Tensor, dirs: torch.Tensor, unit: torch.Tensor, rows: int,
    layers: int = 2, frequencies: int = 2, direction: str = "raw", point: bool = False, diffuse: bool = False,
    limits: tuple[float, float] | None = None, dimmed: int = 0, **options,
) -> torch.Tensor:  # fmt: skip
    """See decoders."""
    read = features @ sections["basis"].T if rows else features
    read = read if limits is None else read.clamp(*limits)
    seen = torch_reference.sh_basis(HARMONICS, dirs) if direction == "harmonics" else dirs
    if direction == "waves":
        seen, frequencies = encoded(dirs, frequencies), 0
    x = torch.cat([read, seen.to(read.dtype), *([2 * unit - 1] if point else [])], 1)
    x = encoded(x, frequencies)
    for i in range(layers + 1):
        x = x @ sections[f"layer_{i}"][:-1] + sections[f"layer_{i}"][-1]
        x = x.relu() if i < layers else x[:, :3]
    x = x + read[:, :3] if diffuse else x
    return dimmed_by(x, features[:, dimmed, None]) if dimmed else x


def dimmed_by(logits: torch.Tensor, shadow: torch.Tensor) -> torch.Tensor:
    """The logit of sigmoid(logits) (1 - sigmoid(shadow)), as `dimmed_logit`."""
    return -torch.logsumexp(torch.stack(torch.broadcast_tensors(-logits, shadow, shadow - logits)), 0)


def encoded(x: torch.Tensor, frequencies: int) -> torch.Tensor:
    """[x, sin x, sin 2x, .., cos x, cos 2x, ..]."""
    waves = [wave(2.0**level * x) for wave in (torch.sin, torch.cos) for level in range(frequencies)]
    return torch.cat([x, *waves], 1)


def bound(
    field, sections: dict, features: torch.Tensor, rows: int, layers: int = 2, diffuse: bool = False,
    dimmed: int = 0, **options,
) -> float:  # fmt: skip
    """See decoders: x is bounded by B, and the network by the product of its layers' largest sums."""
    read = sections["basis"].abs().double() @ features if rows else features
    most = max(1.0, float(read.max()))
    for i in range(layers + 1):
        layer = sections[f"layer_{i}"].abs().double()
        most = float((layer[:-1].sum(0) * most + layer[-1]).max())
    most += float(read[:3].max()) * diffuse
    return most + float(features[dimmed]) + 2 if dimmed else most


# -- compiled ------------------------------------------------------------------------------------------------


def ray_setup(field, d, scratch):
    """The direction, perhaps with its sines and cosines, or its harmonics."""
    if AS_HARMONICS:
        sh_basis(HARMONICS, d, scratch, AT + DIRECTION)
    else:
        scratch[AT + DIRECTION], scratch[AT + DIRECTION + 1], scratch[AT + DIRECTION + 2] = d
        for level in range(WAVES):
            at = AT + DIRECTION + 3 + 3 * level
            for axis in range(3):
                angle = scratch[AT + DIRECTION + axis] * (1 << level)
                scratch[at + axis] = math.sin(angle)
                scratch[at + 3 * WAVES + axis] = math.cos(angle)


def point_setup(field, unit, scratch):
    """See decoders."""
    for axis in range(POINTS):
        u = unit[0] if axis == 0 else (unit[1] if axis == 1 else unit[2])
        scratch[AT + POINT + axis] = 2.0 * u - 1.0


def forward(field, cell, d, scratch, memory, at):
    """See decoders."""
    features_forward(field, cell, scratch, memory, at)
    base, x = np.uint64(at), np.uint64(at + INPUT)
    basis, width, rows, params = np.uint64(field.basis), np.uint64(WIDTH), np.uint64(ROWS), field.params
    for j in range(rows):
        memory[x + j] = dot(WIDTH, params, basis + j * width, memory, base) if BASIS else memory[base + j]
        if LIMITED:
            memory[x + j] = min(max(memory[x + j], LOWEST), HIGHEST)
    for j in range(np.uint64(DIRECTIONS)):
        memory[x + rows + j] = scratch[np.uint64(AT + DIRECTION) + j]
    for j in range(np.uint64(POINTS)):
        memory[x + rows + np.uint64(DIRECTIONS) + j] = scratch[np.uint64(AT + POINT) + j]
    encode(memory, x)
    h, last = base + np.uint64(FIRST), base + np.uint64(LAST)
    network(INPUTS, HIDDEN, LAYERS, 0, OUTPUTS, params, field.layers, memory, x, h, last)
    r, g, b = plain_logits_at(memory, x, last)
    if DIMMED > 0:
        shadow = memory[base + np.uint64(DIMMED)]
        return dimmed_logit(r, shadow)[0], dimmed_logit(g, shadow)[0], dimmed_logit(b, shadow)[0]
    return r, g, b


def plain_logits_at(memory, x, last):
    """The logits before they are dimmed, of what is kept."""
    r, g, b = memory[last], memory[last + np.uint64(1)], memory[last + np.uint64(2)]
    if DIFFUSE:
        return r + memory[x], g + memory[x + np.uint64(1)], b + memory[x + np.uint64(2)]
    return r, g, b


def dimmed_logit(logit, shadow):
    """-log(e^-logit + e^shadow + e^(shadow - logit)), and its derivatives by both."""
    most = max(-logit, max(shadow, shadow - logit))
    lit, dark, both = math.exp(-logit - most), math.exp(shadow - most), math.exp(shadow - logit - most)
    total = lit + dark + both
    return -most - math.log(total), (lit + both) / total, -(dark + both) / total


def encode(memory, x):
    """Behind the numbers x their sines and cosines. That of twice follows from that of once."""
    count = np.uint64(CORE)
    for j in range(count):
        sin, cos = math.sin(memory[x + j]), math.cos(memory[x + j])
        for level in range(np.uint64(FREQUENCIES)):
            if level == 1:
                sin, cos = 2 * sin * cos, 1 - 2 * sin * sin
            elif level > 1:
                angle = memory[x + j] * (np.uint64(1) << level)
                sin, cos = math.sin(angle), math.cos(angle)
            memory[x + (np.uint64(1) + level) * count + j] = sin
            memory[x + (np.uint64(1 + FREQUENCIES) + level) * count + j] = cos


def backward(field, cell, d, d_logits, scratch, memory, at, grad):
    """See decoders."""
    base, x, d_last = np.uint64(at), np.uint64(at + INPUT), np.uint64(AT + D_LAST)
    for r in range(np.uint64(OUTPUTS)):
        scratch[d_last + r] = 0
    d_shadow = 0.0
    if DIMMED > 0:
        d_logits, d_shadow = dimmed_backward(base, x, d_logits, memory)
    for c in range(3):
        scratch[d_last + np.uint64(c)] = d_logits[c]
    network_backward(
        INPUTS, HIDDEN, LAYERS, 0, OUTPUTS, field.params, field.layers, memory, x, base + np.uint64(FIRST),
        scratch, d_last, np.uint64(AT + D_HIDDEN), np.uint64(AT + D_BEFORE), np.uint64(AT + D_INPUT), grad,
    )  # fmt: skip
    encode_backward(memory, x, scratch)
    if DIFFUSE:
        for c in range(3):
            scratch[np.uint64(AT + D_X + c)] += d_logits[c]
    basis_backward(field, base, scratch, memory, grad)
    if DIMMED > 0:
        scratch[np.uint64(AT + D_ROWS + DIMMED)] += d_shadow
    features_backward(field, cell, scratch, AT + D_ROWS, scratch, grad)


def dimmed_backward(base, x, d_logits, memory):
    """The gradients of the logits before they are dimmed, and of the feature that dims them."""
    r, g, b = plain_logits_at(memory, x, base + np.uint64(LAST))
    shadow = memory[base + np.uint64(DIMMED)]
    _, red, by_red = dimmed_logit(r, shadow)
    _, green, by_green = dimmed_logit(g, shadow)
    _, blue, by_blue = dimmed_logit(b, shadow)
    sent = d_logits[0] * red, d_logits[1] * green, d_logits[2] * blue
    return sent, d_logits[0] * by_red + d_logits[1] * by_green + d_logits[2] * by_blue


def basis_backward(field, base, scratch, memory, grad):
    """From the gradient of x in scratch[AT + D_X:] to the features' in scratch[AT + D_ROWS:]."""
    basis, width, d_features = np.uint64(field.basis), np.uint64(WIDTH), np.uint64(AT + D_ROWS)
    for r in range(width):
        scratch[d_features + r] = 0 if BASIS else scratch[np.uint64(AT + D_X) + r]
    if BASIS:
        for j in range(np.uint64(ROWS)):
            d_x = scratch[np.uint64(AT + D_X) + j]
            add_scaled(WIDTH, scratch, d_features, d_x, field.params, basis + j * width)
            scatter(WIDTH, grad, basis + j * width, d_x, memory, base)


def encode_backward(memory, x, scratch):
    """Adjoint of `encode`: from scratch[AT + D_INPUT:] to scratch[AT + D_X:], for the features' part of
    x."""
    count, d_input = np.uint64(CORE), np.uint64(AT + D_INPUT)
    for j in range(np.uint64(ROWS)):
        total = scratch[d_input + j]
        for level in range(np.uint64(FREQUENCIES)):
            sin = (np.uint64(1) + level) * count + j
            cos = (np.uint64(1 + FREQUENCIES) + level) * count + j
            sent = scratch[d_input + sin] * memory[x + cos] - scratch[d_input + cos] * memory[x + sin]
            total += (np.uint64(1) << level) * sent
        if LIMITED and (memory[x + j] <= LOWEST or memory[x + j] >= HIGHEST):
            total = 0 * total
        scratch[np.uint64(AT + D_X) + j] = total
