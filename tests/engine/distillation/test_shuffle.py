"""Every number once before any comes again, whatever the batches."""

from collections import Counter
from itertools import permutations

import numpy as np
import pytest
import torch

from fusedrf_cli.engine.distillation.shuffle import Shuffle


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


@pytest.mark.parametrize("count, batch", [(10, 3), (10, 10), (10, 25), (7, 1), (64, 48)])
def test_every_number_comes_once_an_epoch(count, batch):
    """Also where the batches do not divide the epoch: the remainder is not lost."""
    shuffle = Shuffle(count, seeded())
    batches = [shuffle.draw(batch) for _ in range(5 * count)]
    assert {len(part) for part in batches} == {min(batch, count)}
    drawn = torch.cat(batches)
    whole = drawn[: len(drawn) // count * count].view(-1, count)
    assert torch.equal(whole.sort(1).values, torch.arange(count).expand(len(whole), count))


def test_epochs_differ_and_follow_the_seed():
    first, again, other = (Shuffle(50, seeded(s)) for s in (1, 1, 2))
    a, b, c = first.draw(50), again.draw(50), other.draw(50)
    assert torch.equal(a, b) and not torch.equal(a, c) and not torch.equal(a, first.draw(50))


def test_every_order_comes_as_often():
    """Pearson's χ² of how often each of the 24 orders of four numbers came: over 45 by chance in one of 250
    trials of independent orders."""
    shuffle = Shuffle(4, seeded())
    found = Counter(tuple(shuffle.draw(4).tolist()) for _ in range(4800))
    counts = np.array([found[order] for order in permutations(range(4))])
    assert ((counts - 200) ** 2 / 200).sum() < 45


def test_numbers_that_come_together_have_nothing_in_common():
    """Neither one after the other nor all those of a batch: pixels of a step are from everywhere."""
    count = 1 << 16
    drawn = Shuffle(count, seeded()).draw(count).double().numpy() / count
    for lag in (1, 2, 256):
        assert abs(np.corrcoef(drawn[:-lag], drawn[lag:])[0, 1]) < 4 / np.sqrt(count)
    means = drawn.reshape(256, 256).mean(1)
    assert ((means - 0.5) ** 2).sum() * 12 * 256 == pytest.approx(256, abs=4 * np.sqrt(2 * 256))


@pytest.mark.parametrize("before", [0, 1, 4, 9])
def test_a_restored_order_goes_on(before):
    """Also from before the first draw, and with other random numbers drawn in between."""
    generator = seeded()
    shuffle = Shuffle(10, generator)
    torch.rand(3, generator=generator)
    for _ in range(before):
        shuffle.draw(3)
        torch.rand(1, generator=generator)
    arrays, state = shuffle.state()
    arrays = {name: np.array(value) for name, value in arrays.items()}
    random = generator.get_state()

    other = seeded(99)
    restored = Shuffle(10, other)
    restored.restore(arrays, state)
    other.set_state(random)
    for _ in range(12):
        assert torch.equal(shuffle.draw(3), restored.draw(3))
