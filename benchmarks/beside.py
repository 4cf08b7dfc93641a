"""Two trainings at a time: python -m benchmarks.beside CAPTURE [--seconds 45]

Trains on a capture, every eighth photo held out, alone and beside another of the same, with the short waits
of torch's threads that fusedrf asks for and with torch's own. Prints a Markdown table.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import fusedrf_cli
from benchmarks.paper.table import markdown

WAITS = {"short": fusedrf_cli.SHORT_WAIT, "torch's own": "300000"}  # turns: libgomp's while cores suffice


def trained(capture: Path, seconds: float, at_once: int, turns: str) -> list[dict]:
    """The reports of so many trainings at a time, whose threads spin for so many turns."""
    words = [sys.executable, "-m", "fusedrf_cli", "train", str(capture), "--json"]
    words += ["--holdout", "8", "--time-budget", str(seconds), "-o"]
    with tempfile.TemporaryDirectory() as folder:
        outputs = [str(Path(folder) / f"{i}.rfpack") for i in range(at_once)]
        how = {"env": os.environ | {"GOMP_SPINCOUNT": turns}, "stdout": subprocess.PIPE}
        runs = [subprocess.Popen([*words, output], stderr=subprocess.DEVNULL, **how) for output in outputs]
        return [json.loads(run.communicate()[0]) for run in runs]


def main() -> None:
    """Measure, and print the table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.beside", description=__doc__)
    parser.add_argument("capture", type=Path)
    parser.add_argument("--seconds", type=float, default=45.0)
    asked = parser.parse_args()
    rows = []
    for waits, turns in WAITS.items():
        for at_once in (1, 2):
            for report in trained(asked.capture, asked.seconds, at_once, turns):
                rows.append(
                    {"waits": waits, "at a time": at_once, "steps": report["steps"]}
                    | {"held-out PSNR": f"{report['holdout']['psnr']:.1f}"}
                    | {"seconds of learning": f"{report['seconds']['training']:.0f}"}
                )
    print(markdown(rows))


if __name__ == "__main__":
    main()
