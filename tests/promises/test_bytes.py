"""Equal content gives equal bytes, in any process, at any hour."""

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
WRITE = """
import hashlib, os, sys, tempfile
os.umask(int(sys.argv[1]))
from tests.promises.packs import write_generation
with tempfile.TemporaryDirectory() as folder:
    write_generation(folder + "/a", 7)
    print(hashlib.sha256(open(folder + "/a", "rb").read()).hexdigest())
"""
# A field as safetensors would have it, with its metadata in several keys.
LOOSE = """
import hashlib, numpy, safetensors.numpy
data = safetensors.numpy.save({"a": numpy.zeros(3)}, {f"key{i}": "x" for i in range(12)})
print(hashlib.sha256(data).hexdigest())
"""
PLACES = [
    {"PYTHONHASHSEED": "1", "TZ": "UTC", "LC_ALL": "C"},
    {"PYTHONHASHSEED": "2", "TZ": "Pacific/Kiritimati", "LC_ALL": "C.UTF-8", "USER": "somebody"},
    {"PYTHONHASHSEED": "3", "TZ": "America/Adak", "HOSTNAME": "elsewhere"},
]


def digests(code: str) -> set[str]:
    found = set()
    for i, place in enumerate(PLACES):
        words = [sys.executable, "-c", code, str(i * 8)]
        run = subprocess.run(words, cwd=ROOT, env=place, capture_output=True, text=True, check=True)
        found.add(run.stdout)
    return found


def test_a_pack_written_twice_has_the_same_bytes():
    """P16: whatever the time zone, the locale, the user, and the seed of Python's hashes."""
    assert len(digests(WRITE)) == 1


def test_without_one_key_for_all_metadata_the_bytes_differ():
    """P16 with its defence removed."""
    assert len(digests(LOOSE)) > 1


@pytest.mark.parametrize("times", [2])
def test_a_time_in_the_bytes_would_show(times):
    """P16 with its defence removed: a directory that tells when it was written."""
    code = WRITE.replace(
        "from tests",
        "import time, formats.archive\nformats.archive.DATE = time.time_ns() % 65536\nfrom tests",
    )
    assert len(digests(code)) > 1
