"""What a kind of field is to the rest of the program.

A new kind derives `Kind`, says `name`, `good_for`, `field`, `sections` and `create`, and leaves the rest as
it is here: it is then trained from photos, distilled from any scene, grown, edited, stored and charted.
"""

from collections.abc import Mapping, Sequence

import numpy as np
import torch

from fusedrf_cli.engine.composition.affine import Placed
from fusedrf_cli.engine.composition.composed import ComposedField
from fusedrf_cli.engine.composition.resolution_report import ResolutionReport, resolution_at_voxel
from fusedrf_cli.engine.fields.base import FieldMemory, RadianceField, StoredField
from fusedrf_cli.engine.fields.box import BoxField
from fusedrf_cli.engine.fields.computed import ComputedField, Reads
from fusedrf_cli.engine.fields.occupancy import OccupancyGrid, texels
from fusedrf_cli.engine.kinds import field_cutting
from fusedrf_cli.engine.kinds.builder import (
    BuildRequest,
    DistilledBuilder,
    Plan,
    Section,
    StorageSetting,
    Suitability,
    finest_within,
)
from fusedrf_cli.engine.kinds.field_cutting import Holds
from fusedrf_cli.engine.kinds.reduction import Reduction
from fusedrf_cli.engine.kinds.sweeps import Sweep, by_sizes
from fusedrf_cli.engine.selection.cells import Selection


class Kind:
    """A kind of field: what it is called, what it is good for, how its fields are made, learnt and edited."""

    name: str
    """As people type it and as bundles say it."""
    good_for: str
    """One sentence for the list of kinds."""
    field: type[StoredField] | None = None
    """The class of its fields; None for a way of fusing whose fields are another kind's."""
    trains = True
    """Whether a field of it can begin from photos."""
    photo_rate = 1.0
    """What it learns from photos at, relative to `TrainConfig.rate`."""
    takes: frozenset[str] = frozenset()
    """Which of StorageSetting's words it heeds, besides the precision: "ranks", "sh_degree"."""
    usual_ranks: tuple[int, int] | None = None
    """Density and colour components of a trained field; None: it has none that can be chosen."""
    reduces: frozenset[str] = frozenset()
    """Which of them `reduction` heeds."""
    taught_by_pictures = False
    """Whether a student of it learns more from a teacher's pictures than from its points."""
    on_vertices = False
    """Whether its fields have numbers for each vertex of a grid: as fine as others they take more bytes."""
    hashes = False
    """Whether its fields may have a hashed detail (`StorageSetting.hashed`)."""
    shared_part: str | None = None
    """What the names of those sections begin with, before a dot, that fields which are trained together may
    have in common (see `sharing`): a decoder. None: there are none."""
    warm_starts = False
    """Whether a student may start as the scene's background (`warm_start`)."""
    beside_background = True
    """Whether a field of it is learnt beside the background of a captured unbounded scene, which stays as it
    is."""
    precisions: tuple[str, ...] = ("int4", "int8")
    """That are tried where a quality is asked for, the cheapest first."""
    faithful = "float16"
    """The precision where only a size is given."""
    distilled = "float16"
    """The same of a student that learns from nothing: fewer bits leave room for more numbers."""

    # -- making ----------------------------------------------------------------------------------------------

    def sections(self, storage: StorageSetting, resolution: tuple[int, int, int]) -> Sequence[Section]:
        """The arrays of numbers that a field of a resolution (texels per axis) is stored with."""
        raise NotImplementedError

    def create(self, plan: Plan, generator: torch.Generator, name: str = "") -> StoredField:
        """An untrained field as planned, whose occupancy is full."""
        raise NotImplementedError

    def numbers(self, storage: StorageSetting, resolution: tuple[int, int, int]) -> int:
        """Floats of such a field in memory."""
        return sum(int(np.prod(section.shape)) for section in self.sections(storage, resolution))

    def plan(self, box: np.ndarray, finest: float, storage: StorageSetting, most: int) -> Plan:
        """The finest field over a box (6,) with voxels no finer than `finest` and at most so many numbers."""
        return self.plan_at(
            box, finest_within(box, finest, lambda r: self.numbers(storage, r), most), storage, most
        )

    def plan_at(
        self,
        box: np.ndarray,
        resolution: tuple[int, int, int],
        storage: StorageSetting,
        allowed: int | None = None,
    ) -> Plan:
        """A field over a box (6,) at a resolution."""
        numbers = self.numbers(storage, resolution)
        return Plan(
            storage,
            box,
            resolution,
            numbers,
            numbers if allowed is None else allowed,
            self.sections(storage, resolution),
        )

    def untrained(self, box: np.ndarray, longest: int, storage: StorageSetting) -> Plan:
        """What a field learnt from photos of a box (6,) is, with so many texels on the longest axis."""
        return self.plan_at(box, texels(box, longest), storage)

    def begun(
        self,
        box: np.ndarray,
        longest: int,
        coarse: int,
        storage: StorageSetting,
        generator: torch.Generator,
        name: str = "",
    ) -> StoredField:
        """An untrained field that is to learn from photos of a box (6,), first with `coarse` texels on the
        longest axis, in the end with `longest`."""
        whole = not self.field.over_texels
        field = self.create(self.untrained(box, longest if whole else coarse, storage), generator, name)
        return field.resampled(box, texels(box, coarse)) if whole else field

    def empty(
        self,
        teacher: RadianceField,
        storage: StorageSetting,
        most: int,
        generator: torch.Generator,
        name: str,
    ) -> StoredField:
        """An untrained student of at most so many numbers over a teacher's box, with the teacher's
        occupancy."""
        plan = self.plan(teacher.occupancy.aabb, teacher.voxel_size, storage, most)
        return self.create(plan, generator, name).with_occupancy(teacher.occupancy)

    def sharing(self, field: StoredField) -> StoredField:
        """A field whose `shared_part` is other fields' as well, and so learns no further."""
        raise NotImplementedError

    # -- standing for a scene --------------------------------------------------------------------------------

    def suits(self, scene: ComposedField, limit: int | None = None) -> Suitability:
        """Whether it can hold a scene, and how well; limit: in so many bytes, None: of any size."""
        return Suitability(0.0, f"a field of kind '{self.name}' learns whatever a scene shows")

    def builder(self, scene: ComposedField, request: BuildRequest) -> DistilledBuilder:
        """Its stand for a scene that it suits."""
        return DistilledBuilder(self, scene, request)

    def warm_start(
        self, background: Placed, plan: Plan, scene: ComposedField, generator: torch.Generator
    ) -> StoredField | None:
        """A student that starts as a placed field; None where that cannot be."""
        return None

    def grown(self, before: StoredField, plan: Plan) -> StoredField:
        """A field with what a smaller one has learnt, as planned."""
        return before.resampled(plan.box, plan.resolution)

    # -- making smaller --------------------------------------------------------------------------------------

    def outline(self, field: StoredField) -> StoredField:
        """A field without its numbers, as far as that goes: what `reduction` needs of it."""
        return field.with_params(field.params.new_zeros(0)) if isinstance(field, ComputedField) else field

    def reduction(self, outline: StoredField, voxel: float, storage: StorageSetting) -> Reduction:
        """The same field with texels no finer than `voxel`, in the field's coordinates, and at most the ranks
        and SH degree of a way; of a kind that has no such, the field as it is."""
        return Reduction(None, lambda field: field, True)

    # -- telling ---------------------------------------------------------------------------------------------

    def describe(self, field: StoredField) -> dict:
        """What a report says of a field's size and make."""
        return {"resolution": [int(n) for n in field.resolution]}

    def resolution_reports(self, scene: ComposedField, field: StoredField) -> list[ResolutionReport]:
        """What a field holds of the objects placed in a scene."""
        return resolution_at_voxel(scene.leaves(), field.voxel_size)

    def field_memory(
        self, metadata: dict, shapes: Mapping[str, tuple[int, ...]], array: Reads
    ) -> FieldMemory:
        """What a stored field of these metadata and shapes of arrays needs of memory; array(name) reads one
        of them. Raises what `from_state` does where they make no field."""
        return self.field.needs(metadata, shapes, array)

    def stored_occupancy(self, metadata: dict, arrays: Mapping[str, np.ndarray]) -> OccupancyGrid | None:
        """The occupancy grid of a stored field, of few of its arrays, which are decoded when they are asked
        for; None where only the field has it. Raises what `from_state` does where they make no field."""
        return self.field.stored_occupancy(metadata, arrays)

    def sweeps(self, least_psnr: float) -> dict[str, list[Sweep]]:
        """The ways to fuse that are worth charting, in groups that take about as long; those that learn least
        come first."""
        return {self.name: [by_sizes()]}

    # -- cutting ---------------------------------------------------------------------------------------------

    def cut_out(self, field: StoredField, selection: Selection) -> StoredField | None:
        """A selected object as a field in the frame of the field, with the numbers that it has there; None
        where there is nothing of it. The selection may be one in a scene that places the field
        (`Selection.seen_from`). Raises ValueError where the kind cannot be taken apart."""
        return field_cutting.cut_out(self.on_one_grid(field), field.box, selection)

    def cut_away(self, field: StoredField, selection: Selection) -> StoredField | None:
        """A field without a selected object, with its numbers: itself where it has nothing of it, None where
        nothing is left. Raises ValueError as `cut_out`."""
        return field_cutting.cut_away(self.on_one_grid(field), selection)

    def cropped(self, field: StoredField, holds: Holds) -> StoredField | None:
        """What of a field lies in cells that lie wholly where `holds` says so, with the numbers that it has,
        for those to be stored anew; None where there is nothing. Raises ValueError as `cut_out`."""
        return field_cutting.crop_of(self.on_one_grid(field), field.box, holds)

    def restricted(self, field: StoredField, holds: Holds) -> StoredField | None:
        """The whole field without those of its cells that do not lie wholly where `holds` says so; None where
        nothing is left. Raises ValueError as `cut_out`."""
        return field_cutting.restricted(self.on_one_grid(field), holds)

    def trimmed(self, field: StoredField) -> StoredField:
        """The same field without the numbers that none of its cells asks, where that makes its files
        smaller."""
        return field

    def thinned(self, field: StoredField) -> StoredField:
        """A field that has learnt most, without the numbers that say least, for those never to learn: what
        goes for good while the others make up for it."""
        return field

    def on_one_grid(self, field: StoredField) -> BoxField:
        """The field, which can be taken apart as it is; ValueError where it cannot."""
        if not isinstance(field, BoxField):
            raise ValueError(f"a field of kind '{self.name}' cannot be taken apart; convert it to kind 'vm'")
        return field
