"""`convert`: a field of any kind to one of any other."""

from formats.bundle import OpenBundle, is_bundle
from fusedrf_cli.bridge.evaluating import evaluate
from fusedrf_cli.bridge.fusing import fuse
from fusedrf_cli.bridge.scene import unusable_kind
from fusedrf_cli.bridge.sources import as_it_is
from fusedrf_cli.engine.kinds import registry
from fusedrf_cli.errors import InvalidInput, UsageProblem
from fusedrf_cli.requests import ConvertRequest, EvaluateRequest, FuseRequest


def convert(request: ConvertRequest, progress) -> dict:
    """Teach a field of another kind all that a field shows (after PVD, Fang et al., AAAI 2023), and hold it
    against its source on views that nothing was learnt from."""
    before = kind_of(request.field)
    try:
        wanted = registry.kind(request.kind)
    except ValueError as error:
        raise unusable_kind(error) from error
    if wanted.field is None:
        raise UsageProblem(f"--kind {request.kind} is a way of fusing and no kind of field; choose another")
    words = {
        name: getattr(request, name) for name in FuseRequest.__dataclass_fields__ if hasattr(request, name)
    }
    fused = fuse(
        FuseRequest(
            scene=request.field,
            rgb=True,
            from_scratch=True,
            keep_sources=False,
            allow_outside=False,
            resume=False,
            sources=None,
            **words,
        ),  # fmt: skip
        progress,
        load=as_it_is,
    )
    progress.phase("comparing", None)
    compared = evaluate(
        EvaluateRequest(
            bundle=request.output, against=request.field, split="test", size=None, memory=request.memory,
            allow_outside=False, device=request.device, threads=request.threads,
        ),
        progress,
    )  # fmt: skip
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


def kind_of(path: str) -> str:
    """The kind of the one field that a bundle places; InvalidInput where it is something else."""
    if not is_bundle(path):
        raise InvalidInput(f"{path}: not a bundle; convert takes a .rfpack with one field")
    bundle = OpenBundle(path)
    placed = [leaf.field for leaf in bundle.scene.leaves() if leaf.field is not None]
    if len(placed) != 1:
        raise InvalidInput(f"{path}: holds {len(placed)} placed fields where one was expected; fuse it first")
    return bundle.headers[placed[0]].kind
