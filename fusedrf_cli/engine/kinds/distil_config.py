"""How a student learns from a teacher."""

from dataclasses import dataclass, replace

from fusedrf_cli.engine.settings import current


@dataclass(frozen=True)
class DistilConfig:
    """How a student learns from a teacher: from points on rays, then from the pictures that the rays make."""

    rays: int = 800_000
    """Along which the teacher is asked for points."""
    steps: int = 800
    """From the points on those rays; 0 where the student knows already what they would teach it."""
    points_per_step: int = 1 << 15
    rate: float = 0.08
    """Of points: four times what pictures are learnt at, since points say at once where all is."""
    coarse_from: int | None = 64
    """Texels along a student's longest axis from which it starts at half of them; None: never."""
    coarse_until: float = 0.3
    """Share of the points' phase in which it is coarse: a step is cheaper then and reaches farther."""
    rgb_steps: int = 600
    """From the pictures that the rays make."""
    rgb_rays: int | None = None
    """That pictures are learnt from: those of the points, and, where they are fewer, others that are only
    rendered; None: those alone."""
    rgb_samples: int = 1 << 15
    """Samples per step that the number of rays is steered to."""
    rgb_rate: float = 0.003
    rays_at_first: int = 1024
    """Of a step."""
    opacity_weight: float = 0.1
    """Against the colour."""
    early_stop: float = 1e-3
    """Transmittance at which a ray ends."""
    time_budget: float | None = None
    """Seconds of learning. None: the steps decide, and equal seeds give equal bytes."""
    points_part: float = 0.75
    """Of that at most, where both phases have steps; pictures have the rest."""
    enough_steps: bool = False
    """Whether points end after their steps, whatever time there is."""
    asking: float = 1.0
    """Seconds, for each of learning, after which the teacher is asked no more; a first part it always is."""
    cooling: float = 0.4
    """Of a phase that is not cut short: the share at its end in which the rate falls."""
    rate_decay: float = 0.1
    """The last step's rate over the first's."""
    look_every: int = 100
    """Steps between two looks at what nothing is trained on."""
    patience: int = 3
    """Looks that the best one may be old, ..."""
    patient_share: float = 0.2
    """... and the share of the phase that it may be: at a rate that does not fall what is held out sways."""
    least_gain: float = 0.1
    """dB above the best so far that make a look a better one."""
    seed: int = 0
    views: int = 4
    view_size: int = 160
    """Pixels a side of the views it is judged on."""


@dataclass(frozen=True)
class PicturesConfig:
    """How a student learns otherwise that learns mostly from pictures (`Kind.taught_by_pictures`): points say
    where all is, but meet few of a fine level's numbers."""

    pictures: float = 3.0
    """Times as many rays as there are with points, and times as many steps from them."""
    rgb_rate: float = 0.02
    """That of photos."""


def mostly_pictures(lesson: DistilConfig) -> DistilConfig:
    """A lesson with more pictures, which have all the time after the steps from points."""
    own = current(PicturesConfig)
    return replace(
        lesson,
        enough_steps=True,
        rgb_rays=round(own.pictures * lesson.rays),
        rgb_steps=round(own.pictures * lesson.rgb_steps),
        rgb_rate=own.rgb_rate,
    )
