"""The commit that figures are measured at."""

import subprocess
from pathlib import Path

ROOT = Path(__file__).parents[1]


def head(root: Path = ROOT) -> tuple[str, str] | None:
    """(short hash, date of its committer as year-month-day) of HEAD; None where `root` is no repository."""
    line = ["git", f"--git-dir={root / '.git'}", "log", "-1", "--format=%h %cs"]
    try:
        done = subprocess.run(line, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return None
    short, date = done.stdout.split()
    return short, date


def commit_line(root: Path = ROOT) -> str:
    """The line at the top of generated documents and tables."""
    found = head(root)
    return "Measured in no repository." if found is None else f"Measured at commit {found[0]}, {found[1]}."


def commit_column(root: Path = ROOT) -> dict[str, str]:
    """The last column of rows that stay when others are measured anew."""
    found = head(root)
    return {"commit": "" if found is None else found[0]}
