"""TensoRF's checkpoints, written here as its runs write them, against its formulas in numpy."""

import re
from collections import OrderedDict
from dataclasses import dataclass

import numpy as np
import pytest
import torch
from click.testing import CliRunner

from formats.foreign.systems import open_checkpoint
from fusedrf_cli.bridge.importing import tensorf
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
PLANES, LINES = ((0, 1), (0, 2), (1, 2)), (2, 1, 0)  # matMode, vecMode


@dataclass(frozen=True)
class Model:
    """What a run of TensoRF is told, and what it has come to."""

    name: str = "TensorVMSplit"
    grid: tuple[int, int, int] = (7, 5, 9)
    density: tuple[int, ...] = (16, 4, 4)
    colour: tuple[int, ...] = (24, 12, 8)
    features: int = 27
    shading: str = "MLP_Fea"
    view: int = 2
    feature: int = 2
    point: int = 6
    width: int = 16
    activation: str = "softplus"
    mask: tuple[int, int, int] | None = None
    mask_box: tuple[float, float] = (-0.1, 1.1)
    """Of the mask, where the box is 0 to 1."""
    scale: float = 25
    reads_point: bool = False
    near_far: tuple[float, float] = (2.0, 6.0)


MODELS = {
    "usual": Model(density=(16, 16, 16), colour=(48, 48, 48)),
    "ranks that differ": Model(mask=(4, 6, 5)),
    "mask of the same box": Model(mask=(9, 9, 9), mask_box=(0, 1)),
    "mask in the box": Model(mask=(5, 4, 6), mask_box=(0.2, 0.7)),
    "no frequencies": Model(view=0, feature=0),
    "of the direction alone": Model(view=3, feature=0),
    "of the features alone": Model(view=0, feature=3),
    "eight features": Model(features=8, width=20),
    "MLP": Model(shading="MLP", view=4),
    "MLP without frequencies": Model(shading="MLP", view=0),
    "MLP_PE": Model(shading="MLP_PE", point=3, view=2),
    "MLP_PE that reads the point": Model(shading="MLP_PE", point=2, view=2, reads_point=True),
    "MLP_PE without frequencies": Model(shading="MLP_PE", point=0, view=0),
    "SH": Model(shading="SH", activation="relu"),
    "SH, softplus, mask": Model(shading="SH", mask=(4, 4, 4)),
    "RGB": Model(shading="RGB", features=3, density=(8, 8, 8), colour=(24, 24, 24)),
    "RGB, relu": Model(shading="RGB", features=3, activation="relu", scale=1),
    "CP": Model(name="TensorCP", density=(12,), colour=(20,)),
    "CP, SH, relu, mask": Model(
        name="TensorCP", density=(96,), colour=(28,), shading="SH", activation="relu", mask=(3, 4, 5)
    ),
    "CP, RGB": Model(name="TensorCP", density=(8,), colour=(9,), shading="RGB", features=3),
    "CP, MLP_PE": Model(name="TensorCP", density=(8,), colour=(9,), shading="MLP_PE", view=3, point=4),
    "TensorVM": Model(name="TensorVM", grid=(6, 6, 6), density=(8,), colour=(12,)),
    "another distance scale": Model(scale=3.5),
}


def state_of(model: Model) -> OrderedDict:
    """The state of a model, on a grid of texels along x, y and z."""
    state, draw = OrderedDict(), torch.Generator().manual_seed(5)

    def drawn(*shape: int) -> torch.Tensor:
        return 0.9 * torch.randn(*shape, generator=draw)

    def factors(which: str, ranks: tuple[int, ...]) -> None:
        if model.name == "TensorVMSplit":
            for i, (a, b) in enumerate(PLANES):
                state[f"{which}_plane.{i}"] = drawn(1, ranks[i], model.grid[b], model.grid[a])
        for i, axis in enumerate(LINES):
            rank = ranks[min(i, len(ranks) - 1)]
            state[f"{which}_line.{i}"] = drawn(1, rank, model.grid[axis], 1)

    if model.name == "TensorVM":
        ranks, size = model.density[0] + model.colour[0], model.grid[0]
        state["plane_coef"], state["line_coef"] = drawn(3, ranks, size, size), drawn(3, ranks, size, 1)
    else:
        factors("density", model.density)
        factors("app", model.colour)
    held = 3 * model.colour[0] if model.name == "TensorVM" else sum(model.colour)
    layer(state, "basis_mat", held, model.features, bias=False)
    if model.shading.startswith("MLP"):
        inputs = model.features + 3 + 6 * model.view
        inputs += 2 * model.feature * model.features if model.shading == "MLP_Fea" else 0
        inputs += 6 * model.point + 3 * model.reads_point if model.shading == "MLP_PE" else 0
        layer(state, "renderModule.mlp.0", inputs, model.width)
        layer(state, "renderModule.mlp.2", model.width, model.width)
        layer(state, "renderModule.mlp.4", model.width, 3)
    return state


def mask_of(model: Model) -> tuple[np.ndarray, np.ndarray]:
    """(1, 1, Z, Y, X) of 0 and 1, and its box (2, 3)."""
    low, high = (BOX[0] + share * (BOX[1] - BOX[0]) for share in model.mask_box)
    volume = np.random.default_rng(2).random((1, 1, *reversed(model.mask))) < 0.3
    return volume, np.stack([low, high]).astype(np.float32)


def kwargs_of(model: Model) -> dict:
    ranks = [list(r) if model.name != "TensorVM" else r[0] for r in (model.density, model.colour)]
    return {
        "aabb": torch.from_numpy(BOX), "gridSize": list(model.grid), "density_n_comp": ranks[0],
        "appearance_n_comp": ranks[1], "app_dim": model.features, "density_shift": -10,
        "alphaMask_thres": 1e-4, "distance_scale": model.scale, "rayMarch_weight_thres": 1e-4,
        "fea2denseAct": model.activation, "near_far": list(model.near_far), "step_ratio": 0.5,
        "shadingMode": model.shading, "pos_pe": model.point, "view_pe": model.view, "fea_pe": model.feature,
        "featureC": model.width,
    }  # fmt: skip


def saved(model: Model, folder, kwargs: dict | None = None, state: dict | None = None, **more):
    """A checkpoint as TensorBase.save writes it."""
    held = {"kwargs": kwargs or kwargs_of(model), "state_dict": state or state_of(model)}
    if model.mask is not None:
        volume, box = mask_of(model)
        held |= {"alphaMask.shape": volume.shape, "alphaMask.mask": np.packbits(volume.reshape(-1))}
        held["alphaMask.aabb"] = torch.from_numpy(box)
    torch.save(held | more, folder / "scene.th")
    return folder / "scene.th"


# -- its formulas --------------------------------------------------------------------------------------------


def sampled(texels: np.ndarray, *at: np.ndarray) -> np.ndarray:
    """F.grid_sample with align_corners of texels (R, n, ..) at (N,) in [-1, 1] for each axis: (R, N), with
    zeros around them."""
    total = 0
    where = [(x + 1) / 2 * (n - 1) for x, n in zip(at, texels.shape[1:], strict=True)]
    for corner in np.ndindex(*[2] * len(at)):
        index = [np.floor(x).astype(int) + c for x, c in zip(where, corner, strict=True)]
        weight = np.prod([1 - np.abs(x - i) for x, i in zip(where, index, strict=True)], 0)
        held = np.all([(i >= 0) & (i < n) for i, n in zip(index, texels.shape[1:], strict=True)], 0)
        kept = tuple(np.clip(i, 0, n - 1) for i, n in zip(index, texels.shape[1:], strict=True))
        total = total + np.where(held, weight, 0) * texels[(slice(None), *kept)]
    return total


def features_of(model: Model, state: dict, which: str, x: np.ndarray) -> list[np.ndarray]:
    """(ranks, N) of each mode, or of the only one of TensorCP."""

    def held(part: str, i: int) -> np.ndarray:
        if model.name != "TensorVM":
            return state[f"{which}_{part}.{i}"].double().numpy()[0]
        both, count = state[f"{part}_coef"].double().numpy()[i], model.density[0]
        return both[-count:] if which == "density" else both[: model.colour[0]]

    lines = [sampled(held("line", i)[:, :, 0], x[:, axis]) for i, axis in enumerate(LINES)]
    if model.name == "TensorCP":
        return [lines[0] * lines[1] * lines[2]]
    return [sampled(held("plane", i), x[:, b], x[:, a]) * lines[i] for i, (a, b) in enumerate(PLANES)]


def waves(x: np.ndarray, frequencies: int) -> np.ndarray:
    """positional_encoding."""
    angles = (x[..., None] * 2.0 ** np.arange(frequencies)).reshape(len(x), -1)
    return np.concatenate([np.sin(angles), np.cos(angles)], 1)


def harmonics(d: np.ndarray) -> np.ndarray:
    """eval_sh_bases of degree 2."""
    x, y, z = d.T
    c = 1.0925484305920792
    return np.stack([
        0.28209479177387814 + 0 * x, -0.4886025119029199 * y, 0.4886025119029199 * z,
        -0.4886025119029199 * x, c * x * y, -c * y * z, 0.31539156525252005 * (2 * z * z - x * x - y * y),
        -c * x * z, 0.5462742152960396 * (x * x - y * y),
    ], 1)  # fmt: skip


def expected(model: Model, points: np.ndarray, dirs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(σ, rgb) of TensorBase.forward and of its render modules."""
    state, box = state_of(model), BOX.astype(np.float64)
    x = (points - box[0]) * 2 / (box[1] - box[0]) - 1
    raw = np.sum([part.sum(0) for part in features_of(model, state, "density", x)], 0)
    sigma = model.scale * (softplus(raw - 10) if model.activation == "softplus" else rectified(raw))
    sigma = np.where((np.abs(x) <= 1).all(1), sigma, 0)
    if model.mask is not None:
        volume, mask_box = mask_of(model)
        at = (points - mask_box[0]) * 2 / (mask_box[1] - mask_box[0]).astype(np.float64) - 1
        sigma = np.where(sampled(volume[0].astype(float), *at.T[::-1])[0] > 0, sigma, 0)
    features = dense(state, "basis_mat", np.concatenate(features_of(model, state, "app", x)).T)
    if model.shading == "SH":
        return sigma, rectified((harmonics(dirs)[:, None] * features.reshape(-1, 3, 9)).sum(2) + 0.5)
    if model.shading == "RGB":
        return sigma, features
    read = [features, dirs]
    if model.shading == "MLP_Fea":
        read += [waves(features, model.feature)]
    if model.shading == "MLP_PE":
        read += [x] * model.reads_point + [waves(x, model.point)]
    h = np.concatenate([*read, waves(dirs, model.view)], 1)
    for name in ("0", "2"):
        h = rectified(dense(state, f"renderModule.mlp.{name}", h))
    return sigma, sigmoid(dense(state, "renderModule.mlp.4", h))


def points_around(count: int = 400) -> np.ndarray:
    """Most of them in the box."""
    middle, half = BOX.mean(0), (BOX[1] - BOX[0]) / 2
    return middle + 1.1 * half * np.random.default_rng(1).uniform(-1, 1, (count, 3))


# -- what is taken over --------------------------------------------------------------------------------------


@pytest.mark.parametrize("model", MODELS.values(), ids=MODELS)
def test_a_model_answers_as_tensorf(model, tmp_path):
    points, dirs = points_around(), directions(400)
    imported = tensorf.read(open_checkpoint(saved(model, tmp_path)))
    assert_equal(answers(imported.nodes[0], points, dirs), expected(model, points, dirs))
    assert not imported.notes


@pytest.mark.slow
def test_the_compiled_loops_answer_so_as_well(tmp_path):
    model, points, dirs = MODELS["mask in the box"], points_around(), directions(400)
    report = verbs.import_field(saved(model, tmp_path), tmp_path / "a.rfpack")
    assert report["system"] == "TensoRF" and not report["notes"]
    scene = open_scene(tmp_path / "a.rfpack")
    found = scene.query(torch.from_numpy(points), torch.from_numpy(dirs))
    assert_equal([answer.detach().numpy() for answer in found], expected(model, points, dirs))


def test_options_that_old_files_leave_out_have_their_defaults(tmp_path):
    model = Model(shading="MLP_PE", view=6, point=6)
    kwargs = {"aabb": torch.from_numpy(BOX), "gridSize": list(model.grid)}
    points, dirs = points_around(), directions(400)
    imported = tensorf.read(open_checkpoint(saved(model, tmp_path, kwargs)))
    assert_equal(answers(imported.nodes[0], points, dirs), expected(model, points, dirs))


def test_a_frame_of_device_coordinates_is_said_to_be_one(tmp_path):
    imported = tensorf.read(open_checkpoint(saved(Model(near_far=(0.0, 1.0)), tmp_path)))
    assert imported.notes == [tensorf.NDC]


# -- files that are wrong ------------------------------------------------------------------------------------


def in_kwargs(**values):
    return lambda held: held["kwargs"].update(values)


def in_state(name: str, value):
    return lambda held: held["state_dict"].update({name: value})


def without(name: str):
    return lambda held: held["state_dict"].pop(name)


def with_nan(held: dict) -> None:
    held["state_dict"]["app_plane.1"][0, 0, 0, 0] = np.nan


BROKEN = {
    "no lines": (without("app_line.1"), "'app_line.1' is missing"),
    "no basis": (without("basis_mat.weight"), "'basis_mat.weight' is missing"),
    "no network": (without("renderModule.mlp.0.weight"), "layers 2, 4: one is missing"),
    "no middle layer": (without("renderModule.mlp.2.weight"), "layers 0, 4: one is missing"),
    "another plane": (in_state("density_plane.1", torch.zeros(1, 4, 9, 6)), r"'density_plane.1' should have"),
    "another grid": (in_state("app_line.2", torch.zeros(1, 8, 6, 1)), "'app_plane.0' should have shape"),
    "a grid for each": (
        lambda held: held["state_dict"].update(
            {k: v for k, v in state_of(Model(grid=(7, 5, 8))).items() if k.startswith("app_")}
        ),
        "grids of density and colour are of",
    ),
    "a basis of less": (in_state("basis_mat.weight", torch.zeros(27, 43)), "shape .*any.* 44|44"),
    "other frequencies": (in_kwargs(fea_pe=3), "should read 204 numbers, found 150|read"),
    "frequencies of a fraction": (in_kwargs(view_pe=1.5), "'view_pe' should be a whole number from 0 to 16"),
    "an unknown shading": (in_kwargs(shadingMode="Disney"), "'Disney' is not known: MLP_Fea"),
    "an unknown activation": (in_kwargs(fea2denseAct="exp"), "should be softplus or relu, found 'exp'"),
    "SH of 26": (in_kwargs(shadingMode="RGB"), "should have 3 rows for RGB shading, found 27"),
    "a box inside out": (in_kwargs(aabb=torch.from_numpy(BOX[::-1].copy())), "three minima below three"),
    "half a box": (in_kwargs(aabb=torch.zeros(3)), r"'aabb' should have shape \[2, 3\]"),
    "no distance": (in_kwargs(distance_scale=0), "scale should be above 0"),
    "NaN": (with_nan, "'app_plane.1' holds NaN"),
    "a mask of less": (lambda held: held.update({"alphaMask.shape": (1, 1, 50, 60, 40)}), "bits of a grid"),
    "a mask of no shape": (lambda held: held.pop("alphaMask.shape"), "'alphaMask.shape' is missing"),
    "no bias": (without("renderModule.mlp.2.bias"), "biases of some layers only"),
    "a mask of no box": (lambda held: held.pop("alphaMask.aabb"), "'alphaMask.aabb' is missing"),
    "a mask of no bits": (lambda held: held.pop("alphaMask.mask"), "'alphaMask.mask' is missing"),
}


@pytest.mark.parametrize("change, said", BROKEN.values(), ids=BROKEN)
def test_what_is_wrong_with_a_file_is_named_and_nothing_is_written(change, said, tmp_path):
    model = Model(mask=(4, 5, 6))
    saved(model, tmp_path)
    held = torch.load(tmp_path / "scene.th", weights_only=False)
    change(held)
    torch.save(held, tmp_path / "scene.th")
    words = ["import", str(tmp_path / "scene.th"), "-o", str(tmp_path / "a.rfpack")]
    result = CliRunner().invoke(cli, words)
    assert result.exit_code == 3 and re.search(f"scene.th: .*{said}", result.output), result.output
    assert not (tmp_path / "a.rfpack").exists()


def test_entries_of_other_names_are_no_part_of_it(tmp_path):
    state = state_of(Model())
    state = OrderedDict([(3, torch.zeros(1)), *state.items()])
    assert tensorf.read(open_checkpoint(saved(Model(), tmp_path, state=state))).nodes


def test_a_box_is_not_to_be_given_for_a_file_that_has_one(tmp_path):
    saved(Model(), tmp_path)
    words = "import", "scene.th", "-o", "a.rfpack", "--aabb", "-1,-1,-1,1,1,1"
    result = CliRunner().invoke(cli, [str(tmp_path / w) if "." in w and "," not in w else w for w in words])
    assert result.exit_code == 2 and "has a box of its own" in result.output
