"""The `dense-mlp` field: a grid of vertices with density and features, and a small decoder of colours, its
own or one that it shares with other fields (Control-NeRF, Lazova et al., WACV 2023)."""

from dataclasses import dataclass, replace

import torch

from fusedrf_cli.engine.fields.box import Part, largest
from fusedrf_cli.engine.kinds.dense.field import DenseField
from fusedrf_cli.engine.kinds.dense_mlp import bodies, reference

DECODER_RATE = 0.05  # 1e-3 where features learn at 2e-2, as other networks of the kind
FEATURE_SPREAD = 0.1  # features that were all alike would never come apart


@dataclass(frozen=True)
class DenseMLPShape:
    """What a vertex holds, and how wide the decoder is."""

    width: int = 16
    """Features of a vertex."""
    hidden: int = 32
    """Numbers between the decoder's layers."""
    shared: bool = False
    """Whether the decoder is other fields' as well, and so learns no further."""

    def __post_init__(self):
        """Refuse what the kernels were not written for: runs of eight numbers."""
        for name, most in (("width", 64), ("hidden", 128)):
            count = getattr(self, name)
            if type(count) is not int or not 8 <= count <= most or count % 8:
                raise ValueError(f"'{name}' should be a multiple of 8 up to {most}, found {count}")

    @property
    def numbers(self) -> int:
        """Numbers of a vertex besides its density."""
        return self.width


class DenseMLPField(DenseField):
    """Vertices of a grid over one box, and a decoder."""

    kind = "dense-mlp"
    bodies = bodies
    shape_type = DenseMLPShape

    @classmethod
    def parts_of(cls, shape: DenseMLPShape, resolution: tuple[int, int, int]) -> list[Part]:
        """See BoxField."""
        inputs, rate = shape.width + bodies.HARMONICS, 0.0 if shape.shared else DECODER_RATE
        density, rows = super().parts_of(shape, resolution)
        return [
            density,
            replace(rows, spread=FEATURE_SPREAD),
            Part("decoder.hidden.weight", (inputs, shape.hidden), rate=rate, spread=(2 / inputs) ** 0.5),
            Part("decoder.hidden.bias", (shape.hidden,), rate=rate),
            Part("decoder.out.weight", (shape.hidden, bodies.OUTPUTS), rate=rate, spread=shape.hidden**-0.5),
            Part("decoder.out.bias", (bodies.OUTPUTS,), rate=rate),
        ]

    def kernel_arrays(self, params: object) -> bodies.Arrays:
        """See ComputedField."""
        return bodies.Arrays(*super().kernel_arrays(params), *map(int, self.starts[[2, 4]]))

    def reference(self, params: torch.Tensor, points: torch.Tensor, dirs: torch.Tensor):
        """See reference.py."""
        return reference.query(self, params, points, dirs)

    def sharing(self, other: "DenseMLPField") -> "DenseMLPField":
        """This field with another one's decoder, which learns no further. Raises ValueError where it does not
        fit."""
        if (other.shape.width, other.shape.hidden) != (self.shape.width, self.shape.hidden):
            raise ValueError(
                f"its decoder takes {other.shape.width} features through {other.shape.hidden} numbers, "
                f"expected {self.shape.width} through {self.shape.hidden}"
            )
        shape = replace(self.shape, shared=True)
        new = type(self)(
            shape, self.box, self.resolution, self.scale, self.shift, self.params.clone(), self.occupancy
        )
        new.params[int(self.starts[2]) :] = other.params[int(other.starts[2]) :]
        return new

    def state(self):
        """See BoxField; the decoder is a part that fields may have in common."""
        arrays, metadata = super().state()
        return arrays, metadata | {"shared": ["decoder"]}

    def check_answers(self) -> None:
        """See BoxField."""
        sections = self.sections()
        self.check_density(float(largest(sections["density"])))
        most = max(float(largest(sections["colour"])), 1.0)
        for layer in ("hidden", "out"):
            weight, bias = (sections[f"decoder.{layer}.{part}"].abs().double() for part in ("weight", "bias"))
            most = float((weight.sum(0) * most + bias).amax())
        self.check_logit(most)
