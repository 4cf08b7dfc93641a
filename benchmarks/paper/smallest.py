"""The smallest bundle at a PSNR: on the chart, and as `fuse --target-psnr` finds it."""

import shutil
from dataclasses import dataclass

from benchmarks.paper.sources import four_objects
from benchmarks.paper.work import Work, course, fusedrf, tell, write_csv
from fusedrf_cli.engine.settings import current
from fusedrf_cli.report import readable_size

WANTED = 40.0  # dB
BUDGET = 600


@dataclass(frozen=True)
class SmallestConfig:
    """How the smallest bundle is looked for."""

    size: int = 400


def smallest(work: Work) -> dict[str, str]:
    """Write smallest.csv and the chart; the figures of the table."""
    scene = four_objects(work)
    tell("smallest: the chart")
    report = fusedrf(scene.parent, "chart", scene.name, "-o", "chart", "--budget", str(BUDGET))
    for name in ("chart.csv", "chart.svg"):
        shutil.copy(scene.parent / "chart" / name, work.out / name)
    enough = [p for p in report["points"] if p["psnr"] >= WANTED]
    tell("smallest: the search")
    words = ("-o", "target.rfpack", "--target-psnr", f"{WANTED:g}")
    found = fusedrf(scene.parent, "fuse", scene.name, *words)
    held = course(scene, current(SmallestConfig).size).quality(scene.with_name("target.rfpack"))
    row = {"by": "search", "flags": " ".join(words[2:]), "psnr": held["psnr"], "covered": held["covered"]}
    rows = [row | {"bytes": found["bytes"], "seconds": found["total_seconds"]}]
    if not enough:
        write_csv(work.out / "smallest.csv", rows)
        return {"picked": f"no point of the chart reaches {WANTED:g} dB", "smallest": "none"}
    best = min(enough, key=lambda p: p["bytes"])
    rows.insert(0, {"by": "chart", **{k: best[k] for k in ("flags", "psnr", "covered", "bytes", "seconds")}})
    write_csv(work.out / "smallest.csv", rows)
    return {
        "picked": f"{found['bytes'] / best['bytes']:.2f} ({held['psnr']:.1f} dB)",
        "smallest": f"{readable_size(best['bytes'])} ({best['psnr']:.1f} dB)",
    }
