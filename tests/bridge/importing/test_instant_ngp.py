"""Snapshots of Instant-NGP, written here as its serialising code writes them, against its formulas."""

import copy
import gzip
import math
from dataclasses import dataclass

import msgpack
import numpy as np
import pytest

from formats.bundle import OpenBundle
from formats.foreign.systems import open_checkpoint
from fusedrf_cli import verbs
from fusedrf_cli.bridge.importing import instant_ngp
from fusedrf_cli.errors import InvalidInput

from . import hash_oracle as oracle

SIDE = 16
INF = float("inf")


@dataclass(frozen=True)
class Snapshot:
    """What a run is told, and what its user did."""

    aabb_scale: int = 1
    levels: int = 4
    features: int = 2
    log2_rows: int = 6
    base: int | None = 16
    growth: float | None = None
    grid: str = "HashGrid"
    neurons: int = 16
    outputs: int | None = None
    hidden: tuple[int, int] = (1, 2)
    cutlass: bool = False
    float32: bool = False
    extra: int = 0
    codes: bool = True
    mitsuba: bool = False
    hdr: bool = False
    scale: float | None = 0.33
    offset: tuple[float, ...] = (0.5, 0.5, 0.5)
    cells: str = "some"
    """ "some", "none seen" below, or "unfilled"."""
    crop: tuple[float, ...] = ()
    turned: float = 0.0
    """Radians that the crop box is turned by."""
    by_capture: bool = False
    """Whether the capture's transforms.json said so."""
    zipped: bool = True


SNAPSHOTS = {
    "aabb_scale 1": Snapshot(),
    "aabb_scale 2, 8 levels of 4": Snapshot(aabb_scale=2, levels=8, features=4, zipped=False),
    "aabb_scale 4, 16 levels of 2": Snapshot(aabb_scale=4, levels=16, hidden=(1, 3)),
    "aabb_scale 8": Snapshot(aabb_scale=8, offset=(0.25, 0.5, 0.75)),
    "aabb_scale 16": Snapshot(aabb_scale=16, scale=0.1),
    "aabb_scale 32, whose finest level is not hashed": Snapshot(aabb_scale=32, levels=5, log2_rows=17),
    "aabb_scale 128": Snapshot(aabb_scale=128, levels=3),
    "a growth of its own": Snapshot(growth=1.6, base=5),
    "every vertex": Snapshot(grid="DenseGrid", growth=1.5, base=4),
    "tiled, each level alike": Snapshot(grid="TiledGrid", levels=2, features=8, base=9, growth=1.0),
    "tiled": Snapshot(grid="TiledGrid", growth=1.3, base=9),
    "a base that follows": Snapshot(base=None, log2_rows=10),
    "Cutlass": Snapshot(cutlass=True, neurons=24),
    "outputs that are filled up": Snapshot(outputs=5),
    "no hidden layer": Snapshot(cutlass=True, hidden=(0, 0)),
    "without halves": Snapshot(float32=True, cutlass=True, neurons=32),
    "mitsuba": Snapshot(mitsuba=True, scale=0.66, offset=(0.165, 0.2, 0.165), aabb_scale=2),
    "high dynamic range": Snapshot(hdr=True),
    "codes of pictures": Snapshot(extra=5),
    "codes of pictures, none in the file": Snapshot(extra=16, codes=False),
    "cells that no camera saw": Snapshot(cells="none seen", aabb_scale=2),
    "never filled": Snapshot(cells="unfilled", aabb_scale=4),
    "cut": Snapshot(crop=(0.1, 0.0, 0.3, 0.9, 0.7, 1.0)),
    "cut, never filled": Snapshot(crop=(0.1, -0.5, 0.3, 0.9, 0.7, 2.0), cells="unfilled", aabb_scale=2),
    "cut to a turned box": Snapshot(crop=(-0.2, 0.1, 0.05, 0.7, 1.2, 0.9), turned=0.5),
    "cut by its capture": Snapshot(crop=(0.1, 0.0, 0.3, 0.9, 0.7, 1.0), by_capture=True),
    "without a capture": Snapshot(scale=None),
}
"""By what is peculiar."""


def padded(count: int, by: int) -> int:
    return -(-count // by) * by


def matrices(rng, widths: list[int]) -> list[np.ndarray]:
    return [
        rng.normal(size=(n, m), scale=(2 / m) ** 0.5).astype(np.float16)
        for m, n in zip(widths, widths[1:], strict=False)
    ]


def widths_of(made: Snapshot) -> tuple[list[int], list[int]]:
    """Widths of both networks' layers as they are stored."""
    by = 8 if made.cutlass else 16
    seen = 16 + padded(made.extra, by)
    inputs = padded(made.levels * made.features, by)
    return (
        [inputs, *[made.neurons] * made.hidden[0], 16],
        [padded(16 + seen, by), *[made.neurons] * made.hidden[1], padded(3, by)],
    )


def levels_of(made: Snapshot) -> tuple[list[float], list[int], list[int]]:
    """Scale, vertices along an axis, and rows of each level."""
    single, base = np.float32, made.base or 1 << made.log2_rows // 3
    growth = single(made.growth or 0)
    if not growth:
        ratio = single(2048 * made.aabb_scale / base)
        growth = single(math.exp(single(single(math.log(ratio)) / single(made.levels - 1))))
    log2 = single(math.log2(growth))
    scales = [float(single(single(2.0 ** float(single(n) * log2)) * base) - 1) for n in range(made.levels)]
    sides = [math.ceil(scale) + 1 for scale in scales]
    most = {"HashGrid": 1 << made.log2_rows, "TiledGrid": base**3}.get(made.grid, 1 << 30)
    return scales, sides, [min(padded(side**3, 8), most) for side in sides]


def numbers_of(made: Snapshot):
    """The networks' matrices, the tables of the levels, and the density grid (cascades, S³), as stored."""
    rng = np.random.default_rng(5)
    own, shading = widths_of(made)
    density, colour = matrices(rng, own), matrices(rng, shading)
    tables = [rng.normal(size=(rows, made.features)).astype(np.float16) for rows in levels_of(made)[2]]
    cascades = 1 + int(math.log2(made.aabb_scale))
    values = np.where(rng.random((cascades, SIDE**3)) < 0.5, rng.uniform(0.05, 3, (cascades, SIDE**3)), 1e-3)
    if made.cells == "none seen":
        values[:, : SIDE**3 // 4] = -1
    return density, colour, tables, values.astype(np.float16)


def codes_of(made: Snapshot) -> list[list[float]]:
    """Of two photos."""
    return np.random.default_rng(9).uniform(-1, 1, (2, made.extra)).astype(np.float32).tolist()


def root_of(made: Snapshot) -> dict:
    """The map that a snapshot is."""
    density, colour, tables, cells = numbers_of(made)
    numbers = np.concatenate([x.reshape(-1) for x in (*density, *colour, *tables)])
    otype = "CutlassMLP" if made.cutlass and not made.float32 else "FullyFusedMLP"
    mlp = {"otype": otype, "activation": "ReLU", "output_activation": "None", "n_neurons": made.neurons}
    encoding = {
        "otype": made.grid, "n_levels": made.levels, "n_features_per_level": made.features,
        "log2_hashmap_size": made.log2_rows,
    }  # fmt: skip
    encoding |= {"base_resolution": made.base} if made.base else {}
    encoding |= {"per_level_scale": made.growth} if made.growth else {}
    half = made.aabb_scale / 2
    cube = {"min": [0.5 - half] * 3, "max": [0.5 + half] * 3}
    c, s = math.cos(made.turned), math.sin(made.turned)
    nerf = {"aabb_scale": made.aabb_scale, "cam_pos_offset": [], "cam_rot_offset": [], "extra_dims_opt": []}
    if made.extra and made.codes:
        states = [{"iter": 9, "variable": code, "first_moment": code} for code in codes_of(made)]
        nerf["extra_dims_opt"] = states
    if made.scale is not None:
        nerf["dataset"] = {
            "aabb_scale": made.aabb_scale, "envmap_resolution": [0, 0], "from_mitsuba": made.mitsuba,
            "is_hdr": made.hdr, "metadata": [], "n_extra_learnable_dims": made.extra, "n_images": 0,
            "offset": list(made.offset), "paths": [], "render_aabb": {"min": [INF] * 3, "max": [-INF] * 3},
            "render_aabb_to_local": np.eye(3).tolist(), "scale": made.scale, "up": [0, 1, 0], "xforms": [],
        }  # fmt: skip
    snapshot = {
        "aabb": cube, "background_color": [0.0] * 4, "bounding_radius": 1.0,
        "density_grid_binary": b"" if made.cells == "unfilled" else cells.tobytes(),
        "density_grid_size": SIDE, "mode": "nerf", "n_params": len(numbers), "nerf": nerf,
        "params_binary": numbers.astype(np.float32 if made.float32 else np.float16).tobytes(),
        "params_type": "float" if made.float32 else "__half",
        "render_aabb": {"min": list(made.crop[:3]), "max": list(made.crop[3:])} if made.crop else cube,
        "render_aabb_to_local": [[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]],
        "training_step": 2000, "version": 1,
    }  # fmt: skip
    outputs = {"n_output_dims": made.outputs} if made.outputs else {}
    if made.by_capture:
        nerf["dataset"]["render_aabb"] = snapshot.pop("render_aabb")
    directions = [{"n_dims_to_encode": 3, "otype": "SphericalHarmonics", "degree": 4}, {"otype": "Identity"}]
    return {
        "dir_encoding": {"nested": directions, "otype": "Composite"}, "encoding": encoding,
        "loss": {"otype": "Huber"}, "network": mlp | {"n_hidden_layers": made.hidden[0]} | outputs,
        "rgb_network": mlp | {"n_hidden_layers": made.hidden[1]}, "snapshot": snapshot,
    }  # fmt: skip


def written(root: dict, folder, zipped: bool = True):
    """A snapshot, opened."""
    data = msgpack.packb(root)
    path = folder / ("base.ingp" if zipped else "base.msgpack")
    path.write_bytes(gzip.compress(data) if zipped else data)
    return open_checkpoint(path)


# -- its formulas --------------------------------------------------------------------------------------------


def bits_of(made: Snapshot) -> np.ndarray:
    """The bit field (cascades, S³): cells of a coarser cascade have those that lie in them as well."""
    values = numbers_of(made)[3].astype(np.float64)
    bits = values > min(0.01, np.maximum(values[0], 0).mean())
    for level in range(1, len(bits)):
        for i, j, k in np.ndindex(SIDE, SIDE, SIDE):
            if bits[level - 1, oracle.morton(i, j, k)]:
                at = (n // 2 + SIDE // 4 for n in (i, j, k))
                bits[level, oracle.morton(*at)] = True
    return bits


def expected(made: Snapshot, points: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """σ and rgb in the coordinates of the capture's cameras."""
    scale, offset = made.scale or 0.33, np.array(made.offset if made.scale else (0.5,) * 3)
    p = points * scale + offset
    if not made.mitsuba:
        p, d = p[:, [1, 2, 0]], d[:, [1, 2, 0]]
    density, colour, tables, _ = numbers_of(made)
    scales, sides, _ = levels_of(made)
    u = (p - 0.5) / made.aabb_scale + 0.5
    tables = [table.astype(np.float64) for table in tables]
    h = oracle.grid(u, tables, scales, sides, never=made.grid != "HashGrid")
    own, shading = widths_of(made)
    h = oracle.network(np.pad(h, ((0, 0), (0, own[0] - h.shape[1]))), *density)
    code = codes_of(made)[0] if made.codes else [0.0] * made.extra
    codes = np.tile([*code, *[1.0] * (shading[0] - 32 - made.extra)], (len(p), 1))
    raw = oracle.network(np.concatenate([h, oracle.harmonics(d), codes], 1), *colour)[:, :3]
    rgb = np.exp(raw.clip(-10, 10)) if made.hdr else oracle.sigmoid(raw)
    inside = (np.abs(p - 0.5) <= made.aabb_scale / 2).all(1)
    if made.cells != "unfilled":
        inside &= oracle.occupied(2 * (p - 0.5), bits_of(made), made.aabb_scale).astype(bool)
    if made.crop:
        c, s = math.cos(made.turned), math.sin(made.turned)
        q = p @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]).T
        inside &= ((q >= made.crop[:3]) & (q <= made.crop[3:])).all(1)
    return np.exp(h[:, 0]) * scale * inside, rgb


def places(made: Snapshot, count: int = 200) -> tuple[np.ndarray, np.ndarray]:
    """Points of the capture, most near the middle, some outside."""
    rng = np.random.default_rng(6)
    sizes = 2.0 ** rng.uniform(-2, math.log2(made.aabb_scale) + 0.1, (count, 1)) / 2
    p = 0.5 + sizes * rng.uniform(-1, 1, (count, 3))
    if not made.mitsuba:
        p = p[:, [2, 0, 1]]
    offset = np.array(made.offset if made.scale else (0.5,) * 3)
    return (p - offset) / (made.scale or 0.33), oracle.directions(rng, count)


@pytest.mark.parametrize("name", SNAPSHOTS)
def test_instant_ngp(name, tmp_path):
    made, (points, d) = SNAPSHOTS[name], places(SNAPSHOTS[name])
    checkpoint = written(root_of(made), tmp_path, made.zipped)
    assert checkpoint.system == "instant-ngp"
    imported = instant_ngp.read(checkpoint)
    oracle.assert_alike(oracle.answers(imported, points, d), expected(made, points, d))
    said = " ".join(imported.notes)
    assert ("crop box" in said) == bool(made.crop)
    assert ("first photo's" in said) == bool(made.extra and made.codes)
    assert ("fixed to 0" in said) == bool(made.extra and not made.codes)
    assert ("scale 0.33 and offset 0.5" in said) == (made.scale is None)


@pytest.mark.parametrize("float32", [False, True])
def test_parameters_of_2022_do_not_say_their_type(float32, tmp_path):
    made = Snapshot(float32=float32)
    root, (points, d) = root_of(made), places(made)
    del root["snapshot"]["params_type"]
    imported = instant_ngp.read(written(root, tmp_path))
    oracle.assert_alike(oracle.answers(imported, points, d), expected(made, points, d))


def test_the_command_writes_what_it_shows(tmp_path):
    made = Snapshot(aabb_scale=8, crop=(-3.0, -3.5, -2.0, 3.0, 4.5, 4.5))
    checkpoint, (points, d) = written(root_of(made), tmp_path), places(made)
    report = verbs.import_field(checkpoint.path, output=tmp_path / "f.rfpack")
    assert [entry["name"] for entry in report["fields"]] == ["base-1", "base-2"]
    assert report["notes"] == [instant_ngp.CROPPED]
    kinds = sorted(header.kind for header in OpenBundle(tmp_path / "f.rfpack").headers.values())
    assert kinds == ["assembled", "assembled", "part"]  # the grid's rows, once
    oracle.assert_alike(oracle.asked(tmp_path / "f.rfpack", points, d), expected(made, points, d), 5e-3)


@pytest.mark.parametrize(
    ("place", "value", "said"),
    [
        ("network", None, "'network' is missing"),
        ("network.activation", "Sine", "'activation' should be ReLU, found 'Sine'"),
        ("encoding.otype", "Frequency", "'otype' should be HashGrid, DenseGrid or Ti"),
        ("encoding.hash", "ReversedPrime", "'hash' should be CoherentPrime, found 'ReversedPrime'"),
        ("encoding.type", "Tiled", "a tiled grid of"),
        ("encoding.interpolation", "Smoothstep", "'interpolation' should be Linear"),
        ("encoding.per_level_scale", 1e12, "vertices along an axis is not read"),
        ("encoding.n_levels", 99, "'n_levels' should be a whole number from 1 to 32, found 99"),
        ("dir_encoding.nested", [{"otype": "Frequency"}], "SphericalHarmonics of degree 4, found Frequency"),
        ("snapshot.params_binary", bytes(600), "'params_binary' has 300 numbers"),
        ("snapshot.params_binary", b"\xff\x7f" * 300, "'params_binary' holds NaN"),
        ("snapshot.params_type", "double", "'params_type' should be __half or float"),
        ("snapshot.density_grid_binary", bytes(2 * 9**3), "has 729 cells, and an 'aabb_scale' of 1 asks for"),
        ("snapshot.density_grid_binary", bytes(2 * SIDE**3), "there is nothing to see"),
        ("snapshot.nerf.dataset.scale", 0.0, "'scale' should be above 0, found 0"),
        ("snapshot.nerf.aabb_scale", 3, "'aabb_scale' should be a power of two, found 3"),
        ("snapshot.render_aabb", {"min": [0, 0], "max": [1]}, "'min' should be 3 numbers"),
        ("snapshot.render_aabb_to_local", [["x"]], "should be 3 × 3 numbers"),
        ("snapshot.render_aabb_to_local", [[0] * 3] * 3, "should be a matrix that can be undone"),
    ],
)
def test_what_does_not_fit_is_refused_in_a_sentence(place, value, said, tmp_path):
    root = copy.deepcopy(root_of(Snapshot()))
    *path, last = place.split(".")
    inner = root
    for name in path:
        inner = inner[name]
    inner.pop(last, None)
    inner |= {} if value is None else {last: value}
    checkpoint, output = written(root, tmp_path), tmp_path / "f.rfpack"
    with pytest.raises(InvalidInput) as caught:
        verbs.import_field(checkpoint.path, output=output)
    assert str(checkpoint.path) in str(caught.value) and said in str(caught.value)
    assert caught.value.exit_code == 3 and not output.exists()
