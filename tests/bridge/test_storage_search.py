"""The search for a way to store a field, against a made-up law of PSNR and bytes."""

import math

import pytest

from fusedrf_cli.bridge.storage_search import SearchConfig, StorageSearch, Trial, flags
from fusedrf_cli.engine.kinds.builder import StorageSetting

INT4 = [StorageSetting("int4", (8, 16)), StorageSetting("int4", (8, 24)), StorageSetting("int4")]
INT8 = [StorageSetting("int8", (8, 16)), StorageSetting("int8")]


class Law:
    """PSNR = at + slope ln(bytes) up to a way's whole size; counts what is asked."""

    def __init__(
        self,
        at: dict[StorageSetting, float],
        whole: dict[StorageSetting, int],
        slope: float = 9.0,
        least: int = 1000,
    ):
        self.at, self.whole, self.slope, self.least, self.asked = at, whole, slope, least, []

    def psnr(self, storage: StorageSetting, size: int) -> float:
        return self.at[storage] + self.slope * math.log(size / 1e6)

    def __call__(self, storage: StorageSetting, limit: int, finished: bool) -> Trial | None:
        self.asked.append((storage, limit, finished))
        size = min(limit, self.whole[storage])
        if size < self.least:
            return None
        found = self.psnr(storage, size)
        return Trial(
            storage, limit, size, found if finished else found - 2, found - 2, limit >= self.whole[storage]
        )


def search(law: Law) -> StorageSearch:
    return StorageSearch(law, "blocks", lambda sentence: None)


@pytest.mark.parametrize("target", [25.0, 33.0, 40.0, 41.5])
def test_the_smallest_is_found_to_within_the_tolerance(target):
    law = Law(dict.fromkeys(INT4, 39.0) | {INT4[1]: 40.0}, dict.fromkeys(INT4, 2_000_000))
    chosen = search(law).smallest_reaching([INT4], target, 25_000_000, gain=3)
    exact = 1e6 * math.exp((target - 40.0) / 9)
    assert chosen.storage == INT4[1] and chosen.psnr >= target
    assert exact <= chosen.bytes <= 1.06 * SearchConfig.close * exact
    assert len([a for a in law.asked if a[2]]) <= 12


def test_a_dearer_precision_is_only_tried_where_the_cheap_ones_fail():
    at = dict.fromkeys(INT4, 38.0) | dict.fromkeys(INT8, 36.0)
    law = Law(at, dict.fromkeys(INT4, 2_000_000) | dict.fromkeys(INT8, 9_000_000))
    assert search(law).smallest_reaching([INT4, INT8], 40, 25_000_000, 3).storage.precision == "int4"
    assert not any(storage in INT8 for storage, _, _ in law.asked)
    assert search(law).smallest_reaching([INT4, INT8], 50, 25_000_000, 3).storage.precision == "int8"


def test_nothing_reaches_what_nothing_can():
    law = Law(dict.fromkeys(INT4, 38.0), dict.fromkeys(INT4, 2_000_000))
    assert search(law).smallest_reaching([INT4], 60, 25_000_000, 3) is None
    assert search(law).smallest_reaching([INT4], 40, 900_000, 3) is None


def test_the_best_under_a_size():
    law = Law({INT4[0]: 37.0, INT4[1]: 39.0, INT4[2]: 38.0}, dict.fromkeys(INT4, 2_000_000))
    chosen = search(law).best_within(INT4, 500_000)
    assert chosen.storage == INT4[1] and chosen.bytes <= 500_000
    assert search(law).best_within(INT4, 10) is None


def test_the_next_larger_and_smaller_are_told_with_what_they_give():
    law = Law(dict.fromkeys(INT4, 39.0), dict.fromkeys(INT4, 2_000_000))
    choosing = search(law)
    chosen = choosing.best_within(INT4, 500_000)
    near = choosing.neighbours(chosen)
    assert near["next_smaller"]["bytes"] < chosen.bytes < near["next_larger"]["bytes"]
    assert near["next_smaller"]["psnr"] < chosen.psnr < near["next_larger"]["psnr"]
    assert f"--max-size {near['next_larger']['bytes']}" in near["next_larger"]["flags"]
    whole = choosing.make(INT4[0], 3_000_000, True)
    assert "next_larger" not in choosing.neighbours(whole)


def test_flags_name_what_is_fixed():
    assert flags("blocks", StorageSetting("int4", (8, 16), 1), 9) == (
        "--kind blocks --precision int4 --ranks 8,16 --sh-degree 1 --max-size 9"
    )
    assert flags("blocks", StorageSetting("float16"), 9) == "--kind blocks --precision float16 --max-size 9"


def test_a_finished_try_that_fits_no_more_is_passed_over():
    """Finishing may cost the bytes that were left: then the next best counts."""
    law = Law(dict.fromkeys(INT4, 38.0) | {INT4[0]: 40.0}, dict.fromkeys(INT4, 2_000_000))

    def make(storage, limit, finished):
        return None if finished and storage == INT4[0] else law(storage, limit, finished)

    chosen = StorageSearch(make, "blocks", lambda sentence: None).best_within(INT4, 500_000)
    assert chosen is not None and chosen.storage != INT4[0]
    none = StorageSearch(lambda w, n, f: None if f else law(w, n, f), "blocks", lambda sentence: None)
    assert none.best_within(INT4, 500_000) is None
