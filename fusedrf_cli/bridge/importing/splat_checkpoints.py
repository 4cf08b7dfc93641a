"""Gaussian splats as their trainers keep them: 3DGS (github.com/graphdeco-inria/gaussian-splatting), 2DGS
(hbb1/2d-gaussian-splatting), gsplat's examples (nerfstudio-project/gsplat) and nerfstudio's splatfacto.

All hold logarithms of sizes, logits of opacities, quaternions w, x, y, z of any length, and 3DGS's harmonics.
"""

import math
import re
from pathlib import Path
from typing import NamedTuple

import numpy as np

from formats.errors import FormatError, listed
from formats.foreign.systems import Checkpoint, open_checkpoint
from formats.splats.splats import (
    ANTIALIASED,
    DOWN_Y,
    UP_Z,
    Splats,
    check_count,
    coefficients_of,
    gathered,
    not_honoured,
    of_colours,
    sigmoid,
    sizes_of,
)
from formats.views import Capture
from fusedrf_cli.bridge.importing.nerfacto import model_settings, named, placement_of, state_of, up_of
from fusedrf_cli.bridge.importing.parts import Entries, Imported
from fusedrf_cli.bridge.importing.splats import as_fits, fields_of
from fusedrf_cli.bridge.memory import Memory


class Layout(NamedTuple):
    """What a trainer calls the arrays of N splats, and the shapes in which trainers differ."""

    centres: str = "means"
    scales: str = "scales"
    rotations: str = "quats"
    opacities: str = "opacities"
    first: str = "features_dc"
    rest: str = "features_rest"
    """(N, K, 3) coefficients of all degrees but 0."""
    one: tuple[int, ...] = (1,)
    """Shape of an opacity."""
    colour: tuple[int, ...] = (1, 3)
    """Shape of the coefficients of degree 0."""

    @property
    def names(self) -> tuple[str, ...]:
        """Of the arrays."""
        return self[:6]


KERBL = Layout("_xyz", "_scaling", "_rotation", "_opacity", "_features_dc", "_features_rest")
GSPLAT = Layout(first="sh0", rest="shN", one=())
SPLATFACTO = Layout(colour=(3,))
RANK = re.compile(r"(.*_rank)(0|[1-9]\d?)")
"""How the file of each GPU is named; of a hundred at most."""
BESIDE_SPLATS = {"step", "splats", "scene_id", "scene_path"}
NO_PART = "device_indicator_param", "lpips", "psnr", "ssim"
"""Of a model of nerfstudio's, what shows nothing."""


class Held(NamedTuple):
    """The arrays of N splats, shapes as in `Splats`, but for `first`, coefficients (N, 1, 3) of degree 0, and
    `rest` (N, K, 3) of the others."""

    centres: np.ndarray
    logarithms: np.ndarray
    """(N, 2 or 3) of sizes."""
    rotations: np.ndarray
    logits: np.ndarray
    first: np.ndarray
    rest: np.ndarray


def read(checkpoint: Checkpoint, memory: Memory) -> Imported:
    """The fields of a checkpoint of 3DGS, 2DGS or gsplat. Raises FormatError."""
    made = {"3dgs": of_3dgs, "gsplat": of_gsplat}[checkpoint.system]
    with as_fits(memory):
        splats = made(checkpoint)
    return fields_of(splats)


def read_splatfacto(checkpoint: Checkpoint, memory: Memory, capture: Capture | None = None) -> Imported:
    """The fields of splatfacto's splats, where their capture lies. Raises FormatError."""
    placement, said = placement_of(checkpoint.beside.get("dataparser_transforms.json"), capture)
    with as_fits(memory):
        splats = of_splatfacto(checkpoint, up_of(placement))
    return fields_of(splats, placement, said)


# -- what each trainer holds ---------------------------------------------------------------------------------


def of_3dgs(checkpoint: Checkpoint) -> Splats:
    """The splats of 3DGS and 2DGS, with the harmonics in use by then. Raises FormatError."""
    entries = Entries(checkpoint.entries).inside("gaussians")
    degree = entries.whole("active_sh_degree", 0, 8)
    held, notes = held_by(checkpoint.path, [entries], KERBL), []
    used = held.rest[:, : (degree + 1) ** 2 - 1]
    if used.shape != held.rest.shape:
        notes.append(
            f"its colours depend on the direction by degree {degree} so far: higher ones are left out"
        )
    return splats_of(checkpoint.path, held._replace(rest=used), notes, DOWN_Y)


def of_gsplat(checkpoint: Checkpoint) -> Splats:
    """The splats of gsplat's simple_trainer, of all GPUs, also of 2DGS. Raises FormatError."""
    path, notes = checkpoint.path, []
    ranks = ranks_of(checkpoint)
    parts = [Entries(each.entries).inside("splats") for each in ranks]
    if GSPLAT.first not in parts[0].values:
        raise FormatError(
            "its colours are made of a picture's code by a network (app_opt), which splats cannot hold; give "
            "the .ply that its trainer saves, or train it without"
        )
    layout = GSPLAT if GSPLAT.centres in parts[0].values else GSPLAT._replace(centres="means3d")  # of 2024
    held = held_by(path, parts, layout)
    settings = next(iter(checkpoint.beside.values()), {})
    if str(settings.get("model_type")).startswith("2dgs"):  # which does not ask for the third size
        held = held._replace(logarithms=held.logarithms[:, :2])
    if settings.get("antialiased") is True:
        notes.append(ANTIALIASED)
    not_honoured(sorted(set(map(str, checkpoint.entries)) - BESIDE_SPLATS), notes, "parts of its run")
    not_honoured(sorted(set(map(str, parts[0].values)) - set(layout.names)), notes, "numbers of splats")
    if len(ranks) > 1:
        notes.append(f"the splats of all GPUs are taken: {listed(each.path.name for each in ranks)}")
    moved = settings.get("normalize_world_space") is not False
    if moved:
        notes.append(
            "its trainer turned, moved and scaled the capture, unless told otherwise, and keeps no word of "
            "how: it stays there"
        )
    return splats_of(path, held, notes, UP_Z if moved else DOWN_Y)


def of_splatfacto(checkpoint: Checkpoint, up: tuple[float, ...]) -> Splats:
    """The splats of splatfacto in the frame that it is learnt in; `up` of its capture. Raises FormatError."""
    model = state_of(named(Entries(checkpoint.entries).inside("pipeline")), "_model.")
    own = {name.removeprefix("gauss_params."): value for name, value in model.values.items()}
    held, notes = held_by(checkpoint.path, [Entries(own, "_model: ")], SPLATFACTO), []
    if not held.rest.shape[1]:  # colours without harmonics are the sigmoid of what is learnt
        held = held._replace(first=of_colours(sigmoid(held.first[:, 0])))
    others = {name.partition(".")[0] for name in own.keys() - set(SPLATFACTO.names)} - set(NO_PART)
    not_honoured(sorted(others), notes, "parts of its model")
    if model_settings(checkpoint.beside.get("config.yml")).get("rasterize_mode") == "antialiased":
        notes.append(ANTIALIASED)
    return splats_of(checkpoint.path, held, notes, up)


# -- arrays --------------------------------------------------------------------------------------------------


def ranks_of(checkpoint: Checkpoint) -> list[Checkpoint]:
    """The checkpoints of all GPUs of a step, each of which holds some of the splats. Raises FormatError."""
    path = checkpoint.path
    found = RANK.fullmatch(path.stem)
    if found is None:
        return [checkpoint]
    files = [path.with_name(f"{found[1]}{rank}{path.suffix}") for rank in range(100)]
    there = [file for file in files if file.is_file()]
    if missing := [file.name for file in files[: len(there)] if file not in there]:
        raise FormatError(
            f"{missing[0]} is missing beside it, which holds others of its splats; copy it there"
        )
    ranks = [checkpoint if file == path else open_checkpoint(file) for file in there]
    if other := next((each for each in ranks if each.system != checkpoint.system), None):
        raise FormatError(f"{other.path.name} beside it is no part of it; move it away")
    return ranks


def held_by(path: Path, parts: list[Entries], layout: Layout) -> Held:
    """The arrays of splats that lie in several files. Raises FormatError."""
    shapes = [getattr(part.get(layout.centres), "shape", ()) for part in parts]
    check_count(path, sum(math.prod(shape[:1]) for shape in shapes))
    held = [arrays_of(part, layout) for part in parts]
    if len({(each.logarithms.shape[1], each.rest.shape[1]) for each in held}) > 1:
        raise FormatError(
            "the files of its GPUs hold different numbers for a splat; they are of different runs"
        )
    return Held(*(np.concatenate(arrays) for arrays in zip(*held, strict=True)))


def arrays_of(part: Entries, layout: Layout) -> Held:
    """The arrays of the splats of one file. Raises FormatError."""
    centres = part.numbers(layout.centres, None, 3)
    count = len(centres)
    logarithms = part.numbers(layout.scales, count, None)
    if logarithms.shape[1] not in (2, 3):
        raise FormatError(
            f"{part.where}'{layout.scales}' should have shape [{count}, 2 or 3], found "
            f"{list(logarithms.shape)}"
        )
    return Held(
        centres,
        logarithms,
        part.numbers(layout.rotations, count, 4),
        part.numbers(layout.opacities, count, *layout.one).reshape(count),
        part.numbers(layout.first, count, *layout.colour).reshape(count, 1, 3),
        part.numbers(layout.rest, count, None, 3),
    )


@np.errstate(all="ignore")  # numbers that are none or beyond any measure are left out, and told
def splats_of(path: Path, held: Held, notes: list[str], up: tuple[float, ...]) -> Splats:
    """Splats of what a trainer holds. Raises FormatError."""
    _, kept = coefficients_of(path, 3 * held.rest.shape[1], notes)
    return gathered(
        path,
        "a checkpoint of Gaussian splats",
        centres=held.centres,
        scales=sizes_of(held.logarithms, notes),
        rotations=held.rotations,
        opacities=sigmoid(held.logits),
        harmonics=np.concatenate([held.first, held.rest[:, :kept]], 1),
        up=up,
        notes=notes,
    )
