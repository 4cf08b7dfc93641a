"""Damaged captures, meshes, scenes and checkpoints: `python -m tests.promises.fuzz_inputs --seed 0`.

`--readers N` mutates N inputs and has the readers read them in this process. `--commands N` has whole
commands work on N of them, each in a child forked from one warm process, under limits of memory and time; one
in five is told to end (SIGTERM) meanwhile. An input is wrong if it ended in anything but an error of the
program's own, took too long, took too much memory, did not end when told to, or left a temporary. Every input
follows from (seed, index).
"""

import argparse
import json
import os
import random
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from formats.captures import load_photos, read_capture
from formats.errors import FormatError
from formats.meshes import is_mesh, mesh_capture
from fusedrf_cli import bridge  # noqa: F401  (imported before the first fork)
from fusedrf_cli.errors import FusedRFError
from fusedrf_cli.main import cli
from tests.bridge.conftest import make_tiny, stock_fields
from tests.promises.fuzz import Hung, patience
from tests.promises.inputs import CAPTURES, MESHES
from tests.promises.kills import HIDDEN, forked
from tests.promises.mutations import DAMAGES, EDGES, TOKENS, spoilt_json

MEMORY = 4 << 30
"""Bytes that a child may map beside what the warm process has."""
SECONDS = 60.0
"""Until a command is hung; other processes slow it down."""
ENDING = 10.0
"""Seconds from SIGTERM to the end."""
TEXTS = (".json", ".gltf", ".obj", ".mtl", ".txt")
NUMBERS = ("nan", "inf", "-1", "0", "1e300", "-1e300", "1e-300", "4294967296", "9" * 400, "x", "", "1e999")
FINE = {0, 3, 4, 5, 6, 7}
"""Exit codes that tell of an input; 2 is a fault of the command line."""


# --- mutations ----------------------------------------------------------------------------------------------


def spoil(file: Path, rng: random.Random) -> str:
    """Change a file in place as a disk, another program or an enemy would; what was done."""
    data = file.read_bytes()
    if file.suffix in (".json", ".gltf") and rng.random() < 0.7:
        file.write_bytes(spoilt_json(data, rng))
        return "JSON"
    if file.suffix in TEXTS and rng.random() < 0.7:
        file.write_bytes(spoilt_words(data, rng))
        return "words"
    if file.suffix == ".glb" and rng.random() < 0.5:
        file.write_bytes(spoilt_glb(data, rng))
        return "JSON of a .glb"
    if len(data) > 8 and rng.random() < 0.4:
        file.write_bytes(spoilt_number(bytearray(data), rng))
        return "number"
    kind = rng.choice(sorted(DAMAGES.keys() - {"edge"}))
    file.write_bytes(DAMAGES[kind](bytearray(data or b"\0"), rng))
    return kind


def spoilt_words(data: bytes, rng: random.Random) -> bytes:
    """Text with some words or lines of it replaced, left out or doubled."""
    lines = data.split(b"\n")
    for _ in range(rng.choice((1, 1, 2, 5))):
        at = rng.randrange(len(lines))
        words = lines[at].split(b" ")
        how = rng.randrange(4)
        if how == 0:
            lines[at : at + 1] = [lines[at]] * rng.choice((0, 2, 50))
        elif how == 1:
            words[rng.randrange(len(words))] = rng.choice(NUMBERS).encode()
            lines[at] = b" ".join(words)
        elif how == 2:
            del words[rng.randrange(len(words))]
            lines[at] = b" ".join(words)
        else:
            lines[at] = rng.choice(TOKENS).encode("utf-8", "surrogatepass")
        lines = lines or [b""]
    return b"\n".join(lines)


def spoilt_glb(data: bytes, rng: random.Random) -> bytes:
    """A .glb whose JSON was changed, under right lengths."""
    length = int.from_bytes(data[12:16], "little")
    text = spoilt_json(data[20 : 20 + length], rng)
    text += b" " * (-len(text) % 4)
    rest = data[20 + length :]
    head = data[:8] + (20 + len(text) + len(rest)).to_bytes(4, "little")
    return head + len(text).to_bytes(4, "little") + data[16:20] + text + rest


def spoilt_number(data: bytearray, rng: random.Random) -> bytes:
    """A number at the edge of what an integer or a float holds, where one may stand."""
    at = rng.randrange(max(1, min(len(data) - 8, rng.choice((64, 512, len(data))))))
    if rng.random() < 0.3:
        data[at : at + 8] = np.float64(rng.choice((np.nan, np.inf, 1e300, -1e-300, 1e18))).tobytes()
    else:
        size = rng.choice((1, 2, 4, 8))
        data[at : at + size] = (rng.choice(EDGES) % 256**size).to_bytes(size, "little")
    return bytes(data)


# --- readers ------------------------------------------------------------------------------------------------


def read(source: Path) -> None:
    """What `train` reads of an input, pixels too."""
    if is_mesh(source):
        mesh_capture(source, n_train=2, size=8, samples_per_pixel=1)
        return
    capture = read_capture(source)
    load_photos(capture.train or capture.test)


def readers(count: int, seed: int, folder: Path) -> dict:
    """`count` mutated inputs through the readers; what went wrong."""
    sound, found, wrong = laid_out(folder), Counter(), []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for index in range(count):
            rng = random.Random(f"readers/{seed}/{index}")
            name, source, done = damaged(folder, sound, rng)
            outcome, problem = judged(source)
            found[f"{name}: {outcome}"] += 1
            if problem:
                wrong.append({"index": index, "kind": name, "done": done, "problem": problem})
    return {"inputs": count, "wrong": wrong, "counts": dict(sorted(found.items()))}


def judged(source: Path) -> tuple[str, str | None]:
    """How reading ended, and what is wrong with that."""
    try:
        with patience():
            read(source)
    except (FormatError, FusedRFError) as error:
        return "refused", None if str(error).isprintable() else f"prints {error}"
    except Hung:
        return "hung", "hung"
    except Exception:
        return "crashed", traceback.format_exc()
    return "read", None


def laid_out(folder: Path) -> dict[str, Path]:
    """Sound inputs of every kind in a folder, each in one of its own; where the source of each lies in it."""
    return {make.__name__: make(folder / "sound" / make.__name__) for make in CAPTURES + MESHES}


def damaged(folder: Path, sound: dict[str, Path], rng: random.Random) -> tuple[str, Path, str]:
    """A kind of input, the source of a copy of which one file was changed, and what was done."""
    name = rng.choice(sorted(sound))
    home, copy = folder / "sound" / name, folder / "damaged"
    shutil.rmtree(copy, ignore_errors=True)
    shutil.copytree(home, copy)
    files = sorted(path for path in copy.rglob("*") if path.is_file())
    # what tells of poses and faces more often than pictures
    file = rng.choice([f for f in files if f.suffix != ".png"] if rng.random() < 0.7 else files)
    done = f"{file.relative_to(copy)}: {spoil(file, rng)}"
    return name, copy / sound[name].relative_to(home), done


# --- commands -----------------------------------------------------------------------------------------------


def command(words: list[str], errors: Path, folder: Path) -> Callable[[], None]:
    """A child's work: one command in a folder, under limits, with stderr in a file."""

    def work() -> None:
        os.chdir(folder)
        mapped = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
        resource.setrlimit(resource.RLIMIT_AS, (mapped + MEMORY, mapped + MEMORY))
        stream = os.open(errors, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
        os.dup2(stream, 2)
        signal.signal(signal.SIGTERM, signal.default_int_handler)
        cli.main(words)

    return work


def commands(count: int, seed: int, folder: Path) -> dict:
    """`count` mutated inputs through whole commands; what went wrong."""
    found, wrong = Counter(), []
    with pytest.MonkeyPatch.context() as patch:
        make_tiny(patch)
        sound = laid_out(folder)
        assert forked(lambda: prepare(folder)) == 0
        for index in range(count):
            rng = random.Random(f"commands/{seed}/{index}")
            words, name, done = line(folder, sound, rng)
            outcome, problem = run(words, folder, rng)
            found[f"{words[0]} {name}: {outcome}"] += 1
            if problem:
                case = {"index": index, "words": words, "kind": name, "done": done, "problem": problem}
                wrong.append(case)
    return {"commands": count, "wrong": wrong, "counts": dict(sorted(found.items()))}


def prepare(folder: Path) -> None:
    """Fields, scenes and a checkpoint, in a child: kernels must not have run before a fork."""
    stock_fields(folder)
    os.chdir(folder)
    for words in (
        ["train", "sound/blender", "-o", "warm.rfpack", *QUIET],
        ["fuse", "pair.json", "-o", "fused.rfpack", *QUIET],
        ["render", "pair.json", "--size", "16x16", "-o", "warm.png", *QUIET],
    ):
        with suppress(SystemExit):
            cli.main(words)
    assert Path("warm.rfpack").exists() and Path("fused.rfpack").exists() and Path("warm.png").exists()


QUIET = ("-w", "-q", "--threads", "1")


def line(folder: Path, sound: dict[str, Path], rng: random.Random) -> tuple[list[str], str, str]:
    """A command line over a damaged input, which kind of input it is, and what was done to it."""
    what = rng.choice(("train", "train", "train", "info", "scene", "scene"))
    if what == "scene":
        scene = folder / "scene-damaged.json"
        shutil.copy(folder / "pair.json", scene)
        done = f"scene: {spoil(scene, rng)}"
        verb = rng.choice(("render", "fuse", "info", "validate", "eval", "compose"))
        tail = {
            "render": ["--size", "16x16", "-o", "out.png", *QUIET],
            "fuse": ["-o", "out.rfpack", *QUIET],
            "eval": ["fused.rfpack", "--threads", "1"],
            "compose": ["-o", "out.json", "-w", "-q"],
        }
        words = [verb, scene.name] if verb != "eval" else ["eval", "fused.rfpack", "--against", scene.name]
        extra = tail.get(verb, []) if verb != "eval" else ["--threads", "1"]
        return words + extra, "scene", done
    name, source, done = damaged(folder, sound, rng)
    source = str(source.relative_to(folder))
    words = ["info", source] if what == "info" else ["train", source, "-o", "out.rfpack", "--views", "4"]
    return words + ([] if what == "info" else ["--size", "16", *QUIET]), name, done


def run(words: list[str], folder: Path, rng: random.Random) -> tuple[str, str | None]:
    """How a command in a child ended, and what is wrong with that."""
    errors = folder / "stderr.txt"
    told = rng.random() < 0.2
    before = {path.name for path in folder.iterdir()} | {"out.rfpack", "out.png", "out.json", errors.name}
    child = os.fork()
    if child == 0:
        os._exit(silent(command(words, errors, folder)))
    status, waited = awaited(child, rng.uniform(0, 1.5) if told else SECONDS)
    if status is None and not told:
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        return "hung", f"not done after {SECONDS:g} s"
    if status is None:
        os.kill(child, signal.SIGTERM)
        status, waited = awaited(child, ENDING)
        if status is None:
            os.kill(child, signal.SIGKILL)
            os.waitpid(child, 0)
            return "deaf", f"did not end {ENDING:g} s after SIGTERM"
        return "ended", None
    code = os.waitstatus_to_exitcode(status)
    said = errors.read_text(errors="replace") if errors.exists() else ""
    left = {path.name for path in folder.iterdir()} - before
    if code not in FINE or "internal error" in said or "Traceback" in said:
        return f"exit {code}", said[-2000:] or f"exit {code} in silence"
    if hidden := [path for path in left if HIDDEN.fullmatch(path)]:
        return f"exit {code}", f"left {hidden}"
    return f"exit {code}", None


def silent(work: Callable[[], None]) -> int:
    """The exit code of a child's work, which prints nothing."""
    null = os.open(os.devnull, os.O_RDWR)
    for stream in range(3):
        os.dup2(null, stream)
    try:
        work()
    except SystemExit as done:
        return done.code or 0
    except BaseException:
        traceback.print_exc()
        return 70
    return 0


def awaited(child: int, seconds: float) -> tuple[int | None, float]:
    """The status of a child that ends within some seconds, or None; and how long it took."""
    began = time.monotonic()
    while (passed := time.monotonic() - began) < seconds:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            return status, passed
        time.sleep(0.005)
    return None, passed


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--readers", type=int, default=10_000)
    parser.add_argument("--commands", type=int, default=500)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    found = {}
    for tried, count in ((readers, options.readers), (commands, options.commands)):
        if count:
            with tempfile.TemporaryDirectory() as folder:
                found[tried.__name__] = tried(count, options.seed, Path(folder))
    print(json.dumps(found, indent=1))
    return 1 if any(result["wrong"] for result in found.values()) else 0


if __name__ == "__main__":
    sys.exit(main())
