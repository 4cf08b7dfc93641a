"""Points of a chart as flags of `fusedrf fuse`, for people to type."""

from fusedrf_cli.engine.kinds.sweeps import SweepPoint


def flags_of(kind: str, point: SweepPoint, seed: int = 0) -> str:
    """The flags that ask for a rung."""
    words = ["--kind", kind]
    words += ["--precision", point.precision] if point.precision is not None else []
    words += ["--ranks", f"{point.ranks[0]},{point.ranks[1]}"] if point.ranks is not None else []
    words += ["--sh-degree", str(point.sh_degree)] if point.sh_degree is not None else []
    words += [] if point.finetune else ["--no-finetune"]
    words += ["--max-size", in_words(point.max_size)] if point.max_size is not None else []
    words += ["--time-budget", f"{point.time_budget:g}"] if point.time_budget is not None else []
    return " ".join([*words, *(["--seed", str(seed)] if seed else [])])


def in_words(size: int) -> str:
    """Bytes as --max-size takes them: 12MB, 8.1MB or 950kB."""
    return f"{size / 1e6:g}MB" if size >= 1_000_000 else f"{size / 1e3:g}kB"
