"""`chart` for real: labels that are true, frontiers, ladders, and what is refused."""

import csv
import itertools
import shutil
import signal
import subprocess
import sys
from dataclasses import asdict
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from fusedrf_cli import plots
from fusedrf_cli.bridge.sweep_flags import flags_of, in_words
from fusedrf_cli.commands.fuse import command as fuse_command
from fusedrf_cli.engine.kinds import registry
from fusedrf_cli.engine.kinds.instances import InstancesConfig
from fusedrf_cli.engine.kinds.sweeps import SweepPoint, by_sizes, readable_floor, shrinking
from fusedrf_cli.engine.settings import using
from fusedrf_cli.errors import InvalidInput, ResourceProblem
from fusedrf_cli.option_types import BytesType
from fusedrf_cli.progress import NullProgress
from fusedrf_cli.requests import ChartRequest
from fusedrf_cli.signals import interrupt
from tests.bridge.conftest import done, part

CHART = ("chart", "scene.json", "-o", "chart", "--size", "24x24")


@pytest.fixture(scope="module")
def charted(shop, tmp_path_factory):
    """(folder, the report of a chart of blocks there, the bundles that were made for it)."""
    folder = shutil.copytree(shop, tmp_path_factory.mktemp("charted") / "shop")
    module, made = part("charting"), []
    one = ("float16",)
    sweep = InstancesConfig(ladder_precisions=one, ladder_finished=one, ladder_ranks=(None,))
    with pytest.MonkeyPatch.context() as patch, using(sweep):

        def noted(*words):
            report = fuse(*words)
            request = words[0]
            made.append(Path(request.output).read_bytes())
            return report

        fuse = module.fuse
        patch.setattr(module, "fuse", noted)
        said = done(folder, *CHART, "--kinds", "blocks", "--budget", "600", "--least-psnr", "60")
    return folder, said, made


def test_a_label_is_the_flags_that_give_the_point(charted, report, folder):
    """All of them, to the byte."""
    _, said, made = charted
    assert 3 <= len(said["points"]) == said["tried"]
    assert {"--no-finetune" in p["flags"] for p in said["points"]} == {True, False}
    for point in said["points"]:
        report("fuse", "scene.json", "-o", "again.rfpack", "-w", *point["flags"].split())
        assert (folder / "again.rfpack").read_bytes() in made
        assert (folder / "again.rfpack").stat().st_size == point["bytes"]


def test_the_folder_holds_the_chart_twice_and_its_numbers(charted):
    folder, said, _ = charted
    assert sorted(p.name for p in (folder / "chart").iterdir()) == ["chart.csv", "chart.png", "chart.svg"]
    assert (folder / "chart" / "chart.png").read_bytes().startswith(b"\x89PNG")
    drawn = (folder / "chart" / "chart.svg").read_text()
    with open(folder / "chart" / "chart.csv", newline="") as file:
        composed, *rows = csv.DictReader(file)
    assert composed["kind"] == "composed" and float(composed["ms"]) > 0
    for row, point in zip(rows, said["points"], strict=True):
        assert row["flags"] == point["flags"] and int(row["bytes"]) == point["bytes"]
        assert float(row["psnr"]) == pytest.approx(point["psnr"], abs=1e-3)
        assert float(row["covered"]) == pytest.approx(point["covered"], abs=1e-3)
        assert row["frontier"].split() == point["frontier"]
        assert not point["frontier"] or point["flags"] in drawn
    assert {r["flags"] for r in said["frontier"]} == {p["flags"] for p in said["points"] if p["frontier"]}


def test_nothing_else_is_left(charted):
    folder, _, _ = charted
    before = {"floor", "red", "blue", "scene", "pair", "photos", "chart"}
    assert {p.name.split(".")[0] for p in folder.iterdir()} == before


def test_people_see_the_frontier(run):
    result = run(*CHART, "--kinds", "blocks", "--budget", "0.05")
    assert result.exit_code == 0, result.output
    assert "--kind blocks --precision" in result.stdout
    assert "were left off where --budget 0.05 ended" in result.stderr


def test_a_seed_is_part_of_the_label(report):
    said = report(*CHART, "--kinds", "blocks", "--budget", "0.05", "--seed", "7")
    assert said["frontier"][0]["flags"].endswith("--seed 7")


def test_what_cannot_be_charted(run, folder, monkeypatch):
    assert run(*CHART, "--kinds", "blocks,voxels").exit_code == 2
    little = run(*CHART, "--memory", "20MB")
    assert little.exit_code == 5 and "needs about" in little.stderr
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    bare = run(*CHART)
    assert bare.exit_code == 1 and bare.stderr.count("\n") == 1 and "fusedrf[charts]" in bare.stderr
    assert not (folder / "chart").exists() and not list(folder.glob(".*.rfpack*"))


def test_an_interrupt_leaves_nothing(run, folder, monkeypatch):
    before = sorted(folder.iterdir())

    def interrupted(request, progress, *words):
        Path(request.output).touch()
        Path(f"{request.output}.checkpoint").touch()
        interrupt(signal.SIGINT, None)

    monkeypatch.setattr(part("charting"), "fuse", interrupted)
    result = run(*CHART)
    assert result.exit_code == 130 and "nothing was written" in result.stderr
    assert sorted(folder.iterdir()) == before


# --- frontiers ----------------------------------------------------------------------------------------------


CHARTED = ChartRequest(scene="scene.json", output="chart", budget=60.0, kinds=(), size=(24, 24), device="cpu")


def point(**values):
    same = {"flags": "", "kind": "vm", "ssim": 1.0, "covered": 0.0, "ms": 1.0}
    return part("charting").Point(**same | values)


def test_a_frontier_is_what_no_other_point_surpasses():
    rng = np.random.default_rng(0)
    sizes, psnrs = rng.integers(1, 20, 60), rng.integers(20, 40, 60).astype(float)
    points = [point(psnr=q, bytes=int(b), seconds=1.0) for q, b in zip(psnrs, sizes, strict=True)]
    part("charting").mark_frontiers(points)

    def surpassed(p):
        return any(
            q.psnr >= p.psnr and q.bytes <= p.bytes and (q.psnr, -q.bytes) > (p.psnr, -p.bytes)
            for q in points
        )

    chosen = {(p.psnr, p.bytes) for p in points if "bytes" in p.frontier}
    assert chosen == {(p.psnr, p.bytes) for p in points if not surpassed(p)}


def test_times_within_the_noise_are_equal():
    times = [(50, 1.0), (49, 0.97), (48, 0.94), (47, 0.5)]
    points = [point(psnr=q, bytes=1, seconds=s) for q, s in times]
    part("charting").mark_frontiers(points)
    assert ["seconds" in p.frontier for p in points] == [True, False, True, True]


# --- the order of work --------------------------------------------------------------------------------------


def climbing(
    monkeypatch, seconds: dict[str, float], refused: dict[str, Exception], sizes: dict[str, int] | None = None
):
    """(what Charting.climb left, its points, its warnings) where a fuse of a kind takes so many seconds of a
    clock of its own, or is refused; from one to the next the PSNR falls by 5 dB, and the bytes by a tenth of
    those of the kind, a million by default."""
    module, clock, heard = part("charting"), [0.0], NullProgress()

    def quality(path):
        return {"psnr": 50.0 - 5 * len(run.points), "ssim": 1.0, "covered": 0.0}

    monkeypatch.setattr(module, "time", SimpleNamespace(monotonic=lambda: clock[0]))
    benchmark = SimpleNamespace(scene="scene.json", quality=quality)
    paths = iter(map(Path, "abcdefghijklmnop"))
    run = module.Charting(benchmark, paths, CHARTED, heard)

    def fuse(request, *_):
        kind = request.kind
        clock[0] += seconds[kind] / 2  # the first of a kind is done twice
        if kind in refused:
            raise refused[kind]
        size = (sizes or {}).get(kind, 1_000_000) * 0.9 ** len(run.points)
        return {"bytes": int(size), "total_seconds": seconds[kind]}

    monkeypatch.setattr(module, "fuse", fuse)
    waiting = {k: {k: [shrinking(SweepPoint(), 0)]} for k in seconds}
    return lambda budget: (run.climb(waiting, budget), run.points, heard.warnings)


def test_the_kind_that_had_least_time_is_next(monkeypatch):
    left, points, _ = climbing(monkeypatch, {"vm": 20.0, "blocks": 8.0}, {})(60.0)
    assert [p.kind for p in points] == ["vm", *4 * ["blocks"], "vm", *3 * ["blocks"]]
    assert left == 2


def test_a_kind_that_others_surpass_gets_a_third_of_the_time(monkeypatch):
    sizes = {"blocks": 1_000_000, "vm": 9_000_000}
    _, points, _ = climbing(monkeypatch, {"blocks": 2.0, "vm": 2.0}, {}, sizes)(14.5)
    assert "".join(p.kind[0] for p in points) == "bvbbbbbvbbbv"


def test_a_ladder_that_is_surpassed_waits_and_is_not_forgotten():
    """The second one's first rung shows 2 dB less than the other in more bytes, its next ones are as good."""
    chart = part("charting")
    ahead, slow, new = (chart.SweepRun(shrinking(SweepPoint(), 30), SweepPoint()) for _ in range(3))
    for run, psnr, size in ((ahead, 50, 9), (slow, 48, 10), (ahead, 47, 6)):
        run.points.append(point(psnr=psnr, bytes=size, seconds=1.0))
    found = [*ahead.points, *slow.points]
    assert slow.behind(found) and not ahead.behind(found)
    slow.points.append(point(psnr=46.9, bytes=6, seconds=1.0))
    found = [*ahead.points, *slow.points]
    assert not slow.behind(found)
    assert not new.behind(found)


def test_a_kind_that_does_not_fit_leaves_the_others(monkeypatch):
    refusals = {"blocks": InvalidInput("no blocks"), "vm": ResourceProblem("no room")}
    seconds = dict.fromkeys(("blocks", "vm", "sparse"), 2.0)
    left, points, warnings = climbing(monkeypatch, seconds, refusals)(9)
    assert {p.kind for p in points} == {"sparse"} and left == 1
    assert warnings == ["left out --kind blocks: no blocks", "left out --kind vm: no room"]


def test_where_nothing_fits_the_reason_is_told(monkeypatch):
    with pytest.raises(InvalidInput, match="no blocks"):
        climbing(monkeypatch, {"blocks": 1.0}, {"blocks": InvalidInput("no blocks")})(9)


# --- ladders ------------------------------------------------------------------------------------------------


def climbed(sweep, give) -> list[SweepPoint]:
    """All rungs of a ladder, where give(rung) is (bytes, PSNR) or None."""
    rungs = [next(sweep)]
    while True:
        try:
            rungs.append(sweep.send(give(rungs[-1])))
        except StopIteration:
            return rungs


def test_a_ladder_shrinks_until_quality_is_lost():
    psnrs = iter((50.0, 45.0, 40.0, 29.0))
    rungs = climbed(shrinking(SweepPoint(), 30), lambda sweep_point: (18_400_000, next(psnrs)))
    assert [r.max_size for r in rungs] == [None, 12_000_000, 8_000_000, 5_300_000]
    assert climbed(shrinking(SweepPoint(), 30), lambda sweep_point: None) == [SweepPoint()]
    assert climbed(shrinking(SweepPoint(), 30), lambda sweep_point: (400_000, 99.0))[-1].max_size == 48_000


def test_a_distilled_ladder_goes_on_past_what_does_not_fit():
    rungs = climbed(by_sizes(), lambda sweep_point: None)
    assert len(rungs) == len(set(rungs)) == 24
    assert all(sweep_point.time_budget is None for sweep_point in rungs[-6:])


@pytest.mark.parametrize("size", [1, 9, 10, 99, 100, 51_234, 949_999, 999_999, 1_000_000, 12_345_678.9])
def test_sizes_are_rounded_down_to_what_the_flag_reads_back(size):
    floor = readable_floor(size)
    assert 0.9 * size < floor <= size or size < 10
    assert BytesType().parse(in_words(floor)) == floor


@pytest.mark.parametrize("kind", sorted({*registry.names()} - registry.IMPORTED))
def test_the_flags_of_a_rung_are_its_keywords(kind):
    for sweep in itertools.chain(*registry.kind(kind).sweeps(30).values()):
        sweep_point = next(sweep)
        line = ["-", "-o", "-", *flags_of(kind, sweep_point, seed=7).split()]
        words = fuse_command.make_context("fuse", line).params
        assert {name: words[name] for name in asdict(sweep_point)} == asdict(sweep_point)
        assert (words["kind"], words["seed"]) == (kind, 7)


# --- the drawing --------------------------------------------------------------------------------------------


def test_numbers_in_a_panel_do_not_overlap():
    rng = np.random.default_rng(2)
    points = [point(psnr=30 + i, bytes=int(1e6 * 1.3**i), seconds=1.0) for i in range(20)]
    points += [point(psnr=25 + 10 * v, bytes=int(1e6 + 4e7 * v), seconds=1.0) for v in rng.random(40)]
    part("charting").mark_frontiers(points)
    figure = plots.pyplot().figure(figsize=(4.3, 4.4))
    panel = figure.subplots()
    plots.draw_panel(panel, "bytes", points)
    figure.draw_without_rendering()
    best = sorted((p for p in points if "bytes" in p.frontier), key=lambda p: -p.psnr)
    plots.number(panel, "bytes", points, best)
    figure.draw_without_rendering()
    boxes = [text.get_window_extent() for text in panel.texts]
    assert len(boxes) >= 20
    assert not any(a.overlaps(b) for a, b in itertools.combinations(boxes, 2))
    plots.pyplot().close(figure)


def test_matplotlib_is_loaded_by_drawing_alone(folder):
    """A command that draws nothing does not wait for it."""
    code = "import sys, fusedrf_cli.bridge; print('matplotlib' in sys.modules)"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "False"
