"""The roughness of planes: its gradient is that of its formula, and it takes noise away."""

import numpy as np
import pytest
import torch

from fusedrf_cli.engine.distillation.tv_loss import TVLossConfig, add_tv_gradient
from fusedrf_cli.engine.kinds import registry
from fusedrf_cli.engine.kinds.builder import StorageSetting

BOX = np.array([-1.0, -1, -1, 1, 1, 1])


def untrained(kind: str, resolution=(9, 13, 20)):
    kind = registry.kind(kind)
    plan = kind.plan_at(
        BOX, resolution, StorageSetting(ranks=(8, 16)) if kind.takes & {"ranks"} else StorageSetting()
    )
    return kind.create(plan, torch.Generator().manual_seed(0))


@pytest.mark.parametrize("kind", ["vm", "vm-mlp"])
def test_the_mean_over_all_strips_is_the_gradient_of_the_formula(kind):
    """By autograd of the whole formula, in float64; the numbers that are no planes have none."""
    field, weight = untrained(kind), 0.37
    field = field.with_params(field.params.double())
    found = torch.zeros_like(field.params)
    for strip in range(TVLossConfig.strips):
        add_tv_gradient(field, found, weight, strip)
    numbers = field.params.clone().requires_grad_()
    rough = sum(
        2 * weight * ((p[1:] - p[:-1]).square().sum() + (p[:, 1:] - p[:, :-1]).square().sum()) / p.numel()
        for p in field.planes(numbers)
    )
    (wanted,) = torch.autograd.grad(rough, numbers)
    assert len(field.planes(numbers)) == 6 and wanted.abs().max() > 0
    torch.testing.assert_close(found / TVLossConfig.strips, wanted, rtol=1e-9, atol=1e-15)


def test_planes_are_those_of_the_field():
    """What a slope says of a plane reaches the very number that the plane shows."""
    field = untrained("vm")
    changed = field.params.clone()
    field.planes(changed)[1][3, 4, 5] += 1
    name = [name for name in field.sections() if "_plane_" in name][1]
    assert field.with_params(changed).sections()[name][3, 4, 5] - field.sections()[name][3, 4, 5] == 1
    assert (changed != field.params).sum() == 1


def test_kinds_without_planes_stay_as_they_are():
    field = untrained("dense")
    gradient = torch.zeros_like(field.params)
    add_tv_gradient(field, gradient, 1.0, 0)
    assert field.planes(gradient) == [] and not gradient.any()
