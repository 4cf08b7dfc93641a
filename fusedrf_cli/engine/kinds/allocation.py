"""Bytes shared out among the fields of a scene: each gets the precision, texels and components with which all
of them fit in a limit at the least error. Of what a field may lose, that goes first which saves most bytes
for the error that it adds (greedy allocation of bits; Shoham and Gersho 1988)."""

from bisect import bisect_left
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import islice, product
from math import exp, log

from fusedrf_cli.engine.kinds.builder import StorageSetting
from fusedrf_cli.engine.kinds.reduction import Reduction
from fusedrf_cli.engine.settings import current


@dataclass(frozen=True)
class AllocationConfig:
    """What fields may lose."""

    ranks: tuple[tuple[int, int], ...] = ((8, 24), (8, 16))
    """Of components, one after the other: fewer for density cost least and fewer for colour most
    (docs/how-fusing-works.md)."""
    voxel_step: float = 2 ** (1 / 4)
    """From one spacing of texels to the next."""
    most_steps: int = 32
    """Of that, to 256 times the spacing."""
    measured_steps: tuple[int, ...] = (2, 4, 8, 12, 16, 24, 32)
    """At which the error is measured; between them it is a power of the spacing."""
    least_error: float = 1e-9
    """Mean square: what lies under it cannot be seen."""


@dataclass(frozen=True)
class Share:
    """How one field is stored."""

    precision: str | None
    """None: with the bytes of its source."""
    steps: int = 0
    """By which its texels are wider."""
    ranks: tuple[int, int] | None = None
    """At most so many components; None: its own."""


class FieldShares:
    """What one field takes, and how far it shows from itself, by its share."""

    def __init__(
        self,
        reduction: Callable[[float, StorageSetting], Reduction],
        bytes_at: Callable[[Reduction, str | None], int],
        error_of: Callable[[Reduction, str | None], float],
        voxel: float,
        asked: StorageSetting,
        ladder: Sequence[str | None],
        ranked: bool,
    ):
        """reduction: of a spacing of texels and components. bytes_at and error_of: of a field so reduced in a
        precision. voxel: the field's spacing. asked: ranks and SH degree at most. ladder: the precisions that
        are free, from the dearest to the cheapest, None for the source's own bytes. ranked: whether fewer
        components than those asked for may be tried."""
        self.voxel, self.asked, self.ladder, self.ranked = voxel, asked, ladder, ranked
        self._reduction = cache(reduction)
        self.bytes = cache(lambda share: bytes_at(self.reduction(share), share.precision))
        """At most so many bytes with a share."""
        self._error = cache(lambda share: error_of(self.reduction(share), share.precision))

    @property
    def whole(self) -> Share:
        """All that it may have."""
        return Share(self.ladder[0])

    def reduction(self, share: Share) -> Reduction:
        """What makes the field of a share, but for its precision."""
        voxel = self.voxel * current(AllocationConfig).voxel_step ** share.steps if share.steps else 0.0
        return self._reduction(voxel, replace(self.asked, ranks=share.ranks or self.asked.ranks))

    def error(self, share: Share) -> float:
        """About so much mean square error: of its precision, its texels and its components, each measured by
        itself."""
        error = self._error(Share(share.precision))
        if share.ranks is not None:
            error += self._error(Share(None, 0, share.ranks))
        return error + (self.coarsening_error(share.steps) if share.steps else 0.0)

    def coarsening_error(self, steps: int) -> float:
        """Of wider texels alone."""
        config = current(AllocationConfig)

        def measured(at: int) -> float:
            return max(self._error(Share(None, at)), config.least_error)

        after = next(at for at in config.measured_steps if at >= steps)
        if after == steps:
            return measured(after)
        before = max((at for at in config.measured_steps if at < steps), default=0)
        if not before:  # as its square, from nothing
            return measured(after) * config.voxel_step ** (2 * (steps - after))
        share = (steps - before) / (after - before)
        return exp((1 - share) * log(measured(before)) + share * log(measured(after)))

    def moves(self, share: Share) -> Iterator[Share]:
        """Shares of fewer bytes: in this and each cheaper precision the next spacing that saves any, and the
        next number of components."""
        config, size = current(AllocationConfig), self.bytes(share)
        fewer = [r for r in config.ranks if share.ranks is None or r < share.ranks] if self.ranked else []
        for precision in self.ladder[self.ladder.index(share.precision) :]:
            spacings = (Share(precision, n, share.ranks) for n in range(share.steps, config.most_steps + 1))
            components = (Share(precision, share.steps, r) for r in fewer[:1])
            for tried in (spacings, components):
                yield from islice((one for one in tried if self.bytes(one) < size), 1)

    def best(self, most: int) -> Share | None:
        """Of all shares of at most so many bytes that of the least error; None where there are none."""
        config, fitting = current(AllocationConfig), []
        spacings, components = range(config.most_steps + 1), (None, *config.ranks) if self.ranked else (None,)
        for precision, ranks in product(self.ladder, components):
            fits = [Share(precision, n, ranks) for n in spacings]
            first = bisect_left(fits, True, key=lambda share: self.bytes(share) <= most)
            fitting += fits[first : first + 1]
        return min(fitting, key=self.error, default=None)

    @property
    def least(self) -> Share:
        """That of the fewest bytes."""
        config = current(AllocationConfig)
        ranks = config.ranks[-1] if self.ranked and config.ranks else None
        return min((Share(p, config.most_steps, ranks) for p in self.ladder), key=self.bytes)

    def smallest(self) -> int:
        """Bytes of the least share."""
        return self.bytes(self.least)


def allocated(fields: Sequence[FieldShares], limit: int) -> list[Share]:
    """The shares with which the fields take no more than so many bytes, where any do, else the least."""
    if sum(field.smallest() for field in fields) > limit:  # no error needs to be measured for that
        return [field.least for field in fields]
    shares = [field.whole for field in fields]
    sizes = [field.bytes(share) for field, share in zip(fields, shares, strict=True)]

    def price(i: int, share: Share) -> float:
        """The error that a share adds, for each byte that it saves."""
        added = fields[i].error(share) - fields[i].error(shares[i])
        return max(added, 0.0) / (sizes[i] - fields[i].bytes(share))

    cheapest: dict[int, tuple[float, Share] | None] = {}
    while sum(sizes) > limit:
        for i, field in enumerate(fields):
            if i not in cheapest:
                moves = [(price(i, share), share) for share in field.moves(shares[i])]
                cheapest[i] = min(moves, key=lambda move: move[0], default=None)
        left = [i for i, move in cheapest.items() if move is not None]
        if not left:
            break
        i = min(left, key=lambda i: cheapest[i][0])
        shares[i] = cheapest.pop(i)[1]
        sizes[i] = fields[i].bytes(shares[i])
    return filled(fields, shares, sizes, limit)


def filled(fields: Sequence[FieldShares], shares: list[Share], sizes: list[int], limit: int) -> list[Share]:
    """The shares with what the bytes left over allow, those of the largest error first."""
    for i in sorted(range(len(fields)), key=lambda i: -fields[i].error(shares[i])):
        best = fields[i].best(limit - (sum(sizes) - sizes[i]))
        if best is not None and fields[i].error(best) < fields[i].error(shares[i]):
            shares[i], sizes[i] = best, fields[i].bytes(best)
    return shares
