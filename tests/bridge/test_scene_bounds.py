"""What of unbounded space a capture's photos are learnt in."""

from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import torch

from formats.views import Capture, View
from fusedrf_cli.bridge.pictures import camera_of
from fusedrf_cli.bridge.pose_refinement import with_poses
from fusedrf_cli.bridge.scene_bounds import scene_bounds_of
from fusedrf_cli.bridge.training import TrainPresets, fit_settings, quality_of, texels_of_part
from fusedrf_cli.engine.distillation.config import TrainConfig
from fusedrf_cli.engine.distillation.poses import poses_of
from fusedrf_cli.engine.fields.occupancy import placed_box
from fusedrf_cli.engine.kinds import registry
from fusedrf_cli.engine.rendering.cameras import look_at
from fusedrf_cli.engine.spaces.unbounded import LOOK_AT_BOX, WHOLE, contract
from fusedrf_cli.requests import TrainRequest

BOX = np.array([-9.0] * 3 + [9.0] * 3)
UP = np.array([0.0, 0.0, 1.0])


def request() -> TrainRequest:
    """`train` with unbounded space asked for."""
    known = {field.name: None for field in fields(TrainRequest)}
    return TrainRequest(**known | {"source": "photos", "output": "out.rfpack", "unbounded": True})


def photos(eyes: list, focus=(0.0, 0.0, 0.0)) -> Capture:
    """Views from eyes (3,) towards a focus, 60° wide."""
    views = [
        View(f"v{i}", look_at(np.array(eye, float), np.array(focus), UP), 87.0, 87.0, 50.0, 50.0, 100, 100)
        for i, eye in enumerate(eyes)
    ]
    return Capture(Path("photos"), "transforms", tuple(views), (), BOX, True)


def test_photos_that_look_one_way_fill_the_box_that_they_are_learnt_in():
    capture = photos([(4, y, z) for y in (-0.4, 0, 0.4) for z in (-0.3, 0.3)])
    bounds = scene_bounds_of(request(), capture, False)
    assert bounds.unbounded and (bounds.box[3:] - bounds.box[:3] < WHOLE[3:] - WHOLE[:3]).any()
    rng = np.random.default_rng(0)
    for view in capture.train:  # what a photo shows, near and far, lies in the box
        camera = bounds.camera(camera_of(view))
        x, y = rng.uniform(-1, 1, (2, 500)) * 50 / 87
        rays = np.stack([x, y, -np.ones(500)], 1) @ camera.camera_to_world[:3, :3].T
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        away = bounds.near * 10 ** rng.uniform(0.02, 4, (500, 1))
        at = contract(torch.from_numpy(camera.camera_to_world[:3, 3] + away * rays)).numpy()
        assert ((at >= bounds.box[:3] - 1e-9) & (at <= bounds.box[3:] + 1e-9)).all()


def boxed(box: tuple) -> TrainRequest:
    return replace(request(), unbounded=None, aabb=box)


@pytest.mark.parametrize(
    "box", [(-1.5,) * 3 + (1.5,) * 3, (60, 0, 0, 61, 1, 0.5), (0, 0, 0, 0.002, 0.002, 0.002)]
)
def test_a_box_of_ordinary_size_near_the_origin_is_learnt_in_the_frame_of_the_world(box):
    capture = photos([(4, 0, 0), (0, 4, 0), (0, 0, 4)])
    bounds = scene_bounds_of(boxed(box), capture, False)
    assert bounds.box.tolist() == list(box) and np.array_equal(bounds.origin, np.eye(4))
    assert bounds.camera(camera_of(capture.train[0])).camera_to_world is capture.train[0].camera_to_world


@pytest.mark.parametrize(
    ("unit", "at"),
    [(1.0, (432100, 5411200, 310)), (1e9, (0, 0, 0)), (1e-9, (0, 1, 0)), (1e3, (1e12, 0, -1e12))],
)
def test_a_box_far_away_or_of_another_size_has_a_frame_of_its_own(unit, at):
    """With numbers as near the origin; what cameras see there is what they see in the world."""
    at = np.array(at, float)
    eyes = [at + unit * np.array(eye, float) for eye in ((4, 0, 0), (0, 4, 0), (0, 1, 4))]
    capture = photos(eyes, at)
    box = np.concatenate([at - unit, at + 1.5 * unit])
    bounds = scene_bounds_of(boxed(tuple(box)), capture, False)
    side = (bounds.box[3:] - bounds.box[:3]).max()
    assert 2.0**-10 <= side <= 2.0**12 and np.abs(bounds.box).max() < side and not bounds.unbounded
    np.testing.assert_allclose(placed_box(bounds.box, bounds.origin), box, rtol=1e-12)
    np.testing.assert_allclose(bounds.report()["aabb"], box, rtol=1e-12)
    for view in capture.train:
        camera = bounds.camera(camera_of(view))
        np.testing.assert_allclose(camera.camera_to_world[:3, :3], view.camera_to_world[:3, :3], atol=1e-9)
        eye = bounds.origin[:3, :3] @ camera.camera_to_world[:3, 3] + bounds.centre
        np.testing.assert_allclose(eye, view.camera_to_world[:3, 3], rtol=1e-12)


def test_pixels_of_photos_that_look_one_way_are_as_wide_near_as_far():
    """In the coordinates, along a picture's middle; in the world's own axes they differ more."""
    capture = photos([(4, y, z) for y in (-0.4, 0, 0.4) for z in (-0.3, 0.3)], focus=(0.0, 1.0, 0.2))
    camera = camera_of(capture.train[2])

    def widths(bounds) -> np.ndarray:
        seen = bounds.camera(camera)
        storage_settings = np.array([[0.0, 0.0, -1.0], [1 / 87, 0.0, -1.0]]) @ seen.camera_to_world[:3, :3].T
        depths = np.array([1.5, 4.0, 20.0])[:, None, None] / bounds.unit
        at = torch.from_numpy(seen.camera_to_world[:3, 3] + depths * storage_settings)
        here, beside = contract(at[:, 0]), contract(at[:, 1])
        return np.linalg.norm((beside - here).numpy(), axis=1)

    fan = widths(scene_bounds_of(request(), capture, False))
    assert fan.max() < 1.5 * fan.min()
    asked = replace(request(), centre=(0.0, 1.0, 0.2), radius=2.4)
    around = widths(scene_bounds_of(asked, capture, False))
    assert around.max() > 2.5 * around.min()


def test_views_of_what_lies_before_cameras_look_there():
    """Without the cameras of a capture, too: not at the middle of the core, where the cameras stand."""
    near = {"near": 2.5, "far": 20.0}
    capture = photos([(4, y, z) for y in (-0.4, 0, 0.4) for z in (-0.3, 0.3)], focus=(0.0, 1.0, 0.2))
    capture = replace(capture, train=tuple(replace(view, **near) for view in capture.train))
    bounds = scene_bounds_of(request(), capture, False)
    box = placed_box(bounds.cells.look_at_box, bounds.origin)
    ahead = ((box[:3] + box[3:]) / 2 - [4, 0, 0]) @ [-0.97, 0.24, 0.05]
    assert 2 < ahead < 8
    around = scene_bounds_of(replace(request(), radius=2.4), capture, False)
    assert np.array_equal(around.cells.look_at_box, LOOK_AT_BOX)


def test_the_best_quality_is_as_fine_as_the_photos_and_takes_a_long_time_budget(in_force):
    """At 4 units of distance a pixel of these lenses is 4/87 wide."""
    finer = TrainConfig(longest=256)
    in_force(TrainPresets(normal=TrainConfig(longest=224), high=finer, best=finer))
    capture = photos([(4, 0, 0), (0, 4, 0), (-4, 0, 0), (0, -4, 0), (0, 0.1, 4)])
    words = replace(request(), unbounded=False, aabb=(-1.0, -1.0, -1.0, 1.0, 1.0, 1.0))
    bounds = scene_bounds_of(words, capture, False)

    def found(seconds, quality=None, sharper=1.0, device="cpu"):
        views = tuple(replace(v, fl_x=v.fl_x * sharper, fl_y=v.fl_y * sharper) for v in capture.train)
        asked = replace(words, time_budget=seconds, quality=quality)
        return quality_of(asked, replace(capture, train=views), bounds, device)

    def longest(*words):
        return found(*words).longest

    assert [longest(s) for s in (None, 20, 100, 300)] == [224, 224, 256, 256]
    assert longest(300, None, 10) == round(0.7 * 870 * 2 / 4) == longest(None, "best", 10)
    assert longest(300, None, 100) == 512 and longest(300, "normal", 100) == 224
    best, plain = found(300), TrainConfig()
    assert best.samples > plain.samples and best.samples * best.steps == plain.samples * plain.steps
    there = found(300 / TrainPresets.gpu_pace, device="cuda")  # in larger steps, and sooner
    assert (there.longest, there.steps) == (best.longest, best.steps)
    assert there.samples == best.samples * TrainPresets.gpu_samples


def test_cameras_come_back_from_the_frame_of_a_field():
    capture = photos([(4, y, z) for y in (-0.4, 0, 0.4) for z in (-0.3, 0.3)], focus=(0.0, 1.0, 0.2))
    bounds = scene_bounds_of(request(), capture, False)
    found = with_poses(capture, bounds, poses_of([bounds.camera(camera_of(v)) for v in capture.train]))
    for view, back in zip(capture.train, found.train, strict=True):
        assert np.allclose(view.camera_to_world, back.camera_to_world, atol=1e-9)
    assert np.linalg.det(bounds.origin[:3, :3]) > 0  # not mirrored
    ahead = bounds.origin[:3, :3] @ [1.0, 0.0, 0.0] / bounds.unit
    assert ahead @ [-0.97, 0.24, 0.05] > 0.98


def test_photos_from_all_around_are_learnt_in_all_of_space():
    ring = [(4 * np.cos(a), 4 * np.sin(a), 1.0) for a in np.linspace(0, 6, 12)]
    box = scene_bounds_of(request(), photos(ring), False).box
    assert np.array_equal(box[[0, 1, 3, 4]], WHOLE[[0, 1, 3, 4]])


def test_planes_over_a_part_of_space_have_as_many_texels_as_over_all_of_it():
    def texels(box: np.ndarray) -> float:
        counts = texels_of_part(box, 224) * (box[3:] - box[:3]) / (box[3:] - box[:3]).max()
        return counts[0] * counts[1] + counts[1] * counts[2] + counts[2] * counts[0]

    part = np.array([-2.0, -1.0, -1.0, 1.0, 1.0, 1.0])
    assert abs(texels(part) / texels(WHOLE) - 1) < 0.02


def test_a_place_that_has_the_time_and_the_room_gets_a_hashed_detail(in_force):
    """And fewer texels then; no object does, nor a kind that has none."""
    presets = {"draft": 1500, "normal": 4000, "best": 24000}
    presets = {name: TrainConfig(longest=224, steps=steps) for name, steps in presets.items()}
    in_force(TrainPresets(**presets))
    ring = [(4 * np.cos(a), 4 * np.sin(a), 1.0) for a in np.linspace(0, 6, 12)]
    capture = photos(ring)

    def settings(kind: str = "vm", bounded: bool = False, device: str = "cpu", **words) -> TrainConfig:
        asked = replace(request(), precision="int8", unbounded=not bounded, **words)
        bounds = scene_bounds_of(asked, capture, False)
        return fit_settings(asked, registry.kind(kind), capture, bounds, device)

    plain = settings(time_budget=60.0)
    assert plain.storage.hashed is None
    assert settings(time_budget=60.0, device="cuda").storage.hashed is TrainPresets.hashed
    for words in ({"time_budget": 600.0}, {}, {"quality": "best"}, {"max_size": 30_000_000}):
        found = settings(**words)
        assert found.storage.hashed is TrainPresets.hashed
        assert found.longest < 0.8 * texels_of_part(WHOLE, 2 * presets["normal"].longest)
        larger = "time_budget" in words or "quality" in words
        named = presets[words.get("quality", "normal")]
        assert (found.samples / named.samples, named.steps / found.steps) == ((2, 2) if larger else (1, 1))
    assert settings(quality="draft").storage.hashed is None
    assert settings(max_size=12_000_000).storage.hashed is None
    assert settings("cp").storage.hashed is None and settings(bounded=True).storage.hashed is None


@pytest.mark.parametrize("precision", ("float16", "float32"))
def test_planes_are_as_fine_as_the_quality_says_and_voxels_as_a_file_allows(precision, in_force):
    """Where no size is asked for, however the numbers are stored; and within one that is."""
    in_force(TrainPresets(normal=TrainConfig(longest=256)))
    ring = [(4 * np.cos(a), 4 * np.sin(a), 1.0) for a in np.linspace(0, 6, 12)]
    capture = photos(ring)
    asked = replace(request(), quality="normal", precision=precision, ranks=(16, 24))
    bounds = scene_bounds_of(asked, capture, False)

    def longest(kind: str, size: int | None = None) -> int:
        limited = replace(asked, max_size=size)
        return fit_settings(limited, registry.kind(kind), capture, bounds, "cpu").longest

    assert longest("vm") == longest("cp") == texels_of_part(bounds.box, 2 * 256)
    assert 100 < longest("dense") < longest("vm")
    assert longest("vm", 10_000_000) < longest("vm")
