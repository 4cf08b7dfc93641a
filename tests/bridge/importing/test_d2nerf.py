"""D²NeRF's checkpoints, written here as Flax writes them, against its formulas in plain numpy."""

import json
from dataclasses import dataclass, replace

import msgpack
import numpy as np
import pytest
import torch
from click.testing import CliRunner
from scipy.linalg import expm

from formats.bundle import read_bundle
from formats.errors import FormatError
from formats.foreign.systems import open_checkpoint
from fusedrf_cli.bridge.importing import d2nerf
from fusedrf_cli.errors import UsageProblem
from fusedrf_cli.main import cli
from tests.bridge.importing.test_k_planes import stored
from tests.formats.foreign.samples import flax_array

BOX = np.array([-1.5, -1.0, -1.0, 1.0, 1.5, 2.0])
TIMES, CODE = 5, 8


@dataclass(frozen=True)
class Model:
    """What a run of D²NeRF is told."""

    identity: bool = False
    degree: int = 4
    static_degree: int = 4
    shadow: str = "from alpha"
    warp: bool = True
    hyper: str = "sheet"
    codes: bool = False
    alphas: tuple = (3.4, 2.0, 1.0, 0.5)
    bottleneck: bool = True
    fine: bool = True
    alpha_code: bool = False
    """Whether densities read the codes, and colours none."""
    pushed: bool = False
    """Whether points are only pushed (TranslationField)."""


MODELS = {
    "as run": Model(),
    "identity": Model(identity=True, alphas=(None,) * 4),
    "no shadow": Model(shadow=""),
    "shadow model": Model(shadow="model"),
    "no warp": Model(warp=False),
    "no sheet": Model(hyper="code"),
    "no hyperspace": Model(hyper="", shadow="model"),
    "codes": Model(codes=True, identity=True),
    "other degrees": Model(degree=5, static_degree=3),
    "one network": Model(bottleneck=False, fine=False),
    "codes of densities": Model(codes=True, alpha_code=True),
    "points pushed": Model(pushed=True),
    "points pushed, identity": Model(pushed=True, identity=True),
}
DEEP = {"depth": 6, "skip": 4}


def dense(rng, inputs: int, outputs: int) -> dict:
    kernel = rng.normal(size=(inputs, outputs)) * (1.6 / inputs) ** 0.5
    return {
        "kernel": kernel.astype(np.float32),
        "bias": rng.normal(size=outputs).astype(np.float32) * np.float32(0.1),
    }


def stack(rng, inputs: int, width: int, depth: int, skip: int = 0, prefix: str = "hidden_") -> dict:
    """The hidden layers of an MLP."""
    made = {}
    for i in range(depth):
        read = inputs if i == 0 else width + (inputs if i == skip else 0)
        made[f"{prefix}{i}"] = dense(rng, read, width)
    return made


def point_width(degree: int, identity: bool) -> int:
    return 6 * degree + 3 * identity


def parameters(model: Model) -> dict:
    """The parameters of a DecomposeNerfModel."""
    rng, directions = np.random.default_rng(0), point_width(2, model.identity)
    width, coordinates = 24, {"sheet": 3, "code": CODE, "": 0}[model.hyper]
    code = CODE if model.codes else 0
    inputs = point_width(model.degree, model.identity) + 2 * coordinates
    seen = (directions if model.bottleneck else 0) + (0 if model.alpha_code else code)
    opaque = code if model.alpha_code else 0

    def embed():
        return {"embed": {"embedding": rng.normal(size=(TIMES, CODE)).astype(np.float32)}}

    dynamic = stack(rng, inputs, width, **DEEP, prefix="trunk_hidden_")
    dynamic |= {
        "MLP_0": stack(rng, width + seen, 16, 1) | {"logit": dense(rng, 16, 3)},
        "MLP_1": {"logit": dense(rng, width + opaque, 1 + bool(model.shadow))},
    }
    read = point_width(model.static_degree, model.identity)
    static = {
        "MLP_0": stack(rng, read, 32, **DEEP),
        "MLP_1": stack(rng, 32 + seen, 16, 1) | {"logit": dense(rng, 16, 3)},
        "MLP_2": {"logit": dense(rng, 32 + opaque, 1)},
    }
    if model.bottleneck:
        dynamic["bottleneck"], static["bottleneck"] = dense(rng, width, width), dense(rng, 32, 32)
    level = "nerf_mlps_fine" if model.fine else "nerf_mlps_coarse"
    params = {level: dynamic, "static_nerf": {level: static}, "warp_embed": embed()}
    if model.pushed:
        pushing = stack(rng, point_width(3, False) + CODE, 16, **DEEP) | {"logit": dense(rng, 16, 3)}
        params["warp_field"] = {"mlp": pushing}
    elif model.warp:
        params["warp_field"] = {
            "trunk": stack(rng, point_width(3, False) + CODE, 16, **DEEP),
            "branches_w": {"logit": dense(rng, 16, 3)},
            "branches_v": {"logit": dense(rng, 16, 3)},
        }
    if model.hyper == "sheet":
        params["hyper_sheet_mlp"] = {"MLP_0": stack(rng, 6 + CODE, 8, **DEEP) | {"logit": dense(rng, 8, 3)}}
    if model.shadow == "model":
        params["shadow_model"] = stack(rng, inputs, 16, 7, 4, "trunk_hidden_")
        params["shadow_model"]["MLP_0"] = {"logit": dense(rng, 16, 1)}
    if model.codes:
        params["nerf_embed"], params["static_nerf"]["nerf_embed"] = embed(), embed()
    return params


def packed(value):
    """As flax.serialization has it."""
    if isinstance(value, dict):
        return {name: packed(inner) for name, inner in value.items()}
    return flax_array(value) if isinstance(value, np.ndarray) else value


def written(model: Model, folder, change=lambda params: None):
    """A checkpoint and its options."""
    params = parameters(model)
    change(params)
    alphas = [None if alpha is None else np.array(alpha, np.float32) for alpha in model.alphas]
    names = "nerf_alpha", "warp_alpha", "hyper_alpha", "hyper_sheet_alpha"
    state = {
        "optimizer": {"state": {"step": 9, "param_states": {}}, "target": {"model": params}},
        **dict(zip(names, alphas, strict=True)),
    }
    (folder / "checkpoint_9").write_bytes(msgpack.packb(packed(state)))
    options = {"spatial_point_max_deg": model.degree, "hyper_point_max_deg": 1, "shadow_r_shift": 0.5}
    (folder / "options.json").write_text(json.dumps(options))
    return open_checkpoint(folder / "checkpoint_9")


# -- its formulas --------------------------------------------------------------------------------------------


def posenc(x: np.ndarray, degree: int, identity: bool, alpha: float | None) -> np.ndarray:
    parts = [x] if identity else []
    for band in range(degree):
        share = 1 if alpha is None else 0.5 * (1 - np.cos(np.pi * np.clip(alpha - band, 0, 1)))
        parts += [share * np.sin(x * 2**band), share * np.cos(x * 2**band)]
    return np.concatenate(parts, 1) if parts else np.zeros((len(x), 0))


def apply(layer: dict, x: np.ndarray) -> np.ndarray:
    return x @ layer["kernel"].astype(np.float64) + layer["bias"]


def hidden(layers: dict, x: np.ndarray, skip: int = 4, prefix: str = "hidden_") -> np.ndarray:
    inputs, i = x, 0
    while f"{prefix}{i}" in layers:
        x = np.concatenate([x, inputs], 1) if i == skip else x
        x, i = np.maximum(apply(layers[f"{prefix}{i}"], x), 0), i + 1
    return x


def sigmoid(x: np.ndarray) -> np.ndarray:
    return 1 / (1 + np.exp(-x))


def answers(model: Model, params: dict, points: np.ndarray, dirs: np.ndarray, time: float) -> dict:
    """What `render_samples` makes of points."""
    nerf_alpha, warp_alpha, hyper_alpha, sheet_alpha = model.alphas
    level = "nerf_mlps_fine" if model.fine else "nerf_mlps_coarse"

    def code_of(embed: dict | None) -> np.ndarray:
        if embed is None:
            return np.zeros((len(points), 0))
        codes, i = embed["embed"]["embedding"].astype(np.float64), int(np.floor(time))
        mixed = codes[i] if i == time else (1 - time + i) * codes[i] + (time - i) * codes[i + 1]
        return np.tile(mixed, (len(points), 1))

    code, moved = code_of(params.get("warp_embed")), points
    if model.pushed:
        field = params["warp_field"]["mlp"]
        h = hidden(field, np.concatenate([posenc(points, 3, False, warp_alpha), code], 1))
        moved = points + apply(field["logit"], h)
    elif model.warp:
        field = params["warp_field"]
        h = hidden(field["trunk"], np.concatenate([posenc(points, 3, False, warp_alpha), code], 1))
        twists = zip(
            apply(field["branches_w"]["logit"], h), apply(field["branches_v"]["logit"], h), strict=True
        )
        moved = np.array([screwed(p, w, v) for p, (w, v) in zip(points, twists, strict=True)])
    features = [posenc(moved, model.degree, model.identity, nerf_alpha)]
    if model.hyper == "sheet":
        mlp = params["hyper_sheet_mlp"]["MLP_0"]
        h = hidden(mlp, np.concatenate([posenc(points, 1, False, sheet_alpha), code], 1))
        features.append(posenc(apply(mlp["logit"], h), 1, False, hyper_alpha))
    elif model.hyper:
        features.append(posenc(code, 1, False, hyper_alpha))
    features, network = np.concatenate(features, 1), params[level]
    h = hidden(network, features, prefix="trunk_hidden_")

    def opacity(network: dict, name: str, h: np.ndarray, code: np.ndarray) -> np.ndarray:
        if model.alpha_code:
            h = np.concatenate([apply(network["bottleneck"], h) if model.bottleneck else h, code], 1)
        return apply(network[name]["logit"], h)

    alpha = opacity(network, "MLP_1", h, code_of(params.get("nerf_embed")))
    seen = [posenc(dirs, 2, model.identity, None)] if model.bottleneck else []

    def colour(network: dict, name: str, h: np.ndarray, code: np.ndarray) -> np.ndarray:
        read = apply(network["bottleneck"], h) if model.bottleneck else h
        codes = [] if model.alpha_code else [code]
        return sigmoid(
            apply(network[name]["logit"], hidden(network[name], np.concatenate([read, *seen, *codes], 1)))
        )

    found = {
        "sigma_dynamic": np.log1p(np.exp(alpha[:, 0])),
        "rgb_dynamic": colour(network, "MLP_0", h, code_of(params.get("nerf_embed"))),
        "shadow": np.zeros(len(points)),
    }
    if model.shadow:
        raw = alpha[:, 1]
        if model.shadow == "model":
            shade = params["shadow_model"]
            raw = apply(shade["MLP_0"]["logit"], hidden(shade, features, prefix="trunk_hidden_"))[:, 0]
        found["shadow"] = sigmoid(raw - 0.5)
    static = params["static_nerf"][level]
    h = hidden(static["MLP_0"], posenc(points, model.static_degree, model.identity, nerf_alpha))
    code = code_of(params["static_nerf"].get("nerf_embed"))
    found["sigma_static"] = np.log1p(np.exp(opacity(static, "MLP_2", h, code)[:, 0]))
    found["rgb_static"] = colour(static, "MLP_1", h, code)
    return found


def screwed(p: np.ndarray, w: np.ndarray, v: np.ndarray) -> np.ndarray:
    """A point moved by a twist, as a homogeneous matrix does."""
    twist = np.zeros((4, 4))
    twist[:3, :3] = [[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]]
    twist[:3, 3] = v
    return (expm(twist) @ [*p, 1])[:3]


def samples(count: int = 60) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(1)
    dirs = rng.normal(size=(count, 3))
    return rng.uniform(BOX[:3], BOX[3:], (count, 3)), dirs / np.linalg.norm(dirs, axis=1, keepdims=True)


def asked(node, points, dirs) -> tuple[np.ndarray, np.ndarray]:
    field = stored(node.field)
    found = field.answers(field.params, torch.from_numpy(points), torch.from_numpy(dirs))
    return tuple(value.numpy() for value in found)


@pytest.mark.parametrize("model", MODELS.values(), ids=MODELS)
@pytest.mark.parametrize("time", [3, 1.25])
def test_static_and_dynamic_fields_answer_by_d2nerfs_formulas(model, time, tmp_path):
    imported = d2nerf.read(written(model, tmp_path), BOX, time)
    points, dirs = samples()
    expected = answers(model, parameters(model), points, dirs, time)
    static, dynamic = (asked(node, points, dirs) for node in imported.nodes)
    np.testing.assert_allclose(static[0], expected["sigma_static"], rtol=1e-4)
    np.testing.assert_allclose(dynamic[0], expected["sigma_dynamic"], rtol=1e-4)
    lit = expected["rgb_static"] * (1 - expected["shadow"])[:, None]
    np.testing.assert_allclose(static[1], lit, atol=1e-4)
    np.testing.assert_allclose(dynamic[1], expected["rgb_dynamic"], atol=1e-4)
    assert imported.rule == "add" and [node.suffix for node in imported.nodes] == ["-static", "-dynamic"]
    assert any("shadow" in note for note in imported.notes) == bool(model.shadow)


def test_without_a_warp_or_a_coordinate_nothing_is_held_for_them(tmp_path):
    """Flax holds no codes that nothing reads."""
    model, (points, dirs) = Model(warp=False, hyper="", shadow=""), samples()
    imported = d2nerf.read(written(model, tmp_path, lambda params: params.pop("warp_embed")), BOX, 0)
    params = parameters(model)
    del params["warp_embed"]
    sigma, rgb = asked(imported.nodes[1], points, dirs)
    expected = answers(model, params, points, dirs, 0)
    np.testing.assert_allclose(sigma, expected["sigma_dynamic"], rtol=1e-4)
    np.testing.assert_allclose(rgb, expected["rgb_dynamic"], atol=1e-4)


@pytest.mark.parametrize("model", [MODELS["as run"], MODELS["codes"]], ids=["as run", "codes"])
def test_without_a_time_what_stands_still_is_in_no_shadow(model, tmp_path):
    imported = d2nerf.read(written(model, tmp_path), BOX)
    (node,), (points, dirs) = imported.nodes, samples()
    params = parameters(model)
    if model.codes:  # their mean
        embed = params["static_nerf"]["nerf_embed"]["embed"]
        embed["embedding"] = np.tile(embed["embedding"].mean(0), (TIMES, 1))
    expected = answers(model, params, points, dirs, 0)
    sigma, rgb = asked(node, points, dirs)
    np.testing.assert_allclose(sigma, expected["sigma_static"], rtol=1e-4)
    np.testing.assert_allclose(rgb, expected["rgb_static"], atol=1e-4)
    assert any("left out" in note for note in imported.notes)


@pytest.mark.parametrize("time", [-1, 4.5, float("nan")])
def test_a_time_that_there_is_not_is_named(tmp_path, time):
    with pytest.raises(UsageProblem, match=r"a time from 0 to 4 \(--time\)"):
        d2nerf.read(written(MODELS["as run"], tmp_path), BOX, time)


def halved(*path: str):
    """A change that takes half of the inputs of a layer away."""

    def change(params):
        for name in path:
            params = params[name]
        params["kernel"] = params["kernel"][: len(params["kernel"]) // 2]

    return change


@pytest.mark.parametrize(
    "path",
    [
        ("nerf_mlps_fine", "trunk_hidden_0"), ("nerf_mlps_fine", "trunk_hidden_4"),
        ("nerf_mlps_fine", "MLP_1", "logit"), ("static_nerf", "nerf_mlps_fine", "MLP_0", "hidden_0"),
        ("warp_field", "trunk", "hidden_2"), ("warp_field", "branches_v", "logit"),
        ("hyper_sheet_mlp", "MLP_0", "hidden_0"), ("static_nerf", "nerf_mlps_fine", "MLP_1", "logit"),
    ],
)  # fmt: skip
def test_networks_that_do_not_fit_are_refused(path, tmp_path):
    with pytest.raises(FormatError, match="read|fit|make"):
        d2nerf.read(written(MODELS["as run"], tmp_path, halved(*path)), BOX, 1)


@pytest.mark.parametrize("time", [None, 1])
def test_pushes_of_four_numbers_are_refused(time, tmp_path):
    def change(params):
        params["warp_field"]["mlp"]["logit"] = dense(np.random.default_rng(0), 16, 4)

    checkpoint = written(MODELS["points pushed"], tmp_path, change)
    if time is None:
        assert d2nerf.read(checkpoint, BOX).nodes  # what stands still is as it is
    else:
        with pytest.raises(FormatError, match="should make 3 numbers, found 4"):
            d2nerf.read(checkpoint, BOX, time)


@pytest.mark.parametrize("named", ["branches_p", "branches_t"])
def test_pivots_are_refused(named, tmp_path):
    def change(params):
        params["warp_field"][named] = params["warp_field"]["branches_v"]

    with pytest.raises(FormatError, match=f"{named} .* is not read; train it without"):
        d2nerf.read(written(MODELS["as run"], tmp_path, change), BOX, 1)


@pytest.mark.parametrize("time", [None, 1])
def test_weights_by_which_earlier_versions_blend_are_refused(time, tmp_path):
    def change(params):
        params["nerf_mlps_fine"]["MLP_2"] = {"logit": dense(np.random.default_rng(0), 24, 1)}

    with pytest.raises(FormatError, match="blend_mode old or nsff"):
        d2nerf.read(written(MODELS["as run"], tmp_path, change), BOX, time)


def test_shadows_of_other_skips_are_refused(tmp_path):
    def change(params):
        params["shadow_model"] = stack(np.random.default_rng(0), 30, 16, 6, 3, "trunk_hidden_")
        params["shadow_model"]["MLP_0"] = {"logit": dense(np.random.default_rng(0), 16, 1)}

    model = replace(MODELS["as run"], shadow="model")
    with pytest.raises(FormatError, match="in different layers"):
        d2nerf.read(written(model, tmp_path, change), BOX, 1)


GIN = """
# Macros:
# ==============================================================================
hyper_point_min_deg = 0

# Parameters for DecomposeNerfModel:
# ==============================================================================
DecomposeNerfModel.activation = @jax.nn.relu
DecomposeNerfModel.blend_mode = 'nsff'
DecomposeNerfModel.hyper_point_min_deg = %hyper_point_min_deg
DecomposeNerfModel.norm_type = 'none'
DecomposeNerfModel.sigma_activation = \\
    @jax.nn.softplus
NerfModel.norm_type = 'layer'
SE3Field.use_pivot = False
StaticNerfModel.norm_type = None
"""


def test_settings_as_gin_writes_them_are_read(tmp_path):
    (tmp_path / "config.gin").write_text(GIN)
    model = MODELS["as run"]
    imported, (points, dirs) = d2nerf.read(written(model, tmp_path), BOX, 3), samples()
    expected = answers(model, parameters(model), points, dirs, 3)
    np.testing.assert_allclose(
        asked(imported.nodes[1], points, dirs)[0], expected["sigma_dynamic"], rtol=1e-4
    )


def test_settings_that_are_no_numbers_are_named(tmp_path):
    written(MODELS["as run"], tmp_path)
    (tmp_path / "options.json").unlink()
    (tmp_path / "config.gin").write_text(GIN + "NerfModel.hyper_point_max_deg = 1e999\n")
    with pytest.raises(FormatError, match="hyper_point_max_deg' should be a number, found inf"):
        d2nerf.read(open_checkpoint(tmp_path / "checkpoint_9"), BOX, 1)


@pytest.mark.parametrize(
    "said, other, found",
    [
        ("Model.norm_type = 'none'", "Model.norm_type = 'layer'", "'DecomposeNerfModel.norm_type' should be"),
        ("@jax.nn.relu", "@jax.nn.elu", "'DecomposeNerfModel.activation' should be relu, found @jax.nn.elu"),
        ("deg = 0", "deg = -1", "'hyper_point_min_deg' should be 0, found -1"),
        ("use_pivot = False", "use_pivot = True", "'SE3Field.use_pivot' should be False, found True"),
    ],
)
def test_settings_by_which_networks_compute_otherwise_are_refused(said, other, found, tmp_path):
    (tmp_path / "config.gin").write_text(GIN.replace(said, other, 1))
    with pytest.raises(FormatError, match=f"config.gin: {found}"):
        d2nerf.read(written(MODELS["as run"], tmp_path), BOX)


def test_the_command_writes_a_group_whose_densities_add_up(tmp_path):
    written(MODELS["as run"], tmp_path)
    box, out = ",".join(map(str, BOX)), str(tmp_path / "a.rfpack")
    words = ["import", str(tmp_path / "checkpoint_9"), "-o", out, "--aabb", box, "--name", "hand"]
    done = CliRunner().invoke(cli, [*words, "--time", "3"])
    assert done.exit_code == 0, done.output
    (group,) = read_bundle(out).scene.nodes
    assert group.composition == "add"
    assert [child.name for child in group.children] == ["hand-static", "hand-dynamic"]
    late = CliRunner().invoke(cli, [*words, "--time", "5", "-w"])
    assert late.exit_code == 2 and "a time from 0 to 4 (--time) should be given, found 5" in late.output
    assert CliRunner().invoke(cli, [*words[:4], "--time", "3", "-w"]).exit_code == 2  # nothing says where
