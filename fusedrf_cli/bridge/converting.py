"""`convert`: a field of any kind to one of any other."""

from contextlib import nullcontext
from dataclasses import dataclass, fields, replace

from formats.bundle import OpenBundle, is_bundle
from fusedrf_cli.bridge.evaluating import evaluate
from fusedrf_cli.bridge.fusing import FusingConfig, fuse
from fusedrf_cli.bridge.scene import unusable_kind
from fusedrf_cli.bridge.sources import scene_as_stored
from fusedrf_cli.engine.kinds import registry
from fusedrf_cli.engine.kinds.box_kind import BoxKindConfig
from fusedrf_cli.engine.settings import current, using
from fusedrf_cli.errors import InvalidInput, UsageProblem
from fusedrf_cli.requests import ConvertRequest, EvaluateRequest, FuseRequest


@dataclass(frozen=True)
class ConvertingConfig:
    """How large a field gets where no size is asked for. One on vertices is as fine as one that is trained:
    with what a fuse allows, a chair of 256 texels would have 194."""

    max_size: int = 50_000_000
    """Bytes of one on vertices, beside what the places among the sources take."""
    components: int = 2
    """Times those of a trained field, of kinds that have them: what another kind shows is not of as few
    (decision 054)."""
    most_held: int = 150_000_000
    """Numbers in memory: with what learning adds, some 4 GB."""


def convert(request: ConvertRequest, progress) -> dict:
    """Teach a field of another kind all that a bundle shows (after PVD, Fang et al., AAAI 2023), and hold it
    against its source on views that nothing was learnt from."""
    before = kinds_of(request.field)
    try:
        target_kind = registry.kind(request.kind)
    except ValueError as error:
        raise unusable_kind(error) from error
    if target_kind.field is None:
        raise UsageProblem(f"--kind {request.kind} is a way of fusing and no kind of field; choose another")
    same = [field.name for field in fields(FuseRequest) if hasattr(request, field.name)]
    words = {name: getattr(request, name) for name in same}
    config = current(ConvertingConfig)
    if target_kind.usual_ranks and request.ranks is None and request.max_size is None:
        density, colour = target_kind.usual_ranks
        words["ranks"] = config.components * density, config.components * colour
    larger = using(
        replace(current(FusingConfig), default_max_size=config.max_size),
        replace(current(BoxKindConfig), most_held=config.most_held),
    )
    with larger if target_kind.on_vertices and request.max_size is None else nullcontext():
        fuse_request = FuseRequest(scene=request.field, from_scratch=True, **words)
        fused = fuse(fuse_request, progress, load=scene_as_stored)
    progress.phase("comparing", None)
    compared = evaluate(
        EvaluateRequest(
            request.output,
            request.field,
            memory=request.memory,
            device=request.device,
            threads=request.threads,
        ),
        progress,
    )
    return {
        "output": request.output,
        "bytes": fused["bytes"],
        "source_bytes": fused["source_bytes"],
        "from": before,
        "kind": fused["kind"],
        **compared["mean"],
        "views": len(compared["views"]),
        **{
            name: fused[name]
            for name in ("seconds", "total_seconds", "steps", "chosen", "memory")
            if name in fused
        },
    }


def kinds_of(path: str) -> str:
    """The kinds of the fields that a bundle places; InvalidInput where it is something else, or places
    none."""
    if not is_bundle(path):
        raise InvalidInput(f"{path}: not a bundle; convert takes a .rfpack")
    bundle = OpenBundle(path)
    kinds = {bundle.headers[leaf.field].kind for leaf in bundle.scene.leaves() if leaf.field is not None}
    if not kinds:
        raise InvalidInput(f"{path}: the bundle places no field; choose another one")
    return ", ".join(sorted(kinds))
