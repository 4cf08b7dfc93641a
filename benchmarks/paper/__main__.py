"""The paper's experiments: python -m benchmarks.paper [--only PART] [--data DIR] (make bench-paper DATA=DIR)

Writes docs/paper/table.md, the CSVs that it is made of, and the plots, part by part. Scenes are made and
trained in build/paper and kept there; with --data (a folder with chair/ and fuze/fuze.obj) the four objects
are those captures.
"""

import argparse
from pathlib import Path

from benchmarks.paper.capacity import capacity
from benchmarks.paper.quality import closeup, kinds, seeds, sizes
from benchmarks.paper.smallest import smallest
from benchmarks.paper.table import update
from benchmarks.paper.times import times
from benchmarks.paper.work import Work, tell

ROOT = Path(__file__).parents[2]
EXPERIMENTS = {
    "kinds": kinds,
    "sizes": sizes,
    "times": times,
    "smallest": smallest,
    "closeup": closeup,
    "capacity": capacity,
    "seeds": seeds,
}


def main() -> None:
    """Run the experiments that were asked for, all by default."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.paper", description=__doc__)
    parser.add_argument("--only", action="append", choices=EXPERIMENTS, help="this part; may be repeated")
    parser.add_argument("--data", type=Path, help="a folder with chair/ and fuze/fuze.obj")
    asked = parser.parse_args()
    data = asked.data.resolve() if asked.data else None
    work = Work(ROOT / "build" / "paper", ROOT / "docs" / "paper", data)
    for folder in (work.folder, work.out):
        folder.mkdir(parents=True, exist_ok=True)
    for name in asked.only or EXPERIMENTS:
        seen = EXPERIMENTS[name](work)
        update(work.out, seen)
        tell(f"{name}: {seen}")


if __name__ == "__main__":
    main()
