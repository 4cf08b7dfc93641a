"""Imports against the answers of the systems that wrote them: python -m benchmarks.foreign DATA [NAME ..]

DATA is a folder with a folder for each checkpoint, in which answers.npz has points, directions, σ and colours
by the system's own code, and view.npz and view.json a picture by its own renderer. Each file is imported as
`fusedrf import` does it. Prints a Markdown table: the relative error of σ where it is above 0, and the
largest of a colour's, as median and 99 %; the share of the points without density where ours is 0 as well;
the PSNR of the picture, at half a voxel's step and at a quarter of that.
"""

import argparse
import json
import tempfile
from pathlib import Path

import numpy as np
import torch

from benchmarks.commit import commit_line
from benchmarks.paper.table import markdown
from fusedrf_cli import verbs
from fusedrf_cli.bridge.rendering import renderable
from fusedrf_cli.bridge.scene import load_scene
from fusedrf_cli.engine.fields.base import sampling_step
from fusedrf_cli.engine.rendering.cameras import Camera
from fusedrf_cli.engine.rendering.metrics import psnr
from fusedrf_cli.engine.rendering.volume import render_image
from fusedrf_cli.errors import FusedRFError
from fusedrf_cli.python import open_scene

OURS = "answers.npz", "answers_background.npz", "view.npz"
WORDS = {"krrish-nerf-hotdog": {"aabb": (-2.0, -2.0, -2.0, 2.0, 2.0, 2.0)}, "d2nerf": {"time": 2.0}}
"""What a folder's file does not say of itself."""
FINER = 4


def source_of(folder: Path) -> Path:
    """The checkpoint of a folder, or the folder where it is a run's."""
    files = [f for f in folder.iterdir() if f.suffix in (".th", ".pth", ".tar", ".ckpt", ".ingp")]
    files += [f for f in folder.glob("*.npz") if f.name not in OURS] + list(folder.glob("checkpoint_*"))
    return files[0] if files else folder


def words_of(folder: Path, answers: dict) -> dict:
    """The options that a file needs."""
    words = dict(WORDS.get(folder.name, {}))
    if "nerf-" in folder.name and "aabb" not in words:
        box = view_of(folder).get("box") or [answers["points"].min(0), answers["points"].max(0)]
        words["aabb"] = tuple(float(x) for x in np.ravel(box))
    return words


def view_of(folder: Path) -> dict:
    """What view.json says, or nothing."""
    path = folder / "view.json"
    return json.loads(path.read_text()) if path.exists() else {}


def measured(folder: Path, bundle: Path) -> dict:
    """A row of the table."""
    answers = dict(np.load(folder / "answers.npz"))
    verbs.import_field(source_of(folder), bundle, overwrite=True, **words_of(folder, answers))
    scene = open_scene(bundle)
    where = "_capture" if "points_capture" in answers else ""
    points, dirs = (torch.from_numpy(answers[f"{name}{where}"]).double() for name in ("points", "directions"))
    sigma, rgb = (values.detach().numpy() for values in scene.query(points, dirs))
    truth = answers.get("sigma_rendered", answers[f"sigma{where}"]).reshape(-1)
    dense = truth > 0
    if "inside" in answers:
        dense &= answers["inside"].astype(bool)
    off = np.abs(sigma - truth)[dense] / truth[dense]
    colour, empty = np.abs(rgb - answers["rgb"])[dense].max(1), truth == 0
    row = {"file": folder.name}
    for name, values in (("σ", off), ("colour", colour)):
        row[f"{name}, median"] = f"{np.median(values):.1e}"
        row[f"99 % of {name}"] = f"{np.quantile(values, 0.99):.1e}"
    row["empty"] = f"{(sigma[empty] == 0).mean():.4f}" if empty.any() else ""
    return row | pictures(folder, bundle, "_capture" if where else "")


def pictures(folder: Path, bundle: Path, where: str) -> dict:
    """The PSNR of the view at two steps."""
    view = view_of(folder)
    if not view:
        return {"picture, dB": "", "finer, dB": ""}
    pose = np.array(view["camera_to_world"])
    field, origin = renderable(load_scene(str(bundle)))
    if where:  # the view stands in the model's coordinates, which the import has undone
        forward = json.loads((folder / "dataparser_transforms.json").read_text())
        back = np.linalg.inv(np.vstack([forward["scale"] * np.array(forward["transform"]), [0, 0, 0, 1]]))
        pose = back @ pose
        pose[:3, :3] *= forward["scale"]
    size, focal = view["width"], view["focal"]
    camera = Camera(pose, focal, focal, size / 2, size / 2, size, size)
    truth = np.clip(np.load(folder / "view.npz")["rgb"].reshape(size, size, 3), 0, 1)
    behind = view["background"] if isinstance(view["background"], list) else (0, 0, 0)
    near = 0.0 if where or "dcvgo" in folder.name else view.get("near", 0.0)
    found = []
    for finer in (1, FINER):
        step = sampling_step(field) / finer
        shown = render_image(field, camera, origin=origin, near=near, step=step, early_stop=1e-6)
        found.append(f"{psnr(shown.over(behind), truth):.1f}")
    return dict(zip(("picture, dB", "finer, dB"), found, strict=True))


def main() -> None:
    """Import and measure file after file."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.foreign", description=__doc__)
    parser.add_argument("data", type=Path)
    parser.add_argument("names", nargs="*", help="of folders; default: all")
    asked = parser.parse_args()
    rows = []
    with tempfile.TemporaryDirectory() as temporary:
        for folder in sorted(path.parent for path in asked.data.glob("*/answers.npz")):
            if asked.names and folder.name not in asked.names:
                continue
            try:
                rows.append(measured(folder, Path(temporary) / "field.rfpack"))
            except FusedRFError as error:
                rows.append({"file": f"{folder.name}: {error}"})
            print(rows[-1], flush=True)
    columns = list(dict.fromkeys(key for row in rows for key in row))
    print(f"\n{commit_line()}\n\n{markdown([{name: row.get(name, '') for name in columns} for row in rows])}")


if __name__ == "__main__":
    main()
