"""Splats that are moved, turned, scaled, mirrored or stretched by a linear map."""

from dataclasses import replace

import numpy as np

from formats.rotations import matrices, quaternions
from formats.splats.harmonics import turned
from formats.splats.splats import Splats, thickened


def keeps_shapes(matrix: np.ndarray) -> bool:
    """Whether a (3, 3) linear map is a rotation or a mirror, times a size."""
    sizes = np.linalg.svd(matrix, compute_uv=False)
    return bool(sizes[0] - sizes[2] <= 1e-5 * sizes[0])


def placed(splats: Splats, matrix: np.ndarray) -> Splats:
    """Splats where a (4, 4) affine map A x + t puts them: covariances are A Σ Aᵀ, and a splat shows along A d
    what it showed along d. Exact where A keeps shapes; otherwise colours turn as by the nearest rotation or
    mirror.

    Σ is R S² Rᵀ, and A R S = U D Vᵀ gives U D² Uᵀ. U is a rotation, or a mirror, for which -U stands.
    """
    linear = np.asarray(matrix, np.float64)[:3, :3]
    left, _, right = np.linalg.svd(linear)
    axes = matrices(np.roll(splats.rotations, -1, axis=1))
    if keeps_shapes(linear):  # so that axes keep their order
        u, scales = (left @ right) @ axes, splats.scales * np.cbrt(np.abs(np.linalg.det(linear)))
    else:
        u, scales, _ = np.linalg.svd(linear @ (axes * splats.scales[:, None]))
    u = u * np.sign(np.linalg.det(u))[:, None, None]
    centres = splats.centres.astype(np.float64) @ linear.T + matrix[:3, 3]
    return replace(
        splats,
        centres=centres.astype(np.float32),
        scales=thickened(scales),
        rotations=np.roll(quaternions(u), 1, axis=1).astype(np.float32),
        harmonics=turned(splats.harmonics, left @ right),
    )
