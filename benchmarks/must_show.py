"""End-to-end figures on real captures: python -m benchmarks.must_show DATA [FOLDER] [--vm]

DATA holds chair/ (NeRF-Synthetic layout) and fuze/fuze.obj. Prints a table of: the chair's test PSNR; a
scene of chair, small chair,
bottle and ground fused by blocks (and with --vm by one distilled tensor) against composed, its bytes, and
its time per frame against
that of one of its fields; what add then delete changes outside the object's box; and whether a seed gives
the same bytes twice.
"""

import json
import statistics
import subprocess
import sys
import time
from pathlib import Path

from formats.bundle import read_bundle, sha256_of
from fusedrf_cli.bridge.scene import load_scene, make_field
from fusedrf_cli.engine.rendering.cameras import framing_camera
from fusedrf_cli.engine.rendering.metrics import psnr
from fusedrf_cli.engine.rendering.volume import render_image

PLACES = [
    {"name": "ground", "source": "ground.rfpack", "background": True},
    {
        "name": "chair",
        "source": "chair.rfpack",
        "translation": [-0.6, 0.3, 0.74],
        "rotation": [0, 0, 0.2588190451, 0.9659258263],
        "scale": [0.7, 0.7, 0.7],
    },
    {
        "name": "small",
        "source": "chair.rfpack",
        "translation": [0.6, -0.9, 0.40],
        "rotation": [0, 0, 0.7071067812, 0.7071067812],
        "scale": [0.35, 0.35, 0.35],
    },
    {"name": "bottle", "source": "bottle.rfpack", "translation": [0.9, 0.7, 0.06], "scale": [4, 4, 4]},
]
WHITE = (1.0, 1.0, 1.0)


def fusedrf(folder: Path, *words: str) -> dict:
    """One command's JSON report."""
    done = subprocess.run(
        [sys.executable, "-m", "fusedrf_cli", *words, "--json", "-w"]
        if words[0] != "eval"
        else [sys.executable, "-m", "fusedrf_cli", *words, "--json"],
        cwd=folder,
        stdout=subprocess.PIPE,
        text=True,
        check=True,
    )
    return json.loads(done.stdout)


def train_all(data: Path, folder: Path) -> dict:
    """Train the three sources unless they are there; the chair's figures on its test views."""
    scene = Path(__file__).parent.parent / "examples" / "make_scene.py"
    if not (folder / "chair.rfpack").exists():
        fusedrf(folder, "train", str(data / "chair"), "-o", "chair.rfpack", "--quality", "high")
    if not (folder / "bottle.rfpack").exists():
        fusedrf(folder, "train", str(data / "fuze" / "fuze.obj"), "-o", "bottle.rfpack")
    if not (folder / "ground.rfpack").exists():
        subprocess.run([sys.executable, str(scene), str(folder)], check=True, stdout=subprocess.DEVNULL)
        fusedrf(folder, "train", "ground.glb", "-o", "ground.rfpack", "--max-size", "6MB")
    return fusedrf(folder, "eval", "chair.rfpack", "--against", str(data / "chair"))["mean"]


def field_of(path: Path):
    """The one field of a bundle."""
    bundle = read_bundle(path)
    return make_field(next(iter(bundle.fields.values())), str(path))


def frame_times(folder: Path, fused: str, size: int = 800, repeats: int = 5) -> tuple[float, float, float]:
    """Median seconds of a frame of the fused scene, of its slowest field alone, and of the composed scene
    (one run), each framed alike.
    """
    fields = [
        field_of(folder / fused),
        *(field_of(folder / f"{n}.rfpack") for n in ("ground", "chair", "bottle")),
    ]
    medians = []
    for field in fields:
        camera = framing_camera(field.occupancy.tight_aabb(0), 0.9, 0.45, size, size)
        render_image(field, camera)
        seconds = []
        for _ in range(repeats):
            started = time.perf_counter()
            render_image(field, camera)
            seconds.append(time.perf_counter() - started)
        medians.append(statistics.median(seconds))
    composed = load_scene(str(folder / "scene.json")).composed()
    started = time.perf_counter()
    render_image(composed, framing_camera(composed.occupancy.tight_aabb(0), 0.9, 0.45, size, size))
    return medians[0], max(medians[1:]), time.perf_counter() - started


def add_delete_change(folder: Path, fused: str) -> float:
    """PSNR, outside the object's silhouette, of the scene before an object was added and after it was added
    and deleted again.
    """
    words = ["--name", "guest", "-t", "-0.9,-0.9,0.06", "-s", "3"]
    fusedrf(folder, "add", fused, "bottle.rfpack", *words, "-o", "added.rfpack")
    fusedrf(folder, "delete", "added.rfpack", "guest", "-o", "again.rfpack")
    before, after = field_of(folder / fused), field_of(folder / "again.rfpack")
    camera = framing_camera(before.occupancy.tight_aabb(0), 0.9, 0.45, 400, 400)
    return psnr(render_image(before, camera).over(WHITE), render_image(after, camera).over(WHITE))


def main() -> None:
    """Measure and print the table."""
    data, folder = (
        Path(sys.argv[1]).resolve(),
        Path(sys.argv[2] if len(sys.argv) > 2 else "must-show").resolve(),
    )
    folder.mkdir(parents=True, exist_ok=True)
    chair = train_all(data, folder)
    print(f"| chair, 20 test views | {chair['psnr']:.2f} dB, SSIM {chair['ssim']:.4f} |")
    scene = {"format": "rfpack", "version": "1.0", "composition": "max", "nodes": PLACES}
    (folder / "scene.json").write_text(json.dumps(scene))
    for kind in ["blocks", "vm"] if "--vm" in sys.argv else ["blocks"]:
        report = fusedrf(folder, "fuse", "scene.json", "-o", f"{kind}.rfpack", "--kind", kind)
        mean = fusedrf(folder, "eval", f"{kind}.rfpack", "--against", "scene.json", "--size", "300x300")[
            "mean"
        ]
        seconds = {k: round(v, 1) for k, v in report["seconds"].items()}
        print(
            f"| fused ({kind}) against composed, 8 views of its own | {mean['psnr']:.2f} dB, SSIM "
            f"{mean['ssim']:.4f}; {report['psnr']} |"
        )
        print(f"| bytes; seconds | {report['bytes']:,}; {seconds} |")
        fused, alone, naive = frame_times(folder, f"{kind}.rfpack")
        print(
            f"| 800x800 frame: fused / slowest field alone; naive / fused | {fused / alone:.2f}; "
            f"{naive / fused:.1f} ({fused:.2f} s) |"
        )
    print(
        "| add then delete: PSNR of after against before | "
        f"{add_delete_change(folder, 'blocks.rfpack'):.1f} dB |"
    )
    first = sha256_of(folder / "blocks.rfpack")
    fusedrf(folder, "fuse", "scene.json", "-o", "blocks.rfpack", "--kind", "blocks")
    draft = [fusedrf_train_hash(folder) for _ in range(2)]
    print(
        f"| same seed, same bytes | fuse {first == sha256_of(folder / 'blocks.rfpack')}, train "
        f"{draft[0] == draft[1]} |"
    )


def fusedrf_train_hash(folder: Path) -> str:
    """Checksum of a short training run."""
    fusedrf(
        folder,
        "train",
        "ground.glb",
        "-o",
        "same.rfpack",
        "--quality",
        "draft",
        "--views",
        "20",
        "--size",
        "100",
        "--max-size",
        "300kB",
    )
    return sha256_of(folder / "same.rfpack")


if __name__ == "__main__":
    main()
