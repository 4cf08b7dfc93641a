"""Damaged and hostile files of splats of every format, for `fuzz_inputs.py` and a quick test.

A file is wrong if reading it ended in anything but an error of the program's own, took too long, gave
numbers that splats cannot have, or gave other splats than were written where a checksum could tell.
"""

import gzip
import random
import traceback
from collections import Counter
from pathlib import Path

import numpy as np

from formats.errors import FormatError
from formats.splats.reading import is_splats, read_splats
from formats.splats.splats import Splats
from tests.formats.splats import writers
from tests.promises.fuzz import Hung
from tests.promises.fuzz import patience as patiently
from tests.promises.mutations import DAMAGES, EDGES, spoilt_json

COUNT = 9
FORMATS = {
    "ply": writers.ply(writers.content(COUNT, 1)),
    "ply ascii": writers.ply(writers.content(COUNT, 1), "ascii"),
    "ply compressed": writers.compressed_ply(writers.content(COUNT, 2)),
    "splat": writers.splat(writers.content(COUNT, 0)),
    "ksplat 0": writers.ksplat(writers.content(COUNT, 1)),
    "ksplat 1": writers.ksplat(writers.content(COUNT, 2), 1),
    "ksplat 2": writers.ksplat(writers.content(COUNT, 2), 2),
    "spz 2": writers.spz(writers.content(COUNT, 1), 2),
    "spz 3": writers.spz(writers.content(COUNT, 3), 3),
    "spz 4": writers.spz(writers.content(COUNT, 1), 4),
    "sog 1": writers.sog(writers.content(COUNT, 1), 1),
    "sog 2": writers.sog(writers.content(COUNT, 2), 2),
    "glb": writers.glb(writers.content(COUNT, 1)),
    "glb of spz": writers.as_glb(writers.gltf_of_spz(writers.content(COUNT, 1), translation=[1, 2, 3])),
}
SEALED = ("spz 2", "spz 3", "sog 1", "sog 2")
"""Formats with checksums over all that counts."""


def splats(count: int, seed: int, folder: Path) -> dict:
    """`count` mutations of each format; what went wrong."""
    found, wrong, path = Counter(), [], folder / "hostile"
    for name, sound in FORMATS.items():
        expected = read_splats(writers.written(path, sound))
        for index in range(count):
            rng = random.Random(f"splats/{seed}/{name}/{index}")
            how, data, sealed = mutated(name, sound, rng)
            path.write_bytes(data)
            outcome, problem = reading(path, expected if name in SEALED and not sealed else None)
            found[f"{name}: {outcome}"] += 1
            if problem:
                wrong.append({"kind": name, "index": index, "done": how, "problem": problem})
    return {"inputs": count * len(FORMATS), "wrong": wrong, "counts": dict(sorted(found.items()))}


def reading(path: Path, expected: Splats | None) -> tuple[str, str | None]:
    """How reading ended, and what is wrong with that."""
    try:
        with patiently():
            if not is_splats(path):
                return "no splats", None
            return "read", fault(read_splats(path), expected)
    except FormatError as error:
        return "refused", None if str(error).isprintable() else f"prints {error}"
    except Hung:
        return "hung", "hung"
    except Exception:
        return "crashed", traceback.format_exc()


def fault(splats: Splats, expected: Splats | None) -> str | None:
    """What splats have that they cannot have."""
    arrays = (splats.centres, splats.scales, splats.rotations, splats.opacities, splats.harmonics)
    if not all(np.isfinite(each).all() and len(each) == len(splats) for each in arrays):
        return "not finite"
    if not (splats.scales > 0).all() or not ((splats.opacities >= 0) & (splats.opacities <= 1)).all():
        return "out of range"
    if np.abs(np.linalg.norm(splats.rotations, axis=1) - 1).max() > 1e-5:
        return "no unit quaternions"
    if not all(note.isprintable() for note in splats.notes):
        return f"prints {splats.notes}"
    if expected is not None and not np.array_equal(splats.harmonics, expected.harmonics):
        return "other splats than were written"
    return None


# --- mutations ----------------------------------------------------------------------------------------------


def mutated(name: str, sound: bytes, rng: random.Random) -> tuple[str, bytes, bool]:
    """What was done, the file, and whether its checksums were made anew."""
    if name.startswith(("spz", "sog", "glb")) and rng.random() < 0.6:
        how, data = _within(name, sound, rng)
        return how, data, True
    how, data = _damaged(sound, rng)
    return how, data, False


def _damaged(data: bytes, rng: random.Random) -> tuple[str, bytes]:
    if rng.random() < 0.3:  # a number at the edge, mostly in a header
        changed = bytearray(data)
        at = rng.randrange(min(len(data), rng.choice((16, 64, 5200, len(data)))))
        size = rng.choice((1, 2, 4, 8))
        number = rng.choice(EDGES) % 256**size
        changed[at : at + size] = number.to_bytes(size, "little")
        if rng.random() < 0.3:
            changed[at : at + 4] = np.float32(rng.choice((np.nan, np.inf, 3e38, -1e-40, 1e12))).tobytes()
        return "number", bytes(changed)
    how = rng.choice(sorted(DAMAGES.keys() - {"edge"}))
    return how, DAMAGES[how](bytearray(data), rng)


def _within(name: str, sound: bytes, rng: random.Random) -> tuple[str, bytes]:
    """Changes below the packing: of what gzip holds, of a stream of zstd, of a file of a zip, of JSON."""
    if name in ("spz 2", "spz 3"):
        how, data = _damaged(gzip.decompress(sound), rng)
        return f"gzip of {how}", gzip.compress(data, 1, mtime=0)
    if name == "spz 4":
        splats = writers.content(COUNT, 1)
        streams = writers.spz_streams(splats, 4)
        at = rng.randrange(len(streams))
        how, streams[at] = _damaged(streams[at], rng)
        return f"stream {at} of {how}", writers.spz_container(splats, streams)
    if name.startswith("sog"):
        degree, version = (1, 1) if name == "sog 1" else (2, 2)
        files = writers.sog_files(writers.content(COUNT, degree), version)
        file = rng.choice(["meta.json"] * 6 + sorted(files))
        if file == "meta.json":
            how, files[file] = "JSON", spoilt_json(files[file], rng)
        else:
            how, files[file] = _damaged(files[file], rng)
        return f"{file} of {how}", writers.zipped(files)
    length = int.from_bytes(sound[12:16], "little")
    text, blob = sound[20 : 20 + length], sound[28 + length :]
    return "JSON", writers.glb_of(spoilt_json(text, rng), blob)
