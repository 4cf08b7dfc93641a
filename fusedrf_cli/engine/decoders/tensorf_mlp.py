"""Colour by TensoRF's network (Chen et al., ECCV 2022, MLP_Fea): with a matrix B (ROWS, WIDTH) and
x = [B features, d], its input is [x, sin x, sin 2x, cos x, cos 2x] (INPUTS numbers); two rectified layers of
HIDDEN outputs and one of three logits follow.

The inputs lie in blocks as wide as x, where TensoRF interleaves frequencies and keeps features and direction
apart: an importer permutes the columns of the first layer."""

import math
from typing import NamedTuple

import numpy as np
import torch

from fusedrf_cli.engine.decoders.sh_mlp import OUTPUTS
from fusedrf_cli.engine.fields.box import ParameterBlock
from fusedrf_cli.engine.kernels.primitives import add_scaled, dense, dense_backward, dot, rectify, scatter

LAYERS = 3


class Arrays(NamedTuple):
    """What the functions read beside `params`."""

    basis: object  # int64, where B begins
    layers: object  # (3,) int64, where a layer's (inputs, outputs) begin, and behind them its bias


def layer_shapes(rows: int, hidden: int) -> list[tuple[int, int]]:
    """(inputs, outputs) of each layer in memory: outputs are filled up to runs of eight with zeros."""
    wide = -(-hidden // 8) * 8
    return [(5 * (rows + 3), wide), (wide, wide), (wide, OUTPUTS)]


def sizes(width: int, rows: int, hidden: int) -> dict[str, int | float]:
    """See decoders; scratch holds the direction, and the gradients of the layers' outputs, of the input, of x
    and of the features. Features, input and the layers' outputs are kept."""
    inputs, wide = layer_shapes(rows, hidden)[0]
    rooms = {
        "DIRECTION": 8, "D_LAST": OUTPUTS, "D_SECOND": wide, "D_FIRST": wide, "D_INPUT": inputs,
        "D_X": rows + 3, "D_ROWS": width,
    }  # fmt: skip
    starts = np.cumsum([0, *rooms.values()]).tolist()
    offsets = np.cumsum([width, inputs, wide, wide, OUTPUTS]).tolist()
    return {
        "WIDTH": width, "ROWS": rows, "INPUTS": inputs, "HIDDEN": wide,
        **dict(zip(rooms, starts, strict=False)), "ROOM": starts[-1],
        "INPUT": offsets[0], "FIRST": offsets[1], "SECOND": offsets[2], "LAST": offsets[3],
        "KEPT": offsets[4],
        "LEARN_FROM": 1 / 64, "SHADING_COST": 8,
    }  # fmt: skip


def sections(resolution: tuple[int, int, int], width: int, rows: int, hidden: int) -> list[ParameterBlock]:
    """See decoders; a layer's bias is the last row of its array. Layers learn slower than B."""
    named = enumerate(layer_shapes(rows, hidden))
    return [
        ParameterBlock("basis", (rows, width)),
        *(ParameterBlock(f"layer_{i}", (inputs + 1, outputs), rate=1 / 3) for i, (inputs, outputs) in named),
    ]


def arrays(field, starts: np.ndarray, width: int, rows: int, hidden: int) -> Arrays:
    """See decoders."""
    return Arrays(np.int64(starts[0]), starts[1:])


def reference(
    field, sections: dict, features: torch.Tensor, dirs: torch.Tensor, **options: int
) -> torch.Tensor:
    """See decoders."""
    x = torch.cat([features @ sections["basis"].T, dirs.to(features.dtype)], 1)
    x = torch.cat([x, x.sin(), (2 * x).sin(), x.cos(), (2 * x).cos()], 1)
    for i in range(LAYERS):
        x = x @ sections[f"layer_{i}"][:-1] + sections[f"layer_{i}"][-1]
        x = x.relu() if i < LAYERS - 1 else x[:, :3]
    return x


def bound(field, sections: dict, features: torch.Tensor, **options: int) -> float:
    """See decoders: x is bounded by B, and the network by the product of its layers' largest sums."""
    most = max(1.0, float((sections["basis"].abs().double() @ features).max()))
    for i in range(LAYERS):
        layer = sections[f"layer_{i}"].abs().double()
        most = float((layer[:-1].sum(0) * most + layer[-1]).max())
    return most


# -- compiled ------------------------------------------------------------------------------------------------


def ray_setup(field, d, scratch):
    """The direction."""
    scratch[AT + DIRECTION], scratch[AT + DIRECTION + 1], scratch[AT + DIRECTION + 2] = d


def forward(field, cell, d, scratch, memory, at):
    """See decoders."""
    features_forward(field, cell, scratch, memory, at)
    base, x = np.uint64(at), np.uint64(at + INPUT)
    basis, width, params = np.uint64(field.basis), np.uint64(WIDTH), field.params
    for j in range(np.uint64(ROWS)):
        memory[x + j] = dot(WIDTH, params, basis + j * width, memory, base)
    for j in range(np.uint64(3)):
        memory[x + np.uint64(ROWS) + j] = scratch[np.uint64(AT + DIRECTION) + j]
    encode(memory, x)
    first, second, last = base + np.uint64(FIRST), base + np.uint64(SECOND), base + np.uint64(LAST)
    dense(INPUTS, HIDDEN, params, np.uint64(field.layers[0]), memory, x, memory, first)
    rectify(HIDDEN, memory, first)
    dense(HIDDEN, HIDDEN, params, np.uint64(field.layers[1]), memory, first, memory, second)
    rectify(HIDDEN, memory, second)
    dense(HIDDEN, OUTPUTS, params, np.uint64(field.layers[2]), memory, second, memory, last)
    return memory[last], memory[last + np.uint64(1)], memory[last + np.uint64(2)]


def encode(memory, x):
    """Behind the numbers x their sines and cosines, of once and twice."""
    count = np.uint64(ROWS + 3)
    for j in range(count):
        sin, cos = math.sin(memory[x + j]), math.cos(memory[x + j])
        memory[x + count + j] = sin
        memory[x + np.uint64(2) * count + j] = 2 * sin * cos
        memory[x + np.uint64(3) * count + j] = cos
        memory[x + np.uint64(4) * count + j] = 1 - 2 * sin * sin


def backward(field, cell, d, d_logits, scratch, memory, at, grad):
    """See decoders."""
    base, x, params = np.uint64(at), np.uint64(at + INPUT), field.params
    first, second = base + np.uint64(FIRST), base + np.uint64(SECOND)
    d_last, d_second = np.uint64(AT + D_LAST), np.uint64(AT + D_SECOND)
    d_first, d_input = np.uint64(AT + D_FIRST), np.uint64(AT + D_INPUT)
    for r in range(np.uint64(OUTPUTS)):
        scratch[d_last + r] = 0
    for c in range(3):
        scratch[d_last + np.uint64(c)] = d_logits[c]
    layer = np.uint64(field.layers[2])
    dense_backward(
        HIDDEN, OUTPUTS, params, layer, memory, second, True, scratch, d_last, scratch, d_second, grad
    )
    layer = np.uint64(field.layers[1])
    dense_backward(
        HIDDEN, HIDDEN, params, layer, memory, first, True, scratch, d_second, scratch, d_first, grad
    )
    layer = np.uint64(field.layers[0])
    dense_backward(INPUTS, HIDDEN, params, layer, memory, x, False, scratch, d_first, scratch, d_input, grad)
    encode_backward(memory, x, scratch)
    basis, width, d_features = np.uint64(field.basis), np.uint64(WIDTH), np.uint64(AT + D_ROWS)
    for r in range(width):
        scratch[d_features + r] = 0
    for j in range(np.uint64(ROWS)):
        d_x = scratch[np.uint64(AT + D_X) + j]
        add_scaled(WIDTH, scratch, d_features, d_x, params, basis + j * width)
        scatter(WIDTH, grad, basis + j * width, d_x, memory, base)
    features_backward(field, cell, scratch, AT + D_ROWS, scratch, grad)


def encode_backward(memory, x, scratch):
    """Adjoint of `encode`: from scratch[AT + D_INPUT:] to scratch[AT + D_X:]."""
    count, d_input = np.uint64(ROWS + 3), np.uint64(AT + D_INPUT)
    d_sin = d_input + count
    d_sin2, d_cos, d_cos2 = d_sin + count, d_sin + np.uint64(2) * count, d_sin + np.uint64(3) * count
    for j in range(count):
        sin, sin2 = memory[x + count + j], memory[x + np.uint64(2) * count + j]
        cos, cos2 = memory[x + np.uint64(3) * count + j], memory[x + np.uint64(4) * count + j]
        scratch[np.uint64(AT + D_X) + j] = (
            scratch[d_input + j]
            + scratch[d_sin + j] * cos
            - scratch[d_cos + j] * sin
            + 2 * (scratch[d_sin2 + j] * cos2 - scratch[d_cos2 + j] * sin2)
        )
