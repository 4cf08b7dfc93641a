"""What the systems of hash grids compute, in plain numpy after their formulas: harmonics, grids, networks and
cascades of cells. And what an import answers."""

import itertools

import numpy as np
import torch

from fusedrf_cli.scene import open_scene


def harmonics(d: np.ndarray) -> np.ndarray:
    """(N, 16) of degree 4, as tiny-cuda-nn and torch-ngp have them."""
    x, y, z = d.T
    xx, yy, zz = x * x, y * y, z * z
    return np.stack([
        0.28209479177387814 + 0 * x, -0.48860251190291987 * y, 0.48860251190291987 * z,
        -0.48860251190291987 * x, 1.0925484305920792 * x * y, -1.0925484305920792 * y * z,
        0.94617469575755997 * zz - 0.31539156525251999, -1.0925484305920792 * x * z,
        0.54627421529603959 * (xx - yy), 0.59004358992664352 * y * (yy - 3 * xx),
        2.8906114426405538 * x * y * z, 0.45704579946446572 * y * (1 - 5 * zz),
        0.3731763325901154 * z * (5 * zz - 3), 0.45704579946446572 * x * (1 - 5 * zz),
        1.4453057213202769 * z * (xx - yy), 0.59004358992664352 * x * (3 * yy - xx),
    ], 1)  # fmt: skip


def grid(
    u: np.ndarray, tables: list[np.ndarray], scales: list[float], sides: list[int], offset: float = 0.5,
    always: bool = False, never: bool = False,
) -> np.ndarray:  # fmt: skip
    """(N, L F) features at points u (N, 3) of the unit cube: a table (rows, F) a level; always: hashed,
    however few vertices there are; never: not hashed, however many."""
    features = []
    for table, scale, side in zip(tables, scales, sides, strict=True):
        at = u * scale + offset
        cell, total = np.floor(at), 0.0
        for corner in itertools.product((0, 1), repeat=3):
            weight = np.where(corner, at - cell, 1 - (at - cell)).prod(1)
            total = total + weight[:, None] * table[rows_at(cell + corner, side, len(table), always, never)]
        features.append(total)
    return np.concatenate(features, 1)


def rows_at(vertices: np.ndarray, side: int, rows: int, always: bool, never: bool) -> np.ndarray:
    """The row (N,) of each vertex (N, 3), counted in 32 bits as the kernels do."""
    made = []
    for x, y, z in vertices.astype(int).tolist():
        stride, index = 1, 0
        for n in (x, y, z):
            if stride <= rows:
                index, stride = (index + n * stride) % 2**32, stride * side % 2**32
        if always or rows < stride and not never:
            index = x ^ (y * 2654435761 % 2**32) ^ (z * 805459861 % 2**32)
        made.append(index % rows)
    return np.array(made)


def network(x: np.ndarray, *layers: np.ndarray, biases: list | None = None) -> np.ndarray:
    """Layers (outputs, inputs), rectified but for the last."""
    for i, layer in enumerate(layers):
        x = x @ layer.T.astype(np.float64) + (0 if biases is None else biases[i])
        x = np.maximum(x, 0) if i < len(layers) - 1 else x
    return x


def morton(i: int, j: int, k: int) -> int:
    """The place of a cell in Morton order."""
    return sum((n >> bit & 1) << 3 * bit + axis for axis, n in enumerate((i, j, k)) for bit in range(10))


def occupied(points: np.ndarray, bits: np.ndarray, bound: float) -> np.ndarray:
    """(N,) whether points around 0 lie in an occupied cell of cascades (C, S³), the first out to ±1."""
    cascades, side = len(bits), round(bits.shape[1] ** (1 / 3))
    found = []
    for p in points:
        level = min(max(int(np.frexp(np.abs(p).max())[1]), 0), cascades - 1)
        half = min(2.0**level, bound)
        cell = np.clip(np.floor(0.5 * (p / half + 1) * side), 0, side - 1).astype(int)
        found.append(bits[level, morton(*cell.tolist())] and np.abs(p).max() <= bound)
    return np.array(found)


def sigmoid(x: np.ndarray) -> np.ndarray:
    return 1 / (1 + np.exp(-x))


def directions(rng, count: int) -> np.ndarray:
    d = rng.normal(size=(count, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def answers(imported, points: np.ndarray, dirs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """σ (N,) and rgb (N, 3) of an import, by the torch references of its fields in float64."""
    sigma, rgb = np.zeros(len(points)), np.zeros((len(points), 3))
    for node in imported.nodes:
        field, back = node.field, np.linalg.inv(node.object_to_world)
        at, along = points @ back[:3, :3].T + back[:3, 3], dirs @ back[:3, :3].T
        length = np.linalg.norm(along, axis=1)
        at, along = torch.from_numpy(at), torch.from_numpy(along / length[:, None])
        own, colour = field.with_params(field.params.double()).answers(field.params.double(), at, along)
        own = own.numpy() * length
        rgb[own > sigma], sigma = colour.numpy()[own > sigma], np.maximum(own, sigma)
    return sigma, rgb


def asked(path, points: np.ndarray, dirs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The same of a bundle, by its torch references in float32: nothing is compiled where points learn."""
    sigma, rgb = open_scene(path).query(torch.from_numpy(points).requires_grad_(), torch.from_numpy(dirs))
    return sigma.detach().numpy(), rgb.detach().numpy()


def assert_alike(found, expected, rtol: float = 1e-4) -> None:
    """That σ is the same, 0 where it is, and the colour where something is."""
    sigma, rgb = found
    assert (expected[0] > 0).mean() > 0.15
    np.testing.assert_array_equal(sigma > 0, expected[0] > 0)
    np.testing.assert_allclose(sigma, expected[0], rtol=rtol)
    shown = expected[0] > 0
    np.testing.assert_allclose(rgb[shown], expected[1][shown], atol=rtol)
