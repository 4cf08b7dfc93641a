"""Charts as PNG and SVG; matplotlib, of the extra `charts`, is imported only here and only to draw."""

import importlib.util
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from fusedrf_cli.engine.settings import current
from fusedrf_cli.errors import FusedRFError
from fusedrf_cli.report import readable_size

LOOKS = (  # Okabe and Ito's colours, which colour-blind readers tell apart; a kind keeps its own
    ("#0072B2", "o"),
    ("#E69F00", "D"),
    ("#56B4E9", "v"),
    ("#009E73", "^"),
    ("#D55E00", "s"),
    ("#CC79A7", "P"),
    ("#000000", "X"),
)
AXES = {"seconds": "seconds to fuse", "bytes": "bytes", "ms": "milliseconds per frame"}


@dataclass(frozen=True)
class PlotConfig:
    """How charts look."""

    pale: float = 0.25
    """Opacity of points that others surpass."""
    row_inches: float = 0.19
    font: int = 8
    """Points."""
    few_ticks: int = 20
    """Times the smallest value, from which on an axis is marked at 1, 2 and 5 alone."""
    far: int = 3
    """Times the largest point, from which on a reference is off the scale."""


AROUND = [(dx, dy) for r in (9, 15, 22) for dx, dy in ((-r, r), (0, r), (r, r), (r, 0), (r, -r), (0, -r))]


def check() -> None:
    """FusedRFError where matplotlib is missing: found before any work that ends in a chart."""
    if importlib.util.find_spec("matplotlib") is None:
        raise FusedRFError("matplotlib, which draws charts, is missing; pip install 'fusedrf[charts]'")


def pyplot():
    """matplotlib's pyplot, without a display; equal figures give equal bytes, and text stays text in an
    SVG."""
    import matplotlib

    matplotlib.use("Agg")
    matplotlib.rcParams.update({"svg.hashsalt": "fusedrf", "svg.fonttype": "none", "font.size": 9})
    from matplotlib import pyplot

    return pyplot


def save(figure, path: Path) -> None:
    """Write a figure as its name's ending says, and let it go."""
    figure.savefig(path, metadata={"Date": None} if path.suffix == ".svg" else None, dpi=130)
    pyplot().close(figure)


def chart(points: Sequence, best: Sequence, composed: dict[str, float], title: str, path: Path) -> None:
    """PSNR against seconds, bytes and milliseconds of points (bridge.chart.Point), those on a frontier
    numbered as in the list of `best` below; `composed` has the scene's own bytes and ms.
    """
    config = current(PlotConfig)
    height = 4.4 + config.row_inches * (len(best) + 2)
    figure = pyplot().figure(figsize=(13, height), layout="constrained")
    above, below = figure.subfigures(2, 1, height_ratios=(4.4, height - 4.4))
    panels = above.subplots(1, 3, sharey=True)
    for panel, cost in zip(panels, AXES, strict=True):
        draw_panel(panel, cost, points)
        if cost in composed:
            draw_composed(panel, cost, composed[cost], max(getattr(p, cost) for p in points))
    panels[0].set_ylabel("PSNR against the scene as composed, dB")
    above.suptitle(title, parse_math=False)
    handles = kind_handles(points)
    above.legend(handles=handles, loc="outside upper right", ncols=len(handles), fontsize=config.font)
    write_list(below, best, styles_of(points))
    figure.draw_without_rendering()  # places are final from here on
    for panel, cost in zip(panels, AXES, strict=True):
        number(panel, cost, points, best)
    save(figure, path)


def draw_panel(panel, cost: str, points: Sequence) -> None:
    """The points over one cost, the surpassed ones pale, and the frontier as a line."""
    config = current(PlotConfig)
    from matplotlib import ticker

    styles = styles_of(points)
    for point in points:
        colour, marker = styles[point.kind]
        alpha = 1 if cost in point.frontier else config.pale
        style = {"color": colour, "alpha": alpha, "markersize": 6, "markeredgewidth": 0}
        panel.plot(getattr(point, cost), point.psnr, marker, **style)
    line = sorted((getattr(p, cost), p.psnr) for p in points if cost in p.frontier)
    panel.plot(*zip(*line, strict=True), color="0.4", linewidth=1, zorder=0)
    values = [getattr(p, cost) for p in points]
    panel.set_xscale("log")
    panel.set_xlim(min(values) / 1.2, max(values) * 1.2)
    panel.set_xlabel(AXES[cost])
    panel.margins(y=0.1)
    panel.grid(alpha=0.3)
    format_cost = (lambda x, _: readable_size(x)) if cost == "bytes" else (lambda x, _: f"{x:g}")
    few = max(values) > config.few_ticks * min(values)
    panel.xaxis.set_major_locator(ticker.LogLocator(subs=(1, 2, 5) if few else (1, 1.5, 2, 3, 4, 5, 6, 8)))
    panel.xaxis.set_major_formatter(format_cost)
    panel.xaxis.set_minor_locator(ticker.NullLocator())
    panel.tick_params(labelsize=config.font)


def draw_composed(panel, cost: str, value: float, largest: float) -> None:
    """A line where the scene stands as composed: at the panel's end where it is far beyond all points."""
    config = current(PlotConfig)
    left, right = panel.get_xlim()
    text = "all sources" if cost == "bytes" else "as composed"
    if value > config.far * largest:
        text += f": {readable_size(value) if cost == 'bytes' else f'{value:,.0f} ms'}, off the scale"
    else:
        panel.set_xlim(min(left, value / 1.2), max(right, value * 1.2))
    at = min(value, 0.985 * panel.get_xlim()[1])
    panel.axvline(at, color="black", linewidth=1, linestyle=":")
    where = {"xycoords": ("data", "axes fraction"), "textcoords": "offset points", "fontsize": config.font}
    panel.annotate(text, (at, 0.02), (-4, 0), rotation=90, ha="right", va="bottom", **where)


def kind_handles(points: Sequence) -> list:
    """A legend's marks for the kinds that are there."""
    from matplotlib.lines import Line2D

    return [
        Line2D([], [], color=colour, marker=marker, linestyle="", label=kind)
        for kind, (colour, marker) in styles_of(points).items()
    ]


def styles_of(points: Sequence) -> dict[str, tuple[str, str]]:
    """Colour and marker of the kinds of some points, by the kinds' names: told apart as far as there are
    looks."""
    return {kind: LOOKS[i % len(LOOKS)] for i, kind in enumerate(sorted({p.kind for p in points}))}


def number(panel, cost: str, points: Sequence, best: Sequence) -> None:
    """Write its number beside every point of a panel's frontier, where nothing else is."""
    config = current(PlotConfig)
    to_pixels, per_point = panel.transData.transform, panel.figure.dpi / 72
    positions = [tuple(to_pixels((getattr(p, cost), p.psnr)) / per_point) for p in points]
    for i, point in enumerate(best, 1):
        if cost not in point.frontier:
            continue
        x, y = to_pixels((getattr(point, cost), point.psnr)) / per_point
        dx, dy = max(AROUND, key=lambda d: (clear((x + d[0], y + d[1]), positions), -abs(d[0]) - abs(d[1])))
        positions.append((x + dx, y + dy))
        where = {"textcoords": "offset points", "ha": "center", "va": "center", "fontsize": config.font}
        panel.annotate(str(i), (getattr(point, cost), point.psnr), (dx, dy), **where)


def clear(
    position: tuple[float, float], positions: Sequence[tuple[float, float]], enough: float = 9.0
) -> float:
    """Distance in points to the nearest of the places taken; beyond enough it is all the same."""
    return min(enough, min(((position[0] - x) ** 2 + (position[1] - y) ** 2) ** 0.5 for x, y in positions))


def write_list(figure, best: Sequence, styles: dict[str, tuple[str, str]]) -> None:
    """What the numbers stand for: the flags, and what they give."""
    config = current(PlotConfig)
    longest = max(len(p.flags) for p in best)
    head = f"{'':4}{'fusedrf fuse …':{longest}}{'dB':>8}{'SSIM':>8}{'size':>9}{'fuse, s':>9}{'frame, ms':>11}"
    rows = [
        f"{i:<4}{p.flags:{longest}}{p.psnr:8.2f}{p.ssim:8.4f}{readable_size(p.bytes):>9}{p.seconds:9.2f}{p.ms:11.1f}"
        for i, p in enumerate(best, 1)
    ]
    colours = ["black", *(styles[p.kind][0] for p in best)]
    for row, (text, colour) in enumerate(zip([head, *rows], colours, strict=True)):
        y = 1 - (row + 0.5) / (len(rows) + 1.5)
        figure.text(0.05, y, text, family="monospace", fontsize=config.font + 0.5, color=colour, va="center")
