"""How a field is fitted to pictures: what a fit is asked for, and the numbers that its method rests on."""

from dataclasses import dataclass

from fusedrf_cli.engine.kinds import registry
from fusedrf_cli.engine.kinds.builder import StorageSetting

Stages = tuple[tuple[float, float], ...]
"""(share of the run, share of the final voxels per axis from then on)."""


@dataclass(frozen=True)
class TrainConfig:
    """Lengths are in units of the field's frame; shares are of the run unless something else is said."""

    # what is asked for

    kind: str = registry.DEFAULT
    """Of the field."""
    storage: StorageSetting = StorageSetting()
    """Its ranks and SH degree."""
    longest: int = 256
    """Texels on the longest axis at the end."""
    steps: int = 3000
    samples: int = 1 << 16
    """Samples per step that the number of rays is steered to."""
    time_budget: float | None = None
    """Seconds; when given, the schedule follows the clock and `steps` is not used."""
    opacity_weight: float = 0.1
    """Weight of the captured alpha against the colour; 0 for opaque photos."""
    near: float = 0.0
    """Distance from a camera before which nothing is learnt."""
    unbounded: bool = False
    """Whether the field fills all of space, seen in pictures without alpha."""
    exposure: bool = False
    """Whether pictures may differ in exposure and white balance, as a camera's own do. Not for views of an
    object from all around: of a side that few of them see nothing tells how bright it is."""
    smooth: bool = False
    """Whether planes are kept smooth (tv_loss.py): photos of the real world contradict each other by more
    than a field of theirs should follow; rendered pictures do not, and lose by it."""
    poses: bool = False
    """Whether to look for where the pictures were taken from, near where they are said to have been."""
    target_psnr: float | None = None
    """dB of the training rays, less a margin, at which the fit may stop early."""
    seed: int = 0
    device: str = "cpu"
    """Where the field is trained, "cpu" or "cuda"."""

    # the optimiser

    rate: float = 0.02
    unbounded_momentum: float = 0.0
    """Adam's β1 in unbounded space. A step meets few of its numbers, and where a number was last moved to is
    out of date by then: with TensoRF's 0.9 a park shows 0.2 dB less after as many steps, ferns 0.4, a room
    0.6. Without it a step takes less time and memory, too. Objects end the same, but bear a wrong rate less
    well."""
    fall: float = 0.1
    """The last step's share of the rate."""
    falls_from: float = 0.7
    """From where the rate falls: until then large steps learn most, at the end what single rays say of a
    texel evens out. A rate that falls from the first step on shows 0.7 dB less of a chair after 4,000 steps,
    and 0.25 dB less of a park after three minutes."""
    fade: float = 1.4e-4
    """What a step takes away of numbers that fade, at the first rate: this over the square of the photos'
    pixels for each such number. Few photos do not say enough of a hash grid, which learns by heart then: a
    fox's 43 photos (0.44 pixels for each number) were shown 3.2 dB better than photos held out, and 2.5 to
    3.0 dB with it, which lost nothing. Of a park's 84 larger ones (1.75) 0.23 dB would be lost by as much."""
    most_faded: float = 9e-4
    """Of that, at most."""
    faded_each: int = 16
    """Steps, each for all of them: going through the numbers takes as long as a small step."""

    # rays and samples

    early_stop: float = 1e-3
    """Transmittance at which a ray ends in a box."""
    unbounded_early_stop: float = 1e-2
    """The same in unbounded space. Behind what rays meet first there is more to sample there; by as many
    samples of other rays a park of 1,600 steps shows 0.17 dB more held out, ferns 0.09, and no scene less."""
    light: float = 1 / 25
    """Weight under which a sample's gradient is followed back by chance (kernels/learning.py), once there is
    more than low density. A pass over an unbounded scene takes three quarters of the time and half as many
    numbers change: a park shows 0.15 dB more in the time; with 1/5 it loses as much."""
    distortion: float = 0.012
    """Weight of that loss in unbounded space; in a box surfaces come out sharp without it."""
    settled: float = 0.25
    """After which a scene has taken shape."""
    early_near: float = 5.0
    """Times the near distance of such a scene, at first."""
    least_rays: int = 512
    """Of a step."""
    most_per_sample: int = 2
    """Rays of a step for each sample it is to take, at most. Where few meet anything there would be ever more
    of them."""
    unbounded_samples: float = 2.5
    """Times those of a step in a box, for longer rays; with twice that a fox shows less."""
    fine_samples: int = 2
    """Times as many in a box at full resolution: what a step evens out counts for more then, and looking
    through all gradients, which any step does, takes two fifths of the time of small ones. An unbounded scene
    learns less by it."""

    # resolution

    resolution_stages: Stages = ((0.0, 0.22), (0.05, 0.36), (0.12, 0.5), (0.22, 0.7), (0.36, 1.0))
    """In a box."""
    unbounded_stages: Stages = ((0.0, 0.05), (0.06, 0.1), (0.12, 0.2), (0.2, 0.4), (0.35, 0.7), (0.5, 1.0))
    """Photos of an unbounded scene say little of how far away things are, and fine voxels would explain each
    photo by itself: a start at a twentieth of the texels, not at a fifth, gained 3 dB held out."""
    detail_stages: Stages = ((0.0, 0.05), (0.04, 0.1), (0.08, 0.2), (0.14, 0.4), (0.25, 0.7), (0.35, 1.0))
    """With a hash grid, which only learns beside fine texels: in 0.7 of those times. After ten minutes a park
    shows 0.11 dB more by it; in half of them, 0.08."""

    # occupancy

    occupancy_at: tuple[float, ...] = (0.03, 0.06, 0.13, 0.24, 0.38, 0.6)
    """After which the occupancy is built anew."""
    steps_to_show: int = 100
    """After which a field shows where things are. What is cut off before is lost: of a chair whose cells were
    looked for after 30 steps a corner was missing in every third run, and 0.9 dB in all."""
    calm_after: int = 8
    """Steps of an optimiser that begins anew, whose first move every number by the whole rate, before what
    the numbers say of empty cells is believed: of a ball half was cut off three steps after a change of
    resolution."""
    retry_after: float = 0.03
    """After which an occupancy that found nothing is tried again."""
    weighed_rays: int = 1 << 17
    """By which it is found what photos show."""
    shown_from: float = 0.005
    """Weight on a ray from which a cell of unbounded space counts as shown. With 0.01 there are fewer cells
    to sample: the park gains 0.1 dB, the cup 0.05, but the fox's room loses 0.3."""
    prune_low_density_from: float = 0.5
    """From which no more density is to come into cells of floaters."""
    shrink_below: float = 0.9
    """Share of the box's volume that its occupied part must fall under for the box to be cut down: floaters
    that were over the chair for a third of a run made a box a sixth too long, and with it all texels."""
    target_margin: float = 1.0
    """dB that training rays are ahead of unseen views, about."""

    @property
    def stages(self) -> Stages:
        """The resolutions of the run."""
        if self.storage.hashed:
            return self.detail_stages
        return self.unbounded_stages if self.unbounded else self.resolution_stages

    def decay(self, share: float) -> float:
        """The rate after a share of the run, as a share of the first."""
        return self.fall ** (max(0.0, share - self.falls_from) / (1 - self.falls_from))
