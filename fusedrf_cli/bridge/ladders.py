"""Ways to fuse a scene, from cheap to dear: flags of `fusedrf fuse` in the order in which they are tried."""

from collections.abc import Generator

from fusedrf_cli.engine.kinds import ladders as kinds_ladders
from fusedrf_cli.engine.kinds import registry
from fusedrf_cli.engine.kinds.ladders import Rung

Flags = tuple[str, ...]
Ladder = Generator[Flags, tuple[int, float] | None, None]
"""Gives flags, takes the bytes and the PSNR that came of them, or None where nothing did."""


def ladders(kind: str, least_psnr: float) -> dict[str, list[Ladder]]:
    """The ladders of a kind, in groups that take about as long; those that learn nothing come first."""
    groups = registry.kind(kind).ladders(least_psnr)
    return {name: [in_flags(kind, ladder) for ladder in found] for name, found in groups.items()}


def in_flags(kind: str, ladder: kinds_ladders.Ladder) -> Ladder:
    """A kind's ladder as flags."""
    try:
        rung = next(ladder)
        while True:
            rung = ladder.send((yield flags_of(kind, rung)))
    except StopIteration:
        return


def flags_of(kind: str, rung: Rung) -> Flags:
    """The flags that ask for a rung."""
    words = ["--kind", kind]
    words += ["--precision", rung.precision] if rung.precision is not None else []
    words += ["--ranks", f"{rung.ranks[0]},{rung.ranks[1]}"] if rung.ranks is not None else []
    words += ["--sh-degree", str(rung.sh_degree)] if rung.sh_degree is not None else []
    words += [] if rung.rgb else ["--no-rgb"]
    words += ["--max-size", in_words(rung.bytes)] if rung.bytes is not None else []
    return (*words, *(("--time-budget", f"{rung.seconds:g}") if rung.seconds is not None else ()))


def in_words(size: int) -> str:
    """Bytes as --max-size takes them: 12MB, 8.1MB or 950kB."""
    return f"{size / 1e6:g}MB" if size >= 1_000_000 else f"{size / 1e3:g}kB"
