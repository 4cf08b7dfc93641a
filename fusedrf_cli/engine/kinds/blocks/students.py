"""Blocks as a student: the sources' tensors as they are where they fit, else with fewer texels, components or
SH bands; what that costs is learnt again from rays."""

from collections.abc import Sequence
from itertools import product

from fusedrf_cli.engine.composition.composed import ComposedField
from fusedrf_cli.engine.composition.detail import Detail
from fusedrf_cli.engine.fields.streamed import opened
from fusedrf_cli.engine.kinds.kind import Kind
from fusedrf_cli.engine.kinds.ladders import Ladder, Rung, shrinking
from fusedrf_cli.engine.kinds.student import Made, MadeStudent, Needs, StudentRequest, Suits, Way
from fusedrf_cli.engine.kinds.vm import KIND as VM
from fusedrf_cli.engine.kinds.vm.blocks import blocks_of
from fusedrf_cli.engine.kinds.vm.details import block_details
from fusedrf_cli.engine.kinds.vm.field import VMField, VMShape, VMTensor
from fusedrf_cli.engine.kinds.vm.students import contents_of
from fusedrf_cli.engine.kinds.vm.trimming import without_unread

# Fewer density components cost least and fewer colour components most (docs/how-fusing-works.md).
RANKS = ((8, 16), (8, 24), None)
UNREDUCED = VMShape(1024, 1024, 3)
FLOAT = 4
RESAMPLING = 2.5  # copies of a source while it becomes a block: widened, by itself, at its new resolution
TRUNCATING = RESAMPLING + 6  # and while its ranks are truncated: sections in float64 before and after
LADDER_RANKS = (None, (8, 24), (8, 16))
LADDER_PRECISIONS = ("int8", "float16", "int4")
LADDER_FINISHED = ("int8", "int4")  # what was finished at 16 bits is surpassed by twice the numbers at 8


class BlocksKind(Kind):
    """Tensors in their objects' own axes."""

    name = "blocks"
    good_for = (
        "Scenes of any fields: they stay nodes with their own numbers, vm ones by 'max' smaller where asked."
    )
    trains = False
    takes = frozenset({"ranks", "sh_degree"})
    precisions = ("int4", "int8", "float16")

    def suits(self, scene: ComposedField) -> Suits:
        """Nothing is nearer to a scene of vm fields, in far less time (DESIGN)."""
        if scene.rule != "max" or any(p.field.kind != VM.name or not p.as_it_is for p in scene.placed):
            return Suits(None, f"{self.name} need {VM.name} sources as they are and 'max' composition")
        return Suits(
            2.0, f"all sources are {VM.name} fields and the densest shows, so that each keeps its own axes"
        )

    def student(self, scene: ComposedField, request: StudentRequest) -> "BlocksStudent":
        """Blocks of a scene."""
        return BlocksStudent(self, scene, request)

    def describe(self, field: VMField) -> dict:
        """Texels per axis of every tensor, ranks and SH degree."""
        return VM.describe(field) | {"resolution": [list(t.resolution) for t in field.tensors]}

    def details(self, scene: ComposedField, field: VMField) -> list[Detail]:
        """Block by block; a stretch of density is kept."""
        return block_details(scene.placed, field)

    def ladders(self, least_psnr: float) -> dict[str, list[Ladder]]:
        """What is only compiled, and what is finished."""
        plain = [Rung(p, r, rgb=False) for r, p in product(LADDER_RANKS, LADDER_PRECISIONS)]
        finished = [Rung(p, r) for r, p in product(LADDER_RANKS, LADDER_FINISHED)]
        groups = {self.name: plain, f"{self.name}, finished": finished}
        return {name: [shrinking(rung, least_psnr) for rung in rungs] for name, rungs in groups.items()}


class BlocksStudent(MadeStudent):
    """Blocks over the tensors of a scene's sources."""

    lesson = None
    gain = 5.0  # dB, the most that was seen

    def __init__(self, kind: BlocksKind, scene: ComposedField, request: StudentRequest):
        super().__init__(kind, scene, request)
        # once, since a source that memory does not hold is read again whenever it is opened
        self.blocks = sum(len(opened(p.field).blocks) for p in scene.placed)

    def ways(self) -> list[list[Way]]:
        """By precision, and ranks."""
        request = self.request
        precisions = (request.precision,) if request.precision else self.kind.precisions
        ranks = (request.ranks,) if request.ranks else RANKS
        return [[Way(p, r, request.sh_degree) for r in ranks] for p in precisions]

    def made(self, way: Way, limit: int) -> Made | None:
        """The sources' tensors, resampled and truncated as far as the limit and the way need it."""
        field, size, whole = self.joined(way, limit)
        return Made(field, size, whole, whole and way.ranks is None) if size <= limit else None

    def joined(self, way: Way, limit: int) -> tuple[VMField, int, bool]:
        """Blocks, the bytes of the file, and whether they keep their own resolution."""
        sizes = []

        def fits(shape: VMShape, tensors: list[VMTensor]) -> bool:
            sizes.append(self.bytes_for(shape, tensors, way))
            return sizes[-1] <= limit

        field = blocks_of(self.scene.placed, fits, shape_within(way))
        whole = sizes[0] <= limit  # the first that is asked is their own resolution
        as_they_are = whole and way == Way(self.kind.faithful)
        return field if as_they_are else without_unread(field), self.bytes_of(field, way), whole

    def bytes_for(self, shape: VMShape, tensors: Sequence[VMTensor], way: Way) -> int:
        """At most so many bytes of the file with blocks over such tensors."""
        contents = contents_of(shape, tensors, self.blocks)
        return self.request.overhead + self.request.sizes.of(contents, way.precision)

    def bytes_of(self, field: VMField, way: Way) -> int:
        """At most so many bytes of the file."""
        return self.bytes_for(field.shape, field.tensors, way)

    def smallest(self) -> int:
        """Bytes of the file with the coarsest blocks."""
        return min(self.joined(way, 1)[1] for group in self.ways() for way in group)

    def why(self, field: VMField) -> str:
        """How many blocks over how many fields."""
        own = len({id(p.field) for p in self.scene.placed})
        return f"{len(field.blocks)} blocks over {own} fields, each in its object's own axes"

    def needs(self) -> Needs:
        """The sources' numbers as far as the limit lets them."""
        request, per_number = self.request, self.request.sizes.per_number
        own = sum(request.source_bytes) // FLOAT
        faithful = request.precision or self.kind.faithful
        chosen = request.target is not None or own * per_number(faithful) > request.limit
        cheapest = request.precision or (self.kind.precisions[0] if chosen else faithful)
        numbers = min(own, int(request.limit / per_number(cheapest)))
        return Needs(numbers, TRUNCATING if chosen else RESAMPLING)


def shape_within(way: Way) -> VMShape | None:
    """The most ranks and bands that a way keeps, None for all."""
    if way.ranks is None and way.sh_degree is None:
        return None
    ranks = way.ranks or (UNREDUCED.density_rank, UNREDUCED.colour_rank)
    return VMShape(*ranks, UNREDUCED.sh_degree if way.sh_degree is None else way.sh_degree)
