"""Small sound inputs of every kind that `train` reads, to be damaged: captures of each layout, and meshes."""

import json
import struct
from pathlib import Path

import numpy as np
import trimesh
from PIL import Image

from formats.llff import NAME as LLFF

SIDE, FOCAL, COUNT = 16, 20.0, 4
CUBE = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)


def poses(count: int = COUNT) -> list[np.ndarray]:
    """(4, 4) camera-to-world, OpenGL axes, on a circle of radius 4 that looks at the origin; z is up."""
    made = []
    for turn in np.arange(count) * 2 * np.pi / count:
        back = np.array([np.cos(turn), np.sin(turn), 0.4])
        back /= np.linalg.norm(back)
        right = np.cross([0, 0, 1], back)
        right /= np.linalg.norm(right)
        pose = np.eye(4)
        pose[:3] = np.stack([right, np.cross(back, right), back, 4 * back], 1)
        made.append(pose)
    return made


def photo(i: int, channels: int = 3) -> np.ndarray:
    """(SIDE, SIDE, channels) uint8 of noise; alpha is a disc."""
    pixels = np.random.default_rng(i).integers(0, 256, (SIDE, SIDE, channels), np.uint8)
    if channels == 4:
        y, x = np.mgrid[:SIDE, :SIDE] - SIDE / 2
        pixels[..., 3] = 255 * (x * x + y * y < (SIDE / 3) ** 2)
    return pixels


def save(path: Path, pixels: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path)


def blender(folder: Path) -> Path:
    """Cut-outs with transforms_train.json."""
    frames = []
    for i, pose in enumerate(poses()):
        save(folder / f"train/r_{i}.png", photo(i, 4))
        frames.append({"file_path": f"./train/r_{i}", "transform_matrix": pose.tolist()})
    document = {"camera_angle_x": 0.76, "frames": frames}
    (folder / "transforms_train.json").write_text(json.dumps(document))
    return folder


def nerfstudio(folder: Path) -> Path:
    """Photos with masks, distortion and a .ply of sparse points."""
    frames = []
    for i, pose in enumerate(poses()):
        save(folder / f"images/{i}.png", photo(i))
        save(folder / f"masks/{i}.png", photo(i, 4)[..., 3])
        names = {"file_path": f"images/{i}.png", "mask_path": f"masks/{i}.png"}
        frames.append(names | {"transform_matrix": pose.tolist()})
    lens = {"fl_x": FOCAL, "fl_y": FOCAL, "cx": SIDE / 2, "cy": SIDE / 2, "w": SIDE, "h": SIDE, "k1": 0.01}
    document = {**lens, "ply_file_path": "points.ply", "aabb_scale": 4, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(document))
    head = "ply\nformat ascii 1.0\nelement vertex 8\n" + "".join(f"property float {a}\n" for a in "xyz")
    rows = "\n".join(" ".join(map(str, row)) for row in CUBE.tolist())
    (folder / "points.ply").write_text(f"{head}end_header\n{rows}\n")
    return folder


def colmap_poses() -> list[tuple[np.ndarray, np.ndarray]]:
    """World-to-camera quaternions (w, x, y, z) and translations, y down and z forward."""
    found = []
    for pose in poses():
        rotation = (pose[:3, :3] * [1, -1, -1]).T
        x, y, z, w = np.roll(trimesh.transformations.quaternion_from_matrix(rotation), -1)
        found.append((np.array([w, x, y, z]), -rotation @ pose[:3, 3]))
    return found


def colmap_binary(folder: Path) -> Path:
    """A binary model with points, and its photos."""
    model = folder / "sparse/0"
    model.mkdir(parents=True)
    lens = struct.pack("<QIiQQ3d", 1, 1, 0, SIDE, SIDE, FOCAL, SIDE / 2, SIDE / 2)
    (model / "cameras.bin").write_bytes(lens)
    images = struct.pack("<Q", COUNT)
    for i, (q, t) in enumerate(colmap_poses(), 1):
        save(folder / f"images/{i}.png", photo(i))
        images += struct.pack("<I7dI", i, *q, *t, 1) + f"{i}.png".encode() + b"\0"
        images += struct.pack("<QddQ", 1, 3.0, 4.0, 1)
    (model / "images.bin").write_bytes(images)
    points = struct.pack("<Q", len(CUBE))
    for i, point in enumerate(CUBE, 1):
        points += struct.pack("<Q3d3BdQ2I", i, *point, 200, 100, 50, 0.5, 1, 1, 0)
    (model / "points3D.bin").write_bytes(points)
    return folder


def colmap_text(folder: Path) -> Path:
    """A model in text."""
    model = folder / "sparse/0"
    model.mkdir(parents=True)
    (model / "cameras.txt").write_text(f"# made\n1 PINHOLE {SIDE} {SIDE} {FOCAL} {FOCAL} 8 8\n")
    lines = []
    for i, (q, t) in enumerate(colmap_poses(), 1):
        save(folder / f"images/{i}.png", photo(i))
        lines += [f"{i} {' '.join(map(repr, [*q.tolist(), *t.tolist()]))} 1 {i}.png", "3.0 4.0 1"]
    (model / "images.txt").write_text("\n".join(lines) + "\n")
    rows = [f"{i} {x} {y} {z} 200 100 50 0.5 1 0" for i, (x, y, z) in enumerate(CUBE.tolist(), 1)]
    (model / "points3D.txt").write_text("\n".join(rows) + "\n")
    return folder


def llff(folder: Path) -> Path:
    """poses_bounds.npy and its photos."""
    rows = []
    for i, pose in enumerate(poses()):
        save(folder / f"images/{i}.png", photo(i))
        right, up, back, eye = pose[:3].T
        rows.append([*np.column_stack([-up, right, back, eye, [SIDE, SIDE, FOCAL]]).ravel(), 1.0, 9.0])
    np.save(folder / LLFF, np.array(rows))
    return folder


def polycam(folder: Path) -> Path:
    """A raw export with its keyframes."""
    for i, pose in enumerate(poses()):
        save(folder / f"keyframes/images/{i}.png", photo(i))
        rows = pose[[1, 2, 0]]
        keys = {f"t_{r}{c}": float(rows[r, c]) for r in range(3) for c in range(4)}
        keys |= {"fx": FOCAL, "fy": FOCAL, "cx": 8.0, "cy": 8.0, "width": SIDE, "height": SIDE}
        file = folder / f"keyframes/cameras/{i}.json"
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(json.dumps(keys))
    return folder


def textured() -> trimesh.Trimesh:
    """A cube with a picture and texture coordinates."""
    mesh = trimesh.creation.box((2, 2, 2))
    uv = (mesh.vertices[:, :2] + 1) / 2
    mesh.visual = trimesh.visual.TextureVisuals(uv=uv, image=Image.fromarray(photo(0)))
    return mesh


def glb(folder: Path) -> Path:
    """A textured cube in one file."""
    folder.mkdir(parents=True)
    (folder / "cube.glb").write_bytes(textured().export(file_type="glb"))
    return folder / "cube.glb"


def gltf(folder: Path) -> Path:
    """The same as JSON, with its buffers and picture beside it."""
    folder.mkdir(parents=True)
    for name, data in trimesh.exchange.gltf.export_gltf(trimesh.Scene(textured())).items():
        (folder / name.replace("model", "cube")).write_bytes(data)
    return folder / "cube.gltf"


def obj(folder: Path) -> Path:
    """The same as .obj, with its materials and picture."""
    folder.mkdir(parents=True)
    save(folder / "wood.png", photo(0))
    (folder / "cube.mtl").write_text("newmtl wood\nKd 0.8 0.8 0.8\nmap_Kd -s 1 1 1 wood.png\n")
    box = trimesh.creation.box((2, 2, 2))
    lines = ["mtllib cube.mtl", *(f"v {x} {y} {z}" for x, y, z in box.vertices.tolist())]
    lines += ["vt 0 0", "vt 1 0", "vt 1 1", "usemtl wood"]
    lines += [f"f {a + 1}/1 {b + 1}/2 {c + 1}/3" for a, b, c in box.faces.tolist()]
    (folder / "cube.obj").write_text("\n".join(lines) + "\n")
    return folder / "cube.obj"


def ply(folder: Path, encoding: str = "binary") -> Path:
    """A cube with a colour for each vertex."""
    folder.mkdir(parents=True)
    box = trimesh.creation.box((2, 2, 2))
    box.visual.vertex_colors = np.random.default_rng(0).integers(0, 256, (8, 4), np.uint8)
    data = trimesh.exchange.ply.export_ply(box, encoding=encoding)
    (folder / "cube.ply").write_bytes(data if isinstance(data, bytes) else data.encode())
    return folder / "cube.ply"


def ply_text(folder: Path) -> Path:
    """The same in text."""
    return ply(folder, "ascii")


def stl(folder: Path) -> Path:
    """A cube without colours."""
    folder.mkdir(parents=True)
    (folder / "cube.stl").write_bytes(trimesh.creation.box((2, 2, 2)).export(file_type="stl"))
    return folder / "cube.stl"


CAPTURES = (blender, nerfstudio, colmap_binary, colmap_text, llff, polycam)
MESHES = (glb, gltf, obj, ply, ply_text, stl)
