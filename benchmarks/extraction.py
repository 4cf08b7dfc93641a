"""Objects cut out of fields: python -m benchmarks.extraction DATA [--out docs/real] [--keep FOLDER]

DATA is a folder with tankard/, chair/ and fuze/fuze.obj. The tankard's photos are learnt from with all that
they show, and the tankard is cut out by five of its masks; a scene of three objects and a ground, whose truth
is known, is taken apart by three masks for each object, and by a box and six points. OUT gets extraction.md:
how well silhouettes agree with true masks on views that no mask was given of, seconds, and what object and
rest give when they are put together again.
"""

import argparse
import json
import shutil
import tempfile
import time
from pathlib import Path

import numpy as np
import trimesh
from PIL import Image
from scipy.ndimage import binary_dilation, binary_erosion

from benchmarks.paper.table import markdown
from benchmarks.paper.work import fusedrf, tell
from formats.captures import read_cameras
from fusedrf_cli.bridge.pictures import camera_of
from fusedrf_cli.bridge.rendering import renderable
from fusedrf_cli.bridge.scene import load_scene
from fusedrf_cli.engine.rendering.cameras import framing, framing_lens
from fusedrf_cli.engine.rendering.metrics import psnr
from fusedrf_cli.engine.rendering.volume import render_image

ABOUT = (
    "Written by `python -m benchmarks.extraction DATA`. *IoU* is that of the object's silhouette (half "
    "opaque) and the true one, mean and worst of the views whose masks were not given; *together* is the "
    "PSNR of object and rest, composed, against the field before, over whole 8-bit pictures; *seconds* are "
    "those of the whole command; *rim* is the mean difference of colours, of 255, within three pixels of the "
    "true silhouette, over white, of the chair cut out of a red table and the chair alone."
)
SCENE = {"chair": ("0,0,0", "1"), "fuze": ("1.6,0.2,-0.55", "6"), "other": ("-1.4,0.9,-0.2", "0.6")}
VIEWS = 12
SIDE = 400


def silhouettes(path: Path, views) -> list[np.ndarray]:
    """(H, W) opacity of a bundle in each view."""
    field, origin = renderable(load_scene(str(path)))
    return [render_image(field, camera, origin=origin).opacity for camera in views]


def agreement(found: list[np.ndarray], true: list[np.ndarray]) -> np.ndarray:
    """(V,) intersection over union."""
    return np.array(
        [((f > 0.5) & t).sum() / max(((f > 0.5) | t).sum(), 1) for f, t in zip(found, true, strict=True)]
    )


def together(folder: Path, field: str, views) -> float:
    """PSNR of object.rfpack and rest.rfpack, composed, against a field."""
    fusedrf(folder, "compose", "object.rfpack", "rest.rfpack", "-o", "both.json")
    write_cameras(folder / "looks.json", views)
    shots = []
    for name in (field, "both.json"):
        fusedrf(folder, "render", name, "--cameras", "looks.json", "-o", "looks")
        shots.append([np.array(Image.open(path)) / 255 for path in sorted((folder / "looks").iterdir())])
    return psnr(np.array(shots[0]), np.array(shots[1]))


def row(folder: Path, what: str, field: str, words: list[str], views, true) -> dict:
    """Cut an object out, and measure it."""
    tell(what)
    started = time.monotonic()
    said = fusedrf(folder, "extract", field, *words, "-o", "object.rfpack")
    seconds = time.monotonic() - started
    fusedrf(folder, "extract", field, *words, "--invert", "-o", "rest.rfpack")
    scores = agreement(silhouettes(folder / "object.rfpack", views), true)
    found = {
        "what": what,
        "IoU": f"{scores.mean():.3f}",
        "worst": f"{scores.min():.3f}",
        "together, dB": f"{together(folder, field, views[:3]):.1f}",
        "seconds": f"{seconds:.1f}",
        "MB": f"{said['bytes'] / 1e6:.2f}",
        "sure": said.get("sure", ""),
        "rim": "",
    }
    tell(str(found))
    return found


def tankard(folder: Path, data: Path, seconds: float) -> dict:
    """Out of its own photos, learnt with all that they show."""
    source = folder / "tankard"
    if not source.exists():
        shutil.copytree(data / "tankard", source)
        spec = json.loads((source / "transforms.json").read_text())
        for frame in spec["frames"]:
            frame.pop("mask_path", None)
        (source / "transforms.json").write_text(json.dumps(spec))
    if not (folder / "tankard.rfpack").exists():
        fusedrf(folder, "train", "tankard", "-o", "tankard.rfpack", "--time-budget", str(seconds))
    views = read_cameras(source / "transforms.json")
    given = [int(i) for i in np.linspace(0, len(views), 5, endpoint=False)]
    masks = folder / "tankard_masks"
    shutil.rmtree(masks, ignore_errors=True)
    masks.mkdir()
    for i in given:
        shutil.copy(source / "masks" / f"{views[i].name}.png", masks)
    rest = [view for i, view in enumerate(views) if i not in given][::4]
    true = [np.array(Image.open(source / "masks" / f"{view.name}.png").convert("L")) > 127 for view in rest]
    cameras = [camera_of(view) for view in rest]
    return row(folder, "tankard, 5 masks", "tankard.rfpack", ["--masks", "tankard_masks"], cameras, true)


def composed(folder: Path, data: Path, seconds: float) -> list[dict]:
    """Objects of a scene of known truth, fused as blocks, by masks and by a box and points."""
    for name, source in {"chair": "chair", "fuze": "fuze/fuze.obj"}.items():
        if not (folder / f"{name}.rfpack").exists():
            fusedrf(
                folder, "train", str(data / source), "-o", f"{name}.rfpack", "--time-budget", str(seconds)
            )
    words = []
    for name, (at, size) in SCENE.items():
        words += [f"{'chair' if name == 'other' else name}.rfpack", "--name", name, "-t", at, "-s", size]
    fusedrf(folder, "compose", *words, "-o", "scene.json")
    for kind in ("vm", "sparse"):
        if not (folder / f"{kind}.rfpack").exists():
            fusedrf(
                folder, "fuse", "scene.json", "--kind", kind, "-o", f"{kind}.rfpack", "--time-budget", "30"
            )
    scene = load_scene(str(folder / "scene.json"))
    lens = framing_lens(SIDE, SIDE)
    box = np.concatenate([[-2.2, -1.5, -1.1], [2.2, 1.8, 1.1]])
    rng, cameras = np.random.default_rng(4), []
    for i in range(VIEWS):
        outlook = framing(box, lens, 2 * np.pi * i / VIEWS, rng.uniform(0.1, 1.0))
        cameras.append(outlook.camera(lens, name=f"v{i:02d}"))
    write_cameras(folder / "cameras.json", cameras)
    rows = []
    for placed in scene.placed:
        alone = {p.name: masks_of(scene, p.name, cameras) for p in scene.placed}[placed.name]
        masks = folder / f"{placed.name}_masks"
        shutil.rmtree(masks, ignore_errors=True)
        masks.mkdir()
        given = [0, 4, 8]
        for i in given:
            Image.fromarray(255 * alone[i][1].astype(np.uint8)).save(masks / f"v{i:02d}.png")
        rest = [i for i in range(VIEWS) if i not in given]
        views, true = [cameras[i] for i in rest], [alone[i][0] for i in rest]
        common = ["--cameras", "cameras.json"]
        for kind in ("vm", "sparse"):
            told = ["--masks", masks.name, *common]
            rows.append(row(folder, f"{placed.name} of {kind}, 3 masks", f"{kind}.rfpack", told, views, true))
        told = [*box_of(placed), *points_of(alone, given), *common]
        rows.append(row(folder, f"{placed.name} of vm, box and 6 points", "vm.rfpack", told, views, true))
    return rows


def red_table(folder: Path) -> dict:
    """A chair whose feet stand in a red slab, fused to one tensor with it and cut out again."""
    if not (folder / "slab.rfpack").exists():
        slab = trimesh.creation.box((2.4, 2.4, 0.3))
        slab.visual.face_colors = [200, 20, 20, 255]
        slab.export(folder / "slab.ply")
        fusedrf(folder, "train", "slab.ply", "-o", "slab.rfpack", "--time-budget", "15")
    chair = load_scene(str(folder / "chair.rfpack"))
    top = f"0,0,{chair.placed[0].aabb[2] - 0.13:.4f}"
    fusedrf(folder, "compose", "slab.rfpack", "-t", top, "chair.rfpack", "-o", "red.json")
    if not (folder / "red.rfpack").exists():
        words = ("--kind", "vm", "-o", "red.rfpack", "--time-budget", "30")
        fusedrf(folder, "fuse", "red.json", *words)
    lens, box = framing_lens(SIDE, SIDE), np.repeat([-1.2, 1.2], 3)
    outlooks = [framing(box, lens, 2 * np.pi * i / VIEWS, 0.25 + 0.5 * (i % 3)) for i in range(VIEWS)]
    cameras = [outlook.camera(lens, name=f"v{i:02d}") for i, outlook in enumerate(outlooks)]
    write_cameras(folder / "cameras.json", cameras)
    seen = masks_of(load_scene(str(folder / "red.json")), "chair", cameras)
    shutil.rmtree(folder / "red_masks", ignore_errors=True)
    (folder / "red_masks").mkdir()
    given = [0, 4, 8]
    for i in given:
        Image.fromarray(255 * seen[i][1].astype(np.uint8)).save(folder / "red_masks" / f"v{i:02d}.png")
    rest = [i for i in range(VIEWS) if i not in given]
    words = ["--masks", "red_masks", "--cameras", "cameras.json"]
    views, true = [cameras[i] for i in rest], [seen[i][0] for i in rest]
    found = row(folder, "chair of a red table, vm, 3 masks", "red.rfpack", words, views, true)
    return found | {"rim": f"{rim(folder, views, true):.1f}"}


def rim(folder: Path, views, true) -> float:
    """The mean difference of colours, of 255, of object.rfpack and chair.rfpack near the chair's outline."""
    pair = [renderable(load_scene(str(folder / name))) for name in ("object.rfpack", "chair.rfpack")]
    found = []
    for view, inside in zip(views, true, strict=True):
        one, other = (render_image(field, view, origin=origin).over((1, 1, 1)) for field, origin in pair)
        band = binary_dilation(inside, iterations=2) & ~binary_erosion(inside, iterations=3)
        found.append(255 * np.abs(one - other).mean(-1)[band].mean())
    return float(np.mean(found))


def masks_of(scene, name: str, cameras) -> list[tuple[np.ndarray, np.ndarray]]:
    """For each camera what an object covers, and what of it is seen."""
    found = []
    for camera in cameras:
        shots = {}
        for p in scene.placed:
            pose = camera.seen_from(p.object_to_world)
            shots[p.name] = render_image(p.field, pose), np.cbrt(np.linalg.det(p.object_to_world[:3, :3]))
        own, size = shots[name]
        covers, depth = own.opacity > 0.5, own.depth * size
        nearer = [s.opacity > 0.5 for other, (s, _) in shots.items() if other != name]
        depths = [s.depth * k for other, (s, k) in shots.items() if other != name]
        hidden = np.any([n & (d < depth) for n, d in zip(nearer, depths, strict=True)], 0)
        found.append((covers, covers & ~hidden))
    return found


def box_of(placed) -> list[str]:
    """--box around an object, a twentieth wider."""
    box = placed.aabb
    margin = 0.05 * (box[3:] - box[:3]).max()
    grown = [*(box[:3] - margin), *(box[3:] + margin)]
    return ["--box", ",".join(f"{x:.4f}" for x in grown)]


def points_of(alone, given: list[int]) -> list[str]:
    """Six --points, two in each of three views, in the parts of what is seen that lie deepest within."""
    from scipy.ndimage import distance_transform_edt

    words = []
    for i in given:
        within = distance_transform_edt(alone[i][1])
        for _ in range(2):
            y, x = np.unravel_index(within.argmax(), within.shape)
            words += ["--points", f"v{i:02d}:{x + 0.5},{y + 0.5}"]
            within[max(0, y - 15) : y + 15, max(0, x - 15) : x + 15] = 0
    return words


def write_cameras(path: Path, cameras) -> None:
    """A transforms.json."""
    frames = [{"file_path": f"{c.name}.png", "transform_matrix": c.camera_to_world.tolist()} for c in cameras]
    first = cameras[0]
    spec = {"w": first.width, "h": first.height, "fl_x": first.fl_x, "fl_y": first.fl_y, "frames": frames}
    path.write_text(json.dumps(spec))


def main() -> None:
    """Train, cut out, measure, and write the page."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.extraction", description=__doc__)
    parser.add_argument("data", type=Path)
    parser.add_argument("--out", type=Path, default=Path(__file__).parents[1] / "docs" / "real")
    parser.add_argument("--share", type=float, default=1.0, help="of the seconds of learning")
    parser.add_argument("--keep", type=Path, help="a folder in which fields are kept")
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = (asked.keep or Path(name)).resolve()
        folder.mkdir(parents=True, exist_ok=True)
        data = asked.data.resolve()
        rows = [tankard(folder, data, 90 * asked.share), *composed(folder, data, 40 * asked.share)]
        rows.append(red_table(folder))
    text = f"# Objects cut out of fields\n\n{ABOUT}\n\n{markdown(rows)}"
    (asked.out / "extraction.md").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
