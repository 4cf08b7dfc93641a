"""Checkpoints of nerf-pytorch, krrish94's and HashNeRF, written here as their runs write them, against their
formulas in numpy."""

from collections import OrderedDict
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from click.testing import CliRunner

from formats.bundle import read_bundle
from formats.camera_set import read_camera_set
from formats.captures import write_capture
from formats.errors import FormatError
from formats.foreign.systems import open_checkpoint
from formats.views import View
from fusedrf_cli.bridge.importing import nerf
from fusedrf_cli.bridge.importing.parts import LLFF
from fusedrf_cli.main import cli
from fusedrf_cli.python import open_scene
from tests.bridge.importing.asked import (
    answers,
    assert_equal,
    dense,
    directions,
    layer,
    rectified,
    sigmoid,
)

BOX = np.array([-1.1, -0.7, -0.9, 0.8, 1.2, 1.0])


def points_around(box: np.ndarray = BOX, count: int = 300) -> np.ndarray:
    """Most of them in the box."""
    middle, half = (box[:3] + box[3:]) / 2, (box[3:] - box[:3]) / 2
    return middle + 1.15 * half * np.random.default_rng(1).uniform(-1, 1, (count, 3))


def inside(points: np.ndarray, box: np.ndarray = BOX) -> np.ndarray:
    return ((points >= box[:3]) & (points <= box[3:])).all(1)


def encoded(x: np.ndarray, bands: int, itself: bool = True) -> np.ndarray:
    """Sines and cosines, frequency by frequency."""
    parts = [x] if itself else []
    for band in range(bands):
        parts += [np.sin(x * 2.0**band), np.cos(x * 2.0**band)]
    return np.concatenate([np.zeros((len(x), 0)), *parts], 1)


def centred(state: dict, name: str, raw, model) -> None:
    """Make half of the densities of a network of this last layer positive."""
    middle = np.median(raw(model, state, points_around(), directions(300))[0])
    state[f"{name}.bias"][3 if len(state[f"{name}.bias"]) > 3 else 0] -= middle


# -- nerf-pytorch --------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Net:
    """What run_nerf.py is told."""

    depth: int = 8
    width: int = 16
    multires: int = 4
    multires_views: int = 2
    directions: bool = True
    outputs: int = 5
    fine: bool = True
    skips: tuple[int, ...] = (4,)
    harmonics: bool = False
    views: int = 1

    @property
    def seen(self) -> int:
        """Numbers of a direction."""
        if not self.directions:
            return 0
        return 16 if self.harmonics else 3 + 6 * self.multires_views


NETS = {
    "usual": Net(),
    "six layers of 20": Net(depth=6, width=20),
    "three layers": Net(depth=3, fine=False),
    "one layer": Net(depth=1),
    "no encoding (i_embed -1)": Net(multires=0, multires_views=0),
    "ten frequencies": Net(multires=10, multires_views=4),
    "no directions": Net(directions=False),
    "no directions, no fine network": Net(directions=False, outputs=4, fine=False, depth=5, skips=(2,)),
    "a skip at the second layer": Net(skips=(0,)),
    "two skips": Net(skips=(1, 4)),
    "three skips": Net(skips=(0, 1, 5), depth=7),
    "harmonics of the direction": Net(harmonics=True),
    "more layers of the direction": Net(views=3),
}


def nerf_state(net: Net) -> OrderedDict:
    """The state of nerf-pytorch's NeRF."""
    state, read, w = OrderedDict(), 3 + 6 * net.multires, net.width
    layer(state, "pts_linears.0", read, w)
    for i in range(net.depth - 1):
        layer(state, f"pts_linears.{i + 1}", w + read * (i in net.skips), w)
    layer(state, "views_linears.0", net.seen + w, w // 2)
    for i in range(1, net.views):
        layer(state, f"views_linears.{i}", w // 2, w // 2)
    if net.directions:
        for name, inputs, outputs in (("feature", w, w), ("alpha", w, 1), ("rgb", w // 2, 3)):
            layer(state, f"{name}_linear", inputs, outputs)
    else:
        layer(state, "output_linear", w, net.outputs)
    centred(state, "alpha_linear" if net.directions else "output_linear", nerf_raw, net)
    return state


def nerf_raw(net: Net, state: dict, points: np.ndarray, dirs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """NeRF.forward, and raw2outputs but for the density's activation."""
    x = encoded(points, net.multires)
    h = x
    for i in range(net.depth):
        h = rectified(dense(state, f"pts_linears.{i}", h))
        if i in net.skips:
            h = np.concatenate([x, h], 1)
    if not net.directions:
        raw = dense(state, "output_linear", h)
        return raw[:, 3], sigmoid(raw[:, :3])
    seen = harmonics(dirs) if net.harmonics else encoded(dirs, net.multires_views)
    alpha = dense(state, "alpha_linear", h)[:, 0]
    h = np.concatenate([dense(state, "feature_linear", h), seen], 1)
    for i in range(net.views):
        h = rectified(dense(state, f"views_linears.{i}", h))
    return alpha, sigmoid(dense(state, "rgb_linear", h))


def save_nerf(net: Net, folder, state: dict | None = None):
    state = nerf_state(net) if state is None else state
    held = {"global_step": 200, "network_fn_state_dict": state}
    if net.fine:
        held["network_fn_state_dict"] = nerf_state(replace(net, depth=2, skips=()))
        held["network_fine_state_dict"] = state
    held["optimizer_state_dict"] = {"state": {}, "param_groups": []}
    torch.save(held, folder / "000200.tar")
    return folder / "000200.tar"


@pytest.mark.parametrize("net", NETS.values(), ids=NETS)
def test_a_network_answers_as_nerf_pytorch(net, tmp_path):
    points, dirs = points_around(), directions(300)
    imported = nerf.read(open_checkpoint(save_nerf(net, tmp_path)), BOX)
    sigma, rgb = nerf_raw(net, nerf_state(net), points, dirs)
    assert_equal(answers(imported.nodes[0], points, dirs), (rectified(sigma) * inside(points), rgb))
    assert [note for note in imported.notes if "fine" in note] == [nerf.FINE] * net.fine


def test_the_compiled_loops_answer_so_as_well(tmp_path):
    """Through a bundle, in the box that is given."""
    net, points, dirs = Net(depth=2), points_around(), directions(300)
    box = ",".join(map(str, BOX))
    run("import", save_nerf(net, tmp_path), "-o", tmp_path / "a.rfpack", "--aabb", box)
    scene = open_scene(tmp_path / "a.rfpack")
    found = scene.query(torch.from_numpy(points), torch.from_numpy(dirs))
    sigma, rgb = nerf_raw(net, nerf_state(net), points, dirs)
    assert_equal([answer.detach().numpy() for answer in found], (rectified(sigma) * inside(points), rgb))


# -- where it lies -------------------------------------------------------------------------------------------


def run(*words, code: int = 0) -> str:
    result = CliRunner().invoke(cli, [str(word) for word in words])
    assert result.exit_code == code, result.output
    return result.output


def capture(folder):
    """Three cameras at a distance of 4 that look at the origin along an axis each."""
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[1, :3, :3] = [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]
    poses[2, :3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
    poses[:, :3, 3] = 4 * poses[:, :3, 2]
    views = [View(f"r_{i}", pose, 40.0, 40.0, 16.0, 12.0, 32, 24) for i, pose in enumerate(poses)]
    write_capture(folder, views, np.zeros((3, 24, 32, 3), np.uint8))
    return views


def test_cameras_and_two_distances_give_a_box_and_stay(tmp_path):
    views = capture(tmp_path / "lego")
    path = save_nerf(Net(depth=2), tmp_path)
    near_far = "--near", 2, "--far", 6, "--cameras", tmp_path / "lego"
    run("import", path, "-o", tmp_path / "a.rfpack", *near_far)
    # a camera at 4 sees from 2 to -2 along its axis, 6 · 16 / 40 aside and 6 · 12 / 40 up and down
    assert_box(tmp_path / "a.rfpack", [-2.4, -2.0, -2.4, 2.4, 2.0, 2.4])
    kept = read_camera_set(read_bundle(tmp_path / "a.rfpack").scene.cameras).train
    assert [view.name for view in kept] == [view.name for view in views]
    np.testing.assert_allclose(kept[1].camera_to_world, views[1].camera_to_world, atol=1e-6)


def assert_box(path, box) -> None:
    np.testing.assert_allclose(open_scene(path).aabb, box, atol=1e-6)


WRONG = {
    "no box": ((), "does not say where its scene lies; give the box as --aabb"),
    "no cameras": (("--near", 2, "--far", 6), "does not say where its scene lies"),
    "near beyond far": (("--near", 6, "--far", 2), "--near 6 should be less than --far 2"),
    "two boxes": (("--aabb", "-1,-1,-1,1,1,1", "--far", 6), "leave out --near and --far"),
    "a needle": (("--aabb", "0,0,0,1,1,1e9"), "no side above 10,000 times another"),
    "a box inside out": (("--aabb", "1,1,1,0,0,0"), "with each minimum below its maximum"),
}


@pytest.mark.parametrize("words, said", WRONG.values(), ids=WRONG)
def test_without_a_box_nothing_is_written(words, said, tmp_path):
    path, words = save_nerf(Net(depth=2), tmp_path), list(words)
    if "should be less" in said:
        capture(tmp_path / "lego")
        words += ["--cameras", tmp_path / "lego"]
    assert said in " ".join(run("import", path, "-o", tmp_path / "a.rfpack", *words, code=2).split())
    assert not (tmp_path / "a.rfpack").exists()


def test_a_run_in_normalised_device_coordinates_is_said_to_be(tmp_path):
    path = save_nerf(Net(depth=2), tmp_path)
    for no_ndc, expected in ((False, [nerf.NDC]), (True, [LLFF])):
        (tmp_path / "args.txt").write_text(f"dataset_type = llff\nno_ndc = {no_ndc}\n")
        notes = nerf.read(open_checkpoint(path), BOX).notes
        assert [note for note in notes if note != nerf.FINE] == expected


def test_cameras_do_not_tell_a_box_in_normalised_device_coordinates(tmp_path):
    capture(tmp_path / "fern")
    path = save_nerf(Net(depth=2), tmp_path)
    near_far = "--near", 2, "--far", 6, "--cameras", tmp_path / "fern"
    for no_ndc, because in ((False, "normalised device coordinates"), (True, "moved and scaled")):
        (tmp_path / "args.txt").write_text(f"dataset_type = llff\nno_ndc = {no_ndc}\n")
        said = " ".join(run("import", path, "-o", tmp_path / "a.rfpack", *near_far, code=2).split())
        assert because in said and "give its box there as --aabb" in said
    (tmp_path / "args.txt").write_text("dataset_type = blender\nno_ndc = True\n")
    run("import", path, "-o", tmp_path / "a.rfpack", *near_far)


def test_an_encoding_that_is_not_read_is_named(tmp_path):
    path = save_nerf(Net(depth=2), tmp_path)
    (tmp_path / "args.txt").write_text("i_embed = 2\n")
    with pytest.raises(FormatError, match="'i_embed = 2', an encoding that is not read"):
        nerf.read(open_checkpoint(path), BOX)


# -- krrish94's ----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Flexible:
    """What FlexibleNeRFModel is told."""

    layers: int = 4
    hidden: int = 16
    skip_every: int = 4
    bands: int = 4
    bands_dir: int = 2
    itself: bool = True
    itself_dir: bool = True
    directions: bool = True


FLEXIBLE = {
    "usual": Flexible(),
    "two layers of 20": Flexible(layers=2, hidden=20),
    "no directions": Flexible(directions=False),
    "a skip": Flexible(layers=8),
    "skips of no point": Flexible(layers=8, skip_every=3, itself=False),
    "no direction itself": Flexible(itself_dir=False, bands_dir=4),
    "no point": Flexible(itself=False),
    "no frequencies": Flexible(bands=0, bands_dir=0),
}


def reads_again(model: Flexible, i: int) -> bool:
    return i % model.skip_every == 0 and i > 0 and i != model.layers - 1


def flexible_state(model: Flexible) -> OrderedDict:
    state, w = OrderedDict(), model.hidden
    read = 3 * model.itself + 6 * model.bands
    layer(state, "layer1", read, w)
    for i in range(model.layers - 1):
        layer(state, f"layers_xyz.{i}", w + read * reads_again(model, i), w)
    if model.directions:
        layer(state, "layers_dir.0", 3 * model.itself_dir + 6 * model.bands_dir + w, w // 2)
        for name, inputs, outputs in (("alpha", w, 1), ("rgb", w // 2, 3), ("feat", w, w)):
            layer(state, f"fc_{name}", inputs, outputs)
    else:
        layer(state, "fc_out", w, 4)
    centred(state, "fc_alpha" if model.directions else "fc_out", flexible_raw, model)
    return state


def flexible_raw(model: Flexible, state: dict, points: np.ndarray, dirs: np.ndarray):
    """FlexibleNeRFModel.forward, and volume_render_radiance_field's activation of colours."""
    x = encoded(points, model.bands, model.itself)
    h = dense(state, "layer1", x)
    for i in range(model.layers - 1):
        h = np.concatenate([h, x], 1) if reads_again(model, i) else h
        h = rectified(dense(state, f"layers_xyz.{i}", h))
    if not model.directions:
        raw = dense(state, "fc_out", h)
        return raw[:, 3], sigmoid(raw[:, :3])
    alpha, features = dense(state, "fc_alpha", h)[:, 0], rectified(dense(state, "fc_feat", h))
    read = np.concatenate([features, encoded(dirs, model.bands_dir, model.itself_dir)], 1)
    return alpha, sigmoid(dense(state, "fc_rgb", rectified(dense(state, "layers_dir.0", read))))


def save_flexible(model: Flexible, folder, fine: bool = True):
    state, held = flexible_state(model), {"iter": 9, "loss": torch.tensor(0.5), "psnr": 20.0}
    held["model_coarse_state_dict"] = flexible_state(replace(model, layers=2)) if fine else state
    held["model_fine_state_dict"] = state if fine else None
    torch.save(held, folder / "checkpoint00009.ckpt", _use_new_zipfile_serialization=not fine)
    return open_checkpoint(folder / "checkpoint00009.ckpt")


@pytest.mark.parametrize("model", FLEXIBLE.values(), ids=FLEXIBLE)
def test_a_network_answers_as_krrish94s(model, tmp_path):
    points, dirs = points_around(), directions(300)
    imported = nerf.read_krrish(save_flexible(model, tmp_path, fine=model.hidden == 16), BOX)
    sigma, rgb = flexible_raw(model, flexible_state(model), points, dirs)
    assert_equal(answers(imported.nodes[0], points, dirs), (rectified(sigma) * inside(points), rgb))


@pytest.mark.parametrize("itself", [True, False])
def test_a_network_answers_as_krrish94s_of_the_paper(itself, tmp_path):
    """PaperNeRFModel.forward: density of the features, which are not rectified; three of four layers of
    colours."""
    state, w, read = OrderedDict(), 16, 3 * itself + 6 * 4
    for i in range(8):
        layer(state, f"layers_xyz.{i}", (read if i in (0, 4) else 0) + (w if i else 0), w)
    for i in range(4):
        layer(state, f"layers_dir.{i}", w + 3 * itself + 6 * 2 if i == 0 else 8, 8)
    for name, inputs, outputs in (("alpha", w, 1), ("rgb", 8, 3), ("feat", w, w)):
        layer(state, f"fc_{name}", inputs, outputs)

    def raw(model, state, points, dirs):
        h = x = encoded(points, 4, itself)
        for i in range(8):
            h = rectified(dense(state, f"layers_xyz.{i}", np.concatenate([x, h], 1) if i == 4 else h))
        features = dense(state, "fc_feat", h)
        seen = np.concatenate([features, encoded(dirs, 2, itself)], 1)
        for i in range(3):
            seen = rectified(dense(state, f"layers_dir.{i}", seen))
        return dense(state, "fc_alpha", features)[:, 0], sigmoid(dense(state, "fc_rgb", seen))

    centred(state, "fc_alpha", raw, None)
    torch.save({"iter": 9, "model_coarse_state_dict": state}, tmp_path / "checkpoint00009.ckpt")
    imported = nerf.read_krrish(open_checkpoint(tmp_path / "checkpoint00009.ckpt"), BOX)
    points, dirs = points_around(), directions(300)
    sigma, rgb = raw(None, state, points, dirs)
    assert_equal(answers(imported.nodes[0], points, dirs), (rectified(sigma) * inside(points), rgb))


def test_frequencies_that_are_evenly_spaced_are_refused(tmp_path):
    (tmp_path / "config.yml").write_text("models: {coarse: {log_sampling_xyz: false}}\n")
    with pytest.raises(FormatError, match="'log_sampling_xyz: false'.* not taken over"):
        nerf.read_krrish(save_flexible(Flexible(), tmp_path), BOX)


# -- HashNeRF ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Hashed:
    """What HashNeRF's run_nerf.py is told, and its HashEmbedder makes of it."""

    levels: int = 5
    log2_rows: int = 8
    features: int = 2
    finest: int = 512
    seen: int = 16
    fine: bool = True


HASHED = {
    "usual": Hashed(),
    "frequencies of the direction": Hashed(seen=3 + 6 * 4, finest=100, log2_rows=9),
    "no directions": Hashed(seen=0, fine=False),
    "no encoding of the direction": Hashed(seen=3, levels=3, features=3, fine=False),
}


def harmonics(d: np.ndarray) -> np.ndarray:
    """HashNeRF's SHEncoder of degree 4."""
    x, y, z = d.T
    xx, yy, zz = x * x, y * y, z * z
    return np.stack([
        0.28209479177387814 + 0 * x, -0.4886025119029199 * y, 0.4886025119029199 * z,
        -0.4886025119029199 * x, 1.0925484305920792 * x * y, -1.0925484305920792 * y * z,
        0.31539156525252005 * (2 * zz - xx - yy), -1.0925484305920792 * x * z,
        0.5462742152960396 * (xx - yy), -0.5900435899266435 * y * (3 * xx - yy),
        2.890611442640554 * x * y * z, -0.4570457994644658 * y * (4 * zz - xx - yy),
        0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy), -0.4570457994644658 * x * (4 * zz - xx - yy),
        1.445305721320277 * z * (xx - yy), -0.5900435899266435 * x * (xx - 3 * yy),
    ], 1)  # fmt: skip


def small_state(model: Hashed) -> OrderedDict:
    """The state of NeRFSmall."""
    state = OrderedDict()
    layer(state, "sigma_net.0", model.levels * model.features, 64, bias=False)
    layer(state, "sigma_net.1", 64, 16, bias=False)
    for i, (inputs, outputs) in enumerate(((model.seen + 15, 64), (64, 64), (64, 3))):
        layer(state, f"color_net.{i}", inputs, outputs, bias=False)
    return state


def tables_of(model: Hashed) -> OrderedDict:
    draw = torch.Generator().manual_seed(3)
    shape = 1 << model.log2_rows, model.features
    return OrderedDict(
        {f"embeddings.{i}.weight": torch.randn(shape, generator=draw) for i in range(model.levels)}
    )


def embedded(model: Hashed, points: np.ndarray) -> np.ndarray:
    """HashEmbedder.forward in the box."""
    base, finest = torch.tensor(16), torch.tensor(model.finest)
    growth, features = torch.exp((torch.log(finest) - torch.log(base)) / (model.levels - 1)), []
    for level, table in enumerate(tables_of(model).values()):
        size = (BOX[3:] - BOX[:3]) / float(torch.floor(base * growth**level))
        low = np.floor((points - BOX[:3]) / size).astype(np.int64)
        weights = (points - (low * size + BOX[:3])) / size
        total = 0
        for corner in np.ndindex(2, 2, 2):
            i, j, k = (low + corner).T
            row = (i ^ (j * 2654435761) ^ (k * 805459861)) & ((1 << model.log2_rows) - 1)
            weight = np.where(np.array(corner) == 1, weights, 1 - weights).prod(1)
            total = total + weight[:, None] * table.double().numpy()[row]
        features.append(total)
    return np.concatenate(features, 1)


def hashed_raw(model: Hashed, points: np.ndarray, dirs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """NeRFSmall.forward, and raw2outputs but for the density's activation."""
    state = small_state(model)
    raw = dense(state, "sigma_net.1", rectified(dense(state, "sigma_net.0", embedded(model, points))))
    seen = {16: harmonics, 0: lambda d: d[:, :0], 3: lambda d: d}.get(model.seen, lambda d: encoded(d, 4))
    h = np.concatenate([seen(dirs), raw[:, 1:]], 1)
    for i in range(2):
        h = rectified(dense(state, f"color_net.{i}", h))
    return raw[:, 0], sigmoid(dense(state, "color_net.2", h))


def save_hashed(model: Hashed, folder, args: str | None = None):
    held = {
        "global_step": 9, "network_fn_state_dict": small_state(model),
        "embed_fn_state_dict": tables_of(model), "optimizer_state_dict": {},
    }  # fmt: skip
    if model.fine:
        held["network_fine_state_dict"] = small_state(model)
        held["network_fn_state_dict"] = small_state(replace(model, levels=1))
    torch.save(held, folder / "000009.tar")
    (folder / "args.txt").write_text(f"finest_res = {model.finest}\n" if args is None else args)
    return folder / "000009.tar"


@pytest.mark.parametrize("model", HASHED.values(), ids=HASHED)
def test_a_network_answers_as_hashnerf(model, tmp_path):
    points, dirs = points_around(), directions(300)
    imported = nerf.read_hashed(open_checkpoint(save_hashed(model, tmp_path)), BOX)
    sigma, rgb = hashed_raw(model, points, dirs)
    assert_equal(answers(imported.nodes[0], points, dirs), (rectified(sigma) * inside(points), rgb))


@pytest.mark.parametrize("primes", [(73856093, 19349663, 83492791), (1, 2654435761, 805459861)])
def test_rows_of_hashnerfs_first_hash_are_refused(primes, tmp_path):
    """What has learnt are rows that some vertex of the coarsest level asks."""
    path = save_hashed(Hashed(log2_rows=15), tmp_path)
    table = torch.load(path)
    rows = torch.full((1 << 15, 2), 5e-5)
    for i, j, k in np.ndindex(17, 17, 17):
        rows[(i * primes[0] ^ j * primes[1] ^ k * primes[2]) & 0x7FFF] = 0.3
    table["embed_fn_state_dict"]["embeddings.0.weight"] = rows
    torch.save(table, path)
    if primes[0] == 1:
        assert nerf.read_hashed(open_checkpoint(path), BOX).nodes
    else:
        with pytest.raises(FormatError, match="HashNeRF's first hash"):
            nerf.read_hashed(open_checkpoint(path), BOX)


def test_hash_grids_of_more_levels_than_any_has_are_refused_before_they_are_read(tmp_path):
    path = save_hashed(Hashed(), tmp_path)
    held = torch.load(path)
    row = held["embed_fn_state_dict"]["embeddings.0.weight"]
    held["embed_fn_state_dict"] |= {f"embeddings.{i}.weight": row for i in range(1000)}
    torch.save(held, path)
    with pytest.raises(FormatError, match="up to 32 levels are read, found 1000"):
        nerf.read_hashed(open_checkpoint(path), BOX)


STATED = (
    "bounding_box = (tensor([-1.1000, -0.7000, -9.0000e-01], device='cuda:0'), "
    "tensor([0.8000, 1.2000, 1.0000], device='cuda:0'))\n"
)


def test_hashnerfs_box_is_the_one_that_its_run_states(tmp_path):
    path = save_hashed(Hashed(), tmp_path, STATED + "finest_res = 512\n")
    report = run("import", path, "-o", tmp_path / "a.rfpack")
    assert "args.txt" in report and "four digits" in report
    assert_box(tmp_path / "a.rfpack", BOX)
    (tmp_path / "args.txt").write_text("finest_res = 512\nbounding_box = None\n")
    output = run("import", path, "-o", tmp_path / "b.rfpack", code=2)
    assert "which box its hash grid fills; give it as --aabb" in " ".join(output.split())
    output = run("import", path, "-o", tmp_path / "b.rfpack", "--near", 2, "--far", 6, code=2)
    assert "which --near and --far do not tell" in " ".join(output.split())


def test_a_hash_grid_without_settings_is_taken_at_their_defaults(tmp_path):
    checkpoint = open_checkpoint(save_hashed(Hashed(), tmp_path, "chunk = 32768\n"))
    assert "'finest_res', for which 512 is taken" in " ".join(nerf.read_hashed(checkpoint, BOX).notes)


# -- files that are wrong ------------------------------------------------------------------------------------


def without(name: str):
    return lambda state: state.pop(name)


def with_shape(name: str, *shape: int):
    return lambda state: state.update({name: torch.zeros(shape)})


def with_nan(name: str):
    return lambda state: state[name].view(-1)[:1].fill_(np.nan)


BROKEN = {
    "no density": (without("alpha_linear.weight"), "'alpha_linear.weight' is missing"),
    "no colours": (without("rgb_linear.weight"), "'rgb_linear.weight' is missing"),
    "a layer less": (without("pts_linears.2.weight"), "layers 0, 1, 3: one is missing"),
    "a first layer less": (without("pts_linears.0.weight"), "layers 1, 2, 3: one is missing"),
    "another width": (with_shape("pts_linears.1.weight", 16, 15), "should read 16 numbers, found 15"),
    "no frequencies": (with_shape("pts_linears.0.weight", 16, 14), "6 for each frequency, found 14"),
    "features of another width": (
        with_shape("feature_linear.weight", 16, 12),
        r"read as many numbers, found \[12, 16\]",
    ),
    "a vector": (with_shape("pts_linears.0.weight", 16), "should have shape"),
    "another bias": (with_shape("pts_linears.0.bias", 15), r"should have shape \[16\], found \[15\]"),
    "no bias": (without("feature_linear.bias"), "'feature_linear.bias' is missing"),
    "two densities": (with_shape("alpha_linear.weight", 2, 16), "shape"),
    "four colours": (with_shape("rgb_linear.weight", 4, 8), "shape|3 numbers"),
    "NaN": (with_nan("pts_linears.0.bias"), "'pts_linears.0.bias' holds NaN"),
}


@pytest.mark.parametrize("change, said", BROKEN.values(), ids=BROKEN)
def test_what_is_wrong_with_a_network_is_named(change, said, tmp_path):
    net, state = Net(depth=4, skips=(2,)), nerf_state(Net(depth=4, skips=(2,)))
    change(state)
    with pytest.raises(FormatError, match=said):
        nerf.read(open_checkpoint(save_nerf(net, tmp_path, state)), BOX)


def test_the_error_names_the_file_and_nothing_is_written(tmp_path):
    state = nerf_state(Net(depth=2))
    del state["rgb_linear.weight"]
    path = save_nerf(Net(depth=2), tmp_path, state)
    output = run("import", path, "-o", tmp_path / "a.rfpack", "--aabb", "-1,-1,-1,1,1,1", code=3)
    assert path.name in output and "'rgb_linear.weight' is missing" in output
    assert not (tmp_path / "a.rfpack").exists()


def test_a_network_of_the_usual_size_that_has_been_trained_is_bounded(tmp_path):
    """Rows of trained layers sum up to 100 in magnitude; eight of 256 stay below what answers may reach."""
    net = Net(width=256, multires=10, multires_views=4)
    state = nerf_state(net)
    for name, weight in state.items():
        if name.endswith("weight"):
            weight *= 100 / weight.abs().sum(1).max()
    nerf.read(open_checkpoint(save_nerf(net, tmp_path, state)), 4 * BOX)
