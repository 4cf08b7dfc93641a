"""The `assembled` kind: fields of any encodings and decoders, as other systems' files are made of."""

from fusedrf_cli.engine.kinds.assembled.field import PartsField
from fusedrf_cli.engine.kinds.imported_kind import ImportedKind


class AssembledKind(ImportedKind):
    """See Kind."""

    name = "assembled"
    good_for = "What `fusedrf import` makes of other systems' files: their own numbers, nothing learnt."
    field = PartsField

    def describe(self, field: PartsField) -> dict:
        """See Kind."""
        return {"parts": {slot: entry["part"] for slot, entry in field.shape.entries.items()}}


KIND = AssembledKind()
