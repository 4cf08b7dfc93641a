"""The suite's own recorder: what a row says is written down whether it holds, fails, stops or cannot run."""

import json
import subprocess
import sys
from pathlib import Path

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
