"""The `dense-mlp` kind: a grid of vertices with features, and a small decoder of colours."""

from dataclasses import replace

from fusedrf_cli.engine import spaces
from fusedrf_cli.engine.composition.composed import ComposedField
from fusedrf_cli.engine.kinds.box_kind import BoxKind, GridBuilder
from fusedrf_cli.engine.kinds.builder import BuildRequest, Candidate, DistilledBuilder, StorageSetting
from fusedrf_cli.engine.kinds.dense_mlp.decoder_fit import fit_decoder
from fusedrf_cli.engine.kinds.dense_mlp.field import DenseMLPField
from fusedrf_cli.engine.kinds.distil_config import DistilConfig
from fusedrf_cli.engine.kinds.resampled import ResampledBuilder


class DenseMLPKind(BoxKind):
    """See Kind."""

    name = "dense-mlp"
    good_for = "A grid with a small decoder, which captures may share; alone dense shows as much, and faster."
    field = DenseMLPField
    shared_part = "decoder"

    def builder(self, scene: ComposedField, request: BuildRequest) -> DistilledBuilder:
        """See Kind; in unbounded space it learns."""
        bounded = scene.occupancy.space is spaces.bounded
        return (HarmonicBuilder if bounded else GridBuilder)(self, scene, request)

    def sharing(self, field: DenseMLPField) -> DenseMLPField:
        """See Kind."""
        shape = replace(field.shape, shared=True)
        same = field.box, field.resolution, field.scale, field.shift, field.params, field.occupancy
        return DenseMLPField(shape, *same)


class HarmonicBuilder(ResampledBuilder):
    """A field whose features begin as coefficients of spherical harmonics, of which a decoder learns what
    they stand for."""

    distil_config = DistilConfig(rays=400_000, steps=0, rgb_steps=1000, rgb_rate=0.002)

    def build(self, storage: StorageSetting, limit: int) -> Candidate | None:
        """See `DirectBuilder`."""
        candidate = super().build(storage, limit)
        if candidate is None:
            return None
        fit_decoder(candidate.field, self.scene)
        return replace(candidate, bytes=self.bytes_of(candidate.field, storage))


KIND = DenseMLPKind()
