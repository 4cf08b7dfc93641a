"""The `hash` kind: Instant-NGP's hash grid."""

import math

import torch

from fusedrf_cli.engine.encodings.hash_grid import FINER
from fusedrf_cli.engine.kinds.box_kind import BoxKind
from fusedrf_cli.engine.kinds.builder import Plan, StorageSetting
from fusedrf_cli.engine.kinds.hash.field import BASE, HashField, HashShape

MOST_ROWS = 19  # log2, of a level: a step looks through the gradients of all


class HashKind(BoxKind):
    """See Kind."""

    name = "hash"
    good_for = "Surroundings and objects of fine detail, as Instant-NGP holds them."
    field = HashField

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


KIND = HashKind()
