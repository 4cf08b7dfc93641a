"""torch-ngp's and PVD's checkpoints, written here as their trainers write them, against their formulas."""

from dataclasses import dataclass, field, replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from formats.bundle import OpenBundle
from formats.errors import FormatError
from formats.foreign.systems import open_checkpoint
from fusedrf_cli import verbs
from fusedrf_cli.bridge.bundling import stored_bytes, unchanged_bytes
from fusedrf_cli.bridge.importing import torch_ngp
from fusedrf_cli.bridge.scene import load_scene
from fusedrf_cli.bridge.sizes import BundleSizes
from fusedrf_cli.engine.fields.streamed import opened
from fusedrf_cli.errors import InvalidInput

from . import hash_oracle as oracle

SIDE = 16


@dataclass(frozen=True)
class Model:
    """What a run is told."""

    kind: str = "hash"
    bound: float = 1
    levels: int = 4
    log2_rows: int = 6
    features: int = 2
    rounded: bool = True
    """Whether rows of a level are a multiple of eight, as newer versions have them."""
    finest: float = 2048
    """desired_resolution for each unit of the bound."""
    networks: str = "torch"
    layers: tuple[int, int] = (2, 3)
    shown: tuple[float, ...] = ()
    """aabb_infer, where it is not the whole cube."""
    trained: tuple[float, ...] = ()
    cells: bool = True
    frequencies: int = 3
    degree: int = 3
    clip: tuple[float, float] = (-2, 7)
    args: dict = field(default_factory=dict)
    """Of PVD's args.txt; none where that is not there."""
    more: tuple[str, ...] = field(default=())


MODELS = {
    "bound 1": Model(),
    "bound 2": Model(bound=2, features=4),
    "bound 16, 3 levels": Model(bound=16, levels=3, features=1),
    "bound 4, without cells": Model(bound=4, cells=False, more=("ema",)),
    "rows as there are vertices": Model(log2_rows=14, rounded=False),
    "a coarser grid": Model(finest=512, levels=16, log2_rows=15),
    "a grid whatever the bound": Model(bound=4, finest=512, levels=16, log2_rows=15, more=("ema",)),
    "twice at each level": Model(bound=2, finest=16 * 2**6 / 2, levels=7, log2_rows=19, rounded=False),
    "deeper": Model(layers=(4, 2), more=("bg_net.0.weight",)),
    "cut": Model(bound=2, shown=(-1.0, -0.5, -2.0, 1.5, 2.0, 0.25)),
    "cut to a smaller cube": Model(bound=2, shown=(-1.0,) * 3 + (1.0,) * 3),
    "fused": Model(levels=8, networks="ff"),
    "tiny-cuda-nn": Model(levels=16, log2_rows=19, networks="tcnn"),
    "TensoRF": Model("vm", frequencies=2),
    "TensoRF's lines": Model("cp", bound=2),
    "TensoRF's lines, shrunk": Model("cp", trained=(-0.75, -1.0, -0.5, 1.0, 0.75, 1.0)),
}
PVD = {
    "hash": Model(levels=14),
    "hash, bound 2": Model(levels=14, bound=2),
    "mlp": Model("mlp", layers=(2, 3)),
    "vm": Model("vm", trained=(-0.75, -1.0, -0.5, 1.0, 0.75, 1.0)),
    "tensors": Model("tensors"),
    "tensors of degree 2": Model("tensors", degree=2, bound=2),
    "hash, clipped": Model(levels=14, clip=(-1.5, 1), args={"sigma_clip_min": -1.5, "sigma_clip_max": 1}),
    "mlp, clipped": Model("mlp", clip=(-0.5, 0.5), args={"sigma_clip_min": -0.5, "sigma_clip_max": 0.5}),
    "vm, clipped": Model("vm", clip=(-0.5, 0.5), args={"sigma_clip_min": -0.5, "sigma_clip_max": 0.5}),
    "vm of photos": Model(
        "vm", clip=(-1, 1), args={"sigma_clip_min": -1.0, "sigma_clip_max": 1.0, "just_train_a_model": True}
    ),
    "vm, edited": Model("vm", args={"enable_edit_plenoxel": True}),
    "tensors, edited": Model("tensors", args={"enable_edit_plenoxel": True}),
    "tensors, clipped": Model("tensors", clip=(-1, 1e3), args={"sigma_clip_min": -1, "sigma_clip_max": 1e3}),
}


def numbers(rng, *shape: int, scale: float = 1.0) -> np.ndarray:
    return rng.normal(scale=scale, size=shape).astype(np.float32)


def matrices(rng, inputs: int, outputs: int, layers: int, wide: int = 16) -> list[np.ndarray]:
    """Layers of a network whose answers are of ordinary size."""
    widths = [inputs, *[wide] * (layers - 1), outputs]
    return [numbers(rng, n, m, scale=(2 / m) ** 0.5) for m, n in zip(widths, widths[1:], strict=False)]


def scales_of(model: Model, extra: int) -> tuple[list[float], list[int]]:
    """Scales and vertices along an axis of the levels; extra: beyond one more than its scale rounded up."""
    growth = 2 ** (np.log2(model.finest * model.bound / 16) / (model.levels - 1))
    growth = np.float32(np.log2(float(np.float32(growth)) if model.networks == "tcnn" else growth))
    scales = [float(np.float32(2.0 ** float(np.float32(n) * growth) * 16) - 1) for n in range(model.levels)]
    return scales, [int(np.ceil(scale)) + 1 + extra for scale in scales]


def cut(values: np.ndarray, by: int = 16) -> np.ndarray:
    """A matrix filled up to multiples."""
    return np.pad(values, [(0, -n % by) for n in values.shape])


def state_of(model: Model, pvd: bool) -> dict[str, np.ndarray]:
    """The state of a NeRFNetwork."""
    rng = np.random.default_rng(3)
    cube = np.array([-model.bound] * 3 + [model.bound] * 3, np.float32)
    state = {
        "aabb_train": np.array(model.trained or cube, np.float32),
        "aabb_infer": np.array(model.shown or cube, np.float32),
    }
    if model.cells:
        cascades = 1 + int(np.ceil(np.log2(model.bound)))
        bits = rng.random((cascades, SIDE**3)) < 0.6
        state["density_bitfield"] = np.packbits(bits.reshape(-1), bitorder="little")
    wide = 64 if model.networks != "torch" else 16
    inputs = {"hash": model.levels * model.features, "mlp": 28}.get(model.kind, 0)
    sigma, color = [], matrices(rng, 31, 3, model.layers[1], wide)
    if inputs:
        sigma = matrices(rng, inputs, 16, model.layers[0], wide)
    if model.kind == "hash":
        extra = 0 if model.networks == "tcnn" else 1
        _, sides = scales_of(model, extra)
        filled = 8 if model.rounded else 1
        rows = [min(-(-(side**3) // filled) * filled, 1 << model.log2_rows) for side in sides]
        table = numbers(rng, sum(rows), model.features)
        if model.networks == "tcnn":
            state["encoder.params"] = table.astype(np.float16).astype(np.float32).reshape(-1)
        else:
            state["encoder.embeddings"] = table
            state["encoder.offsets"] = np.cumsum([0, *rows]).astype(np.int32)
    if model.kind == "mlp":
        widths = [3 + 6 * model.frequencies, 16, 16, 16, 16, 28]
        for i, (m, n) in enumerate(zip(widths, widths[1:], strict=False)):
            m += widths[0] if i == 3 else 0
            state[f"nerf_mlp.{i}.weight"] = numbers(rng, n, m, scale=(2 / m) ** 0.5)
            state[f"nerf_mlp.{i}.bias"] = numbers(rng, n, scale=0.3)
    if model.kind == "tensors":
        state["tensor_volume.0"] = numbers(rng, 1, 1 + 3 * model.degree**2, 6, 7, 5, scale=2.0)
    if model.kind in ("vm", "cp"):
        texels, ranks = (5, 6, 7), {"sigma": (4, 3, 2), "color": (6, 5, 8)}
        if model.kind == "cp":
            ranks = {"sigma": (5,) * 3, "color": (9,) * 3}
        for which, rank in ranks.items():
            for i, (a, b) in enumerate(((0, 1), (0, 2), (1, 2))):
                if model.kind == "vm":
                    state[f"{which}_mat.{i}"] = numbers(rng, 1, rank[i], texels[b], texels[a])
                state[f"{which}_vec.{i}"] = numbers(rng, 1, rank[i], texels[2 - i], 1)
        count, read = (15, 31) if pvd else (27, 30 * (1 + 2 * model.frequencies))
        whole = sum(ranks["color"]) if model.kind == "vm" else ranks["color"][0]
        state["basis_mat.weight"] = numbers(rng, count, whole, scale=0.3)
        color = matrices(rng, read, 3, model.layers[1])
    if model.networks == "torch":
        state |= {f"sigma_net.{i}.weight": layer for i, layer in enumerate(sigma)}
        if model.kind != "tensors":
            state |= {f"color_net.{i}.weight": layer for i, layer in enumerate(color)}
    else:
        for name, layers in (("sigma_net", sigma), ("color_net", color)):
            flat = np.concatenate([cut(layer).reshape(-1) for layer in layers])
            flat = flat.astype(np.float16).astype(np.float32)
            state[f"{name}.{'params' if model.networks == 'tcnn' else 'weights'}"] = flat
    return state | {name: numbers(rng, 2, 2) for name in model.more if "." in name}


def written(model: Model, folder, pvd: bool = False, **changed):
    """A checkpoint, opened."""
    state = state_of(model, pvd) | changed
    state = {name: torch.from_numpy(v) if isinstance(v, np.ndarray) else v for name, v in state.items()}
    if model.args:
        given = sorted(({"PE": 10, "stage_iters": {"stage1": 2000}, "ckpt": "a=b"} | model.args).items())
        (folder / "args.txt").write_text("".join(f"{pair}\n" for pair in given) + "\npsnr: 31.20 \nssim: 0.9")
        folder = folder / "checkpoints"
        folder.mkdir()
    file = {"epoch": 3, "global_step": 1000, "stats": {"loss": [0.1], "checkpoints": []}, "model": state}
    if model.cells:
        file |= {"mean_count": 2345, "mean_density": 5.4}
    if "ema" in model.more:
        shadows = [torch.zeros(2)]
        file["ema"] = {"decay": 0.95, "num_updates": 6, "shadow_params": shadows, "collected_params": None}
    torch.save(file, folder / "ngp_ep0003.pth")
    return open_checkpoint(folder / "ngp_ep0003.pth")


# -- its formulas --------------------------------------------------------------------------------------------


def layers_in(state: dict, name: str, widths: list[int]) -> list[np.ndarray]:
    """Matrices of a network, however they are stored."""
    for whole in (f"{name}.params", f"{name}.weights"):
        if whole in state:
            flat, made = state[whole], []
            for m, n in zip(widths, widths[1:], strict=False):
                made.append(flat[: m * n].reshape(n, m))
                flat = flat[m * n :]
            return made
    return [state[f"{name}.{i}.weight"] for i in range(9) if f"{name}.{i}.weight" in state]


def sampled(values: np.ndarray, at: np.ndarray) -> np.ndarray:
    """grid_sample of (1, C, ..) at (N, axes) in [-1, 1], the last axis first; corners aligned."""
    at = torch.from_numpy(at)[None, None, None] if values.ndim == 5 else torch.from_numpy(at)[None, None]
    made = torch.nn.functional.grid_sample(torch.from_numpy(values).double(), at, align_corners=True)
    return made.reshape(values.shape[1], -1).T.numpy()


def multiplied(state: dict, which: str, x: np.ndarray, kind: str) -> np.ndarray:
    """Products of planes and lines, or of three lines, mode after mode."""
    lines = [sampled(state[f"{which}_vec.{i}"], np.stack([0 * x[:, 0], x[:, 2 - i]], 1)) for i in range(3)]
    if kind == "cp":
        return lines[0] * lines[1] * lines[2]
    pairs = ((0, 1), (0, 2), (1, 2))
    planes = [sampled(state[f"{which}_mat.{i}"], x[:, pair]) for i, pair in enumerate(pairs)]
    return np.concatenate([plane * line for plane, line in zip(planes, lines, strict=True)], 1)


def waves(x: np.ndarray, count: int) -> np.ndarray:
    return np.concatenate([x, *[f(2.0**n * x) for n in range(count) for f in (np.sin, np.cos)]], 1)


def expected(model: Model, state: dict, points: np.ndarray, d: np.ndarray, pvd: bool):
    """σ and rgb by the system's own formulas, in the cells that it samples."""
    low, high = model.clip if pvd else (-np.inf, np.inf)
    box = state["aabb_train"].astype(np.float64)
    x, read = 2 * (points - box[:3]) / (box[3:] - box[:3]) - 1, oracle.harmonics(d)
    if model.kind == "tensors":
        values = sampled(state["tensor_volume.0"], x)
        raw = values[:, 0]
        rgb = (values[:, 1:].reshape(-1, 3, model.degree**2) * read[:, None, : model.degree**2]).sum(2)
    elif model.kind in ("vm", "cp"):
        raw = multiplied(state, "sigma", x, model.kind).sum(1)
        features = multiplied(state, "color", x, model.kind) @ state["basis_mat.weight"].T
        if pvd:
            features = features if model.args.get("just_train_a_model") else features.clip(low, high)
            read = np.concatenate([read, features], 1)
        else:
            read = np.concatenate([waves(features, model.frequencies), waves(d, model.frequencies)], 1)
        rgb = oracle.network(read, *layers_in(state, "color_net", []))
    else:
        if model.kind == "mlp":
            h = first = waves(points, model.frequencies)
            for i in range(5):
                h = h @ state[f"nerf_mlp.{i}.weight"].T.astype(np.float64) + state[f"nerf_mlp.{i}.bias"]
                h = np.maximum(h, 0) if i < 4 else h
                h = np.concatenate([first, h], 1) if i == 2 else h
        else:
            scales, sides = scales_of(model, 0 if model.networks == "tcnn" else 1)
            if model.networks == "tcnn":
                rows = [min(-(-(side**3) // 8) * 8, 1 << model.log2_rows) for side in sides]
                table, ends = state["encoder.params"].reshape(-1, model.features), np.cumsum(rows)
            else:
                table, ends = state["encoder.embeddings"], state["encoder.offsets"][1:]
            u = (points + model.bound) / (2 * model.bound)
            h = oracle.grid(u, np.split(table, ends[:-1]), scales, sides)
        count = h.shape[1]
        h = oracle.network(h, *layers_in(state, "sigma_net", [count, 64, 16]))
        raw = h[:, 0]
        filler = np.ones((len(h), 1)) if model.networks == "tcnn" else np.zeros((len(h), 1))
        read = np.concatenate([read, h[:, 1:], *([filler] if model.networks != "torch" else [])], 1)
        rgb = oracle.network(read, *layers_in(state, "color_net", [32, 64, 64, 16]))[:, :3]
    low = -100 if model.args.get("enable_edit_plenoxel") else low
    sigma = np.exp(raw.clip(low, high))
    inside = (np.abs(points) <= model.bound).all(1)
    inside &= ((points >= state["aabb_infer"][:3]) & (points < state["aabb_infer"][3:])).all(1)
    if model.cells:
        cascades = 1 + int(np.ceil(np.log2(model.bound)))
        bits = np.unpackbits(state["density_bitfield"], bitorder="little").reshape(cascades, -1)
        inside &= oracle.occupied(points, bits.astype(bool), model.bound).astype(bool)
    return sigma * inside, oracle.sigmoid(rgb)


def places(model: Model, count: int = 200) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(4)
    sizes = 2.0 ** rng.uniform(-2, np.log2(model.bound) + 0.1, (count, 1))
    return sizes * rng.uniform(-1, 1, (count, 3)), oracle.directions(rng, count)


@pytest.mark.parametrize("name", MODELS)
def test_torch_ngp(name, tmp_path):
    model, (points, d) = MODELS[name], places(MODELS[name])
    checkpoint = written(model, tmp_path)
    assert checkpoint.system == "torch-ngp"
    imported = torch_ngp.read(checkpoint)
    state = state_of(model, False)
    oracle.assert_alike(oracle.answers(imported, points, d), expected(model, state, points, d, False))
    said = " ".join(imported.notes)
    assert ("moving averages" in said) == ("ema" in model.more)
    assert ("finest level is taken to have" in said) == (model.finest != 2048)
    assert ("behind the scene" in said) == ("bg_net.0.weight" in model.more)
    assert ("is cut to" in said) == bool(model.shown)


@pytest.mark.parametrize("name", PVD)
def test_pvd(name, tmp_path):
    model, (points, d) = PVD[name], places(PVD[name])
    checkpoint = written(model, tmp_path, True)
    assert checkpoint.system == "pvd"
    imported = torch_ngp.read_pvd(checkpoint)
    found = oracle.answers(imported, points, d)
    oracle.assert_alike(found, expected(model, state_of(model, True), points, d, True))
    assert any("between -2 and 7" in note for note in imported.notes) == (not model.args)


@pytest.mark.parametrize("kind", ["hash", "tensors"])
def test_pvd_lies_where_its_capture_does(kind, tmp_path):
    """nerf_matrix_to_ngp takes a camera's y, z, x times the run's scale."""
    model = replace(PVD[kind], args={"scale": 0.8, "mode": "blender"})
    checkpoint, (points, d) = written(model, tmp_path, True), places(model)
    own = torch_ngp.read_pvd(checkpoint)
    assert torch_ngp.FRAME in own.notes and own.up == (0, 1, 0)
    imported = torch_ngp.read_pvd(checkpoint, SimpleNamespace(kind="blender"))
    x, y, z = (points / 0.8)[:, [2, 0, 1]].T  # of the capture, of which the model's are y, z, x
    assert np.allclose(np.stack([y, z, x], 1) * 0.8, points)
    sigma, rgb = oracle.answers(imported, np.stack([x, y, z], 1), d[:, [2, 0, 1]])
    expect = expected(model, state_of(model, True), points, d, True)
    oracle.assert_alike((sigma / 0.8, rgb), expect)
    assert torch_ngp.FRAME not in imported.notes and imported.up == (0, 0, 1)


def test_cells_of_spring_2022_are_refused(tmp_path):
    grid = np.zeros((1, SIDE, SIDE, SIDE), np.float32)
    with pytest.raises(FormatError, match="spring 2022.*train it with a later one"):
        torch_ngp.read(written(Model(), tmp_path, density_grid=grid))


def test_limits_of_pvd_that_are_none_are_named(tmp_path):
    checkpoint = written(Model("tensors", args={"sigma_clip_min": 7}), tmp_path, True)
    with pytest.raises(FormatError, match="'sigma_clip_min' should be below 'sigma_clip_max'"):
        torch_ngp.read_pvd(checkpoint)


def test_the_command_writes_what_it_shows(tmp_path):
    """Cascades, and a box that pictures are cut to, in one group of a bundle."""
    model = Model(bound=8, shown=(-8.0, -4.0, -8.0, 8.0, 8.0, 1.0))
    checkpoint, (points, d) = written(model, tmp_path), places(model, 60)
    report = verbs.import_field(checkpoint.path, output=tmp_path / "f.rfpack", name="fox")
    assert [entry["name"] for entry in report["fields"]] == ["fox-1", "fox-2"]
    assert report["system"] == "torch-ngp" and any("is cut to" in note for note in report["notes"])
    found = oracle.asked(tmp_path / "f.rfpack", points, d)
    oracle.assert_alike(found, expected(model, state_of(model, False), points, d, False), 2e-3)


def test_rows_that_cascades_share_count_among_the_bytes_of_each(tmp_path):
    """What a file is foretold to take holds all numbers of a field, and all of a bundle each member once."""
    verbs.import_field(written(Model(bound=8), tmp_path).path, output=tmp_path / "f.rfpack")
    loaded = load_scene(str(tmp_path / "f.rfpack"))
    assert len(loaded.fields) > 1
    for source in loaded.fields:
        field = opened(source.placed.field)
        numbers = sum(np.asarray(array).nbytes for array in field.state()[0].values())
        assert BundleSizes().exactly(field, "float32") > numbers
        assert stored_bytes(loaded)[id(source.placed.field)] > numbers
    headers = OpenBundle(tmp_path / "f.rfpack").headers
    assert unchanged_bytes(loaded) == sum(header.size for header in headers.values())


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"color_net.0.weight": None}, "'color_net.0.weight'"),
        ({"encoder.embeddings": np.zeros((9, 2), np.float32)}, "'encoder.offsets' should count up to 9 rows"),
        ({"encoder.offsets": np.array([0, 32, 96, 192, 256], np.int32)}, "rows of a grid of 16 to 2048 ver"),
        ({"sigma_net.0.weight": np.zeros((16, 9), np.float32)}, "a network should read at most 8 features"),
        ({"sigma_net.1.weight": np.full((16, 16), np.nan, np.float32)}, "holds NaN or infinity"),
        ({"aabb_infer": np.zeros(6, np.float32)}, "three minima below three maxima"),
        ({"density_bitfield": np.zeros(7, np.uint8)}, "56 cells are no 1 cubes"),
        ({"density_bitfield": np.zeros(SIDE**3 // 8, np.uint8)}, "there is nothing to see"),
    ],
)
def test_what_does_not_fit_is_refused_in_a_sentence(changed, said, tmp_path):
    checkpoint, output = written(Model(), tmp_path, **changed), tmp_path / "f.rfpack"
    with pytest.raises(InvalidInput) as caught:
        verbs.import_field(checkpoint.path, output=output)
    assert str(checkpoint.path) in str(caught.value) and said in str(caught.value)
    assert caught.value.exit_code == 3 and not output.exists()
