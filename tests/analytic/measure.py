"""What a field answers, put in figures that can be held against a truth."""

import numpy as np
import torch

from fusedrf_cli.engine.fields.base import RadianceField
from fusedrf_cli.engine.rendering.cameras import Camera
from fusedrf_cli.engine.rendering.volume import render_image

WHITE = (1.0, 1.0, 1.0)
LSB = 1 / 255  # one level of an 8-bit picture
ORIGIN = np.zeros(3)


def answers(field: RadianceField, points: np.ndarray, dirs: np.ndarray, origin=ORIGIN):
    """σ (N,) and rgb (N, 3) float64 of a field at world points along unit dirs (N, 3); origin (3,) is the
    world position of the field's frame."""
    sigma, rgb = field.query(
        torch.from_numpy(np.ascontiguousarray(points - origin)), torch.from_numpy(np.ascontiguousarray(dirs))
    )
    return sigma.double().numpy(), rgb.double().numpy()


def depth_along(
    field: RadianceField, rays_o: np.ndarray, rays_d: np.ndarray, spans: np.ndarray, origin=ORIGIN, nodes=160
) -> np.ndarray:
    """(N,) optical depth of a field along world rays (N, 3) between two distances each (N, 2), by
    Gauss-Legendre quadrature: exact where σ is even, and for a blob to many digits."""
    at, weights = np.polynomial.legendre.leggauss(nodes)
    half, middle = (spans[:, 1] - spans[:, 0])[:, None] / 2, spans.mean(1)[:, None]
    t = middle + half * at
    points = rays_o[:, None] + t[..., None] * rays_d[:, None]
    dirs = np.broadcast_to(rays_d[:, None], points.shape)
    sigma, _ = answers(field, points.reshape(-1, 3), dirs.reshape(-1, 3), origin)
    return (sigma.reshape(t.shape) * weights * half).sum(1)


def photo(field: RadianceField, camera: Camera, origin=ORIGIN, background=WHITE, **options) -> np.ndarray:
    """(H, W, 3) picture of a field in the world over a background; options are `render_image`'s."""
    return render_image(field, camera, origin=origin, **options).over(background)


def worst_relative(found: np.ndarray, wanted: np.ndarray, floor: float = 1e-3) -> float:
    """Largest |found - wanted| / wanted where wanted is above a floor of its own largest."""
    counts = wanted > floor * wanted.max()
    return float((np.abs(found - wanted)[counts] / wanted[counts]).max())
