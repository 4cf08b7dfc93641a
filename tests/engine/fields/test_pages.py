"""Arrays in large pages are arrays like any other."""

import mmap
import os

import pytest
import torch

from fusedrf_cli.engine.fields import large_pages

MANY = large_pages.LARGE // 4


@pytest.mark.parametrize("count", [0, 7, MANY - 1, MANY, MANY + 5])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_they_are_zeros_that_can_be_written(count, dtype):
    numbers = large_pages.zeros(count, dtype)
    assert numbers.shape == (count,) and numbers.dtype == dtype and numbers.device.type == "cpu"
    assert not numbers.any()
    numbers += 1
    view = numbers[count // 2 :].numpy()
    del numbers  # what is left keeps the memory
    assert (view == 1).all()


def test_large_ones_are_asked_for_in_large_pages(monkeypatch):
    asked = []

    class Memory(mmap.mmap):
        def madvise(self, *advice):
            asked.append((len(self), *advice))

    monkeypatch.setattr(large_pages.mmap, "mmap", Memory)
    large_pages.zeros(MANY - 1, advice=14)
    large_pages.zeros(MANY, advice=14)
    assert asked == [(large_pages.LARGE, 14)]


def test_a_system_without_them_gives_small_ones(monkeypatch):
    class Memory(mmap.mmap):
        def madvise(self, *advice):
            raise OSError(22, "Invalid argument")

    monkeypatch.setattr(large_pages.mmap, "mmap", Memory)
    assert not large_pages.zeros(MANY, advice=14).any()
    assert not large_pages.zeros(MANY, advice=None).any()


@pytest.mark.skipif(large_pages.ADVICE is None, reason="a system without large pages")
def test_large_ones_are_not_shared_with_children():
    """Shared memory, which a mapping is unless it says otherwise, stays in small pages on most systems."""
    numbers = large_pages.zeros(MANY)
    child = os.fork()
    if child == 0:
        numbers.numpy()[:] = 1
        os._exit(0)
    assert os.waitpid(child, 0)[1] == 0
    assert not numbers.any()
