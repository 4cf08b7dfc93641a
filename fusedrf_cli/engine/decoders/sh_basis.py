"""Colour by spherical harmonics of features, as TensoRF's SH shading of a learnt basis:
logit_c = Σ_r features_r Σ_k Y_k(d) B[c, k, r]. SH is linear: a ray folds its direction into B once."""

from typing import NamedTuple

import msgspec
import numpy as np
import torch

from fusedrf_cli.engine.fields.box import ParameterBlock, largest
from fusedrf_cli.engine.fields.part_options import Coefficients
from fusedrf_cli.engine.kernels import reference as torch_reference
from fusedrf_cli.engine.kernels.primitives import add_scaled, dot, mixed_8, scatter, sh_basis


class Options(msgspec.Struct, forbid_unknown_fields=True):
    """See decoders."""

    coefficients: Coefficients


class Arrays(NamedTuple):
    """What the functions read beside `params`."""

    start: object  # int64, where B begins


def sizes(width: int, coefficients: int) -> dict[str, int]:
    """See decoders; scratch holds the folded basis, its gradient, that of the features, and Y. Features are
    kept."""
    return {"WIDTH": width, "COEFFICIENTS": coefficients, "ROOM": 7 * width + 16, "KEPT": width}


def sections(resolution: tuple[int, int, int], width: int, coefficients: int) -> list[ParameterBlock]:
    """See decoders; B is drawn as wide as leaves logits of unit features of order 1."""
    return [ParameterBlock("basis", (3, coefficients, width), spread=width**-0.5)]


def arrays(field, starts: np.ndarray, width: int, coefficients: int) -> Arrays:
    """See decoders."""
    return Arrays(np.int64(starts[0]))


def reference(
    field, sections: dict, features: torch.Tensor, dirs: torch.Tensor, width: int, coefficients: int
) -> torch.Tensor:
    """See decoders."""
    harmonics = torch_reference.sh_basis(coefficients, dirs).to(features.dtype)
    return torch.einsum("nk,ckr,nr->nc", harmonics, sections["basis"], features)


def bound(field, sections: dict, features: torch.Tensor, width: int, coefficients: int) -> float:
    """See decoders; no |Y_k| is above 1."""
    return coefficients * float((features * largest(sections["basis"], kept=1)).sum())


# -- compiled ------------------------------------------------------------------------------------------------


def ray_setup(field, d, scratch):
    """Fold Y into the basis: scratch[AT + c WIDTH + r] = Σ_k Y_k B[c, k, r]."""
    sh = AT + 7 * WIDTH
    sh_basis(COEFFICIENTS, d, scratch, sh)
    for c in range(np.uint64(3)):
        source = np.uint64(field.start) + c * np.uint64(COEFFICIENTS * WIDTH)
        row, stride = np.uint64(AT) + c * np.uint64(WIDTH), np.uint64(WIDTH)
        for tile in range(np.uint64(WIDTH // 8)):
            at = tile * np.uint64(8)
            mixed_8(
                COEFFICIENTS, scratch, row + at, scratch, np.uint64(sh), field.params, source + at, stride
            )


def ray_backward(field, d, scratch, grad):
    """Adjoint of `ray_setup`; clears the gradient."""
    for c in range(3):
        row = np.uint64(AT + (3 + c) * WIDTH)
        for k in range(COEFFICIENTS):
            target = np.uint64(field.start) + np.uint64((c * COEFFICIENTS + k) * WIDTH)
            scatter(WIDTH, grad, target, scratch[AT + 7 * WIDTH + k], scratch, row)
    for r in range(np.uint64(3 * WIDTH)):
        scratch[np.uint64(AT + 3 * WIDTH) + r] = 0


def forward(field, cell, d, scratch, memory, at):
    """See decoders; the features are kept."""
    features_forward(field, cell, scratch, memory, at)
    f = np.uint64(at)
    r = dot(WIDTH, scratch, np.uint64(AT), memory, f)
    g = dot(WIDTH, scratch, np.uint64(AT + WIDTH), memory, f)
    b = dot(WIDTH, scratch, np.uint64(AT + 2 * WIDTH), memory, f)
    return r, g, b


def backward(field, cell, d, d_logits, scratch, memory, at, grad):
    """See decoders."""
    d_features = np.uint64(AT + 6 * WIDTH)
    for r in range(np.uint64(WIDTH)):
        scratch[d_features + r] = 0
    for c in range(3):
        d_logit = scratch.dtype.type(d_logits[0] if c == 0 else (d_logits[1] if c == 1 else d_logits[2]))
        row = np.uint64(AT) + np.uint64(c * WIDTH)
        add_scaled(WIDTH, scratch, d_features, d_logit, scratch, row)
        add_scaled(WIDTH, scratch, row + np.uint64(3 * WIDTH), d_logit, memory, np.uint64(at))
    features_backward(field, cell, scratch, AT + 6 * WIDTH, scratch, grad)
