"""DVGO's checkpoints, written here as its runs write them, against its formulas in numpy."""

import re
from collections import OrderedDict
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from click.testing import CliRunner

from formats.errors import FormatError
from formats.foreign.systems import open_checkpoint
from fusedrf_cli.bridge.importing import dvgo
from fusedrf_cli.bridge.importing.parts import LLFF
from fusedrf_cli.main import cli
from fusedrf_cli.python import open_scene, verbs
from tests.bridge.importing.asked import (
    answers,
    assert_equal,
    dense,
    directions,
    layer,
    rectified,
    sigmoid,
    softplus,
)

BOX = np.float32([[-1.1, -0.7, -0.9], [0.8, 1.2, 1.0]])
CENTRE, RADIUS = np.float32([0.2, -0.4, 1.0]), np.float32([1.5, 1.5, 1.5])
SHIFT = -1.7


@dataclass(frozen=True)
class Model:
    """What a run of DVGO is told, and what it has come to."""

    size: tuple[int, int, int] = (7, 5, 9)
    channels: int = 12
    """rgbnet_dim, 0 for colours in the grid."""
    direct: bool = True
    depth: int = 3
    width: int = 16
    views: int = 4
    density_ranks: tuple[int, int] | None = None
    """n_comp_xy and n_comp of a TensoRFGrid."""
    colour_ranks: tuple[int, int] | None = None
    mask: tuple[int, int, int] | None = (7, 5, 9)
    contracted: str | None = None
    shell: float = 0.2
    bare: bool = False
    """As before there were classes of grids."""
    points: int | None = None
    """posbase_pe of the first version, whose colours read the point."""
    implicit: bool = False
    """rgbnet_full_implicit of the first version, whose colours read no grid."""


MODELS = {
    "fine": Model(),
    "coarse": Model(channels=0),
    "indirect": Model(direct=False),
    "indirect of nine": Model(channels=9, direct=False, depth=4, width=20),
    "no mask": Model(mask=None),
    "a finer mask": Model(mask=(14, 9, 20)),
    "two layers": Model(depth=2, channels=8),
    "no frequencies": Model(views=0, channels=6),
    "eight frequencies": Model(views=8, channels=3),
    "one channel": Model(channels=1),
    "TensoRF grids": Model(density_ranks=(8, 8), colour_ranks=(16, 16)),
    "TensoRF grids of two ranks": Model(density_ranks=(3, 5), colour_ranks=(12, 7), direct=False),
    "TensoRF density": Model(density_ranks=(4, 4)),
    "TensoRF colours, coarse": Model(channels=0, colour_ranks=(6, 6)),
    "contracted": Model(size=(8, 8, 8), mask=(8, 8, 8), contracted="inf", channels=9),
    "contracted, coarse": Model(size=(8, 8, 8), mask=None, contracted="inf", channels=0, shell=0.6),
    "contracted by l2": Model(size=(8, 8, 8), mask=(8, 8, 8), contracted="l2"),
    "contracted by l2 to 2": Model(size=(8, 8, 8), mask=None, contracted="l2", shell=1.0, channels=4),
    "contracted TensoRF grids": Model(
        size=(8, 8, 8), mask=(9, 9, 9), contracted="inf", density_ranks=(4, 4), colour_ranks=(6, 6)
    ),
    "without classes": Model(bare=True),
    "without classes, coarse": Model(bare=True, channels=0, mask=None),
    "first version": Model(bare=True, mask=None, direct=False, points=5),
    "first version, direct": Model(bare=True, mask=None, points=5, width=20, depth=4),
    "first version, more frequencies of the direction": Model(bare=True, mask=None, points=2, views=3),
    "first version, the point alone": Model(bare=True, mask=None, points=0, channels=7),
    "first version, direction alone": Model(bare=True, mask=None, points=4, views=0, direct=False),
    "first version, no features": Model(bare=True, mask=None, points=5, implicit=True),
}


def box_of(model: Model) -> np.ndarray:
    """(2, 3) of the grid."""
    reach = np.float32(1 + model.shell)
    return BOX if model.contracted is None else np.float32([[-reach] * 3, [reach] * 3])


def state_of(model: Model) -> OrderedDict:
    state, draw = OrderedDict(), torch.Generator().manual_seed(4)
    low, high = (torch.from_numpy(corner) for corner in box_of(model))

    def grid(name: str, channels: int, ranks: tuple[int, int] | None, spread: float) -> None:
        def drawn(*shape: int) -> torch.Tensor:
            return spread * torch.randn(*shape, generator=draw)

        x, y, z = model.size
        if ranks is None:
            state[name if model.bare else f"{name}.grid"] = drawn(1, channels, x, y, z)
        else:
            rxy, r = ranks
            shapes = {"xy": (rxy, x, y), "xz": (r, x, z), "yz": (r, y, z)}
            state.update({f"{name}.{axes}_plane": drawn(1, *shape) for axes, shape in shapes.items()})
            shapes = {"x": (r, x), "y": (r, y), "z": (rxy, z)}
            state.update({f"{name}.{axis}_vec": drawn(1, *shape, 1) for axis, shape in shapes.items()})
            if channels > 1:
                state[f"{name}.f_vec"] = torch.randn(rxy + 2 * r, channels, generator=draw)
        if not model.bare:
            state.update({f"{name}.xyz_min": low, f"{name}.xyz_max": high})

    if model.contracted is not None:
        state |= {"scene_center": torch.from_numpy(CENTRE), "scene_radius": torch.from_numpy(RADIUS)}
    state |= {"xyz_min": low, "xyz_max": high}
    if not model.bare:
        state["act_shift"] = torch.tensor([SHIFT])
    grid("density", 1, model.density_ranks, 2.0)
    grid("k0", 0 if model.implicit else model.channels or 3, model.colour_ranks, 1.0)
    if model.channels:
        read = model.channels * (not model.implicit) - 3 * (not model.direct) + 3 + 6 * model.views
        if model.points is not None:
            state["posfreq"] = torch.FloatTensor([2**i for i in range(model.points)])
            read += 3 + 6 * model.points
        state["viewfreq"] = torch.tensor([2.0**i for i in range(model.views)])
        layer(state, "rgbnet.0", read, model.width)
        for i in range(model.depth - 2):
            layer(state, f"rgbnet.{i + 2}.0", model.width, model.width)
        layer(state, f"rgbnet.{model.depth}", model.width, 3)
    if model.mask is not None:
        shape = torch.tensor(model.mask)
        state["mask_cache.mask"] = torch.rand(model.mask, generator=draw) < 0.7
        state["mask_cache.xyz2ijk_scale"] = (shape - 1) / (high - low)
        state["mask_cache.xyz2ijk_shift"] = -low * state["mask_cache.xyz2ijk_scale"]
    return state


def kwargs_of(model: Model) -> dict:
    low, high = box_of(model)
    more = {} if model.contracted is None else {"contracted_norm": model.contracted}
    return more | {
        "xyz_min": low, "xyz_max": high, "num_voxels": int(np.prod(model.size)), "num_voxels_base": 500,
        "alpha_init": 0.15, "voxel_size_ratio": torch.tensor(1.3), "mask_cache_path": "./coarse_last.tar",
        "mask_cache_thres": 1e-3, "fast_color_thres": 1e-4, "rgbnet_dim": model.channels,
        "rgbnet_direct": model.direct, "rgbnet_full_implicit": model.implicit, "rgbnet_depth": model.depth,
        "rgbnet_width": model.width, "viewbase_pe": model.views, "posbase_pe": model.points or 5,
    }  # fmt: skip


def saved(model: Model, folder, change=lambda held: None):
    held = {
        "global_step": 20000, "model_kwargs": kwargs_of(model), "model_state_dict": state_of(model),
        "optimizer_state_dict": {"state": {}, "param_groups": []},
    }  # fmt: skip
    change(held)
    torch.save(held, folder / "fine_last.tar")
    return folder / "fine_last.tar"


# -- its formulas --------------------------------------------------------------------------------------------


def sampled(texels: np.ndarray, at: np.ndarray) -> np.ndarray:
    """F.grid_sample with align_corners of texels (C, ..) at (N, axes) in 0 to 1: (N, C)."""
    counts = np.array(texels.shape[1:])
    where = np.clip(at, 0, 1) * (counts - 1)
    low = np.minimum(where.astype(int), counts - 2)
    total = 0
    for corner in np.ndindex(*[2] * len(counts)):
        weight = np.where(np.array(corner) == 1, where - low, 1 - (where - low)).prod(1)
        total = total + weight * texels[(slice(None), *(low + corner).T)]
    return total.T


def of_grid(state: dict, name: str, at: np.ndarray) -> np.ndarray:
    """DenseGrid.forward and TensoRFGrid.forward: (N, channels)."""
    if name in state or f"{name}.grid" in state:
        return sampled(state[name if name in state else f"{name}.grid"].double().numpy()[0], at)
    parts = []
    for axes, axis in (("xy", "z"), ("xz", "y"), ("yz", "x")):
        plane = state[f"{name}.{axes}_plane"].double().numpy()[0]
        line = state[f"{name}.{axis}_vec"].double().numpy()[0, :, :, 0]
        parts.append(
            sampled(plane, at[:, ["xyz".index(a) for a in axes]]) * sampled(line, at[:, ["xyz".index(axis)]])
        )
    features = np.concatenate(parts, 1)
    if f"{name}.f_vec" in state:
        return features @ state[f"{name}.f_vec"].double().numpy()
    return features.sum(1, keepdims=True)


def contracted(model: Model, x: np.ndarray) -> np.ndarray:
    """Where DirectContractedVoxGO.sample_ray puts points."""
    if model.contracted is None:
        return x
    x = (x - CENTRE.astype(np.float64)) / RADIUS
    norm = np.abs(x).max(1) if model.contracted == "inf" else np.linalg.norm(x, axis=1)
    outside = np.maximum(norm, 1)[:, None]
    return np.where(norm[:, None] <= 1, x, x / outside * ((1 + model.shell) - model.shell / outside))


def expected(model: Model, points: np.ndarray, dirs: np.ndarray):
    """(σ, rgb) of DirectVoxGO.forward and DirectContractedVoxGO.forward, σ per length of the world: what it
    is per length of the grid's space times how long that is, by differences."""
    state, (low, high) = state_of(model), box_of(model).astype(np.float64)
    p = contracted(model, points)
    at = (p - low) / (high - low)
    base = ((high - low).prod() / 500) ** (1 / 3)
    shift = np.log(1 / (1 - 0.15) - 1) if model.bare else SHIFT
    sigma = softplus(of_grid(state, "density", at)[:, 0] + shift) / base
    h = 1e-6
    sigma *= np.linalg.norm(
        contracted(model, points + h * dirs) - contracted(model, points - h * dirs), axis=1
    )
    sigma = np.where(((at >= 0) & (at <= 1)).all(1), sigma / (2 * h), 0)
    if model.mask is not None:
        scale, offset = (state[f"mask_cache.xyz2ijk_{n}"].double().numpy() for n in ("scale", "shift"))
        index, mask = np.rint(p * scale + offset).astype(int), state["mask_cache.mask"].numpy()
        held = ((index >= 0) & (index < mask.shape)).all(1)
        sigma = np.where(held & mask[tuple(np.clip(index, 0, np.array(mask.shape) - 1).T)], sigma, 0)
    k0 = of_grid(state, "k0", at)
    if not model.channels:
        return sigma, sigmoid(k0)
    read = [k0 if model.direct else k0[:, 3:]]
    for x, levels in ((at, model.points), (dirs, model.views)):
        if levels is not None:
            angles = (x[..., None] * 2.0 ** np.arange(levels)).reshape(len(x), -1)
            read += [x, np.sin(angles), np.cos(angles)]
    h = np.concatenate(read, 1)
    for name in ["0", *(f"{i + 2}.0" for i in range(model.depth - 2))]:
        h = rectified(dense(state, f"rgbnet.{name}", h))
    logits = dense(state, f"rgbnet.{model.depth}", h)
    return sigma, sigmoid(logits if model.direct else logits + k0[:, :3])


def points_around(model: Model, count: int = 400) -> np.ndarray:
    """Most of them in the box, or within five radii."""
    rng = np.random.default_rng(1)
    if model.contracted is None:
        return BOX.mean(0) + 1.1 * (BOX[1] - BOX[0]) / 2 * rng.uniform(-1, 1, (count, 3))
    return CENTRE + RADIUS * 5 ** rng.uniform(-1, 1, (count, 1)) * directions(count, 2)


# -- what is taken over --------------------------------------------------------------------------------------


@pytest.mark.parametrize("model", MODELS.values(), ids=MODELS)
def test_a_model_answers_as_dvgo(model, tmp_path):
    points, dirs = points_around(model), directions(400)
    imported = dvgo.read(open_checkpoint(saved(model, tmp_path)))
    wanted = expected(model, points, dirs)
    assert_equal(answers(imported.nodes[0], points, dirs), wanted, both=model.contracted is None)
    assert not imported.notes


@pytest.mark.slow
@pytest.mark.parametrize("name", ["indirect", "contracted by l2", "first version"])
def test_the_compiled_loops_answer_so_as_well(name, tmp_path):
    model, dirs = MODELS[name], directions(400)
    points = points_around(model)
    verbs.import_field(saved(model, tmp_path), tmp_path / "a.rfpack")
    found = open_scene(tmp_path / "a.rfpack").query(torch.from_numpy(points), torch.from_numpy(dirs))
    assert_equal([answer.detach().numpy() for answer in found], expected(model, points, dirs), both=False)


def test_vertices_that_the_first_version_masks_are_taken_as_they_are(tmp_path):
    """A voxel counts where one of its vertices does; what the file lacks is said."""
    model, dirs = MODELS["without classes, coarse"], directions(400)
    points, mask = points_around(model), np.random.default_rng(5).random(model.size) < 0.2

    def masked(held: dict) -> None:
        held["model_state_dict"]["nonempty_mask"] = torch.from_numpy(mask[None, None])

    imported = dvgo.read(open_checkpoint(saved(model, tmp_path, masked)))
    sigma, rgb = expected(model, points, dirs)
    low = np.floor((points - BOX[0]) / (BOX[1] - BOX[0]) * (np.array(model.size) - 1)).astype(int)
    corners = low[:, None] + np.stack(np.meshgrid(*[[0, 1]] * 3, indexing="ij"), -1).reshape(-1, 3)
    inside = ((corners >= 0) & (corners < model.size)).all((1, 2))
    kept = mask[tuple(np.moveaxis(np.clip(corners, 0, np.array(model.size) - 1), 2, 0))].any(1)
    assert_equal(answers(imported.nodes[0], points, dirs), (np.where(inside & kept, sigma, 0), rgb))
    assert imported.notes == [dvgo.MASK]


def coarse_mask(shape: tuple[int, int, int], low: np.ndarray, high: np.ndarray):
    """Densities of a first version's coarse stage, as MaskCache has them, and which points its forward keeps:
    a ball."""
    at = np.stack(
        np.meshgrid(*(np.linspace(a, b, n) for a, b, n in zip(low, high, shape, strict=True)), indexing="ij"),
        -1,
    )
    density = np.float32(12 - 10 * np.linalg.norm(at - BOX.mean(0), axis=-1))
    density = torch.nn.functional.max_pool3d(torch.from_numpy(density)[None, None], 3, 1, 1)
    shift = np.log(1 / (1 - 1e-6) - 1)

    def keeps(points: np.ndarray) -> np.ndarray:
        at = torch.from_numpy((points.astype(np.float64) - low) / (high - low) * 2 - 1)
        grid = at[None, None, None].flip(-1)
        raw = torch.nn.functional.grid_sample(density.double(), grid, align_corners=True)[0, 0, 0, 0]
        return 1 - np.exp(-softplus(raw.numpy() + shift)) >= 1e-3

    return density, keeps


@pytest.mark.parametrize("size", [(7, 5, 9), (41, 47, 44)])
def test_a_mask_of_coarse_densities_is_taken_in_fine_cells(size, tmp_path):
    """As well as cells are fine; that it is so is said."""
    model = replace(MODELS["first version"], size=size)
    low, high = BOX[0] - np.float32(0.1), BOX[1] + np.float32([0.1, 0.2, -0.3])
    density, keeps = coarse_mask((11, 13, 12), low, high)
    vertices = np.meshgrid(*(np.linspace(a, b, n) for a, b, n in zip(*BOX, size, strict=True)), indexing="ij")
    held = keeps(np.stack(vertices, -1).reshape(-1, 3)).reshape(size)

    def masked(held_file: dict) -> None:
        state = held_file["model_state_dict"]
        state |= {"mask_cache.density": density, "nonempty_mask": torch.from_numpy(held[None, None])}
        state |= {f"mask_cache.xyz_{n}": torch.from_numpy(at) for n, at in (("min", low), ("max", high))}

    imported = dvgo.read(open_checkpoint(saved(model, tmp_path, masked)))
    points, dirs = BOX[0] + (BOX[1] - BOX[0]) * np.random.default_rng(3).random((4000, 3)), directions(4000)
    found, (sigma, _) = answers(imported.nodes[0], points, dirs)[0], expected(model, points, dirs)
    wanted = np.where(keeps(points), sigma, 0)
    assert (wanted > 0).mean() > 0.03 and (wanted == 0).mean() > 0.3
    assert np.isclose(found, wanted, rtol=1e-4).mean() > 0.99
    assert imported.notes == [dvgo.CELLS]


def test_a_tensorf_grid_whose_colours_read_the_point_is_none(tmp_path):
    path = saved(MODELS["TensoRF grids"], tmp_path, in_state(posfreq=2.0 ** torch.arange(5)))
    with pytest.raises(FormatError, match="colours of a TensoRF grid should not read the point"):
        dvgo.read(open_checkpoint(path))


def test_a_contraction_whose_norm_is_not_said_is_the_later_ones(tmp_path):
    model = MODELS["contracted"]
    points, dirs = points_around(model), directions(400)
    path = saved(model, tmp_path, lambda held: held["model_kwargs"].pop("contracted_norm"))
    imported = dvgo.read(open_checkpoint(path))
    assert_equal(answers(imported.nodes[0], points, dirs), expected(model, points, dirs), both=False)
    assert imported.notes == [dvgo.NORM]


# -- files that are wrong, or are not taken over -------------------------------------------------------------


def in_kwargs(**values):
    return lambda held: held["model_kwargs"].update(values)


def in_state(**values):
    return lambda held: held["model_state_dict"].update({n.replace("__", "."): v for n, v in values.items()})


def without(name: str):
    return lambda held: held["model_state_dict"].pop(name)


def with_nan(held: dict) -> None:
    held["model_state_dict"]["k0.grid"][0, 0, 0, 0, 0] = np.nan


def without_network(held: dict) -> None:
    for name in [name for name in held["model_state_dict"] if name.startswith("rgbnet")]:
        without(name)(held)


BROKEN = {
    "no shift": (without("act_shift"), "'act_shift' is missing"),
    "grids that differ": (in_state(k0__grid=torch.zeros(1, 12, 7, 5, 8)), "grids of density and colour are"),
    "two densities": (in_state(density__grid=torch.zeros(1, 2, 7, 5, 9)), "have one number at a vertex, fou"),
    "four axes": (in_state(density__grid=torch.zeros(1, 7, 5, 9)), "'density.grid' should have shape"),
    "fewer channels": (in_state(k0__grid=torch.zeros(1, 11, 7, 5, 9)), "should read 35 numbers, found 39"),
    "odd frequencies": (in_state(viewfreq=torch.ones(4)), "'viewfreq' should be 1, 2, 4 and so on"),
    "no bias": (without("rgbnet.2.0.bias"), "biases of some layers only"),
    "no mask": (without("mask_cache.mask"), "'mask_cache.mask' is missing"),
    "no centre": (in_state(scene_radius=torch.ones(3)), "a cube up to 1 to 2"),
    "other frequencies": (in_state(viewfreq=2 ** torch.arange(3)), "should read 30 numbers, found 39"),
    "no middle layer": (without("rgbnet.2.0.weight"), "layers 0, 3: one is missing"),
    "no last layer": (without("rgbnet.3.weight"), "should make 3 numbers, found 16"),
    "no network": (without_network, "3 numbers at a vertex without 'rgbnet', found 12"),
    "a box inside out": (in_state(xyz_min=torch.ones(3) * 2), "three minima below three maxima"),
    "no voxels": (in_kwargs(num_voxels_base=0), "'num_voxels_base' should be above 0, found 0"),
    "a mask without scale": (without("mask_cache.xyz2ijk_scale"), "'mask_cache.xyz2ijk_scale' is missing"),
    "a mask of no scale": (in_state(mask_cache__xyz2ijk_scale=torch.zeros(3)), "should be above 0"),
    "a flat mask": (in_state(mask_cache__mask=torch.ones(7, 5)), "'mask_cache.mask' should have shape"),
    "NaN": (with_nan, "'k0.grid' holds NaN"),
    "odd frequencies of the point": (in_state(posfreq=torch.ones(5)), "'posfreq' should be 1, 2, 4 and"),
    "a point that no layer reads": (in_state(posfreq=2 ** torch.arange(5)), "should read 69 num.* found 39"),
    "an earlier forward-facing scene": (in_kwargs(mpi_depth=128), "of DVGO .NDC., which is not read; its de"),
    "nearest vertices": (in_kwargs(nearest=True), "'nearest' of DVGO's first version is not taken over"),
    "no radius": (in_state(scene_center=torch.zeros(3), scene_radius=torch.zeros(3)), "cube up to 1 to 2"),
    "planes in device coordinates": (in_state(act_shift__grid=torch.zeros(1, 1, 1, 1, 9)), "a camera"),
}  # fmt: skip


@pytest.mark.parametrize("change, said", BROKEN.values(), ids=BROKEN)
def test_what_is_wrong_with_a_file_is_named_and_nothing_is_written(change, said, tmp_path):
    path = saved(Model(), tmp_path, change)
    result = CliRunner().invoke(cli, ["import", str(path), "-o", str(tmp_path / "a.rfpack")])
    assert result.exit_code == 3 and re.search(f"fine_last.tar: .*{said}", result.output), result.output
    assert not (tmp_path / "a.rfpack").exists()


@pytest.mark.parametrize("name, value, said", [
    ("scene_radius", torch.tensor([1.0, 0.0, 1.0]), "'scene_radius' should be above 0"),
    ("xyz_max", torch.tensor([1.2, 1.2, 1.3]), "should be a cube up to 1 to 2"),
    ("xyz_max", torch.tensor([2.2] * 3), "should be a cube up to 1 to 2"),
])  # fmt: skip
def test_what_is_wrong_with_a_contracted_scene_is_named(name, value, said, tmp_path):
    path = saved(MODELS["contracted"], tmp_path, in_state(**{name: value}))
    result = CliRunner().invoke(cli, ["import", str(path), "-o", str(tmp_path / "a.rfpack")])
    assert result.exit_code == 3 and said in result.output, result.output


def test_an_opacity_that_is_none_is_named(tmp_path):
    path = saved(MODELS["without classes"], tmp_path, in_kwargs(alpha_init=1.0))
    with pytest.raises(FormatError, match="'alpha_init' should be between 0 and 1, found 1"):
        dvgo.read(open_checkpoint(path))


def test_an_llff_capture_is_said_to_have_been_moved(tmp_path):
    """By load_llff.py, which moves and scales cameras; other loaders take them as they are."""
    path = saved(Model(), tmp_path)
    for kind in ("llff", "blender"):
        (tmp_path / "config.py").write_text(f"data = dict(datadir='./x', dataset_type='{kind}')\n")
        assert (LLFF in dvgo.read(open_checkpoint(path)).notes) == (kind == "llff")
