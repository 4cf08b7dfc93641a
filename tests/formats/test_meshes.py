"""Meshes as captures: known faces on hand-projected pixels, in exact colours, for every way to colour."""

import logging
import os
import runpy
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from formats.captures import is_capture, read_capture
from formats.errors import BadMesh, MissingFile
from formats.meshes import is_mesh, mesh_capture
from formats.photos import load_images

RED, BLUE, GREEN = [200, 30, 60], [10, 90, 220], [40, 180, 70]
FEW = {"n_train": 8, "size": 64, "samples_per_pixel": 4}


def project(view, point) -> tuple[np.ndarray, float]:
    """Pixel (x, y) and depth."""
    x, y, z, _ = np.linalg.inv(view.camera_to_world) @ [*point, 1]
    return np.array([view.cx + view.fl_x * x / -z, view.cy - view.fl_y * y / -z]), -z


def linear(srgb) -> np.ndarray:
    unit = np.asarray(srgb) / 255
    return np.where(unit <= 0.04045, unit / 12.92, ((unit + 0.055) / 1.055) ** 2.4)


def two_coloured_cube() -> trimesh.Trimesh:
    """2 x 2 x 2 about (1, 2, 3): red where a face's normal is positive, else blue."""
    cube = trimesh.creation.box((2, 2, 2))
    cube.apply_translation((1, 2, 3))
    cube.visual = trimesh.visual.ColorVisuals(cube)
    cube.visual.face_colors = np.where((cube.face_normals.sum(1) > 0)[:, None], [*RED, 255], [*BLUE, 255])
    return cube


def test_cube_faces_lie_where_they_project(tmp_path):
    two_coloured_cube().export(tmp_path / "cube.ply")
    capture = mesh_capture(tmp_path / "cube.ply", n_train=12, size=200, samples_per_pixel=1)
    checked = 0
    for view in capture.train:
        eye = view.camera_to_world[:3, 3]
        for axis in range(3):
            for sign, colour in ((1, RED), (-1, BLUE)):
                centre = np.array([1.0, 2, 3])
                centre[axis] += sign
                if sign * (eye - centre)[axis] < 0.2:
                    continue
                (x, y), _ = project(view, centre)
                assert view.pixels[int(y), int(x)].tolist() == [*colour, 255]
                checked += 1
    assert checked >= 24


def test_cube_corners_bound_the_picture(tmp_path):
    two_coloured_cube().export(tmp_path / "cube.ply")
    capture = mesh_capture(tmp_path / "cube.ply", n_train=6, size=200)
    corners = np.array([1, 2, 3]) + np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, 8).T
    for view in capture.train:
        pixels = np.array([project(view, corner)[0] for corner in corners])
        rows, columns = np.nonzero(view.pixels[..., 3])
        assert pixels.min(0) == pytest.approx([columns.min() + 0.5, rows.min() + 0.5], abs=1)
        assert pixels.max(0) == pytest.approx([columns.max() + 0.5, rows.max() + 0.5], abs=1)
        assert pixels.min() >= 0 and pixels.max() <= 200  # all of it is in sight


def test_alpha_is_the_share_of_rays(tmp_path):
    """The picture's summed alpha is the area of the silhouette, and colour stays pure at its rim."""
    ball = trimesh.creation.icosphere(4, 1.0)
    ball.visual.vertex_colors = [*GREEN, 255]
    ball.export(tmp_path / "ball.ply")
    (view,) = mesh_capture(tmp_path / "ball.ply", n_train=1, size=100).train
    distance = np.linalg.norm(view.camera_to_world[:3, 3])
    radius = view.fl_x / np.sqrt(distance**2 - 1)
    assert view.pixels[..., 3].sum() / 255 == pytest.approx(np.pi * radius**2, rel=5e-3)
    rim = (view.pixels[..., 3] > 0) & (view.pixels[..., 3] < 255)
    assert rim.sum() > 100
    assert (view.pixels[rim][:, :3] == GREEN).all()
    assert (view.pixels[view.pixels[..., 3] == 0] == 0).all()


def test_box_and_cameras(tmp_path):
    two_coloured_cube().export(tmp_path / "cube.ply")
    capture = mesh_capture(tmp_path / "cube.ply", n_train=40, n_test=3, size=8, samples_per_pixel=1)
    assert capture.aabb == pytest.approx([-0.04, 0.96, 1.96, 2.04, 3.04, 4.04])
    assert (capture.kind, capture.opaque, len(capture.train), len(capture.test)) == ("mesh", False, 40, 3)
    eyes = np.array([view.camera_to_world[:3, 3] for view in capture.train]) - [1, 2, 3]
    directions = eyes / np.linalg.norm(eyes, axis=1)[:, None]
    # All around: the cameras balance out, and no direction is far from one of them.
    assert np.linalg.norm(directions.mean(0)) < 0.03
    anywhere = np.random.default_rng(0).normal(size=(500, 3))
    anywhere /= np.linalg.norm(anywhere, axis=1)[:, None]
    assert (anywhere @ directions.T).max(1).min() > np.cos(np.radians(30))
    for view in capture.train:
        rotation = view.camera_to_world[:3, :3]
        assert rotation.T @ rotation == pytest.approx(np.eye(3), abs=1e-12)
        assert np.linalg.det(rotation) == pytest.approx(1)


def test_same_seed_same_bytes(tmp_path):
    two_coloured_cube().export(tmp_path / "cube.ply")
    a, b, c = (load_images(mesh_capture(tmp_path / "cube.ply", **FEW, seed=seed).train) for seed in (1, 1, 2))
    assert a.tobytes() == b.tobytes() != c.tobytes()


# --- colours ------------------------------------------------------------------------------------------------


def colours_seen(path) -> set:
    pixels = load_images(mesh_capture(path, n_train=8, size=64, samples_per_pixel=1).train)
    return {tuple(colour) for colour in pixels[pixels[..., 3] > 0][:, :3].tolist()}


def near(found: set, expected: list, off: int) -> bool:
    distance = np.abs(np.array(list(found))[:, None] - np.array(expected)).max(2)
    return bool((distance.min(1) <= off).all() and (distance.min(0) <= off).all())


def gltf_material(colour) -> trimesh.visual.TextureVisuals:
    factor = [*np.rint(255 * linear(colour)).astype(int).tolist(), 255]
    return trimesh.visual.TextureVisuals(material=trimesh.visual.material.PBRMaterial(baseColorFactor=factor))


def test_scene_of_several_materials(tmp_path):
    """A material, vertex colours and a texture in one .glb, the first placed twice, all moved."""
    plain, coloured, textured = (trimesh.creation.box() for _ in range(3))
    plain.visual = gltf_material(RED)
    coloured.visual.vertex_colors = [*np.rint(255 * linear(BLUE)).astype(int), 255]
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=Image.new("RGB", (4, 4), tuple(GREEN)))
    textured.visual = trimesh.visual.TextureVisuals(uv=np.zeros((8, 2)), material=material)
    scene = trimesh.Scene()
    for i, mesh in enumerate((plain, coloured, textured)):
        scene.add_geometry(
            mesh, geom_name=f"g{i}", transform=trimesh.transformations.translation_matrix((3 * i, 0, 0))
        )
    scene.graph.update("again", matrix=trimesh.transformations.translation_matrix((0, 5, 0)), geometry="g0")
    scene.export(tmp_path / "scene.glb")
    # The linear bytes of trimesh's glTF are a few sRGB steps apart where it is dark.
    assert near(colours_seen(tmp_path / "scene.glb"), [RED, BLUE, GREEN], 4)
    capture = mesh_capture(tmp_path / "scene.glb", **FEW)
    # Moved up, that is along glTF's +y, the first box stands higher than the others.
    assert capture.aabb[3:] == pytest.approx([6.64, 0.64, 5.64])
    assert "+z is up" in capture.notes[0]


def test_obj_material(tmp_path):
    (tmp_path / "a.mtl").write_text("newmtl red\nKd {} {} {}\n".format(*(c / 255 for c in RED)))
    faces = "usemtl red\nf 1 2 3\nf 1 3 4\nf 1 2 4\nf 2 3 4\n"
    (tmp_path / "a.obj").write_text("mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\n" + faces)
    assert near(colours_seen(tmp_path / "a.obj"), [RED], 1)


def slow_texel(texels: np.ndarray, u: float, v: float) -> np.ndarray:
    """The four nearest of a texture that repeats twice along each axis, v up, weighted by closeness; beyond
    the surface its border goes on."""
    height, width, _ = texels.shape
    x, y = u * width, (1 - v) * height
    total = np.zeros(3)
    for row in range(-height - 2, height + 2):
        for column in range(-2, 2 * width + 2):
            near = max(0, 1 - abs(column + 0.5 - x)) * max(0, 1 - abs(row + 0.5 - y))
            inside = np.clip(row, -height, height - 1), np.clip(column, 0, 2 * width - 1)
            total += near * texels[inside[0] % height, inside[1] % width]
    return total


def test_texture_is_bilinear_upright_and_repeats(tmp_path):
    """Where a pixel's ray meets z = 0 at (u, v, 0), it shows the texture at (u, v), twice along each axis."""
    texels = np.array([[RED, BLUE, GREEN], [GREEN, [250, 250, 250], RED]], np.uint8)
    Image.fromarray(texels).save(tmp_path / "t.png")
    (tmp_path / "a.mtl").write_text("newmtl m\nmap_Kd t.png\n")
    corners = "v 0 0 0\nv 2 0 0\nv 2 2 0\nv 0 2 0\nvt 0 0\nvt 2 0\nvt 2 2\nvt 0 2\n"
    (tmp_path / "a.obj").write_text("mtllib a.mtl\n" + corners + "usemtl m\nf 1/1 2/2 3/3\nf 1/1 3/3 4/4\n")
    random = np.random.default_rng(0)
    for view in mesh_capture(tmp_path / "a.obj", n_train=4, size=100, samples_per_pixel=1).train:
        hits = np.argwhere(view.pixels[..., 3])
        for row, column in hits[random.integers(0, len(hits), 25)]:
            right, down = (column + 0.5 - view.cx) / view.fl_x, (row + 0.5 - view.cy) / view.fl_y
            direction = view.camera_to_world[:3, :3] @ [right, -down, -1]
            eye = view.camera_to_world[:3, 3]
            u, v, _ = eye - direction * eye[2] / direction[2]
            seen = view.pixels[row, column, :3].astype(int)
            assert seen == pytest.approx(slow_texel(texels, u, v), abs=0.6)


@pytest.mark.parametrize("ending", ["stl", "stl_ascii", "off", "obj"])
def test_mesh_without_colour_is_white(tmp_path, ending):
    path = tmp_path / f"a.{ending.partition('_')[0]}"
    path.write_bytes(as_bytes(trimesh.creation.box().export(file_type=ending)))
    assert colours_seen(path) == {(255, 255, 255)}
    assert mesh_capture(path, **FEW).aabb == pytest.approx([-0.52] * 3 + [0.52] * 3)


def as_bytes(data: str | bytes) -> bytes:
    return data.encode() if isinstance(data, str) else data


# --- what is and what is not a mesh -------------------------------------------------------------------------


def test_told_apart_by_content(tmp_path):
    trimesh.creation.box().export(tmp_path / "box.glb")
    os.rename(tmp_path / "box.glb", tmp_path / "box.data")
    trimesh.PointCloud(np.eye(3)).export(tmp_path / "points.ply")
    assert is_mesh(tmp_path / "box.data") and not is_capture(tmp_path / "box.data")
    assert not is_mesh(tmp_path / "points.ply") and not is_mesh(tmp_path) and not is_mesh(tmp_path / "no.obj")
    assert len(mesh_capture(tmp_path / "box.data", **FEW).train) == 8
    with pytest.raises(BadMesh, match=r"points\.ply"):
        mesh_capture(tmp_path / "points.ply")
    with pytest.raises(MissingFile, match=r"no\.obj"):
        mesh_capture(tmp_path / "no.obj")


BROKEN = {
    "cut.glb": lambda data: data[: len(data) // 2],
    "noise.glb": lambda data: b"glTF" + bytes(range(200)),
    "empty.obj": lambda data: b"",
    "nan.obj": lambda data: b"v nan 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n",
    "point.obj": lambda data: b"v 0 0 0\nv 0 0 0\nv 0 0 0\nf 1 2 3\n",
    "far.obj": lambda data: b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n",
    "list.gltf": lambda data: b"[]",
}


@pytest.mark.parametrize("name", BROKEN)
def test_broken(tmp_path, name, caplog):
    caplog.set_level(logging.CRITICAL, "trimesh")
    data = trimesh.creation.box().export(file_type="glb")
    (tmp_path / name).write_bytes(BROKEN[name](data))
    with pytest.raises(BadMesh, match=name.replace(".", r"\.")):
        mesh_capture(tmp_path / name, **FEW)


# --- whole meshes -------------------------------------------------------------------------------------------

DATA = Path(os.environ.get("FUSEDRF_DATA", Path(__file__).parents[3] / "shared/data"))


def test_fuze():
    path = DATA / "fuze/fuze.obj"
    if not path.exists():
        pytest.skip("fuze is not in the folder named by FUSEDRF_DATA")
    capture = mesh_capture(path, n_train=2, size=80)
    assert capture.aabb[5] == pytest.approx(0.2191 + 0.02 * 0.2151, abs=1e-4)
    pixels = load_images(capture.train)
    mean = pixels[pixels[..., 3] == 255].mean(0)
    assert mean[0] > 1.5 * mean[1]  # its label is red


def test_example_scene(tmp_path, capsys):
    """examples/make_scene.py: four meshes with their feet on z = 0, the same bytes every time."""
    make = runpy.run_path(str(Path(__file__).parents[2] / "examples/make_scene.py"))["main"]
    make([str(tmp_path / "scene")])
    first = {path.name: path.read_bytes() for path in (tmp_path / "scene").iterdir()}
    assert sorted(first) == ["arch.glb", "ball.glb", "ground.glb", "tower.glb"]
    make([str(tmp_path / "scene")])
    assert first == {path.name: path.read_bytes() for path in (tmp_path / "scene").iterdir()}
    for name in first:
        low, high = trimesh.load_scene(tmp_path / "scene" / name).bounds
        assert low[1] == pytest.approx(0, abs=1e-6) and np.abs(low + high)[::2].max() < 0.05
        assert high[1] == pytest.approx(0.06 if name == "ground.glb" else 1, abs=1e-6)
    assert "tower.glb" in capsys.readouterr().out


def test_gltf_stands_upright(tmp_path):
    """A tall box with a red top: as glTF along +y, as .ply along +z; both are one and the same picture."""
    box = trimesh.creation.box((1, 1, 3))
    colours = np.where((box.triangles_center[:, 2] > 1)[:, None], [255, 0, 0, 255], [0, 0, 255, 255])
    box.unmerge_vertices()
    box.visual.vertex_colors = np.repeat(colours, 3, axis=0).astype(np.uint8)
    box.export(tmp_path / "box.ply")
    box.apply_transform(trimesh.transformations.rotation_matrix(-np.pi / 2, (1, 0, 0)))
    box.export(tmp_path / "box.glb")
    turned, plain = (mesh_capture(tmp_path / f"box.{kind}", **FEW) for kind in ("glb", "ply"))
    assert turned.aabb == pytest.approx(plain.aabb) and turned.aabb[5] > 1.5 and plain.notes == ()
    difference = load_images(turned.train).astype(int) - load_images(plain.train)
    assert np.abs(difference).max(-1).mean() < 1


def test_read_capture_renders_meshes(tmp_path, monkeypatch):
    two_coloured_cube().export(tmp_path / "cube.ply")
    monkeypatch.setattr("formats.captures.mesh_capture", lambda path: ("rendered", path))
    assert read_capture(tmp_path / "cube.ply") == ("rendered", tmp_path / "cube.ply")
