"""One item of work per body: a point, a ray, a cell, a cache line of parameters.

Called with the item's number from the CPU loops in `cpu.py` and from GPU threads in `cuda.py`; notation as in
bodies.py.

Scratch arrays come from the caller, so that nothing is allocated per item. Sums that several items share go
through `accumulate` and `add_scaled_8` of bodies.py, which `cuda.py` replaces by atomic ones.
"""

import math

import numpy as np

from fusedrf_cli.engine.kernels.bodies import (
    COLOUR_FROM,
    add_scaled,
    block_density,
    body,
    colour_features,
    compared,
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
from fusedrf_cli.engine.kernels.prefetch import COLOUR, DENSITY, LINE, prefetch_planes

SAMPLES_AHEAD = 2


@body
def query_point(
    ranks, colour_ranks, coefficients, vm, grid, points, dirs, with_colour, i, features, basis, sh, sigma, rgb
):  # fmt: skip
    """σ (1/length) and rgb of a VM field at point i; both 0 where the grid is empty."""
    x, y, z = float(points[i, 0]), float(points[i, 1]), float(points[i, 2])
    dx, dy, dz = float(dirs[i, 0]), float(dirs[i, 1]), float(dirs[i, 2])
    sigma[i] = 0
    rgb[i, 0], rgb[i, 1], rgb[i, 2] = 0, 0, 0
    if occupied(grid, x, y, z):
        b, s, _, _ = winning_block(ranks, vm, grid, x, y, z, dx, dy, dz)
        sigma[i] = s
        if with_colour and s > 0:
            u, v, w, _ = unit_point(vm, b, x, y, z)
            directional_basis(colour_ranks, coefficients, vm, b, dx, dy, dz, basis, sh)
            colour_features(colour_ranks, vm, vm.tensor[b], u, v, w, features, 0)
            for c in range(3):
                rgb[i, c] = sigmoid(dot_row(colour_ranks, basis, c, features, 0))


@body
def occupied(grid, x, y, z):
    """Whether a point lies in the grid's box, in a cell that is not empty."""
    nx, ny, nz = grid.skip.shape
    i = int(math.floor((x - grid.lo[0]) / grid.cell[0]))
    j = int(math.floor((y - grid.lo[1]) / grid.cell[1]))
    m = int(math.floor((z - grid.lo[2]) / grid.cell[2]))
    return 0 <= i < nx and 0 <= j < ny and 0 <= m < nz and grid.skip[i, j, m] == 0


@body
def query_point_backward(
    ranks, colour_ranks, coefficients, vm, grid, points, dirs, d_sigma, d_rgb, i, features, d_features,
    basis, d_basis, sh, d_f, scratch, grad,
):  # fmt: skip
    """Adjoint of `query_point`: adds to grad (P,) what d_sigma[i] and d_rgb[i] send back."""
    x, y, z = float(points[i, 0]), float(points[i, 1]), float(points[i, 2])
    dx, dy, dz = float(dirs[i, 0]), float(dirs[i, 1]), float(dirs[i, 2])
    if occupied(grid, x, y, z):
        b, s, f, _ = winning_block(ranks, vm, grid, x, y, z, dx, dy, dz)
        u, v, w, inside = unit_point(vm, b, x, y, z)
        if inside and s > 0:
            t = vm.tensor[b]
            stretch = object_direction(vm, b, dx, dy, dz)[3]
            d_f[0] = d_sigma[i] * stretch * vm.density[t, 0] * sigmoid(f + vm.density[t, 1])
            scatter_density(ranks, vm, grad, t, u, v, w, d_f, 0, scratch)
            if d_rgb[i, 0] != 0 or d_rgb[i, 1] != 0 or d_rgb[i, 2] != 0:
                directional_basis(colour_ranks, coefficients, vm, b, dx, dy, dz, basis, sh)
                colour_features(colour_ranks, vm, t, u, v, w, features, 0)
                clear(d_basis)
                shade_backward(
                    colour_ranks, basis, features, 0, d_rgb[i, 0], d_rgb[i, 1], d_rgb[i, 2], d_features,
                    d_basis,
                )  # fmt: skip
                scatter_colour(colour_ranks, vm, grad, t, u, v, w, d_features, 0, scratch)
                scatter_basis(colour_ranks, coefficients, vm, grad, b, sh, d_basis)


@body
def clear(values):
    """Set a vector to zero."""
    for i in range(values.shape[0]):
        values[i] = 0


@body
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


@body
def render_ray(
    ranks, colour_ranks, coefficients, vm, grid, rays_o, rays_d, near, step, early_stop, i, features, basis,
    sh, out,
):  # fmt: skip
    """Marches, shades and composites ray i in one pass: out[i] is premultiplied rgb, opacity, Σ w t."""
    ox, oy, oz = rays_o[i, 0], rays_o[i, 1], rays_o[i, 2]
    dx, dy, dz = rays_d[i, 0], rays_d[i, 1], rays_d[i, 2]
    t0, t1 = hit_box(ox, oy, oz, dx, dy, dz, grid.lo, grid.hi)
    t0 = max(t0, near) + 0.5 * step
    red, green, blue, depth = 0.0, 0.0, 0.0, 0.0
    trans = 1.0
    waiting = 0.0  # as in train_ray
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


@body
def train_ray(
    ranks, colour_ranks, coefficients, vm, grid, rays_o, rays_d, near, jitter, step, early_stop, target,
    background, opacity_weight, i, ts, pre, weights, carried, rgbs, blocks, slots, spans, features,
    d_features, basis, d_basis, sh, d_f, scratch, grad, loss,
):  # fmt: skip
    """Ray i of `train_rays` in cpu.py: forward, compare, and backward along the ray into grad (P,).

    ts to spans hold what the backward sweep needs of every sample. features holds the colour features of as
    many shaded samples as fit; the last slot serves all beyond, whose features are then computed twice.
    """
    width = 3 * len(colour_ranks)
    last = features.shape[0] - width
    ox, oy, oz = rays_o[i, 0], rays_o[i, 1], rays_o[i, 2]
    dx, dy, dz = rays_d[i, 0], rays_d[i, 1], rays_d[i, 2]
    t0, t1 = hit_box(ox, oy, oz, dx, dy, dz, grid.lo, grid.hi)
    t0 = max(t0, near) + jitter[i] * step
    red, green, blue = 0.0, 0.0, 0.0
    trans = 1.0
    current = -1
    count = 0
    shaded = 0
    waiting = 0.0  # weight of samples too light to be shaded; the next shaded one lends them its colour
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
            base = min(shaded * width, last)
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

    g_r, g_g, g_b, g_t = compared(
        red, green, blue, trans, target, background, opacity_weight, i, count, loss
    )
    if count > 0:
        train_ray_backward(
            ranks, colour_ranks, coefficients, vm, ox, oy, oz, dx, dy, dz, step, trans, g_r, g_g, g_b, g_t,
            count, shaded, current, ts, pre, weights, carried, rgbs, blocks, slots, spans, features,
            d_features, basis, d_basis, sh, d_f, scratch, grad,
        )  # fmt: skip


@body
def train_ray_backward(
    ranks, colour_ranks, coefficients, vm, ox, oy, oz, dx, dy, dz, step, trans, g_r, g_g, g_b, g_t, count,
    shaded, current, ts, pre, weights, carried, rgbs, blocks, slots, spans, features, d_features, basis,
    d_basis, sh, d_f, scratch, grad,
):  # fmt: skip
    """The backward sweep of `train_ray`.

    g_r to g_b are the gradient of the loss in the ray's colour, g_t that in the transmittance behind it;
    `behind` gathers the share of all that lies behind a sample.
    """
    real = vm.params.dtype.type
    last = features.shape[0] - 3 * len(colour_ranks)
    overwritten = shaded * 3 * len(colour_ranks) > features.shape[0]
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
            if overwritten and slots[q] == last:
                colour_features(colour_ranks, vm, vm.tensor[b], u, v, w, features, last)
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


@body
def adam_line(params, grads, moment1, moment2, rate, start, beta1, beta2, eps, correction1, correction2):
    """`adam` of cpu.py for the cache line that starts at entry `start`; one that no part touched costs one
    read."""
    real = params.dtype.type
    one, zero = real(1), real(0)
    touched = zero
    for p in range(grads.shape[0]):
        for i in range(np.uint64(LINE)):
            touched += abs(grads[p, start + i])
    if touched == zero:
        return
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


@body
def cell_density(ranks, vm, b, lo, cell, cells, i, offsets, out):
    """Largest σ of block b, as if unstretched, over `offsets` (K, 3) in cell i."""
    best = 0.0
    for q in range(offsets.shape[0]):
        x = lo[0] + (cells[i, 0] + offsets[q, 0]) * cell[0]
        y = lo[1] + (cells[i, 1] + offsets[q, 1]) * cell[1]
        z = lo[2] + (cells[i, 2] + offsets[q, 2]) * cell[2]
        best = max(best, block_density(ranks, vm, b, x, y, z, 1.0)[0])
    out[i] = best


@body
def march_ray(grid, rays_o, rays_d, near, jitter, step, alive, i, start, ts, counts):
    """The next samples of ray i, from lattice index start[i] on: distances ts[i], as many as counts[i]."""
    counts[i] = 0
    if not alive[i] or start[i] < 0:
        return
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


@body
def features_point(colour_ranks, vm, block, points, i, out):
    """Colour products of a block at point i into out (N * 3 rank,), 0 outside the block's box."""
    width = 3 * len(colour_ranks)
    u, v, w, inside = unit_point(vm, block, float(points[i, 0]), float(points[i, 1]), float(points[i, 2]))
    if inside:
        colour_features(colour_ranks, vm, vm.tensor[block], u, v, w, out, i * width)
    else:
        for r in range(np.uint64(width)):
            out[np.uint64(i * width) + r] = 0


@body
def features_point_backward(colour_ranks, vm, block, points, d_features, i, scratch, grad):
    """Adjoint of `features_point`: adds to grad (P,)."""
    width = 3 * len(colour_ranks)
    u, v, w, inside = unit_point(vm, block, float(points[i, 0]), float(points[i, 1]), float(points[i, 2]))
    if inside:
        scatter_colour(colour_ranks, vm, grad, vm.tensor[block], u, v, w, d_features, i * width, scratch)


@body
def pinhole_ray(pose, fl_x, fl_y, cx, cy, width, top, order, i, rays_o, rays_d):
    """The ray of pixel order[i]; see `pinhole_rays` in cpu.py."""
    row, column = order[i] // width, order[i] % width
    x, y = (column + 0.5 - cx) / fl_x, -(top + row + 0.5 - cy) / fl_y
    dx = pose[0, 0] * x + pose[0, 1] * y - pose[0, 2]
    dy = pose[1, 0] * x + pose[1, 1] * y - pose[1, 2]
    dz = pose[2, 0] * x + pose[2, 1] * y - pose[2, 2]
    length = math.sqrt(dx * dx + dy * dy + dz * dz)
    rays_d[i, 0], rays_d[i, 1], rays_d[i, 2] = dx / length, dy / length, dz / length
    rays_o[i, 0], rays_o[i, 1], rays_o[i, 2] = pose[0, 3], pose[1, 3], pose[2, 3]
