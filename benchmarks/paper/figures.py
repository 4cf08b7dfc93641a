"""The plots of the experiments."""

from pathlib import Path

from fusedrf_cli import plots

NAMES = {
    "background": "fuse --kind vm, from the background",
    "scratch": "fuse --kind vm --from-scratch --no-rgb",
    "retraining": "100 views of the composition, then train",
}
COLOURS = {"background": "#D55E00", "scratch": "#CC79A7", "retraining": "0.35"}


def capacity(rows: list[dict], path: Path) -> None:
    """PSNR, time per frame and memory over how many things there are."""
    pyplot = plots.pyplot()
    figure, (quality, speed, memory) = pyplot.subplots(1, 3, figsize=(12, 3.6), layout="constrained")
    for limit in dict.fromkeys(r["limit"] for r in rows):
        chosen = [r for r in rows if r["limit"] == limit]
        n = [r["n"] for r in chosen]
        quality.plot(n, [r["psnr"] for r in chosen], "o-", label=f"--max-size {limit}")
        speed.plot(n, [r["fused ms"] for r in chosen], "o-", label=f"fused, {limit}")
        memory.plot(n, [r["fused peak bytes"] / 1e6 for r in chosen], "o-", label=f"fused, {limit}")
    speed.plot(n, [r["naive ms"] for r in chosen], "k:", label="as composed")
    memory.plot(n, [r["naive peak bytes"] / 1e6 for r in chosen], "k:", label="as composed")
    quality.axhline(38, color="0.6", linewidth=1, linestyle="--")
    quality.set_ylabel("PSNR against the scene as composed, dB")
    speed.set_ylabel("milliseconds per frame")
    memory.set_ylabel("peak memory of a frame's process, MB")
    speed.set_yscale("log")
    memory.set_ylim(0)
    for panel in (quality, speed, memory):
        panel.set_xscale("log", base=2)
        panel.set_xticks(n, map(str, n))
        panel.set_xlabel("things on the ground")
        panel.grid(alpha=0.3)
        panel.legend(fontsize=8)
    plots.save(figure, path)


def times(rows: list[dict], wanted: float, path: Path) -> None:
    """PSNR over seconds of each way, and the PSNR that is asked for as a line."""
    figure, panel = plots.pyplot().subplots(figsize=(7, 4.2), layout="constrained")
    for way in dict.fromkeys(r["way"] for r in rows):
        points = sorted((r["seconds"], r["psnr"]) for r in rows if r["way"] == way)
        if way in plots.LOOKS:
            colour, marker = plots.LOOKS[way]
            panel.plot(*zip(*points, strict=True), marker, color=colour, label=f"fuse --kind {way}")
        else:
            panel.plot(*zip(*points, strict=True), "s-", color=COLOURS[way], label=NAMES[way], markersize=4)
    panel.axhline(wanted, color="0.6", linewidth=1, linestyle="--")
    panel.set_xscale("log")
    panel.xaxis.set_major_formatter(lambda x, _: f"{x:g}")
    panel.set_xlabel("seconds, with the rendering of the views")
    panel.set_ylabel("PSNR against the scene as composed, dB")
    panel.grid(alpha=0.3)
    panel.legend(fontsize=8)
    plots.save(figure, path)
