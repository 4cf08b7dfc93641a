"""TensoRF's checkpoints (Chen et al., ECCV 2022; github.com/apchenstu/TensoRF), of TensorVMSplit, TensorCP
and TensorVM."""

import numpy as np

from formats.errors import FormatError
from fusedrf_cli.bridge.importing.parts import (
    Y0,
    ColourInput,
    Entries,
    Imported,
    ImportedNode,
    beside,
    colour_network,
    parts_field,
    ranks_filled,
)
from fusedrf_cli.engine.fields.box import checked_box
from fusedrf_cli.engine.fields.occupancy import OccupancyGrid
from fusedrf_cli.engine.kinds.assembled.field import PartsShape

MAX_FREQUENCIES = 16
NDC = "its rays go from 0 to 1, as in normalised device coordinates, which are its frame if it was trained so"


def read(checkpoint) -> Imported:
    """The field of a checkpoint. Raises FormatError."""
    entries = Entries(checkpoint.entries)
    kwargs = entries.inside("kwargs")
    state = split(entries.inside("state_dict"), kwargs)
    planes = any(str(name).startswith("density_plane.") for name in state.values)
    density, resolution, _ = factors(state, "density", planes)
    colour, colour_resolution, ranks = factors(state, "app", planes)
    if resolution != colour_resolution:
        raise FormatError(f"grids of density and colour are of {resolution} and {colour_resolution} texels")
    basis = state.array("basis_mat.weight", None, sum(ranks))
    blocks = np.split(basis, np.cumsum(ranks)[:-1], 1)
    basis = beside(blocks, ranks_filled(ranks)) if planes else np.pad(basis, ((0, 0), (0, -ranks[0] % 8)))
    rgb, shading, activation = shading_of(kwargs, state, basis)
    act = kwargs.values.get("fea2denseAct", "softplus")
    if act not in ("softplus", "relu"):
        raise FormatError(f"kwargs: 'fea2denseAct' should be softplus or relu, found {str(act)[:40]!r}")
    part = "plane_line" if planes else "line"
    shape = PartsShape(
        {"part": part, "rank": next(iter(density.values())).shape[-1]},
        {"part": part, "rank": next(iter(colour.values())).shape[-1]},
        {"part": "density_sum", "activation": act}, rgb, activation,
    )  # fmt: skip
    values = {f"density_{name}": value for name, value in density.items()}
    values |= {f"colour_{name}": value for name, value in colour.items()} | shading
    box = kwargs.array("aabb", 2, 3).astype(np.float64).reshape(6)
    shift = kwargs.number("density_shift", -10.0) if act == "softplus" else 0.0
    scale = kwargs.number("distance_scale", 25.0)
    field = parts_field(shape, box, resolution, values, scale, shift, cells_of(entries, box))
    in_ndc = kwargs.values.get("near_far") in ([0, 1], (0, 1))
    return Imported([ImportedNode(field)], [NDC] if in_ndc else [])


def split(state: Entries, kwargs: Entries) -> Entries:
    """A state by the names of TensorVMSplit: TensorVM has planes and lines of colour and density in one
    array, those of density last."""
    if "plane_coef" not in state.values:
        return state
    planes, lines = state.array("plane_coef", 3, None, None, None), state.array("line_coef", 3, None, None, 1)
    first = planes.shape[1] - kwargs.whole("density_n_comp", 1, max(planes.shape[1] - 1, 1))
    parts = {"plane": planes, "line": lines}
    named = {f"app_{part}.{i}": found[i : i + 1, :first] for part, found in parts.items() for i in range(3)}
    named |= {
        f"density_{part}.{i}": found[i : i + 1, first:] for part, found in parts.items() for i in range(3)
    }
    return Entries(state.values | named, state.where)


def factors(state: Entries, which: str, planes: bool) -> tuple[dict[str, np.ndarray], tuple, list[int]]:
    """Planes and lines of density or colour by the names of our sections, texels per axis, and ranks of the
    modes, which all get the largest."""
    # TensoRF's line i runs along axis 2 - i, and its plane i along the two others
    lines = [state.array(f"{which}_line.{i}", 1, None, None, 1)[0, :, :, 0] for i in range(3)]
    resolution = tuple(line.shape[1] for line in reversed(lines))
    ranks = [len(line) for line in lines]
    rank = ranks_filled(ranks)
    if not planes:
        if len(set(ranks)) > 1:
            raise FormatError(f"lines of '{which}' have {ranks} components, expected as many on each axis")
        made = {f"line_{2 - i}": line.T for i, line in enumerate(lines)}
        return (
            {name: np.pad(line, ((0, 0), (0, rank - ranks[0]))) for name, line in made.items()},
            resolution,
            ranks[:1],
        )
    made = {}
    for i, (a, b) in enumerate(((0, 1), (0, 2), (1, 2))):
        plane = state.array(f"{which}_plane.{i}", 1, ranks[i], resolution[b], resolution[a])[0]
        filled = ((0, 0), (0, 0), (0, rank - ranks[i]))
        made[f"plane_{i}"] = np.pad(plane.transpose(2, 1, 0), filled)
        made[f"line_{i}"] = np.pad(lines[i].T, filled[1:])
    return made, resolution, ranks


def shading_of(kwargs: Entries, state: Entries, basis: np.ndarray) -> tuple[dict, dict[str, np.ndarray], str]:
    """The entry of the colour's decoder, its sections, and the activation of colours."""
    mode, count = kwargs.values.get("shadingMode", "MLP_PE"), len(basis)
    if mode == "SH":
        if count != 27:
            raise FormatError(f"'basis_mat.weight' should have 27 rows for SH shading, found {count}")
        return {"part": "sh_basis", "coefficients": 9}, {"rgb_basis": basis.reshape(3, 9, -1)}, "relu"
    if mode == "RGB":
        if count != 3:
            raise FormatError(f"'basis_mat.weight' should have 3 rows for RGB shading, found {count}")
        return {"part": "sh_basis", "coefficients": 1}, {"rgb_basis": basis[:, None] / Y0}, "none"
    if mode not in ("MLP_Fea", "MLP_PE", "MLP"):
        raise FormatError(
            f"kwargs: 'shadingMode' {str(mode)[:40]!r} is not known: MLP_Fea, MLP_PE, MLP, SH, RGB"
        )
    view = kwargs.whole("view_pe", 0, MAX_FREQUENCIES, 6)
    features = kwargs.whole("fea_pe", 0, MAX_FREQUENCIES, 6) if mode == "MLP_Fea" else 0
    points = kwargs.whole("pos_pe", 0, MAX_FREQUENCIES, 6) if mode == "MLP_PE" else 0
    frequencies, alone = max(view, features, points), not features and not points
    order = ColourInput(count, count, frequencies, point=mode == "MLP_PE", alone=alone)
    layers = state.layers("renderModule.mlp.")
    columns = [order.at("features"), order.at("direction")]
    if mode == "MLP_PE":
        # forks differ in whether the point itself is read
        whole = count + 3 + 3 + 6 * points + 6 * view
        columns += [order.at("point")] if layers[0][0].shape[1] == whole else []
        columns += [order.waves("point", points)]
    if mode == "MLP_Fea":
        columns += [order.waves("features", features)]
    columns = np.concatenate([*columns, order.waves("direction", view)])
    entry, sections = colour_network(layers, order, columns, rows=count)
    return entry, sections | {"rgb_basis": basis}, "sigmoid"


def cells_of(entries: Entries, box: np.ndarray) -> OccupancyGrid:
    """The alpha mask: a point counts where any of the eight samples around it is occupied."""
    if {"alphaMask.shape", "alphaMask.mask", "alphaMask.aabb"}.isdisjoint(entries.values):
        return OccupancyGrid.full(box)
    shape = [int(n) for n in entries.array("alphaMask.shape", None)[-3:]]
    bits = entries.get("alphaMask.mask")
    bits = bits.array() if hasattr(bits, "array") else np.asarray(bits)
    if (
        len(shape) != 3
        or min(shape) < 2
        or bits.dtype != np.uint8
        or bits.size * 8 < np.prod(shape, dtype=float)
    ):
        raise FormatError(f"'alphaMask.mask' should be the bits of a grid, of 'alphaMask.shape' {shape}")
    samples = np.unpackbits(bits.reshape(-1), count=int(np.prod(shape))).reshape(shape).astype(bool).T
    mask_box = entries.array("alphaMask.aabb", 2, 3).astype(np.float64)
    if (mask_box[0] > box[:3]).any() or (mask_box[1] < box[3:]).any():
        # samples around those of the mask are 0, and a point may lie between the two
        samples, cell = np.pad(samples, 1), (mask_box[1] - mask_box[0]) / (np.array(samples.shape) - 1)
        mask_box = mask_box + [-cell, cell]
    return OccupancyGrid(checked_box(mask_box.reshape(6).tolist(), "'alphaMask.aabb'"), between(samples))


def between(samples: np.ndarray) -> np.ndarray:
    """(X - 1, Y - 1, Z - 1) which cells between samples (X, Y, Z) bool have any at a corner."""
    for axis in range(3):
        low, high = (
            np.take(samples, indices, axis)
            for indices in (range(samples.shape[axis] - 1), range(1, samples.shape[axis]))
        )
        samples = low | high
    return samples
