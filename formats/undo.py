"""Earlier bundles of an edited one: `BUNDLE.history/SHA256.rfpack` beside it, each with the bytes that it
had. An edit that keeps its input says its SHA-256 as `before` in the entry of history that it adds.
"""

import os
import re
import shutil
from pathlib import Path

from formats.atomic import atomic_writer, check_space, check_writable, sync_file, sync_folder
from formats.bundle import is_bundle, read_headers, sha256_of
from formats.errors import BadSchema, FormatError, MissingFile, ResourceError
from formats.history import names_of, psnr_of
from formats.scene import SceneGraph

KEPT = 64
"""Earlier bundles of one, at most; the oldest go."""
CHECKSUM = re.compile(r"[0-9a-f]{64}")


def history_folder(bundle: Path | str) -> Path:
    """The folder of a bundle's earlier ones, which need not exist."""
    return Path(f"{bundle}.history")


def check_history_folder(bundle: Path | str, output: Path | str) -> None:
    """Before any work: a bundle and its earlier ones can be kept as what an output will have been. Raises
    ResourceError."""
    folder = history_folder(output)
    if not os.path.lexists(folder):
        check_writable(folder, overwrite=False)
    elif not folder.is_dir():
        raise ResourceError(f"{folder}: no folder, and in the way; move it, or leave --undoable out")
    elif not os.access(folder, os.W_OK | os.X_OK):
        raise ResourceError(f"{folder}: cannot write in it; make it writable, or leave --undoable out")
    copy = folder if folder.is_dir() else folder.parent
    if os.path.isfile(bundle) and os.stat(bundle).st_dev != os.stat(copy).st_dev:  # no link will do
        check_space(folder, os.path.getsize(bundle))


def keep(bundle: Path | str, output: Path | str, most: int = KEPT) -> str:
    """Keep a bundle and its own earlier ones as what an output will have been; its SHA-256. Of those in the
    folder at most so many stay, the output's own before all.

    Where the file system can, the bytes are shared with the bundle that is there. Raises ResourceError."""
    checksum = sha256_of(bundle)
    share(bundle, bundle, output)
    folder = ensure_folder(history_folder(output))
    link(Path(bundle), folder / f"{checksum}.rfpack", checksum)
    prune(folder, [checksum, *chain(folder, bundle)], most)
    sync_folder(folder)
    return checksum


def ensure_folder(folder: Path) -> Path:
    """A folder that is there, and on the disk."""
    if not folder.is_dir():
        folder.mkdir()
        sync_folder(folder.parent)
    return folder


def chain(folder: Path, bundle: Path | str) -> list[str]:
    """The checksums of the bundles before one, the latest first, as far as they are in the folder."""
    checksums, path = [], Path(bundle)
    while len(checksums) < KEPT:
        try:
            checksum = before(read_headers(path)[0])
        except FormatError:
            if not checksums:
                raise
            break  # it was damaged since it was kept
        path = folder / f"{checksum}.rfpack"
        if checksum is None or not path.is_file():
            break
        checksums.append(checksum)
    return checksums


def prune(folder: Path, newest: list[str], most: int) -> None:
    """Remove bundles until at most so many are there: first those that are none of an output's `newest`,
    which come the latest first, and then its earliest. What this module did not put there is left alone:
    whatever is not named by the checksum that it has."""
    stored = {path.stem for path in folder.glob("*.rfpack") if CHECKSUM.fullmatch(path.stem)}
    paths = {checksum: folder / f"{checksum}.rfpack" for checksum in stored}
    others = sorted(stored - set(newest), key=lambda checksum: paths[checksum].lstat().st_mtime)
    for checksum in [*others, *reversed([c for c in newest if c in stored])][: max(0, len(stored) - most)]:
        path = paths[checksum]
        if path.is_file() and sha256_of(path) == checksum:
            path.unlink(missing_ok=True)


def share(bundle: Path | str, kept_of: Path | str, output: Path | str) -> None:
    """Have the bundles before one, which were kept as what `kept_of` was, as what an output was, too."""
    source, other = history_folder(kept_of), history_folder(output)
    earlier = chain(source, bundle)
    if not earlier or os.path.realpath(source) == os.path.realpath(other):
        return
    check_history_folder(kept_of, output)
    for checksum in earlier:
        link(source / f"{checksum}.rfpack", ensure_folder(other) / f"{checksum}.rfpack", checksum)


def link(path: Path, target: Path, checksum: str) -> None:
    """The same bytes at another path, and on the disk. Raises ResourceError where others are there."""
    if os.path.lexists(target):
        if target.is_file() and sha256_of(target) == checksum:
            return
        raise ResourceError(f"{target}: holds something else than its name says; move it away")
    try:
        os.link(path, target)
    except OSError:  # another disk, or one without links
        copy(path, target)
    else:
        sync_file(target)


def copy(path: Path, target: Path | str) -> int:
    """Write a file's bytes whole or not at all; how many."""
    with open(path, "rb") as source, atomic_writer(target) as file:
        shutil.copyfileobj(source, file)
        return file.tell()


def before(scene: SceneGraph) -> str | None:
    """The SHA-256 of the bundle that the last edit was done to, where it was kept."""
    checksum = scene.history[-1].get("before") if scene.history else None
    return checksum if isinstance(checksum, str) and CHECKSUM.fullmatch(checksum) else None


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
            f"{bundle}: what it was before its last edit was not kept; edit with --undoable to undo it"
        )
    path = history_folder(bundle) / f"{checksum}.rfpack"
    if not path.is_file() or sha256_of(path) != checksum:
        raise MissingFile(
            f"{path}: the bundle before the last edit is not there as it was; keep the folder "
            f"{history_folder(bundle).name} beside the bundle"
        )
    last = scene.history[-1]
    share(path, bundle, output)
    size = copy(path, output)
    return {
        "output": str(output),
        "bytes": size,
        "undone": last.get("event", "edited"),
        "objects": names_of(last),
        "more": len(chain(history_folder(output), output)),
    }


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
    return {"path": str(bundle), "undoable": len(chain(history_folder(bundle), bundle)), "history": entries}
