"""CPU loops over the scalar bodies: each part of the work runs on one core and writes only what is its own.

Rays are (N, 3) float64 in the field's frame, directions of unit length. A loop over `parts` is the parallel
one: part p owns the p-th slice of the rays and row p of every scratch and gradient array, so nothing races
and a sum over rows has one order.
"""

import math

import numpy as np
from llvmlite import ir
from numba import njit, prange, types
from numba.extending import intrinsic

from fusedrf_cli.engine.kernels.bodies import (
    COLOUR_FROM,
    add_scaled,
    block_density,
    colour_features,
    directional_basis,
    dot_row,
    hit_box,
    next_sample,
    object_direction,
    scatter_basis,
    scatter_colour,
    scatter_density,
    sigmoid,
    unit_point,
    winning_block,
)

loop = njit(parallel=True, fastmath=True, error_model="numpy", cache=True)
# A task is the serial work of one core. Without the reference counting of array arguments (_nrt) it is up to
# eight times faster, so tasks allocate nothing: the loops around them hand in the scratch.
task = njit(fastmath=True, error_model="numpy", cache=True, _nrt=False)

POINTS_PER_TASK = 2048
RAYS_PER_TASK = 256
ENTRIES_PER_TASK = 1 << 16
LINE = 16  # floats in a cache line
POINTS_AHEAD = 4  # a point's texels are asked for so many points before it
SAMPLES_AHEAD = 2
DENSITY, COLOUR = 0, 6  # first sections of both in a layout


@intrinsic(prefer_literal=False)
def prefetch(typing, array, index):
    """Ask for the cache line of array[index], a flat array, before it is needed."""

    def generate(context, builder, signature, arguments):
        data = context.make_array(signature.args[0])(context, builder, arguments[0]).data
        line, whole = builder.gep(data, [arguments[1]]), ir.IntType(32)
        kind = ir.FunctionType(ir.VoidType(), [line.type, whole, whole, whole])
        known = builder.module.globals.get("llvm.prefetch.p0")
        hint = known or ir.Function(builder.module, kind, "llvm.prefetch.p0")
        builder.call(hint, [line, whole(0), whole(3), whole(1)])  # for reading, to the nearest cache, data
        return context.get_dummy_value()

    return types.void(array, index), generate


@task
def prefetch_plane(ranks, array, plane, na, nb, a, b):
    """Ask for the four texels of a plane around unit coordinates (a, b), which may lie outside."""
    rank = len(ranks)
    real = array.dtype.type
    ia = min(max(int(a * real(na - 1)), 0), na - 2)
    ib = min(max(int(b * real(nb - 1)), 0), nb - 2)
    lower = np.uint64(plane + (ia * nb + ib) * rank)
    upper = lower + np.uint64(nb * rank)
    for i in range(np.uint64(2 * rank // LINE)):
        prefetch(array, lower + i * np.uint64(LINE))
        prefetch(array, upper + i * np.uint64(LINE))
    if rank % LINE != 0:
        last = np.uint64(2 * rank - 1)
        prefetch(array, lower + last)
        prefetch(array, upper + last)


@task
def prefetch_planes(ranks, vm, array, first, b, x, y, z):
    """Ask for what a query of block b at a field point reads, in params or gradients, of the planes from
    section `first` on. A random point misses the cache a dozen times; asked for early, the misses overlap.
    """
    u, v, w, _ = unit_point(vm, b, x, y, z)
    t = vm.tensor[b]
    nx, ny, nz = vm.resolution[t, 0], vm.resolution[t, 1], vm.resolution[t, 2]
    off = vm.layout[t]
    prefetch_plane(ranks, array, off[first], nx, ny, u, v)
    prefetch_plane(ranks, array, off[first + 1], nx, nz, u, w)
    prefetch_plane(ranks, array, off[first + 2], ny, nz, v, w)


@task
def query_task(
    ranks,
    colour_ranks,
    coefficients,
    vm,
    grid,
    points,
    dirs,
    with_colour,
    low,
    high,
    features,
    basis,
    sh,
    sigma,
    rgb,
):
    """`query` for points low..high."""
    for i in range(low, high):
        x, y, z = float(points[i, 0]), float(points[i, 1]), float(points[i, 2])
        dx, dy, dz = float(dirs[i, 0]), float(dirs[i, 1]), float(dirs[i, 2])
        n = i + POINTS_AHEAD
        if n < high:
            px, py, pz = float(points[n, 0]), float(points[n, 1]), float(points[n, 2])
            prefetch_planes(ranks, vm, vm.params, DENSITY, 0, px, py, pz)
            if with_colour:
                prefetch_planes(colour_ranks, vm, vm.params, COLOUR, 0, px, py, pz)
        sigma[i] = 0
        rgb[i, 0], rgb[i, 1], rgb[i, 2] = 0, 0, 0
        if not occupied(grid, x, y, z):
            continue
        b, s, _, _ = winning_block(ranks, vm, grid, x, y, z, dx, dy, dz)
        sigma[i] = s
        if with_colour and s > 0:
            u, v, w, _ = unit_point(vm, b, x, y, z)
            directional_basis(colour_ranks, coefficients, vm, b, dx, dy, dz, basis, sh)
            colour_features(colour_ranks, vm, vm.tensor[b], u, v, w, features, 0)
            for c in range(3):
                rgb[i, c] = sigmoid(dot_row(colour_ranks, basis, c, features, 0))


@loop
def query(ranks, colour_ranks, coefficients, vm, grid, points, dirs, with_colour, sigma, rgb):
    """σ (1/length) and rgb of a VM field at points (N, 3) seen along dirs (N, 3); both 0 where the grid is
    empty."""
    n = points.shape[0]
    width = 3 * len(colour_ranks)
    for part in prange((n + POINTS_PER_TASK - 1) // POINTS_PER_TASK):
        kind = vm.params.dtype
        features, basis, sh = np.empty(width, kind), np.empty(3 * width, kind), np.empty(16, kind)
        low, high = part * POINTS_PER_TASK, min(n, (part + 1) * POINTS_PER_TASK)
        query_task(
            ranks,
            colour_ranks,
            coefficients,
            vm,
            grid,
            points,
            dirs,
            with_colour,
            low,
            high,
            features,
            basis,
            sh,
            sigma,
            rgb,
        )


@task
def occupied(grid, x, y, z):
    """Whether a point lies in the grid's box, in a cell that is not empty."""
    nx, ny, nz = grid.skip.shape
    i = int(math.floor((x - grid.lo[0]) / grid.cell[0]))
    j = int(math.floor((y - grid.lo[1]) / grid.cell[1]))
    m = int(math.floor((z - grid.lo[2]) / grid.cell[2]))
    return 0 <= i < nx and 0 <= j < ny and 0 <= m < nz and grid.skip[i, j, m] == 0


@task
def query_backward_task(
    ranks, colour_ranks, coefficients, vm, grid, points, dirs, d_sigma, d_rgb, low, high, grad, features,
    d_features, basis, d_basis, sh, d_f, scratch,
):  # fmt: skip
    """`query_backward` for points low..high, into one row of gradients."""
    for i in range(low, high):
        x, y, z = float(points[i, 0]), float(points[i, 1]), float(points[i, 2])
        dx, dy, dz = float(dirs[i, 0]), float(dirs[i, 1]), float(dirs[i, 2])
        n = i + POINTS_AHEAD
        if n < high:
            px, py, pz = float(points[n, 0]), float(points[n, 1]), float(points[n, 2])
            prefetch_planes(ranks, vm, vm.params, DENSITY, 0, px, py, pz)
            prefetch_planes(ranks, vm, grad, DENSITY, 0, px, py, pz)
            if d_rgb[n, 0] != 0 or d_rgb[n, 1] != 0 or d_rgb[n, 2] != 0:
                prefetch_planes(colour_ranks, vm, vm.params, COLOUR, 0, px, py, pz)
                prefetch_planes(colour_ranks, vm, grad, COLOUR, 0, px, py, pz)
        if not occupied(grid, x, y, z):
            continue
        b, s, f, _ = winning_block(ranks, vm, grid, x, y, z, dx, dy, dz)
        u, v, w, inside = unit_point(vm, b, x, y, z)
        if not inside or s == 0:
            continue
        t = vm.tensor[b]
        stretch = object_direction(vm, b, dx, dy, dz)[3]
        d_f[0] = d_sigma[i] * stretch * vm.density[t, 0] * sigmoid(f + vm.density[t, 1])
        scatter_density(ranks, vm, grad, t, u, v, w, d_f, 0, scratch)
        if s > 0 and (d_rgb[i, 0] != 0 or d_rgb[i, 1] != 0 or d_rgb[i, 2] != 0):
            directional_basis(colour_ranks, coefficients, vm, b, dx, dy, dz, basis, sh)
            colour_features(colour_ranks, vm, t, u, v, w, features, 0)
            clear(d_basis)
            shade_backward(
                colour_ranks, basis, features, 0, d_rgb[i, 0], d_rgb[i, 1], d_rgb[i, 2], d_features, d_basis
            )
            scatter_colour(colour_ranks, vm, grad, t, u, v, w, d_features, 0, scratch)
            scatter_basis(colour_ranks, coefficients, vm, grad, b, sh, d_basis)


@task
def clear(values):
    """Set a vector to zero."""
    for i in range(values.shape[0]):
        values[i] = 0


@loop
def query_backward(ranks, colour_ranks, coefficients, vm, grid, points, dirs, d_sigma, d_rgb, grads):
    """Adjoint of `query`: adds to row p of grads (parts, P) what d_sigma (N,), d_rgb (N, 3) of part p's
    points send back."""
    n = points.shape[0]
    parts = grads.shape[0]
    width = 3 * len(colour_ranks)
    for p in prange(parts):
        kind = vm.params.dtype
        query_backward_task(
            ranks, colour_ranks, coefficients, vm, grid, points, dirs, d_sigma, d_rgb, p * n // parts,
            (p + 1) * n // parts, grads[p], np.empty(width, kind), np.empty(width, kind),
            np.empty(3 * width, kind), np.empty(3 * width, kind), np.empty(16, kind), np.empty(1, kind),
            np.empty(2 * max(len(ranks), len(colour_ranks)), kind),
        )  # fmt: skip


@task
def shade_backward(colour_ranks, basis, features, base, d_r, d_g, d_b, d_features, d_basis):
    """Adjoint of rgb_c = sigmoid(<basis_c, features[base:]>): sets d_features, adds to d_basis."""
    rank = len(colour_ranks)
    real = basis.dtype.type
    for r in range(np.uint64(3 * rank)):
        d_features[r] = 0
    for c in range(3):
        rgb = sigmoid(dot_row(colour_ranks, basis, c, features, base))
        d = d_r if c == 0 else (d_g if c == 1 else d_b)
        d_logit = real(d * rgb * (1 - rgb))
        for mode in range(3):
            at = np.uint64(mode * rank)
            row = np.uint64(3 * c * rank) + at
            add_scaled(colour_ranks, d_features, at, d_logit, basis, row)
            add_scaled(colour_ranks, d_basis, row, d_logit, features, np.uint64(base) + at)


@task
def render_task(
    ranks, colour_ranks, coefficients, vm, grid, rays_o, rays_d, near, step, early_stop, low, high,
    features, basis, sh, out,
):  # fmt: skip
    """`render` for rays low..high."""
    for i in range(low, high):
        ox, oy, oz = rays_o[i, 0], rays_o[i, 1], rays_o[i, 2]
        dx, dy, dz = rays_d[i, 0], rays_d[i, 1], rays_d[i, 2]
        t0, t1 = hit_box(ox, oy, oz, dx, dy, dz, grid.lo, grid.hi)
        t0 = max(t0, near) + 0.5 * step
        red, green, blue, depth = 0.0, 0.0, 0.0, 0.0
        trans = 1.0
        waiting = 0.0  # as in train_task
        current = -1
        k = next_sample(grid, ox, oy, oz, dx, dy, dz, t0, t1, step, 0)
        while k >= 0 and trans > early_stop:
            t = t0 + k * step
            x, y, z = ox + t * dx, oy + t * dy, oz + t * dz
            b, s, _, steps = winning_block(ranks, vm, grid, x, y, z, dx, dy, dz)
            alpha = 1.0 - math.exp(-s * steps * step)
            weight = trans * alpha
            trans -= weight
            depth += weight * t
            waiting += weight
            if waiting > COLOUR_FROM:
                if b != current:
                    directional_basis(colour_ranks, coefficients, vm, b, dx, dy, dz, basis, sh)
                    current = b
                u, v, w, _ = unit_point(vm, b, x, y, z)
                colour_features(colour_ranks, vm, vm.tensor[b], u, v, w, features, 0)
                red += waiting * sigmoid(dot_row(colour_ranks, basis, 0, features, 0))
                green += waiting * sigmoid(dot_row(colour_ranks, basis, 1, features, 0))
                blue += waiting * sigmoid(dot_row(colour_ranks, basis, 2, features, 0))
                waiting = 0.0
            k = next_sample(grid, ox, oy, oz, dx, dy, dz, t0, t1, step, k + steps)
        out[i, 0], out[i, 1], out[i, 2], out[i, 3], out[i, 4] = red, green, blue, 1.0 - trans, depth


@loop
def render(ranks, colour_ranks, coefficients, vm, grid, rays_o, rays_d, near, step, early_stop, out):
    """March, shade and composite rays in one pass: out (N, 5) is premultiplied rgb, opacity, and Σ w t (over
    opacity: mean depth).

    Stops at a remaining transmittance of `early_stop`; samples sit at the middle of each step.
    """
    n = rays_o.shape[0]
    width = 3 * len(colour_ranks)
    for part in prange((n + RAYS_PER_TASK - 1) // RAYS_PER_TASK):
        kind = vm.params.dtype
        features, basis, sh = np.empty(width, kind), np.empty(3 * width, kind), np.empty(16, kind)
        low, high = part * RAYS_PER_TASK, min(n, (part + 1) * RAYS_PER_TASK)
        render_task(
            ranks,
            colour_ranks,
            coefficients,
            vm,
            grid,
            rays_o,
            rays_d,
            near,
            step,
            early_stop,
            low,
            high,
            features,
            basis,
            sh,
            out,
        )


@task
def train_task(
    ranks, colour_ranks, coefficients, vm, grid, rays_o, rays_d, near, jitter, step, early_stop, target,
    background, opacity_weight, low, high, ts, pre, weights, carried, rgbs, blocks, slots, spans, features,
    d_features,
    basis, d_basis, sh, d_f, scratch, grad, loss,
):  # fmt: skip
    """`train_rays` for rays low..high, into one row of gradients and losses."""
    n = rays_o.shape[0]
    width = 3 * len(colour_ranks)
    real = vm.params.dtype.type
    for i in range(low, high):
        ox, oy, oz = rays_o[i, 0], rays_o[i, 1], rays_o[i, 2]
        dx, dy, dz = rays_d[i, 0], rays_d[i, 1], rays_d[i, 2]
        t0, t1 = hit_box(ox, oy, oz, dx, dy, dz, grid.lo, grid.hi)
        t0 = max(t0, near) + jitter[i] * step
        red, green, blue = 0.0, 0.0, 0.0
        trans = 1.0
        current = -1
        count = 0
        shaded = 0
        waiting = (
            0.0  # weight of samples too light to be shaded alone; the next shaded one gives them its colour
        )
        k = next_sample(grid, ox, oy, oz, dx, dy, dz, t0, t1, step, 0)
        while k >= 0 and trans > early_stop and count < ts.shape[0]:
            t = t0 + k * step
            x, y, z = ox + t * dx, oy + t * dy, oz + t * dz
            b, s, f, steps = winning_block(ranks, vm, grid, x, y, z, dx, dy, dz)
            ahead = SAMPLES_AHEAD * steps * step
            prefetch_planes(ranks, vm, vm.params, DENSITY, b, x + ahead * dx, y + ahead * dy, z + ahead * dz)
            prefetch_planes(ranks, vm, grad, DENSITY, b, x, y, z)
            weight = trans * (1.0 - math.exp(-s * steps * step))
            trans -= weight
            ts[count], pre[count], weights[count], blocks[count], slots[count] = t, f, weight, b, -1
            spans[count] = steps
            waiting += weight
            if waiting > COLOUR_FROM:
                if b != current:
                    directional_basis(colour_ranks, coefficients, vm, b, dx, dy, dz, basis, sh)
                    current = b
                u, v, w, _ = unit_point(vm, b, x, y, z)
                base = shaded * width
                prefetch_planes(colour_ranks, vm, grad, COLOUR, b, x, y, z)
                colour_features(colour_ranks, vm, vm.tensor[b], u, v, w, features, base)
                rgbs[count, 0] = sigmoid(dot_row(colour_ranks, basis, 0, features, base))
                rgbs[count, 1] = sigmoid(dot_row(colour_ranks, basis, 1, features, base))
                rgbs[count, 2] = sigmoid(dot_row(colour_ranks, basis, 2, features, base))
                red += waiting * rgbs[count, 0]
                green += waiting * rgbs[count, 1]
                blue += waiting * rgbs[count, 2]
                slots[count] = base
                carried[count] = waiting
                waiting = 0.0
                shaded += 1
            count += 1
            k = next_sample(grid, ox, oy, oz, dx, dy, dz, t0, t1, step, k + steps)

        e_r = red + trans * background[i, 0] - target[i, 0]
        e_g = green + trans * background[i, 1] - target[i, 1]
        e_b = blue + trans * background[i, 2] - target[i, 2]
        e_a = (1.0 - trans) - target[i, 3]
        loss[2] += count
        loss[0] += (e_r * e_r + e_g * e_g + e_b * e_b) / 3.0
        loss[1] += e_a * e_a
        if count == 0:
            continue
        scale = 2.0 / (3.0 * n)
        g_r, g_g, g_b = scale * e_r, scale * e_g, scale * e_b
        g_t = (
            g_r * background[i, 0]
            + g_g * background[i, 1]
            + g_b * background[i, 2]
            - 2.0 / n * opacity_weight * e_a
        )

        # Backwards along the ray: `behind` is the gradient's share of all that lies behind the sample, the
        # background too.
        behind = trans * g_t
        after = trans
        own = 0.0
        clear(d_basis)
        for q in range(count - 1, -1, -1):
            b = blocks[q]
            t = ts[q]
            u, v, w, inside = unit_point(vm, b, ox + t * dx, oy + t * dy, oz + t * dz)
            if slots[q] >= 0:
                own = g_r * rgbs[q, 0] + g_g * rgbs[q, 1] + g_b * rgbs[q, 2]
                if b != current:
                    scatter_basis(colour_ranks, coefficients, vm, grad, current, sh, d_basis)
                    directional_basis(colour_ranks, coefficients, vm, b, dx, dy, dz, basis, sh)
                    clear(d_basis)
                    current = b
                wq = carried[q]
                shade_backward(
                    colour_ranks, basis, features, slots[q], g_r * wq, g_g * wq, g_b * wq, d_features, d_basis
                )
                scatter_colour(colour_ranks, vm, grad, vm.tensor[b], u, v, w, d_features, 0, scratch)
            d_sigma = spans[q] * step * (after * own - behind)
            behind += weights[q] * own
            after += weights[q]
            if inside and weights[q] > 0.0:  # where no block is asked, none learns
                tensor = vm.tensor[b]
                slope = object_direction(vm, b, dx, dy, dz)[3] * vm.density[tensor, 0]
                d_f[0] = real(d_sigma * slope * sigmoid(pre[q] + vm.density[tensor, 1]))
                if d_f[0] != 0:
                    scatter_density(ranks, vm, grad, tensor, u, v, w, d_f, 0, scratch)
        if shaded > 0:
            scatter_basis(colour_ranks, coefficients, vm, grad, current, sh, d_basis)


@loop
def train_rays(
    ranks, colour_ranks, coefficients, vm, grid, rays_o, rays_d, near, jitter, step, early_stop, target,
    background, opacity_weight, max_samples, grads, loss,
):  # fmt: skip
    """One pass over rays: render, compare, and add the gradient of the loss to row p of grads (parts, P).

    The loss of a ray is mean_c (C_c + (1 - A) background_c - target_c)^2 + opacity_weight (A - target_3)^2,
    with A the opacity; target is (N, 4): rgb over the ray's background (N, 3), and the captured alpha. loss
    (parts, 3) gains the sums of the colour term, of the opacity term and of the samples taken. jitter (N,) in
    [0, 1) shifts the samples by a share of a step.
    """
    n = rays_o.shape[0]
    parts = grads.shape[0]
    width = 3 * len(colour_ranks)
    for p in prange(parts):
        kind = vm.params.dtype
        ts, pre, weights = np.empty(max_samples), np.empty(max_samples), np.empty(max_samples)
        whole = np.empty((3, max_samples), np.int64)
        train_task(
            ranks, colour_ranks, coefficients, vm, grid, rays_o, rays_d, near, jitter, step, early_stop,
            target, background, opacity_weight, p * n // parts, (p + 1) * n // parts, ts, pre, weights,
            np.empty(max_samples), np.empty((max_samples, 3)), whole[0], whole[1], whole[2],
            np.empty(max_samples * width, kind), np.empty(width, kind), np.empty(3 * width, kind),
            np.empty(3 * width, kind), np.empty(16, kind),
            np.empty(1, kind), np.empty(2 * max(len(ranks), len(colour_ranks)), kind), grads[p], loss[p],
        )  # fmt: skip


@task
def adam_task(params, grads, moment1, moment2, rate, low, high, beta1, beta2, eps, correction1, correction2):
    """`adam` for entries low..high, a cache line at a time; lines that no part touched cost one read."""
    real = params.dtype.type
    one, zero = real(1), real(0)
    for line in range(low, high, LINE):
        start = np.uint64(line)
        touched = zero
        for p in range(grads.shape[0]):
            for i in range(np.uint64(LINE)):
                touched += abs(grads[p, start + i])
        if touched == zero:
            continue
        for p in range(1, grads.shape[0]):
            for i in range(np.uint64(LINE)):
                grads[0, start + i] += grads[p, start + i]
                grads[p, start + i] = zero
        for i in range(np.uint64(LINE)):
            g = grads[0, start + i]
            m, v = moment1[start + i], moment2[start + i]
            m_new = beta1 * m + (one - beta1) * g
            v_new = beta2 * v + (one - beta2) * g * g
            moment1[start + i] = m_new if g != zero else m
            moment2[start + i] = v_new if g != zero else v
            change = rate * (m_new * correction1) / (math.sqrt(v_new * correction2) + eps)
            params[start + i] -= change if g != zero else zero
            grads[0, start + i] = zero


@loop
def adam(params, grads, moment1, moment2, rate, low, high, beta1, beta2, eps, correction1, correction2):
    """Adam (Kingma and Ba 2015, alg. 1) on params[low:high], whole cache lines, summing and clearing the rows
    of grads (parts, P).

    An entry whose gradient is exactly 0 was touched by no sample: it and its moments keep their values (lazy
    Adam).
    """
    parts = (high - low + ENTRIES_PER_TASK - 1) // ENTRIES_PER_TASK
    for part in prange(parts):
        start = low + part * ENTRIES_PER_TASK
        end = min(high, start + ENTRIES_PER_TASK)
        adam_task(
            params, grads, moment1, moment2, rate, start, end, beta1, beta2, eps, correction1, correction2
        )


@task
def density_at_cells_task(ranks, vm, b, lo, cell, cells, low, high, offsets, out):
    """`density_at_cells` for cells low..high."""
    for i in range(low, high):
        best = 0.0
        for q in range(offsets.shape[0]):
            x = lo[0] + (cells[i, 0] + offsets[q, 0]) * cell[0]
            y = lo[1] + (cells[i, 1] + offsets[q, 1]) * cell[1]
            z = lo[2] + (cells[i, 2] + offsets[q, 2]) * cell[2]
            best = max(best, block_density(ranks, vm, b, x, y, z, 1.0)[0])
        out[i] = best


@loop
def density_at_cells(ranks, vm, b, lo, cell, cells, offsets, out):
    """Largest σ of block b, as if unstretched, over `offsets` (K, 3) in each of `cells` (N, 3) int64 of a
    grid: out (N,)."""
    n = cells.shape[0]
    for part in prange((n + POINTS_PER_TASK - 1) // POINTS_PER_TASK):
        low, high = part * POINTS_PER_TASK, min(n, (part + 1) * POINTS_PER_TASK)
        density_at_cells_task(ranks, vm, b, lo, cell, cells, low, high, offsets, out)


@task
def pinhole_task(pose, fl_x, fl_y, cx, cy, width, top, order, low, high, rays_o, rays_d):
    """`pinhole_rays` for rays low..high."""
    for i in range(low, high):
        row, column = order[i] // width, order[i] % width
        x, y = (column + 0.5 - cx) / fl_x, -(top + row + 0.5 - cy) / fl_y
        dx = pose[0, 0] * x + pose[0, 1] * y - pose[0, 2]
        dy = pose[1, 0] * x + pose[1, 1] * y - pose[1, 2]
        dz = pose[2, 0] * x + pose[2, 1] * y - pose[2, 2]
        length = math.sqrt(dx * dx + dy * dy + dz * dz)
        rays_d[i, 0], rays_d[i, 1], rays_d[i, 2] = dx / length, dy / length, dz / length
        rays_o[i, 0], rays_o[i, 1], rays_o[i, 2] = pose[0, 3], pose[1, 3], pose[2, 3]


@loop
def pinhole_rays(pose, fl_x, fl_y, cx, cy, width, top, order, rays_o, rays_d):
    """Rays (N, 3) of an undistorted camera at pose (4, 4), camera to world, OpenGL axes: ray i is that of
    pixel order[i] (N,), counted row by row of `width` pixels from row `top` on."""
    n = order.shape[0]
    for part in prange((n + POINTS_PER_TASK - 1) // POINTS_PER_TASK):
        low, high = part * POINTS_PER_TASK, min(n, (part + 1) * POINTS_PER_TASK)
        pinhole_task(pose, fl_x, fl_y, cx, cy, width, top, order, low, high, rays_o, rays_d)


@loop
def march(grid, rays_o, rays_d, near, jitter, step, start, alive, ts, counts):
    """The next samples of every living ray: ts (N, K) distances, counts (N,); start (N,) int64 is where to go
    on, -1 at the end."""
    for i in prange(rays_o.shape[0]):
        counts[i] = 0
        if not alive[i] or start[i] < 0:
            continue
        ox, oy, oz = rays_o[i, 0], rays_o[i, 1], rays_o[i, 2]
        dx, dy, dz = rays_d[i, 0], rays_d[i, 1], rays_d[i, 2]
        t0, t1 = hit_box(ox, oy, oz, dx, dy, dz, grid.lo, grid.hi)
        t0 = max(t0, near) + jitter[i] * step
        k = next_sample(grid, ox, oy, oz, dx, dy, dz, t0, t1, step, start[i])
        while k >= 0 and counts[i] < ts.shape[1]:
            ts[i, counts[i]] = t0 + k * step
            counts[i] += 1
            k = next_sample(grid, ox, oy, oz, dx, dy, dz, t0, t1, step, k + 1)
        start[i] = k


@task
def features_task(colour_ranks, vm, block, points, low, high, out):
    """`features` for points low..high."""
    width = 3 * len(colour_ranks)
    for i in range(low, high):
        u, v, w, inside = unit_point(vm, block, float(points[i, 0]), float(points[i, 1]), float(points[i, 2]))
        if inside:
            colour_features(colour_ranks, vm, vm.tensor[block], u, v, w, out, i * width)
        else:
            for r in range(np.uint64(width)):
                out[np.uint64(i * width) + r] = 0


@loop
def features(colour_ranks, vm, block, points, out):
    """Colour products of one block at points (N, 3): out (N * 3 rank,), 0 outside the block's box."""
    n = points.shape[0]
    for part in prange((n + POINTS_PER_TASK - 1) // POINTS_PER_TASK):
        low, high = part * POINTS_PER_TASK, min(n, (part + 1) * POINTS_PER_TASK)
        features_task(colour_ranks, vm, block, points, low, high, out)


@task
def features_backward_task(colour_ranks, vm, block, points, d_features, low, high, grad, scratch):
    """`features_backward` for points low..high, into one row of gradients."""
    width = 3 * len(colour_ranks)
    for i in range(low, high):
        u, v, w, inside = unit_point(vm, block, float(points[i, 0]), float(points[i, 1]), float(points[i, 2]))
        if inside:
            scatter_colour(colour_ranks, vm, grad, vm.tensor[block], u, v, w, d_features, i * width, scratch)


@loop
def features_backward(colour_ranks, vm, block, points, d_features, grads):
    """Adjoint of `features`: adds to row p of grads (parts, P) what d_features (N * 3 rank,) of part p's
    points send back."""
    n = points.shape[0]
    parts = grads.shape[0]
    for p in prange(parts):
        scratch = np.empty(2 * len(colour_ranks), vm.params.dtype)
        low, high = p * n // parts, (p + 1) * n // parts
        features_backward_task(colour_ranks, vm, block, points, d_features, low, high, grads[p], scratch)
