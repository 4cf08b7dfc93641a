"""Which system wrote a checkpoint, told by what the file holds, and what its run says beside it."""

import re
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from formats.errors import (
    FormatError,
    NewerVersion,
    OlderVersion,
    UnknownCheckpoint,
    counted,
    listed,
    noted,
)
from formats.foreign.beside import read_beside
from formats.foreign.msgpack_file import GZIP, read_msgpack
from formats.foreign.npz_file import array_names, read_npz
from formats.foreign.stored import StoredTensor
from formats.foreign.torch_file import OLD_MAGIC, pickle_member, read_torch
from formats.foreign.zip_file import MAGIC as ZIP
from formats.foreign.zip_file import Archive
from formats.other_files import HEAD, identify
from formats.safe_input import open_input

NGP_VERSION = 1
ENDINGS = (".th", ".tar", ".pth", ".pt", ".ckpt", ".npz", ".ingp", ".msgpack")
"""Of files of a folder that may be a run's checkpoints, beside those named `checkpoint_N`."""
FOLDERS = ("nerfstudio_models", "checkpoints")
"""Folders of a run that hold its checkpoints."""
MAX_FILES = 2000
MAX_TRIED = 50


@dataclass(frozen=True)
class Checkpoint:
    """A checkpoint of another system.

    `system` is a name of SYSTEMS, `entries` what the file holds: plain containers, with a StoredTensor for
    every array. `beside` has, by their names, the files of settings that lie beside it and could be read.
    `notes` are sentences for the report.
    """

    system: str
    entries: dict
    path: Path
    beside: dict[str, object] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)


class System(NamedTuple):
    """How the checkpoints of a system are told, and what its runs leave beside them."""

    title: str
    holds: Callable[[dict], bool]
    beside: tuple[str, ...] = ()


def open_checkpoint(path: Path | str) -> Checkpoint:
    """A checkpoint, or the newest one of a run's folder; only what it needs is read.

    Raises UnknownCheckpoint for any other file or folder, BadCheckpoint, NeedsCode, ChecksumMismatch,
    LimitExceeded, NewerVersion, OlderVersion, MissingFile, NotAFile, ResourceError.
    """
    path = Path(path)
    if path.is_dir():
        return _of_folder(path)
    entries = _entries(path)
    system = next((name for name, system in SYSTEMS.items() if system.holds(entries)), None)
    if system is None:
        raise UnknownCheckpoint(
            f"{path}: {_described(entries)}, which no known system writes; {known_systems()}"
        )
    if system == "instant-ngp":
        _check_snapshot(entries["snapshot"], path)
    found = Checkpoint(system, entries, path)
    for name in SYSTEMS[system].beside:
        for folder in (path.parent, path.parent.parent)[: 2 if path.parent.name in FOLDERS else 1]:
            if (folder / name).is_file() and name not in found.beside:
                with noted(found.notes, "it is not used"):
                    found.beside[name] = read_beside(folder / name)
    return found


def known_systems() -> str:
    """ "known are TensoRF, …"."""
    return f"known are {', '.join(system.title for system in SYSTEMS.values())}"


# --- files --------------------------------------------------------------------------------------------------


def _entries(path: Path) -> dict:
    """What a file holds, by the format that its first bytes tell."""
    with open_input(path) as file:
        head = file.read(HEAD)
    if head.startswith(OLD_MAGIC):
        return _table(read_torch(path))
    if head.startswith(ZIP) and identify(head, path.suffix).kind != "bundle":
        archive = Archive(path)
        if pickle_member(archive):
            return _table(read_torch(path))
        if array_names(archive):
            return read_npz(path)
    if head.startswith(GZIP) or _begins_as_map(head):
        entries = read_msgpack(path)
        if isinstance(entries, dict):
            return entries
    raise _other_file(path, head)


def _table(value: object) -> dict:
    """A torch file's dictionary; anything else under the name of its type."""
    return value if isinstance(value, dict) else {type(value).__name__: value}


def _begins_as_map(head: bytes) -> bool:
    """Whether bytes begin as a map of MessagePack does whose first key is a short text."""
    if head[:1] and 0x81 <= head[0] <= 0x8F:
        key = head[1:2]
    elif head[:1] in (b"\xde", b"\xdf"):
        key = head[3:4] if head[0] == 0xDE else head[5:6]
    else:
        return False
    return bool(key) and (0xA1 <= key[0] <= 0xBF or key[0] == 0xD9)


def _other_file(path: Path, head: bytes) -> FormatError:
    """The error for a file that is no checkpoint."""
    other = identify(head, path.suffix)
    if other is None or other.kind in ("checkpoint", "archive", "text", "other"):
        return UnknownCheckpoint(f"{path}: begins as no checkpoint of a known system does; {known_systems()}")
    return UnknownCheckpoint(
        f"{path}: is {other.what}, no checkpoint; {CURES.get(other.kind, known_systems())}"
    )


CURES = {
    "bundle": "it needs no import: render it, or place it in a scene with `fusedrf compose`",
    "photo": "give a folder of photos to `fusedrf train`",
    "mesh": "give it to `fusedrf train`, which learns a field of it",
    "empty": "copy or export it again",
}


def _described(entries: dict) -> str:
    """What an unknown file holds: its first keys, and those of the first dictionary in it."""
    if not entries:
        return "is empty"
    inner = next(((k, v) for k, v in entries.items() if isinstance(v, dict) and v), None)
    more = f" ({inner[0]}: {listed(inner[1], 6)})" if inner else ""
    return f"holds {listed(entries, 8)}{more}"


def _check_snapshot(snapshot: dict, path: Path) -> None:
    """Raise for a snapshot of instant-ngp that is no radiance field, or of a version that is not known."""
    if (mode := snapshot.get("mode", "nerf")) not in ("nerf", 0):
        raise UnknownCheckpoint(f"{path}: holds instant-ngp's mode {str(mode)[:40]!r}, expected nerf")
    version = snapshot.get("version")
    if type(version) is not int:
        raise OlderVersion(
            f"{path}: a snapshot of instant-ngp from before July 2022, without a version; train it again "
            "with a newer instant-ngp"
        )
    if version > NGP_VERSION:
        raise NewerVersion(
            f"{path}: a snapshot of instant-ngp of version {version}, and this fusedrf reads {NGP_VERSION}; "
            "take a newer fusedrf"
        )


# --- systems ------------------------------------------------------------------------------------------------


def _part(entries: dict, *names: str) -> dict:
    """The dictionary at a path of keys; empty where there is none."""
    for name in names:
        entries = entries.get(name) if isinstance(entries, dict) else None
    return entries if isinstance(entries, dict) else {}


def _has(*names: str, within: tuple[str, ...] = (), but: tuple[str, ...] = ()) -> Callable[[dict], bool]:
    """Whether a dictionary of a checkpoint has all these tensors and dictionaries, and none of those."""

    def holds(entries: dict) -> bool:
        part = _part(entries, *within)
        return all(isinstance(part.get(n), StoredTensor | dict | bytes) for n in names) and not any(
            n in part for n in but
        )

    return holds


def _any(*rules: Callable[[dict], bool]) -> Callable[[dict], bool]:
    return lambda entries: any(rule(entries) for rule in rules)


def _all(*rules: Callable[[dict], bool]) -> Callable[[dict], bool]:
    return lambda entries: all(rule(entries) for rule in rules)


def _sized(name: str, axis: int, size: int, within: tuple[str, ...]) -> Callable[[dict], bool]:
    """Whether a tensor has a size along an axis."""

    def holds(entries: dict) -> bool:
        tensor = _part(entries, *within).get(name)
        return isinstance(tensor, StoredTensor) and tensor.shape[axis : axis + 1] == (size,)

    return holds


_DVGO = ("model_state_dict",)
_MPI = _any(_sized("act_shift", 3, 1, _DVGO), _has("act_shift.grid", within=_DVGO))
_GRID = _any(
    *(_has(f"density.{name}", f"k0.{name}", within=_DVGO) for name in ("grid", "xy_plane")),
    _has("density.grid", "k0.xy_plane", within=_DVGO),
)
_MODEL = ("model",)
_HASH = _has(
    "encoder.embeddings", "encoder.offsets", "sigma_net.0.weight", "color_net.0.weight", within=_MODEL
)
_PVD_OFFSETS = _sized("encoder.offsets", 0, 15, _MODEL)
"""PVD's hash grid has 14 levels, where torch-ngp's has 16."""
_FIELD = "_model.field."
_FLAX = ("optimizer", "target", "model")

SYSTEMS = {  # the first that fits counts
    "tensorf": System(
        "TensoRF", _all(_has("kwargs"), _has("density_line.0", "app_line.0", within=("state_dict",)))
    ),
    "svox2": System(
        "Plenoxels (svox2)",
        _any(_has("links", "density_data", "sh_data"), _has("links", "data", but=("density_data",))),
        ("args.json",),
    ),
    "dcvgo": System(
        "DVGO (unbounded)", _all(_has("scene_center", "scene_radius", within=_DVGO), _GRID), ("config.py",)
    ),
    "dmpigo": System("DVGO (NDC)", _all(_has("model_kwargs"), _GRID, _MPI), ("config.py",)),
    "dvgo": System("DVGO", _all(_has("model_kwargs"), _GRID), ("config.py",)),
    "instant-ngp": System("instant-ngp", _has("params_binary", within=("snapshot",))),
    "hashnerf": System("HashNeRF", _has("network_fn_state_dict", "embed_fn_state_dict"), ("args.txt",)),
    "nerf-pytorch": System(
        "nerf-pytorch", _has("pts_linears.0.weight", within=("network_fn_state_dict",)), ("args.txt",)
    ),
    "krrish-nerf": System(
        "krrish94's nerf-pytorch", _has("layer1.weight", within=("model_coarse_state_dict",)), ("config.yml",)
    ),
    "pvd": System(
        "PVD",
        _any(
            _all(_HASH, _PVD_OFFSETS),
            _has("nerf_mlp.0.weight", "sigma_net.0.weight", within=_MODEL),
            _all(
                _has("sigma_mat.0", "color_mat.0", within=_MODEL), _sized("basis_mat.weight", 0, 15, _MODEL)
            ),
            _has("tensor_volume.0", within=_MODEL),
        ),
    ),
    "torch-ngp": System("torch-ngp", _HASH),
    "nerfacto": System(
        "nerfstudio's nerfacto",
        _all(
            _any(
                *(
                    _has(_FIELD + n, within=("pipeline",))
                    for n in ("mlp_base.model.params", "mlp_base.model.0.hash_table")
                )
            ),
            _any(
                *(
                    _has(_FIELD + n, within=("pipeline",))
                    for n in ("mlp_head.tcnn_encoding.params", "mlp_head.layers.0.weight")
                )
            ),
        ),
        ("config.yml", "dataparser_transforms.json"),
    ),
    "k-planes": System(
        "K-Planes", _has("field.grids.0.0", "field.sigma_net.params", within=_MODEL), ("config.py",)
    ),
    "d2nerf": System("D²NeRF", _has("static_nerf", within=_FLAX), ("options.json", "config.gin")),
}


# --- folders of runs ----------------------------------------------------------------------------------------


def _of_folder(folder: Path) -> Checkpoint:
    """The newest checkpoint of a run: the highest step that a name tells, fine before coarse, `last` before
    any step. What is no checkpoint is passed over, a damaged one is an error."""
    files = _files(folder)
    found: list[Checkpoint] = []
    for file in files[:MAX_TRIED]:
        if found and _rank(file) < _rank(found[0].path):
            break
        try:
            found.append(open_checkpoint(file))
        except UnknownCheckpoint:
            continue
    if not found:
        names = f"such as {files[0].name}, which is none" if files else "by their names"
        raise UnknownCheckpoint(f"{folder}: holds no checkpoint of a known system {names}; {known_systems()}")
    if len(found) > 1:
        names = listed(checkpoint.path.name for checkpoint in found)
        raise UnknownCheckpoint(
            f"{folder}: holds {counted(len(found), 'checkpoint', 'checkpoints')}: {names}; give one"
        )
    found[0].notes.append(f"{folder}: its newest checkpoint {found[0].path.name} is taken")
    return found[0]


def _files(folder: Path) -> list[Path]:
    """Files of a folder, or of its folder of checkpoints, that may be checkpoints: the newest first."""
    files: list[Path] = []
    for place in (*(folder / name for name in FOLDERS), folder):
        if place.is_dir() and not files:
            files = [
                file
                for file in sorted(place.iterdir())[:MAX_FILES]
                if (file.suffix in ENDINGS or re.fullmatch(r"checkpoint_\d+", file.name)) and file.is_file()
            ]
    return sorted(files, key=_rank, reverse=True)


def _rank(file: Path) -> tuple[bool, bool, int]:
    """How new a checkpoint is by its name."""
    number = re.search(r"(\d{1,18})$", file.stem)
    return not file.stem.startswith("coarse"), "last" in file.stem, int(number[1]) if number else -1
