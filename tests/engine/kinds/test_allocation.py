"""Bytes shared out among fields, held to an exhaustive search over fields whose costs are closed forms."""

from itertools import product
from types import SimpleNamespace

import numpy as np
import pytest

from fusedrf_cli.engine.kinds.allocation import AllocationConfig, FieldShares, Share, allocated
from fusedrf_cli.engine.kinds.builder import EACH, StorageSetting

BITS = {None: 16, "int8": 8, "int4": 4}
ERROR = {None: 0.0, "int8": 1e-6, "int4": 1e-4}


def field(
    size: float, noise: float = 1.0, texture: float = 1.0, dimensions: int = 2, calls=None
) -> FieldShares:
    """A field of a unit of spacing, of `size` bytes in 16 bits, whose bytes fall with a power of its spacing,
    and whose error is so many times ERROR, and texture times 1e-4 of the squared spacing."""

    def reduction(voxel: float, storage: StorageSetting) -> SimpleNamespace:
        return SimpleNamespace(spacing=max(voxel, 1.0), lossless=voxel <= 1.0)

    def bytes_at(one: SimpleNamespace, precision: str | None) -> int:
        if precision is None and not one.lossless:
            return 1 << 62
        return int(size * BITS[precision] / 16 / one.spacing**dimensions)

    def error_of(one: SimpleNamespace, precision: str | None) -> float:
        if calls is not None:
            calls.append((one.spacing, precision))
        coarse = 0.0 if one.lossless else 1e-4 * texture * one.spacing**2
        return noise * ERROR[precision] + coarse

    return FieldShares(
        reduction, bytes_at, error_of, 1.0, StorageSetting(EACH), [None, "int8", "int4"], False
    )


def totals(fields: list[FieldShares], shares: list[Share]) -> tuple[int, float]:
    """Bytes and error of all."""
    pairs = list(zip(fields, shares, strict=True))
    return sum(f.bytes(s) for f, s in pairs), sum(f.error(s) for f, s in pairs)


def best(fields: list[FieldShares], limit: int) -> float:
    """The least error of all shares that fit."""
    every = [Share(p, n) for p in BITS for n in range(17)]
    found = [totals(fields, shares) for shares in product(every, repeat=len(fields))]
    return min(error for size, error in found if size <= limit)


@pytest.mark.parametrize("limit", [150_000, 90_000, 40_000, 12_000])
def test_the_error_is_near_the_least_that_there_is(limit):
    fields = [field(100_000, texture=0.3), field(60_000, noise=8, dimensions=3)]
    size, error = totals(fields, allocated(fields, limit))
    assert size <= limit and error <= 1.6 * best(fields, limit) + 1e-12


def test_nothing_is_lost_where_all_fits_and_all_where_nothing_does():
    """And no error is measured to find that out."""
    calls = []
    fields = [field(1e9, calls=calls), field(2e9, calls=calls)]
    least = sum(one.smallest() for one in fields)
    shares = allocated(fields, least - 1)
    assert calls == [] and totals(fields, shares)[0] == least > 0
    assert allocated(fields, 3_000_000_000) == [Share(None), Share(None)]


def test_what_shows_least_goes_first():
    """A field that hardly shows its loss gives up its bits, another keeps its source's bytes."""
    fields = [field(100_000, noise=0.01), field(100_000, noise=100)]
    assert [one.precision for one in allocated(fields, 160_000)] == ["int8", None]
    assert [one.precision for one in allocated(fields, 130_000)] == ["int4", None]


def test_what_has_few_bits_already_gets_wider_texels():
    """A source in 4 bits, whose numbers take no fewer bytes anew."""
    one = field(100_000)
    one.bytes = lambda share, before=one.bytes: 25_000 if share == one.whole else before(share)
    (share,) = allocated([one], 20_000)
    assert share.precision is not None and share.steps > 0 and 10_000 < one.bytes(share) <= 20_000


def test_bytes_left_over_make_texels_finer():
    """Bits come in halves; of texels there is always a spacing that nearly fits."""
    fields = [field(100_000), field(50_000, dimensions=3)]
    for limit in np.geomspace(1000, 30_000, 7).astype(int):
        assert 0.6 * limit < totals(fields, allocated(fields, limit))[0] <= limit


def test_one_field_gets_the_best_share_that_fits():
    """Whichever share saves most for its error by the way."""
    one = field(100_000, noise=1.0, texture=0.02)
    for limit in np.geomspace(900, 99_000, 40).astype(int):
        assert totals([one], allocated([one], limit))[1] == pytest.approx(best([one], limit))


def test_errors_between_those_measured_are_powers_of_the_spacing():
    """Exact where the error is one; few spacings are made."""
    calls, step = [], AllocationConfig().voxel_step
    one = field(1000, calls=calls)
    for steps in range(1, 33):
        assert one.error(Share(None, steps)) == pytest.approx(1e-4 * step ** (2 * steps), rel=1e-9)
    assert len(calls) <= 1 + len(AllocationConfig().measured_steps)
