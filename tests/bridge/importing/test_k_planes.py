"""K-Planes' checkpoints, written here as its runs write them, against its formulas in numpy and torch."""

import itertools
from dataclasses import dataclass

import numpy as np
import pytest
import torch

from formats.errors import FormatError
from formats.foreign.systems import open_checkpoint
from formats.records import FieldRecord, decode_field, encode_field
from fusedrf_cli.bridge.importing import k_planes
from fusedrf_cli.bridge.scene import make_field
from fusedrf_cli.errors import UsageProblem

from .hash_oracle import harmonics


@dataclass(frozen=True)
class Model:
    """What a run of K-Planes is told."""

    explicit: bool = False
    features: int = 16
    scales: tuple[int, ...] = (1, 2)
    concatenated: bool = True
    basis_layers: int = 1
    activation: str = "trunc_exp"
    codes: int = 0
    times: int = 0
    contracted: tuple[float, ...] = ()
    reversed: bool = False


RESOLUTION = 5, 7, 6
CORNERS = np.array([[-1.5, -1.0, -0.5], [1.0, 1.5, 2.0]], np.float32)
MODELS = {
    "hybrid": Model(),
    "one of twelve": Model(features=12, scales=(2,), reversed=True),
    "summed": Model(concatenated=False, activation="relu", codes=4),
    "explicit": Model(explicit=True, basis_layers=2, reversed=True),
    "explicit, summed": Model(explicit=True, concatenated=False, codes=5, activation="relu"),
    "moving": Model(times=9),
    "explicit, moving": Model(explicit=True, times=4),
    "contracted": Model(contracted=(2.5, 2.5, 2.5), codes=8),
    "stretched": Model(contracted=(10.0, 6.0, 4.0), explicit=True, codes=8),
}


def padded(count: int, by: int) -> int:
    return -(-count // by) * by


def network(rng, inputs: int, outputs: int, hidden: int, layers: int, by: int = 16) -> np.ndarray:
    """Parameters of a network of tiny-cuda-nn: matrices (outputs, inputs), filled up to multiples."""
    widths = [padded(inputs, by), *[hidden] * layers, padded(outputs, by)]
    parts = [rng.normal(size=(n, m)) / m**0.5 for m, n in itertools.pairwise(widths)]
    return np.concatenate([part.reshape(-1) for part in parts]).astype(np.float16).astype(np.float32)


def state_of(model: Model) -> dict[str, np.ndarray]:
    """The state of a LowrankModel."""
    rng, axes = np.random.default_rng(0), 4 if model.times else 3
    state = {"field.aabb": CORNERS[::-1].copy() if model.reversed else CORNERS}
    for s, factor in enumerate(model.scales):
        counts = [n * factor for n in RESOLUTION] + [model.times]
        for m, (a, b) in enumerate(itertools.combinations(range(axes), 2)):
            plane = rng.uniform(0.3, 1.5, (1, model.features, counts[b], counts[a]))
            state[f"field.grids.{s}.{m}"] = plane.astype(np.float32)
    width = model.features * (len(model.scales) if model.concatenated else 1)
    if model.codes:
        state["field.appearance_embedding.weight"] = rng.normal(size=(7, model.codes)).astype(np.float32)
    if model.explicit:
        state["field.sigma_net.params"] = network(rng, width, 1, 128, 0, 8)
        state["field.color_basis.params"] = network(rng, 3 + model.codes, 3 * width, 128, model.basis_layers)
    else:
        state["field.sigma_net.params"] = network(rng, width, 16, 64, 1)
        state["field.color_net.params"] = network(rng, 31 + model.codes, 3, 64, 2)
    if model.contracted:
        prefix = "field.spatial_distortion.global_"
        state[prefix + "scale"] = np.array(model.contracted, np.float32)
        state[prefix + "translation"] = np.array([0.0, 0.3, -1.0], np.float32)
    return state


def written(model: Model, folder):
    """A run's checkpoint and its config.py."""
    state = {name: torch.from_numpy(value) for name, value in state_of(model).items()}
    torch.save(
        {"model": state, "optimizer": {}, "lr_scheduler": None, "global_step": 9}, folder / "model.pth"
    )
    config = {
        "density_activation": model.activation, "concat_features_across_scales": model.concatenated,
        "ndc": False, "grid_config": [{"resolution": list(RESOLUTION)}],
    }  # fmt: skip
    (folder / "config.py").write_text(f"config = {config!r}\n")
    return open_checkpoint(folder / "model.pth")


# -- its formulas --------------------------------------------------------------------------------------------


def evaluated(params, x: np.ndarray, outputs: int, hidden: int, layers: int, by: int = 16) -> np.ndarray:
    """A network of tiny-cuda-nn, whose inputs are filled up with ones."""
    x = np.concatenate([x, np.ones((len(x), padded(x.shape[1], by) - x.shape[1]))], 1)
    widths, start = [x.shape[1], *[hidden] * layers, padded(outputs, by)], 0
    for i, (m, n) in enumerate(itertools.pairwise(widths)):
        x = x @ params[start : start + m * n].reshape(n, m).T.astype(np.float64)
        x, start = np.maximum(x, 0) if i < layers else x, start + m * n
    return x[:, :outputs]


def features_of(model: Model, state: dict, points: np.ndarray, time: float | None) -> np.ndarray:
    """interpolate_ms_features of K-Planes."""
    prefix = "field.spatial_distortion.global_"
    if model.contracted:
        x = points * state[prefix + "scale"] + state[prefix + "translation"]
        size = np.abs(x).max(1, keepdims=True)
        at = np.where(size >= 1, (2 - 1 / size) * x / size, x) / 2
    else:
        first, second = state["field.aabb"].astype(np.float64)
        at = (points - first) * (2 / (second - first)) - 1
    at = at if time is None else np.concatenate([at, np.full((len(at), 1), time)], 1)
    made = []
    for s in range(len(model.scales)):
        product = 1
        for m, pair in enumerate(itertools.combinations(range(at.shape[1]), 2)):
            plane = torch.from_numpy(state[f"field.grids.{s}.{m}"]).double()
            where = torch.from_numpy(at[None, None][..., list(pair)])
            product = (
                product
                * torch.nn.functional.grid_sample(plane, where, align_corners=True, padding_mode="border")[
                    0, :, 0
                ].T.numpy()
            )
        made.append(product)
    return np.concatenate(made, 1) if model.concatenated else sum(made)


def answers(model: Model, points: np.ndarray, dirs: np.ndarray, time: float | None):
    """(σ, rgb) of KPlaneField.forward with the mean of the codes."""
    state = state_of(model)
    features = features_of(model, state, points, time)
    code = np.zeros((0,))
    if model.codes:
        code = state["field.appearance_embedding.weight"].astype(np.float64).mean(0)
    codes = np.tile(code, (len(points), 1))
    if model.explicit:
        raw = evaluated(state["field.sigma_net.params"], features, 1, 128, 0, 8)[:, 0]
        params, read = state["field.color_basis.params"], np.concatenate([dirs, codes], 1)
        basis = evaluated(params, read, 3 * features.shape[1], 128, model.basis_layers)
        logits = (basis.reshape(len(points), 3, -1) * features[:, None]).sum(2)
    else:
        made = evaluated(state["field.sigma_net.params"], features, 16, 64, 1)
        raw, read = made[:, 15], np.concatenate([harmonics(dirs), made[:, :15], codes], 1)
        logits = evaluated(state["field.color_net.params"], read, 3, 64, 2)
    sigma = np.exp(raw - 1) if model.activation == "trunc_exp" else np.maximum(raw, 0)
    return sigma, 1 / (1 + np.exp(-logits))


def assert_answers(imported, points: np.ndarray, dirs: np.ndarray, sigma, rgb) -> None:
    """That the only node of an import answers so in the world."""
    (node,) = imported.nodes
    world_to_object = np.linalg.inv(node.object_to_world)
    v = dirs @ world_to_object[:3, :3].T
    length = np.linalg.norm(v, axis=1)
    x = points @ world_to_object[:3, :3].T + world_to_object[:3, 3]
    field = stored(node.field)
    found = field.answers(field.params, torch.from_numpy(x), torch.from_numpy(v / length[:, None]))
    np.testing.assert_allclose(found[0].numpy() * length, sigma, rtol=1e-4, atol=2e-6)  # at a relu's zero
    np.testing.assert_allclose(found[1].numpy()[sigma > 0], rgb[sigma > 0], atol=1e-4)


def stored(field):
    """The field that a bundle gives back."""
    record = FieldRecord(field.kind, *field.state())
    return make_field(decode_field(encode_field(record, "float32"), "here"), "here")


def samples(model: Model) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(1)
    low, high = CORNERS * (4 if model.contracted else 1.5)  # the values on a box's border go on around it
    dirs = rng.normal(size=(200, 3))
    return rng.uniform(low, high, (200, 3)), dirs / np.linalg.norm(dirs, axis=1, keepdims=True)


@pytest.mark.parametrize("model", MODELS.values(), ids=MODELS)
def test_a_checkpoint_answers_by_k_planes_formulas(model, tmp_path):
    time = 0.37 if model.times else None
    (points, dirs) = samples(model)
    imported = k_planes.read(written(model, tmp_path), time)
    sigma, rgb = answers(model, points, dirs, time)
    assert (sigma > 0).mean() > 0.3 and sigma.max() < 1e4
    assert_answers(imported, points, dirs, sigma, rgb)
    assert any("codes" in note for note in imported.notes) == bool(model.codes)


@pytest.mark.slow
def test_compiled_loops_answer_so_as_well(tmp_path):
    model = MODELS["explicit, moving"]
    points, dirs = samples(model)
    field = k_planes.read(written(model, tmp_path), -1.0).nodes[0].field
    sigma, rgb = (found.numpy() for found in field.query(torch.from_numpy(points), torch.from_numpy(dirs)))
    expected = answers(model, points, dirs, -1.0)
    np.testing.assert_allclose(sigma, expected[0], rtol=1e-4)
    np.testing.assert_allclose(rgb, expected[1], atol=1e-4)


def test_nothing_is_farther_outside_of_the_box_than_its_sides_are_long(tmp_path):
    imported = k_planes.read(written(MODELS["hybrid"], tmp_path))
    field = imported.nodes[0].field
    outside = torch.tensor([[3.6, 0.0, 0.0], [0.0, 0.0, -3.1]])
    assert not field.answers(field.params, outside, torch.tensor([[0.0, 0.0, 1.0]] * 2))[0].any()


@pytest.mark.parametrize("time", [None, -1.5, float("nan")])
def test_a_scene_that_moves_needs_a_time(tmp_path, time):
    with pytest.raises(UsageProblem, match=r"a time from -1 to 1 \(--time\)"):
        k_planes.read(written(MODELS["moving"], tmp_path), time)


def test_what_was_chosen_is_said(tmp_path):
    checkpoint = written(MODELS["hybrid"], tmp_path)
    (tmp_path / "config.py").unlink()
    checkpoint.beside.clear()
    notes = " ".join(k_planes.read(checkpoint, 0.5).notes)
    assert "no config.py" in notes and "stands still" in notes


@pytest.mark.parametrize("name", ["grids.1.2", "sigma_net.params", "color_net.params"])
def test_numbers_that_do_not_fit_are_named(tmp_path, name):
    checkpoint = written(MODELS["hybrid"], tmp_path)
    state, name = checkpoint.entries["model"], f"field.{name}"
    state[name] = state[name].array()[..., :-1]
    with pytest.raises(FormatError, match=name.rpartition(".")[0]):
        k_planes.read(checkpoint)
