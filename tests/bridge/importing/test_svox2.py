"""Plenoxels' files, written here as svox2's SparseGrid.save writes them, against its formulas in numpy."""

import itertools
import json
from dataclasses import dataclass

import numpy as np
import pytest
import torch
from click.testing import CliRunner

from formats.captures import read_capture
from formats.errors import FormatError, LimitExceeded
from formats.foreign.stored import StoredTensor
from formats.foreign.systems import open_checkpoint
from formats.images import write_png
from fusedrf_cli.bridge.importing import svox2
from fusedrf_cli.main import cli
from fusedrf_cli.python import open_scene

COUNTS = 5, 8, 7
RADIUS, CENTER = np.float32([1.05, 1.1, 0.9]), np.float32([0.1, -0.2, 0.05])


@dataclass(frozen=True)
class Saved:
    """What SparseGrid.save is told."""

    basis_type: int = 1
    basis_dim: int = 9
    background: bool = False
    legacy: bool = False
    even: bool = False


SAVED = {
    "harmonics": Saved(),
    "legacy": Saved(basis_dim=4, legacy=True),
    "texture": Saved(basis_type=4, basis_dim=5),
    "network": Saved(basis_type=255, basis_dim=6),
    "background": Saved(basis_dim=1, background=True, even=True),
    "a flattened background": Saved(background=True),
}


def morton(index: np.ndarray) -> np.ndarray:
    """The place in Z-order of voxels (N, 3)."""
    bits = [((index[:, 2 - axis] >> bit) & 1) << (3 * bit + axis) for bit in range(6) for axis in range(3)]
    return np.sum(bits, 0)


def entries_of(saved: Saved) -> dict[str, np.ndarray]:
    """The arrays of a random grid of which about two thirds are held, in Z-order; links below 0 tell a GPU
    how far a ray may skip."""
    rng = np.random.default_rng(0)
    links = rng.integers(-4, 0, COUNTS).astype(np.int32)
    held = np.argwhere(rng.random(COUNTS) < 0.66)
    held = held[np.argsort(morton(held))]
    links[tuple(held.T)] = np.arange(len(held))
    density = (6 * rng.normal(size=(len(held), 1)) + 2).astype(np.float32)
    sh = rng.normal(size=(len(held), 3 * saved.basis_dim)).astype(np.float16)
    if saved.legacy:
        return {"links": links, "data": np.concatenate([density, sh.astype(np.float32)], 1)}
    entries = {
        "radius": np.full(3, 1.3, np.float32) if saved.even else RADIUS, "center": CENTER, "links": links,
        "density_data": density, "sh_data": sh, "basis_type": np.int64(saved.basis_type),
    }  # fmt: skip
    if saved.basis_type == 4:
        entries["basis_data"] = rng.normal(size=(4, 4, 4, saved.basis_dim)).astype(np.float32)
    if saved.basis_type == 255:
        widths = 3 + 6 * 2, 12, 12, 12, saved.basis_dim
        for i, (n, m) in enumerate(itertools.pairwise(widths)):
            entries[f"pt__basis_mlp__{2 * i}__weight"] = (rng.normal(size=(m, n)) / n**0.5).astype(np.float32)
            entries[f"pt__basis_mlp__{2 * i}__bias"] = rng.normal(size=m).astype(np.float32)
        entries |= {"mlp_posenc_size": np.int64(2), "mlp_width": np.int64(12)}
    if saved.background:
        background = rng.integers(-3, 0, (10, 5)).astype(np.int32)
        columns = np.flatnonzero(rng.random(50) < 0.8)
        background.reshape(-1)[columns] = rng.permutation(len(columns))
        data = 4 * rng.normal(size=(len(columns), 4, 4)) * [0.5, 0.5, 0.5, 1] + [0, 0, 0, 1]
        entries |= {"background_links": background, "background_data": data.astype(np.float32)}
    return entries


def write(path, entries: dict):
    np.savez(path, **entries)
    return open_checkpoint(path)


# -- svox2's formulas ----------------------------------------------------------------------------------------


def linear_of(links: np.ndarray, rows: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Rows of a point between voxels; what is not held counts 0."""
    at = np.clip(at, 0, np.array(links.shape) - 1)
    low = np.minimum(at.astype(int), np.array(links.shape) - 2)
    total = np.zeros(rows.shape[1])
    for corner in itertools.product((0, 1), repeat=3):
        link = links[tuple(low + corner)]
        if link >= 0:
            total += np.where(corner, at - low, 1 - (at - low)).prod() * rows[link]
    return total


def basis_at(entries: dict, d: np.ndarray, count: int) -> np.ndarray:
    x, y, z = d
    if "basis_data" in entries:
        texture = entries["basis_data"]
        side = len(texture)
        links = np.arange(side**3).reshape((side,) * 3)
        return np.maximum(linear_of(links, texture.reshape(side**3, -1), (d + 1) / 2 * (side - 1)), 0)
    if "mlp_width" in entries:
        h = np.concatenate([d, *(np.sin(d * 2**i) for i in (0, 1)), *(np.cos(d * 2**i) for i in (0, 1))])
        for i in range(4):
            name = f"pt__basis_mlp__{2 * i}__"
            h = entries[name + "weight"] @ h + entries[name + "bias"]
            h = np.maximum(h, 0) if i < 3 else 1 / (1 + np.exp(-h))
        return h
    return np.array(
        [
            0.28209479177387814, -0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x,
            1.0925484305920792 * x * y, -1.0925484305920792 * y * z,
            0.31539156525252005 * (2 * z * z - x * x - y * y), -1.0925484305920792 * x * z,
            0.5462742152960396 * (x * x - y * y),
        ]
    )[:count]  # fmt: skip


def inside_of(entries: dict, p: np.ndarray, d: np.ndarray) -> tuple[float, np.ndarray]:
    """σ per world length and colour of the grid at a point."""
    radius, center = entries.get("radius", np.ones(3)), entries.get("center", np.zeros(3))
    if (abs(p - center) > radius).any():
        return 0.0, np.zeros(3)
    if "data" in entries:
        density, sh = entries["data"][:, :1], entries["data"][:, 1:]
    else:
        density, sh = entries["density_data"], entries["sh_data"].astype(np.float64)
    n = np.array(COUNTS)
    at = p * (0.5 / radius) * n + 0.5 * (1 - center / radius) * n - 0.5
    basis = basis_at(entries, d, sh.shape[1] // 3)
    colour = (linear_of(entries["links"], sh, at).reshape(3, -1) * basis).sum(1)
    return max(linear_of(entries["links"], density, at)[0], 0), np.maximum(colour + 0.5, 0)


def around_of(entries: dict, p: np.ndarray, d: np.ndarray) -> tuple[float, np.ndarray]:
    """The same of the spheres around it: σ falls like the growth of -1/rho, on the way out."""
    links, data = entries["background_links"], entries["background_data"].astype(np.float64)
    q, ahead = (p - entries["center"]) / entries["radius"], d / entries["radius"]
    ahead /= np.linalg.norm(ahead)
    rho = np.linalg.norm(q)
    if rho < 1:
        return 0.0, np.zeros(3)
    q, (wide, high), layers = q / rho, links.shape, data.shape[1]
    at = np.array(
        [
            wide * (0.5 + np.arctan2(q[0], q[2]) / (2 * np.pi)), high * (0.5 - np.arcsin(q[1]) / np.pi),
            np.clip((1 - 1 / rho) * layers - 0.5, 0, layers - 1),
        ]
    )  # fmt: skip
    low = np.minimum(at.astype(int), [wide - 1, high - 1, layers - 2])
    total = np.zeros(4)
    for corner in itertools.product((0, 1), repeat=3):
        i, j, k = low + corner
        if links[i % wide, j % high] >= 0:
            weight = np.where(corner, at - low, 1 - (at - low)).prod()
            total += weight * data[links[i % wide, j % high], k]
    sigma = max(total[3], 0) * max(q @ ahead, 0) / rho**2
    return sigma, np.maximum(0.28209479177387814 * total[:3] + 0.5, 0)


def asked(entries: dict, count: int, reach: float) -> tuple[np.ndarray, np.ndarray]:
    """Points around the box, some on its outer voxels, and directions."""
    rng = np.random.default_rng(3)
    radius, center = entries.get("radius", np.ones(3)), entries.get("center", np.zeros(3))
    points = center + radius * rng.uniform(-1.05, 1.05, (count, 3))
    points[: count // 3] = center + radius * reach ** rng.uniform(0, 1, (count // 3, 1)) * unit(
        rng, count // 3
    )
    return points, unit(rng, count)


def unit(rng, count: int) -> np.ndarray:
    made = rng.normal(size=(count, 3))
    return made / np.linalg.norm(made, axis=1, keepdims=True)


def answers(node, points: np.ndarray, dirs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """σ per world length and colours of a placed field, by its reference."""
    back = np.linalg.inv(node.object_to_world)
    ahead = dirs @ back[:3, :3].T
    stretch = np.linalg.norm(ahead, axis=1)
    at = torch.from_numpy(points @ back[:3, :3].T + back[:3, 3])
    ahead = torch.from_numpy(ahead / stretch[:, None])
    sigma, rgb = node.field.answers(node.field.params.double(), at, ahead)
    return sigma.numpy() * stretch, rgb.numpy()


def agree(found, wanted) -> None:
    np.testing.assert_allclose(found[0], wanted[0], rtol=1e-4, atol=1e-5)
    seen = wanted[0] > 1e-4
    assert seen.sum() > 20
    np.testing.assert_allclose(found[1][seen], wanted[1][seen], atol=1e-4)


def of_all(formula, entries: dict, points: np.ndarray, dirs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    sigma, rgb = zip(*(formula(entries, p, d) for p, d in zip(points, dirs, strict=True)), strict=True)
    return np.array(sigma), np.array(rgb)


# -- what is taken over --------------------------------------------------------------------------------------


@pytest.mark.parametrize("saved", SAVED.values(), ids=SAVED)
def test_a_grid_answers_as_its_file(saved, tmp_path):
    entries = entries_of(saved)
    imported = svox2.read(write(tmp_path / "a.npz", entries))
    points, dirs = asked(entries, 300, 1.2)
    wanted = of_all(inside_of, entries, points, dirs)
    found = answers(imported.nodes[0], points, dirs)
    agree(found, wanted)
    assert (found[0][wanted[0] == 0] == 0).all() and (wanted[0] == 0).sum() > 20


@pytest.mark.parametrize("name", ["background", "a flattened background"])
def test_a_background_answers_as_its_file(name, tmp_path):
    """Also where radii differ: σ is times the length of a radius along the ray, which the placement leaves
    out."""
    entries = entries_of(SAVED[name])
    imported = svox2.read(write(tmp_path / "a.npz", entries))
    assert imported.rule == "add"
    points, dirs = asked(entries, 450, 100.0)
    wanted = of_all(around_of, entries, points, dirs)
    found = answers(imported.nodes[1], points, dirs)
    agree(found, wanted)
    assert (found[0][wanted[0] == 0] == 0).all() and (wanted[0] == 0).sum() > 20


def test_a_field_comes_back_from_its_file_as_it_was(tmp_path):
    for saved in ("texture", "a flattened background"):
        imported = svox2.read(write(tmp_path / "a.npz", entries_of(SAVED[saved])))
        for node in imported.nodes:
            arrays, metadata = node.field.state()
            assert [arrays[name].dtype for name in arrays if "columns" in name or "blocks" in name][
                0
            ] == np.int32
            back = type(node.field).from_state(arrays, metadata)
            assert torch.equal(back.params, node.field.params)


def test_a_texture_of_before_types_were_stored_is_one(tmp_path):
    entries = entries_of(SAVED["texture"])
    del entries["basis_type"]
    points, dirs = asked(entries, 100, 1.2)
    found = answers(svox2.read(write(tmp_path / "a.npz", entries)).nodes[0], points, dirs)
    agree(found, of_all(inside_of, entries, points, dirs))


def test_of_more_rows_than_are_read_those_that_show_nothing_are_left_out(tmp_path, monkeypatch):
    entries = entries_of(SAVED["harmonics"])
    empty = entries["links"][:2], entries["links"][2:, :, 5:]
    for links in empty:
        entries["density_data"][links[links >= 0]] *= -np.sign(entries["density_data"][links[links >= 0]])
    checkpoint, count = write(tmp_path / "a.npz", entries), len(entries["density_data"])
    monkeypatch.setattr(svox2, "MAX_ROWS", count - 20)
    (node,) = svox2.read(checkpoint).nodes
    assert node.field.shape.density["rows"] < count - 20
    points, dirs = asked(entries, 300, 1.2)
    agree(answers(node, points, dirs), of_all(inside_of, entries, points, dirs))
    monkeypatch.setattr(svox2, "MAX_ROWS", 50)
    with pytest.raises(LimitExceeded, match="more than 50 are not read"):
        svox2.read(checkpoint)
    entries["density_data"] = -abs(entries["density_data"])
    (node,) = svox2.read(write(tmp_path / "a.npz", entries)).nodes
    assert not node.field.occupancy.occupied.any()


def test_a_forward_facing_scene_is_said_to_lie_in_ndc(tmp_path):
    (tmp_path / "args.json").write_text('{"dataset_type": "llff", "near_clip": 0.0}')
    imported = svox2.read(write(tmp_path / "ckpt.npz", entries_of(SAVED["harmonics"])))
    assert "NDC" in imported.notes[0]
    box = {"radius": np.array([1.4, 1.1, 1.0], np.float32), "center": np.zeros(3, np.float32)}
    for said, in_ndc in (("auto", True), ("nsvf", False)):  # by its box, unless the run says otherwise
        (tmp_path / "args.json").write_text(f'{{"dataset_type": "{said}"}}')
        imported = svox2.read(write(tmp_path / "ckpt.npz", entries_of(SAVED["harmonics"]) | box))
        assert (imported.notes == [svox2.NDC]) == in_ndc


def blender(folder):
    """A capture of one photo, as NeRF's synthetic scenes lie."""
    (folder / "train").mkdir(parents=True)
    write_png(folder / "train/r_0.png", np.zeros((8, 8, 4), np.uint8))
    frame = {"file_path": "./train/r_0", "transform_matrix": np.eye(4).tolist()}
    (folder / "transforms_train.json").write_text(json.dumps({"camera_angle_x": 0.7, "frames": [frame]}))
    return read_capture(folder)


@pytest.mark.parametrize(
    "args, given, scale",
    [
        (None, True, 2 / 3),
        ({"dataset_type": "nerf", "scene_scale": None}, False, 2 / 3),
        ({"dataset_type": "auto", "scene_scale": 0.5}, True, 0.5),
        ({"dataset_type": "auto", "scene_scale": 0.5}, False, 1),  # which could be of another loader
        ({"dataset_type": "nsvf", "scene_scale": 0.5}, True, 1),
        (None, False, 1),
    ],
)
@pytest.mark.parametrize("name", ["harmonics", "background"])
def test_a_field_is_as_large_as_the_capture_it_was_learnt_from(name, args, given, scale, tmp_path):
    """svox2's Blender loader multiplies camera positions by its scene_scale, 2/3 unless told otherwise."""
    entries = entries_of(SAVED[name])
    if args is not None:
        (tmp_path / "args.json").write_text(json.dumps(args))
    capture = blender(tmp_path / "lego") if given else None
    imported = svox2.read(write(tmp_path / "a.npz", entries), capture)
    for formula, node in zip((inside_of, around_of), imported.nodes, strict=False):
        points, dirs = asked(entries, 200, 1.2 if formula is inside_of else 3.0)
        sigma, rgb = of_all(formula, entries, points, dirs)
        agree(answers(node, points / scale, dirs), (sigma * scale, rgb))
    (note,) = imported.notes
    assert ("scaled back" in note) == (scale != 1) and ("--cameras" in note) == (scale == 1 and not given)


def test_nothing_dense_is_an_empty_field(tmp_path):
    entries = entries_of(SAVED["harmonics"])
    entries["density_data"] = -abs(entries["density_data"])
    (node,) = svox2.read(write(tmp_path / "a.npz", entries)).nodes
    assert not node.field.occupancy.occupied.any()
    type(node.field).from_state(*node.field.state())


def test_a_background_of_which_nothing_is_held_is_none(tmp_path):
    entries = entries_of(SAVED["background"])
    entries["background_links"][:] = -1
    entries["background_data"] = entries["background_data"][:0]
    assert len(svox2.read(write(tmp_path / "a.npz", entries)).nodes) == 1


@pytest.mark.slow
def test_the_command_and_the_scene_that_it_writes(tmp_path):
    """Grid and background add up, as compiled loops answer."""
    entries = entries_of(SAVED["background"])
    write(tmp_path / "park.npz", entries)
    result = CliRunner().invoke(cli, ["import", str(tmp_path / "park.npz"), "-o", str(tmp_path / "a.rfpack")])
    assert result.exit_code == 0, result.output
    points, dirs = asked(entries, 300, 30.0)
    (inner, inside), (outer, around) = (
        of_all(formula, entries, points, dirs) for formula in (inside_of, around_of)
    )
    sigma = inner + outer
    rgb = (inner[:, None] * inside + outer[:, None] * around) / np.maximum(sigma, 1e-9)[:, None]
    found = open_scene(tmp_path / "a.rfpack").query(torch.from_numpy(points), torch.from_numpy(dirs))
    agree([answer.detach().numpy() for answer in found], (sigma, rgb))


# -- what is not ---------------------------------------------------------------------------------------------


REFUSED = {
    "a link to no row": ("background", "links", np.full(COUNTS, 1000, np.int32), "more than the last link"),
    "links on no grid": ("harmonics", "links", np.zeros((4, 4), np.int32), "whole numbers on a grid"),
    "a flat box": ("harmonics", "radius", np.float32([1, 0, 1]), "above 0"),
    "two radii": ("harmonics", "radius", np.ones(2, np.float32), "three numbers, found 2"),
    "an unknown basis": ("harmonics", "basis_type", np.int64(3), "1, 4 or 255, found 3"),
    "no harmonics": ("harmonics", "basis_type", np.int64(4), "'basis_data' is missing"),
    "no cube": ("texture", "basis_data", np.zeros((4, 4, 3, 5), np.float32), "should be a cube"),
    "no network": ("network", "pt__basis_mlp__2__weight", np.zeros((12, 9), np.float32), "read 12 numbers"),
    "a column of no row": ("background", "background_links", np.full((4, 2), 99, np.int32), "last link"),
    "no layers": ("background", "background_data", np.zeros((50, 0, 4), np.float32), "up to 1024 layers"),
    "five numbers": ("background", "background_data", np.zeros((50, 2, 5), np.float32), "shape"),
    "NaN": ("harmonics", "density_data", np.full((500, 1), np.nan, np.float32), "NaN"),
}


@pytest.mark.parametrize("saved, name, value, said", REFUSED.values(), ids=REFUSED)
def test_what_a_file_may_not_say_is_named(saved, name, value, said, tmp_path):
    checkpoint = write(tmp_path / "a.npz", entries_of(SAVED[saved]) | {name: value})
    with pytest.raises(FormatError, match=said):
        svox2.read(checkpoint)


def test_a_grid_that_is_too_large_is_refused_before_it_is_read(tmp_path):
    checkpoint = write(tmp_path / "a.npz", entries_of(SAVED["harmonics"]))
    shape = (1 << 11, 1 << 11, 1 << 11)
    checkpoint.entries["links"] = StoredTensor(shape, "int32", 1 << 33, lambda: pytest.fail("it was read"))
    with pytest.raises(LimitExceeded, match="not read"):
        svox2.read(checkpoint)


@pytest.mark.parametrize("name, value", [("density_blocks", 99), ("density_vertices", 5000)])
def test_a_stored_table_that_leads_nowhere_is_refused(name, value, tmp_path):
    (node,) = svox2.read(write(tmp_path / "a.npz", entries_of(SAVED["harmonics"]))).nodes
    arrays, metadata = node.field.state()
    arrays[name].reshape(-1)[0] = value
    with pytest.raises(ValueError, match=f"'{name[8:]}' should be whole numbers from -1"):
        type(node.field).from_state(arrays, metadata)
