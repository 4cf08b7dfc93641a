"""PSNR and SSIM of every kind of fused field: with and without RGB finishing, by seed, and close up."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.paper.sources import TINY, four_objects, with_a_tiny_one
from benchmarks.paper.work import SIZES, FusedConfig, Work, course, fusedrf, tell, write_csv
from fusedrf_cli.engine.settings import current


@dataclass(frozen=True)
class QualityConfig:
    """How fused fields are compared."""

    size: int = 400
    """Pixels a side."""
    seeds: int = 5
    fewer: tuple[int, ...] = (5_000_000, 2_000_000)
    """Bytes."""


def kinds(work: Work) -> dict[str, str]:
    """Write kinds.csv; the figures of the table."""
    scene = four_objects(work)
    held, rows = course(scene, current(QualityConfig).size), []
    for kind in current(FusedConfig).kinds:
        for rgb in ("--no-finetune", "--finetune"):
            found, seconds = fused(held, scene, kind, rgb)
            rows.append({"kind": kind, "rgb": rgb == "--finetune"} | found | {"seconds": seconds})
            write_csv(work.out / "kinds.csv", rows)
    return {
        "points": listed({r["kind"]: r["psnr"] for r in rows if not r["rgb"]}),
        "pictures": listed({r["kind"]: r["psnr"] for r in rows if r["rgb"]}),
    }


def seeds(work: Work) -> dict[str, str]:
    """Write seeds.csv; the figures of the table."""
    config = current(QualityConfig)
    scene = four_objects(work)
    held, rows = course(scene, config.size // 2), []
    drawn = [kind for kind in current(FusedConfig).kinds if kind not in SIZES]
    for kind in drawn:
        for seed in range(config.seeds):
            rows.append({"kind": kind, "seed": seed} | fused(held, scene, kind, "--seed", str(seed))[0])
            write_csv(work.out / "seeds.csv", rows)
    spread = {k: float(np.ptp([r["psnr"] for r in rows if r["kind"] == k])) for k in drawn}
    return {"seeds": listed(spread, digits=2)}


def sizes(work: Work) -> dict[str, str]:
    """Write sizes.csv."""
    config = current(QualityConfig)
    scene = four_objects(work)
    held, rows = course(scene, config.size), []
    for limit in config.fewer:
        found, seconds = fused(held, scene, "blocks", most=limit)
        rows.append({"at most": limit} | found | {"seconds": seconds})
        write_csv(work.out / "sizes.csv", rows)
    return {}


def closeup(work: Work) -> dict[str, str]:
    """Write closeup.csv; the figures of the table."""
    config = current(QualityConfig)
    scene, box = with_a_tiny_one(work)
    held, whole, rows = course(scene, config.size, box), course(scene, config.size), []
    for kind in current(FusedConfig).kinds:
        found, _ = fused(held, scene, kind)
        found["psnr of the whole"] = whole.quality(bundle_of(scene, kind))["psnr"]
        rows.append({"kind": kind, "units tall": TINY} | found)
        write_csv(work.out / "closeup.csv", rows)
    return {"closeup": listed({r["kind"]: r["psnr"] for r in rows})}


def bundle_of(scene: Path, kind: str) -> Path:
    """Where a scene's fused field of a kind is written."""
    return scene.with_name(f"{scene.stem}_{kind}.rfpack")


def fused(held, scene: Path, kind: str, *words: str, most: int | None = None) -> tuple[dict, float]:
    """Fuse a scene to a kind of at most so many bytes (default: FusedConfig's), and hold it to views: the
    row, and seconds."""
    most = most or current(FusedConfig).most_bytes
    tell(f"{scene.stem}: {kind} {' '.join(words)}")
    path = bundle_of(scene, kind)
    line = ("--kind", kind, "--max-size", str(SIZES.get(kind, most)), *words)
    report = fusedrf(scene.parent, "fuse", scene.name, "-o", path.name, *line)
    found = {"covered share": held.covered_share, **held.quality(path), "bytes": report["bytes"]}
    return found, report["total_seconds"]


def listed(values: dict[str, float], digits: int = 1) -> str:
    """blocks 52.0, vm 36.5 dB."""
    return ", ".join(f"{name} {value:.{digits}f}" for name, value in values.items()) + " dB"
