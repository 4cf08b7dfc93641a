"""Files to placed engine fields, and back."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from formats.bundle import FieldSet, OpenBundle, is_bundle, shared_members
from formats.errors import FormatError
from formats.field_header import reading_size
from formats.nodes import Crop as ShownPart
from formats.nodes import Leaf, check_affine
from formats.records import FieldRecord
from formats.scene import MAX_SCENE_BYTES, SceneGraph, parse_scene
from formats.sources import expand_scene, inline_scenes, resolve_source
from fusedrf_cli.bridge.crops import NothingHeld, where_held
from fusedrf_cli.bridge.field_cache import FieldCache
from fusedrf_cli.bridge.memory import Memory, sources
from fusedrf_cli.engine.composition.affine import WHITE, Placed
from fusedrf_cli.engine.composition.composed import ComposedField
from fusedrf_cli.engine.composition.crops import Crop, Crops
from fusedrf_cli.engine.fields.base import FieldMemory, StoredField
from fusedrf_cli.engine.fields.occupancy import OccupancyGrid, placement
from fusedrf_cli.engine.fields.streamed import StreamedField, opened
from fusedrf_cli.engine.kinds import registry
from fusedrf_cli.engine.kinds.kind import Kind
from fusedrf_cli.errors import FusedRFError, InvalidInput, UsageProblem
from fusedrf_cli.requests import FuseRequest, TrainRequest

MALFORMED = (KeyError, TypeError, ValueError, IndexError, AttributeError, ArithmeticError)
"""What reading arrays and metadata that make no field may raise."""
OPTIONS = {"ranks": "--ranks", "sh_degree": "--sh-degree"}


@dataclass(frozen=True)
class SourceField:
    """A field that a scene places, and where it came from."""

    placed: Placed
    background: bool
    bundle: OpenBundle
    """That it was read from."""
    member: str
    needs: FieldMemory
    whole: bool = True
    """Whether it is shown as the bundle has it."""
    cut: bool = False
    """Whether the field is what crops leave of the bundle's, in numbers of its own: see `cut_to_crops`."""
    crops: tuple[ShownPart, ...] = ()
    """In its frame."""
    groups: tuple[tuple[str, str], ...] = ()
    """The groups of nodes that it is in which have a rule of their own, from the root down, and their
    rules."""


FoundField = tuple[Leaf, OpenBundle, str]
"""Where a field lies in a scene, the bundle that it is in, and its member."""


@dataclass(frozen=True)
class PlacedCameraSet:
    """Cameras that a source of a scene keeps."""

    name: str
    """Of the node that names the source."""
    background: bool
    cameras: dict
    """In the source's own world, as its scene.json has them."""
    object_to_world: np.ndarray
    """(4, 4) from that world to the scene's."""


@dataclass(frozen=True)
class PlacedFraming:
    """What pictures of a source of a scene show by themselves."""

    name: str
    """Of the node that names the source."""
    box: tuple[float, ...]
    """(6,) in the source's own world."""
    object_to_world: np.ndarray
    """(4, 4) from that world to the scene's."""


@dataclass(frozen=True)
class LoadedScene:
    """A scene graph with its fields read."""

    fields: tuple[SourceField, ...]
    composition: str
    graph: SceneGraph
    path: Path | None
    field_cache: FieldCache
    camera_sets: tuple[PlacedCameraSet, ...] = ()
    """Of its sources."""
    framings: tuple[PlacedFraming, ...] = ()
    """Of those of its sources that say so, and are not cropped."""
    bundle: OpenBundle | None = None
    """That the graph was read from; None: a scene.json."""

    @property
    def sizes(self) -> list[int]:
        """Bytes of the distinct fields."""
        return list({id(f.placed.field): f.needs.held for f in self.fields}.values())

    @property
    def resident(self) -> list[int]:
        """Bytes that these take while they are only read."""
        return list({id(f.placed.field): f.needs.resident for f in self.fields}.values())

    @property
    def placed(self) -> list[Placed]:
        """The placed fields in node order."""
        return [f.placed for f in self.fields]

    def composed(self) -> ComposedField:
        """The scene as one field."""
        return ComposedField(
            grouped(self.placed, [f.groups for f in self.fields], self.composition), self.composition
        )

    def lone(self) -> tuple[StoredField, np.ndarray] | None:
        """The field of a scene that is one field, shown as it is, and where its frame lies in the world: a
        position (3,) where it is only moved, else a placement (4, 4)."""
        if len(self.fields) == 1 and self.fields[0].placed.as_it_is:
            placed = self.fields[0].placed
            return opened(placed.field), short_origin(placed.object_to_world)
        return None


def grouped(placed: Sequence[Placed], groups: Sequence[tuple], rule: str, depth: int = 0) -> list[Placed]:
    """Placed fields, in groups of nodes, as what is composed by a rule: groups of another rule are fields of
    their own, placed where their frames lie."""
    members, start = [], 0
    while start < len(placed):
        group = groups[start][depth] if len(groups[start]) > depth else None
        end = start + 1
        while group is not None and end < len(placed) and groups[end][depth : depth + 1] == (group,):
            end += 1
        if group is None:
            members.append(placed[start])
        else:
            subgroup = grouped(placed[start:end], groups[start:end], group[1], depth + 1)
            if group[1] == rule or len(subgroup) == 1:
                members += subgroup
            else:
                inner = ComposedField(subgroup, group[1])
                members.append(Placed(group[0], inner, placement(inner.origin)))
        start = end
    return members


def make_field(record: FieldRecord, where: str) -> StoredField:
    """An engine field from a bundle's record; InvalidInput for an unknown kind or arrays that do not fit
    it.
    """
    try:
        field = registry.kind(record.kind).field
        if field is None:
            raise registry.UnknownKind(f"kind '{record.kind}' is a way of fusing, and no field is of it")
    except ValueError as error:
        raise InvalidInput(f"{where}: {error}") from error
    try:
        return field.from_state(record.arrays, record.metadata)
    except MALFORMED as error:
        raise InvalidInput(
            f"{where}: the '{record.kind}' field is malformed ({error}); make the bundle again"
        ) from error


def unusable_kind(error: ValueError) -> FusedRFError:
    """What a person reads of a kind that they named and that the registry does not have."""
    return (InvalidInput if isinstance(error, registry.BrokenKind) else UsageProblem)(f"--kind: {error}")


def refuse_options(kind: Kind, request: FuseRequest | TrainRequest) -> None:
    """UsageProblem for an option that a kind does not heed."""
    for option in unheeded(kind, request):
        raise UsageProblem(f"{option} does not apply to kind '{kind.name}'; leave it out")


def unheeded(kind: Kind, request: FuseRequest | TrainRequest) -> list[str]:
    """The options that are given and that a kind does not heed."""
    given = {word: option for word, option in OPTIONS.items() if getattr(request, word) is not None}
    return [option for word, option in given.items() if word not in kind.takes]


def note_options(request: FuseRequest, loaded: LoadedScene, progress) -> None:
    """Say which of the sources, which stay fields of their own, do not heed an option; UsageProblem where
    none does."""
    kinds = {f.placed.field.kind for f in loaded.fields}
    for word, option in OPTIONS.items():
        others = sorted(name for name in kinds if word not in registry.kind(name).reduces)
        if getattr(request, word) is None or not others:
            continue
        if len(others) == len(kinds):
            raise UsageProblem(f"{option} does not apply to kind {', '.join(others)}; leave it out")
        progress.warn(f"{option} does not apply to fields of kind {', '.join(others)}: they keep theirs")


def needs_of(bundle: FieldSet, member: str) -> FieldMemory:
    """What a field of a bundle needs of memory, told by its header before it is read. InvalidInput where that
    makes no field."""
    header = bundle.headers[member]
    arrays = bundle.arrays(member)
    shapes = {name: shape for name, (_, shape) in header.arrays.items()}
    try:
        needs = registry.kind(header.kind).field_memory(header.metadata, shapes, arrays.__getitem__)
    except MALFORMED:  # reading the field says what is wrong
        needs = FieldMemory(header.decoded_size, 0)
    shared = shared_members(member, header, bundle.headers, str(bundle.path)).values()
    parts = [header, *(bundle.headers[name] for name in shared)]
    decoding = max(map(reading_size, parts)) - needs.resident  # before anything is made of the arrays
    reading = sum(part.decoded_size for part in parts) + max(needs.reading, decoding)
    return replace(needs, reading=reading)


def stored_grid(bundle: FieldSet, member: str) -> OccupancyGrid | None:
    """The occupancy grid of a field, without its other numbers; None where only reading the field tells, or
    says what is wrong with it."""
    header = bundle.headers[member]
    try:
        return registry.kind(header.kind).stored_occupancy(header.metadata, bundle.arrays(member))
    except MALFORMED:
        return None


def load_scene(
    path: str, allow_outside: bool = False, budget: Memory | None = None, device: str = "cpu"
) -> LoadedScene:
    """Read a bundle, a scene.json or '-' with all fields it places, on the device `device`; equal members
    become one field.

    Of the fields, as many stay in memory as the budget has room for; others are read again when asked. Raises
    ResourceProblem where not even the largest fits, before it is read.
    """
    if path == "-":
        where = Path.cwd() / "scene.json"
        graph = inline_scenes(
            parse_scene(sys.stdin.buffer.read(MAX_SCENE_BYTES + 1), "standard input"), where, allow_outside
        )
        return _Loader(where, budget, device).load(graph, allow_outside)
    if is_bundle(path):
        bundle = OpenBundle(path)
        return _Loader(Path(path), budget, device).load(bundle.scene, allow_outside, bundle)
    return _Loader(Path(path), budget, device).load(expand_scene(path, allow_outside), allow_outside)


def load_bundle(
    bundle: FieldSet, graph: SceneGraph, budget: Memory | None = None, device: str = "cpu"
) -> LoadedScene:
    """As `load_scene`, of a bundle that is open, by its graph or another one over its fields."""
    return _Loader(bundle.path, budget, device).load(graph, False, bundle)


def outlines(
    bundle: FieldSet, graph: SceneGraph, budget: Memory | None, known: dict[str, StreamedField]
) -> list[Placed]:
    """The same to know where its visible nodes lie: a field is read when its header and its grid do not tell
    that, and held against the budget then. known: fields that were asked before, and come to be."""
    loader = _Loader(bundle.path, budget, "cpu", known)
    return where_held(loader.outline, loader.found(graph, False, bundle))


def load_fields(
    path: Path, graph: SceneGraph, fields: Sequence[FoundField], budget: Memory | None, device: str = "cpu"
) -> LoadedScene:
    """As `load_scene`, of fields that were found already."""
    return _Loader(path, budget, device).read(graph, fields)


class _Loader:
    """Finds the fields of one scene; every bundle is opened once, and read from that version to the end."""

    def __init__(
        self,
        path: Path,
        budget: Memory | None,
        device: str,
        known: dict[str, StreamedField] | None = None,
    ):
        self.path, self.budget, self.field_cache, self.device = path, budget, FieldCache(), device
        self.bundles: dict[Path, OpenBundle] = {}
        self.fields: dict[str, StreamedField] = {} if known is None else known
        self.camera_sets: list[PlacedCameraSet] = []
        self.framings: list[PlacedFraming] = []

    def load(self, graph: SceneGraph, allow_outside: bool, bundle: OpenBundle | None = None) -> LoadedScene:
        return self.read(graph, self.found(graph, allow_outside, bundle), bundle)

    def found(self, graph: SceneGraph, allow_outside: bool, bundle: OpenBundle | None) -> list[FoundField]:
        """The fields that visible leaves of a graph place."""
        fields = []
        leaves = graph.leaves()
        for leaf in leaves:
            if not leaf.visible:
                continue
            if leaf.field is not None:
                fields.append((leaf, bundle, leaf.field))
            elif leaf.source is not None:
                target = resolve_source(self.path, leaf.source, allow_outside, leaf.name)
                fields += self.sources(leaf, target)
        if not fields and leaves:
            raise InvalidInput(f'{self.path}: nothing of the scene is visible; remove a "visible": false')
        if not fields:
            raise InvalidInput(f"{self.path}: the scene places no field; add a node with a 'source'")
        return fields

    def read(
        self, graph: SceneGraph, field_list: Sequence[FoundField], bundle: OpenBundle | None = None
    ) -> LoadedScene:
        """A scene of fields, within the budget."""
        needs = {(bundle, member): needs_of(bundle, member) for _, bundle, member in field_list}
        if self.budget is not None:
            sizes = {member: needs[b, member].resident for _, b, member in field_list}
            reading = {"a source while it is read": max(each.reading for each in needs.values())}
            if copied := sum(one.copied for one in {id(one): one for _, one, _ in field_list}.values()):
                reading["fields of a bundle of an earlier version"] = copied
            self.field_cache.resize(self.budget.room(reading))
            self.budget.expect(
                sources([*sizes.values()], self.field_cache.room) | reading, advice="use smaller sources"
            )
        with_needs = ((leaf, b, member, needs[b, member]) for leaf, b, member in field_list)
        fields = tuple(where_held(self.source, with_needs))
        kept = tuple(self.camera_sets), tuple(self.framings)
        return LoadedScene(fields, graph.composition, graph, self.path, self.field_cache, *kept, bundle)

    def sources(self, leaf, path: Path) -> list[FoundField]:
        """The arguments of `source` for the fields of the bundle that a leaf names."""
        if path not in self.bundles:
            if not is_bundle(path):
                raise InvalidInput(
                    f"{self.path}: node '{leaf.name}': its source {leaf.source} is no bundle; train it to a "
                    ".rfpack first"
                )
            self.bundles[path] = OpenBundle(path)
        scene = self.bundles[path].scene
        inner = [node for node in scene.leaves() if node.field is not None and node.visible]
        if not inner:
            raise InvalidInput(
                f"{path}: the bundle holds no field, so node '{leaf.name}' would be empty; choose another "
                "source"
            )
        if scene.cameras is not None:
            self.camera_sets.append(
                PlacedCameraSet(leaf.name, leaf.background, scene.cameras, leaf.object_to_world)
            )
        if scene.framing is not None and not leaf.crops:
            self.framings.append(PlacedFraming(leaf.name, scene.framing, leaf.object_to_world))
        named = [leaf.name] if len(inner) == 1 else [f"{leaf.name}/{node.name}" for node in inner]
        if len(inner) > 1:
            leaf = replace(leaf, groups=(*leaf.groups, (leaf.name, scene.composition)))
        return [
            (replace(node.inside(leaf), name=name), self.bundles[path], node.field)
            for name, node in zip(named, inner, strict=True)
        ]

    def source(self, leaf: Leaf, bundle: OpenBundle, member: str, needs: FieldMemory) -> SourceField:
        """leaf: where the field lies, under which name, and what is shown of it."""
        where = f"{bundle.path}: node '{leaf.name}'"

        def read():
            return self.field_cache.take(member, needs.held, partial(self.field, bundle, member, where))

        if member not in self.fields:
            self.fields[member] = StreamedField(read, partial(stored_grid, bundle, member))
            self.fields[member].kept  # noqa: B018  (read now, so that before any work what is no field is refused)
        placed = self.placed(leaf, bundle, member)
        shown = leaf.whole, False, leaf.crops, leaf.groups
        return SourceField(placed, leaf.background, bundle, member, needs, *shown)

    def outline(self, leaf: Leaf, bundle: FieldSet, member: str) -> Placed:
        """The same of a field that is read, and not kept, where its header and its grid do not tell where it
        lies."""

        def read():
            needs = needs_of(bundle, member)
            if self.budget is not None:
                parts = {f"the field of '{leaf.name}'": needs.held + needs.reading}
                self.budget.expect(parts, advice="allow more by --memory")
            return self.field(bundle, member, f"{bundle.path}: node '{leaf.name}'")

        if member not in self.fields:
            self.fields[member] = StreamedField(read, partial(stored_grid, bundle, member))
        return self.placed(leaf, bundle, member)

    def field(self, bundle: FieldSet, member: str, where: str) -> StoredField:
        """The field of a member."""
        return make_field(bundle.field(member), where).to(self.device)

    def placed(self, leaf: Leaf, bundle: FieldSet, member: str) -> Placed:
        """A field where a leaf places it. Raises what says that it cannot, or that its crops hold nothing of
        it."""
        crops = Crops(tuple(Crop.of(crop.shape, crop.object_to_shape) for crop in leaf.crops))
        field = self.fields[member]
        try:
            check_affine(leaf.object_to_world, f"node '{leaf.name}' in the world")
            placed = Placed(leaf.name, field, leaf.object_to_world, leaf.opacity, leaf.tint, crops)
        except FormatError as error:
            raise error.within(str(self.path)) from error
        except ValueError as error:
            raise InvalidInput(f"{bundle.path}: {error}; give an invertible placement") from error
        if crops and not placed.occupancy.occupied.any():
            raise NothingHeld(f"{bundle.path}: node '{leaf.name}'", field.aabb, leaf.crops[-1])
        return placed


def background_of(scene: LoadedScene) -> SourceField:
    """The node marked as background, else one that fills all of space, else the one with the largest box."""
    marked = [f for f in scene.fields if f.background]
    return marked[0] if marked else max(scene.fields, key=_volume)


def _volume(source: SourceField) -> tuple[bool, float]:
    placed = source.placed
    return placed.unbounded, float(np.prod(placed.aabb[3:] - placed.aabb[:3]))


def showing_of(placed: Placed | Leaf) -> dict:
    """What a node says of how a placed field is shown, but for crops."""
    words = {} if placed.opacity == 1 else {"opacity": placed.opacity}
    return words | ({} if tuple(placed.tint) == WHITE else {"tint": list(placed.tint)})


def short_origin(object_to_world: np.ndarray) -> np.ndarray:
    """A placement (4, 4), or, where it only moves, the position (3,)."""
    moves = np.array_equal(object_to_world[:3, :3], np.eye(3))
    return object_to_world[:3, 3] if moves else object_to_world
