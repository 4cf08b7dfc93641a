"""No byte of a pack can change without notice, and no pack, however hostile, makes a reader stumble."""

import os
import random
import subprocess
import sys
import zlib
from collections import Counter
from pathlib import Path

import pytest

from formats import archive, bundle, errors
from formats.bundle import read_bundle, read_summary
from fusedrf_cli.engine.fields.occupancy import OccupancyConfig
from tests.bundles import parse_bundle
from tests.promises.fuzz import VERBS, Crashed, fuzz, judged
from tests.promises.mutations import DAMAGES, HOSTILITIES
from tests.promises.packs import GOLDEN

ROOT = Path(__file__).parents[2]

PAIR = (GOLDEN / "pair.rfpack").read_bytes()


def regions() -> dict[str, range]:
    """Every byte of the golden pair, by what it is."""
    members, stop = archive._members(memoryview(PAIR), "golden")
    found = {}
    for member in members:
        name = member.name.decode().split("/")[0]
        names_end = member.offset + archive.LOCAL.size + len(member.name)
        found[f"{name}: local header"] = range(member.offset, member.offset + archive.LOCAL.size)
        found[f"{name}: name"] = range(member.offset + archive.LOCAL.size, names_end)
        found[f"{name}: padding"] = range(names_end, member.start)
        found[f"{name}: content"] = range(member.start, member.stop)
    found["directory"] = range(stop, len(PAIR) - archive.END.size)
    found["end record"] = range(len(PAIR) - archive.END.size, len(PAIR))
    return found


def accepted(places) -> list[int]:
    """Bytes among `places` of which some changed bit goes unseen."""
    data, unseen = bytearray(PAIR), []
    for at in places:
        for mask in (1, 0x80, 0xFF):
            data[at] ^= mask
            try:
                parse_bundle(data, "here")
                unseen.append(at)
            except errors.FormatError as error:
                assert error.exit_code == 3
            data[at] ^= mask
    return unseen


def test_the_regions_are_the_whole_file():
    assert sorted(at for places in regions().values() for at in places) == list(range(len(PAIR)))


@pytest.mark.parametrize("region", regions())
def test_a_changed_byte_of_any_region_is_seen(region):
    """P4: every byte of headers and padding, some hundreds of content; `make fuzz` takes the rest."""
    places = list(regions()[region])
    assert accepted(places if len(places) < 400 else random.Random(0).sample(places, 200)) == []


class Anything:
    """Equal to all."""

    def __eq__(self, _):
        return True

    def __ne__(self, _):
        return False


REMOVED = {
    "local header": lambda patch: patch.setattr(archive.Member, "local_header", lambda _: Anything()),
    "name": lambda patch: patch.setattr(archive.Member, "local_header", lambda _: Anything()),
    "padding": lambda patch: patch.setattr(archive.Member, "local_header", lambda _: Anything()),
    "directory": lambda patch: patch.setattr(archive, "_directory", lambda *_: Anything()),
    "end record": lambda patch: patch.setattr(archive, "_directory", lambda *_: Anything()),
}


@pytest.mark.parametrize("region", [name for name in regions() if "content" not in name])
def test_without_the_comparison_of_headers_changes_go_unseen(region, monkeypatch):
    """P4 with its defence removed, region by region."""
    if not regions()[region]:
        pytest.skip("this region is empty in the golden pair")
    REMOVED[region.split(": ")[-1]](monkeypatch)
    assert accepted(regions()[region])


def no_sums(patch, *, crc: bool = False, sha: bool = False) -> None:
    """Take one or both checksums away."""
    if crc:
        real = archive.parse_archive
        patch.setattr(archive, "parse_archive", lambda data, where, **_: real(data, where, verify=False))
    if sha:
        patch.setattr(bundle, "member_name", lambda _: Anything())


def test_content_is_under_two_sums_and_the_scene_under_one(monkeypatch):
    """P4 with its defences removed: SHA-256 or CRC-32 alone sees a field's damage, neither does not.

    A CRC-32 sees every change of one, two or three bits, and of 32 bits in a row, in as much as a scene may
    hold; what other changes it misses are 1 in 4 billion.
    """
    found = regions()
    field, scene = (
        random.Random(1).sample(list(found[f"{n}: content"]), 60) for n in ("fields", "scene.json")
    )
    for crc, sha, unseen in ((True, False, False), (False, True, False), (True, True, True)):
        with monkeypatch.context() as patch:
            no_sums(patch, crc=crc, sha=sha)
            assert bool(accepted(field)) == unseen
    with monkeypatch.context() as patch:
        no_sums(patch, crc=True)
        assert accepted(scene)


def test_a_burst_of_four_bytes_is_seen_anywhere_in_the_scene():
    """P4."""
    start, content = regions()["scene.json: content"].start, PAIR[slice(*_ends("scene.json: content"))]
    rng, crc = random.Random(2), zlib.crc32(content)
    for _ in range(2000):
        at = rng.randrange(len(content) - 4)
        burst = rng.randbytes(4)
        changed = content[:at] + burst + content[at + 4 :]
        assert changed == content or zlib.crc32(changed) != crc
    assert start % archive.ALIGNMENT == 0


def _ends(region: str) -> tuple[int, int]:
    return regions()[region].start, regions()[region].stop


def test_every_length_is_the_wrong_one_but_its_own(tmp_path):
    """P4: truncations of a real pack, at the edges of its parts and between."""
    edges = {edge for places in regions().values() for edge in (places.start, places.stop)}
    lengths = {edge + by for edge in edges for by in (-1, 0, 1)} | set(range(0, len(PAIR), 131))
    for length in sorted(lengths & set(range(len(PAIR)))):
        (tmp_path / "a").write_bytes(PAIR[:length])
        for read in (read_bundle, read_summary):
            with pytest.raises(errors.FormatError) as caught:
                read(tmp_path / "a")
            assert caught.value.exit_code == 3


def test_info_sees_damage_too(tmp_path):
    """P4: what is reported of a pack comes from bytes that were checked."""
    at = PAIR.index(b'"translation": [0.1') + len(b'"translation": [0.')
    (tmp_path / "a").write_bytes(PAIR[:at] + b"7" + PAIR[at + 1 :])
    with pytest.raises(errors.ChecksumMismatch):
        read_summary(tmp_path / "a")


def test_mutated_packs_are_refused_or_read_as_they_are(tmp_path):
    """P4, P18: by every verb that reads; `make fuzz` does the same to 10,000."""
    result = fuzz(400, 0, tmp_path)
    counts = result["counts"]
    assert result["wrong"] == [] and counts["refused"] > 1000 and counts["taken"] > 50
    assert {f"damaged: {kind}" for kind in DAMAGES} | {
        f"hostile: {kind}" for kind in HOSTILITIES
    } < counts.keys()


def test_a_reader_without_checks_is_found_out(tmp_path, monkeypatch):
    """P4, P18 with their defences removed."""
    no_sums(monkeypatch, crc=True, sha=True)
    assert any(problem["problem"] == "silent" for problem in fuzz(100, 0, tmp_path)["wrong"])


def test_a_reader_that_stumbles_or_hangs_is_found_out(tmp_path):
    """P18: the fuzzer sees what it looks for."""

    def stumble(_):
        raise RecursionError

    def hang(_):
        while True:
            pass

    def crash(_):
        raise Crashed("exit 1")

    assert judged(tmp_path, stumble, True, Counter()).startswith("crashed")
    assert judged(tmp_path, crash, True, Counter()).startswith("crashed")
    assert judged(tmp_path, hang, True, Counter(), 0.2) == "hung"
    assert judged(tmp_path, lambda _: True, True, Counter()) == "silent"
    assert judged(tmp_path, lambda _: True, False, Counter()) is None


def test_good_packs_are_taken_by_every_verb(in_force):
    """A fuzzer whose verbs refuse all would find nothing."""

    in_force(OccupancyConfig(scene_cells=16))
    assert all(verb(str(GOLDEN / "pair.rfpack")) for verb in VERBS.values())


@pytest.mark.slow
def test_whole_commands_over_hostile_packs(tmp_path):
    """P14, P18: some runs of what `make fuzz` does at length, in a process that forks with one thread."""
    words = [sys.executable, "-m", "tests.promises.commands", "--count", "12"]
    environment = os.environ | {"NUMBA_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "TMPDIR": str(tmp_path)}
    done = subprocess.run(words, cwd=ROOT, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
