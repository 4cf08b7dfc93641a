"""Cameras: pixels to rays and back, poses, rasters."""

import numpy as np
import pytest

from fusedrf_cli.engine.rendering.cameras import (
    Camera,
    FramingConfig,
    Outlook,
    azimuth_of,
    bend,
    fisheye_directions,
    framing,
    framing_camera,
    framing_lens,
    level,
    look_at,
    of_nine,
    orbit,
    scattered,
    undistort,
)
from tests.engine.conftest import BOX, DIRECTIONS_26

DISTORTION = (-0.12, 0.05, -0.01, 0.003, -0.002)


LENSES = {
    "pinhole": ((0.0,) * 5, False),
    "brown": (DISTORTION, False),
    "barrel": ((0.2, 0, 0, 0, 0), False),
    "eighth power": ((-0.2, 0.08, -0.02, 0.001, 0.002, 0.004), False),
    "rational": ((0.3, -0.1, 0.02, -0.001, 0.002, 0.0, 0.35, -0.05, 0.01), False),
    "equidistant": ((0.0,) * 4, True),
    "fisheye": ((0.05, -0.02, 0.006, -0.001), True),
}


def distort(u, v, distortion):
    """OpenCV's distortion as its manual writes it: ideal to distorted normalised coordinates (y down)."""
    k1, k2, k3, p1, p2, k4, d1, d2, d3 = (*distortion, *[0] * (9 - len(distortion)))
    r2 = u * u + v * v
    radial = (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3 + k4 * r2**4) / (1 + d1 * r2 + d2 * r2**2 + d3 * r2**3)
    return u * radial + 2 * p1 * u * v + p2 * (r2 + 2 * u * u), v * radial + p1 * (
        r2 + 2 * v * v
    ) + 2 * p2 * u * v


def on_lens(local, distortion, fisheye):
    """(N, 3) points in the camera's frame to distorted normalised image coordinates (y down)."""
    if not fisheye:
        return distort(local[:, 0] / -local[:, 2], -local[:, 1] / -local[:, 2], distortion)
    across = np.hypot(local[:, 0], local[:, 1])
    angle = np.arctan2(across, -local[:, 2])
    k1, k2, k3, k4 = distortion
    radius = angle * (1 + k1 * angle**2 + k2 * angle**4 + k3 * angle**6 + k4 * angle**8)
    return local[:, 0] / across * radius, -local[:, 1] / across * radius


def project(camera: Camera, points: np.ndarray) -> np.ndarray:
    """(N, 2) column and row coordinates of world points."""
    local = (points - camera.camera_to_world[:3, 3]) @ camera.camera_to_world[:3, :3]
    u, v = on_lens(local, camera.distortion, camera.fisheye)
    return np.stack([camera.fl_x * u + camera.cx, camera.fl_y * v + camera.cy], 1)


def camera_at(distortion=(0.0,) * 5, fisheye=False, width=23, height=17) -> Camera:
    pose = look_at(np.array([3.0, -2.0, 1.5]), np.array([0.1, 0.2, 0.0]), np.array([0.0, 0.0, 1.0]))
    return Camera(pose, 25.0, 27.0, 11.3, 8.9, width, height, distortion, fisheye=fisheye)


@pytest.mark.parametrize("distortion", [lens for lens, fisheye in LENSES.values() if not fisheye])
def test_undistort_inverts(distortion):
    u, v = np.random.default_rng(0).uniform(-0.6, 0.6, (2, 400))
    found = undistort(*distort(u, v, distortion), distortion)
    np.testing.assert_allclose(found, (u, v), rtol=0, atol=1e-9)


@pytest.mark.parametrize("distortion", [lens for lens, fisheye in LENSES.values() if not fisheye])
def test_the_slopes_of_a_lens_are_its_differences(distortion):
    u, v = np.random.default_rng(1).uniform(-0.7, 0.7, (2, 50))
    h = 1e-6
    by_u, by_v = (
        (np.array(distort(u + h * i, v + h * j, distortion)) - distort(u - h * i, v - h * j, distortion))
        / (2 * h)
        for i, j in ((1, 0), (0, 1))
    )
    (x, y), (x_u, x_v, y_v) = bend(u, v, of_nine(distortion))
    np.testing.assert_allclose([x, y], distort(u, v, distortion), rtol=1e-12)
    np.testing.assert_allclose([x_u, x_v, x_v, y_v], [by_u[0], by_v[0], by_u[1], by_v[1]], atol=1e-8)


@pytest.mark.parametrize("distortion", [lens for lens, fisheye in LENSES.values() if fisheye])
def test_a_fisheye_sees_beside_and_behind_itself(distortion):
    """Directions up to 110 degrees from the axis come back from where they land."""
    random = np.random.default_rng(2)
    angle, turn = random.uniform(1e-3, np.radians(110), 500), random.uniform(0, 2 * np.pi, 500)
    d = np.stack([np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), -np.cos(angle)], 1)
    found = fisheye_directions(*on_lens(d, distortion, True), distortion)
    np.testing.assert_allclose(found, d, rtol=0, atol=1e-9)
    assert fisheye_directions(np.zeros(1), np.zeros(1), distortion).tolist() == [[0, 0, -1]]


def test_pixels_that_no_ray_reaches_stay_finite():
    """Barrel distortion folds over: what lies past the fold gets a finite ray, what lies before the right
    one."""
    folding, x = (-0.3, 0, 0, 0, 0), np.linspace(0, 3, 200)
    u, v = undistort(x, np.zeros(200), folding)
    assert np.isfinite(u).all() and (v == 0).all()
    fold = 1 / np.sqrt(0.9)
    inside = x < 0.99 * fold * (1 - 0.3 * fold**2)
    np.testing.assert_allclose(u[inside] * (1 - 0.3 * u[inside] ** 2), x[inside], atol=1e-9)
    assert (np.abs(u[inside]) < fold).all()
    d = fisheye_directions(np.linspace(0, 9, 50), np.zeros(50), (-0.1, 0, 0, 0))
    np.testing.assert_allclose(np.linalg.norm(d, axis=1), 1)
    assert (np.diff(np.arccos(-d[:, 2])) >= 0).all()


@pytest.mark.parametrize("distortion, fisheye", LENSES.values(), ids=LENSES)
def test_the_ray_of_a_pixel_passes_what_projects_to_it(distortion, fisheye):
    """A point anywhere along the ray of pixel (i, j) projects to (i + 0.5, j + 0.5)."""
    camera = camera_at(distortion, fisheye)
    rays_o, rays_d = camera.rays()
    np.testing.assert_allclose(np.linalg.norm(rays_d, axis=1), 1, rtol=1e-12)
    row, column = np.divmod(np.arange(camera.width * camera.height), camera.width)
    for distance in (0.5, 4.0, 100.0):
        found = project(camera, rays_o + distance * rays_d)
        np.testing.assert_allclose(found, np.stack([column, row], 1) + 0.5, atol=1e-9)


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


@pytest.mark.parametrize("up", DIRECTIONS_26)
def test_an_outlook_stands_where_its_angles_say(up):
    """Around any upward direction: at its distance, its height and its turn, level, and looking at the
    target."""
    target, lens = np.array([0.3, -0.2, 5.0]), framing_lens(8, 6)
    east, north = level(up)
    axes = np.array([east, north, up])
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(np.cross(east, north), up, atol=1e-12)
    for azimuth, elevation in ((0.0, 0.0), (2.5, 0.7), (-1.0, -1.2)):
        camera = Outlook(target, 3.0, azimuth, elevation, up).camera(lens, turn=0.25)
        away = camera.camera_to_world[:3, 3] - target
        assert np.linalg.norm(away) == pytest.approx(3)
        assert away @ up == pytest.approx(3 * np.sin(elevation))
        assert azimuth_of(away, up) == pytest.approx(azimuth + 0.25)
        assert camera.camera_to_world[:3, 0] @ up == pytest.approx(0, abs=1e-12)
        np.testing.assert_allclose(project(camera, target[None])[0], [4, 3], atol=1e-9)


def test_azimuth_is_from_x_about_z():
    assert np.array_equal(level(np.array([0.0, 0, 1])), np.eye(3)[:2])
    assert azimuth_of(np.array([0.0, 2.0, 7.0]), np.array([0.0, 0, 1])) == pytest.approx(np.pi / 2)


def test_scattered_views_follow_their_seed():
    poses = [[c.camera_to_world for c in scattered(BOX, 4, 8, 8, seed)] for seed in (1, 1, 2)]
    assert np.array_equal(poses[0], poses[1]) and not np.array_equal(poses[0], poses[2])
    assert len({c.name for c in scattered(BOX, 4, 8, 8, 1)}) == 4


def test_boxes_are_framed_from_where_the_settings_in_force_say(in_force):
    in_force(FramingConfig(azimuth=0.2, elevation=-0.3))
    wanted = framing_camera(BOX, 0.2, -0.3, 16, 12).camera_to_world
    lens = framing_lens(16, 12)
    np.testing.assert_array_equal(framing(BOX, lens).camera(lens).camera_to_world, wanted)
    np.testing.assert_array_equal(orbit(BOX, 3, 16, 12)[0].camera_to_world, wanted)
    level_view = framing(BOX, lens, 0.0, 0.0)
    assert (level_view.azimuth, level_view.elevation) == (0, 0)
