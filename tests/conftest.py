"""The files that take longest come first, so that no process is left alone with one of them at the end; no
test hears of an interrupt that another one made; and settings of its own end with a test."""

import contextlib
from pathlib import Path

import pytest

from fusedrf_cli import signals
from fusedrf_cli.engine.settings import using

LONGEST = (
    *("bridge/test_extract.py", "bridge/test_fuse.py", "formats/test_posing.py", "promises/test_kills.py"),
    *("bridge/test_chart.py", "bridge/test_captures.py", "kinds/test_plugin.py", "bridge/test_edit.py"),
    *("bridge/test_far.py", "cli/test_streams.py", "kinds/test_every_kind.py", "promises/test_damage.py"),
)
TESTS = Path(__file__).parent


def pytest_collection_modifyitems(items):
    """Files of LONGEST in that order, then the others as they are found; in a file nothing changes its
    place."""
    places = {TESTS / file: place for place, file in enumerate(LONGEST)}
    items.sort(key=lambda item: places.get(item.path, len(places)))


@pytest.fixture(autouse=True)
def not_interrupted(monkeypatch):
    """As a process begins."""
    monkeypatch.setattr(signals, "_raised", None)


@pytest.fixture
def in_force():
    """in_force(OccupancyConfig(scene_cells=24), …): settings until the end of the test."""
    with contextlib.ExitStack() as stack:
        yield lambda *settings: stack.enter_context(using(*settings))
