"""Points of a chart as flags of `fusedrf fuse`, for people to type."""

from fusedrf_cli.engine.kinds.ladders import Rung


def flags_of(kind: str, rung: Rung, seed: int = 0) -> str:
    """The flags that ask for a rung."""
    words = ["--kind", kind]
    words += ["--precision", rung.precision] if rung.precision is not None else []
    words += ["--ranks", f"{rung.ranks[0]},{rung.ranks[1]}"] if rung.ranks is not None else []
    words += ["--sh-degree", str(rung.sh_degree)] if rung.sh_degree is not None else []
    words += [] if rung.finetune else ["--no-finetune"]
    words += ["--max-size", in_words(rung.max_size)] if rung.max_size is not None else []
    words += ["--time-budget", f"{rung.time_budget:g}"] if rung.time_budget is not None else []
    return " ".join([*words, *(["--seed", str(seed)] if seed else [])])


def in_words(size: int) -> str:
    """Bytes as --max-size takes them: 12MB, 8.1MB or 950kB."""
    return f"{size / 1e6:g}MB" if size >= 1_000_000 else f"{size / 1e3:g}kB"
