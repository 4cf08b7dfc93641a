"""The suite's own recorder: what a row says is written down whether it holds, fails, stops or cannot run."""

import json
import subprocess
import sys
from pathlib import Path

from benchmarks import stability
from benchmarks.commit import commit_line

SUITE = """
import pytest

def test_a1_holds(row):
    row.check("A1", "error", 1e-7, 1e-5, at_most=True, scene="S2")
    row.check("A1", "PSNR", 71, 60, unit="dB", preset="draft", seconds=2.5)

def test_a2_fails(row):
    row.check("A2", "PSNR", float("nan"), 60, unit="dB")

def test_a3_stops(row):
    row.check("A3", "first", 2, 1)
    raise ValueError("no such kind")

def test_b13_cannot_run():
    pytest.skip("nothing contracts yet")

def test_b14_needs_an_exporter(row):
    from tests.analytic.export import exported
    exported(None, "marble")

@pytest.mark.xfail(strict=True, reason="not yet")
def test_other():
    assert False
"""


def test_every_outcome_is_written_down(tmp_path):
    (tmp_path / "test_rows.py").write_text(SUITE)
    words = ["-p", "tests.failures.conftest", "-q", "-p", "no:cacheprovider", "--stability-report", "out"]
    done = subprocess.run(
        [sys.executable, "-m", "pytest", *words, "--rootdir", str(tmp_path), "test_rows.py"],
        cwd=tmp_path,
        env={"PYTHONPATH": str(Path(__file__).parents[2]), "PATH": "/usr/bin:/bin"},
        stdout=subprocess.PIPE,
        text=True,
    )
    assert "2 failed, 1 passed, 2 skipped, 1 xfailed" in done.stdout
    assert "A2: PSNR: nan dB, should be at least 60 dB" in done.stdout
    found = [json.loads(line) for line in (tmp_path / "out").read_text().splitlines()]
    assert [(r["row"], r["passed"]) for r in found] == [
        ("A1", True),
        ("A1", True),
        ("A2", False),
        ("A3", True),
        ("A3", False),
        ("B13", None),
        ("B14", None),
    ]
    assert found[1]["seconds"] == 2.5 and found[1]["preset"] == "draft" and found[0]["scene"] == "S2"
    assert found[4]["reason"] == "no such kind" and found[5]["reason"] == "nothing contracts yet"
    assert "'marble'" in found[6]["reason"]


def test_the_table_has_every_row_and_hides_no_failure(tmp_path):
    """What failed is shown as such, what is skipped tells why, what nobody ran is named."""
    check = {"scene": "S2", "unit": "", "preset": "", "seconds": 1.0, "at_most": True, "test": "t"}
    records = [
        {**check, "row": "A1", "what": "error", "figure": 1e-7, "bar": 1e-5, "passed": True},
        {**check, "row": "A2", "what": "error", "figure": 3e-5, "bar": 1e-5, "passed": False},
        {"row": "B13", "passed": None, "reason": "nothing contracts yet", "test": "t"},
    ]
    for preset, figure in (("draft", 31.0), ("high", 36.0)):
        decibel = {"unit": "dB", "at_most": False, "preset": preset, "figure": figure, "bar": 30.0}
        records.append({**check, **decibel, "row": "A1", "what": "PSNR", "passed": True})
    (tmp_path / "records").write_text("\n".join(json.dumps(r) for r in records))
    stability.main(str(tmp_path / "records"), str(tmp_path / "docs"))
    page = (tmp_path / "docs" / "stability.md").read_text()
    assert page.splitlines()[2] == commit_line() and "**1 of 2 rows" in page
    assert "| A1 | S2 | PSNR (draft) | 31 dB | ≥ 30 dB | 3/3 | pass |" in page
    assert "| A2 | S2 | error | 3e-05 | ≤ 1e-05 | 0/1 | FAIL |" in page
    assert "skipped: nothing contracts yet" in page and page.count("not run") == 9 + 16 + 11 + 11 - 3
    assert "<svg" in (tmp_path / "docs" / "stability.svg").read_text()
