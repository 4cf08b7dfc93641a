"""Whole commands, killed: `python -m tests.promises.kills --kills 200 --seed 0 [COMMAND...]`.

One process imports everything and forks a child for each run, so that a kill costs no start-up. A child is
ended by SIGKILL after a random time, and with --calls at its k-th system call of writing, for every k. Then
the output has to be the old one or the new one, byte for byte, and nothing else may have changed but hidden
remains, which the next run has to remove.
"""

import argparse
import json
import os
import random
import re
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path

import pytest

from formats import atomic, bundle, scene
from formats.bundle import is_bundle, read_bundle
from fusedrf_cli import bridge  # noqa: F401  (imported before the first fork)
from fusedrf_cli.engine.settings import using
from fusedrf_cli.main import cli
from tests.bridge.conftest import TINY, make_tiny, stock_fields, write_views
from tests.promises.calls import At, watched

HIDDEN = re.compile(r"\..*\.(tmp|old|fusedrf-lock)")
QUICK = ("-w", "-q", "--threads", "1")
TRAIN = ("--sh-degree", "1", "--aabb", "-0.5,-0.5,-0.5,0.5,0.5,0.5")


@dataclass(frozen=True)
class Victim:
    """A command line that writes `output`, where `old` stands before."""

    words: tuple[str, ...]
    output: str
    old: str


VICTIMS = {
    "train": Victim(("train", "photos", "-o", "out.rfpack", *TRAIN, *QUICK), "out.rfpack", "blue.rfpack"),
    "fuse": Victim(("fuse", "pair.json", "-o", "out.rfpack", *QUICK), "out.rfpack", "blue.rfpack"),
    "add": Victim(
        ("add", "out.rfpack", "blue.rfpack", "--name", "blue", "-o", "out.rfpack", *QUICK[:2]),
        "out.rfpack",
        "fused.rfpack",
    ),
    "delete": Victim(
        ("delete", "out.rfpack", "red", "-o", "out.rfpack", *QUICK), "out.rfpack", "fused.rfpack"
    ),
    "compose": Victim(
        ("compose", "floor.rfpack", "blue.rfpack", "-t", "1,0,0", "-o", "out.json", "-w", "-q"),
        "out.json",
        "pair.json",
    ),
    "render": Victim(
        ("render", "red.rfpack", "--orbit", "4", "--size", "24x24", "-o", "views", *QUICK),
        "views",
        "old-views",
    ),
}


def begun(work: Callable[[], int | None]) -> int:
    """The number of a child that does `work` in silence."""
    child = os.fork()
    if child == 0:
        code = 70
        try:
            silence = os.open(os.devnull, os.O_RDWR)
            for stream in range(3):
                os.dup2(silence, stream)
            code = work() or 0
        except SystemExit as done:
            code = done.code or 0
        finally:
            os._exit(code)
    return child


def forked(work: Callable[[], int | None], kill_after: float | None = None) -> int:
    """Do `work` in a child, killed after some seconds if it is not done; the status as a shell tells it."""
    child = begun(work)
    deadline = None if kill_after is None else time.monotonic() + kill_after
    while True:
        done, status = os.waitpid(child, os.WNOHANG if deadline is not None else 0)
        if done:
            return os.waitstatus_to_exitcode(status)
        if time.monotonic() > deadline:
            os.kill(child, signal.SIGKILL)
            deadline = None
        time.sleep(0.001)


def snapshot(place: Path) -> dict[str, bytes]:
    """Every file at or below a place, by its path."""
    places = [place, *place.rglob("*")] if place.is_dir() else [place]
    return {str(p.relative_to(place)): p.read_bytes() for p in places if p.is_file()}


def _remove(place: Path) -> None:
    if place.is_dir():
        shutil.rmtree(place)
    else:
        place.unlink(missing_ok=True)


class Shop:
    """A folder of tiny fields in which a victim can be run and killed again and again."""

    def __init__(self, folder: Path, victim: Victim, defence=nullcontext):
        self.folder, self.victim, self.defence = folder, victim, defence
        self.output = folder / victim.output
        for _ in range(2):  # kernels may be compiled in the first
            self.lay_out()
            began = time.monotonic()
            assert self.run() == 0, victim
            self.seconds = time.monotonic() - began
        self.old, self.new = snapshot(folder / victim.old), snapshot(self.output)
        assert self.old != self.new
        self.others = {place.name for place in folder.iterdir()}

    def lay_out(self) -> None:
        """The old output, and no remains."""
        for name in self.remains():
            _remove(self.folder / name)
        self.restore()

    def restore(self) -> None:
        """The old output."""
        _remove(self.output)
        old = self.folder / self.victim.old
        shutil.copytree(old, self.output) if old.is_dir() else shutil.copy(old, self.output)

    def run(self, kill_after: float | None = None, before: Callable | None = None) -> int:
        def work():
            os.chdir(self.folder)
            with self.defence(), watched(before) if before else nullcontext():
                cli.main(list(self.victim.words))

        return forked(work, kill_after)

    def wrong(self) -> str | None:
        """What a kill broke."""
        found = snapshot(self.output) if self.output.exists() else {}
        if found not in (self.old, self.new):
            return f"neither old nor new: {sorted(found)}"
        if self.output.is_file() and is_bundle(self.output):
            read_bundle(self.output)
        strangers = {place.name for place in self.folder.iterdir()} - self.others
        if bad := [name for name in strangers if not HIDDEN.fullmatch(name)]:
            return f"left behind: {bad}"
        return None

    def remains(self) -> list[str]:
        return [place.name for place in self.folder.iterdir() if HIDDEN.fullmatch(place.name)]


def next_run(shop: Shop) -> list[str]:
    """What is wrong with the run after a killed one: it has to succeed, and to remove the remains."""
    shop.restore()
    code = shop.run()
    done = code == 0 and snapshot(shop.output) == shop.new and not shop.remains()
    return [] if done else [f"the next run ended with {code} and left {shop.remains()}"]


def kill_at_random(shop: Shop, kills: int, rng: random.Random) -> dict:
    """`kills` runs killed at random moments, half of them in the last fifth, where the output is written."""
    wrong, killed, renewed, remained = [], 0, 0, 0
    while killed < kills:
        shop.lay_out()
        share = rng.uniform(0, 1) if rng.random() < 0.5 else rng.uniform(0.8, 1.05)
        caught = shop.run(kill_after=share * shop.seconds) == -signal.SIGKILL
        # Other processes slow the machine down and let it go: what a run takes is followed.
        shop.seconds *= 0.9 if not caught else 1.05 if share > 0.8 else 1
        killed += caught
        wrong += [problem] if (problem := shop.wrong()) else []
        renewed += snapshot(shop.output) == shop.new
        remained += bool(shop.remains())
    wrong += next_run(shop)
    return {"kills": killed, "new": renewed, "with_remains": remained, "wrong": wrong}


def kill_at_every_call(shop: Shop) -> dict:
    """One run killed at the first system call of writing, one at the second, and so on to the last."""
    wrong, k = [], 0
    while True:
        k += 1
        shop.lay_out()
        if shop.run(before=At(k, lambda: os.kill(os.getpid(), signal.SIGKILL))) != -signal.SIGKILL:
            break
        wrong += [f"call {k}: {problem}"] if (problem := shop.wrong()) else []
        if k % 8 == 0:
            wrong += [f"call {k}: {problem}" for problem in next_run(shop)]
    return {"kills": k - 1, "wrong": wrong}


def add_at_once(folder: Path, count: int) -> dict:
    """As many `add` to one pack in place, all begun at once; which of them are in it in the end."""
    shutil.copy(folder / "fused.rfpack", folder / "many.rfpack")
    names = {f"new-{i}" for i in range(count)}

    def adding(name: str) -> Callable:
        def work():
            os.chdir(folder)
            words = ("add", "many.rfpack", "blue.rfpack", "--name", name, "-o", "many.rfpack", *QUICK[:2])
            cli.main(list(words))

        return work

    children = [begun(adding(name)) for name in sorted(names)]
    codes = [os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) for child in children]
    found = {node.name for node in read_bundle(folder / "many.rfpack").scene.nodes} & names
    wrong = [f"lost: {sorted(names - found)}"] if found != names else []
    return {"adds": len(found), "wrong": wrong + [f"exit {code}" for code in codes if code]}


@contextmanager
def in_place():
    """The defence removed: outputs are written where they stand."""

    @contextmanager
    def writer(path, **_):
        with atomic.open(path, "wb") if hasattr(atomic, "open") else open(path, "wb") as file:
            yield file

    with pytest.MonkeyPatch.context() as patch:
        for module in (atomic, bundle, scene):
            patch.setattr(module, "atomic_writer", writer)
        yield


def stocked(folder: Path, names: list[str]) -> None:
    """What the named victims need, made in a child: kernels must not have run before a fork."""

    def work():
        stock_fields(folder)
        if "train" in names:
            write_views(folder / "photos")
        os.chdir(folder)
        (folder / "old-views").mkdir()
        (folder / "old-views" / "old.png").write_bytes(b"old")
        if {"add", "delete"} & set(names):
            cli.main(["fuse", "pair.json", "-o", "fused.rfpack", "-q", "--threads", "1"])

    assert forked(work) == 0


def tried(names: list[str], kills: int, seed: int, calls: bool, adds: int, defence=nullcontext) -> dict:
    """Kill each named command at random moments, at every call, or both; what became of it."""
    found = {}
    with pytest.MonkeyPatch.context() as patch, using(*TINY), tempfile.TemporaryDirectory() as folder:
        make_tiny(patch)
        stocked(Path(folder), names)
        for name in names:
            shop = Shop(Path(folder), VICTIMS[name], defence)
            if kills:
                found[name] = kill_at_random(shop, kills, random.Random(f"{seed}{name}"))
            if calls:
                found[f"{name} at every call"] = kill_at_every_call(shop)
        if adds:
            found["adds at once"] = add_at_once(Path(folder), adds)
    return found


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("commands", nargs="*", metavar="COMMAND", help=", ".join(VICTIMS))
    parser.add_argument("--kills", type=int, default=200, help="at random moments; 0: none")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--adds", type=int, default=0, help="so many adds to one pack at once as well")
    parser.add_argument("--calls", action="store_true", help="at every system call of writing as well")
    parser.add_argument("--in-place", action="store_true", help="without the defence")
    options = parser.parse_args()
    defence = in_place if options.in_place else nullcontext
    names = options.commands or list(VICTIMS)
    found = tried(names, options.kills, options.seed, options.calls, options.adds, defence)
    print(json.dumps(found, indent=1))
    return 1 if any(result["wrong"] for result in found.values()) else 0


if __name__ == "__main__":
    sys.exit(main())
