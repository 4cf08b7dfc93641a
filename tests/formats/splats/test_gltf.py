"""Splats of glTF: every type of accessor, nodes that turn and stretch them, SPZ, drafts."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from formats.errors import BadMesh, BadSplats, LimitExceeded
from formats.splats.harmonics import basis
from formats.splats.placing import placed
from formats.splats.reading import is_splats, read_splats
from tests.formats.gltf import CORNERS, FACES
from tests.formats.splats.test_formats import EXACT, SPZ, check
from tests.formats.splats.writers import content, gltf, gltf_of_spz

TURN = Rotation.from_rotvec([0.4, -1.0, 0.7])
SPLATTING = "KHR_gaussian_splatting"


def read(tmp_path, made, name: str = "a.glb"):
    """In glTF's axes."""
    path = made.write(tmp_path / name)
    assert is_splats(path)
    return placed(read_splats(path), np.diag([-1, -1, 1, 1]))


def covariances(splats) -> np.ndarray:
    axes = Rotation.from_quat(np.roll(splats.rotations, -1, axis=1)).as_matrix() * splats.scales[:, None]
    return axes @ axes.transpose(0, 2, 1)


def colours(splats, directions: np.ndarray) -> np.ndarray:
    """(N, D, 3) before they are clipped."""
    values = basis(directions)[:, : splats.harmonics.shape[1]]
    return np.einsum("dk,nkc->ndc", values, np.asarray(splats.harmonics, float))


def directions() -> np.ndarray:
    rows = np.random.default_rng(5).normal(size=(20, 3))
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


def matrix(linear: np.ndarray, move=(1.0, -2.0, 3.0)) -> list[float]:
    """Of a node, by columns."""
    full = np.eye(4)
    full[:3, :3], full[:3, 3] = linear, move
    return full.T.reshape(-1).tolist()


@pytest.mark.parametrize("name", ["a.glb", "a.gltf"])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_degrees_and_containers(degree, name, tmp_path):
    expected = content(5, degree)
    check(read(tmp_path, gltf(expected), name), expected, EXACT)


@pytest.mark.parametrize(
    ("attribute", "kind", "normalised"),
    [
        ("ROTATION", "int8", True),
        ("ROTATION", "int16", True),
        ("SCALE", "int8", False),
        ("SCALE", "int8", True),
        ("SCALE", "int16", False),
        ("SCALE", "int16", True),
        ("OPACITY", "uint8", True),
        ("OPACITY", "uint16", True),
    ],
)
def test_every_type_of_attribute(attribute, kind, normalised, tmp_path):
    expected = content(4, 0)
    if attribute == "SCALE":
        expected.scales = expected.scales if normalised else np.arange(12).reshape(4, 3) + 1.0
    made, largest = gltf(expected), np.iinfo(kind).max
    values = {
        "ROTATION": np.roll(expected.rotations, -1, 1),
        "SCALE": expected.scales,
        "OPACITY": expected.opacities,
    }[attribute]
    stored = np.round(values * (largest if normalised else 1)).astype(kind)
    made.primitive["attributes"][f"{SPLATTING}:{attribute}"] = made.accessor(stored, normalized=normalised)
    step = 1 / largest
    bounds = EXACT | {"rotations": 2 * step, "opacities": step, "scales": 1e-6}
    if attribute == "SCALE" and normalised:
        bounds["scales"] = step / expected.scales.min()
    check(read(tmp_path, made), expected, bounds)


@pytest.mark.parametrize("mirror", [1, -1])
def test_turned_moved_scaled_and_mirrored_splats(mirror, tmp_path):
    """x -> M x + t: covariances M Σ Mᵀ, and a splat shows along M d what it showed along d."""
    before = content(6, 3)
    linear = 1.7 * TURN.as_matrix() * [1, 1, mirror]
    splats = read(tmp_path, gltf(before, matrix=matrix(linear)))
    np.testing.assert_allclose(splats.centres, before.centres @ linear.T + [1, -2, 3], atol=1e-5)
    np.testing.assert_allclose(covariances(splats), linear @ covariances(before) @ linear.T, atol=1e-5)
    np.testing.assert_allclose(splats.scales, 1.7 * before.scales, rtol=1e-5)  # axes keep their order
    seen = colours(splats, directions() @ (linear / 1.7).T)
    np.testing.assert_allclose(seen, colours(before, directions()), atol=1e-5)
    assert splats.notes == ()


def test_nodes_within_nodes_by_parts_of_placements(tmp_path):
    before = content(6, 1)
    made = gltf(before, rotation=TURN.as_quat().tolist(), scale=[2, 2, 2])
    made.doc["nodes"] = [{"children": [1], "translation": [5, 0, 0]}, *made.doc["nodes"]]
    splats = read(tmp_path, made)
    np.testing.assert_allclose(splats.centres, 2 * TURN.apply(before.centres) + [5, 0, 0], atol=1e-5)


def test_stretched_and_sheared_splats(tmp_path):
    """Exact but for the colours, which turn as by the nearest rotation."""
    before = content(6, 2)
    linear = np.array([[1.0, 0.6, 0], [0, 3, 0.2], [0, 0, -0.5]])
    splats = read(tmp_path, gltf(before, matrix=matrix(linear)))
    expected = linear @ covariances(before) @ linear.T
    np.testing.assert_allclose(covariances(splats), expected, atol=1e-5 * np.abs(expected).max())
    assert "nearest rotation" in splats.notes[0]


def test_a_node_that_flattens_leaves_discs(tmp_path):
    splats = read(tmp_path, gltf(content(3, 0), scale=[1, 0, 1], rotation=TURN.as_quat().tolist()))
    assert len(splats) == 3 and (splats.scales > 0).all() and np.isfinite(splats.rotations).all()


def test_instances_and_meshes_that_are_used_twice(tmp_path):
    made = gltf(content(2, 0))
    moves = made.accessor(np.array([[0, 0, 0], [0, 0, 9]], np.float32))
    instancing = {"EXT_mesh_gpu_instancing": {"attributes": {"TRANSLATION": moves}}}
    made.doc["nodes"] += [{"mesh": 0, "extensions": instancing}]
    made.doc["scenes"] = [{"nodes": [0, 1]}]
    splats = read(tmp_path, made)
    assert len(splats) == 6
    np.testing.assert_allclose(splats.centres[4:], splats.centres[:2] + [0, 0, 9], atol=1e-5)


def test_primitives_of_several_degrees(tmp_path):
    made, more = gltf(content(2, 0)), gltf(content(3, 2, seed=1))
    made.doc["bufferViews"] += [
        view | {"byteOffset": view["byteOffset"] + len(made.blob)} for view in more.doc["bufferViews"]
    ]
    views, accessors = len(made.doc["bufferViews"]) - len(more.doc["bufferViews"]), len(made.doc["accessors"])
    made.doc["accessors"] += [a | {"bufferView": a["bufferView"] + views} for a in more.doc["accessors"]]
    made.blob += more.blob
    shifted = {name: index + accessors for name, index in more.primitive["attributes"].items()}
    made.doc["meshes"][0]["primitives"].append(more.primitive | {"attributes": shifted})
    splats = read(tmp_path, made)
    assert splats.harmonics.shape == (5, 9, 3) and not splats.harmonics[:2, 1:].any()
    np.testing.assert_allclose(splats.harmonics[2:], content(3, 2, seed=1).harmonics, atol=1e-6)


@pytest.mark.parametrize("name", [f"{SPLATTING}_compression_spz_2", f"{SPLATTING}_compression_spz"])
def test_spz_has_the_axes_of_its_primitive(name, tmp_path):
    expected = content(5, 3)
    splats = read(tmp_path, gltf_of_spz(expected, name))
    check(splats, expected, SPZ)
    assert "as CesiumJS does" in splats.notes[0]


def test_spz_of_the_first_draft_lies_beside(tmp_path):
    made = gltf_of_spz(content(5, 1))
    packed = made.primitive["extensions"][SPLATTING]["extensions"].popitem()[1]
    made.primitive["extensions"] = {"KHR_spz_gaussian_splats_compression": packed}
    made.doc["extensionsRequired"] = ["KHR_spz_gaussian_splats_compression"]
    check(read(tmp_path, made), content(5, 1), SPZ)


def test_scales_of_drafts_are_logarithms(tmp_path):
    expected = content(5, 0)
    made = gltf(expected)
    made.primitive["attributes"][f"{SPLATTING}:SCALE"] = made.accessor(np.log(expected.scales).astype("f4"))
    splats = read(tmp_path, made)
    check(splats, expected, EXACT)
    assert "scales are logarithms" in splats.notes[0]


def test_one_colour_for_each_splat_as_the_first_draft_had_it(tmp_path):
    expected = content(5, 0)
    made = gltf(expected)
    attributes = made.primitive["attributes"]
    for name in ("ROTATION", "SCALE"):
        attributes[f"_{name}"] = attributes.pop(f"{SPLATTING}:{name}")
    for name in ("OPACITY", "SH_DEGREE_0_COEF_0"):
        del attributes[f"{SPLATTING}:{name}"]
    colours = 0.5 + 0.28209479177387814 * expected.harmonics[:, 0]
    rgba = np.concatenate([colours, expected.opacities[:, None]], 1)
    attributes["COLOR_0"] = made.accessor(rgba.astype(np.float32))
    splats = read(tmp_path, made)
    check(splats, expected, EXACT)
    assert "one colour for each splat" in splats.notes[0]


def test_what_is_not_honoured_is_told(tmp_path):
    made = gltf(content(5, 0))
    made.primitive["extensions"][SPLATTING] |= {"colorSpace": "lin_rec709_display", "kernel": "box"}
    attributes = {"POSITION": made.accessor(CORNERS)}
    made.doc["meshes"][0]["primitives"].append({"attributes": attributes, "indices": made.accessor(FACES)})
    made.doc["extensionsUsed"].append("EXT_strange")
    notes = "\n".join(read(tmp_path, made).notes)
    for part in ("linear colours", "kernel 'box'", "1 primitive without splats", "EXT_strange"):
        assert part in notes


@pytest.mark.parametrize(
    "attribute", ["SCALE", "ROTATION", "OPACITY", "SH_DEGREE_0_COEF_0", "SH_DEGREE_1_COEF_1"]
)
def test_missing_attributes(attribute, tmp_path):
    made = gltf(content(5, 1))
    del made.primitive["attributes"][f"{SPLATTING}:{attribute}"]
    with pytest.raises(BadSplats, match=f"lack {SPLATTING}:{attribute}"):
        read(tmp_path, made)


def test_attributes_of_other_lengths(tmp_path):
    made = gltf(content(5, 1))
    made.primitive["attributes"][f"{SPLATTING}:OPACITY"] = made.accessor(np.ones(4, np.float32))
    with pytest.raises(BadSplats, match="differ in their number"):
        read(tmp_path, made)


def test_required_extensions_that_are_not_known(tmp_path):
    made = gltf(content(5, 1))
    made.doc["extensionsRequired"] = ["EXT_strange"]
    with pytest.raises(BadMesh, match="EXT_strange"):
        read(tmp_path, made)


@pytest.mark.parametrize(("count", "sentence"), [(1, "more than 1,000 times"), (3000, "at most")])
def test_instances_cost_no_bytes_and_are_bounded(count, sentence, tmp_path):
    made = gltf(content(count, 0))
    moves = made.accessor(np.zeros((900, 3), np.float32))
    instancing = {"EXT_mesh_gpu_instancing": {"attributes": {"TRANSLATION": moves}}}
    made.doc["nodes"] = [{"mesh": 0, "extensions": instancing} for _ in range(2)]
    made.doc["scenes"] = [{"nodes": [0, 1]}]
    with pytest.raises(LimitExceeded, match=sentence):
        read(tmp_path, made)


@pytest.mark.parametrize("entry", [1e300, 1e20])
def test_placements_beyond_any_measure(entry, tmp_path):
    with pytest.raises(BadSplats, match="beyond any measure"):
        read(tmp_path, gltf(content(2, 1), scale=[entry] * 3))
