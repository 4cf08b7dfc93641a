"""nerfacto's checkpoints, written here as nerfstudio's trainer writes them, against its formulas."""

import json
import math
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch

from formats.bundle import read_summary
from formats.captures import read_capture
from formats.foreign.systems import open_checkpoint
from fusedrf_cli import verbs
from fusedrf_cli.bridge.importing import nerfacto
from fusedrf_cli.errors import InvalidInput
from tests.formats.test_captures import photo, posed, write

from . import hash_oracle as oracle


@dataclass(frozen=True)
class Run:
    """What a run is told."""

    tcnn: bool = False
    layout: str = "now"
    """Or "between" (2023), whose grid and network are apart, or "before", tiny-cuda-nn's whole."""
    levels: int = 4
    log2_rows: int = 6
    base: int = 16
    finest: int = 100
    features: int = 2
    geometry: int = 15
    layers: tuple[int, int] = (1, 2)
    """Hidden ones of both networks."""
    wide: tuple[int, int] = (16, 16)
    codes: int = 4
    average: bool | None = True
    """None: before that was a setting."""
    contracted: bool = True
    density: float | None = 0.01
    config: bool = True
    prefix: str = "_model."
    transforms: bool = True
    marched: bool = False
    """Whether it is nerfstudio's instant-ngp."""
    semantic: bool = False
    contraction: int | None = None
    """And if it is of before April 2023, its contraction."""


RUNS = {
    "torch": Run(),
    "tiny-cuda-nn": Run(tcnn=True),
    "torch, more of everything": Run(features=4, base=8, geometry=7, layers=(2, 3), wide=(24, 40), levels=5),
    "tiny-cuda-nn, more of everything": Run(tcnn=True, features=4, base=8, layers=(2, 1), wide=(32, 128)),
    "Cutlass": Run(tcnn=True, wide=(48, 24)),
    "as large as nerfacto-huge": Run(tcnn=True, wide=(256, 256), codes=32, finest=8192),
    "without codes": Run(codes=0),
    "without codes, tiny-cuda-nn": Run(tcnn=True, codes=0),
    "codes of 0": Run(average=False, codes=32),
    "codes of 0, tiny-cuda-nn": Run(tcnn=True, average=False, codes=32),
    "in a box": Run(contracted=False, density=1.0),
    "in a box, tiny-cuda-nn": Run(tcnn=True, contracted=False, density=1.0),
    "before densities had a scale": Run(density=None),
    "without settings": Run(config=False, wide=(64, 64)),
    "without settings, tiny-cuda-nn": Run(tcnn=True, config=False, wide=(128, 64), layers=(1, 2)),
    "Semantic NeRF-W": Run(semantic=True),
    "Semantic NeRF-W without settings": Run(config=False, wide=(64, 64), semantic=True),
    "on several GPUs": Run(prefix="_model.module."),
    "wrapped whole": Run(tcnn=True, prefix="module._model."),
    "of 2023": Run(layout="between", density=None),
    "of 2023, tiny-cuda-nn": Run(tcnn=True, layout="between", density=None),
    "of 2022": Run(tcnn=True, layout="before", density=None, config=False, wide=(64, 64)),
    "without transforms": Run(transforms=False),
    "nerfstudio's instant-ngp": Run(tcnn=True, codes=0, density=None, marched=True),
    "its codes": Run(tcnn=True, codes=32, average=None, density=None, marched=True),
    "its codes without settings": Run(tcnn=True, average=False, density=None, marched=True, config=False),
    "its of 2022": Run(tcnn=True, layout="before", codes=0, density=None, marched=True, contraction=2),
    "its of 2022, codes": Run(
        tcnn=True, layout="before", codes=32, average=None, density=None, marched=True, contraction=2
    ),
    "its of 2022, in a box": Run(
        tcnn=True, layout="before", codes=0, density=None, marched=True, contraction=0, contracted=False
    ),
    "its first": Run(
        tcnn=True,
        layout="before",
        codes=0,
        density=None,
        marched=True,
        contraction=2,
        config=False,
        finest=4096,
    ),
    "of October 2022": Run(tcnn=True, layout="before", density=None, average=None, finest=1024),
    "before codes were averaged": Run(average=None, density=None),
}
NGP = Run(tcnn=True, layout="before", codes=0, density=None, marched=True, contraction=1, levels=16,
          log2_rows=19, finest=2048)  # fmt: skip
BOX = np.array([[-1.0, -1.5, -0.5], [1.5, 1.0, 1.0]], np.float32)
CUBE = np.array([[-0.5, -0.25, -0.75], [1.0, 1.25, 0.75]], np.float32)
SCALE, TURN = 0.4, 0.7
SHIFT = np.array([0.3, -0.2, 0.1])
FRAME = np.array([[1, 0, 0], [0, 0.8, -0.6], [0, 0.6, 0.8]]) @ np.array(
    [[math.cos(TURN), -math.sin(TURN), 0], [math.sin(TURN), math.cos(TURN), 0], [0, 0, 1]]
)


def padded(count: int, by: int) -> int:
    return -(-count // by) * by


def widths_of(run: Run) -> tuple[list[int], list[int]]:
    """Widths of both networks' layers, those of tiny-cuda-nn filled up."""
    own = [run.levels * run.features, *[run.wide[0]] * run.layers[0], 1 + run.geometry]
    head = [16 + run.geometry + run.codes, *[run.wide[1]] * run.layers[1], 3]
    if run.tcnn:
        for widths, wide in ((own, run.wide[0]), (head, run.wide[1])):
            by = 16 if wide in (16, 32, 64, 128) else 8
            widths[0], widths[-1] = padded(widths[0], by), padded(widths[-1], by)
    return own, head


def levels_of(run: Run) -> tuple[list[float], list[int], list[int]]:
    """Scale, vertices along an axis, and rows of each level."""
    growth = np.exp((np.log(run.finest) - np.log(run.base)) / (run.levels - 1))
    if not run.tcnn:
        # numbers of torch, in float32
        scales = torch.floor(run.base * growth ** torch.arange(run.levels)).tolist()
        return scales, [0] * run.levels, [1 << run.log2_rows] * run.levels
    log2 = np.float32(math.log2(float(np.float32(growth))))
    grown = [np.float32(2.0 ** float(np.float32(n) * log2)) for n in range(run.levels)]
    scales = [float(g * np.float32(run.base) - np.float32(1)) for g in grown]
    sides = [math.ceil(scale) + 1 for scale in scales]
    return scales, sides, [min(padded(side**3, 8), 1 << run.log2_rows) for side in sides]


def numbers_of(run: Run):
    """Both networks' (weights, bias), the tables of the levels, and the pictures' codes."""
    rng = np.random.default_rng(7)

    def layers(widths):
        made = []
        for m, n in zip(widths, widths[1:], strict=False):
            weight = rng.normal(size=(n, m), scale=(2 / m) ** 0.5)
            bias = np.zeros(n) if run.tcnn else rng.normal(size=n, scale=0.3)
            made.append([x.astype(np.float16).astype(np.float32) for x in (weight, bias)])
        return made

    own, head = map(layers, widths_of(run))
    tables = [rng.normal(size=(rows, run.features)).astype(np.float16) for rows in levels_of(run)[2]]
    return own, head, [x.astype(np.float32) for x in tables], rng.normal(size=(9, run.codes), scale=0.7)


def flat(layers) -> np.ndarray:
    return np.concatenate([weight.reshape(-1) for weight, _ in layers])


def state_of(run: Run) -> dict[str, np.ndarray]:
    """The state of a pipeline."""
    own, head, tables, codes = numbers_of(run)
    table = np.concatenate(tables)
    field = {"aabb": BOX if run.contraction is None else CUBE}
    if run.layout != "before":
        field |= {"max_res": np.int64(run.finest), "num_levels": np.int64(run.levels)}
        field["log2_hashmap_size"] = np.int64(run.log2_rows)
    if run.codes:
        name = "embedding_appearance" if run.contraction is None else "appearance_embedding"
        field[f"{name}.embedding.weight"] = codes.astype(np.float32)
    named = {
        ("now", True): "mlp_base.model.params", ("before", True): "mlp_base.params",
        ("now", False): ("mlp_base.model.0.hash_table", "mlp_base.model.1.layers"),
        ("between", False): ("mlp_base_grid.hash_table", "mlp_base_mlp.layers"),
    }  # fmt: skip
    if run.layout == "between" and run.tcnn:
        field["mlp_base_grid.tcnn_encoding.params"] = table.reshape(-1)
        field["mlp_base_mlp.tcnn_encoding.params"] = flat(own)
    elif run.tcnn:
        field[named[run.layout, True]] = np.concatenate([flat(own), table.reshape(-1)])
    else:
        grid, network = named[run.layout, False]
        field[grid] = table
        field |= {f"{network}.{i}.weight": weight for i, (weight, _) in enumerate(own)}
        field |= {f"{network}.{i}.bias": bias for i, (_, bias) in enumerate(own)}
    if run.tcnn:
        field[f"mlp_head.{'params' if run.layout == 'before' else 'tcnn_encoding.params'}"] = flat(head)
    else:
        field |= {f"mlp_head.layers.{i}.weight": weight for i, (weight, _) in enumerate(head)}
        field |= {f"mlp_head.layers.{i}.bias": bias for i, (_, bias) in enumerate(head)}
    state = {f"field.{name}": value for name, value in field.items()}
    if run.contraction is not None:
        state |= {
            "occupancy_grid._roi_aabb": CUBE.reshape(6),
            "occupancy_grid._binary": np.ones((2, 2, 2), bool),
        }
    state["occupancy_grid.occs" if run.marched else "proposal_networks.0.aabb"] = BOX
    state["field.mlp_pred_normals.layers.0.weight"] = BOX
    if run.semantic:
        state["field.mlp_semantics.layers.0.weight"] = BOX
    state["camera_optimizer.pose_adjustment"] = np.zeros((9, 6), np.float32)
    return {run.prefix + name: value for name, value in state.items()}


def written(run: Run, folder, **changed):
    """A run's folder, opened; changed: entries of its field."""
    state = state_of(run) | {f"{run.prefix}field.{name}": value for name, value in changed.items()}
    state = {n: torch.from_numpy(np.asarray(value)) for n, value in state.items() if value is not None}
    models = folder / "nerfstudio_models"
    models.mkdir()
    file = {"step": 600, "pipeline": state, "optimizers": {}, "schedulers": {}, "scalers": {}}
    torch.save(file, models / "step-000000600.ckpt")
    settings = {
        "base_res": run.base, "features_per_level": run.features, "hidden_dim": run.wide[0],
        "hidden_dim_color": run.wide[1], "appearance_embed_dim": run.codes,
        "use_average_appearance_embedding": run.average, "average_init_density": run.density,
        "disable_scene_contraction": None if run.contraction is not None else not run.contracted,
    }  # fmt: skip
    lines = "".join(f"    {n}: {json.dumps(value)}\n" for n, value in settings.items() if value is not None)
    if run.contraction is not None:
        lines += "    contraction_type: &id001 !!python/object/apply:nerfacc.contraction.ContractionType\n"
        lines += f"    - {run.contraction}\n"
    if run.config:
        (folder / "config.yml").write_text(
            "!!python/object:nerfstudio.engine.trainer.TrainerConfig\n"
            "pipeline: !!python/object:nerfstudio.pipelines.base_pipeline.VanillaPipelineConfig\n"
            "  model: !!python/object:nerfstudio.models.nerfacto.NerfactoModelConfig\n" + lines
        )
    if run.transforms:
        transform = np.concatenate([FRAME, SHIFT[:, None]], 1).tolist()
        (folder / "dataparser_transforms.json").write_text(
            json.dumps({"transform": transform, "scale": SCALE})
        )
    return open_checkpoint(folder)


# -- its formulas --------------------------------------------------------------------------------------------


def harmonics_of(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
    """nerfstudio's own harmonics of degree 4, of any vector."""
    xx, yy, zz = x**2, y**2, z**2
    return np.stack([
        0.28209479177387814 + 0 * x, 0.4886025119029199 * y, 0.4886025119029199 * z, 0.4886025119029199 * x,
        1.0925484305920792 * x * y, 1.0925484305920792 * y * z,
        0.9461746957575601 * zz - 0.31539156525251999, 1.0925484305920792 * x * z,
        0.5462742152960396 * (xx - yy), 0.5900435899266435 * y * (3 * xx - yy),
        2.890611442640554 * x * y * z, 0.4570457994644658 * y * (5 * zz - 1),
        0.3731763325901154 * z * (5 * zz - 3), 0.4570457994644658 * x * (5 * zz - 1),
        1.445305721320277 * z * (xx - yy), 0.5900435899266435 * x * (xx - 3 * yy),
    ], 1)  # fmt: skip


def filled(x: np.ndarray, count: int, by: float) -> np.ndarray:
    return np.concatenate([x, np.full((len(x), count - x.shape[1]), by)], 1)


def expected(run: Run, points: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """σ and rgb in the capture's coordinates."""
    own, head, tables, codes = numbers_of(run)
    scale = SCALE if run.transforms else 1.0
    x = scale * (points @ FRAME.T + SHIFT) if run.transforms else points
    d = d @ FRAME.T if run.transforms else d
    if run.contraction == 2:
        x = (x - CUBE[0]) / (CUBE[1] - CUBE[0]) * 2 - 1
        length = np.maximum(np.linalg.norm(x, axis=1, keepdims=True), 1e-9)
        u = np.where(length < 1, x, (2 - 1 / length) * x / length) / 4 + 0.5
    elif run.contraction == 0:
        u = (x - CUBE[0]) / (CUBE[1] - CUBE[0])
    elif run.contracted:
        most = np.maximum(np.abs(x).max(1, keepdims=True), 1e-9)
        u = (np.where(most < 1, x, (2 - 1 / most) * x / most) + 2) / 4
    else:
        u = (x - BOX[0]) / (BOX[1] - BOX[0])
    inside = ((u > 0) & (u < 1)).all(1)
    scales, sides, _ = levels_of(run)
    u = u * inside[:, None]
    if run.tcnn:
        h = oracle.grid(u, tables, scales, sides)
    else:
        h = oracle.grid(u, tables, scales, sides, offset=0.0, always=True)
    weights, biases = zip(*own, strict=True)
    h = filled(h, weights[0].shape[1], 1.0 if run.layout == "between" else 0.0)
    h = oracle.network(h, *weights, biases=biases)[:, : 1 + run.geometry]
    code = codes.astype(np.float32).astype(float).mean(0) if run.average else np.zeros(run.codes)
    seen = oracle.harmonics(d) if run.tcnn else harmonics_of(*((d + 1) / 2).T)
    read = np.concatenate([seen, h[:, 1:], np.tile(code, (len(h), 1))], 1)
    weights, biases = zip(*head, strict=True)
    rgb = oracle.network(filled(read, weights[0].shape[1], 1.0), *weights, biases=biases)[:, :3]
    density = 1.0 if run.density is None or run.semantic else run.density
    return scale * density * np.exp(h[:, 0]) * inside, oracle.sigmoid(rgb)


def places(run: Run, count: int = 150) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(8)
    x = rng.uniform(-1.2, 1.2, (count, 3)) * rng.choice([0.8, 4, 30] if run.contracted else [1.2], (count, 1))
    points = (x / SCALE - SHIFT) @ FRAME if run.transforms else x
    return points, oracle.directions(rng, count)


@pytest.mark.parametrize("name", RUNS)
def test_nerfacto(name, tmp_path):
    run, (points, d) = RUNS[name], places(RUNS[name])
    if run.layout == "before":  # of the sizes that it was written with
        finest = 2048 if run.finest < 1024 else run.finest
        run = Run(**{**run.__dict__, "levels": 16, "finest": finest, "log2_rows": 19})
    checkpoint = written(run, tmp_path)
    assert checkpoint.system == "nerfacto"
    imported = nerfacto.read(checkpoint)
    oracle.assert_alike(oracle.answers(imported, points, d), expected(run, points, d))
    said = " ".join(imported.notes)
    assert ("no config.yml" in said) == (not run.config and not run.semantic)
    assert ("sampled everywhere" in said) == run.marched
    assert ("around a ball" in said) == (run.contraction is not None and not run.config)
    assert ("no dataparser_transforms.json" in said) == (not run.transforms)
    assert ("their mean" in said) == bool(run.codes and run.average)
    assert ("fixed to 0" in said) == bool(run.codes and not run.average)


def test_the_command_writes_it(tmp_path):
    run = Run(tcnn=True)
    written(run, tmp_path)
    report = verbs.import_field(tmp_path, output=tmp_path / "f.rfpack", name="room")
    assert [entry["name"] for entry in report["fields"]] == ["room"]
    up = read_summary(tmp_path / "f.rfpack")["up"]  # which its trainer turned to +z
    assert up == pytest.approx(FRAME.T @ [0, 0, 1])
    points, d = places(run, 50)
    oracle.assert_alike(oracle.asked(tmp_path / "f.rfpack", points, d), expected(run, points, d), 1e-3)


@pytest.mark.parametrize("stated", ["all", "scale", "nothing", "used to be", "used to be, scale"])
def test_what_was_done_to_the_poses_before_is_undone_by_the_capture(stated, tmp_path):
    """nerfstudio's parser: model = f T p of the poses p in transforms.json, whose middle it puts at 0; it
    saves T A and f s, where that file says that A and s were applied."""
    rng = np.random.default_rng(3)
    applied, scale = np.eye(4), 1.0
    if stated != "nothing":
        applied[:3] = [[0, 1, 0, 0.5], [1, 0, 0, -2], [0, 0, -1, 1]] if stated == "all" else np.eye(4)[:3]
        scale = 1.0 if "used to be" == stated else 2.5
    keys = {"applied_transform": applied[:3].tolist()} if stated == "all" else {}
    keys |= {"applied_scale": scale} if scale != 1 else {}
    if "used to be" in stated:
        (tmp_path / "capture/colmap/sparse/0").mkdir(parents=True)
        applied[:3] = [[0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0]]
    poses = np.tile(np.eye(4), (6, 1, 1))
    poses[:, :3, 3] = rng.normal(size=(6, 3)) + [4, 5, 6]
    photo(tmp_path / "capture/a.png")
    write(tmp_path / "capture", frames=posed(tmp_path / "capture", poses.tolist()), fl_x=80, **keys)
    turned, size = np.eye(4), 0.3
    turned[:3, :3] = FRAME
    turned[:3, 3] = -FRAME @ poses[:, :3, 3].mean(0)
    saved = {"transform": (turned @ applied)[:3].tolist(), "scale": size * scale}
    placement, (said,) = nerfacto.placement_of(saved, read_capture(tmp_path / "capture"))
    assert ("their middle tells" in said) == ("used to be" in stated)
    points = np.concatenate([rng.normal(size=(5, 3)), np.ones((5, 1))], 1)
    model = points @ (np.diag([size] * 3 + [1]) @ turned).T
    np.testing.assert_allclose(model @ placement.T, points, atol=1e-9)


@pytest.mark.parametrize(
    ("run", "changed", "said"),
    [
        (Run(), {"mlp_head.layers.2.weight": np.zeros((4, 16))}, "should have shape [4], found [3]"),
        (Run(), {"mlp_base.model.0.hash_table": np.zeros((9, 2))}, "should have shape [256, 'any']"),
        (Run(), {"num_levels": np.int64(99)}, "a grid of 99 levels of 16 to 100 vertices"),
        (Run(), {"max_res": np.int64(2)}, "a grid of 4 levels of 16 to 2 vertices"),
        (Run(), {"mlp_head.layers.1.bias": np.full(16, np.nan)}, "holds NaN or infinity"),
        (Run(), {"mlp_head.layers.0.weight": np.zeros((16, 30))}, "should read 31 numbers and codes"),
        (Run(tcnn=True), {"mlp_base.model.params": np.zeros(99)}, "99 numbers, which no network"),
        (Run(tcnn=True), {"mlp_head.tcnn_encoding.params": np.zeros(99)}, "no network over its features has"),
        (Run(contracted=False), {"aabb": np.zeros((2, 3))}, "three minima below three maxima"),
        (NGP, {}, "should be 2, of a ball, or 0, of a box, found 1"),
        (replace(NGP, contraction=2), {"aabb": BOX}, "the box in a contracted scene should be a cube"),
        (Run(), {"mlp_base.model.0.hash_table": None}, "another method's of nerfstudio than nerfacto's"),
        (Run(tcnn=True, config=False), {"mlp_base.model.params": np.zeros(99)}, "config.yml beside it"),
        (Run(density=-1.0), {}, "'average_init_density' should be above 0, found -1"),
    ],
)  # fmt: skip
def test_what_does_not_fit_is_refused_in_a_sentence(run, changed, said, tmp_path):
    checkpoint, output = written(run, tmp_path, **changed), tmp_path / "f.rfpack"
    with pytest.raises(InvalidInput) as caught:
        verbs.import_field(checkpoint.path, output=output)
    assert str(checkpoint.path) in str(caught.value) and said in str(caught.value)
    assert caught.value.exit_code == 3 and not output.exists()
