"""Device functions run by Python itself: an oracle's other half that waits for no compiler."""

from collections.abc import Callable
from types import FunctionType

import numpy as np
import pytest
import torch

from fusedrf_cli.engine.kernels import specialise

from ..conftest import points_in, unit


def interpreted(field) -> dict[str, Callable]:
    """The namespace of a field's loops, as plain functions over numpy arrays."""
    sizes = field.device_module.sizes(field)
    names, functions = specialise.namespace(field.device_module, field.space)
    names |= sizes
    for name, value in {**names, **functions}.items():
        function = getattr(value, "py_func", functions.get(name))
        if function is not None:
            names[name] = FunctionType(function.__code__, names, name, function.__defaults__)
    names["LANES"] = 0  # each sample by itself
    names["literally"], names["prefetch"] = lambda value: value, lambda array, index: array[index]
    return names


def samples(field, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Points in the box and unit directions."""
    return points_in(field.box, count), unit(np.random.default_rng(1).normal(size=(count, 3)))


def answer(names, field, p, d):
    """(σ, rgb) of the device functions at a point."""
    scratch, memory = np.zeros(names["SCRATCH"]), np.empty(max(names["KEPT"], 1))
    sigma, _, steps, at = names["density"](field.arrays, field.grid, 0, p, d, scratch)
    assert steps == 1
    names["ray_setup"](field.arrays, d, scratch)
    return sigma, names["colour"](field.arrays, at, p, d, scratch, memory, 0)


def assert_answers(field) -> None:
    """That the device functions of a field in float64 answer as its reference."""
    names, (points, dirs) = interpreted(field), samples(field, 12)
    expected = field.reference(field.params, torch.from_numpy(points), torch.from_numpy(dirs))
    for i, (p, d) in enumerate(zip(points.tolist(), dirs.tolist(), strict=True)):
        sigma, rgb = answer(names, field, tuple(p), tuple(d))
        assert sigma == pytest.approx(float(expected[0][i]), rel=1e-9)
        if sigma > 0:
            np.testing.assert_allclose(rgb, expected[1][i], atol=1e-10)


def assert_gradients(field, shaded: bool) -> None:
    """That they send back what autograd does. Two samples of each ray, so that what a ray gathers is sent
    once; a sample that is not shaded sends back by its density alone."""
    names, (points, dirs) = interpreted(field), samples(field, 6)
    arrays, grid = field.arrays, field.grid
    grad = np.zeros(len(field.params))
    rng = np.random.default_rng(2)
    d_sigma, d_rgb = rng.normal(size=6), rng.normal(size=(6, 3)) * shaded
    dirs = dirs[[0, 0, 1, 1, 2, 2]]
    for i in range(0, 6, 2):
        d, scratch = tuple(dirs[i]), np.zeros(names["SCRATCH"])
        names["ray_setup"](arrays, d, scratch)
        for k in (i, i + 1):
            p, memory = tuple(points[k]), np.empty(max(names["KEPT"], 1))
            sigma, pre, _, at = names["density"](arrays, grid, 0, p, d, scratch)
            if sigma == 0:
                continue
            rgb = names["colour"](arrays, at, p, d, scratch, memory, 0) if shaded else (0.0, 0.0, 0.0)
            sent = d_sigma[k], shaded, rgb, tuple(d_rgb[k])
            names["backward"](arrays, at, p, d, pre, *sent, scratch, memory, 0, grad)
        names["ray_backward"](arrays, d, scratch, grad)
    params = field.params.clone().requires_grad_()
    answers = field.reference(params, torch.from_numpy(points), torch.from_numpy(dirs))
    torch.autograd.backward(answers, (torch.from_numpy(d_sigma), torch.from_numpy(d_rgb)))
    assert params.grad.any()
    np.testing.assert_allclose(grad, params.grad, atol=1e-10)
