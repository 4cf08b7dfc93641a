"""Asking imports at points of the world, to compare them with the formulas of the systems that wrote them."""

import numpy as np
import torch


def directions(count: int, seed: int = 9) -> np.ndarray:
    """(N, 3) of length 1."""
    made = np.random.default_rng(seed).normal(size=(count, 3))
    return made / np.linalg.norm(made, axis=1, keepdims=True)


def answers(node, points: np.ndarray, dirs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """σ (N,) per length of the world and colours (N, 3) of a placed field at points (N, 3) of the world."""
    back = np.linalg.inv(node.object_to_world)
    at, ahead = points @ back[:3, :3].T + back[:3, 3], dirs @ back[:3, :3].T
    stretch = np.linalg.norm(ahead, axis=1)
    numbers = torch.from_numpy(at), torch.from_numpy(ahead / stretch[:, None])
    with torch.no_grad():
        sigma, rgb = node.field.answers(node.field.params.double(), *numbers)
    return sigma.numpy() * stretch, rgb.numpy()


def assert_equal(found: tuple, wanted: tuple, both: bool = True) -> None:
    """That σ and, where there is any, colours are the same, and σ is 0 where it should be; both: there are
    points where it is, and where it is not."""
    (sigma, rgb), (expected, colours) = found, wanted
    solid = expected > 0
    assert solid.sum() > 20 and ((~solid).sum() > 5 or not both)
    np.testing.assert_array_equal(sigma[~solid], 0)
    np.testing.assert_allclose(sigma[solid], expected[solid], rtol=1e-4, atol=1e-6 * expected.max())
    np.testing.assert_allclose(rgb[solid], colours[solid], atol=1e-4)


def sigmoid(x: np.ndarray) -> np.ndarray:
    return 1 / (1 + np.exp(-x))


def softplus(x: np.ndarray) -> np.ndarray:
    return np.logaddexp(0, x)


def dense(state: dict, name: str, x: np.ndarray) -> np.ndarray:
    """torch's nn.Linear of a state dict."""
    y = x @ state[f"{name}.weight"].double().numpy().T
    return y + state[f"{name}.bias"].double().numpy() if f"{name}.bias" in state else y


def rectified(x: np.ndarray) -> np.ndarray:
    return np.maximum(x, 0)


def layer(state: dict, name: str, inputs: int, outputs: int, bias: bool = True) -> None:
    """Add an nn.Linear of random numbers to a state dict."""
    draw = torch.Generator().manual_seed(len(state) + 7 * inputs)
    state[f"{name}.weight"] = torch.randn(outputs, inputs, generator=draw) * (2 / max(inputs, 1)) ** 0.5
    if bias:
        state[f"{name}.bias"] = 0.3 * torch.randn(outputs, generator=draw)
