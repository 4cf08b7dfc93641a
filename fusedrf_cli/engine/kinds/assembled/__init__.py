"""The `assembled` kind: fields of any encodings and decoders, as other systems' files are made of."""

from fusedrf_cli.engine.composition.composed import ComposedField
from fusedrf_cli.engine.kinds.assembled.field import PartsField
from fusedrf_cli.engine.kinds.builder import Suitability
from fusedrf_cli.engine.kinds.kind import Kind
from fusedrf_cli.engine.kinds.sweeps import Sweep


class AssembledKind(Kind):
    """See Kind."""

    name = "assembled"
    good_for = "What `fusedrf import` makes of other systems' files: their own numbers, nothing learnt."
    field = PartsField
    trains = False

    def suits(self, scene: ComposedField) -> Suitability:
        """See Kind."""
        return Suitability(None, f"fields of kind '{self.name}' are imported, and nothing is fused to them")

    def sweeps(self, least_psnr: float) -> dict[str, list[Sweep]]:
        """See Kind."""
        return {}

    def describe(self, field: PartsField) -> dict:
        """See Kind."""
        return {"parts": {slot: entry["part"] for slot, entry in field.shape.entries.items()}}


KIND = AssembledKind()
