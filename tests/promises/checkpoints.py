"""Checkpoints of interrupted runs, to be damaged: as a disk would, or sealed anew under a right checksum."""

import hashlib
import os
import random
import signal
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from formats.checkpoints import DIGEST_BYTES, MAGIC, write_checkpoint
from fusedrf_cli.engine.distillation import distill, fit
from fusedrf_cli.engine.distillation.optimiser import Adam
from fusedrf_cli.main import cli
from fusedrf_cli.signals import interrupt
from tests.promises.mutations import DAMAGES, spoilt_json

NAME = "out.rfpack.checkpoint"
START = len(MAGIC) + 8
QUICK = ("-w", "-q", "--threads", "1", "--memory", "2GB", "--time-budget", "1")
RUNS = {
    "train an object": ("train", "sound/blender", *QUICK),
    "train a place": ("train", "sound/colmap_binary", *QUICK),
    "fuse": ("fuse", "pair.json", "--kind", "vm", *QUICK),
}


def interrupted(folder: Path, words: tuple[str, ...], steps: int = 6) -> bytes:
    """The checkpoint of a command that SIGINT ends during a step; `folder` is the current one."""
    step, calls = Adam.step, []

    def counted(self, rate: float) -> None:
        calls.append(rate)
        if len(calls) == steps:
            signal.raise_signal(signal.SIGINT)
        step(self, rate)

    signal.signal(signal.SIGINT, interrupt)
    with pytest.MonkeyPatch.context() as patch, suppress(SystemExit):
        patch.setattr(Adam, "step", counted)
        for module in (fit, distill):  # so that the time budget does not end before
            patch.setattr(module, "working_time", lambda: 0.0)
        cli.main([*words, "-o", "out.rfpack"])
    data = (folder / NAME).read_bytes()
    os.unlink(folder / NAME)
    return data


def checkpoint(folder: Path) -> Path:
    """A small one, as `train` may leave it."""
    folder.mkdir(parents=True)
    arrays = {
        "params": np.arange(60, dtype=np.float32).reshape(20, 3),
        "random": np.arange(9, dtype=np.uint8),
    }
    state = {"command": "train", "kind": "vm", "steps": 7, "elapsed": 1.5, "found": [True, False]}
    write_checkpoint(folder / NAME, arrays, state | {"guard": {"rate": 1.0, "recent": [0, 1]}})
    return folder / NAME


def spoilt_checkpoint(data: bytes, rng: random.Random) -> tuple[str, bytes]:
    """What was done, and the bytes; most are sealed anew."""
    if rng.random() < 0.25:
        kind = rng.choice(sorted(DAMAGES.keys() - {"edge"}))
        return kind, DAMAGES[kind](bytearray(data), rng)
    stop = START + int.from_bytes(data[len(MAGIC) : START], "little")
    header, rest = data[START:stop], data[stop:-DIGEST_BYTES]
    if rng.random() < 0.75:
        kind, header = "sealed header", spoilt_json(header, rng)
    else:
        damage = rng.choice(sorted(DAMAGES.keys() - {"edge"}))
        kind, rest = f"sealed numbers: {damage}", DAMAGES[damage](bytearray(rest), rng)
    data = MAGIC + len(header).to_bytes(8, "little") + header + rest
    return kind, data + hashlib.sha256(data).digest()


def intact(data: bytes) -> bool:
    """Whether the checksum at the end is that of what comes before it."""
    return hashlib.sha256(data[:-DIGEST_BYTES]).digest() == data[-DIGEST_BYTES:]
