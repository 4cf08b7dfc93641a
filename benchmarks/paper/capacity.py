"""Composing ever more fields, naive and fused: memory, bytes, time per frame, and what a fixed size holds."""

from dataclasses import dataclass, replace
from pathlib import Path

from benchmarks.paper import figures
from benchmarks.paper.sources import things_on_ground
from benchmarks.paper.work import FusedConfig, Work, course, frame_times, fusedrf, peak_of, tell, write_csv
from fusedrf_cli.bridge.charting import Benchmark, frame_seconds
from fusedrf_cli.bridge.scene import load_scene
from fusedrf_cli.engine.rendering.cameras import framing_camera
from fusedrf_cli.engine.settings import current


@dataclass(frozen=True)
class CapacityConfig:
    """How many things are fused, and how they are compared."""

    counts: tuple[int, ...] = (1, 2, 4, 8, 16, 32)
    compared: int = 200
    """Pixels a side of the pictures compared."""
    frame: int = 400
    """Pixels a side of the frames timed."""
    measured_at: int = 8
    limits: tuple[tuple[str, int], ...] = (("25MB", FusedConfig.most_bytes),)
    """Sizes that are asked for, as the command takes them, and bytes."""


def capacity(work: Work) -> dict[str, str]:
    """Write capacity.csv and capacity.svg; the figures of the table."""
    config = current(CapacityConfig)
    rows: list[dict] = []
    for count in config.counts:
        rows += of_count(work, count)
        write_csv(work.out / "capacity.csv", rows)
        figures.capacity(rows, work.out / "capacity.svg")
    wide = {row["n"]: row for row in rows if row["limit"] == "25MB"}
    at = wide[config.measured_at]
    return {
        "flat": f"{at['fused ms'] / at['ms at n = 1']:.2f}",
        "naive over fused": f"{at['naive ms'] / at['fused ms']:.1f}×",
        "capacity": ", ".join(f"{row['psnr']:.1f}" for row in wide.values()) + " dB",
    }


def of_count(work: Work, count: int) -> list[dict]:
    """The rows of so many things, one for each of the limits."""
    config = current(CapacityConfig)
    scene = things_on_ground(work, count)
    tell(f"capacity: {count} things")
    bundles = {limit: work.folder / f"{scene.stem}_{limit}.rfpack" for limit, _ in config.limits}
    reports = {
        limit: fusedrf(work.folder, "fuse", scene.name, "-o", path.name, "--max-size", limit)
        for limit, path in bundles.items()
    }
    alone = work.folder / f"things_{config.counts[0]:02d}_25MB.rfpack"
    held = course(scene, config.compared)
    framed = replace(held, size=(config.frame, config.frame))
    _, one, *fused = frame_times(framed, [alone, *bundles.values()])
    naive = naive_ms(framed)
    naive_peak = peak_of(scene, config.frame)
    rows = []
    for (limit, path), ms in zip(bundles.items(), fused, strict=True):
        rows.append(
            {
                "n": count,
                "limit": limit,
                "kind": reports[limit]["kind"],
                **held.quality(path),
                "bytes": within(path, dict(config.limits)[limit]),
                "source bytes": held.source_bytes,
                "seconds": reports[limit]["total_seconds"],
                "fused ms": ms,
                "naive ms": naive,
                "ms at n = 1": one,
                "fused peak bytes": peak_of(path, config.frame),
                "naive peak bytes": naive_peak,
            }
        )
    return rows


def naive_ms(held: Benchmark) -> float:
    """Milliseconds of one frame of the naive composition."""
    naive = load_scene(held.scene).composed()
    return 1000 * frame_seconds(naive, framing_camera(held.box, 0.9, 0.45, *held.size), naive.origin)


def within(path: Path, limit: int) -> int:
    """Bytes of a bundle, which its limit has to hold."""
    size = path.stat().st_size
    if size > limit:
        raise RuntimeError(f"{path}: {size} bytes, though {limit} were the most")
    return size
