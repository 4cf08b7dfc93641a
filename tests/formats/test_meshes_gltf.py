"""glTF as its specification says: a square whose every pixel is known, written in each of many ways."""

import base64
import io
import json
import math
import sys
from urllib.parse import quote

import numpy as np
import pytest
from PIL import Image

from formats.errors import BadMesh, FormatError, LimitExceeded, MissingExtra, MissingFile
from formats.meshes import _load, mesh_capture
from tests.formats.gltf import CORNERS, FACES, UV, Gltf, front, notes_of

SIDE = 8


def png(pixels: np.ndarray) -> bytes:
    file = io.BytesIO()
    Image.fromarray(pixels.astype(np.uint8)).save(file, "PNG")
    return file.getvalue()


def noise(side: int = SIDE, channels: int = 3) -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (side, side, channels), dtype=np.uint8)


def shows(path, pixels: np.ndarray, off: int = 1) -> bool:
    """Is the square this picture? One ray goes through the middle of each texel."""
    return bool(np.abs(front(path, len(pixels))[..., :3].astype(int) - pixels[..., :3]).max() <= off)


def encoded(linear: float) -> int:
    return round(255 * (12.92 * linear if linear <= 0.0031308 else 1.055 * linear ** (1 / 2.4) - 0.055))


def textured(**more) -> Gltf:
    gltf = Gltf()
    gltf.material(png(noise()), **more)
    return gltf


def test_without_material_white(tmp_path):
    picture = front(Gltf().write(tmp_path / "a.glb"))
    assert (picture == 255).all()


def test_texture_stands_upright(tmp_path):
    assert shows(textured().write(tmp_path / "a.glb"), noise())


@pytest.mark.parametrize("kind", ["uint8", "uint16"])
def test_normalised_coordinates(tmp_path, kind):
    gltf = textured()
    most = np.iinfo(kind).max
    padded = np.zeros((4, 4 if kind == "uint8" else 2), kind)
    padded[:, :2] = UV * most
    view = gltf.view(padded.tobytes(), byteStride=padded.strides[0])
    entry = {"bufferView": view, "componentType": {"uint8": 5121, "uint16": 5123}[kind], "normalized": True}
    gltf.primitive["attributes"]["TEXCOORD_0"] = gltf.list("accessors", entry | {"count": 4, "type": "VEC2"})
    assert shows(gltf.write(tmp_path / "a.glb"), noise())


@pytest.mark.parametrize("kind", ["int8", "int16"])
def test_quantised_positions(tmp_path, kind):
    gltf, most = textured(), np.iinfo(kind).max
    gltf.attribute("POSITION", np.column_stack([CORNERS, np.zeros(4)]).astype(kind) * most)
    gltf.doc["accessors"][-1] |= {"type": "VEC3", "normalized": True}
    view = gltf.doc["accessors"][-1]["bufferView"]
    gltf.doc["bufferViews"][view]["byteStride"] = 4 * np.dtype(kind).itemsize
    gltf.doc["extensionsUsed"] = gltf.doc["extensionsRequired"] = ["KHR_mesh_quantization"]
    assert shows(gltf.write(tmp_path / "a.glb"), noise())


def test_sparse_accessors_with_and_without_a_base(tmp_path):
    """Corner 2 is moved from wherever it was; without a base all the others are zeros."""
    for base in (True, False):
        gltf = Gltf()
        wrong = CORNERS.copy()
        wrong[2] = 9
        entry = gltf.doc["accessors"][gltf.accessor(wrong)]
        places = [2] if base else [0, 1, 2, 3]
        indices = gltf.view(np.array(places, np.uint8).tobytes())
        values = gltf.view(CORNERS[places].tobytes())
        entry["sparse"] = {
            "count": len(places),
            "indices": {"bufferView": indices, "componentType": 5121},
            "values": {"bufferView": values},
        }
        if not base:
            del entry["bufferView"]
        gltf.primitive["attributes"]["POSITION"] = len(gltf.doc["accessors"]) - 1
        assert (front(gltf.write(tmp_path / "a.glb")) == 255).all()


@pytest.mark.parametrize(
    "mode, indices", [(4, None), (5, [0, 1, 3, 2]), (6, [0, 1, 2, 3]), (4, [0, 1, 2, 0, 2, 3, 1])]
)
def test_lists_strips_and_fans(tmp_path, mode, indices):
    gltf = Gltf()
    gltf.primitive["mode"] = mode
    if indices is None:
        gltf.attribute("POSITION", CORNERS[FACES])
        del gltf.primitive["indices"]
    else:
        gltf.primitive["indices"] = gltf.accessor(np.array(indices, np.uint32))
    path = gltf.write(tmp_path / "a.glb")
    assert (front(path) == 255).all()
    # All faces look to the same side: from behind, and only from there, they show their backs.
    points, faces = _load(path).triangles
    a, b, c = points[faces].astype(float).transpose(1, 0, 2)
    assert len({tuple(np.sign(n).round()) for n in np.cross(b - a, c - a)}) == 1


def test_points_and_lines_are_told(tmp_path):
    gltf = Gltf()
    gltf.doc["meshes"][0]["primitives"] += [{**gltf.primitive, "mode": 0}, {**gltf.primitive, "mode": 3}]
    assert "2 primitives of points or lines are left out" in notes_of(gltf.write(tmp_path / "a.glb"))


# --- materials ----------------------------------------------------------------------------------------------


def test_factor_times_texture_times_vertex_colour_in_linear_light(tmp_path):
    gltf = Gltf()
    gltf.material(png(np.full((2, 2, 3), 188)), pbrMetallicRoughness={"baseColorFactor": [1, 0.5, 0.25, 1]})
    gltf.attribute("COLOR_0", np.tile(np.float32([0.5, 0.5, 1, 1]), (4, 1)))
    seen = front(gltf.write(tmp_path / "a.glb"))[16, 16]
    texel = ((188 / 255 + 0.055) / 1.055) ** 2.4
    expected = [encoded(texel * part) for part in (0.5, 0.25, 0.25)]
    assert np.abs(seen[:3].astype(int) - expected).max() <= 1


@pytest.mark.parametrize("kind", ["uint8", "uint16", "float32"])
@pytest.mark.parametrize("width", [3, 4])
@pytest.mark.parametrize("material", [True, False])
def test_vertex_colours_of_every_type(tmp_path, kind, width, material):
    gltf = Gltf()
    most = 1 if kind == "float32" else np.iinfo(kind).max
    rgba = np.tile(np.array([0.2, 0.6, 1.0, 1.0])[:width] * most, (4, 1)).astype(kind)
    padded = np.zeros((4, 4), kind)
    padded[:, :width] = rgba
    view = gltf.view(padded.tobytes(), byteStride=padded.strides[0])
    code = {"uint8": 5121, "uint16": 5123, "float32": 5126}[kind]
    entry = {"bufferView": view, "componentType": code, "count": 4, "type": f"VEC{width}"}
    if kind != "float32":
        entry["normalized"] = True
    gltf.primitive["attributes"]["COLOR_0"] = gltf.list("accessors", entry)
    if material:
        gltf.material()
    seen = front(gltf.write(tmp_path / "a.glb"))[16, 16, :3].astype(int)
    assert np.abs(seen - [encoded(0.2), encoded(0.6), 255]).max() <= 1


def test_texture_transform_and_own_coordinates(tmp_path):
    """Base colour by set 1 and a quarter turn about the corner: u' = v, v' = 1 - u."""
    gltf = textured()
    gltf.attribute("TEXCOORD_1", UV)
    gltf.attribute("TEXCOORD_0", UV * 0)
    info = gltf.doc["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"]
    turn = {"rotation": math.pi / 2, "offset": [0, 1], "texCoord": 1}
    info["extensions"] = {"KHR_texture_transform": turn}
    gltf.doc["extensionsUsed"] = ["KHR_texture_transform"]
    # At (u, v) the square shows the picture at (v, 1 - u): its lower left corner is above on the left.
    assert shows(gltf.write(tmp_path / "a.glb"), np.rot90(noise(), -1))


WRAPS = {"repeat": (10497, lambda i: i % SIDE), "clamp": (33071, lambda i: np.clip(i, 0, SIDE - 1)),
         "mirror": (33648, lambda i: np.minimum(i % (2 * SIDE), 2 * SIDE - 1 - i % (2 * SIDE)))}  # fmt: skip


@pytest.mark.parametrize("name", WRAPS)
def test_wrap_modes(tmp_path, name):
    """Coordinates from -1 to 2: three pictures a side."""
    mode, index = WRAPS[name]
    gltf = textured(sampler={"wrapS": mode, "wrapT": mode})
    gltf.attribute("TEXCOORD_0", UV * 3 - 1)
    which = index(np.arange(-SIDE, 2 * SIDE))
    seen = front(gltf.write(tmp_path / "a.glb"), 3 * SIDE)
    assert np.abs(seen[..., :3].astype(int) - noise()[which][:, which]).max() <= 1


def test_nearest_filter_shows_squares(tmp_path):
    path = textured(sampler={"magFilter": 9728}).write(tmp_path / "a.glb")
    seen = front(path, size=8 * SIDE)
    assert (seen[..., :3] == noise().repeat(8, 0).repeat(8, 1)).all()


def test_emission_is_added_and_told(tmp_path):
    """A scan exported shadeless, with a black base, shows its picture; strength counts."""
    gltf = Gltf()
    material = gltf.material(png(noise()))
    material["emissiveTexture"] = material["pbrMetallicRoughness"].pop("baseColorTexture")
    material |= {"emissiveFactor": [1, 1, 1]}
    material["pbrMetallicRoughness"] = {"baseColorFactor": [0, 0, 0, 1]}
    path = gltf.write(tmp_path / "a.glb")
    assert shows(path, noise()) and "glows" in notes_of(path)
    material["extensions"] = {"KHR_materials_emissive_strength": {"emissiveStrength": 0}}
    assert (front(gltf.write(tmp_path / "a.glb"))[..., :3] == 0).all()


def test_specular_glossiness_shows_its_diffuse_colour(tmp_path):
    gltf = textured()
    glossy = {"diffuseFactor": [0, 1, 0, 1]}
    gltf.doc["materials"][0]["extensions"] = {"KHR_materials_pbrSpecularGlossiness": glossy}
    path = gltf.write(tmp_path / "a.glb")
    assert (front(path)[..., :3] == [0, 255, 0]).all() and "image 0" in notes_of(path)


# --- alpha --------------------------------------------------------------------------------------------------


def half_seen() -> np.ndarray:
    """Green, alpha 100 in the left half, 200 in the right."""
    picture = np.zeros((2, 2, 4), np.uint8)
    picture[...] = (0, 255, 0, 100)
    picture[:, 1, 3] = 200
    return picture


def two_squares(mode: str, **material) -> Gltf:
    """The green one in front of a blue one, half a unit behind."""
    gltf = Gltf()
    gltf.material(png(half_seen()), sampler={"magFilter": 9728}, alphaMode=mode, **material)
    gltf.list("materials", {"pbrMetallicRoughness": {"baseColorFactor": [0, 0, 1, 1]}})
    gltf.list("meshes", {"primitives": [{**gltf.primitive, "material": 1}]})
    gltf.list("nodes", {"mesh": 1, "translation": [0, 0, -0.5]})
    gltf.doc["scenes"][0]["nodes"] = [0, 1]
    return gltf


def test_a_ray_goes_on_behind_what_is_cut_out(tmp_path):
    for cutoff, left in ((0.5, [0, 0, 255]), (0.3, [0, 255, 0])):
        seen = front(two_squares("MASK", alphaCutoff=cutoff).write(tmp_path / "a.glb"))
        assert (seen[8, 8] == [*left, 255]).all() and (seen[8, 24] == [0, 255, 0, 255]).all()


def test_blending_covers_as_much_as_alpha_says(tmp_path):
    gltf = two_squares("BLEND")
    seen = front(gltf.write(tmp_path / "a.glb"))
    assert np.abs(seen[8, 8].astype(int) - [0, 100, 155, 255]).max() <= 1
    gltf.doc["scenes"][0]["nodes"] = [0]
    seen = front(gltf.write(tmp_path / "a.glb"))
    assert np.abs(seen[8, [8, 24]].astype(int) - [[0, 255, 0, 100], [0, 255, 0, 200]]).max() <= 1
    gltf.doc["materials"][0]["alphaMode"] = "OPAQUE"
    assert (front(gltf.write(tmp_path / "a.glb"))[8, 8] == [0, 255, 0, 255]).all()


def test_many_panes_are_bounded_and_exact(tmp_path):
    """30 panes of alpha 0.1 let 0.9^30 pass."""
    gltf = Gltf()
    gltf.material(alphaMode="BLEND", pbrMetallicRoughness={"baseColorFactor": [1, 1, 1, 0.1]})
    gltf.doc["nodes"] = [{"mesh": 0, "translation": [0, 0, 0.01 * i]} for i in range(30)]
    gltf.doc["scenes"][0]["nodes"] = list(range(30))
    alpha = front(gltf.write(tmp_path / "a.glb"))[16, 16, 3]
    assert alpha == pytest.approx(255 * (1 - 0.9**30), abs=1)


def test_backs_are_shown_and_told(tmp_path):
    gltf = Gltf()
    path = gltf.write(tmp_path / "a.glb")
    assert (front(path, behind=True) == 255).all() and "from both sides" in notes_of(path)
    gltf.material(doubleSided=True)
    assert "from both sides" not in notes_of(gltf.write(tmp_path / "a.glb"))


def test_mirrored_fronts_stay_fronts(tmp_path):
    """A node that mirrors turns the winding, which its determinant undoes."""
    gltf = Gltf()
    gltf.doc["nodes"][0]["scale"] = [-1, 1, 1]
    (surface,) = _load(gltf.write(tmp_path / "a.glb")).surfaces
    points = CORNERS[:, [0, 2, 1]] * [-1, 1, 1]
    a, b, c = (points[surface.faces[:, i]] for i in range(3))
    assert (np.cross(b - a, c - a)[:, 1] < 0).all()  # +z, which is turned to -y


# --- nodes --------------------------------------------------------------------------------------------------


def box(path) -> list[float]:
    """glTF's own x, y, z of the lower and upper corner, without the margin."""
    low, high = _load(path).vertices.min(0), _load(path).vertices.max(0)
    return [low[0], low[2], -high[1], high[0], high[2], -low[1]]


def test_nodes_matrices_and_cameras(tmp_path):
    """A square under a node with a camera, turned by 90 degrees about x and moved: column-major, TRS."""
    gltf = Gltf()
    gltf.doc["cameras"] = [{"type": "perspective", "perspective": {"yfov": 1, "znear": 0.1}}]
    half = math.sqrt(0.5)
    turned = {"rotation": [half, 0, 0, half], "scale": [2, 1, 1], "translation": [5, 0, 0], "children": [1]}
    matrix = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 7, 0, 1]
    gltf.doc["nodes"] = [{"camera": 0} | turned, {"mesh": 0, "matrix": matrix}]
    assert box(gltf.write(tmp_path / "a.glb")) == pytest.approx([3, 0, 6, 7, 0, 8], abs=1e-6)


def test_scenes(tmp_path):
    gltf = Gltf()
    gltf.doc["nodes"] = [{"mesh": 0, "translation": [9, 0, 0]}, {"mesh": 0}]
    gltf.doc["scenes"] = [{"nodes": [0], "name": "store"}, {"nodes": [1]}]
    for chosen, x in ((0, 8), (1, -1)):
        gltf.doc["scene"] = chosen
        path = gltf.write(tmp_path / "a.glb")
        assert box(path)[0] == pytest.approx(x) and "not shown" in notes_of(path)
    gltf.doc["scene"] = 2
    with pytest.raises(BadMesh, match=r"scenes\[2\]"):
        _load(gltf.write(tmp_path / "a.glb"))
    del gltf.doc["scene"], gltf.doc["scenes"]
    assert box(gltf.write(tmp_path / "a.glb"))[::3] == pytest.approx([-1, 10])


@pytest.mark.parametrize("children", [[0], [1, 1]])
def test_nodes_that_are_no_tree(tmp_path, children):
    gltf = Gltf()
    gltf.doc["nodes"] = [{"mesh": 0, "children": children}, {}]
    with pytest.raises(BadMesh, match="node"):
        _load(gltf.write(tmp_path / "a.glb"))


def test_instances(tmp_path):
    gltf = Gltf()
    moved = gltf.accessor(np.float32([[0, 0, 0], [4, 0, 0], [0, 6, 0]]))
    attributes = {"TRANSLATION": moved, "SCALE": gltf.accessor(np.float32([[1, 1, 1], [2, 1, 1], [1, 1, 1]]))}
    gltf.doc["nodes"][0]["extensions"] = {"EXT_mesh_gpu_instancing": {"attributes": attributes}}
    gltf.doc["extensionsRequired"] = ["EXT_mesh_gpu_instancing"]
    path = gltf.write(tmp_path / "a.glb")
    assert len(_load(path).triangles[1]) == 6
    assert box(path) == pytest.approx([-1, -1, 0, 6, 7, 0])


def test_skin_at_rest(tmp_path):
    """Two joints: the right side hangs at one that was moved by 3 since it was bound; the node's own place
    does not count."""
    gltf = Gltf()
    gltf.attribute("JOINTS_0", np.tile(np.uint8([0, 1, 0, 0]), (4, 1)))
    right = (CORNERS[:, 0] > 0).astype(np.float32)
    gltf.attribute("WEIGHTS_0", np.column_stack([1 - right, right, 0 * right, 0 * right]))
    bound = np.tile(np.eye(4, dtype=np.float32), (2, 1, 1))
    bound[1, 3, 0] = -2  # column-major: the joint stood at x = 2
    gltf.doc["skins"] = [{"joints": [1, 2], "inverseBindMatrices": gltf.accessor(bound.reshape(2, 16))}]
    gltf.doc["nodes"] = [
        {"mesh": 0, "skin": 0, "translation": [50, 0, 0]},
        {"children": [2]},
        {"translation": [5, 0, 0]},
    ]
    gltf.doc["scenes"][0]["nodes"] = [0, 1]
    assert box(gltf.write(tmp_path / "a.glb")) == pytest.approx([-1, -1, 0, 4, 1, 0])


def test_morph_weights_of_mesh_and_node(tmp_path):
    gltf = Gltf()
    gltf.primitive["targets"] = [{"POSITION": gltf.accessor(np.tile(np.float32([0, 10, 0]), (4, 1)))}]
    for mesh, node, y in (([], None, 0), ([0.5], None, 5), ([0.5], [0.1], 1)):
        gltf.doc["meshes"][0]["weights"] = mesh
        gltf.doc["nodes"][0] = {"mesh": 0} | ({} if node is None else {"weights": node})
        assert box(gltf.write(tmp_path / "a.glb"))[1] == pytest.approx(y - 1)


# --- files --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["my wood.png", "grün.png", "100%.png", "Wood.PNG", "../textures/wood.png"])
def test_uris(tmp_path, name):
    """Percent-encoded, not encoded, in another case, in a folder beside."""
    (tmp_path / "m").mkdir()
    (tmp_path / "textures").mkdir()
    file = tmp_path / "m" / (name.lower() if name.startswith("Wood") else name)
    file.write_bytes(png(noise()))
    for uri in (quote(name), name):
        gltf = textured()
        gltf.doc["images"] = [{"uri": uri}]
        assert shows(gltf.write(tmp_path / "m/a b.gltf"), noise())


def test_data_uri_and_several_buffers(tmp_path):
    gltf = textured()
    (tmp_path / "more.bin").write_bytes(CORNERS.tobytes())
    gltf.doc["buffers"] = [{"byteLength": 48, "uri": "more.bin"}]
    gltf.doc["accessors"][0]["bufferView"] = gltf.list("bufferViews", {"buffer": 1, "byteLength": 48})
    assert shows(gltf.write(tmp_path / "a.glb"), noise())
    (tmp_path / "more.bin").unlink()
    with pytest.raises(MissingFile, match=r"more\.bin"):
        _load(tmp_path / "a.glb")


def test_lost_and_unused_pictures_are_named(tmp_path):
    gltf = textured()
    gltf.doc["images"] = [{"uri": "lost.png"}, {"uri": "spare.png"}]
    gltf.doc["materials"][0]["normalTexture"] = {"index": 0}
    notes = notes_of(gltf.write(tmp_path / "a.gltf"))
    assert "lost.png" in notes and "spare.png" in notes and "normalTexture" in notes


def test_unused_materials_are_named(tmp_path):
    gltf = textured()
    gltf.list("materials", {"name": "spare"})
    assert "materials that nothing shown has: spare" in notes_of(gltf.write(tmp_path / "a.glb"))


@pytest.mark.parametrize("name", ["nodes", "meshes", "primitives", "root", "required"])
def test_extensions_that_are_not_declared_are_named(tmp_path, name):
    gltf, there = Gltf(), {"KHR_materials_variants": {}}
    places = {"nodes": gltf.doc["nodes"][0], "meshes": gltf.doc["meshes"][0], "primitives": gltf.primitive}
    if name == "required":
        gltf.doc["extensionsRequired"] = list(there)
    else:
        places.get(name, gltf.doc)["extensions"] = there
    assert "KHR_materials_variants" in notes_of(gltf.write(tmp_path / "a.glb"))


def test_reserved_index_is_told(tmp_path):
    gltf = Gltf()
    corners = np.concatenate([np.zeros((252, 3), np.float32), CORNERS])
    gltf.attribute("POSITION", corners)
    gltf.primitive["indices"] = gltf.accessor((FACES + 252).astype(np.uint8))
    path = gltf.write(tmp_path / "a.glb")
    assert (front(path) == 255).all() and "reserves" in notes_of(path)


def test_extensions(tmp_path):
    gltf = Gltf()
    gltf.doc["extensionsUsed"] = ["VENDOR_thing", "KHR_materials_unlit"]
    assert "VENDOR_thing" in notes_of(gltf.write(tmp_path / "a.glb"))
    gltf.doc["extensionsRequired"] = ["VENDOR_thing"]
    with pytest.raises(BadMesh, match="VENDOR_thing"):
        _load(gltf.write(tmp_path / "a.glb"))


@pytest.mark.parametrize(
    "asset", [None, {"version": "1.0"}, {"version": "2.1", "minVersion": "2.1"}, {"version": "3.0"}]
)
def test_other_versions_are_refused(tmp_path, asset):
    gltf = Gltf()
    gltf.doc["asset"] = asset
    if asset is None:
        del gltf.doc["asset"]
    with pytest.raises(BadMesh, match="2.0"):
        _load(gltf.write(tmp_path / "a.glb"))
    gltf.doc["asset"] = {"version": "2.7"}
    assert (front(gltf.write(tmp_path / "a.glb")) == 255).all()


@pytest.mark.parametrize("extension", ["KHR_draco_mesh_compression", "EXT_meshopt_compression"])
def test_broken_compression_is_named(tmp_path, extension):
    pytest.importorskip("DracoPy" if "draco" in extension else "meshopt")
    gltf = Gltf()
    packed = gltf.view(b"\x00" * 64)
    if "draco" in extension:
        gltf.primitive["extensions"] = {extension: {"bufferView": packed, "attributes": {"POSITION": 0}}}
    else:
        view = gltf.doc["bufferViews"][0]
        packed = {"buffer": 0, "byteLength": 64, "byteStride": 12, "count": 4, "mode": "ATTRIBUTES"}
        view["extensions"] = {extension: packed}
    with pytest.raises(BadMesh, match=extension):
        _load(gltf.write(tmp_path / "a.glb"))


@pytest.mark.parametrize("library, extra", [("DracoPy", "draco"), ("meshopt", "meshopt")])
def test_a_missing_library_is_named(tmp_path, monkeypatch, library, extra):
    monkeypatch.setitem(sys.modules, library, None)
    gltf = Gltf()
    if extra == "draco":
        packed = {"bufferView": gltf.view(bytes(64)), "attributes": {"POSITION": 0}}
        gltf.primitive["extensions"] = {"KHR_draco_mesh_compression": packed}
        assert (front(gltf.write(tmp_path / "a.glb")) == 255).all()  # by its plain numbers
        del gltf.doc["accessors"][0]["bufferView"]
    else:
        packed = {"buffer": 0, "byteLength": 64, "byteStride": 12, "count": 4, "mode": "ATTRIBUTES"}
        gltf.doc["bufferViews"][0]["extensions"] = {"EXT_meshopt_compression": packed}
    with pytest.raises(MissingExtra, match=rf"fusedrf\[{extra}\]"):
        _load(gltf.write(tmp_path / "a.glb"))


def test_draco(tmp_path):
    draco = pytest.importorskip("DracoPy")
    gltf = textured()
    data = draco.encode(
        CORNERS, FACES.reshape(-1, 3).astype(np.uint32), tex_coord=UV.astype(float), quantization_bits=14
    )
    decoded = draco.decode(data)
    ids = {entry["attribute_type"]: entry["unique_id"] for entry in decoded.attributes}
    attributes = {"POSITION": ids[0], "TEXCOORD_0": ids[3]}
    gltf.primitive["extensions"] = {
        "KHR_draco_mesh_compression": {"bufferView": gltf.view(data), "attributes": attributes}
    }
    for accessor in gltf.doc["accessors"]:
        del accessor["bufferView"]
    gltf.doc["extensionsRequired"] = ["KHR_draco_mesh_compression"]
    assert shows(gltf.write(tmp_path / "a.glb"), noise(), off=3)


def test_meshopt(tmp_path):
    """Vertices, indices and coordinates packed, in a buffer without bytes of its own."""
    meshopt = pytest.importorskip("meshopt")
    gltf = textured()
    arrays = {"POSITION": CORNERS, "TEXCOORD_0": UV, None: FACES}
    gltf.doc["buffers"] = [{"byteLength": 92}]
    for name, array in arrays.items():
        mode = "TRIANGLES" if name is None else "ATTRIBUTES"
        packed = gltf.view(meshopt.encode_gltf_buffer(array, mode))
        place = {key: gltf.doc["bufferViews"][packed].get(key, 0) for key in ("byteOffset", "byteLength")}
        rest = {"buffer": 0, "byteStride": array.nbytes // len(array), "count": len(array), "mode": mode}
        view = {
            "buffer": 1,
            "byteLength": array.nbytes,
            "extensions": {"EXT_meshopt_compression": place | rest},
        }
        index = gltf.primitive["indices"] if name is None else gltf.primitive["attributes"][name]
        gltf.doc["accessors"][index]["bufferView"] = gltf.list("bufferViews", view)
    gltf.doc["extensionsRequired"] = ["EXT_meshopt_compression"]
    assert shows(gltf.write(tmp_path / "a.glb"), noise())


def test_ktx2_that_cannot_be_read_falls_back(tmp_path):
    gltf = textured()
    ktx = b"\xabKTX 20\xbb\r\n\x1a\n" + bytes(120)
    source = gltf.list("images", {"bufferView": gltf.view(ktx), "mimeType": "image/ktx2"})
    gltf.doc["textures"][0]["extensions"] = {"KHR_texture_basisu": {"source": source}}
    path = gltf.write(tmp_path / "a.glb")
    assert shows(path, noise()) and "KTX2" in notes_of(path)


# --- hostile ------------------------------------------------------------------------------------------------


def test_counts_are_held_against_bytes(tmp_path):
    for count, bytes_behind in ((6_000_000, False), (2**40, True), (5, True)):
        gltf = Gltf()
        gltf.doc["accessors"][0]["count"] = count
        if not bytes_behind:
            del gltf.doc["accessors"][0]["bufferView"]
        with pytest.raises((BadMesh, LimitExceeded), match="accessor 0"):
            _load(gltf.write(tmp_path / "a.glb"))


def test_instances_of_a_small_file_are_bounded(tmp_path):
    gltf = Gltf()
    gltf.primitive["indices"] = gltf.accessor(np.tile(FACES, 2000))
    gltf.doc["nodes"] = [{"mesh": 0}] * 2000
    gltf.doc["scenes"][0]["nodes"] = list(range(2000))
    with pytest.raises(LimitExceeded, match="triangles"):
        _load(gltf.write(tmp_path / "a.glb"))


@pytest.mark.parametrize(
    "uri", ["/etc/hostname", "http://x.org/a.png", "file:///etc/hostname", "../../../a.png"]
)
def test_nothing_outside_is_opened(tmp_path, uri):
    folder = tmp_path / "a/b/c"
    folder.mkdir(parents=True)
    (tmp_path / "a.png").write_bytes(png(noise()))
    gltf = textured()
    gltf.doc["images"] = [{"uri": uri}]
    path = gltf.write(folder / "a.gltf")
    assert (front(path)[..., :3] == 255).all() and "is not shown" in notes_of(path)
    gltf.doc["buffers"] = [{"byteLength": 4, "uri": uri}]
    gltf.doc["bufferViews"][0]["buffer"] = 1
    with pytest.raises(FormatError):
        _load(gltf.write(folder / "a.gltf"))


def test_links_that_lead_outside_are_not_followed(tmp_path):
    folder = tmp_path / "a/b/c"
    folder.mkdir(parents=True)
    (tmp_path / "secret.png").write_bytes(png(noise()))
    (folder / "wood.png").symlink_to(tmp_path / "secret.png")
    gltf = textured()
    gltf.doc["images"] = [{"uri": "wood.png"}]
    assert "lies outside" in notes_of(gltf.write(folder / "a.gltf"))


def test_no_program_is_started_and_no_pipe_waited_for(tmp_path, monkeypatch):
    import os
    import subprocess

    monkeypatch.setattr(subprocess, "Popen", lambda *_, **__: pytest.fail("a program was started"))
    os.mkfifo(tmp_path / "pipe.png")
    eps = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 64 48\n%%EndComments\nshowpage\n%%EOF\n"
    gltf = textured()
    gltf.doc["images"] = [{"bufferView": gltf.view(eps)}]
    assert "no picture in a format that is read" in notes_of(gltf.write(tmp_path / "a.gltf"))
    gltf.doc["images"] = [{"uri": "pipe.png"}]
    assert "pipe" in notes_of(gltf.write(tmp_path / "a.gltf"))


def test_large_json_is_refused(tmp_path):
    gltf = Gltf()
    gltf.doc["extras"] = [{}] * 600_000
    with pytest.raises(LimitExceeded):
        _load(gltf.write(tmp_path / "a.gltf"))


def test_wrong_types_are_sentences(tmp_path):
    """Every number and name of a file replaced in turn by what does not belong there."""
    whole = json.dumps(textured().doc | {"buffers": [{"byteLength": 400, "uri": "a.bin"}]})
    textured().write(tmp_path / "a.gltf")
    document = json.loads(whole)
    for owner, key in list(places(document)):
        for odd in (-1, 2**31, "x", None, [], 1e300):
            kept, owner[key] = owner[key], odd
            (tmp_path / "a.gltf").write_text(json.dumps(document))
            try:
                mesh_capture(tmp_path / "a.gltf", n_train=1, size=2, samples_per_pixel=1)
            except FormatError as error:
                assert "a.gltf" in str(error)
            owner[key] = kept


def places(value):
    for key, inner in value.items() if isinstance(value, dict) else enumerate(value):
        yield value, key
        if isinstance(inner, dict | list):
            yield from places(inner)


def test_nulls_and_whole_numbers_with_a_point(tmp_path):
    gltf = textured()
    gltf.doc |= {"skins": None, "animations": None}
    gltf.doc["nodes"][0] |= {"mesh": 0.0, "children": None, "name": None, "translation": None}
    gltf.doc["materials"][0] |= {"alphaMode": None, "extensions": None, "alphaCutoff": 1}
    gltf.doc["accessors"][0] |= {"componentType": 5126.0, "count": 4.0}
    gltf.doc["bufferViews"][0]["byteStride"] = None
    gltf.doc["textures"][0]["extensions"] = {"EXT_texture_webp": {"source": None}}
    assert shows(gltf.write(tmp_path / "a.glb"), noise())


@pytest.mark.parametrize("head", ["DATA:image/png;base64,", "data:image/png;BASE64,", "data:;base64,"])
def test_data_uris_as_people_write_them(tmp_path, head):
    gltf = textured()
    gltf.doc["images"] = [{"uri": head + base64.b64encode(png(noise())).decode()}]
    assert shows(gltf.write(tmp_path / "a.glb"), noise())


@pytest.mark.parametrize("uri", ["file:///C:/work/wood.png", "wood.png?v=2", "./tex/wood.png#a"])
def test_addresses_of_local_files(tmp_path, uri):
    gltf = textured()
    gltf.doc["images"] = [{"uri": uri}]
    (tmp_path / "wood.png").write_bytes(png(noise()))
    assert shows(gltf.write(tmp_path / "a.glb"), noise())


def test_integer_colours_are_normalised_though_not_said(tmp_path):
    gltf = Gltf()
    gltf.attribute("COLOR_0", np.tile(np.array([51, 102, 153, 255], np.uint8), (4, 1)))
    wanted = [encoded(part / 255) for part in (51, 102, 153)]
    assert np.abs(front(gltf.write(tmp_path / "a.glb"))[..., :3].astype(int) - wanted).max() <= 1


def test_nodes_outside_the_scene_and_corners_left_over_are_told(tmp_path):
    gltf = Gltf()
    gltf.list("nodes", {"mesh": 0, "translation": [9, 0, 0]})
    gltf.doc["accessors"][gltf.primitive["indices"]]["count"] = 5
    path = gltf.write(tmp_path / "a.glb")
    assert box(path)[3] == 1 and "not in the shown scene" in notes_of(path) and "left out" in notes_of(path)


def skinned(weights: list[float], **joint) -> Gltf:
    gltf = Gltf()
    gltf.doc["nodes"] = [{"mesh": 0, "skin": 0}, joint]
    gltf.doc["skins"] = [{"joints": [1]}]
    gltf.attribute("JOINTS_0", np.zeros((4, 4), np.uint8))
    gltf.attribute("WEIGHTS_0", np.tile(np.array(weights, np.float32), (4, 1)))
    return gltf


def test_joints_that_mirror_and_vertices_that_nothing_holds(tmp_path):
    plain, turned = (
        _load(skinned([1, 0, 0, 0], scale=[x, 1, 1]).write(tmp_path / "a.glb")).triangles[1] for x in (1, -1)
    )
    assert (turned == plain[:, [0, 2, 1]]).all()
    path = skinned([0, 0, 0, 0], translation=[5, 0, 0]).write(tmp_path / "a.glb")
    assert box(path) == pytest.approx([4, -1, 0, 6, 1, 0])


def test_a_camera_beside_a_mesh_is_no_note(tmp_path):
    gltf = Gltf()
    gltf.doc["cameras"] = [{"type": "perspective", "perspective": {"yfov": 1, "znear": 0.1}}]
    gltf.doc["nodes"] += [{"camera": 0}, {}]
    gltf.doc["scenes"][0]["nodes"] = [0, 1]
    assert "scene" not in notes_of(gltf.write(tmp_path / "a.glb"))
