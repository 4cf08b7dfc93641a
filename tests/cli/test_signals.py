"""A process that is told to end does so in time, whatever has its main thread."""

import signal
import time

import pytest

# `train` with a bridge whose main thread does not heed a signal, as a compiled loop does not.
CAUGHT = """
import signal, sys, time, types
from formats.atomic import atomic_writer
from fusedrf_cli import signals
from fusedrf_cli.engine.settings import using
def train(request, progress):
    with atomic_writer(request.output) as file:
        file.write(b"half")
        {doing}
def caught(seconds):
    signal.signal(signal.SIGTERM, lambda *_: None)  # as if this thread did not come to it
    print("ready", flush=True)
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        time.sleep(0.01)
import fusedrf_cli
fusedrf_cli.bridge = sys.modules["fusedrf_cli.bridge"] = types.SimpleNamespace(train=train)
from fusedrf_cli.main import main
with using(signals.SignalConfig({patience}, {echo})):
    main()
"""
WORDS = ("train", "chair.rfpack", "-o", "out.rfpack")


@pytest.fixture
def caught(process):
    """caught("caught(60)", patience=0.3) -> a process that has just been told to end."""

    def caught(doing: str, patience: float, echo: float = 0.3):
        running = process(CAUGHT.format(doing=doing, patience=patience, echo=echo), *WORDS)
        assert running.stdout.readline() == "ready\n"
        running.send_signal(signal.SIGTERM)
        return running

    return caught


def test_what_no_signal_reaches_is_ended_and_leaves_nothing(caught, folder):
    before = set(folder.iterdir())
    running = caught("caught(600)", patience=0.3)
    _, said = running.communicate(timeout=120)
    assert (running.returncode, said) == (143, "Error: interrupted\n")
    assert set(folder.iterdir()) == before


def test_it_saves_first_what_can_be_saved(caught, folder):
    last = "signals.last = lambda: open('saved', 'w').close(); signals.remains = 'kept'"
    running = caught(f"{last}; caught(600)", patience=0.3)
    assert running.communicate(timeout=120)[1] == "Error: kept\n" and running.returncode == 143
    assert (folder / "saved").exists()


def test_a_second_signal_does_not_wait(caught):
    running = caught("caught(600)", patience=500, echo=0.05)
    while running.poll() is None:  # one that comes with the first counts as the same
        time.sleep(0.1)
        running.send_signal(signal.SIGTERM)
    assert running.returncode == 143


def test_saving_is_waited_for(caught, folder):
    saving = 'exec(\'with signals.unhurried():\\n try: caught(1.5)\\n finally: open("saved", "w")\')'
    running = caught(f"{saving}; caught(600)", patience=0.1)
    running.communicate(timeout=120)
    assert running.returncode == 143 and (folder / "saved").exists()


def test_two_signals_at_once_are_one(caught, folder):
    """As `timeout` sends them: what the first one began goes on."""
    running = caught("print('ready', flush=True); import time; time.sleep(60)", patience=20, echo=2)
    running.send_signal(signal.SIGTERM)
    assert running.communicate(timeout=120)[1] == "Error: interrupted\n" and running.returncode == 143
    assert not list(folder.glob(".out*"))


BROKEN_OFF = """
import os, signal, sys, types
def train(request, progress):
    try:
        os.kill(os.getpid(), signal.SIGTERM)
        while True:
            pass
    finally:  # as a compiler that was broken off
        raise RuntimeError("finalize not done yet")
import fusedrf_cli
fusedrf_cli.bridge = sys.modules["fusedrf_cli.bridge"] = types.SimpleNamespace(train=train)
from fusedrf_cli.main import main
main()
"""


def test_an_error_that_an_interrupt_caused_is_the_interrupt(process):
    running = process(BROKEN_OFF, *WORDS)
    assert (running.communicate(timeout=120)[1], running.returncode) == ("Error: interrupted\n", 143)
