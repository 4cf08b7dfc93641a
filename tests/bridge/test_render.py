"""`render` for real: one picture, a folder, a film, depth and transparency."""

import json

import numpy as np
import pytest
from PIL import Image

from formats.images import read_image
from formats.scene import SceneGraph, make_node, write_scene
from fusedrf_cli.bridge.rendering import WorkConfig
from fusedrf_cli.engine.rendering.metrics import psnr
from tests.bridge.conftest import blues

SMALL = ("--size", "32x24")


def test_one_picture_frames_the_scene(report, folder):
    said = report("render", "red.rfpack", "-o", "red.png", *SMALL)
    assert said["views"] == 1 and said["size"] == [32, 24] and said["files"] == ["red.png"]
    pixels = read_image(folder / "red.png")
    assert pixels.shape == (24, 32, 4)
    assert (pixels[0, 0] == 255).all()  # white outside
    middle = pixels[12, 16, :3] / 255
    np.testing.assert_allclose(middle, (0.9, 0.1, 0.1), atol=0.02)


def test_the_background_is_as_asked(report, folder):
    report("render", "red.rfpack", "-o", "red.png", *SMALL, "--background", "#102030")
    assert read_image(folder / "red.png")[0, 0].tolist() == [16, 32, 48, 255]


def test_transparent_has_straight_alpha(report, folder):
    report("render", "red.rfpack", "-o", "red.png", *SMALL, "--background", "transparent")
    pixels = read_image(folder / "red.png")
    assert pixels[0, 0, 3] == 0 and pixels[12, 16, 3] == 255
    seen = pixels[pixels[..., 3] > 8]
    assert (seen[:, 3] < 250).any()  # edges are part transparent, their colour is still the object's
    assert np.abs(seen[:, :3].astype(int) - [230, 26, 26]).max() <= 16


def test_a_folder_has_one_picture_per_view(report, folder):
    said = report("render", "scene.json", "-o", "turn", "--orbit", "3", *SMALL)
    assert [file.name for file in sorted((folder / "turn").iterdir())] == [
        f"orbit_000{i}.png" for i in range(3)
    ]
    assert said["views"] == len(said["files"]) == 3
    one, two = (read_image(folder / f) for f in said["files"][:2])
    assert (one != two).any()


def test_depth_lies_beside(report, folder):
    said = report("render", "red.rfpack", "-o", "red.png", *SMALL, "--depth")
    depth = np.asarray(Image.open(folder / "red_depth.png"), float) * said["files"][0]["depth"]["scale"]
    assert depth.shape == (24, 32) and depth[0, 0] == 0
    report("render", "red.rfpack", "-o", "turn", "--orbit", "2", *SMALL, "--depth")
    assert len(list((folder / "turn").iterdir())) == 4
    assert 1.0 < depth[12, 16] < 3.0  # 0.92 radii / sin(fov) away, about 1.6 less half a box


def test_two_views_of_one_name_are_two_pictures(report, folder):
    """Nor does a depth take the place of another view's picture, on whatever disk."""
    names = ("a", "a_depth", "A")
    pose = np.eye(4)
    pose[2, 3] = 3.0
    lens = {"fl_x": 30.0, "fl_y": 30.0, "cx": 12.0, "cy": 12.0, "w": 24, "h": 24}
    frames = []
    for i, name in enumerate(names):
        pose[0, 3] = 0.2 * i
        frames.append({"file_path": name, "transform_matrix": pose.tolist()})
    (folder / "eyes.json").write_text(json.dumps(lens | {"frames": frames}))
    said = report("render", "red.rfpack", "--cameras", "eyes.json", "-o", "views", "--depth")
    assert said["files"] == ["views/a.png", "views/a_depth-2.png", "views/A-2.png"]
    assert len(said["warnings"]) == 2 and len(list((folder / "views").iterdir())) == 6
    report("render", "red.rfpack", "--cameras", "eyes.json", "-o", "plain")
    for file, plain in zip(said["files"], ("a", "a_depth", "A-2"), strict=True):
        assert (folder / file).read_bytes() == (folder / "plain" / f"{plain}.png").read_bytes()


def test_a_depth_that_is_there_is_not_replaced_unasked(run, report, folder):
    (folder / "red_depth.png").write_text("mine")
    words = ("render", "red.rfpack", "-o", "red.png", *SMALL, "--depth")
    assert run(*words).exit_code == 1 and not (folder / "red.png").exists()
    assert (folder / "red_depth.png").read_text() == "mine"
    report(*words, "-w")


def test_a_film_turns(report, folder):
    report("render", "scene.json", "-o", "turn.gif", "--orbit", "3", *SMALL, "--fps", "10")
    with Image.open(folder / "turn.gif") as film:
        assert film.n_frames == 3 and film.size == (32, 24) and film.info["duration"] == 100


def test_a_scene_put_together_shows_what_its_fields_do(report, folder):
    """Turned and stretched, at the numbers that the fields have; `--reference` asks each of them."""
    matrix = np.diag([1.2, 0.8, 1.0, 1.0])
    matrix[:2, :2] = [[0.9, -0.6], [0.5, 0.7]]
    nodes = [make_node("floor", source="floor.rfpack"), make_node("red", source="red.rfpack", matrix=matrix)]
    write_scene(folder / "turned.json", SceneGraph(tuple(nodes)))
    pictures = []
    for words in ((), ("--reference",)):
        report("render", "turned.json", "-o", "a.png", "-w", "--size", "96x72", *words)
        pictures.append(read_image(folder / "a.png")[..., :3] / 255)
    assert 42 < psnr(*pictures) < 100  # samples lie elsewhere, and the boxes have hard faces


def test_the_scene_is_the_sum_of_its_parts(picture):
    """The composed scene shows floor, red and blue; without blue its pixels are no longer blue."""
    assert blues(picture("scene.json")) > 20 and blues(picture("pair.json")) == 0


@pytest.mark.parametrize(
    "words, code, says",
    [
        (("-o", "a.gif", "--background", "transparent"), 2, "transparency"),
        (("-o", "a.gif", "--depth"), 2, "depth"),
        (("-o", "a.png", "--orbit", "2"), 2, "one picture"),
        (("-o", "a.png", "--device", "cuda"), 5, "no GPU"),
        (("-o", "a.png", "--cameras", "none.json"), 3, "none.json"),
    ],
)
def test_what_cannot_be_rendered(run, folder, words, code, says):
    before = sorted(folder.iterdir())
    result = run("render", "red.rfpack", *SMALL, *words)
    assert result.exit_code == code and says in result.stderr and sorted(folder.iterdir()) == before


def test_what_takes_long_is_said_before_it_begins(run, folder, in_force):
    """Many pixels, or a node so small beside another that each ray takes very many samples."""
    nodes = [
        make_node("whole", source="red.rfpack"),
        make_node("tiny", source="blue.rfpack", scale=[1e-3] * 3),
    ]
    write_scene(folder / "tiny.json", SceneGraph(tuple(nodes)))
    few = "render", "tiny.json", "-o", "out.png", "-w", "--reference", "--size", "2x2"
    assert run(*few).stderr.count("may take long") == 0
    in_force(WorkConfig(much_work=1 << 12))
    said = run(*few).stderr
    assert "Warning: tiny.json: a ray takes up to " in said and "leave out what is smallest" in said
    assert run("render", "red.rfpack", "-o", "red.png", *SMALL).stderr.count("Warning") == 0
    in_force(WorkConfig(many_rays=32 * 24))
    result = run("render", "red.rfpack", "-o", "out.png", "-w", *SMALL)
    assert result.exit_code == 0
    assert "Warning: red.rfpack: 768 pixels may take long; give a smaller --size" in result.stderr


@pytest.mark.parametrize("output", ["red.png", "turn"])
def test_an_output_in_the_way_needs_a_word(run, folder, output):
    assert run("render", "red.rfpack", "-o", output, *SMALL).exit_code == 0
    assert run("render", "red.rfpack", "-o", output, *SMALL).exit_code != 0
    assert run("render", "red.rfpack", "-o", output, *SMALL, "-w").exit_code == 0
