"""A decoder of colours that learns, alone, what a scene shows where features of it are known."""

from dataclasses import dataclass

import torch

from fusedrf_cli.engine.composition.composed import ComposedField
from fusedrf_cli.engine.decoders import activations
from fusedrf_cli.engine.distillation.losses import mostly_seen
from fusedrf_cli.engine.distillation.sampler import RaySampler
from fusedrf_cli.engine.distillation.teacher import TeacherPoints, query_teacher
from fusedrf_cli.engine.fields.assembled import AssembledField
from fusedrf_cli.engine.fields.base import sampling_step
from fusedrf_cli.engine.kernels.reference import exact
from fusedrf_cli.engine.settings import current


@dataclass(frozen=True)
class DecoderFitConfig:
    """How a decoder is fitted."""

    rays: int = 1 << 14
    seed: int = 7
    steps: int = 400
    points: int = 1 << 12
    """Of a step."""
    rate: float = 0.01
    decay: float = 0.1
    """The last step's rate over the first's."""
    least: float = 1e-3
    """Of what a point counts that is looked at."""


def fit_decoder(field: AssembledField, scene: ComposedField) -> None:
    """Teach a field's decoder the colours at points of random rays through a scene, in whose frame the field
    lies: Adam on squared errors, by what is seen of a point."""
    config = current(DecoderFitConfig)
    generator = torch.Generator().manual_seed(config.seed)
    rays = RaySampler([scene.occupancy.look_at_box]).draw(config.rays, generator)
    points = query_teacher(scene, *rays, sampling_step(field), generator).points
    counts = mostly_seen(points.transmittance) * (1 - torch.exp(-points.sigma * sampling_step(field)))
    shown = torch.nonzero(counts > config.least)[:, 0]
    decoder = field.slot_sections()["rgb"]
    learnt = {name: part.clone().requires_grad_() for name, part in decoder.items()}
    optimiser = torch.optim.Adam(learnt.values(), lr=config.rate)
    falling = torch.optim.lr_scheduler.ExponentialLR(optimiser, config.decay ** (1 / config.steps))
    for _ in range(config.steps if len(shown) else 0):
        chosen = shown[torch.randint(len(shown), (config.points,), generator=generator)]
        some = TeacherPoints(*(column[chosen] for column in points.columns()))
        with torch.enable_grad():
            off = colours_of(field, learnt, some) - some.rgb
            loss = (counts[chosen, None] * off**2).sum() / counts[chosen].sum()
            optimiser.zero_grad()
            loss.backward()
        optimiser.step()
        falling.step()
    for name, part in learnt.items():
        decoder[name].copy_(part.detach())


def colours_of(
    field: AssembledField, decoder: dict[str, torch.Tensor], points: TeacherPoints
) -> torch.Tensor:
    """(N, 3) colours of a field with another decoder's numbers at points."""
    colour, rgb = field.slots["colour"], field.slots["rgb"]
    low, sides = (exact(part, points.where.device) for part in field.cube)
    unit = ((points.where - low) / sides).to(field.params.dtype)
    sections = field.slot_sections()["colour"]
    features = colour.module.reference(field, sections, unit, None, **colour.options)
    logits = rgb.module.reference(field, decoder, features, points.dirs.double(), **rgb.options)
    return activations.colour_reference(field.colour_activation, logits)
