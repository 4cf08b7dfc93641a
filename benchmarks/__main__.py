"""Kernel speed against the torch reference in the same run: python -m benchmarks (or make bench).

Prints medians of several repeats as ratios, since a bare time says little of a shared machine.
"""

import statistics
import time
from collections.abc import Callable

import numpy as np
import torch

from fusedrf_cli.engine.fields.vm import VMField, VMShape
from fusedrf_cli.engine.kernels import cpu, reference
from fusedrf_cli.engine.rendering.volume import render_rays

POINTS, RAYS, REPEATS, TEXELS = 1 << 17, 1 << 13, 5, 224
BOX = np.array([-1.0, -1, -1, 1, 1, 1])


def median_seconds(work: Callable[[], object]) -> float:
    """Median of REPEATS runs after one that compiles."""
    work()
    seconds = []
    for _ in range(REPEATS):
        started = time.perf_counter()
        work()
        seconds.append(time.perf_counter() - started)
    return statistics.median(seconds)


def query_ratio(field: VMField, generator: torch.Generator, with_colour: bool) -> tuple[float, float]:
    """(millions of points per second, times faster than the reference) of a query and its backward pass."""
    points = torch.rand(POINTS, 3, generator=generator, dtype=torch.float64) * 2 - 1
    dirs = torch.nn.functional.normalize(
        torch.randn(POINTS, 3, generator=generator, dtype=torch.float64), dim=1
    )
    grads = np.zeros((torch.get_num_threads(), field.params.numel()), np.float32)
    d_sigma, d_rgb = np.ones(POINTS, np.float32), np.full((POINTS, 3), float(with_colour), np.float32)

    def kernel():
        field.query(points, dirs, with_colour)
        cpu.query_backward(
            *field.kernel_shape,
            field.arrays,
            field.grid,
            points.numpy(),
            dirs.numpy(),
            d_sigma,
            d_rgb,
            grads,
        )

    sections = {name: view.clone().requires_grad_() for name, view in field.sections(0).items()}
    unit, ways, tensor = ((points + 1) / 2).float(), dirs.float(), field.tensors[0]

    def truth():
        if with_colour:
            sigma, rgb = reference.vm_query(sections, unit, ways, tensor.scale, tensor.shift)
            (sigma.sum() + rgb.sum()).backward()
        else:
            feature = reference.vm_density_feature(sections, unit)
            reference.density(feature, tensor.scale, tensor.shift).sum().backward()

    ours, theirs = median_seconds(kernel), median_seconds(truth)
    return POINTS / ours / 1e6, theirs / ours


def ray_rates(field: VMField, generator: torch.Generator) -> tuple[float, float]:
    """Millions of samples per second of rendering and of a training pass through a full grid."""
    origin = torch.nn.functional.normalize(
        torch.randn(RAYS, 3, generator=generator, dtype=torch.float64), dim=1
    )
    rays_o = (3 * origin).numpy()
    target = torch.rand(RAYS, 3, generator=generator, dtype=torch.float64).numpy() - 0.5
    rays_d = target - rays_o
    rays_d /= np.linalg.norm(rays_d, axis=1, keepdims=True)
    step, grads = 0.02, np.zeros((torch.get_num_threads(), field.params.numel()), np.float32)
    wanted, white = np.zeros((RAYS, 4), np.float32), np.ones((RAYS, 3), np.float32)
    loss = np.zeros((len(grads), 3))

    def train():
        loss[:] = 0
        cpu.train_rays(
            *field.kernel_shape,
            field.arrays,
            field.grid,
            rays_o,
            rays_d,
            0.0,
            np.zeros(RAYS),
            step,
            1e-3,
            wanted,
            white,
            0.1,
            256,
            grads,
            loss,
        )

    trained = median_seconds(train)
    samples = loss[:, 2].sum()
    return samples / median_seconds(lambda: render_rays(field, rays_o, rays_d, step=step)) / 1e6, (
        samples / trained / 1e6
    )


def main() -> None:
    """Measure and print the table."""
    generator = torch.Generator().manual_seed(0)
    field = VMField.create(BOX, (TEXELS,) * 3, VMShape(), generator)
    print(f"VM tensor of {TEXELS} texels per axis, ranks 16 and 24, {torch.get_num_threads()} threads")
    for what, colour in (("density", False), ("density and colour", True)):
        rate, ratio = query_ratio(field, generator, colour)
        print(
            f"query forward and backward, {what}: {rate:.2f} M points/s, "
            f"{ratio:.1f} times the torch reference"
        )
    rendered, trained = ray_rates(field, generator)
    print(f"fog (every sample shaded): render {rendered:.2f} M samples/s, train {trained:.2f} M samples/s")


if __name__ == "__main__":
    main()
