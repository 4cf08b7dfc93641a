"""Earlier bundles of an edited one: `BUNDLE.history/SHA256.rfpack` beside it, each with the bytes that it
had. An edit that keeps its input says its SHA-256 as `before` in the entry of history that it adds.
"""

import contextlib
import os
import re
import shutil
from pathlib import Path

from formats.atomic import atomic_writer
from formats.bundle import is_bundle, read_headers, sha256_of
from formats.errors import BadSchema, MissingFile
from formats.scene import SceneGraph

KEPT = 64
"""Earlier bundles of one, at most; the oldest go."""
CHECKSUM = re.compile(r"[0-9a-f]{64}")


def past_of(bundle: Path | str) -> Path:
    """The folder of a bundle's earlier ones, which need not exist."""
    return Path(f"{bundle}.history")


def keep(bundle: Path | str, output: Path | str) -> str:
    """Keep a bundle and its own earlier ones as what an output will have been; its SHA-256.

    Where the file system can, the bytes are shared with the bundle that is there. Raises ResourceError."""
    checksum = sha256_of(bundle)
    share(past_of(bundle), past_of(output))
    folder = past_of(output)
    folder.mkdir(exist_ok=True)
    link(Path(bundle), folder / f"{checksum}.rfpack")
    held = sorted(folder.glob("*.rfpack"), key=lambda path: path.stat().st_mtime)
    for old in held[: max(0, len(held) - KEPT)]:
        old.unlink(missing_ok=True)
    return checksum


def share(own: Path, other: Path) -> None:
    """Have the bundles of one folder in another one too."""
    if not own.is_dir() or os.path.realpath(own) == os.path.realpath(other):
        return
    other.mkdir(exist_ok=True)
    for path in own.glob("*.rfpack"):
        link(path, other / path.name)


def link(path: Path, target: Path) -> None:
    """The same bytes at another path, where there is nothing yet."""
    with contextlib.suppress(FileExistsError):
        try:
            os.link(path, target)
        except FileExistsError:
            raise
        except OSError:  # another disk, or one without links
            copy(path, target)


def copy(path: Path, target: Path | str) -> int:
    """Write a file's bytes whole or not at all; how many."""
    with open(path, "rb") as source, atomic_writer(target) as file:
        shutil.copyfileobj(source, file)
        return file.tell()


def before(scene: SceneGraph) -> str | None:
    """The SHA-256 of the bundle that the last edit was done to, where it was kept."""
    said = scene.history[-1].get("before") if scene.history else None
    return said if isinstance(said, str) and CHECKSUM.fullmatch(said) else None


def undo(bundle: Path | str, output: Path | str) -> dict:
    """Write the bytes that a bundle had before its last edit; what was undone, and how many more can be.

    Raises BadSchema where it is no bundle or was not kept, MissingFile where the earlier one is gone or is
    another now."""
    if not is_bundle(bundle):
        raise BadSchema(f"{bundle}: not a bundle; only edits of a fused .rfpack can be undone")
    scene, _ = read_headers(bundle)
    checksum = before(scene)
    if all(entry.get("event") == "fused" and not entry.get("edits") for entry in scene.history):
        raise BadSchema(f"{bundle}: it was not edited since it was made; there is nothing to undo")
    if checksum is None:
        raise BadSchema(
            f"{bundle}: what it was before its last edit was not kept; edit with --keep-history to undo it"
        )
    path = past_of(bundle) / f"{checksum}.rfpack"
    if not path.is_file() or sha256_of(path) != checksum:
        raise MissingFile(
            f"{path}: the bundle before the last edit is not there as it was; keep the folder "
            f"{past_of(bundle).name} beside the bundle"
        )
    last = scene.history[-1]
    share(past_of(bundle), past_of(output))
    size = copy(path, output)
    return {
        "output": str(output),
        "bytes": size,
        "undone": last.get("event", "edited"),
        "objects": names_of(last),
        "more": depth(past_of(output), output),
    }


def depth(folder: Path, bundle: Path | str) -> int:
    """How many edits of a bundle can be undone, one after the other."""
    found, path = 0, Path(bundle)
    while found < KEPT:
        checksum = before(read_headers(path)[0])
        path = folder / f"{checksum}.rfpack"
        if checksum is None or not path.is_file():
            break
        found += 1
    return found


def names_of(entry: dict) -> list[str]:
    """The objects that an entry of history tells of."""
    nodes = entry.get("nodes") if isinstance(entry.get("nodes"), list) else []
    said = entry.get("names") if isinstance(entry.get("names"), list) else []
    names = [node.get("name") for node in nodes if isinstance(node, dict)]
    return [name for name in dict.fromkeys([*said, *names]) if isinstance(name, str)]


def psnr_of(entry: dict) -> float | None:
    """The dB that an edit or a fuse reached, as its entry of history says."""
    said = entry.get("psnr")
    said = said.get("stored", said.get("psnr")) if isinstance(said, dict) else said
    return float(said) if isinstance(said, int | float) else None


def history(bundle: Path | str) -> dict:
    """What was done to a bundle, the earliest first, and how many of its edits can be undone. Raises
    BadSchema where it is no bundle."""
    if not is_bundle(bundle):
        raise BadSchema(f"{bundle}: not a bundle; only a .rfpack has a history")
    scene, _ = read_headers(bundle)
    entries = [
        {
            "event": entry.get("event", "edited"),
            "objects": names_of(entry),
            "psnr": psnr_of(entry),
            "edits": entry.get("edits"),
        }
        for entry in scene.history
    ]
    return {"path": str(bundle), "undoable": depth(past_of(bundle), bundle), "history": entries}
