"""Packs of every version ever written stay readable; packs of later ones are judged by their word."""

import json
import warnings
from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner

from formats import scene as scene_file
from formats.archive import read_archive
from formats.bundle import BundleWriter, OpenBundle, read_bundle, read_summary
from formats.camera_set import read_camera_set
from formats.errors import FormatWarning, NewerVersion
from formats.images import read_image
from formats.scene import dump_scene
from fusedrf_cli.bridge.rendering import reference, to_pixels
from fusedrf_cli.bridge.scene import load_scene
from fusedrf_cli.engine.composition.composed import ComposedField
from fusedrf_cli.engine.fields.occupancy import OccupancyConfig, placement
from fusedrf_cli.engine.rendering.cameras import orbit
from fusedrf_cli.engine.rendering.volume import render_image
from fusedrf_cli.main import cli
from tests.promises.mutations import sealed
from tests.promises.packs import GOLDEN

WHITE = (1.0, 1.0, 1.0)


FINE = 0.003  # a step so small that pictures show what a pack holds, not how it is drawn


def rendered(path) -> np.ndarray:
    """(48, 48, 3) uint8 of a pack, as pair.png was made."""
    field, origin = reference(load_scene(str(path)))
    if isinstance(field, ComposedField):  # all of it at the same step
        field.__dict__["occupancy"] = replace(field.occupancy, stride=None)
    camera = orbit(field.occupancy.tight_aabb(0), 1, 48, 48)[0]
    linear, pose = placement(origin)[:3, :3], camera.camera_to_world.copy()
    pose[:3, 3] = linear @ pose[:3, 3] + placement(origin)[:3, 3]
    camera = replace(camera, camera_to_world=pose)
    return to_pixels(render_image(field, camera, origin=origin, step=FINE), WHITE)


def decibels(one: np.ndarray, other: np.ndarray) -> float:
    error = np.mean((one / 255.0 - other / 255.0) ** 2)
    return float("inf") if error == 0 else float(-10 * np.log10(error))


@pytest.mark.parametrize(
    ("name", "picture"),
    [
        ("pair.rfpack", "pair.png"),
        ("ring.rfpack", "pair.png"),
        ("later.rfpack", "pair.png"),
        ("far.rfpack", "pair.png"),
        ("coded-8.rfpack", "coded.png"),
        ("coded-4.rfpack", "coded.png"),
    ],
)
def test_kept_packs_render_as_they_did(name, picture):
    """P1: these files are kept for ever, and show what their pictures show."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FormatWarning)
        assert decibels(rendered(GOLDEN / name), read_image(GOLDEN / picture)[..., :3]) >= 60


def test_kept_cameras_stand_where_they_stood():
    """P1: ring.rfpack has four cameras around z, 2 away and 1 up, of which the third is a fisheye."""
    scene = read_bundle(GOLDEN / "ring.rfpack").scene
    camera_set = read_camera_set(scene.cameras)
    assert (scene.version, scene.framing) == ("1.1", (-1.5, -1.0, -0.5, 1.5, 1.0, 0.75))
    assert [view.name for view in camera_set.train] == ["r_0", "r_1", "r_2"] and len(camera_set.test) == 1
    for view, place in zip(camera_set.views, ((2, 0, 1), (0, 2, 1), (-2, 0, 1), (0, -2, 1)), strict=True):
        np.testing.assert_allclose(view.camera_to_world[:3, 3], place)
        back = np.array(place) / np.sqrt(5)  # it looks at the origin, and its right is level
        np.testing.assert_allclose(view.camera_to_world[:3, 2], back, atol=1e-7)
        np.testing.assert_allclose(view.camera_to_world[2, 0], 0, atol=1e-7)
    assert [view.fisheye for view in camera_set.views] == [False, False, True, False]
    assert camera_set.views[2].distortion == (0.05, -0.02, 0.006, -0.001)


def test_the_kept_pack_of_a_far_world_lies_where_it_lay():
    """P1: the pair in a unit of 2.5e8, which readers before version 1.3 refuse for what it requires."""
    scene = read_bundle(GOLDEN / "far.rfpack").scene
    (leaf,) = scene.leaves()
    assert scene.version == "1.3" and scene.far
    np.testing.assert_array_equal(leaf.object_to_world[:3, 3], [-7e11, 5411200.0, 1e12])
    np.testing.assert_array_equal(leaf.object_to_world[:3, :3], 2.5e8 * np.eye(3))


def test_another_meaning_of_the_same_bytes_would_show(monkeypatch):
    """P1 with its defence removed: a reader that changed its mind about a number misses the picture."""
    from fusedrf_cli.engine.kinds.vm import field as vm

    real = vm.box_metadata

    def misread(*words) -> dict:
        told = real(*words)
        return told | {"scale": 1.1 * told["scale"]}

    monkeypatch.setattr(vm, "box_metadata", misread)
    assert decibels(rendered(GOLDEN / "pair.rfpack"), read_image(GOLDEN / "pair.png")[..., :3]) < 50


def test_another_meaning_of_codes_would_show(monkeypatch):
    """P1 with its defence removed: a reader that divides by 128 instead of 127."""
    from formats import quantisation

    monkeypatch.setitem(quantisation.LEVELS, 8, 128)
    assert decibels(rendered(GOLDEN / "coded-8.rfpack"), read_image(GOLDEN / "coded.png")[..., :3]) < 50


@pytest.mark.parametrize("path", sorted(GOLDEN.glob("*.rfpack")), ids=lambda path: path.stem)
def test_every_kept_pack_is_valid(path):
    """P1."""
    result = CliRunner().invoke(cli, ["validate", str(path)])
    assert result.exit_code == 0, result.stderr


def versioned(tmp_path, old: bytes, new: bytes):
    """The golden pair with a part of its scene.json changed, under right checksums."""
    import random

    data = sealed(
        (GOLDEN / "pair.rfpack").read_bytes(),
        lambda scene, field, _: (scene.replace(old, new, 1), field),
        random.Random(0),
    )
    (tmp_path / "a.rfpack").write_bytes(data)
    return str(tmp_path / "a.rfpack")


@pytest.mark.parametrize("verb", ["info", "validate"])
def test_another_major_version_is_refused_naming_both(tmp_path, verb):
    """P1."""
    result = CliRunner().invoke(cli, [verb, versioned(tmp_path, b'"1.0"', b'"2.3"')])
    assert result.exit_code == 4 and "2.3" in result.stderr and "1.x" in result.stderr


@pytest.mark.parametrize("verb", ["info", "validate"])
def test_an_unknown_feature_that_is_required_is_refused(tmp_path, verb):
    """P1."""
    path = versioned(tmp_path, b'"composition"', b'"requires": ["time"],\n  "composition"')
    result = CliRunner().invoke(cli, [verb, path])
    assert result.exit_code == 4 and "time" in result.stderr


def test_without_a_look_at_the_version_the_future_is_misread(tmp_path, monkeypatch):
    """P1 with its defence removed."""
    path = versioned(tmp_path, b'"1.0"', b'"2.3"')
    with pytest.raises(NewerVersion):
        read_summary(path)
    monkeypatch.setattr(scene_file, "_check_version", lambda *_: False)
    assert read_summary(path)["version"] == "2.3"


def test_keys_that_this_version_does_not_know_survive_a_round_trip(tmp_path):
    """P1: those of the scene, and those of its nodes."""
    with pytest.warns(FormatWarning, match="1.7 is newer"):
        stored = read_bundle(GOLDEN / "later.rfpack")
    assert dump_scene(stored.scene) == bytes(read_archive(GOLDEN / "later.rfpack")["scene.json"])
    with pytest.warns(FormatWarning, match="1.7 is newer"):
        bundle = OpenBundle(GOLDEN / "later.rfpack")
    writer = BundleWriter()
    for member in bundle.headers:
        writer.copy_field(bundle, member)
    writer.write(tmp_path / "a", bundle.scene)
    with pytest.warns(FormatWarning, match="1.7 is newer"):
        again = OpenBundle(tmp_path / "a")
    assert again.scene == bundle.scene and again.scene.extras == stored.scene.extras != {}
    assert again.headers.keys() == bundle.headers.keys()


def test_an_edit_keeps_what_it_does_not_know_of_the_scene(tmp_path, in_force):
    """P1, through a whole `delete`."""

    in_force(OccupancyConfig(scene_cells=32))
    words = ["delete", str(GOLDEN / "later.rfpack"), "chair", "-o", str(tmp_path / "a.rfpack"), "--json"]
    result = CliRunner().invoke(cli, words)
    assert result.exit_code == 0, result.stderr
    assert any("1.7 is newer" in text for text in json.loads(result.stdout)["warnings"])
    with pytest.warns(FormatWarning, match="1.7 is newer"):  # whose keys it has
        scene = read_bundle(tmp_path / "a.rfpack").scene
    assert scene.extras == {"licence": "CC0", "poses": {"a": [1, 2]}}
