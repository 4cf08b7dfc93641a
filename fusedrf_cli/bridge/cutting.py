"""A bundle taken apart by its nodes: what of each field is an object's, and what stays. Every field is cut by
its own kind; the fields of nodes that lie wholly on one side keep their bytes."""

from collections.abc import Container, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from formats.records import BYTES_PER_NUMBER
from formats.scene import Leaf, SceneGraph
from fusedrf_cli.bridge.editing import Draft
from fusedrf_cli.bridge.memory import ownership, sources
from fusedrf_cli.bridge.scene import LoadedScene, SourceField, grouped
from fusedrf_cli.engine.composition.affine import Placed
from fusedrf_cli.engine.composition.composed import ComposedField, shown_at
from fusedrf_cli.engine.composition.composite import as_composite
from fusedrf_cli.engine.composition.crops import NO_CROPS
from fusedrf_cli.engine.fields.base import RadianceField, StoredField
from fusedrf_cli.engine.fields.occupancy import seen_placement, transformed_aabb
from fusedrf_cli.engine.fields.streamed import StreamedField, opened
from fusedrf_cli.engine.kinds import registry
from fusedrf_cli.engine.rendering.cameras import Camera
from fusedrf_cli.engine.selection.cells import CellConfig, Selection
from fusedrf_cli.engine.selection.voting import shown_by
from fusedrf_cli.engine.settings import current
from fusedrf_cli.errors import InvalidInput


@dataclass(frozen=True)
class CuttingConfig:
    """How what a cut hides is found, and what that takes."""

    copies: float = 3.0
    """Copies of the largest field in memory, while it is taken apart."""
    cells_bytes: float = 400e6
    """Of cells and votes."""
    veiled: float = 0.2
    """Of how much cameras see of a cell without the object: it was hidden where they saw less before."""
    layers: int = 4
    """How often what was hidden is taken away, at most."""
    few_revealed: float = 1e-4
    """Share of cells from which it is."""


Fields = Mapping[str, StoredField]
"""What is there of the fields of visible nodes, by their names: those of the bundle, and parts of them."""


@dataclass(frozen=True, eq=False)
class Whole:
    """A bundle out of which an object is taken, and the field of all that it shows."""

    draft: Draft
    loaded: LoadedScene
    field: RadianceField
    origin: np.ndarray
    """Where its frame lies in the world: a position (3,), or a placement (4, 4)."""
    raw: dict[str, StoredField] = field(default_factory=dict)
    """The fields of nodes as they are stored, by the nodes' names."""

    @classmethod
    def read(cls, draft: Draft) -> "Whole":
        """The bundle of a draft with a memory, with all its fields in it."""
        config, path, memory = current(CuttingConfig), draft.path, draft.memory
        outside = [leaf for leaf in draft.graph.leaves() if leaf.field is None]
        if outside:
            raise InvalidInput(
                f"{path}: its node '{outside[0].name}' names a source beside it; fuse it first"
            )
        loaded = draft.after()
        lone = loaded.lone()
        field, origin = lone or ((scene := as_composite(loaded.composed())), scene.origin)
        memory.expect(
            sources(loaded.sizes, copies=config.copies)
            | ownership(field.aabb)
            | {"its cells": config.cells_bytes},
            advice="take an object out of a smaller field",
        )
        loaded.field_cache.resize(sum(loaded.sizes))
        whole = cls(draft, loaded, field, origin)
        for leaf, placed in whole.nodes:
            whole.raw[leaf.name] = opened(placed.field)
        return whole

    @property
    def path(self) -> str:
        """Of the bundle."""
        return self.draft.path

    @property
    def scene(self) -> SceneGraph:
        """Of the bundle."""
        return self.draft.bundle.scene

    @property
    def nodes(self) -> list[tuple[Leaf, Placed]]:
        """The visible nodes that hold a field, and these as they are shown."""
        leaves = [leaf for leaf in self.scene.leaves() if leaf.visible and leaf.field is not None]
        return list(zip(leaves, self.loaded.placed, strict=True))

    def object_to_frame(self, leaf: Leaf) -> np.ndarray:
        """(4, 4) where a node's field lies in the frame."""
        return seen_placement(leaf.object_to_world, self.origin)

    def composed(self, fields: Fields) -> RadianceField | None:
        """What some fields show, in the frame; None where that is nothing."""
        parts, groups = [], []
        for (leaf, placed), source in zip(self.nodes, self.loaded.fields, strict=True):
            part = fields.get(leaf.name)
            if part is not None and part is not self.raw[leaf.name]:
                placed = replace(placed, field=part)
            if part is not None and placed.occupancy.occupied.any():
                parts.append(placed)
                groups.append(source.groups)
        if not parts:
            return None
        if len(self.nodes) == 1 and self.loaded.lone() is not None:
            return opened(parts[0].field)
        rule = self.loaded.composition
        return as_composite(ComposedField(grouped(parts, groups, rule), rule, origin=self.origin))

    def named(self, names: Container[str]) -> tuple[Fields, Fields]:
        """The fields of nodes of some names, and all others."""
        fields_named = {key: one for key, one in self.raw.items() if key in names}
        return fields_named, {key: one for key, one in self.raw.items() if key not in names}

    @property
    def precision(self) -> str:
        """The most exact one of its fields."""
        precisions = {self.draft.bundle.headers[leaf.field].precision for leaf, _ in self.nodes}
        return max(precisions, key=BYTES_PER_NUMBER.get)


# -- cutting -------------------------------------------------------------------------------------------------


def cut(whole: Whole, selection: Selection, both: bool, touched: Container[str]) -> tuple[Fields, Fields]:
    """A selected object out of nodes of some names, and what is left. Without `both` nothing need be known of
    what is left."""
    objects, rest = {}, dict(whole.raw)
    around = selection.object.tight_aabb(1)
    for leaf, _ in whole.nodes:
        if leaf.name not in touched:
            continue
        raw, matrix = whole.raw[leaf.name], whole.object_to_frame(leaf)
        kind, own = registry.kind(raw.kind), selection.seen_from(matrix)
        try:
            part = kind.cut_out(raw, own)
            inside = len(whole.nodes) > 1 and holds(
                around, transformed_aabb(raw.occupancy.look_at_box, matrix)
            )
            left = kind.cut_away(raw, own) if part is not None and (both or inside) else raw
        except ValueError as error:
            raise InvalidInput(f"{whole.path}: node '{leaf.name}': {error}") from error
        if part is None:
            continue
        if left is None:
            del rest[leaf.name]
            objects[leaf.name] = raw
        else:
            rest[leaf.name], objects[leaf.name] = left, part
    return objects, rest


def nodes_of(whole: Whole, selection: Selection) -> set[str]:
    """The nodes in whose occupied cells more than a share (CellConfig.aside) of an object's cells lie: it is
    none of those that it merely touches."""
    points = selection.lattice.points[selection.chosen & selection.lattice.dense]
    names = set()
    for leaf, placed in whole.nodes:
        own = shown_at(replace(placed, object_to_world=whole.object_to_frame(leaf)), points)
        if own.mean() > current(CellConfig).aside:
            names.add(leaf.name)
    return names


def holds(box: np.ndarray, other: np.ndarray) -> bool:
    """Whether a box (6,) holds another."""
    return bool((box[:3] <= other[:3]).all() and (other[3:] <= box[3:]).all())


def cut_with_hidden(
    whole: Whole,
    selection: Selection,
    shown: np.ndarray,
    least: float,
    cameras: list[Camera],
    touched: Container[str],
) -> tuple[Fields, Fields]:
    """As `cut`, and what is left is without what then shows where the object was to cameras that did not see
    it before (`shown`, (M,); `least` where it is seen at all). Such is in a field by chance, and behind it
    lies more of it."""
    config = current(CuttingConfig)
    objects, rest = cut(whole, selection, True, touched)
    gone = selection.with_islands()  # of photos: what hangs in the air is an error
    if (gone.chosen != selection.chosen).any():
        rest = cut(whole, gone, True, touched)[1]
    for _ in range(config.layers):
        left = whole.composed(rest)
        if left is None:
            break
        now = shown_by(left, selection.lattice, cameras)
        revealed = ~gone.chosen & (now > least) & (shown < config.veiled * now)
        if revealed.mean() < config.few_revealed:
            break
        gone = gone.joined(revealed)
        rest = cut(whole, gone, True, touched)[1]
    return objects, rest


def cut_to_crops(loaded: LoadedScene) -> LoadedScene:
    """The same scene in which each field that is cropped has been cut by its kind, to cells: what is stored
    anew needs no numbers that nothing shows. InvalidInput where a kind cannot be cut, or nothing is left."""
    cut: dict[tuple[int, str], StreamedField] = {}

    def after(source: SourceField) -> SourceField:
        placed, where = source.placed, f"{source.bundle.path}: node '{source.placed.name}'"
        needs = replace(source.needs, unwritten=0)  # a copy of some of it

        def read() -> StoredField:
            whole = opened(placed.field)
            try:
                part = registry.kind(whole.kind).cropped(whole.to("cpu"), placed.crops.hold)
            except ValueError as error:
                raise InvalidInput(f"{where}: {error}") from error
            if part is None:
                raise InvalidInput(f"{where}: its crop holds no whole cell of it; give a larger one")
            return part.to(whole.params.device)

        if not placed.crops:
            return source
        key = id(placed.field), repr([(c.is_ball, c.to_unit.tolist()) for c in placed.crops.items])
        if key not in cut:
            name = f"{source.member} {key[1]}"
            cut[key] = StreamedField(lambda: loaded.field_cache.take(name, needs.held, read))
        whole = replace(placed, field=cut[key], crops=NO_CROPS)
        return replace(source, placed=whole, needs=needs, cut=True, crops=())

    return replace(loaded, fields=tuple(map(after, loaded.fields)))
