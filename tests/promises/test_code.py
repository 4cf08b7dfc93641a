"""Opening a pack, good, damaged or hostile, runs no code of it and touches nothing but its file."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from tests.promises.packs import GOLDEN

ROOT = Path(__file__).parents[2]
# Opens mutated packs under an audit hook; tells the events that mean code, and the files that were opened.
WATCHED = """
import json, os, random, sys, tempfile, warnings
import formats.bundle, formats.scene
from formats.errors import FormatError
from tests.promises.mutations import mutated
warnings.simplefilter("ignore")
exec(sys.argv[2])
def read(path):
    for reader in (formats.bundle.read_bundle, formats.bundle.read_summary):
        try:
            reader(path)
        except FormatError:
            pass
good = [open(path, "rb").read() for path in sys.argv[3:]]
folder = tempfile.mkdtemp()
path = os.path.join(folder, "mutated.rfpack")
packs = [mutated(good[i % len(good)], random.Random(i))[1] for i in range(int(sys.argv[1]))]
for golden in sys.argv[3:]:  # what Python itself loads for the first reading and the first error
    read(golden)
read("absent")
CODE = ("exec", "compile", "import", "pickle", "marshal", "socket", "subprocess", "ctypes", "code.", "pty")
SYSTEM = ("os.system", "os.exec", "os.fork", "os.posix_spawn", "os.spawn", "os.remove", "os.rename")
events, opened, reading = set(), set(), False
def hook(event, words):
    if not reading:
        return
    if event.startswith(CODE + SYSTEM):
        events.add(f"{event} {str(words)[:80]}")
    if event == "open" and isinstance(words[0], str):
        opened.add(words[0])
sys.addaudithook(hook)
for data in packs:
    with open(path, "wb") as file:
        file.write(data)
    reading = True
    read(path)
    reading = False
print(json.dumps({"events": sorted(events), "strangers": sorted(opened - {path})}))
"""
UNPICKLING = """
import pickle
decode = formats.bundle.decode_field
formats.bundle.decode_field = lambda data, where: pickle.loads(pickle.dumps(decode(data, where)))
"""


def watched(count: int, change: str = "") -> dict:
    packs = sorted(map(str, GOLDEN.glob("*.rfpack")))
    run = subprocess.run(
        [sys.executable, "-c", WATCHED, str(count), change, *packs], cwd=ROOT, capture_output=True, text=True
    )
    assert run.returncode == 0, run.stderr
    return json.loads(run.stdout)


@pytest.mark.parametrize("count", [300, pytest.param(5000, marks=pytest.mark.slow)])
def test_no_code_runs_and_no_other_file_is_opened(count):
    """P17."""
    assert watched(count) == {"events": [], "strangers": []}


def test_a_reader_that_unpickles_is_found_out():
    """P17 with its defence removed."""
    assert any(event.startswith("pickle") for event in watched(20, UNPICKLING)["events"])
