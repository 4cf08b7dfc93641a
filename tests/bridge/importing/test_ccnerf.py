"""CCNeRF's checkpoints, written here as torch-ngp's trainer writes them, against its formulas."""

from dataclasses import dataclass

import numpy as np
import pytest
import torch
from torch.nn.functional import grid_sample

from formats.foreign.systems import open_checkpoint
from fusedrf_cli import verbs
from fusedrf_cli.bridge.importing import torch_ngp
from fusedrf_cli.errors import InvalidInput

from . import hash_oracle as oracle

SIDE = 16
PLANES, LINES = ((0, 1), (0, 2), (1, 2)), (2, 1, 0)


@dataclass(frozen=True)
class Model:
    """What a run is told, and what it has come to."""

    density: tuple[tuple[int, int], ...] = ((9, 0), (0, 4), (3, 2))
    """Ranks of lines and planes of each group, whose ranks add up while it is learnt."""
    colour: tuple[tuple[int, int], ...] = ((6, 0), (0, 5))
    degree: int = 4
    resolution: tuple[int, int, int] = (9, 11, 7)
    trained: tuple[float, ...] = (-0.6, -0.5, -0.4, 0.5, 0.6, 0.3)
    bound: float = 1
    cells: bool = True
    background: bool = False


MODELS = {
    "of groups": Model(),
    "finalized": Model(density=((16, 8),), colour=((16, 24),)),
    "compressed to lines": Model(density=((16, 0),), colour=((8, 0),), degree=2),
    "in the whole cube": Model(trained=(-2.0,) * 3 + (2.0,) * 3, bound=2, cells=False, background=True),
}


def state_of(model: Model) -> dict[str, np.ndarray]:
    """The state of a NeRFNetwork."""
    rng = np.random.default_rng(6)
    cube = np.array([-model.bound] * 3 + [model.bound] * 3, np.float32)
    state = {"aabb_train": np.array(model.trained, np.float32), "aabb_infer": cube}
    if model.cells:
        bits = rng.random(SIDE**3) < 0.6
        state["density_bitfield"] = np.packbits(bits, bitorder="little")
    for which, ranks, outputs in (
        ("_density", model.density, 1), ("", model.colour, 3 * model.degree**2),
    ):  # fmt: skip
        for part in (0, 1):
            held = [group[part] for group in ranks if group[part]]
            name = ("vec", "mat")[part] + which
            for k, rank in enumerate(held):
                for i in range(3):
                    a, b = PLANES[i]
                    size = (model.resolution[LINES[i]], 1)
                    size = size if part == 0 else (model.resolution[b], model.resolution[a])
                    value = rng.normal(size=(1, rank, *size)).astype(np.float32)
                    state[f"U_{name}.{3 * k + i}"] = value
                weight = rng.normal(size=(outputs, rank), scale=(2 / rank) ** 0.5)
                state[f"S_{name}.{k}"] = weight.astype(np.float32)
    if model.background:
        state |= {"bg_mat": np.zeros((1, 2, 4, 4), np.float32), "bg_S": np.zeros((48, 2), np.float32)}
    return state


def written(model: Model, folder, **changed):
    """A checkpoint, opened."""
    state = {name: torch.from_numpy(v) for name, v in (state_of(model) | changed).items() if v is not None}
    file = {
        "epoch": 3, "global_step": 1000, "stats": {"loss": [0.1], "checkpoints": []}, "model": state,
        "resolution": list(model.resolution), "rank_vec_density": [16], "rank_mat_density": [8],
    }  # fmt: skip
    torch.save(file, folder / "16_8-16_24.pth")
    return open_checkpoint(folder / "16_8-16_24.pth")


# -- its formulas --------------------------------------------------------------------------------------------


def features(state: dict, which: str, x: np.ndarray) -> np.ndarray:
    """compute_features(_density): (N, outputs) at x (N, 3) of the box in [-1, 1]."""
    total = 0.0
    for part in ("vec", "mat"):
        for k in range(sum(name.startswith(f"S_{part}{which}.") for name in state)):
            product = 1.0
            for i in range(3):
                at = np.stack([0 * x[:, 0], x[:, LINES[i]]], 1) if part == "vec" else x[:, PLANES[i]]
                grid = torch.from_numpy(at).double()[None, :, None]
                values = torch.from_numpy(state[f"U_{part}{which}.{3 * k + i}"]).double()
                product = product * grid_sample(values, grid, align_corners=False)[0, :, :, 0].numpy()
            total = total + (state[f"S_{part}{which}.{k}"].astype(np.float64) @ product).T
    return total


def expected(model: Model, state: dict, points: np.ndarray, d: np.ndarray):
    """σ and rgb of NeRFNetwork.forward, in the cells that it samples."""
    box = state["aabb_train"].astype(np.float64)
    x = 2 * (points - box[:3]) / (box[3:] - box[:3]) - 1
    sigma = np.exp(features(state, "_density", x)[:, 0])
    basis = features(state, "", x).reshape(len(x), 3, -1)
    rgb = oracle.sigmoid((basis * oracle.harmonics(d)[:, None, : model.degree**2]).sum(2))
    inside = (np.abs(points) <= model.bound).all(1)
    if model.cells:
        bits = np.unpackbits(state["density_bitfield"], bitorder="little").reshape(1, -1)
        inside &= oracle.occupied(points, bits.astype(bool), model.bound).astype(bool)
    return sigma * inside, rgb


def places(model: Model, count: int = 300) -> tuple[np.ndarray, np.ndarray]:
    """Some near the faces of the box, some outside, where densities are exp(0)."""
    rng = np.random.default_rng(4)
    return model.bound * rng.uniform(-1.05, 1.05, (count, 3)), oracle.directions(rng, count)


@pytest.mark.parametrize("name", MODELS)
def test_ccnerf(name, tmp_path):
    model, (points, d) = MODELS[name], places(MODELS[name])
    checkpoint = written(model, tmp_path)
    assert checkpoint.system == "torch-ngp"
    imported = torch_ngp.read(checkpoint)
    oracle.assert_alike(oracle.answers(imported, points, d), expected(model, state_of(model), points, d))
    assert ("behind the scene" in " ".join(imported.notes)) == model.background


def test_the_command_writes_it(tmp_path):
    model = MODELS["finalized"]
    checkpoint, (points, d) = written(model, tmp_path), places(model, 60)
    verbs.import_field(checkpoint.path, output=tmp_path / "f.rfpack")
    found = oracle.asked(tmp_path / "f.rfpack", points, d)
    oracle.assert_alike(found, expected(model, state_of(model), points, d), 1e-3)


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"T_1": np.eye(4, dtype=np.float32)}, "a scene composed of several objects is not read"),
        ({"U_vec.2": None}, "'U_vec.2' is missing"),
        ({"U_mat_density.1": np.zeros((1, 4, 7, 8), np.float32)}, "'U_mat_density.1' should have shape"),
        ({"S_vec.0": np.zeros((47, 6), np.float32)}, "should have as many rows"),
        ({"S_vec_density.1": np.zeros((1, 4), np.float32)}, "'U_vec_density.3' should have shape [1, 4, "),
        ({"aabb_train": np.zeros(6, np.float32)}, "three minima below three maxima"),
    ],
)
def test_what_does_not_fit_is_refused_in_a_sentence(changed, said, tmp_path):
    checkpoint, output = written(MODELS["of groups"], tmp_path, **changed), tmp_path / "f.rfpack"
    with pytest.raises(InvalidInput) as caught:
        verbs.import_field(checkpoint.path, output=output)
    assert str(checkpoint.path) in str(caught.value) and said in str(caught.value)
    assert caught.value.exit_code == 3 and not output.exists()
