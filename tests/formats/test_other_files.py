"""What is no capture is called what it is, with what to do."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import formats.other_files
from formats.captures import read_capture
from formats.errors import BadMesh, MissingExtra, NotACapture, NoViews
from formats.meshes import mesh_surfaces
from formats.overview import overview
from formats.posing import photos_to_pose
from tests.formats.test_captures import photo

FTYP = b"\0\0\0\x20ftyp"
SPLATS = b"ply\nformat binary_little_endian 1.0\nelement vertex 9\nproperty float x\nproperty float f_dc_0\n"
FILES = {
    "walk.mp4": (FTYP + b"isom", "a film", "ffmpeg"),
    "walk.MOV": (FTYP + b"qt  ", "a film", "ffmpeg"),
    "walk": (b"\x1aE\xdf\xa3webm", "a film", "ffmpeg"),
    "walk.avi": (b"RIFF1234AVI LIST", "a film", "ffmpeg"),
    "walk.gif": (b"GIF89a", "a film", "ffmpeg"),
    "poses.zip": (b"PK\x03\x04", "an archive", "unpack"),
    "poses.tar.gz": (b"\x1f\x8b\x08", "an archive", "unpack"),
    "poses.tar": (bytes(257) + b"ustar", "an archive", "unpack"),
    "scan.r3d": (b"PK\x03\x04", "Record3D", "ns-process-data"),
    "scan.usdz": (b"PK\x03\x04", "USD", ".glb"),
    "one.jpg": (b"\xff\xd8\xff\xe0", "a single photo", "folder of the photos"),
    "one.dng": (b"II\x2a\0", "raw", "JPEG"),
    "cameras.xml": (b'<?xml version="1.0"?>\n<document version="2.0.0">\n <chunk', "Metashape", "COLMAP"),
    "cameras.csv": (b"#name,x,y,alt,heading\n", "RealityCapture", "COLMAP"),
    "scene.nvm": (b"NVM_V3 \n", "list of cameras", "COLMAP"),
    "images.bin": (b"\x0c\0\0\0\0\0\0\0", "COLMAP", "folder above"),
    "images.txt": (b"# Image list with two lines\n", "COLMAP", "folder above"),
    "point_cloud.ply": (SPLATS, "Gaussian splats", "fusedrf import"),
    "scene.spz": (b"\x1f\x8b\x08", "Gaussian splats", "fusedrf import"),
    "scene.splat": (b"\1\2\3\4", "Gaussian splats", "fusedrf import"),
    "cloud.ply": (b"ply\nformat ascii 1.0\nelement vertex 9\nproperty float x\n", "of points", "photos"),
    "a.fbx": (b"Kaydara FBX Binary", "FBX model", ".glb"),
    "a.blend": (b"\x28\xb5\x2f\xfd", "Blender file", ".glb"),
    "a.usda": (b"#usda 1.0", "USD", ".glb"),
    "model.pth": (b"PK\x03\x04", "checkpoint", "photos"),
    "model.ckpt": (b"\x80\x02}", "checkpoint", "photos"),
    "base.ingp": (b"\x78\x9c", "checkpoint", "photos"),
    "poses.npz": (b"PK\x03\x04", "arrays", "photos"),
    "poses.npy": (b"\x93NUMPY\1\0", "arrays", "photos"),
    "chair.rfpack": (b"PK\x03\x04", "a bundle", "fusedrf render"),
    "notes.txt": (b"The photos of the chair", "a text", "transforms.json"),
    "nothing": (b"\0\1\2", "unknown kind", "transforms.json"),
    "empty": (b"", "an empty file", "again"),
}


@pytest.mark.parametrize("name", FILES)
def test_files(tmp_path, name):
    data, what, cure = FILES[name]
    (tmp_path / name).write_bytes(data)
    for read in (read_capture, photos_to_pose):
        with pytest.raises(NotACapture, match=rf"{name}: is .*{what}.*; .*{cure}"):
            read(tmp_path / name)


def test_an_archive_is_no_bundle_to_info(tmp_path):
    (tmp_path / "photos.zip").write_bytes(b"PK\x03\x04" + bytes(60))
    with pytest.raises(NotACapture, match=r"photos\.zip: is an archive, no capture; unpack"):
        overview(tmp_path / "photos.zip")


def test_what_is_no_mesh(tmp_path):
    for name, data, what in (
        ("a.fbx", b"", "an empty file"),
        ("a.fbx", b"Kaydara FBX", "an FBX model.*Blender"),
    ):
        (tmp_path / name).write_bytes(data)
        with pytest.raises(BadMesh, match=rf"a\.fbx: is {what}"):
            mesh_surfaces(tmp_path / name)
    (tmp_path / "a.txt").write_text("no mesh")
    with pytest.raises(BadMesh, match=r"a\.txt: is a text, no mesh; give a \.glb, "):
        mesh_surfaces(tmp_path / "a.txt")


HEIC = FTYP + b"heic" + bytes(200)


@pytest.mark.parametrize("extra", [False, True])
def test_heic_names_its_extra(tmp_path, monkeypatch, extra):
    monkeypatch.setattr(formats.other_files, "find_spec", lambda name: extra or None)
    (tmp_path / "IMG_1.HEIC").write_bytes(HEIC)
    error, said = (NotACapture, "folder of the photos") if extra else (MissingExtra, r"fusedrf\[heif\]")
    with pytest.raises(error, match=rf"IMG_1\.HEIC: is a HEIC photo.*{said}"):
        read_capture(tmp_path / "IMG_1.HEIC")


def test_heic_is_read_with_its_extra(tmp_path):
    pillow_heif = pytest.importorskip("pillow_heif")
    from formats.images import read_image

    pixels = np.zeros((64, 96, 3), np.uint8)
    pixels[:, 48:] = 200, 60, 30
    pillow_heif.from_pillow(Image.fromarray(pixels)).save(tmp_path / "a.heic", quality=100)
    assert (
        np.abs(read_image(tmp_path / "a.heic")[32, [10, 80], :3] - pixels[32, [10, 80]].astype(int)).max() < 9
    )


JSONS = {
    "a scene": ({"format": "rfpack", "nodes": []}, "a scene of fields"),
    "Luma's list": ([{"file_path": "a.png", "transform": []}], "a JSON list of frames"),
    "splats' list": ([{"id": 0, "position": [], "rotation": []}], "splat scene"),
    "Meshroom": ({"version": ["1", "2"], "views": [], "poses": []}, "another program's list of cameras"),
    "OpenSfM": ([{"cameras": {}, "shots": {}}], "another program's list of cameras"),
    "nerfstudio's own": ({"transform": [], "scale": 1.0}, "what nerfstudio did"),
    "a path of cameras": ({"camera_path": []}, "path of cameras"),
}


@pytest.mark.parametrize("content, what", JSONS.values(), ids=JSONS)
def test_json_of_other_kinds(tmp_path, content, what):
    for name in ("transforms.json", "transforms_train.json"):  # which goes before the other
        (tmp_path / name).write_text(json.dumps(content))
        for read in (tmp_path, tmp_path / name):
            with pytest.raises(NotACapture, match=rf"{name}: is .*{what}"):
                read_capture(read)


def folder(path: Path, **files) -> Path:
    for name, data in files.items():
        file = path / name.replace("__", "/").replace("_DOT_", ".")
        file.parent.mkdir(parents=True, exist_ok=True)
        if data is None:
            photo(file)
        else:
            file.write_bytes(data)
    return path


FOLDERS = {
    "nested": (
        {f"10{i % 2}APPLE__IMG_{i}_DOT_png": None for i in range(5)},
        r"in 2 folders below it, 3 of them in 100APPLE; give that folder, or put all",
    ),
    "one below": (
        {"DCIM__100APPLE__a_DOT_png": None},
        r"1 folder below it, 1 of them in DCIM/100APPLE; give",
    ),
    "captures": (
        {f"{name}__transforms_DOT_json": b"{}" for name in ("chair", "lego")},
        "holds 2 captures, such as chair and lego; give one",
    ),
    "Record3D": (
        {"metadata": b"{}", "rgbd__0_DOT_png": None},
        "is a Record3D export, no capture; convert",
    ),
    "a film": ({"walk_DOT_MOV": FTYP + b"qt  "}, r"walk\.MOV, a film; take pictures"),
    "a mesh": ({"a_DOT_obj": b"v 0 0 0\n", "a_DOT_mtl": b""}, r"a\.obj, a mesh; give that file itself"),
    "splats": ({"a__point_cloud_DOT_ply": SPLATS}, r"point_cloud\.ply, a scene of Gaussian splats"),
    "texts": ({"readme_DOT_txt": b"hello"}, r"1 file such as readme\.txt, but no photos"),
    "a Mac's": ({"_DOT__a_DOT_jpg": b"\0\5\x16\7"}, "the folder is empty"),
}


@pytest.mark.parametrize("files, said", FOLDERS.values(), ids=FOLDERS)
def test_folders(tmp_path, files, said):
    folder(tmp_path, **files)
    for read in (read_capture, *[photos_to_pose] * ("captures" not in said)):
        with pytest.raises(NotACapture, match=said):
            read(tmp_path)


def test_a_thumbnail_beside_the_photos(tmp_path):
    folder(tmp_path, thumbnail_DOT_png=None, **{f"images__{i}_DOT_png": None for i in range(4)})
    assert [file.parent.name for file in photos_to_pose(tmp_path)] == ["images"] * 4


def test_a_texture_beside_its_mesh(tmp_path):
    folder(tmp_path, a_DOT_obj=b"v 0 0 0\n", texture_DOT_png=None)
    with pytest.raises(NoViews, match=r"holds 1 photos.*a\.obj as well, a mesh: give that file itself"):
        photos_to_pose(tmp_path)
