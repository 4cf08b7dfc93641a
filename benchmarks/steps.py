"""Where the time of learning goes: python -m benchmarks.steps CAPTURE [--seconds 60] [--light 0 0.04]

Trains on a capture, once for each --light, the weight under which a sample is followed back by chance (0: all
are followed), every eighth photo held out. Prints a Markdown table of medians of the last third of each run:
milliseconds of a step, of its pass over rays and of Adam, rays, samples per ray, and the share of cache lines
of the field's numbers that a step changes.
"""

import argparse
import statistics
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from unittest import mock

import numpy as np

from benchmarks.paper.table import markdown
from benchmarks.paper.work import fusedrf, tell
from fusedrf_cli.bridge.training import Presets
from fusedrf_cli.engine.distillation import fit
from fusedrf_cli.engine.distillation.config import TrainConfig
from fusedrf_cli.engine.distillation.optimiser import Adam
from fusedrf_cli.engine.fields.computed import ComputedField
from fusedrf_cli.engine.kernels.parts import LINE
from fusedrf_cli.engine.settings import using

LOOKED_AT = 50  # steps from one count of changed lines to the next: counting takes as long as a step


def timed(taken: dict[str, list[float]], name: str, call):
    """A function that notes its milliseconds."""

    def noted(*words, **named):
        started = time.perf_counter()
        answer = call(*words, **named)
        taken.setdefault(name, []).append(1e3 * (time.perf_counter() - started))
        return answer

    return noted


def looked_at(taken: dict[str, list[float]], step):
    """`Adam.step` that notes the share of lines with a gradient now and then."""

    def noted(self: Adam, rate: float) -> None:
        if self.steps % LOOKED_AT == 0:
            lines = self.gradient.numpy().reshape(len(self.gradient), -1, LINE)
            taken.setdefault("changed", []).append(100 * float(lines.any((0, 2)).mean()))
        step(self, rate)

    return noted


def measured(capture: Path, seconds: float, light: float) -> dict:
    """A row of the table."""
    taken: dict[str, list[float]] = {}
    learn = fit.FitRun.learn

    def counted(self: fit.FitRun, sums: np.ndarray, rays: int, *more) -> None:
        taken.setdefault("rays", []).append(rays)
        taken.setdefault("samples per ray", []).append(sums[2] / rays)
        learn(self, sums, rays, *more)

    tell(f"{capture.name}: {light:g}")
    known = {name: getattr(Presets, name) for name in ("draft", "normal", "high", "best")}
    with (
        tempfile.TemporaryDirectory() as folder,
        using(Presets(**{name: replace(how, light=light) for name, how in known.items()})),
        mock.patch.object(fit.FitRun, "learn", counted),
        mock.patch.object(fit.FitRun, "step", timed(taken, "step", fit.FitRun.step)),
        mock.patch.object(ComputedField, "train_rays", timed(taken, "pass", ComputedField.train_rays)),
        mock.patch.object(Adam, "step", looked_at(taken, timed(taken, "Adam", Adam.step))),
    ):
        words = ("train", str(capture.resolve()), "-o", "field.rfpack", "--time-budget", str(seconds))
        report = fusedrf(Path(folder), *words, "--holdout", "8")
    late = {name: statistics.median(values[-len(values) // 3 :]) for name, values in taken.items()}
    return {
        "followed by chance under": f"{light:g}",
        "steps": report["steps"],
        "held-out PSNR": f"{report['holdout']['psnr']:.2f}",
        **{f"{name}, ms": f"{late[name]:.1f}" for name in ("step", "pass", "Adam")},
        "rays": round(late["rays"]),
        "samples per ray": f"{late['samples per ray']:.1f}",
        "lines changed, %": f"{late['changed']:.0f}",
    }


def main() -> None:
    """Measure, and print the table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.steps", description=__doc__)
    parser.add_argument("capture", type=Path)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--light", type=float, nargs="+", default=[0.0, TrainConfig.light])
    asked = parser.parse_args()
    print(markdown([measured(asked.capture, asked.seconds, light) for light in asked.light]))


if __name__ == "__main__":
    main()
