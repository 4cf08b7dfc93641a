"""The Python face: the page in docs/ as it is written, and what a scene promises."""

import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from formats.bundle import BundleWriter
from formats.errors import FormatError, OutputExists
from formats.records import FieldRecord
from formats.scene import SceneGraph, make_node, write_scene
from fusedrf_cli.bridge.field_bundle import graph_of, write_field
from fusedrf_cli.bridge.scene import load_scene
from fusedrf_cli.engine.composition.composite import as_composite
from fusedrf_cli.engine.fields.occupancy import OccupancyConfig
from fusedrf_cli.engine.rendering.volume import render_image
from fusedrf_cli.python import camera_rays, open_scene, rigid_motion
from tests.analytic.export import vm_field
from tests.analytic.fields import Gaussian, Tint

PAGE = Path(__file__).parents[2] / "docs" / "python.md"
PLACES = {"grey": (0, 0, -0.4), "red": (-0.5, 0, 0), "blue": (0.5, 0, 0)}
TINTS = {"grey": (0.5, 0.5, 0.5), "red": (0.9, 0.1, 0.1), "blue": (0.1, 0.2, 0.9)}
BALL = np.array([-0.9, -0.9, -0.9, 0.9, 0.9, 0.9])  # the box of a soft ball, which is nowhere cut


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch, in_force) -> Path:
    """The current folder, with three soft balls, a scene of them, and grids that are made in no time."""
    in_force(OccupancyConfig(scene_cells=24))
    monkeypatch.chdir(tmp_path)
    for name, rgb in TINTS.items():
        ball = vm_field(Gaussian(20.0, (0, 0, 0), aabb=BALL, tint=Tint.of(*rgb)))
        write_field(str(tmp_path / f"{name}.rfpack"), ball, name, precision="float16", overwrite=False)
    write(tmp_path, "scene.json", PLACES)
    return tmp_path


def write(folder: Path, file: str, places: dict) -> None:
    nodes = [
        make_node(
            name,
            source=f"{name.split('-')[0]}.rfpack",
            translation=place,
            background=name in ("grey", "ground"),
        )
        for name, place in places.items()
    ]
    write_scene(folder / file, SceneGraph(tuple(nodes), extras={"author": "me"}))


README = {"ground": (0, 0, 0), "tower": (-0.8, 0.4, 0.3), "small": (0.9, 0.8, 0.3), "ball": (0.6, -0.7, 0.46)}
"""The scene of its five lines, of soft balls."""


def test_the_page_runs_as_it_is_written(folder):
    for name, colour in zip(README, ("grey", "blue", "blue", "red"), strict=True):
        (folder / f"{name}.rfpack").hardlink_to(folder / f"{colour}.rfpack")
    (folder / "scene.json").unlink()
    write(folder, "scene.json", README)
    torch.manual_seed(0)
    names = {}
    blocks = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)
    assert len(blocks) > 6
    for block in blocks:
        exec(compile(block, str(PAGE), "exec"), names)
    assert names["sigma"][0] > 10 and names["sigma"][1] == 0
    assert names["rgb"][0].tolist() == pytest.approx([0.9, 0.1, 0.1], abs=0.02)
    assert names["photo"].shape == (24, 32, 3) and names["found"].shape == (256, 5)
    assert names["losses"][-1] < 0.8 * names["losses"][0]
    assert names["darker"].rgb.mean() < names["picture"].rgb.mean()
    apart = [(names[pose] - names["truth"]).abs().max() for pose in ("wrong", "found_pose")]
    assert apart[1] < 0.5 * apart[0]
    assert names["distances"][-1] < 0.25 * names["distances"][0]
    toward = torch.from_numpy(names["camera"].camera_to_world[:3, 2])  # along it one view sees little
    across = names["shift"].detach() - toward * (toward @ names["shift"].detach())
    assert across.norm() < 0.04  # it was 0.066
    again, scene = names["again"], names["scene"]
    assert names["size"] == Path("learnt.rfpack").stat().st_size and again.names == scene.names
    torch.testing.assert_close(again.placements["ball"], scene.placements["ball"].detach())


def test_a_picture_is_that_of_the_command_line():
    scene, loaded = open_scene("scene.json"), as_composite(load_scene("scene.json").composed())
    camera = scene.camera(0.9, 0.45, 40, 30)
    wanted = render_image(loaded, camera, origin=loaded.origin)
    found = scene.render(camera)
    np.testing.assert_allclose(found.rgb, wanted.rgb, atol=1e-6)
    np.testing.assert_allclose(found.opacity, wanted.opacity, atol=1e-6)
    assert 0.02 < found.opacity.mean() < 0.9
    rays_o, rays_d = camera_rays(camera)
    row = scene.render_rays(rays_o[400:440], rays_d[400:440])
    torch.testing.assert_close(row[:, :3], found.rgb[10])


def test_a_lone_field_and_one_far_away():
    """Answered by the field itself, with the digits of float64."""
    far = (1e5, -2e5, 3e4)
    write(Path(), "far.json", {"red": far})
    scene, near = open_scene("far.json"), open_scene("red.rfpack")
    shift = torch.tensor(far, dtype=torch.float64)
    points = torch.rand(50, 3, dtype=torch.float64) - 0.5
    dirs = torch.nn.functional.normalize(torch.rand(50, 3, dtype=torch.float64), dim=1)
    for one, other in zip(scene.query(points + shift, dirs), near.query(points, dirs), strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=1e-4)
    np.testing.assert_allclose(scene.aabb, near.aabb + np.tile(far, 2), atol=1e-6)


@pytest.mark.parametrize(("unit", "at"), [(1e-9, (0, 1e-8, 0)), (1e9, (1e12, 0, 5e11))])
def test_a_scene_in_any_unit_answers_in_it(folder, unit, at):
    """Densities per unit of length, distances and `near` and `step` are those of the world."""
    at, names = np.array(at), ("red", "blue")
    for file, scale, shift in (("here.json", 1.0, 0 * at), ("there.json", unit, at)):
        nodes = (
            make_node(
                n, source=f"{n}.rfpack", scale=[scale] * 3, translation=scale * np.array(PLACES[n]) + shift
            )
            for n in names
        )
        write_scene(folder / file, SceneGraph(tuple(nodes)))
    here, there = open_scene("here.json"), open_scene("there.json")
    g = torch.Generator().manual_seed(0)
    points = 2 * torch.rand(50, 3, dtype=torch.float64, generator=g) - 1
    dirs = torch.nn.functional.normalize(torch.rand(50, 3, dtype=torch.float64, generator=g) - 0.5, dim=1)
    moved = unit * points + torch.from_numpy(at)
    for one, other, size in zip(there.query(moved, dirs), here.query(points, dirs), (unit, 1.0), strict=True):
        torch.testing.assert_close(one * size, other, rtol=1e-2, atol=1e-3)
    found = there.render_rays(moved, dirs, near=0.3 * unit, step=0.01 * unit)
    wanted = here.render_rays(points, dirs, near=0.3, step=0.01)
    torch.testing.assert_close(found[:, :4], wanted[:, :4], rtol=0, atol=2e-3)
    torch.testing.assert_close(found[:, 4] / unit, wanted[:, 4], rtol=1e-2, atol=2e-3)
    assert wanted[:, 3].max() > 0.5


def test_saved_it_is_read_the_same(folder):
    """Placements that were turned too; nodes that show one field keep sharing it."""
    write(folder, "twins.json", {"grey": PLACES["grey"], "red-1": (-0.5, 0, 0), "red-2": (0.5, 0, 0)})
    scene = open_scene("twins.json")
    assert scene.fields["red-1"] is scene.fields["red-2"] and len(scene.parameters()) == 2
    turned = rigid_motion(torch.tensor([0.3, 0.1, -0.2, 0, 0.1, 0], dtype=torch.float64))
    scene.placements["red-1"] = (
        turned @ scene.placements["red-1"] @ torch.diag(torch.tensor([1, 2, -1, 1.0])).double()
    )
    with torch.no_grad():
        scene.fields["grey"].params += 0.01
    scene.save("saved.rfpack", precision="float32")
    again = open_scene("saved.rfpack")
    assert again.names == scene.names and again.rule == scene.rule and len(again.parameters()) == 2
    assert [f.background for f in load_scene("saved.rfpack").fields] == [True, False, False]
    assert load_scene("saved.rfpack").graph.extras == {"author": "me"}
    camera = scene.camera(0.9, 0.45, 24, 20)
    with torch.no_grad():
        torch.testing.assert_close(again.render(camera).rgb, scene.render(camera).rgb, rtol=0, atol=1e-5)
    with pytest.raises(OutputExists):
        scene.save("saved.rfpack")
    assert scene.save("saved.rfpack", overwrite=True) < Path("saved.rfpack").stat().st_size + 1


def test_what_a_bundle_keeps_stays_in_it(folder):
    """Its history, and members that no node shows."""
    red = load_scene("red.rfpack").fields[0]
    field = open_scene("blue.rfpack").fields["blue"]
    writer = BundleWriter()
    member = writer.add_field(FieldRecord(field.kind, *field.state()), "float16")
    writer.copy_field(folder / "red.rfpack", red.member)
    about = SceneGraph((), history=({"event": "fused"},))
    writer.write("kept.rfpack", graph_of({"blue": member}, {}, about), overwrite=False)
    open_scene("kept.rfpack").save("again.rfpack")
    assert Path("again.rfpack").read_bytes() == Path("kept.rfpack").read_bytes()


def test_learnt_placements_are_seen_by_every_answer():
    scene = open_scene("scene.json")
    points = torch.tensor([[-0.5, 0, 0], [-0.5, 0, 1.0]], dtype=torch.float64)
    dirs = torch.tensor([[0.0, 1, 0]] * 2, dtype=torch.float64)
    lift = torch.tensor([0, 0, 0, 0, 0, 1.0], dtype=torch.float64, requires_grad=True)
    before = scene.query(points, dirs)[0]
    scene.placements["red"] = rigid_motion(lift) @ scene.placements["red"]
    for grad in (True, False):
        with torch.set_grad_enabled(grad):
            sigma, _ = scene.query(points, dirs)
            assert sigma.requires_grad == grad
            torch.testing.assert_close(sigma.detach(), before.flip(0), rtol=1e-3, atol=0.02)
    scene.placements["red"] = scene.placements["red"].detach()
    assert not scene.query(points, dirs)[0].requires_grad


def test_what_cannot_be_done_is_said():
    with pytest.raises(FormatError, match="nothing.rfpack"):
        open_scene("nothing.rfpack")
    scene = open_scene("scene.json")
    scene.placements["green"] = torch.eye(4)
    with pytest.raises(ValueError, match="placements should be of grey, red, blue, found 'green'"):
        scene.query(torch.zeros(1, 3), torch.eye(3)[:1])
    del scene.placements["green"]
    for bad in (torch.eye(3), torch.ones(4, 4)):
        scene.placements["red"] = bad
        with pytest.raises(ValueError, match=r"the placement of 'red' should be \(4, 4\)"):
            scene.query(torch.zeros(1, 3), torch.eye(3)[:1])
    scene.placements["red"] = torch.diag(torch.tensor([1.0, 1, 0, 1]))
    with pytest.raises(ValueError, match="'red' is singular"):
        scene.query(torch.zeros(1, 3), torch.eye(3)[:1])


@pytest.mark.parametrize(
    ("asked", "found"),
    [({}, "1000"), ({"GOMP_SPINCOUNT": "7"}, "7"), ({"OMP_WAIT_POLICY": "active"}, "None")],
)
def test_how_long_threads_wait_is_settled_before_torch_is_loaded_unless_the_user_has_said_it(asked, found):
    code = "import fusedrf_cli, os, sys; print(os.environ.get('GOMP_SPINCOUNT'), 'torch' in sys.modules)"
    unsaid = {name: value for name, value in os.environ.items() if name != "GOMP_SPINCOUNT"}
    words = [sys.executable, "-c", code]
    run = subprocess.run(words, env=unsaid | asked, capture_output=True, text=True, check=True)
    assert run.stdout.split() == [found, "False"]
