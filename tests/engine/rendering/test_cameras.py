"""Cameras: pixels to rays and back, poses, rasters."""

import numpy as np
import pytest

from fusedrf_cli.engine.rendering.cameras import Camera, framing_camera, look_at, orbit, scattered, undistort
from tests.engine.conftest import BOX, DIRECTIONS_26

DISTORTION = (-0.12, 0.05, -0.01, 0.003, -0.002)


def distort(u, v, distortion):
    """Brown-Conrady as OpenCV writes it: ideal to distorted normalised image coordinates (y down)."""
    k1, k2, k3, p1, p2 = distortion
    r2 = u * u + v * v
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    return u * radial + 2 * p1 * u * v + p2 * (r2 + 2 * u * u), v * radial + p1 * (
        r2 + 2 * v * v
    ) + 2 * p2 * u * v


def project(camera: Camera, points: np.ndarray) -> np.ndarray:
    """(N, 2) column and row coordinates of world points."""
    local = (points - camera.camera_to_world[:3, 3]) @ camera.camera_to_world[:3, :3]
    u, v = distort(local[:, 0] / -local[:, 2], -local[:, 1] / -local[:, 2], camera.distortion)
    return np.stack([camera.fl_x * u + camera.cx, camera.fl_y * v + camera.cy], 1)


def camera_at(distortion=(0.0,) * 5, width=23, height=17) -> Camera:
    pose = look_at(np.array([3.0, -2.0, 1.5]), np.array([0.1, 0.2, 0.0]), np.array([0.0, 0.0, 1.0]))
    return Camera(pose, 25.0, 27.0, 11.3, 8.9, width, height, distortion)


@pytest.mark.parametrize("distortion", [(0.0,) * 5, DISTORTION, (0.2, 0, 0, 0, 0)])
def test_undistort_inverts(distortion):
    u, v = np.random.default_rng(0).uniform(-0.6, 0.6, (2, 400))
    found = undistort(*distort(u, v, distortion), distortion)
    np.testing.assert_allclose(found, (u, v), atol=1e-6)


@pytest.mark.parametrize("distortion", [(0.0,) * 5, DISTORTION])
def test_the_ray_of_a_pixel_passes_what_projects_to_it(distortion):
    """A point anywhere along the ray of pixel (i, j) projects to (i + 0.5, j + 0.5)."""
    camera = camera_at(distortion)
    rays_o, rays_d = camera.rays()
    np.testing.assert_allclose(np.linalg.norm(rays_d, axis=1), 1, rtol=1e-12)
    row, column = np.divmod(np.arange(camera.width * camera.height), camera.width)
    for distance in (0.5, 4.0, 100.0):
        found = project(camera, rays_o + distance * rays_d)
        np.testing.assert_allclose(found, np.stack([column, row], 1) + 0.5, atol=1e-4)


def test_axes_are_opengls():
    """Unrotated, the middle looks along -z; columns run to +x and rows to -y."""
    camera = Camera(np.eye(4), 10.0, 10.0, 2.5, 1.5, 5, 3)
    rays_o, rays_d = camera.rays()
    d = rays_d.reshape(3, 5, 3)
    np.testing.assert_allclose(d[1, 2], [0, 0, -1])
    assert d[1, 4, 0] > 0 and d[0, 2, 1] > 0 and (rays_o == 0).all()


def test_bands_of_rows_are_parts_of_the_whole():
    camera = camera_at(DISTORTION)
    whole = camera.rays()
    bands = [camera.rays(slice(top, top + 5)) for top in range(0, 17, 5)]
    for i in range(2):
        assert np.array_equal(whole[i], np.concatenate([band[i] for band in bands]))


@pytest.mark.parametrize("up", np.eye(3))
def test_look_at_is_a_rotation_towards_the_target(up):
    for away in DIRECTIONS_26:
        target = np.array([0.3, -0.2, 0.1])
        pose = look_at(target + 2.5 * away, target, up)
        rotation = pose[:3, :3]
        np.testing.assert_allclose(rotation.T @ rotation, np.eye(3), atol=1e-12)
        assert np.linalg.det(rotation) == pytest.approx(1)
        np.testing.assert_allclose(pose[:3, 3] - 2.5 * pose[:3, 2], target, atol=1e-12)
        assert rotation[:, 1] @ up >= -1e-12


def test_framing_cameras_see_the_whole_box():
    corners = np.stack(np.meshgrid(*zip(BOX[:3], BOX[3:], strict=True)), -1).reshape(-1, 3)
    cameras = [
        framing_camera(BOX, a, e, w, h)
        for a in (0, 2)
        for e in (-1.2, 0.0, 1.5)
        for w, h in ((40, 30), (15, 31))
    ]
    for camera in [*cameras, *orbit(BOX, 3, 31, 17), *scattered(BOX, 3, 16, 16, seed=1)]:
        at = project(camera, 0.9 * corners + 0.1 * corners.mean(0))
        assert (at > 0).all() and (at < [camera.width, camera.height]).all()
        np.testing.assert_allclose(project(camera, corners.mean(0)[None])[0], [camera.cx, camera.cy])


def test_scattered_views_follow_their_seed():
    poses = [[c.camera_to_world for c in scattered(BOX, 4, 8, 8, seed)] for seed in (1, 1, 2)]
    assert np.array_equal(poses[0], poses[1]) and not np.array_equal(poses[0], poses[2])
    assert len({c.name for c in scattered(BOX, 4, 8, 8, 1)}) == 4
