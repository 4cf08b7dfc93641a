"""The `hash` kind: Instant-NGP's hash grid."""

import math

import torch

from fusedrf_cli.engine.encodings.hash_grid import FINER
from fusedrf_cli.engine.fields.cell_bits import packed_bits
from fusedrf_cli.engine.fields.stored_rows import StoredRows
from fusedrf_cli.engine.kinds.box_kind import BoxKind
from fusedrf_cli.engine.kinds.builder import Contents, Plan, Section, StorageSetting, numbers_in
from fusedrf_cli.engine.kinds.hash.field import BASE, ROWS, HashConfig, HashField, HashShape
from fusedrf_cli.engine.kinds.hash.trimming import rows_used, with_fewer_rows, without_unasked
from fusedrf_cli.engine.kinds.reduction import Reduction
from fusedrf_cli.engine.settings import current

MOST_ROWS = 19  # log2, of a level: a step looks through the gradients of all


class HashKind(BoxKind):
    """See Kind."""

    name = "hash"
    good_for = "Surroundings of fine detail, as Instant-NGP holds them; of objects vm shows more in fewer MB."
    field = HashField
    taught_by_pictures = True

    def shape_at(self, storage: StorageSetting, resolution: tuple[int, int, int]) -> object:
        """See BoxKind: levels up to FINER vertices on a texel, of at most four times the rows that a plane of
        texels has."""
        longest = max(resolution)
        log2_rows = min(round(2 * math.log2(longest)) + 2, MOST_ROWS)
        return HashShape(finest=max(FINER * longest, BASE), log2_rows=log2_rows)

    def grown(self, before: HashField, plan: Plan) -> HashField:
        """See Kind: rows of other levels begin anew, the weights that read them go on."""
        field = self.create(plan, torch.Generator().manual_seed(0), before.name)
        old, new = before.sections(), field.sections()
        for name in new.keys() - {"density_rows"}:
            new[name].copy_(old[name])
        return field.with_occupancy(before.occupancy)

    def outline(self, field: HashField) -> HashField:
        """See Kind: it knows which rows are other than 0."""
        outline = super().outline(field)
        outline.told = StoredRows.other_than_0(field.sections()[ROWS].detach().cpu().numpy())
        return outline

    def reduction(self, outline: HashField, voxel: float, storage: StorageSetting) -> Reduction:
        """See Kind: with fewer rows, those of the largest numbers: half as many for texels four times as
        wide."""
        held, own = outline.told.first(rows_used(outline)), outline.voxel_size
        if voxel <= own or not outline.shape.lines_are_runs:
            return Reduction(contents_of(outline, held), lambda field: field, True)
        few = held.spread(int(held.count * math.sqrt(own / voxel)))
        return Reduction(contents_of(outline, few), lambda field: with_fewer_rows(field, few.count), False)

    def trimmed(self, field: HashField) -> HashField:
        """See hash/trimming.py."""
        return without_unasked(field)

    def thinned(self, field: HashField) -> HashField:
        """See Kind: with a share of the rows (`HashConfig.kept`)."""
        kept = int(current(HashConfig).kept * rows_used(field))
        return with_fewer_rows(field, kept) if field.shape.lines_are_runs else field

    def describe(self, field: HashField) -> dict:
        """Texels per axis, levels that they leave in, and rows that a file holds."""
        levels, held = field.used_levels, field.held
        rows = held.count if held else sum(level["rows"] for level in field.shape.grids)
        return super().describe(field) | {"levels": len(levels), "rows": rows}


def contents_of(field: HashField, held: StoredRows) -> Contents:
    """What a field of those rows alone is stored with."""
    sections = [Section(part.name, field.stored_shape(part)) for part in field.parts]
    bits = field.occupancy.stored_bits(numbers_in(sections))
    if held.saves(field.shape.features):
        bits = 8 * sum(array.nbytes for array in packed_bits("", field.occupancy.occupied, 0).values())
        bits += held.told(field.shape.features)
        few = held.count, field.shape.features
        sections = [Section(s.name, few) if s.name == ROWS else s for s in sections]
    return Contents(sections, bits)


KIND = HashKind()
