"""Which system wrote a checkpoint, told by what the file holds, and what its run says beside it."""

import fnmatch
import re
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import islice
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
FOLDERS = ("nerfstudio_models", "checkpoints", "ckpts")
"""Folders of a run that hold its checkpoints."""
MAX_FILES = 2000
MAX_TRIED = 50
MAX_NAMES = 50_000
"""Names of a checkpoint that its system is told by."""
WRAPPED = re.compile(r"(module\.|_orig_mod\.)+")
"""What stands in front of all names of a model that runs on several GPUs, or is compiled."""
CAPTURED = (
    "active_sh_degree", "_xyz", "_features_dc", "_features_rest", "_scaling", "_rotation", "_opacity",
    "max_radii2D", "xyz_gradient_accum", "denom", "optimizer", "spatial_lr_scale",
)  # fmt: skip
"""What 3DGS saves of its model, in this order and without these names."""


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
    beside: dict[str, dict] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)


class System(NamedTuple):
    """How the checkpoints of a system are told, and what its runs leave beside them."""

    title: str
    rule: str
    """Of the names in its files, as `_fits` reads it."""
    beside: tuple[str, ...] = ()
    is_read: bool = True


def open_checkpoint(path: Path | str) -> Checkpoint:
    """A checkpoint, or the newest one of a run's folder; only what it needs is read.

    Raises UnknownCheckpoint for any other file or folder, BadCheckpoint, NeedsCode, ChecksumMismatch,
    LimitExceeded, NewerVersion, OlderVersion, MissingFile, NotAFile, ResourceError.
    """
    path = Path(path)
    if path.name == "config.yml" and (path.parent / FOLDERS[0]).is_dir():  # how nerfstudio names a run
        path = path.parent
    if path.is_dir():
        return _of_folder(path)
    entries = _entries(path)
    names = list(islice(_names(entries), MAX_NAMES))
    system = next((name for name, system in SYSTEMS.items() if _fits(system.rule, names)), None)
    if system is None:
        told = _likeness(names) or known_systems()
        raise UnknownCheckpoint(f"{path}: {_described(entries)}, which no known system writes; {told}")
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
    titles = ", ".join(system.title for system in SYSTEMS.values() if system.is_read)
    return (
        f"known are {titles}, and splats in .ply, .spz, .sog, .splat, .ksplat and glTF; give a file of those"
    )


def _likeness(names: list[str]) -> str:
    """Of names that lie elsewhere in a system's own files, what they should be; "" of any others."""
    last = [name.rpartition("/")[2] for name in names]
    for system in (system for system in SYSTEMS.values() if system.is_read):
        for words in system.rule.split("|"):
            wanted = [word for word in words.split() if not word.startswith("!")]
            inner = [word.rpartition("/")[2] for word in wanted if "/" in word]
            if inner and all(fnmatch.filter(last, word) for word in inner):
                lacking = [word.partition(":")[0] for word in wanted if not fnmatch.filter(names, word)]
                named = f"its arrays are named as {system.title} names them"
                if lacking:  # else it has what the system's own files do not
                    return f"{named}, but {listed(lacking, 3)} lack: give the file as that saves it"
    return ""


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
    if _begins_as_map(_unzipped(head) if head.startswith(GZIP) else head):
        return read_msgpack(path)
    raise _other_file(path, head)


def _table(value: object) -> dict:
    """A torch file's dictionary; what 3DGS saves, by its names; anything else under that of its type."""
    match value:
        case dict():
            return _unwrapped(value)
        case ((*model,), int() as step) if len(model) == len(CAPTURED) and isinstance(model[1], StoredTensor):
            return {"gaussians": dict(zip(CAPTURED, model, strict=True)), "iteration": step}
    return {type(value).__name__: value}


def _unwrapped(entries: dict, levels: int = 3) -> dict:
    """Entries by the names that a model's numbers have when it is not wrapped, in the first levels."""
    if levels == 0:
        return entries
    if all(WRAPPED.match(str(name)) for name in entries):
        entries = {WRAPPED.sub("", name, count=1): value for name, value in entries.items()}
    return {
        name: _unwrapped(value, levels - 1) if isinstance(value, dict) else value
        for name, value in entries.items()
    }


def _unzipped(head: bytes) -> bytes:
    """The first bytes in a gzip stream; none where it is damaged."""
    try:
        return zlib.decompressobj(31).decompress(head, 64)
    except zlib.error:
        return b""


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
    if other is None or other.kind in ("checkpoint", "text", "other"):
        return UnknownCheckpoint(f"{path}: begins as no checkpoint of a known system does; {known_systems()}")
    if other.kind == "splats":
        return UnknownCheckpoint(
            f"{path}: is {other.what}, but cut short or of no format that is read; copy or export it again"
        )
    return UnknownCheckpoint(
        f"{path}: is {other.what}, no checkpoint; {CURES.get(other.kind, known_systems())}"
    )


CURES = {
    "archive": "unpack it, and give the checkpoint or the splats in it",
    "bundle": "it needs no import: render it, or place it in a scene with `fusedrf compose`",
    "photo": "give a folder of photos to `fusedrf train`",
    "mesh": "give it to `fusedrf train`, which learns a field of it",
    "empty": "copy or export it again",
    "usd": "of splats in it save a .ply",
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
    if "mode" not in snapshot and "nerf" not in snapshot:  # of 2022
        raise UnknownCheckpoint(
            f"{path}: is a snapshot of instant-ngp without a radiance field, as of a surface or a picture; "
            "give one of its nerf mode"
        )
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


def _names(entries: dict, levels: int = 4) -> Iterator[str]:
    """Paths "a/b/c:" of the dictionaries, tensors and binaries in the first levels, with sizes: "a:2x3"."""
    for key, value in entries.items():
        if "/" in str(key) or len(str(key)) > 200 or not isinstance(value, dict | StoredTensor | bytes):
            continue
        yield f"{key}:{'x'.join(map(str, value.shape)) if isinstance(value, StoredTensor) else ''}"
        if isinstance(value, dict) and levels > 1:
            yield from (f"{key}/{name}" for name in _names(value, levels - 1))


def _fits(rule: str, names: list[str]) -> bool:
    """Whether names fit a rule: alternatives, with "|" between them, of patterns that all have to fit."""
    return any(
        all(bool(fnmatch.filter(names, word.lstrip("!"))) != word.startswith("!") for word in words.split())
        for words in rule.split("|")
    )


_GRIDS = "model_state_dict:* model_state_dict/density.*:* model_state_dict/k0.*:*"
SYSTEMS = {  # the first whose rule fits counts
    "tensorf": System(
        "TensoRF",
        "kwargs:* state_dict/density_line.0:* state_dict/app_line.0:* "
        "| kwargs:* state_dict/plane_coef:* state_dict/line_coef:*",
    ),
    "ccnerf": System(
        "CCNeRF's own code",
        "kwargs:* state_dict/S_vec.0:* state_dict/sigma_*:* | kwargs:* state_dict/S_mat.0:* "
        "state_dict/sigma_*:*",
        is_read=False,
    ),
    "svox2": System("Plenoxels (svox2)", "links:* density_data:* sh_data:* | links:* data:*", ("args.json",)),
    "dbivoxgo": System(
        "DVGO (two grids)",
        "model_state_dict/scene_radius:* model_state_dict/density.0.*:* model_state_dict/k0.0.*:*",
        is_read=False,
    ),
    "dcvgo": System("DVGO (unbounded)", f"model_state_dict/scene_radius:* {_GRIDS}", ("config.py",)),
    "dmpigo": System(
        "DVGO (NDC)",
        f"model_state_dict/act_shift.grid:* {_GRIDS} | model_state_dict/act_shift:1x1x1x1x* {_GRIDS}",
        is_read=False,
    ),
    "dvgo": System(  # of its first version without classes of grids
        "DVGO",
        f"model_kwargs:* {_GRIDS} | model_kwargs:* model_state_dict/density:* model_state_dict/k0:*",
        ("config.py",),
    ),
    "instant-ngp": System("instant-ngp", "snapshot/params_binary:*"),
    "hashnerf": System("HashNeRF", "network_fn_state_dict:* embed_fn_state_dict:*", ("args.txt",)),
    "d-nerf": System(
        "D-NeRF",
        "network_fn_state_dict/_occ.pts_linears.0.weight:* network_fn_state_dict/_time.0.weight:*",
        is_read=False,
    ),
    "nerf-pytorch": System("nerf-pytorch", "network_fn_state_dict/pts_linears.0.weight:*", ("args.txt",)),
    "krrish-nerf": System(
        "krrish94's nerf-pytorch",
        "model_coarse_state_dict/layer1.weight:* "
        "| model_coarse_state_dict/layers_xyz.0.weight:* !latent_codes:*",  # which NerFACE has
        ("config.yml",),
    ),
    "pvd": System(  # its hash grid has 14 levels, where torch-ngp's has 16
        "PVD",
        "model/encoder.embeddings:* model/encoder.offsets:15 model/sigma_net.0.weight:* !model/deform_net.*"
        "| model/nerf_mlp.0.weight:* model/sigma_net.0.weight:* | model/tensor_volume.0:*"
        "| model/sigma_mat.0:* model/color_mat.0:* model/basis_mat.weight:15x*",
        ("args.txt",),
    ),
    "torch-ngp": System(  # but for its networks of moving scenes
        "torch-ngp",
        "model/encoder.embeddings:* model/encoder.offsets:* model/sigma_net.0.weight:* "
        "!model/deform_net.* !model/basis_net.* !model/ambient_net.*"
        "| model/encoder.embeddings:* model/sigma_net.weights:* model/color_net.weights:*"
        "| model/encoder.params:* model/sigma_net.params:* model/color_net.params:*"
        "| model/sigma_vec.0:* model/color_vec.0:* model/basis_mat.weight:* model/color_net.0.weight:*"
        "| model/U_vec_density.0:* model/S_vec_density.0:* model/U_vec.0:* model/S_vec.0:*",
    ),
    "nerfacto": System(
        "nerfstudio's nerfacto",
        "pipeline/*_model.*field.mlp_base* pipeline/*_model.*field.mlp_head* "
        "pipeline/*_model.*proposal_networks.*"
        "| pipeline/*_model.*field.mlp_base* pipeline/*_model.*field.mlp_head* "
        "pipeline/*_model.*occupancy_grid.*",
        ("config.yml", "dataparser_transforms.json"),
    ),
    "k-planes": System("K-Planes", "model/field.grids.0.0:* model/field.sigma_net.params:*", ("config.py",)),
    "splatfacto": System(
        "nerfstudio's splatfacto",
        "pipeline/*_model.*means:*x3 pipeline/*_model.*quats:*x4 pipeline/*_model.*features_dc:*",
        ("config.yml", "dataparser_transforms.json"),
    ),
    "gsplat": System(
        "gsplat",
        "splats/means*:*x3 splats/quats:*x4 splats/sh0:*"
        "| splats/means*:*x3 splats/quats:*x4 splats/colors:* splats/features:*",
        ("cfg.yml", "cfg.json"),
    ),
    "3dgs": System(
        "3D Gaussian splatting", "gaussians/_xyz:*x3 gaussians/_rotation:*x4 gaussians/_features_dc:*x1x3"
    ),
    "d2nerf": System("D²NeRF", "optimizer/target/model/static_nerf:*", ("options.json", "config.gin")),
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
        names = f"{files[0].name} is none" if files else f"no file named {', '.join(ENDINGS)}"
        names += "; of splats give the file itself"
        raise UnknownCheckpoint(
            f"{folder}: holds no checkpoint of a known system ({names}); {known_systems()}"
        )
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
                if (file.suffix in ENDINGS or re.fullmatch(r"checkpoint_\d+", file.name))
                and not re.search(r"_rank[1-9]\d*$", file.stem)  # other GPUs' parts of the same checkpoint
                and file.is_file()
            ]
    return sorted(files, key=_rank, reverse=True)


def _rank(file: Path) -> tuple[bool, bool, int]:
    """How new a checkpoint is by its name, which may end twice (torch-ngp's TensoRF: .pth.pth)."""
    stem = file.stem.removesuffix(file.suffix)
    number = re.search(r"(\d{1,18})(?:_rank\d+)?$", stem)
    return not stem.startswith("coarse"), "last" in stem, int(number[1]) if number else -1
