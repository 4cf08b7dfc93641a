"""A capture with faults put into it: python -m benchmarks.spoiled CAPTURE [--seconds 40] [--pixels 4]

CAPTURE is a folder with a transforms.json and photos. Every eighth photo is held out and stays as it is; of
the others the exposure and white balance drift, or the poses are off by so many pixels. A table on stdout
says what is reached, with poses refined and without.
"""

import argparse
import json
import shutil
import tempfile
from pathlib import Path

import numpy as np

from benchmarks.paper.table import markdown
from benchmarks.paper.work import fusedrf, tell
from formats.captures import hold_out, read_capture
from formats.images import read_image, write_png
from fusedrf_cli.engine.distillation.poses import turns

EVERY = 8
PERIOD = 17  # photos, after which the exposure is as it was
DRIFT = 0.2  # natural logarithm of the largest gain


def drifting(folder: Path, frames: list[dict], shown: set[str]) -> None:
    """Multiply the photos that are learnt from by gains that drift, each channel's a little later."""
    for number, frame in enumerate(frames):
        path = folder / frame["file_path"]
        if path.stem not in shown or not path.exists():
            continue
        gains = np.exp(DRIFT * np.sin(2 * np.pi * (number / PERIOD + np.array([0, 0.1, 0.2]))))
        pixels = np.rint(np.clip(read_image(path)[..., :3] * gains, 0, 255)).astype(np.uint8)
        write_png(path.with_suffix(".png"), pixels)
        frame["file_path"] = str(Path(frame["file_path"]).with_suffix(".png"))


def shaken(frames: list[dict], shown: set[str], focal: float, pixels: float) -> None:
    """Turn the cameras that are learnt from about all axes by so many pixels in all, and move them by as much
    of their distance from the middle of all cameras."""
    g = np.random.default_rng(0)
    poses = [np.array(frame["transform_matrix"], float) for frame in frames]
    middle = np.mean([pose[:3, 3] for pose in poses], 0)
    for frame, pose in zip(frames, poses, strict=True):
        if Path(frame["file_path"]).stem in shown:
            angles = g.normal(0, pixels / focal / np.sqrt(3), (2, 3))
            pose[:3, :3] = turns(angles[:1])[0] @ pose[:3, :3]
            pose[:3, 3] += angles[1] * np.linalg.norm(pose[:3, 3] - middle)
            frame["transform_matrix"] = pose.tolist()


def row(folder: Path, name: str, seconds: float, *words: str) -> dict:
    """Train on a capture and say what was reached."""
    tell(name)
    asked = ("--holdout", str(EVERY), "--time-budget", str(seconds), *words)
    report = fusedrf(folder, "train", str(folder.resolve()), "-o", str(folder / "field.rfpack"), *asked)
    held = report["holdout"]
    aligned = held.get("aligned")
    return {
        "capture": name,
        "steps": report["steps"],
        "training": f"{report['training_psnr']:.2f}",
        "PSNR": f"{held['psnr']:.2f}",
        "aligned": f"{aligned['psnr']:.2f}" if aligned else "",
    }


def main() -> None:
    """Spoil copies of a capture, and learn from each."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.spoiled", description=__doc__)
    parser.add_argument("capture", type=Path)
    parser.add_argument("--seconds", type=float, default=40)
    parser.add_argument("--pixels", type=float, default=4)
    asked = parser.parse_args()
    capture = hold_out(read_capture(asked.capture), EVERY)
    shown, focal = {view.name for view in capture.train}, capture.train[0].fl_x
    rows = []
    with tempfile.TemporaryDirectory() as name:

        def copy(part: str) -> tuple[Path, dict]:
            folder = Path(shutil.copytree(asked.capture, Path(name) / part))
            return folder, json.loads((folder / "transforms.json").read_text())

        for part, spoil in (
            ("as it is", lambda folder, frames: None),
            ("exposure drifts", lambda folder, frames: drifting(folder, frames, shown)),
            ("poses off", lambda folder, frames: shaken(frames, shown, focal, asked.pixels)),
        ):
            folder, content = copy(part)
            spoil(folder, content["frames"])
            (folder / "transforms.json").write_text(json.dumps(content))
            rows.append(row(folder, part, asked.seconds))
            if part != "exposure drifts":
                rows.append(row(folder, f"{part}, --refine-poses", asked.seconds, "--refine-poses"))
    print(markdown(rows))


if __name__ == "__main__":
    main()
