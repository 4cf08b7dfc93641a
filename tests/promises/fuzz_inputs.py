"""Damaged captures, meshes, scenes and checkpoints: `python -m tests.promises.fuzz_inputs --seed 0`.

`--readers N` mutates N inputs and has the readers read them in this process, `--foreign N` as many of each
format of other systems' checkpoints, `--splats N` of splats (splat_inputs.py). `--commands N` has whole
commands work on N of them, each in a child (commands.py). An input is wrong if it ended in anything but an
error of the program's own, took too long or too much memory, did not end when it was asked to, or left a
temporary. Every input follows from (seed, index).
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
import traceback
import warnings
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path

import numpy as np

from formats.bundle import is_bundle
from formats.captures import read_capture
from formats.checkpoints import read_checkpoint
from formats.errors import FormatError
from formats.meshes import is_mesh, mesh_capture
from formats.photos import load_photos
from fusedrf_cli.errors import FusedRFError
from fusedrf_cli.main import cli
from tests.bridge.conftest import stock_fields
from tests.formats.foreign import samples
from tests.promises.checkpoints import NAME, RUNS, checkpoint, intact, interrupted, spoilt_checkpoint
from tests.promises.commands import PATIENCE, QUICK, judged, run
from tests.promises.fuzz import Hung
from tests.promises.fuzz import patience as patiently
from tests.promises.inputs import CAPTURES, MESHES
from tests.promises.kills import forked
from tests.promises.mutations import DAMAGES, EDGES, TOKENS, spoilt_json
from tests.promises.splat_inputs import splats

MAX_MB = 500
"""Of memory that reading one small input may take."""
EARLY = 0.2
"""Share of the commands that are asked to end after a moment."""
TEXTS = (".json", ".gltf", ".obj", ".mtl", ".txt")
INPUTS = (*CAPTURES, *MESHES, checkpoint)
NUMBERS = ("nan", "inf", "-1", "0", "1e300", "-1e300", "1e-300", "4294967296", "9" * 400, "x", "", "1e999")


# --- mutations ----------------------------------------------------------------------------------------------


def spoil(file: Path, rng: random.Random) -> str:
    """Change a file in place as a disk, another program or an enemy would; what was done."""
    data = file.read_bytes()
    if file.name == NAME:
        done, data = spoilt_checkpoint(data, rng)
        file.write_bytes(data)
        return done
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
    """What `train` reads of an input, pixels too; a checkpoint that is read has to be sealed."""
    if source.name == NAME:
        read_checkpoint(source)
        assert intact(source.read_bytes())
        return
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
            outcome, problem = reading(source)
            found[f"{name}: {outcome}"] += 1
            if problem:
                wrong.append({"index": index, "kind": name, "done": done, "problem": problem})
    return {"inputs": count, "wrong": wrong, "counts": dict(sorted(found.items()))}


def foreign(count: int, seed: int, folder: Path) -> dict:
    """`count` mutations of a checkpoint of every system, and of its settings, through the readers; what went
    wrong."""
    found, wrong = Counter(), []
    makers = {name: partial(samples.write, name) for name in samples.SYSTEMS}
    makers |= {make.__name__: make for make in (samples.old_torch, samples.compressed_npz)}
    for name, make in makers.items():
        home = folder / name
        home.mkdir()
        path = make(home)
        whole = {file: file.read_bytes() for file in home.rglob("*") if file.is_file()}
        for index in range(count):
            rng = random.Random(f"foreign/{seed}/{name}/{index}")
            file = path if rng.random() < 0.8 else rng.choice(sorted(whole))
            file.write_bytes(samples.spoilt(whole[file], rng))
            if file.suffix in (*TEXTS, ".yml", ".py") and rng.random() < 0.7:
                file.write_bytes(spoilt_words(whole[file], rng))
            outcome, problem = reading(path, samples.read_all)
            found[f"{name}: {outcome}"] += 1
            if problem:
                wrong.append({"index": index, "kind": name, "done": file.name, "problem": problem})
            file.write_bytes(whole[file])
    return {"inputs": found.total(), "wrong": wrong, "counts": dict(sorted(found.items()))}


def reading(source: Path, read: Callable[[Path], None] = read) -> tuple[str, str | None]:
    """How reading ended, and what is wrong with that."""
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    try:
        with patiently():
            read(source)
    except (FormatError, FusedRFError) as error:
        return "refused", None if str(error).isprintable() else f"prints {error}"
    except Hung:
        return "hung", "hung"
    except Exception:
        return "crashed", traceback.format_exc()
    taken = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) >> 10
    return "read", None if taken < MAX_MB else f"took {taken} MB"


def laid_out(folder: Path) -> dict[str, Path]:
    """Sound inputs of every kind in a folder, each in one of its own; where the source of each lies in it."""
    return {make.__name__: make(folder / "sound" / make.__name__) for make in INPUTS}


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


def commands(count: int, seed: int, folder: Path) -> dict:
    """`count` mutated inputs through whole commands, each in a child; what went wrong."""
    found, wrong = Counter(), []
    sound = laid_out(folder)
    assert forked(lambda: prepare(folder)) == 0  # kernels must not have run before a fork
    for index in range(count):
        rng = random.Random(f"commands/{seed}/{index}")
        words, name, done = line(folder, sound, rng)
        torn = "--resume" in words and not intact((folder / NAME).read_bytes())
        early = rng.random() < EARLY
        code, said, asked = run(words, folder, rng.uniform(0.0, 2.0) if early else PATIENCE)
        found[f"{words[0]} {name}: exit {code}"] += 1
        found["asked to end"] += bool(asked)
        if problem := judged_run(code, said, early, torn, folder):
            case = {"index": index, "words": words, "kind": name, "done": done, "problem": problem}
            wrong.append(case | {"said": said[-2000:]})
    return {"commands": count, "wrong": wrong, "counts": dict(sorted(found.items()))}


def judged_run(code: int, said: str, early: bool, torn: bool, folder: Path) -> str | None:
    """What is wrong with how a command ended, which may have been asked to end before it began, or to go on
    from a checkpoint that is `torn`."""
    if early and code == -signal.SIGTERM:
        return None
    if not early and code in (-signal.SIGTERM, 128 + signal.SIGTERM):
        return "took too long"
    return judged(code, said, torn and not early, folder)


def prepare(folder: Path) -> None:
    """Fields, scenes and a fused bundle."""
    os.chdir(folder)
    stock_fields(folder)
    with suppress(SystemExit):
        cli.main(["fuse", "pair.json", "-o", "good.rfpack", *QUICK])
    assert is_bundle(Path("good.rfpack"))
    for name, words in RUNS.items():
        Path(f"{name}.checkpoint").write_bytes(interrupted(folder, words))


SCENE = "damaged.json"
OVER_SCENES = (
    ("render", SCENE, "--size", "16x16", "-o", "out.png", *QUICK),
    ("fuse", SCENE, "-o", "out.rfpack", "--time-budget", "1", *QUICK),
    ("eval", "good.rfpack", "--against", SCENE, *QUICK[1:]),
    ("compose", SCENE, "-o", "out.json", "-w", "-q"),
    ("info", SCENE),
    ("validate", SCENE),
)
OVER_CAPTURES = (
    ("train", "SOURCE", "-o", "out.rfpack", "--views", "4", "--size", "16", "--time-budget", "1", *QUICK),
    ("info", "SOURCE"),
)


def line(folder: Path, sound: dict[str, Path], rng: random.Random) -> tuple[tuple[str, ...], str, str]:
    """A command line over a damaged input, which kind of input it is, and what was done to it."""
    kind = rng.random()
    if kind < 0.25:
        name = rng.choice(sorted(RUNS))
        shutil.copy(folder / f"{name}.checkpoint", folder / NAME)
        done = f"checkpoint: {spoil(folder / NAME, rng)}"
        return (*RUNS[name], "-o", "out.rfpack", "--resume"), f"checkpoint of {name}", done
    if kind < 0.5:
        shutil.copy(folder / "pair.json", folder / SCENE)
        done = f"scene: {spoil(folder / SCENE, rng)}"
        return rng.choice(OVER_SCENES), "scene", done
    name, source, done = damaged(folder, sound, rng)
    words = rng.choice(OVER_CAPTURES)
    source = str(source.relative_to(folder))
    return tuple(source if word == "SOURCE" else word for word in words), name, done


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--readers", type=int, default=10_000)
    parser.add_argument("--foreign", type=int, default=2_000)
    parser.add_argument("--commands", type=int, default=500)
    parser.add_argument("--splats", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    found = {}
    for tried, count in (
        (readers, options.readers),
        (foreign, options.foreign),
        (splats, options.splats),
        (commands, options.commands),
    ):
        if count:
            with tempfile.TemporaryDirectory() as folder:
                found[tried.__name__] = tried(count, options.seed, Path(folder))
    print(json.dumps(found, indent=1))
    return 1 if any(result["wrong"] for result in found.values()) else 0


if __name__ == "__main__":
    sys.exit(main())
