"""Recording of the failure suite: every row states its figure and its bar, and is written down also where it
fails or cannot run.

Tests are named for their row, `test_a1_what_holds`; with `--stability-report FILE` each check, each skip and
each test that stops before its checks adds a line of JSON to FILE (benchmarks/stability.py makes the table).
"""

import json
import re
import time
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from fusedrf_cli.bridge.evaluation_views import EvaluationViewConfig
from fusedrf_cli.engine.distillation.finetune import FinetuneConfig
from fusedrf_cli.engine.fields.occupancy import OccupancyConfig
from fusedrf_cli.engine.kinds.allocation import AllocationConfig
from fusedrf_cli.engine.kinds.vm.builder import VMBuilderConfig
from tests.analytic.export import SHAPE, NotExportable
from tests.bridge.conftest import TinySettings
from tests.bundles import field_kinds
from tests.engine.kinds.cases import SLOW_TO_COMPILE

ROW = re.compile(r"test_([a-z]+\d+)_")


def pytest_addoption(parser):
    """`--stability-report FILE`."""
    parser.addoption("--stability-report", metavar="FILE", help="append the figures of the failure suite")


@dataclass
class Row:
    """What a test of the failure suite says of its row."""

    test: str
    records: list[dict] = field(default_factory=list)
    started: float = field(default_factory=time.perf_counter)

    def check(
        self,
        row: str,
        what: str,
        figure: float,
        bar: float,
        *,
        at_most: bool = False,
        scene: str = "",
        unit: str = "",
        preset: str = "",
        seconds: float | None = None,
    ) -> None:
        """Write the figure down and assert that it is at least its bar, or at most.

        unit is "dB" for a PSNR, which the chart draws; preset is "draft", "normal" or "high" where the figure
        depends on one; seconds default to the time since the test began.
        """
        figure, bar = float(figure), float(bar)
        passed = figure <= bar if at_most else figure >= bar  # NaN fails either way
        took = time.perf_counter() - self.started if seconds is None else seconds
        record = {"row": row, "scene": scene, "what": what, "figure": figure, "bar": bar, "at_most": at_most}
        record |= {"unit": unit, "passed": passed, "preset": preset, "seconds": took, "test": self.test}
        self.records.append(record)
        sign = "at most" if at_most else "at least"
        assert passed, f"{row}: {what}: {figure:.6g} {unit}, should be {sign} {bar:g} {unit}"


@pytest.fixture
def row(request) -> Row:
    """row.check("A1", "relative error of optical depth", figure, 1e-5, at_most=True)."""
    request.node.stability = Row(request.node.name)
    return request.node.stability


@pytest.fixture
def quick(in_force) -> None:
    """Coarse grids over a scene, and commands that distil for a second and judge small pictures."""
    in_force(
        OccupancyConfig(scene_cells=48),
        VMBuilderConfig(SHAPE),
        TinySettings(),
        FinetuneConfig(rays=15_000, steps=30, rays_per_step=500),
        AllocationConfig(ranks=()),  # others would be compiled
        EvaluationViewConfig(whole=2, most_objects=0),
    )


def pytest_generate_tests(metafunc):
    """A test that takes `kind` runs once for every registered field kind, also for those still to come."""
    if "kind" in metafunc.fixturenames:
        kinds = sorted(field_kinds())
        slow = pytest.mark.slow
        tried = [pytest.param(k, marks=slow if k in SLOW_TO_COMPILE else ()) for k in kinds]
        metafunc.parametrize("kind", tried)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item, call):
    """Skip where a kind has no exporter; append what the test found to the report."""
    if call.excinfo is not None and call.excinfo.errisinstance(NotExportable):
        try:
            pytest.skip(str(call.excinfo.value))
        except pytest.skip.Exception:
            call.excinfo = pytest.ExceptionInfo.from_current()
    report = yield
    path = item.config.getoption("--stability-report", None)
    found = getattr(item, "stability", None)
    records = list(found.records) if found and report.when == "call" else []
    named = ROW.match(item.name)
    if named and not report.passed and all(r["passed"] for r in records):
        reason = report.longrepr[2] if report.skipped else str(call.excinfo.value).split("\n")[0]
        records.append(
            {"row": named[1].upper(), "test": item.name, "passed": None if report.skipped else False}
            | {"reason": reason.removeprefix("Skipped: ")}
        )
    if path and records:
        with Path(path).open("a") as file:
            file.writelines(json.dumps(record) + "\n" for record in records)
    return report
