"""Mutated packs against every verb that reads one: `python -m tests.promises.fuzz --count 10000 --seed 0`.

A pack is counted as *silent* if it was damaged and a verb took it, *crashed* if a verb ended in anything but
its own error, *hung* if a verb computed for more than five seconds, or waited for a minute. Every pack
follows from (seed, index).
"""

import argparse
import json
import random
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import numpy as np
from click.testing import CliRunner

from formats.errors import FormatError
from fusedrf_cli.bridge import deleting, editing, scene
from fusedrf_cli.engine.fields.occupancy import OccupancyConfig
from fusedrf_cli.engine.settings import using
from fusedrf_cli.errors import FusedRFError
from fusedrf_cli.main import cli
from tests.promises.mutations import mutated
from tests.promises.packs import GOLDEN

PATIENCE = 5.0  # seconds of computing; other processes may slow the clock on the wall
WAITING = 60.0
GOOD = (
    *("lamp.rfpack", "pair.rfpack", "ring.rfpack", "later.rfpack"),
    *("coded-8.rfpack", "coded-4.rfpack", "bricks.rfpack", "far.rfpack"),
)
CELLS = 16  # of ownership grids, here: a good pack of two blocks then loads in a hundredth of the time


class Hung(BaseException):
    """A verb took longer than anybody waits."""


class Crashed(Exception):
    """A verb ended in something else than its own error."""


def command(*words: str):
    def verb(path: str) -> bool:
        result = CliRunner().invoke(cli, [*words, path])
        said = result.stderr.replace("Warning: ", "")
        if (
            result.exit_code not in (0, 3, 4)
            or "internal error" in said
            or not said.replace("\n", "").isprintable()
        ):
            raise Crashed(f"exit {result.exit_code}: {result.stderr}")
        return result.exit_code == 0

    return verb


def reading(read):
    def verb(path: str) -> bool:
        try:
            read(path)
        except (FormatError, FusedRFError):
            return False
        return True

    return verb


def edited(path: str) -> None:
    request = SimpleNamespace(fused=path, output=f"{path}.edited", undoable=False, memory=None)
    edit = editing.Edit(request, Silence())
    assert isinstance(edit.draft.names, set)
    deleting.Deletion(edit, (), False).remaining(np.array([-1e9] * 3 + [1e9] * 3))


class Silence:
    def warn(self, _: str) -> None:
        pass

    def phase(self, *_) -> None:
        pass


VERBS = {
    "info": command("info"),
    "info --json": command("info", "--json"),
    "validate": command("validate"),
    "render, eval, fuse": reading(scene.load_scene),  # what all three do first
    "add, delete": reading(edited),
}


@contextmanager
def patience(seconds: float = PATIENCE):
    def hung(*_):
        raise Hung

    before = [signal.signal(number, hung) for number in (signal.SIGALRM, signal.SIGPROF)]
    signal.setitimer(signal.ITIMER_REAL, WAITING)
    signal.setitimer(signal.ITIMER_PROF, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.setitimer(signal.ITIMER_PROF, 0)
        for number, handler in zip((signal.SIGALRM, signal.SIGPROF), before, strict=True):
            signal.signal(number, handler)


def judged(path: Path, verb, damaged: bool, found: Counter, seconds: float = PATIENCE) -> str | None:
    """What a verb did wrong with the pack at `path`, if anything; it may compute for so many seconds."""
    began = time.process_time()
    try:
        with patience(seconds):
            taken = verb(str(path))
        if time.process_time() - began > seconds:
            return "hung"
    except Hung:
        return "hung"
    except Exception:
        return "crashed: " + traceback.format_exc()
    found["taken" if taken else "refused"] += 1
    return "silent" if taken and damaged else None


def fuzz(count: int, seed: int, folder: Path, first: int = 0) -> dict:
    """Counts of `count` mutated packs, written one after the other to `folder`, and what went wrong."""
    good = [(GOLDEN / name).read_bytes() for name in GOOD]
    found: Counter = Counter()
    wrong, slowest = [], 0.0
    with using(OccupancyConfig(scene_cells=CELLS)), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for index in range(first, first + count):
            rng = random.Random(f"{seed}/{index}")
            pack = rng.choice(good)
            kind, data, sealed = mutated(pack, rng)
            path = folder / "mutated.rfpack"
            path.write_bytes(data)
            found[f"{'hostile' if sealed else 'damaged'}: {kind}"] += 1
            for name, verb in VERBS.items():
                began = time.process_time()
                problem = judged(path, verb, not sealed and data != pack, found)
                slowest = max(slowest, time.process_time() - began)
                if problem is not None:
                    wrong.append({"index": index, "kind": kind, "verb": name, "problem": problem})
    return {
        "packs": count,
        "seed": seed,
        "slowest": slowest,
        "wrong": wrong,
        "counts": dict(sorted(found.items())),
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=10_000)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        result = fuzz(options.count, options.seed, Path(folder), options.first)
    print(json.dumps(result, indent=1))
    return 1 if result["wrong"] else 0


if __name__ == "__main__":
    sys.exit(main())
