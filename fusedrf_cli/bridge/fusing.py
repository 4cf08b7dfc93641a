"""What fusing is asked for, whatever the kind, and what it gives back."""

from dataclasses import dataclass

from fusedrf_cli.bridge.memory import READING, Memory, sources
from fusedrf_cli.bridge.scene import LoadedScene
from fusedrf_cli.engine.composition.detail import ENOUGH_VOXELS, LOST_NOTED, Detail

CONDITION_NOTED = 1.01  # a stretch beyond this shows in a translucent medium (by 1/255 of its opacity)


@dataclass(frozen=True)
class Asked:
    """What a person fixed of how a scene is stored; None is left to choose."""

    limit: int
    """Bytes of the file."""
    overhead: int
    """Bytes of the file besides the field."""
    target: float | None
    """PSNR in dB."""
    precision: str | None
    ranks: tuple[int, int] | None
    """Components per mode of density and of colour at most."""
    sh_degree: int | None
    rgb: bool
    """Whether to finish on rendered rays."""
    seed: int
    time_budget: float | None = None
    """Seconds after which nothing more is learnt."""


@dataclass(frozen=True)
class Fused:
    """A field, and how to store and report it."""

    field: object
    precision: str
    figures: dict
    """For the report; psnr.stored is that of the field as it will be read back."""
    details: list[Detail]
    remedy: str
    """What helps an object that is held too coarsely."""


def make_room(budget: Memory, loaded: LoadedScene, *stages: tuple[float, dict[str, float]]) -> None:
    """Keep no more sources in memory than fit beside what every stage needs, which is so many copies of the
    largest one and other things; ResourceProblem where not even one does.
    """
    sizes, shelf = loaded.sizes, loaded.shelf
    room = min(budget.room(needed) - copies * max(sizes) for copies, needed in stages)
    if room < sum(sizes):  # then one is read now and then in every stage
        stages = tuple((max(copies, READING), needed) for copies, needed in stages)
        room = min(budget.room(needed) - copies * max(sizes) for copies, needed in stages)
    shelf.resize(room)
    budget.expect(
        *(sources(sizes, shelf.room, copies) | needed for copies, needed in stages),
        advice="give a smaller --max-size",
    )


def warn_of_detail(details: list[Detail], remedy: str, progress) -> None:
    """Say which objects a fused field will not hold as they are: stretched translucent ones, those it has too
    few voxels for, and those that share their cells with more than two."""
    for d in details:
        if d.opacity_off and d.stretch > CONDITION_NOTED:
            progress.warn(
                f"'{d.name}' is stretched by {d.stretch:.2f}: where it is translucent its "
                f"opacity may be off by up to {d.opacity_off:.3f}"
            )
        if d.voxels_across < ENOUGH_VOXELS:
            progress.warn(f"'{d.name}' is only {d.voxels_across:.2g} voxels across; use {remedy}")
        if d.lost > LOST_NOTED:
            progress.warn(
                f"{d.lost:.0%} of '{d.name}' is not shown, since more than two objects meet there in one "
                "cell of a grid over the whole scene; render the scene as it is, or fuse its parts apart"
            )
    coarse = [d for d in details if d.held_voxel > d.own_voxel * (1 + 1e-6)]
    if coarse:
        worst = max(coarse, key=lambda d: d.held_voxel / d.own_voxel)
        progress.warn(
            f"{len(coarse)} of {len(details)} objects are held at coarser voxels than their own, "
            f"'{worst.name}' at {worst.held_voxel / worst.own_voxel:.1f} times; use {remedy}"
        )
