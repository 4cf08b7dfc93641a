"""Composing ever more fields, naive and fused: memory, bytes, time per frame, and what a fixed size holds."""

from dataclasses import replace
from pathlib import Path

from benchmarks.paper import figures
from benchmarks.paper.sources import things_on_ground
from benchmarks.paper.work import MOST_BYTES, Work, course, frame_times, fusedrf, peak_of, tell, write_csv
from fusedrf_cli.bridge.charting import Benchmark, frame_seconds
from fusedrf_cli.bridge.scene import load_scene
from fusedrf_cli.engine.rendering.cameras import framing_camera

COUNTS = (1, 2, 4, 8, 16, 32)
LIMITS = {"25MB": MOST_BYTES}
COMPARED, FRAME = 200, 400  # pixels a side: of the pictures compared, of the frames timed
MEASURED_AT = 8


def capacity(work: Work) -> dict[str, str]:
    """Write capacity.csv and capacity.svg; the figures of the table."""
    rows: list[dict] = []
    for count in COUNTS:
        rows += of_count(work, count)
        write_csv(work.out / "capacity.csv", rows)
        figures.capacity(rows, work.out / "capacity.svg")
    wide = {row["n"]: row for row in rows if row["limit"] == "25MB"}
    at = wide[MEASURED_AT]
    return {
        "flat": f"{at['fused ms'] / at['ms at n = 1']:.2f}",
        "naive over fused": f"{at['naive ms'] / at['fused ms']:.1f}×",
        "capacity": ", ".join(f"{row['psnr']:.1f}" for row in wide.values()) + " dB",
    }


def of_count(work: Work, count: int) -> list[dict]:
    """The rows of so many things, one for each of LIMITS."""
    scene = things_on_ground(work, count)
    tell(f"capacity: {count} things")
    bundles = {limit: work.folder / f"{scene.stem}_{limit}.rfpack" for limit in LIMITS}
    reports = {
        limit: fusedrf(work.folder, "fuse", scene.name, "-o", path.name, "--max-size", limit)
        for limit, path in bundles.items()
    }
    alone = work.folder / f"things_{COUNTS[0]:02d}_25MB.rfpack"
    held = course(scene, COMPARED)
    framed = replace(held, size=(FRAME, FRAME))
    _, one, *fused = frame_times(framed, [alone, *bundles.values()])
    naive = naive_ms(framed)
    naive_peak = peak_of(scene, FRAME)
    rows = []
    for (limit, path), ms in zip(bundles.items(), fused, strict=True):
        rows.append(
            {
                "n": count,
                "limit": limit,
                "kind": reports[limit]["kind"],
                **held.quality(path),
                "bytes": within(path, LIMITS[limit]),
                "source bytes": held.source_bytes,
                "seconds": reports[limit]["total_seconds"],
                "fused ms": ms,
                "naive ms": naive,
                "ms at n = 1": one,
                "fused peak bytes": peak_of(path, FRAME),
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
