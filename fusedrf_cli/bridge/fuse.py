"""`fuse`: a scene to one field."""

import time
from dataclasses import asdict, replace

from fusedrf_cli.bridge.fuse_blocks import blocks_memory, fuse_blocks
from fusedrf_cli.bridge.fuse_sparse import fuse_sparse, sparse_memory
from fusedrf_cli.bridge.fuse_vm import fuse_vm, vm_memory
from fusedrf_cli.bridge.fusing import Asked, make_room, warn_of_detail
from fusedrf_cli.bridge.memory import Memory
from fusedrf_cli.bridge.running import checkpoint_path, engine
from fusedrf_cli.bridge.scene import LoadedScene, history_nodes, load_scene, write_field
from fusedrf_cli.bridge.sizes import graph_bytes
from fusedrf_cli.engine.fields.base import holds_matter
from fusedrf_cli.engine.kinds.vm.field import VMField
from fusedrf_cli.errors import InvalidInput, QualityNotReached

DEFAULT_MAX_SIZE = 25_000_000


def fuse(
    scene: str,
    output: str,
    *,
    kind: str,
    max_size: int | None,
    target_psnr: float | None,
    time_budget: float | None,
    rgb: bool,
    from_scratch: bool,
    keep_sources: bool,
    memory: int | None,
    precision: str | None,
    ranks: tuple[int, int] | None,
    sh_degree: int | None,
    resume: bool,
    allow_outside: bool,
    overwrite: bool,
    seed: int,
    device: str,
    threads: int | None,
    progress,
) -> dict:
    """Turn a composed scene into one field and write it with the scene's history."""
    with engine(device, threads, progress) as place:
        progress.phase("reading", None)
        budget = Memory(memory)
        loaded = without_empty(load_scene(scene, allow_outside, budget, place), scene, progress)
        composed = loaded.composed()
        chosen = choose_kind(kind, loaded)
        limit = max_size or DEFAULT_MAX_SIZE
        started = time.monotonic()
        kept = {f.member: f.path for f in loaded.fields} if keep_sources else {}
        nodes = history_nodes(loaded, output, kept)
        asked = Asked(
            limit=limit,
            overhead=graph_bytes(nodes),
            target=target_psnr,
            precision=precision,
            ranks=ranks,
            sh_degree=sh_degree,
            rgb=rgb,
            seed=seed,
            time_budget=time_budget,
        )
        if chosen == "blocks":
            whole = blocks_memory(budget, loaded, composed, asked)
            fused = fuse_blocks(composed, asked, whole, place, progress)
        elif chosen == "sparse":
            make_room(budget, loaded, *sparse_memory(composed, asked))
            fused = fuse_sparse(composed, asked, place, progress)
        else:
            make_room(budget, loaded, *vm_memory(composed, asked))
            fused = fuse_vm(loaded, composed, asked, from_scratch, output, resume, place, progress)
        warn_of_detail(fused.details, fused.remedy, progress)
        entry = {
            "event": "fused",
            "kind": chosen,
            "composition": loaded.composition,
            "nodes": nodes,
            "settings": {"seed": seed, "max_size": limit, "rgb": rgb, "from_scratch": from_scratch},
            "psnr": fused.figures["psnr"],
        }
        size = write_field(
            output,
            fused.field,
            "fused",
            precision=fused.precision,
            overwrite=overwrite,
            origin=composed.origin,
            history=(entry,),
            kept=kept,
        )
        checkpoint_path(output).unlink(missing_ok=True)
    report = {
        "output": output,
        "bytes": size,
        "source_bytes": source_bytes(loaded),
        "kind": chosen,
        **fused.figures,
        "objects": [asdict(d) for d in fused.details],
        "total_seconds": time.monotonic() - started,
        "memory": budget.report(),
    }
    check_target(report, target_psnr, output)
    return report


def check_target(report: dict, target_psnr: float | None, output: str) -> None:
    """QualityNotReached, after the output was written, where a target was given and missed."""
    reached = report["psnr"]["stored"]
    if target_psnr is not None and reached < target_psnr:
        raise QualityNotReached(
            f"{output}: reached {reached:.2f} dB where --target-psnr asked for {target_psnr:g}; give more "
            "--max-size or --time-budget",
            report=report,
        )


def choose_kind(kind: str, loaded: LoadedScene) -> str:
    """What was asked for; for auto, blocks where they can stand for the scene (VM sources, max composition),
    which came far nearer to it in far less time (DESIGN), else vm.
    """
    possible = loaded.composition == "max" and all(p.field.kind == VMField.kind for p in loaded.placed)
    if kind == "blocks" and not possible:
        raise InvalidInput(f"{loaded.path}: blocks need vm sources and 'max' composition; use --kind vm")
    return kind if kind != "auto" else ("blocks" if possible else "vm")


def source_bytes(loaded: LoadedScene) -> int:
    """Bytes of the distinct source files."""
    return sum(
        path.stat().st_size for path in {f.path for f in loaded.fields} if path is not None and path.is_file()
    )


def without_empty(loaded: LoadedScene, scene: str, progress) -> LoadedScene:
    """The scene without the fields that show nothing, each named in a warning; InvalidInput where none is
    left."""
    full = {id(p.field): p.field for p in loaded.placed}
    full = {key for key, field in full.items() if holds_matter(field)}
    for f in loaded.fields:
        if id(f.placed.field) not in full:
            progress.warn(f"'{f.placed.name}' is empty and was left out")
    kept = tuple(f for f in loaded.fields if id(f.placed.field) in full)
    if not kept:
        raise InvalidInput(f"{scene}: all its fields are empty; train them again")
    return replace(loaded, fields=kept)
