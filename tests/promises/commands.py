"""Whole commands over mutated packs: `python -m tests.promises.commands --count 300 --seed 0`.

One process imports everything and forks a child for each run, under limits of memory and time. A run is
*wrong* if it ends in anything but its own exit codes, says "internal error", leaves half an output, takes a
damaged pack, or does not end within seconds of SIGTERM after it computed for long. The packs it begins from
are the golden ones and hostile ones of every kind (`SEEDS`). Every run follows from (seed, index).
"""

import argparse
import json
import os
import random
import resource
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np

from formats.bundle import is_bundle, read_bundle
from formats.records import FieldRecord
from fusedrf_cli import bridge  # noqa: F401  (imported before the first fork)
from fusedrf_cli.engine import kernels  # noqa: F401
from fusedrf_cli.engine.kinds import registry
from fusedrf_cli.main import main as command_line
from tests.bundles import write_single
from tests.promises.fuzz import GOOD
from tests.promises.mutations import mutated
from tests.promises.packs import GOLDEN

PATIENCE = 60  # seconds of computing before a run is asked to end: a mutated field may have to be compiled
ENDING = 10  # seconds of computing that it then has
MEMORY = 3 << 30  # bytes more than the process that forks has
CODES = {0, 3, 4, 5, 6, 7, 128 + signal.SIGTERM}
QUICK = ("-w", "-q", "--threads", "1", "--memory", "2GB")
COMMANDS = {
    "render": ("render", "PACK", "-o", "out.png", "--size", "24x24", *QUICK),
    "render its photos' views": ("render", "PACK", "-o", "views", "--views", "capture", *QUICK),
    "eval": ("eval", "PACK", "--against", "good.rfpack", "--size", "24x24", *QUICK[1:]),
    "fuse": ("fuse", "PACK", "-o", "out.rfpack", "--time-budget", "1", *QUICK),
    "add": ("add", "good.rfpack", "PACK", "--name", "new", "-o", "out.rfpack", "-w", "-q", "--memory", "2GB"),
}
BOX = [0.0, 0.0, 0.0, 1.0, 1.0, 1.0]


def boxed(name: str, texels: tuple, cells: tuple, box: list, precision: str) -> Callable[[Path], None]:
    """Writes a pack of a field over a box with nothing in it, which takes few bytes whatever its size."""

    def write(path: Path) -> None:
        kind = registry.kind(name).field
        shape = kind.shape_type()
        arrays = {
            part.name: np.zeros(
                (0, *(part.columns,) * bool(part.columns)) if part.on_vertices else part.shape, np.float32
            )
            for part in kind.parts_of(shape, texels)
        }
        arrays["occupancy"] = np.packbits(np.zeros(cells, bool))
        metadata = {
            **{"aabb": box, "resolution": list(texels), "scale": 1.0, "shift": -8.0},
            **{"shape": vars(shape), "cells": {"aabb": box, "counts": list(cells)}},
        }
        write_single(path, FieldRecord(name, arrays, metadata), "a", precision=precision)

    return write


def of_blocks(count: int) -> Callable[[Path], None]:
    """Writes a pack of one small tensor in many blocks at one place."""

    def write(path: Path) -> None:
        record = read_bundle(GOLDEN / "ring.rfpack").fields.popitem()[1]
        block = record.metadata["blocks"][0]
        record.metadata["blocks"] = [{**block, "name": f"b{i}"} for i in range(count)]
        write_single(path, record, "a")

    return write


THIN = [0.0, 0.0, 0.0, 1e-9, 1.0, 1.0]
SEEDS = {
    "vertices of nothing": boxed("dense", (400,) * 3, (1, 1, 1), BOX, "float16"),
    "more vertices": boxed("dense-mlp", (8192,) * 3, (1, 1, 1), BOX, "float16"),
    "a thin box": boxed("dense", (16,) * 3, (1, 1, 1), THIN, "float16"),
    "a thin box of lines": boxed("cp", (64,) * 3, (4, 4, 4), THIN, "int8"),
    "cells and vertices across": boxed("dense", (8192, 2, 2), (1, 512, 512), BOX, "float16"),
    "lines of zeros": boxed("cp", (8192,) * 3, (1, 1, 1), BOX, "int8"),
    "many blocks": of_blocks(64),
}


def seeds(folder: Path) -> list[bytes]:
    """The packs that are mutated."""
    found = [(GOLDEN / name).read_bytes() for name in GOOD]
    for write in SEEDS.values():
        path = folder / "seed.rfpack"
        path.unlink(missing_ok=True)
        write(path)
        found.append(path.read_bytes())
    path.unlink()
    return found


def run(words: tuple[str, ...], folder: Path, patience: float = PATIENCE) -> tuple[int, str, float]:
    """A command in a child of this process: its exit status as a shell tells it, what it said, and the
    seconds of computing, at least `patience`, after which it was asked to end; 0 where it was not."""
    said = folder / "said"
    child = os.fork()
    if child == 0:
        os.chdir(folder)
        with open(said, "wb") as file:
            os.dup2(file.fileno(), 1)
            os.dup2(file.fileno(), 2)
        held = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
        resource.setrlimit(resource.RLIMIT_AS, (held + MEMORY, held + MEMORY))
        sys.argv = ["fusedrf", *words]
        code = 70
        try:
            command_line()
            code = 0
        except SystemExit as done:
            code = done.code if isinstance(done.code, int) else 0
        finally:
            os._exit(code)
    asked = None
    while True:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            break
        computed = seconds_of(child)
        if asked is None and computed > patience:
            asked = computed
            os.kill(child, signal.SIGTERM)
        elif asked is not None and computed > asked + ENDING:
            os.kill(child, signal.SIGKILL)
        time.sleep(0.02)
    return os.waitstatus_to_exitcode(status), said.read_text(errors="replace"), asked or 0.0


def seconds_of(process: int) -> float:
    """Seconds that a process has computed."""
    fields = Path(f"/proc/{process}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def judged(code: int, said: str, damaged: bool, folder: Path) -> str | None:
    """What a run did wrong, if anything."""
    if code not in CODES:
        return f"exit {code}"
    if "internal error" in said or "Traceback" in said:
        return "internal error"
    if damaged and code not in (3, 4):
        return "took a damaged pack"
    output = folder / "out.rfpack"
    if output.exists() and is_bundle(output):
        read_bundle(output)
    left = [path.name for path in folder.iterdir() if path.name.startswith(".")]
    return f"left {left}" if left and code >= 0 else None


def fuzz(count: int, seed: int, folder: Path, first: int = 0) -> dict:
    """Counts of `count` runs and what went wrong."""
    good = seeds(folder)
    (folder / "good.rfpack").write_bytes((GOLDEN / "ring.rfpack").read_bytes())
    found, wrong = Counter(), []
    for index in range(first, first + count):
        rng = random.Random(f"commands {seed}/{index}")
        pack, name = rng.choice(good), rng.choice(sorted(COMMANDS))
        kind, data, sealed = ("as it is", pack, True) if rng.random() < 0.1 else mutated(pack, rng)
        (folder / "pack.rfpack").write_bytes(data)
        words = tuple("pack.rfpack" if word == "PACK" else word for word in COMMANDS[name])
        code, said, asked = run(words, folder)
        found[f"{name}: exit {code}"] += 1
        found["asked to end"] += bool(asked)
        problem = judged(code, said, not sealed and data != pack, folder)
        if problem is not None:
            what = {"index": index, "kind": kind, "command": name, "problem": problem}
            wrong.append(what | {"said": said[-500:]})
    return {"runs": count, "seed": seed, "wrong": wrong, "counts": dict(sorted(found.items()))}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=1000)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        result = fuzz(options.count, options.seed, Path(folder), options.first)
    print(json.dumps(result, indent=1))
    return 1 if result["wrong"] else 0


if __name__ == "__main__":
    sys.exit(main())
