"""Kinds that other systems' files become."""

from fusedrf_cli.engine.composition.composed import ComposedField
from fusedrf_cli.engine.kinds.builder import Suitability
from fusedrf_cli.engine.kinds.kind import Kind
from fusedrf_cli.engine.kinds.sweeps import Sweep


class ImportedKind(Kind):
    """A kind of registry.IMPORTED, as which nothing is learnt."""

    trains = False

    def suits(self, scene: ComposedField, limit: int | None = None) -> Suitability:
        """See Kind."""
        return Suitability(None, f"fields of kind '{self.name}' are imported, and nothing is fused to them")

    def sweeps(self, least_psnr: float) -> dict[str, list[Sweep]]:
        """See Kind."""
        return {}
