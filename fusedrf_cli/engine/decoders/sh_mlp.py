"""Colour by a network of one hidden layer from features and spherical harmonics of the direction (DVGO, Sun
et al., CVPR 2022; Instant-NGP, Müller et al. 2022, sec. 5.4): with x = [features, Y(d)],
h = max(0, W x + b) and logits V h + c."""

from typing import NamedTuple

import numpy as np
import torch

from fusedrf_cli.engine.fields.box import ParameterBlock
from fusedrf_cli.engine.kernels import reference as torch_reference
from fusedrf_cli.engine.kernels.primitives import dense, dense_backward, rectify, sh_basis

OUTPUTS = 8  # three colours, filled up to a run
HARMONICS = 16


class Arrays(NamedTuple):
    """What the functions read beside `params`."""

    hidden: object  # int64, where W (WIDTH + HARMONICS, HIDDEN) begins, and behind it b
    out: object  # int64, where V (HIDDEN, OUTPUTS) begins, and behind it c


def sizes(width: int, hidden: int) -> dict[str, int]:
    """See decoders; scratch holds Y and the gradients of the outputs, of h and of x. Kept are x, h and the
    outputs."""
    inputs = width + HARMONICS
    return {
        "WIDTH": width, "INPUTS": inputs, "HIDDEN": hidden, "D_OUT": HARMONICS,
        "D_HIDDEN": HARMONICS + OUTPUTS, "D_INPUT": HARMONICS + OUTPUTS + hidden,
        "ROOM": HARMONICS + OUTPUTS + hidden + inputs, "KEPT": inputs + hidden + OUTPUTS,
    }  # fmt: skip


def sections(resolution: tuple[int, int, int], width: int, hidden: int) -> list[ParameterBlock]:
    """See decoders; (inputs, outputs) of each layer, and its bias."""
    inputs = width + HARMONICS
    return [
        ParameterBlock("hidden.weight", (inputs, hidden), spread=(2 / inputs) ** 0.5),
        ParameterBlock("hidden.bias", (hidden,)),
        ParameterBlock("out.weight", (hidden, OUTPUTS), spread=hidden**-0.5),
        ParameterBlock("out.bias", (OUTPUTS,)),
    ]


def arrays(field, starts: np.ndarray, width: int, hidden: int) -> Arrays:
    """See decoders."""
    return Arrays(np.int64(starts[0]), np.int64(starts[2]))


def reference(
    field, sections: dict, features: torch.Tensor, dirs: torch.Tensor, width: int, hidden: int
) -> torch.Tensor:
    """See decoders."""
    x = torch.cat([features, torch_reference.sh_basis(HARMONICS, dirs).to(features.dtype)], 1)
    h = (x @ sections["hidden.weight"] + sections["hidden.bias"]).relu()
    return (h @ sections["out.weight"] + sections["out.bias"])[:, :3]


def bound(field, sections: dict, features: torch.Tensor, width: int, hidden: int) -> float:
    """See decoders; no |Y_k| is above 1."""
    most = max(float(features.max()), 1.0)
    for layer in ("hidden", "out"):
        weight, bias = (sections[f"{layer}.{part}"].abs().double() for part in ("weight", "bias"))
        most = float((weight.sum(0) * most + bias).amax())
    return most


# -- compiled ------------------------------------------------------------------------------------------------


def ray_setup(field, d, scratch):
    """Y of the direction."""
    sh_basis(HARMONICS, d, scratch, AT)


def forward(field, cell, d, scratch, memory, at):
    """See decoders."""
    features_forward(field, cell, scratch, memory, at)
    x = np.uint64(at)
    for r in range(np.uint64(HARMONICS)):
        memory[x + np.uint64(WIDTH) + r] = scratch[np.uint64(AT) + r]
    h, out = x + np.uint64(INPUTS), x + np.uint64(INPUTS + HIDDEN)
    dense(INPUTS, HIDDEN, field.params, np.uint64(field.hidden), memory, x, memory, h)
    rectify(HIDDEN, memory, h)
    dense(HIDDEN, OUTPUTS, field.params, np.uint64(field.out), memory, h, memory, out)
    return memory[out], memory[out + np.uint64(1)], memory[out + np.uint64(2)]


def backward(field, cell, d, d_logits, scratch, memory, at, grad):
    """See decoders."""
    x, h, real = np.uint64(at), np.uint64(at + INPUTS), field.params.dtype.type
    d_out, d_h, d_x = np.uint64(AT + D_OUT), np.uint64(AT + D_HIDDEN), np.uint64(AT + D_INPUT)
    for r in range(OUTPUTS):
        scratch[AT + D_OUT + r] = 0
    for c in range(3):
        scratch[AT + D_OUT + c] = real(d_logits[c])
    params, hidden, out = field.params, np.uint64(field.hidden), np.uint64(field.out)
    dense_backward(HIDDEN, OUTPUTS, params, out, memory, h, True, scratch, d_out, scratch, d_h, grad)
    dense_backward(INPUTS, HIDDEN, params, hidden, memory, x, False, scratch, d_h, scratch, d_x, grad)
    features_backward(field, cell, scratch, AT + D_INPUT, scratch, grad)
