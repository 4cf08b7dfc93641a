"""What `train` is asked, with its defaults (requests.py)."""

from dataclasses import KW_ONLY, dataclass
from typing import Annotated, Literal

from msgspec import Meta

from fusedrf_cli.errors import UsageProblem
from fusedrf_cli.request_parts import Box, Learning, Positive, Sizing, Vector, Writing


@dataclass(frozen=True)
class TrainRequest(Writing, Learning, Sizing):
    """Photos or a mesh to one field, or several of them to a field each, whose decoder is one."""

    source: str | tuple[str, ...]
    output: str
    _: KW_ONLY
    kind: str | None = None
    """None: hash of surroundings that learn for two minutes or more, else vm, or of fields that share a
    decoder dense-mlp."""
    shared_decoder: bool = False
    quality: Literal["draft", "normal", "high", "best"] | None = None
    """None: as the time budget allows."""
    holdout: Annotated[int, Meta(ge=2)] | None = None
    """Every so many-th photo is kept to measure with."""
    views: Annotated[int, Meta(ge=2, le=1000)] = 100
    """Of a mesh."""
    size: Annotated[int, Meta(ge=16, le=4096)] = 400
    """Pixels a side of them."""
    aabb: Box | None = None
    unbounded: bool | None = None
    """Whether the field is to fill all of space; None: as the capture needs."""
    centre: Vector | None = None
    radius: Positive | None = None
    """Of the core of unbounded space, whose detail is finest."""
    downscale: Annotated[int, Meta(ge=1, le=64)] | None = None
    """How many times smaller a side of photos is made; None: until it is no longer than photos need be."""
    masks: Literal["ignore", "alpha"] = "ignore"
    """Whether the pixels that masks exclude are left out, or learnt as transparent."""
    refine_poses: bool = False
    """Whether to look for where the photos were taken from, near where they are said to have been."""
    resume: bool = False

    def __post_init__(self):
        sources = self.sources
        if len(sources) == 1:
            object.__setattr__(self, "source", sources[0])
            if self.shared_decoder:
                raise UsageProblem("--shared-decoder is of several sources; give another, or leave it out")
            return
        if not self.shared_decoder:
            raise UsageProblem(
                f"{len(sources)} sources become fields of one bundle only with --shared-decoder; give it, or "
                "train them one by one"
            )
        own = {"--aabb": self.aabb, "--centre": self.centre, "--radius": self.radius}
        if wrong := [option for option, value in own.items() if value is not None]:
            raise UsageProblem(f"{wrong[0]} is of one capture's world, and {len(sources)} are given")

    @property
    def sources(self) -> tuple[str, ...]:
        """One or several."""
        return self.source if isinstance(self.source, tuple) else (self.source,)
