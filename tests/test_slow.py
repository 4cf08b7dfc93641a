"""The exit code of the slow tests' run: what failed counts, and what there was no time for does not."""

import json
import sys

import pytest

from tests import slow

MARKED = "import pytest\n\n\n@pytest.mark.slow\ndef test_one():\n    "
BODIES = {"passes": "pass", "fails": "assert False", "lasts": "import time; time.sleep(60)"}


@pytest.fixture
def code(tmp_path, monkeypatch, capfd):
    """The exit code of a run of files, and what it says."""
    tests = tmp_path / "tests"
    tests.mkdir()
    (tmp_path / "pytest.ini").write_text("[pytest]\nmarkers = slow\n")
    monkeypatch.setattr(slow, "TESTS", tests)
    monkeypatch.setattr(slow, "SECONDS", tests / "slow.json")

    def run(*words: str, **seconds: float) -> tuple[int, str]:
        for name in seconds:
            (tests / f"test_{name}.py").write_text(MARKED + BODIES[name] + "\n")
        slow.SECONDS.write_text(json.dumps({f"test_{name}.py": took for name, took in seconds.items()}))
        monkeypatch.setattr(sys, "argv", ["slow", *words])
        return slow.main(), capfd.readouterr().out

    return run


def test_a_test_that_fails_fails_the_run(code):
    result, said = code(passes=1.0, fails=1.0)
    assert result == 1 and "FAILED: tests/test_fails.py\n" in said
    assert "tests/test_passes.py: passed" in said and "assert False" in said


def test_tests_that_there_is_no_time_for_do_not(code):
    """One is stopped before its end, and one that would take longer does not begin."""
    result, said = code("--minutes", "0.04", lasts=0.1, passes=1000.0)
    assert result == 0
    assert "NOT RUN for want of time: tests/test_passes.py\n" in said
    assert "STOPPED for want of time: tests/test_lasts.py\n" in said
