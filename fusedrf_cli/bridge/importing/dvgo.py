"""DVGO's checkpoints (Sun et al., CVPR 2022, and its second version; github.com/sunset1995/DirectVoxGO):
DirectVoxGO and DirectContractedVoxGO, on dense or TensoRF grids, and those of earlier versions."""

import numpy as np

from formats.errors import FormatError
from fusedrf_cli.bridge.importing.cells import MOST_CELLS
from fusedrf_cli.bridge.importing.parts import (
    LLFF,
    Y0,
    ColourInput,
    Entries,
    Imported,
    ImportedNode,
    beside,
    colour_network,
    eight,
    parts_field,
    ranks_filled,
)
from fusedrf_cli.bridge.importing.tensorf import between
from fusedrf_cli.engine.fields.box import checked_box
from fusedrf_cli.engine.fields.occupancy import OccupancyGrid
from fusedrf_cli.engine.kinds.assembled.field import PartsShape
from fusedrf_cli.engine.spaces import bounded, contracted_l2, contracted_linf, space_of

NORM = "it does not say by which norm it is contracted, so 'inf' is taken; earlier versions had 'l2'"
MASK = "the coarse densities that mask it are asked at its vertices, and not between them"
CELLS = "the coarse densities that mask it are asked in the middle of cells"
BEGUN = float(np.log(1 / (1 - 1e-6) - 1))
"""What the recipe adds to coarse densities: as opaque as 1e-6."""
MODES = (("xy", "z", 0, 1, 2), ("xz", "y", 0, 2, 1), ("yz", "x", 1, 2, 0))


OTHERWISE = "nearest", "pre_act_density", "in_act_density"
"""Options of the first version by which a grid is read otherwise."""
FORWARD = (
    "its density is counted along the axis of a camera, and its colours depend on directions outside its "
    "space, which the file does not tell; train it with DVGO's bounded or unbounded model"
)
"""Why DirectMPIGO's checkpoints are not read."""


def read(checkpoint) -> Imported:
    """The field of a checkpoint. Raises FormatError."""
    entries = Entries(checkpoint.entries)
    kwargs, state = entries.inside("model_kwargs"), entries.inside("model_state_dict")
    check_version(kwargs, state)
    box = np.concatenate([bounds(state, kwargs, name) for name in ("xyz_min", "xyz_max")])
    box = checked_box(box.tolist(), "the box from 'xyz_min' to 'xyz_max'")
    density, values, resolution, _ = grid_of(state, "density")
    colour, more, colour_resolution, basis = grid_of(state, "k0")
    if resolution != colour_resolution:
        raise FormatError(f"grids of density and colour are of {resolution} and {colour_resolution} vertices")
    values |= more
    count = len(basis) if basis is not None else state.get(dense_name(state, "k0")).shape[1]
    if "posfreq" in state.values:
        colour, values = with_points(values)
    rgb, shading = shading_of(kwargs, state, count, basis)
    shape = PartsShape(density, colour, {"part": "density_sum"}, rgb)
    space, placement, notes = space_and_placement(kwargs, state, box)
    if not (voxels := kwargs.number("num_voxels_base")) > 0:
        raise FormatError(f"model_kwargs: 'num_voxels_base' should be above 0, found {voxels:g}")
    base = (np.prod(box[3:] - box[:3]) / voxels) ** (1 / 3)
    cells, more_notes = cells_of(kwargs, state, box, space)
    field = parts_field(shape, box, resolution, values | shading, 1 / base, shift_of(kwargs, state), cells)
    data = checkpoint.beside.get("config.py", {}).get("data")
    if isinstance(data, dict) and data.get("dataset_type") == "llff":
        more_notes = [*more_notes, LLFF]
    return Imported([ImportedNode(field, placement)], notes + more_notes)


def check_version(kwargs: Entries, state: Entries) -> None:
    """Refuse what is read otherwise. Raises FormatError."""
    if "mpi_depth" in kwargs.values:  # which its later version is told by before it is opened
        raise FormatError(f"a checkpoint of DVGO (NDC), which is not read; {FORWARD}")
    if said := [name for name in OTHERWISE if kwargs.values.get(name)]:
        raise FormatError(
            f"model_kwargs: '{said[0]}' of DVGO's first version is not taken over; train it with the second"
        )


def shift_of(kwargs: Entries, state: Entries) -> float:
    """What is added to a density before its activation: earlier versions have it from the opacity that
    training began with."""
    if "act_shift" in state.values or "density" not in state.values:
        return state.number("act_shift")
    begun = kwargs.number("alpha_init")
    if not 0 < begun < 1:
        raise FormatError(f"model_kwargs: 'alpha_init' should be between 0 and 1, found {begun:g}")
    return float(np.log(1 / (1 - begun) - 1))


def bounds(state: Entries, kwargs: Entries, name: str) -> np.ndarray:
    """A corner (3,) of the box."""
    return (state if name in state.values else kwargs).array(name, 3).astype(np.float64)


def dense_name(state: Entries, which: str) -> str:
    """What a dense grid is called: before there were others, without a class of its own."""
    return which if which in state.values else f"{which}.grid"


def grid_of(state: Entries, which: str) -> tuple[dict, dict[str, np.ndarray], tuple, np.ndarray | None]:
    """The entry of an encoding, its sections, texels per axis, and the matrix that makes features of those of
    a TensoRF grid."""
    slot = {"density": "density", "k0": "colour"}[which]
    if (name := dense_name(state, which)) in state.values:
        grid = state.array(name, 1, None, None, None, None)[0]
        if which == "density" and len(grid) != 1:
            raise FormatError(f"'{name}' should have one number at a vertex, found {len(grid)}")
        rows = grid[0] if which == "density" else grid.transpose(1, 2, 3, 0)
        numbers = 1 if which == "density" else max(2, len(grid))  # one alone would be no row
        return {"part": "grid", "numbers": numbers}, {f"{slot}_": rows}, grid.shape[1:], None
    vectors = {axis: state.array(f"{which}.{axis}_vec", 1, None, None, 1)[0, :, :, 0] for axis in "xyz"}
    resolution = tuple(vectors[axis].shape[1] for axis in "xyz")
    ranks = [len(vectors[axis]) for _, axis, *_ in MODES]
    rank, made = ranks_filled(ranks), {}
    for i, (name, axis, a, b, _) in enumerate(MODES):
        plane = state.array(f"{which}.{name}_plane", 1, ranks[i], resolution[a], resolution[b])[0]
        filled = ((0, 0), (0, 0), (0, rank - ranks[i]))
        made[f"{slot}_plane_{i}"] = np.pad(plane.transpose(1, 2, 0), filled)
        made[f"{slot}_line_{i}"] = np.pad(vectors[axis].T, filled[1:])
    basis = None
    if which == "k0":
        blocks = np.split(state.array("k0.f_vec", sum(ranks), None).T, np.cumsum(ranks)[:-1], 1)
        basis = beside(blocks, rank)
    return {"part": "plane_line", "rank": rank}, made, resolution, basis


def with_points(values: dict[str, np.ndarray]) -> tuple[dict, dict[str, np.ndarray]]:
    """The entry of the colours' grid and all sections, with three more numbers at a vertex: where in the box
    it lies, from 0 to 1. Interpolated, that is where a point lies."""
    if "colour_" not in values:
        raise FormatError("colours of a TensoRF grid should not read the point, found 'posfreq'")
    rows = values["colour_"]
    axes = np.meshgrid(*(np.linspace(0, 1, n, dtype=np.float32) for n in rows.shape[:3]), indexing="ij")
    rows = np.concatenate([rows, np.stack(axes, -1)], -1)
    return {"part": "grid", "numbers": rows.shape[-1]}, values | {"colour_": rows}


def shading_of(
    kwargs: Entries, state: Entries, count: int, basis: np.ndarray | None
) -> tuple[dict, dict[str, np.ndarray]]:
    """The entry of the colour's decoder, and its sections; count: of features."""
    own = {} if basis is None else {"rgb_basis": basis}
    if not any(str(name).startswith("rgbnet.") for name in state.values):
        if count != 3:
            raise FormatError(f"'k0.grid' should have 3 numbers at a vertex without 'rgbnet', found {count}")
        if basis is None:
            return {"part": "rgb"}, {}
        return {"part": "sh_basis", "coefficients": 1}, {"rgb_basis": basis[:, None] / Y0}
    layers = state.layers("rgbnet.")
    views = frequencies_of(state, "viewfreq", kwargs.whole("viewbase_pe", 0, 16, 4))
    points = frequencies_of(state, "posfreq", 0)
    rows, at = count if basis is not None else 0, 3 * ("posfreq" in state.values)
    # not all versions say whether the first three features are diffuse; the first layer's width does
    direct = layers[0][0].shape[1] == count + at * (1 + 2 * points) + 3 + 6 * views
    order = ColourInput(count + at, rows or eight(count + at), max(views, points), alone=not points)
    columns = [
        order.at("features")[0 if direct else 3 :],
        order.waves("features", points).reshape(2, count + at, points)[:, count:].reshape(-1),
        order.at("direction"),
        order.waves("direction", views),
    ]
    columns = np.concatenate(columns)
    entry, sections = colour_network(layers, order, columns, rows=rows, diffuse=not direct)
    return entry, sections | own


def frequencies_of(state: Entries, name: str, otherwise: int) -> int:
    """How many there are of an encoding; otherwise: where the file has none of this name."""
    if name not in state.values:
        return otherwise
    bands = state.array(name, None)
    if not np.array_equal(bands, 2.0 ** np.arange(len(bands))):
        raise FormatError(f"'{name}' should be 1, 2, 4 and so on, found {bands.tolist()[:9]}")
    return len(bands)


def space_and_placement(kwargs: Entries, state: Entries, box: np.ndarray):
    """The space that the grid lies in, its frame's placement (4, 4), and what is to be said: of contracted
    scenes the cube that is not contracted is the frame's unit."""
    if {"scene_center", "scene_radius"}.isdisjoint(state.values):
        return bounded, np.eye(4), []
    norm = str(kwargs.values.get("contracted_norm", "inf"))
    notes = [] if "contracted_norm" in kwargs.values else [NORM]
    spaces = {"inf": contracted_linf, "l2": contracted_l2}
    if norm not in spaces:
        raise FormatError(f"model_kwargs: 'contracted_norm' should be inf or l2, found {norm[:40]!r}")
    shell = box[3] - 1
    if not 0 < shell <= 1 or not np.allclose(np.abs(box), box[3]):
        raise FormatError(
            f"the box of a contracted scene should be a cube up to 1 to 2, found {box.tolist()}"
        )
    radius = state.array("scene_radius", 3).astype(np.float64)
    if not (radius > 0).all():
        raise FormatError(f"'scene_radius' should be above 0, found {radius.tolist()}")
    placement = np.eye(4)
    placement[:3, :3] = np.diag(radius)
    placement[:3, 3] = state.array("scene_center", 3)
    return space_of(spaces[norm], shell=float(shell), contracted_density=1.0), placement, notes


def cells_of(kwargs: Entries, state: Entries, box: np.ndarray, space) -> tuple[OccupancyGrid, list[str]]:
    """The mask cache, whose samples each stand for a cell around them, and what is to be said of it."""
    if "nonempty_mask" in state.values:
        held = state.array("nonempty_mask", 1, 1, None, None, None)[0, 0] > 0
        if (cells := coarse_cells(kwargs, state, box, held)) is not None:
            return OccupancyGrid(box, cells), [CELLS]
        return OccupancyGrid(box, between(held)), [MASK]
    if {"mask_cache.mask", "mask_cache.xyz2ijk_scale"}.isdisjoint(state.values):
        return OccupancyGrid.full(box, space=space), []
    mask = state.array("mask_cache.mask", None, None, None) > 0
    scale, shift = (state.array(f"mask_cache.xyz2ijk_{n}", 3).astype(np.float64) for n in ("scale", "shift"))
    if not (scale > 0).all():
        raise FormatError("'mask_cache.xyz2ijk_scale' should be above 0")
    faces = [(-0.5 - shift) / scale, (np.array(mask.shape) - 0.5 - shift) / scale]
    return OccupancyGrid(np.concatenate(faces), mask, space), []


def coarse_cells(kwargs: Entries, state: Entries, box: np.ndarray, held: np.ndarray) -> np.ndarray | None:
    """Cells of the box (6,) by the coarse densities of the first version, as fine as MOST_CELLS allows: those
    in whose middle they are above a threshold. What they are at vertices that are `held` (X, Y, Z), and at
    others, tells it, and whether it is the recipe's. None where it does not."""
    if "mask_cache.density" not in state.values or held.all() or not held.any() or min(held.shape) < 2:
        return None
    density = state.array("mask_cache.density", 1, 1, None, None, None)[0, 0].astype(np.float64)
    low, high = (state.array(f"mask_cache.xyz_{end}", 3).astype(np.float64) for end in ("min", "max"))
    parts = max(1, int((MOST_CELLS / np.prod(np.array(held.shape) - 1)) ** (1 / 3) + 1e-9))

    def asked(shares: list[np.ndarray]) -> np.ndarray:
        """The densities where the box is divided by these on each axis, 0 beyond their own."""
        values = density
        for axis, share in enumerate(shares):
            count = density.shape[axis]
            at = box[axis] + share * (box[3 + axis] - box[axis])
            at = (at - low[axis]) / (high[axis] - low[axis]) * (count - 1)
            weights = np.maximum(0, 1 - np.abs(at[:, None] - np.arange(count)))
            values = np.moveaxis(np.tensordot(weights, values, (1, axis)), 0, axis)
        return values

    at_vertices = asked([np.linspace(0, 1, n) for n in held.shape])
    least, most = at_vertices[held].min(), at_vertices[~held].max()
    if not (low < high).all() or most > least + 1e-4 * np.abs(density).max():
        return None
    opacity = kwargs.number("mask_cache_thres", 1e-3)
    usual = np.log(np.expm1(-np.log1p(-opacity))) - BEGUN if 0 < opacity < 1 else least
    threshold = usual if most < usual <= least else (least + most) / 2
    counts = (np.array(held.shape) - 1) * parts
    return asked([(np.arange(n) + 0.5) / n for n in counts]) >= threshold
