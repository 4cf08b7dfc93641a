"""`import`: another system's file to a bundle of its own numbers."""

from collections.abc import Callable
from dataclasses import replace
from importlib import import_module
from pathlib import Path

import numpy as np

from formats.bundle import BundleWriter
from formats.camera_set import capture_camera_set
from formats.captures import read_capture
from formats.errors import FormatError
from formats.foreign.stored import StoredTensor
from formats.foreign.systems import SYSTEMS, Checkpoint, open_checkpoint
from formats.graph import free_name, placement_of
from formats.records import FieldRecord
from formats.scene import SceneGraph, make_node
from formats.splats.reading import is_moved, is_splats, newest_point_cloud
from formats.splats.splats import UP_Z
from formats.views import Capture
from fusedrf_cli import __version__
from fusedrf_cli.bridge.importing import dvgo, nerf, splats
from fusedrf_cli.bridge.importing.parts import Imported
from fusedrf_cli.bridge.memory import Memory
from fusedrf_cli.bridge.views import unit_vector
from fusedrf_cli.engine.kinds import registry
from fusedrf_cli.engine.spaces import bounded
from fusedrf_cli.errors import InvalidInput, UsageProblem
from fusedrf_cli.requests import ImportRequest

READERS = {
    "tensorf": ("tensorf", "read"),
    "svox2": ("svox2", "read"),
    "dvgo": ("dvgo", "read"),
    "dcvgo": ("dvgo", "read"),
    "torch-ngp": ("torch_ngp", "read"),
    "pvd": ("torch_ngp", "read_pvd"),
    "instant-ngp": ("instant_ngp", "read"),
    "nerfacto": ("nerfacto", "read"),
    "nerf-pytorch": ("nerf", "read"),
    "krrish-nerf": ("nerf", "read_krrish"),
    "hashnerf": ("nerf", "read_hashed"),
    "k-planes": ("k_planes", "read"),
    "d2nerf": ("d2nerf", "read"),
    "splatfacto": ("splat_checkpoints", "read_splatfacto"),
    "gsplat": ("splat_checkpoints", "read"),
    "3dgs": ("splat_checkpoints", "read"),
}
"""The module and the function that read a system's checkpoint."""
BOXLESS = "nerf-pytorch", "krrish-nerf", "hashnerf", "d2nerf"
"""Systems whose files have no box."""
MOVING = "k-planes", "d2nerf"
"""Systems whose scenes may move."""
MOVED = "nerfacto", "splatfacto", "svox2", "pvd"
"""Systems of which a run or a capture tells how they moved its cameras."""
SPLATS = "splatfacto", "gsplat", "3dgs"
"""Systems whose scenes are Gaussian splats."""
UNREAD = {
    "dmpigo": dvgo.FORWARD,
    "dbivoxgo": "train it with DVGO's contracted model",
    "ccnerf": "train it with CCNeRF of torch-ngp (main_CCNeRF.py)",
    "d-nerf": "its points are moved by a network of time; train it with 'nerf_type = original'",
}
"""Why checkpoints of a system are not read, where that is known."""
MOST_LONG = 10_000
"""Times as long as another side of its box one may be, of a field whose file has none."""
COPIES = 5.5
"""Of an array, of what its field takes: read, rearranged, as numbers and as they are written."""


def import_field(request: ImportRequest, progress) -> dict:
    """Write what a file of another system holds."""
    progress.phase("reading", None)
    memory = Memory(request.memory)
    capture = None if request.cameras is None else read_capture(request.cameras)
    newest = newest_point_cloud(request.path)
    if newest is not None or Path(request.path).is_file() and is_splats(request.path):
        check_boxless(request)
        system, imported = "Gaussian splats", splats.read(newest or request.path, memory)
        taken = [] if newest is None else [f"{request.path}: its newest splats are taken, {newest}"]
        if is_moved(Path(newest or request.path)):
            taken.append(
                f"{request.path}: its splats move, by a network that is not read; they stand where they rest"
            )
        imported = replace(imported, notes=[*taken, *imported.notes, *unmoved(request)])
    else:
        system, imported = of_system(request, capture, memory)
    progress.phase("writing", None)
    graph = write(imported, request, capture)
    return {
        "output": request.output,
        "bytes": Path(request.output).stat().st_size,
        "system": system,
        "fields": [
            {"name": leaf.name, "kind": field.kind, **registry.kind(field.kind).describe(field)}
            for leaf, field in zip(graph.leaves(), (n.field for n in imported.nodes), strict=True)
        ],
        "notes": [*imported.notes],
        "memory": memory.report(),
    }


def of_system(request: ImportRequest, capture: Capture | None, memory: Memory) -> tuple[str, Imported]:
    """What a checkpoint holds, and the name of the system that wrote it."""
    checkpoint = open_checkpoint(request.path)
    title = SYSTEMS[checkpoint.system].title
    if checkpoint.system not in READERS:
        known = ", ".join(SYSTEMS[name].title for name in READERS)
        because = UNREAD.get(checkpoint.system, f"read are those of {known}")
        raise InvalidInput(f"{checkpoint.path}: a checkpoint of {title}, which is not read; {because}")
    parts = {"the field": COPIES * bytes_of(checkpoint.entries)}
    memory.expect(parts, advice="close other programs, or raise --memory")
    imported = imported_from(checkpoint, request, capture, memory)
    return title, replace(imported, notes=[*checkpoint.notes, *imported.notes])


def is_read(key: object, value: object) -> bool:
    """Whether an entry may be part of a field."""
    return "optim" not in str(key) or isinstance(value, dict) and "target" in value


def bytes_of(entries: object) -> float:
    """Of the arrays that a field may be made of: what optimisers keep is never read."""
    if isinstance(entries, StoredTensor):
        return 4.0 * np.prod(entries.shape, dtype=float)
    if isinstance(entries, dict):
        entries = entries.get("target", entries)  # an optimiser of Flax holds what it optimises
        return sum(bytes_of(value) for key, value in entries.items() if is_read(key, value))
    return float(len(entries)) if isinstance(entries, bytes) else 0.0


def imported_from(
    checkpoint: Checkpoint, request: ImportRequest, capture: Capture | None, memory: Memory
) -> Imported:
    """What the file holds. Raises InvalidInput naming the file."""
    module, function = READERS[checkpoint.system]
    read: Callable[..., Imported] = getattr(import_module(f"{__name__}.{module}"), function)
    boxless = checkpoint.system in BOXLESS
    if not boxless:
        check_boxless(request)
    given = {"box": box_of(request, capture, checkpoint)} if boxless else {}
    given |= {"time": request.time} if checkpoint.system in MOVING else {}
    given |= {"memory": memory} if checkpoint.system in SPLATS else {}
    given |= {"capture": capture} if checkpoint.system in MOVED else {}
    try:
        imported = read(checkpoint, **given)
    except (FormatError, ValueError, ArithmeticError, LookupError) as error:
        where = "" if str(error).startswith(f"{checkpoint.path}: ") else f"{checkpoint.path}: "
        cure = f"copy it again, or save it with {SYSTEMS[checkpoint.system].title} as it is published"
        raise InvalidInput(f"{where}{error}" + ("" if "; " in str(error) else f"; {cure}")) from error
    notes = [] if "time" in given else unmoved(request)
    return replace(imported, notes=[*imported.notes, *notes])


def check_boxless(request: ImportRequest) -> None:
    """UsageProblem where a box is given of a file that has its own."""
    if any(given is not None for given in (request.aabb, request.near, request.far)):
        raise UsageProblem(
            f"{request.path}: has a box of its own, and --aabb, --near and --far are for files without one; "
            "leave them out"
        )


def unmoved(request: ImportRequest) -> list[str]:
    """What is to be said of a time for what does not move."""
    return [] if request.time is None else ["nothing in it moves, and --time is not used"]


def box_of(request: ImportRequest, capture: Capture | None, checkpoint: Checkpoint) -> np.ndarray:
    """The box (6,) of a field whose file has none: as given, or what cameras see between two distances."""
    if request.aabb is not None:
        if request.near is not None or request.far is not None:
            raise UsageProblem("--aabb is the box itself; leave out --near and --far")
        box = np.array(request.aabb)
        if not (box[:3] < box[3:]).all():
            raise UsageProblem(f"--aabb should be three minima below three maxima, found {request.aabb}")
        sides = box[3:] - box[:3]
        if not sides.max() <= MOST_LONG * sides.min():
            raise UsageProblem(f"--aabb should have no side above {MOST_LONG:,} times another, found {sides}")
        return box
    if checkpoint.system == "hashnerf":
        if request.near is not None or request.far is not None:
            raise UsageProblem(
                f"{request.path}: its hash grid fills a box, which --near and --far do not tell; give it as "
                "--aabb, or leave them out where args.txt lies beside it"
            )
        if (stated := nerf.hashed_box(checkpoint)) is None:
            raise UsageProblem(
                f"{request.path} does not say which box its hash grid fills; give it as --aabb "
                "xmin,ymin,zmin,xmax,ymax,zmax, exactly as its run had it"
            )
        return stated
    if nerf.in_ndc(checkpoint):
        raise UsageProblem(
            f"{request.path} was trained in normalised device coordinates, in which a capture's cameras do "
            "not lie; give its box there as --aabb, such as -1.5,-1.67,-1,1.5,1.67,1"
        )
    if nerf.of_llff(checkpoint):
        raise UsageProblem(
            f"{request.path} was trained on an LLFF capture, whose cameras its loader moved and scaled, and "
            "how is told nowhere; give its box there as --aabb xmin,ymin,zmin,xmax,ymax,zmax"
        )
    if capture is None or request.near is None or request.far is None:
        raise UsageProblem(
            f"{request.path} does not say where its scene lies; give the box as --aabb "
            "xmin,ymin,zmin,xmax,ymax,zmax, or --near, --far and the capture as --cameras"
        )
    if not request.near < request.far:
        raise UsageProblem(f"--near {request.near:g} should be less than --far {request.far:g}")
    views = capture.train + capture.test
    corners = np.concatenate([view.corners(t) for view in views for t in (request.near, request.far)])
    return np.concatenate([corners.min(0), corners.max(0)])


def write(imported: Imported, request: ImportRequest, capture: Capture | None) -> SceneGraph:
    """Write the bundle; its scene graph: several nodes stand in a group."""
    writer, nodes, names = BundleWriter(), [], set()
    wanted = request.name or Path(request.path).stem
    group = free_name(wanted, names) if len(imported.nodes) > 1 else None
    for node in imported.nodes:
        member = writer.add_field(FieldRecord(node.field.kind, *node.field.state()), request.precision)
        name = free_name(wanted + node.suffix, names)
        nodes.append(make_node(name, field=member, **placement_of(node.object_to_world)))
    if group is not None:
        rule = None if imported.rule == "max" else imported.rule
        nodes = [replace(make_node(group, children=tuple(nodes)), composition=rule)]
    cameras = None
    if capture is not None:
        unbounded = any(node.field.space is not bounded for node in imported.nodes)
        cameras = capture_camera_set(capture, surroundings=unbounded).content()
    up = None if imported.up == UP_Z else imported.up
    up = up if request.up is None else tuple(unit_vector(request.up).tolist())
    shown = {"cameras": cameras} if imported.framing is None or cameras else {"framing": imported.framing}
    graph = SceneGraph(tuple(nodes), generator=f"fusedrf {__version__}", up=up, **shown)
    writer.write(request.output, graph, overwrite=request.overwrite)
    return graph
