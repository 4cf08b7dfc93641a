"""How `train` fits a field to one source: what is read, and the settings and needs that follow from it."""

from dataclasses import dataclass, replace

import numpy as np
import torch

from formats.meshes import is_mesh, mesh_capture
from formats.photos import load_photos, loading_bytes
from formats.views import Capture, check_parallax, hold_out
from fusedrf_cli.bridge.memory import decoding, fitting, photos
from fusedrf_cli.bridge.pictures import camera_of
from fusedrf_cli.bridge.posing import posed_capture
from fusedrf_cli.bridge.scene import refuse_options, unheeded, unusable_kind
from fusedrf_cli.bridge.scene_bounds import SceneBounds
from fusedrf_cli.bridge.sizes import BundleSizes, HeaderConfig, section_bytes
from fusedrf_cli.engine.distillation.config import TrainConfig
from fusedrf_cli.engine.distillation.ray_dataset import Pictures
from fusedrf_cli.engine.encodings.hash_runs import HashGrid
from fusedrf_cli.engine.fields.occupancy import OccupancyConfig, cell_counts
from fusedrf_cli.engine.kinds import registry
from fusedrf_cli.engine.kinds.builder import BuilderConfig, Plan, Section, StorageSetting
from fusedrf_cli.engine.kinds.kind import Kind
from fusedrf_cli.engine.settings import current
from fusedrf_cli.engine.spaces.unbounded import REACH
from fusedrf_cli.errors import InvalidInput, UsageProblem
from fusedrf_cli.report import readable_size
from fusedrf_cli.requests import TrainRequest


@dataclass(frozen=True)
class TrainPresets:
    """How a TrainConfig follows from the quality, the time and the bytes that are asked for."""

    draft: TrainConfig = TrainConfig(longest=128, steps=1500, samples=1 << 15)
    normal: TrainConfig = TrainConfig(longest=224, steps=4000, samples=1 << 15)
    high: TrainConfig = TrainConfig(longest=256, steps=9000, samples=1 << 15)
    best: TrainConfig = TrainConfig(longest=256, steps=24000, samples=1 << 15)
    patient: tuple[tuple[str, float], ...] = (("best", 200.0), ("high", 90.0), ("normal", 0.0))
    """Seconds of a time budget from which an object is learnt so where no quality is asked for. Of unbounded
    scenes the texels follow the time budget."""
    texels_per_pixel: float = 0.7
    """Of the best quality, for each pixel of the photos that an object's box is wide."""
    finest_object: int = 512
    """Texels, at most."""
    unbounded_texels: float = 2.0
    """Times those of a box, along an axis of all of space: half lie outside the core."""
    more_texels_from: float = 120
    """Seconds of learning from which an unbounded scene has more texels, ..."""
    more_texels_power: float = 0.23
    """... by this power of the time, ..."""
    most_texels: float = 1.5
    """... and times how many at most: on two cores ten minutes with 1.45 times as many reach 0.5 dB more, two
    minutes less."""
    unbounded_precision: str = "int8"
    """Where none is asked for: half the bytes of float16 for 0.0001 dB."""
    largest_unbounded: int = 95_000_000
    """Bytes, stored as its kind is by default, where no size is asked for: voxels of all of space, as fine as
    planes are, would take a hundred times those of the planes."""
    surroundings_from: float = 120.0
    """Seconds of learning from which surroundings are learnt as `registry.SURROUNDINGS`: after thirty seconds
    of a fox planes and lines show 3 dB more, after two minutes as much, after five of a fern 1 dB less."""
    hashed: HashGrid = HashGrid((2 * REACH / 256, 2 * REACH / 512, 2 * REACH / 1024), 1 << 20)
    """What the texels of an unbounded scene cannot tell apart. The first level is coarser than they are:
    after as many steps a park shows 0.4 dB more with it than without; one more, of 128, takes half a dB."""
    hashed_from: float = 360.0
    """Seconds of learning from which there is a hash grid. After ten minutes a park shows up to 1 dB more
    than with any number of texels without it. After four it shows 0.4 dB more, a cup 0.6 less."""
    hashed_steps: int = 4000
    """Steps from which there is one."""
    hashed_texels: float = 1.5
    """Times the texels of a box that there are then."""
    hashed_share: float = 0.5
    """Of a file, that it may take."""
    fewer_texels: int = 4
    """Steps in which a size is looked for that fits."""
    more_samples: int = 2
    """Times the samples of a step, in as many fewer steps, of the best quality of an object and of an
    unbounded scene that learns its hash grid for long: looking through all gradients of so many numbers would
    take two fifths of a step, and a quarter. By `hashed_steps` a park shows 23.2 dB, and in half as many of
    twice the samples 23.0."""
    gpu_samples: int = 4
    """Times the samples of a step on a GPU, whose threads wait for work otherwise: its steps hardly take
    longer. After 60 s of an H100 a park shows 22.99 dB by steps of two cores, 23.59 by four times the
    samples, 23.55 by eight times."""
    gpu_pace: float = 6
    """Seconds of two cores that one of a GPU counts as, where the time decides how to learn: an H100 does in
    a minute what they do in ten."""


def usual_kind(request: TrainRequest, unbounded: bool, device: str) -> str:
    """What sources become where no kind is asked for: one that takes the options that are, and that there is
    time for."""
    if request.shared_decoder:
        return registry.SHARING
    budget = scaled_budget(request.time_budget, device)
    patient = budget >= current(TrainPresets).surroundings_from if budget else request.quality != "draft"
    if unbounded and patient and not unheeded(registry.kind(registry.SURROUNDINGS), request):
        return registry.SURROUNDINGS
    return registry.DEFAULT


def trained_kind(request: TrainRequest, unbounded: bool = False, device: str = "cpu") -> Kind:
    """The kind that was asked for, or the usual one of sources of which some are `unbounded`; UsageProblem
    where none of its fields can begin from photos, or share what they are to share."""
    try:
        kind = registry.kind(request.kind or usual_kind(request, unbounded, device))
    except ValueError as error:
        raise unusable_kind(error) from error
    if not kind.trains:
        others = [k.name for k in registry.kinds() if k.trains]
        raise UsageProblem(
            f"--kind {kind.name} does not begin from photos: train another kind ({', '.join(others)}), and "
            f"fuse it to '{kind.name}'"
        )
    if request.shared_decoder and kind.shared_part is None:
        others = [k.name for k in registry.kinds() if k.trains and k.shared_part is not None]
        raise UsageProblem(
            f"--kind {kind.name} has no decoder that fields can share; with --shared-decoder take "
            f"{' or '.join(others)}"
        )
    refuse_options(kind, request)
    return kind


def read_views(request: TrainRequest, progress) -> Capture:
    """The photos, or the views of a mesh, some of them held out where that is asked."""
    source = request.source
    if request.refine_poses and is_mesh(source):
        raise UsageProblem(f"{source}: the views of a mesh have exact poses; leave --refine-poses out")
    capture = (
        mesh_capture(source, n_train=request.views, size=request.size, seed=request.seed)
        if is_mesh(source)
        else posed_capture(source, request.downscale, request.threads, progress)
    )
    capture = hold_out(capture, request.holdout) if request.holdout else capture
    check_parallax(capture)
    for note in capture.notes:
        progress.tell(note)
    return capture


def masks_object(request: TrainRequest, capture: Capture) -> bool:
    """Whether masks cut an object out of its photos: what they exclude is to be transparent, or they keep so
    little of the photos' borders that the rest is learnt from pixels of the object alone."""
    transparent = request.masks == "alpha" and any(view.mask_path for view in capture.train)
    return transparent or capture.object_aabb is not None


def pictures_of(request: TrainRequest, capture: Capture) -> Pictures:
    """The photos to learn from; InvalidInput where masks leave nothing of them."""
    loaded = load_photos(capture.train, request.masks)
    if loaded.ignored is not None and loaded.ignored.all():
        raise InvalidInput(f"{request.source}: the masks exclude every pixel; they are black where to ignore")
    return Pictures(loaded.pixels, loaded.ignored)


def scaled_budget(seconds: float | None, device: str) -> float | None:
    """Seconds of two cores that a time budget at a place to compute counts as."""
    return seconds and seconds * (current(TrainPresets).gpu_pace if device == "cuda" else 1)


def quality_of(request: TrainRequest, capture: Capture, bounds: SceneBounds, device: str) -> TrainConfig:
    """The settings of the asked quality, or, of an object, of the one that the time budget is enough for; the
    best of an object has texels as fine as the photos' pixels ask for, and fewer but larger steps."""
    presets = current(TrainPresets)
    name = request.quality or "normal"
    budget = scaled_budget(request.time_budget, device)
    if request.quality is None and budget and not bounds.unbounded:
        name = next(name for name, seconds in presets.patient if budget >= seconds)
    settings = getattr(presets, name)
    if device == "cuda":
        settings = replace(settings, samples=settings.samples * presets.gpu_samples)
    if name != "best" or bounds.unbounded:
        return settings
    centre, side = (bounds.box[:3] + bounds.box[3:]) / 2, (bounds.box[3:] - bounds.box[:3]).max()
    cameras = [bounds.camera(camera_of(view)) for view in capture.train]
    away = [np.linalg.norm(camera.camera_to_world[:3, 3] - centre) for camera in cameras]
    pixels = np.median([c.fl_x * side / max(d, side / 2) for c, d in zip(cameras, away, strict=True)])
    longest = int(np.clip(round(presets.texels_per_pixel * pixels), settings.longest, presets.finest_object))
    return with_larger_steps(replace(settings, longest=longest))


def with_larger_steps(settings: TrainConfig) -> TrainConfig:
    """More samples in a step, in as many fewer steps."""
    more = current(TrainPresets).more_samples
    return replace(settings, steps=settings.steps // more, samples=settings.samples * more)


def fit_settings(
    request: TrainRequest, kind: Kind, capture: Capture, bounds: SceneBounds, device: str, besides: int = 0
) -> TrainConfig:
    """How to fit; UsageProblem where not even the coarsest field is as small as asked, with `besides` more
    bytes in its bundle."""
    usual = quality_of(request, capture, bounds, device)
    settings = replace(
        usual,
        kind=kind.name,
        rate=usual.rate * kind.photo_rate,
        storage=StorageSetting(request.precision, request.ranks, request.sh_degree),
        seed=request.seed,
        time_budget=request.time_budget,
        target_psnr=request.target_psnr,
        opacity_weight=0.0 if capture.opaque and not masks_object(request, capture) else 0.1,
        near=bounds.near,
        unbounded=bounds.unbounded,
        exposure=bounds.unbounded and capture.opaque,
        smooth=capture.opaque,
        poses=request.refine_poses,
        device=device,
    )
    room = request.max_size and max(1, request.max_size - besides)
    if bounds.unbounded:
        settings = settings_of_part(settings, kind, bounds.box, room)
    if request.max_size or not bounds.unbounded:
        longest = fitting_longest(kind, bounds.box, settings, room, request.precision)
    else:  # however its numbers are stored
        most = current(TrainPresets).largest_unbounded
        longest = fitting_longest(kind, bounds.box, settings, most, kind.faithful)
    plan = kind.untrained(bounds.box, longest, settings.storage)
    check_size(bytes_of(plan, request.precision) + besides, request.max_size)
    return replace(settings, longest=longest)


def settings_of_part(settings: TrainConfig, kind: Kind, box: np.ndarray, room: int | None) -> TrainConfig:
    """The settings of a field over a part (6,) of unbounded space, of at most `room` bytes: what has time to
    learn it, and the room, gets a hashed detail where its kind can have one, and others more texels the
    longer they learn."""
    presets = current(TrainPresets)
    budget = scaled_budget(settings.time_budget, settings.device)
    takes = section_bytes(Section("detail", presets.hashed.shape), settings.storage.precision)
    fits = room is None or takes <= presets.hashed_share * room
    patient = budget is None or budget >= presets.hashed_from
    if kind.hashes and fits and patient and settings.steps >= presets.hashed_steps:
        longest = texels_of_part(box, presets.hashed_texels * settings.longest)
        storage = replace(settings.storage, hashed=presets.hashed)
        settings = replace(settings, longest=longest, storage=storage)
        return with_larger_steps(settings) if budget or settings.steps > presets.hashed_steps else settings
    patience = max(1.0, (budget or 0) / presets.more_texels_from)
    more = presets.unbounded_texels * min(presets.most_texels, patience**presets.more_texels_power)
    return replace(settings, longest=texels_of_part(box, more * settings.longest))


def texels_of_part(box: np.ndarray, longest: float) -> int:
    """Texels on the longest side of a part (6,) of unbounded space: planes over it have as many as those over
    all of space that have so many a side."""
    a, b, c = box[3:] - box[:3]
    shrunk = np.sqrt((a * b + b * c + c * a) / (3 * (2 * REACH) ** 2)) / (max(a, b, c) / (2 * REACH))
    return round(longest / shrunk)


def loading(capture: Capture) -> dict[str, float]:
    """What decoding the photos to learn from needs."""
    pixels = sum(view.width * view.height for view in capture.train)
    masked = any(view.mask_path for view in capture.train)
    return decoding(pixels, masked, 0 if capture.kind == "mesh" else loading_bytes(capture.train))


def fit_memory(capture: Capture, plan: Plan, settings: TrainConfig) -> dict[str, float]:
    """What a fit to a capture's photos needs."""
    pixels = max(view.width * view.height for view in capture.train)
    cameras = len({camera_of(v).intrinsics for v in capture.train})
    return {
        **photos(len(capture.train), pixels, 1, cameras, any(view.mask_path for view in capture.train)),
        **fitting(plan, settings.longest, torch.get_num_threads(), settings.unbounded),
    }


def warn_of_nonfinite(figures: dict[str, int], progress) -> None:
    """Say that steps were not finite, where some were (`NanGuard.figures`)."""
    if figures:
        progress.warn(
            f"{figures['skipped_steps']} steps were not finite and were skipped; returned "
            f"{figures['roll_backs']} times to the last good state"
        )


def fitting_longest(
    kind: Kind, box: np.ndarray, settings: TrainConfig, max_size: int | None, precision: str
) -> int:
    """Texels on the longest axis, fewer than the settings' where the file would grow past max_size
    (bytes).
    """
    longest = settings.longest
    while (
        max_size
        and longest > current(BuilderConfig).least_texels
        and bytes_of(kind.untrained(box, longest, settings.storage), precision) > max_size
    ):
        longest -= current(TrainPresets).fewer_texels
    return longest


def bytes_of(plan: Plan, precision: str) -> int:
    """At most so many bytes of a bundle with a field as planned."""
    cells = np.prod(cell_counts(plan.box, min(current(OccupancyConfig).cells, max(plan.resolution))))
    return current(HeaderConfig).besides + BundleSizes().of(plan.contents(int(cells)), precision)


def check_size(smallest: int, allowed: float | None) -> None:
    """UsageProblem where even the smallest output, in bytes, is more than --max-size allows."""
    if allowed is not None and smallest > allowed:
        raise UsageProblem(
            f"--max-size is too small: the file takes up to {readable_size(smallest)} at its coarsest, where "
            f"{readable_size(int(allowed))} were allowed; give more"
        )
