"""The plots of the experiments."""

from pathlib import Path

from fusedrf_cli import plots

NAMES = {  # of the ways that are no kind to fuse with
    "background": "fuse --kind vm, from the background",
    "scratch": "fuse --kind vm --from-scratch --no-finetune",
    "retraining": "views of the composition, then train",
}


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
    """PSNR over seconds of each way, and the PSNR that is asked for as a level."""
    lines = {}
    for row in rows:
        name = NAMES.get(row["way"], f"fuse --kind {row['way']}")
        lines.setdefault(name, []).append((row["seconds"], row["psnr"]))
    words = ("seconds, with the rendering of the views", "PSNR against the scene as composed, dB")
    over_time(lines, {None: wanted}, words, path)


def over_time(
    lines: dict[str, list[tuple[float, float]]],
    levels: dict[str | None, float],
    words: tuple[str, str],
    path: Path,
) -> None:
    """Points of each named line over a logarithmic time; a level is dotted, in its line's colour if it names
    one. `words` are those of the two axes.
    """
    figure, panel = plots.pyplot().subplots(figsize=(7, 4.2), layout="constrained")
    colours = {}
    for i, (name, points) in enumerate(lines.items()):
        colours[name], marker = plots.LOOKS[i % len(plots.LOOKS)]
        panel.plot(*zip(*sorted(points), strict=True), marker=marker, color=colours[name], label=name)
    for name, level in levels.items():
        panel.axhline(level, color=colours.get(name, "0.5"), linewidth=1, linestyle=":")
    panel.set_xscale("log")
    panel.xaxis.set_major_formatter(lambda x, _: f"{x:g}")
    panel.set_xlabel(words[0])
    panel.set_ylabel(words[1])
    panel.grid(alpha=0.3)
    panel.legend(fontsize=8)
    plots.save(figure, path)
