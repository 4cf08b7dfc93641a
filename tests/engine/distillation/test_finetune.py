"""Finishing: what was made smaller comes nearer to its teacher on rays it never saw; the same seed, the same
numbers."""

import numpy as np
import pytest
import torch

from fusedrf_cli.engine.distillation.finetune import FinetuneRays
from fusedrf_cli.engine.distillation.ray_dataset import TeacherRays
from fusedrf_cli.engine.distillation.sampler import RaySampler
from fusedrf_cli.engine.distillation.shuffle import Shuffle
from fusedrf_cli.engine.fields.occupancy import OccupancyGrid
from fusedrf_cli.engine.rendering.volume import render_rays
from tests.engine.conftest import BOX, THIRTY_TWO, random_vm


@pytest.fixture
def pair():
    """A field that some rays miss, and the same at less than half its resolution."""
    smooth = random_vm(THIRTY_TWO, resolution=(3, 3, 3), dtype=torch.float32, seed=1)
    grid = OccupancyGrid(BOX, np.arange(64).reshape(4, 4, 4) < 32)
    sizes = (20, 21, 22), (4, 4, 5)
    whole, few = (smooth.resampled(BOX, size).with_occupancy(grid) for size in sizes)
    few.params += 0.3 * torch.randn(few.params.shape, generator=torch.Generator().manual_seed(3))
    return whole, few


def test_a_student_comes_nearer_on_rays_it_never_saw(pair):
    whole, few = pair
    lesson = FinetuneRays(whole, RaySampler([whole.aabb]), seed=0, rays=4000)
    rays = RaySampler([whole.aabb]).draw(1000, torch.Generator().manual_seed(99))
    wanted = render_rays(whole, *rays)[:, :4]

    def error() -> float:
        return float(((render_rays(few, *rays)[:, :4] - wanted) ** 2).mean())

    before, shares = error(), []
    lesson.teach(few, steps=60, advance=shares.append)
    assert error() < 0.6 * before and shares[-1] == 1


def test_the_same_seed_teaches_the_same(pair):
    whole, few = pair
    start, ends = few.params.clone(), []
    for seed in (0, 0, 1):
        few.params.copy_(start)
        FinetuneRays(whole, RaySampler([whole.aabb]), seed, rays=1000).teach(few, steps=5)
        ends.append(few.params.clone())
    assert torch.equal(ends[0], ends[1]) and not torch.equal(ends[0], ends[2])


def test_what_the_teacher_shows_is_over_white(pair):
    whole, _ = pair
    lesson = FinetuneRays(whole, RaySampler([whole.aabb]), seed=0, rays=500)
    empty = lesson.shown[:, 3] == 0
    rays = TeacherRays(lesson.rays_o, lesson.rays_d, lesson.shown, Shuffle(500, torch.Generator()))
    assert empty.any() and np.array_equal(rays.target[empty, :3], np.ones((empty.sum(), 3)))
