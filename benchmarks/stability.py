"""The failure suite's table and chart: python -m benchmarks.stability RECORDS FOLDER (or make stability).

RECORDS are the lines of JSON that `pytest tests/failures --stability-report` wrote. FOLDER gets stability.md,
one line for every row, and stability.svg: the worst PSNR of every row that has one, a bar for each preset
where the row depends on one, with the seconds it took.
"""

import json
import re
import sys
from dataclasses import dataclass
from math import inf, log10
from pathlib import Path

from benchmarks.commit import commit_line

PRESETS = ("draft", "normal", "high")
COLOURS = {"draft": "#9ecae1", "normal": "#4292c6", "high": "#084594", "": "#7f7f7f"}
COUNTS = {"A": 9, "B": 16, "C": 11, "D": 11}
TITLES = {"A": "Placement", "B": "Composition", "C": "Student, edits and time", "D": "Rendering"}
SHOWN_FROM = 15  # dB, where the chart's axis begins


@dataclass(frozen=True)
class RowResult:
    """All that was recorded of one row of the catalogue."""

    name: str
    checks: tuple[dict, ...]
    reasons: tuple[str, ...]
    """Why tests of the row were skipped or stopped."""

    @property
    def verdict(self) -> str:
        """pass, FAIL, skipped or not run; a row with both checks and skips is judged by its checks."""
        if any(c["passed"] is False for c in self.checks):
            return "FAIL"
        return ("pass" if any(c["passed"] for c in self.checks) else "skipped") if self.checks else "not run"

    @property
    def measured(self) -> list[dict]:
        """The checks that have a figure."""
        return [c for c in self.checks if "figure" in c]

    @property
    def tightest(self) -> dict | None:
        """The check that is nearest to its bar, or furthest beyond it."""
        return min(self.measured, key=margin, default=None)


def margin(check: dict) -> float:
    """dB by which a figure is on the good side of its bar, negative beyond it; a count is far on either."""
    figure, bar = check["figure"], check["bar"]
    if check["unit"] == "dB" and not check["at_most"] and figure == figure:
        return figure - bar
    if check["at_most"] and figure > 0 and bar > 0:
        return 10 * log10(bar / figure)
    return inf if check["passed"] else -inf


def read_records(path: Path) -> dict[str, RowResult]:
    """Rows by name, in the catalogue's order, those without a record among them."""
    found: dict[str, list[dict]] = {f"{k}{i}": [] for k, n in COUNTS.items() for i in range(1, n + 1)}
    for line in path.read_text().splitlines():
        record = json.loads(line)
        found.setdefault(record["row"], []).append(record)
    order = sorted(found, key=lambda name: (name.rstrip("0123456789"), int(re.sub(r"\D", "", name))))
    return {name: row_result(name, found[name]) for name in order}


def row_result(name: str, records: list[dict]) -> RowResult:
    """A row of its records."""
    reasons = dict.fromkeys(r["reason"] for r in records if "reason" in r)
    return RowResult(name, tuple(records), tuple(reasons))


def table(rows: dict[str, RowResult]) -> str:
    """The page: how many hold, then one table per group of rows."""
    ran = [r for r in rows.values() if r.name[0] in COUNTS and r.verdict in ("pass", "FAIL")]
    held = [r for r in ran if r.verdict == "pass"]
    lines = [
        "# Stability where methods fail",
        "",
        commit_line(),
        "",
        "Written by `make stability`. Each row is a situation in which radiance-field methods fail, with an "
        "adversarial scene whose truth is known in closed form (`tests/analytic`), the check that is nearest "
        "to its bar, and how many checks the row has. `tests/failures` holds the tests, named for their row.",
        "",
        f"**{len(held)} of {len(ran)} rows that today's kinds and commands can run hold all their checks.**",
        "",
        "![worst PSNR per row](stability.svg)",
    ]
    for group in dict.fromkeys(name.rstrip("0123456789") for name in rows):
        lines += ["", f"## {group}. {TITLES.get(group, 'Training')}", ""]
        lines += ["| row | scene | nearest to its bar | figure | bar | checks | |", "|---" * 7 + "|"]
        lines += [line(r) for name, r in rows.items() if name.rstrip("0123456789") == group]
    return "\n".join(lines) + "\n"


def line(row: RowResult) -> str:
    """One row of the table, and what was skipped or stopped."""
    tightest = row.tightest
    notes = "; ".join(escaped(reason) for reason in row.reasons)
    verdict = row.verdict
    if notes:
        verdict += f"; left out: {notes}" if verdict == "pass" else f": {notes}"
    if tightest is None:
        return f"| {row.name} | | | | | | {verdict} |"
    scenes = ", ".join(sorted({c["scene"] for c in row.measured if c["scene"]}, key=natural))
    unit = f" {tightest['unit']}" if tightest["unit"] else ""
    sign = "≤" if tightest["at_most"] else "≥"
    passed = sum(c["passed"] for c in row.measured)
    count = f"{passed}/{len(row.measured)}"
    what = escaped(tightest["what"]) + (f" ({tightest['preset']})" if tightest["preset"] else "")
    cells = (what, f"{tightest['figure']:.3g}{unit}", f"{sign} {tightest['bar']:g}{unit}", count, verdict)
    return f"| {row.name} | {scenes} | {' | '.join(cells)} |"


def natural(scene: str) -> tuple:
    """S2 before S10."""
    return tuple(int(part) if part.isdigit() else part for part in re.split(r"(\d+)", scene))


def escaped(text: str) -> str:
    """Text that cannot end a cell."""
    return text.replace("|", "\\|").replace("\n", " ")


def worst(row: RowResult) -> dict[str, tuple[float, float]]:
    """(worst PSNR, seconds) of a row by preset; "" where it depends on none."""
    found: dict[str, tuple[float, float]] = {}
    for check in row.measured:
        if check["unit"] == "dB" and not check["at_most"]:  # a PSNR, and no difference of two
            psnr, seconds = found.get(check["preset"], (inf, 0.0))
            found[check["preset"]] = (min(psnr, check["figure"]), max(seconds, check["seconds"]))
    return found


def chart(rows: dict[str, RowResult], path: Path) -> None:
    """Worst PSNR per row beside its seconds, a bar for every preset."""
    import matplotlib

    matplotlib.use("Agg")
    matplotlib.rcParams["svg.hashsalt"] = "stability"  # equal figures, equal bytes
    from matplotlib import pyplot, ticker

    shown = {name: found for name, row in rows.items() if (found := worst(row))}
    figure, (quality, speed) = pyplot.subplots(
        1, 2, sharey=True, figsize=(9, 1.6 + 0.34 * len(shown)), width_ratios=(2, 1), layout="constrained"
    )
    for at, found in enumerate(shown.values()):
        presets = [p for p in ("", *PRESETS) if p in found]
        height = 0.8 / len(presets)
        for i, preset in enumerate(presets):
            y, (psnr, seconds) = at - 0.4 + (i + 0.5) * height, found[preset]
            colour = COLOURS[preset]
            quality.barh(y, max(psnr, SHOWN_FROM) - SHOWN_FROM, height, left=SHOWN_FROM, color=colour)
            speed.barh(y, seconds, height, color=colour)
    for at, name in enumerate(shown):
        bars = {c["bar"] for c in rows[name].measured if c["unit"] == "dB" and not c["at_most"]}
        quality.vlines(sorted(bars), at - 0.45, at + 0.45, color="black", linewidth=1)
    quality.set_yticks(range(len(shown)), list(shown))
    quality.invert_yaxis()
    quality.set_xlim(SHOWN_FROM, 102)
    quality.set_xlabel("worst PSNR, dB (black: bars)")
    speed.set_xscale("log")
    speed.xaxis.set_minor_formatter(ticker.NullFormatter())  # decades alone have room
    speed.set_xlabel("longest test, s")
    names = {"": "no preset", **{p: p for p in PRESETS}}
    used = {p for found in shown.values() for p in found}
    handles = [pyplot.Rectangle((0, 0), 1, 1, color=COLOURS[p]) for p in names if p in used]
    figure.legend(handles, [n for p, n in names.items() if p in used], loc="outside upper right", ncols=4)
    figure.savefig(path, metadata={"Date": None} if path.suffix == ".svg" else None, dpi=110)
    pyplot.close(figure)


def main(records: str, folder: str) -> None:
    """Write the page and the chart; the verdicts to stdout."""
    rows, out = read_records(Path(records)), Path(folder)
    out.mkdir(parents=True, exist_ok=True)
    (out / "stability.md").write_text(table(rows))
    chart(rows, out / "stability.svg")
    for row in rows.values():
        print(f"{row.name:5} {row.verdict}")


if __name__ == "__main__":
    main(*sys.argv[1:])
