"""The slow tests, a process for each file and two at a time: `python -m tests.slow [--third] [--minutes M]`.

Says how long each file took. With --third only a third of the files runs: which one follows from the number
of commits, so that three commits one after the other run all of them. With --minutes nothing runs longer than
that: a file that may not end in time does not begin, and one that is still running then is stopped, which is
said. The exit code is 1 where a test failed, and 0 where none did that was reached. --save keeps the seconds
in slow.json, by which thirds are of equal length and the longest begin first.
"""

import argparse
import json
import os
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

TESTS = Path(__file__).parent
SECONDS = TESTS / "slow.json"
UNKNOWN = 60.0  # seconds of a file that was not measured yet
SLACK = 2.0  # times its measured seconds that a file may take
AT_ONCE = 2
THIRDS = 3
NOTHING_FOUND = 5  # pytest's exit code where no test is slow


def speaks_of_slow(file: Path) -> bool:
    """Whether a file of tests, or the conftest.py beside it, has the word."""
    texts = (path.read_text() for path in (file, file.with_name("conftest.py")) if path.exists())
    return any("slow" in text.lower() for text in texts)


def slow_files() -> dict[str, float]:
    """Seconds by file, the longest first, of files that may have slow tests."""
    known = json.loads(SECONDS.read_text()) if SECONDS.exists() else {}
    files = filter(speaks_of_slow, sorted(TESTS.rglob("test_*.py")))
    found = {str(p.relative_to(TESTS.parent)): known.get(str(p.relative_to(TESTS)), UNKNOWN) for p in files}
    return dict(sorted(found.items(), key=lambda item: -item[1]))


def third_of(files: dict[str, float], which: int) -> dict[str, float]:
    """One of three parts of about equal length: each file goes to the part that is shortest so far."""
    parts: list[dict[str, float]] = [{} for _ in range(THIRDS)]
    for file, seconds in files.items():
        min(parts, key=lambda part: sum(part.values()))[file] = seconds
    return parts[which]


def turn() -> int:
    """Whose turn it is, 0 to 2: by the number of commits; of a shallow clone, which lacks them, by its
    commit's name; without git 0."""

    def git(*words: str) -> str:
        try:
            said = subprocess.run(["git", "-C", TESTS, *words], capture_output=True, text=True)
        except FileNotFoundError:
            return ""
        return said.stdout.strip()

    shallow = git("rev-parse", "--is-shallow-repository") != "false"
    number = int(git("rev-parse", "HEAD") or "0", 16) if shallow else int(git("rev-list", "--count", "HEAD"))
    return number % THIRDS


def ran(file: str, left: float) -> tuple[str, float, str]:
    """(what became of a file, its seconds, its output); left: the seconds that there are."""
    # -x: in a file that is stopped no test has failed
    words = [sys.executable, "-m", "pytest", "-q", "-x", "-m", "slow", "-p", "no:cacheprovider", file]
    environment = {**os.environ, "NUMBA_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    began = time.monotonic()
    try:
        done = subprocess.run(
            words, cwd=TESTS.parent, env=environment, capture_output=True, text=True, timeout=left
        )
    except subprocess.TimeoutExpired as stopped:
        return "stopped", time.monotonic() - began, (stopped.stdout or b"").decode(errors="replace")
    became = "passed" if done.returncode in (0, NOTHING_FOUND) else "FAILED"
    return became, time.monotonic() - began, done.stdout + done.stderr


def main() -> int:
    """Run them; 1 where one failed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--third", action="store_true")
    parser.add_argument("--minutes", type=float, default=float("inf"))
    parser.add_argument("--save", action="store_true")
    asked = parser.parse_args()
    began, files, took = time.monotonic(), slow_files(), {}
    left_out, stopped, failed = [], [], []
    if asked.third:
        which = turn()
        files = third_of(files, which)
        print(f"slow tests, part {which + 1} of {THIRDS}: {len(files)} files", flush=True)

    def left() -> float:
        return 60 * asked.minutes - (time.monotonic() - began)

    def one(file: str) -> None:
        if left() < SLACK * files[file]:
            left_out.append(file)
            print(
                f"{file}: not run, {left():.0f} s are left and it may take {SLACK * files[file]:.0f}",
                flush=True,
            )
            return
        became, seconds, output = ran(file, left() if asked.minutes < float("inf") else None)
        took[file] = seconds
        print(f"{file}: {became} in {seconds:.0f} s", flush=True)
        if became != "passed":
            (stopped if became == "stopped" else failed).append(file)
            print(output, flush=True)

    with ThreadPoolExecutor(AT_ONCE) as pool:
        list(pool.map(one, files))
    if asked.save:
        kept = {file: round(seconds, 1) for file, seconds in (files | took).items()}
        names = {str(Path(file).relative_to("tests")): seconds for file, seconds in sorted(kept.items())}
        SECONDS.write_text(json.dumps(names, indent=1) + "\n")
    print(
        f"{len(took)} files in {time.monotonic() - began:.0f} s, {sum(took.values()):.0f} s of two processes"
    )
    unfinished = {"NOT RUN for want of time": left_out, "STOPPED for want of time": stopped}
    for what, named in ({"FAILED": failed} | unfinished).items():
        if named:
            print(f"{what}: {', '.join(named)}")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
