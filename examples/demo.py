"""The whole tool in one go: python examples/demo.py [FOLDER]

Makes a scene from nothing, trains its objects, composes, fuses, adds, deletes and renders, by the same
commands a person types.
Everything lands in FOLDER (default: demo-out), with a report in report.md.
"""

import json
import subprocess
import sys
import time
from pathlib import Path

HERE = Path(__file__).parent
DRAFT = ["--quality", "draft", "--time-budget", "20", "--views", "50", "--size", "200", "--overwrite"]
TRAINED = ("ground", "tower", "ball")
STAND = 0.06  # height of the ground's top


def fusedrf(folder: Path, *words: str) -> dict:
    """Run one command in the folder, show it, and return its JSON report; a failure ends the demo with the
    command's exit code.
    """
    print("$ fusedrf", *words, flush=True)
    done = subprocess.run(
        [sys.executable, "-m", "fusedrf_cli", *words, "--json"], cwd=folder, stdout=subprocess.PIPE, text=True
    )
    if done.returncode:
        sys.exit(done.returncode)
    return json.loads(done.stdout)


def train_all(folder: Path) -> dict[str, dict]:
    """Every mesh to a field."""
    return {name: fusedrf(folder, "train", f"{name}.glb", "-o", f"{name}.rfpack", *DRAFT) for name in TRAINED}


def build(folder: Path) -> dict[str, dict]:
    """Compose ground and two towers, fuse both ways, add the ball, delete a tower, render each step."""
    reports = {}
    place = ["ground.rfpack", "--background-node", "tower.rfpack", "-t", f"-0.8,0.4,{STAND}"]
    place += ["tower.rfpack", "--name", "small-tower", "-t", f"0.9,0.8,{STAND}", "-s", "0.5", "-r", "0,0,40"]
    reports["compose"] = fusedrf(folder, "compose", *place, "-o", "scene.json", "--overwrite")
    reports["fuse"] = fusedrf(folder, "fuse", "scene.json", "-o", "fused.rfpack", "--overwrite")
    words = [
        "add",
        "fused.rfpack",
        "ball.rfpack",
        "--name",
        "ball",
        "-t",
        f"0.6,-0.7,{STAND}",
        "-s",
        "0.8",
        "-o",
        "more.rfpack",
    ]
    reports["add"] = fusedrf(folder, *words, "--overwrite")
    reports["delete"] = fusedrf(folder, "delete", "more.rfpack", "tower", "-o", "less.rfpack", "--overwrite")
    for name in ("scene.json", "fused.rfpack", "more.rfpack", "less.rfpack"):
        picture = f"{Path(name).stem}.png"
        reports[picture] = fusedrf(folder, "render", name, "-o", picture, "--size", "400x400", "--overwrite")
    reports["turn.gif"] = fusedrf(
        folder,
        "render",
        "more.rfpack",
        "--orbit",
        "12",
        "--size",
        "240x240",
        "--fps",
        "8",
        "-o",
        "turn.gif",
        "--overwrite",
    )
    reports["eval"] = fusedrf(folder, "eval", "fused.rfpack", "--against", "scene.json", "--size", "160x160")
    return reports


def write_report(folder: Path, trained: dict[str, dict], built: dict[str, dict], seconds: float) -> None:
    """What came out, as a page of Markdown."""
    fuse, mean = built["fuse"], built["eval"]["mean"]
    lines = [
        "# What the demo made",
        "",
        f"All of it took {seconds:.0f} s.",
        "",
        "| field | bytes | training PSNR, dB |",
        "|---|---|---|",
    ]
    lines += [f"| {name} | {r['bytes']:,} | {r['training_psnr']:.1f} |" for name, r in trained.items()]
    lines += [
        "",
        f"Fused ({fuse['kind']}): {fuse['bytes']:,} bytes from {fuse['source_bytes']:,} bytes of sources.",
    ]
    lines += [
        f"Against the composed scene, on views of its own: PSNR {mean['psnr']:.2f} dB, SSIM "
        f"{mean['ssim']:.4f}.",
        "",
    ]
    for name, text in {
        "scene.png": "composed",
        "fused.png": "fused into one bundle",
        "more.png": "a ball added",
        "less.png": "the large tower deleted",
        "turn.gif": "a turn around it",
    }.items():
        lines += [f"![{text}]({name})", f"*{name}: {text}*", ""]
    (folder / "report.md").write_text("\n".join(lines))


def main() -> None:
    """Make the scene and run it all."""
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else "demo-out")
    started = time.monotonic()
    folder.mkdir(parents=True, exist_ok=True)
    subprocess.run([sys.executable, str(HERE / "make_scene.py"), str(folder)], check=True)
    trained = train_all(folder)
    built = build(folder)
    write_report(folder, trained, built, time.monotonic() - started)
    print(f"pictures and report: {folder.resolve()}/report.md")


if __name__ == "__main__":
    main()
