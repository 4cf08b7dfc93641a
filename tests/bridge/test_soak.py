"""Adding and deleting over and over: nothing grows, nothing is left behind."""

import gc
import os
from pathlib import Path

import pytest

from fusedrf_cli.bridge.memory import resident
from tests.bridge.conftest import done

AT = ("--name", "blue", "-t", "0.7,0,0")


def descriptors() -> int:
    gc.collect()  # scenes refer to the bundles that they read from, and these to them
    return len(os.listdir("/proc/self/fd"))


@pytest.mark.skipif(not Path("/proc/self/fd").exists(), reason="counts open files in /proc")
@pytest.mark.parametrize("cycles", [5, pytest.param(200, marks=pytest.mark.slow)])
def test_cycles_of_add_and_delete_leave_nothing_behind(folder, cycles):
    """Memory within 5 %, open files and the folder's files as they were, the bundle no larger but for its
    history, its numbers those of the first."""
    done(folder, "fuse", "pair.json", "-o", "a.rfpack")

    def cycle() -> None:
        done(folder, "add", "a.rfpack", "blue.rfpack", *AT, "-o", "b.rfpack", "-w")
        done(folder, "delete", "b.rfpack", "blue", "-o", "a.rfpack", "-w")

    for _ in range(3):  # what is loaded once, and pools that fill
        cycle()
    files, size = sorted(folder.rglob("*")), (folder / "a.rfpack").stat().st_size
    held, open_files = resident(), descriptors()
    for _ in range(cycles):
        cycle()
    assert sorted(folder.rglob("*")) == files
    assert descriptors() == open_files
    assert resident() < 1.05 * held
    grown = (folder / "a.rfpack").stat().st_size - size
    assert grown < 0.05 * size + 1500 * cycles  # two entries of history each
