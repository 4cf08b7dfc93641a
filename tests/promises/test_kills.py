"""Commands killed at random, and at every system call of writing, leave the old output or the new one."""

import json
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.promises.packs import generation_of, write_generation

ROOT = Path(__file__).parents[2]


def kills(*words: str) -> dict:
    """What `tests.promises.kills` tells, in a process of its own: it forks."""
    run = subprocess.run(
        [sys.executable, "-m", "tests.promises.kills", *words], cwd=ROOT, capture_output=True, text=True
    )
    assert run.stdout, run.stderr
    return json.loads(run.stdout)


def test_a_writer_killed_at_random_leaves_whole_packs(tmp_path):
    """P2: without commands around it, many times over."""
    path, rng, seen = tmp_path / "out", random.Random(0), set()
    write_generation(path, 1)
    for _ in range(12):
        writer = subprocess.Popen([sys.executable, "-m", "tests.promises.packs", "write", path], cwd=ROOT)
        before, deadline = path.stat().st_ino, time.monotonic() + 60
        while path.stat().st_ino == before and time.monotonic() < deadline:
            time.sleep(0.001)
        time.sleep(rng.uniform(0, 0.03))
        writer.send_signal(signal.SIGKILL)
        writer.wait()
        seen.add(generation_of(path))
    assert len(seen) > 1


def test_commands_killed_at_random_leave_old_or_new():
    """P2: a few here, at least 200 for each command under `make fuzz`."""
    found = kills("compose", "delete", "--kills", "4")
    assert {name: result["wrong"] for name, result in found.items()} == {"compose": [], "delete": []}
    assert all(result["kills"] == 4 for result in found.values())


def test_a_command_that_writes_in_place_is_found_out():
    """P2 with its defence removed."""
    assert kills("compose", "--kills", "0", "--calls", "--in-place")["compose at every call"]["wrong"]


@pytest.mark.slow
def test_every_command_killed_at_every_call_leaves_old_or_new():
    """P2."""
    found = kills("--kills", "0", "--calls")
    assert {name: result["wrong"] for name, result in found.items()} == dict.fromkeys(found, [])
    assert all(result["kills"] >= 10 for result in found.values())


@pytest.mark.slow
def test_sixteen_adds_at_once_are_all_there():
    """P8, with whole commands: `test_locks.py` has the same with a quick stand-in."""
    assert kills("add", "--kills", "0", "--adds", "16") == {"adds at once": {"adds": 16, "wrong": []}}
