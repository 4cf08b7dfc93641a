"""Placement, A1 to A9: what scale, stretch, mirrors, turns, distance and deep trees do to a field."""

import dataclasses
import inspect
import json

import numpy as np
import pytest
import torch

from formats.bundle import read_bundle
from formats.errors import FormatError
from formats.scene import Node, SceneGraph, make_node, read_scene, write_scene
from fusedrf_cli.bridge.scene import load_scene
from fusedrf_cli.engine.composition.affine import Placed
from fusedrf_cli.engine.composition.composite import as_composite
from fusedrf_cli.engine.composition.resolution_report import opacity_off
from fusedrf_cli.engine.distillation.distill import distill
from fusedrf_cli.engine.distillation.sampler import RaySampler
from fusedrf_cli.engine.kinds.distil_config import DistilConfig
from fusedrf_cli.engine.kinds.vm import KIND as VM
from fusedrf_cli.engine.kinds.vm.field import VMField
from fusedrf_cli.engine.rendering.metrics import psnr
from tests.analytic import scenes
from tests.analytic.export import SHAPE, exported, way_of
from tests.analytic.fields import Box, Gaussian, Tint
from tests.analytic.files import write_bundles, write_camera
from tests.analytic.measure import answers, depth_along, photo, worst_relative
from tests.analytic.rays import DIRECTIONS_26, SHEAR, affine, moved_rays, rays_at, turn, unit
from tests.analytic.scenes import Scene, camera_at, moved_camera, scene_of
from tests.bridge.conftest import done, invoke

SCALES = (1e-3, 2.5, 1e3)
CUBE, SOFT = scenes.s3_cube(1), scenes.s3_cube(1, soft=True)
STEP = 0.03  # of a soft scene's pictures, far below its width
EYE = camera_at((1.9, 1.1, 0.8), size=24)
MIRROR = np.diag([-1.0, 1, 1, 1])
TURNS = (turn(37), turn(160, (1, 0, 0.3)))


pytestmark = pytest.mark.usefixtures("quick")


def ways(scene: Scene, kind: str) -> dict[str, tuple]:
    """(field, origin) of the naive composition and, where the kind allows it, of the fast one."""
    composed = scene.composed(kind)
    found = {"composed": (composed, composed.origin)}
    if (fast := as_composite(composed)) is not composed:
        found["composite"] = (fast, composed.origin)
    return found


def worst_depth_error(matrix: np.ndarray, kind: str, count: int = 1000) -> float:
    """Worst relative difference of optical depth through a placed blob and a placed box, each against the
    same field alone in its own frame."""
    worst = 0.0
    for field in (Gaussian(tint=scenes.RED), Box(3.0, (0.5, 0.4, 0.3), tint=scenes.RED)):
        alone = exported(field, kind)
        rays_o, rays_d = rays_at(field.matter, count // 2, seed=3)
        spans = scene_of((field, np.eye(4))).intervals(rays_o, rays_d)[0]
        spans = np.where(spans[:, 1:] > spans[:, :1], spans, 0.0)
        wanted = depth_along(alone, rays_o, rays_d, spans, nodes=24)
        world_o, world_d, longer = moved_rays(matrix, rays_o, rays_d)
        for thing, origin in ways(scene_of((field, matrix)), kind).values():
            found = depth_along(thing, world_o, world_d, spans * longer[:, None], origin, nodes=24)
            worst = max(worst, worst_relative(found, wanted))
    return worst


# -- A1 ------------------------------------------------------------------------------------------------------


def test_a1_scale_keeps_every_optical_depth(row, kind):
    figure = max(worst_depth_error(affine(s), kind) for s in SCALES)
    row.check("A1", f"{kind}: optical depth, relative", figure, 1e-5, at_most=True, scene="S2")


def test_a1_a_scaled_scene_looks_the_same(row, kind):
    wanted = {name: photo(*pair(thing, EYE)) for name, thing in ways(CUBE, kind).items()}
    assert all(picture.std() > 0.1 for picture in wanted.values())
    worst = naive = np.inf
    for s in SCALES:
        matrix = affine(s, (0, 0, 0))
        camera = dataclasses.replace(EYE, camera_to_world=rescaled(EYE.camera_to_world, s))
        for name, thing in ways(CUBE.under(matrix), kind).items():
            found = photo(*pair(thing, camera))
            worst, naive = min(worst, psnr(found, wanted[name])), min(naive, psnr(found, wanted["composed"]))
    row.check("A1", f"{kind}: picture at scales 1e-3 to 1e3", worst, 60, scene="S3", unit="dB")
    row.check("A1", f"{kind}: against the naive composition", naive, 25, scene="S3", unit="dB")


def pair(thing: tuple, camera) -> tuple:
    """(field, camera, origin) as `photo` takes them."""
    return thing[0], camera, thing[1]


def rescaled(pose: np.ndarray, scale: float) -> np.ndarray:
    """A camera's pose in a world that grew about its origin."""
    pose = pose.copy()
    pose[:3, 3] *= scale
    return pose


# -- A2 ------------------------------------------------------------------------------------------------------


def test_a2_stretch_and_shear_are_exact_when_composed(row, kind):
    linear = [np.diag([1, 1, k]) for k in (0.1, 10.0)] + [np.array(SHEAR)]
    figure = max(worst_depth_error(affine(m), kind) for m in linear)
    row.check("A2", f"{kind}: optical depth, relative", figure, 1e-5, at_most=True, scene="S2")


def test_a2_any_affine_against_the_closed_form(row):
    """Blobs under random affines, mirrored ones too, against the error function."""
    worst = 0.0
    for condition in (1.0, 3.0, 10.0):
        scene = scenes.s2_blobs(condition, count=1, seed=int(condition))
        rays_o, rays_d = rays_at(scene.placed()[0].aabb, 200, seed=5, away=20.0)
        spans = scene.intervals(rays_o, rays_d)[0]
        spans = np.where(spans[:, 1:] > spans[:, :1], spans, 0.0)
        composed = scene.composed()
        found = depth_along(composed, rays_o, rays_d, spans, composed.origin)
        worst = max(worst, worst_relative(found, scene.depths(rays_o, rays_d)[0]))
    row.check("A2", "optical depth against erf, relative", worst, 1e-5, at_most=True, scene="S2")


def test_a2_fusing_to_one_tensor_says_what_a_stretch_costs(row, tmp_path):
    """Between exp(-τ) and exp(-4τ) lie at most 0.472; blocks keep the stretch and predict 0."""
    assert opacity_off(4.0) == pytest.approx(0.472, abs=1e-3)
    write_bundles(tmp_path, scene_of(("thin", Box(1.0, 0.5, tint=scenes.RED), affine((1, 1, 4)))))
    warned = {}
    for kind in ("vm", "blocks"):
        said = done(tmp_path, "fuse", "scene.json", "-o", f"{kind}.rfpack", "--kind", kind, "--no-finetune")
        warned[kind] = [w for w in said["warnings"] if "stretched by 4.00" in w and "0.472" in w]
        (noted,) = said["objects"]
        assert noted["stretch"] == pytest.approx(4.0)
        assert noted["opacity_off"] == (pytest.approx(0.472, abs=1e-3) if kind == "vm" else 0.0)
    figure = len(warned["vm"]) - len(warned["blocks"])
    row.check("A2", "warnings of κ and predicted opacity error", figure, 1, scene="S2")


@pytest.mark.slow
@pytest.mark.parametrize("condition", [2.0, 4.0])
def test_a2_the_measured_opacity_keeps_to_the_prediction(row, condition):
    """A translucent stretched ball distilled to one isotropic tensor, against its closed depth."""
    scene = scene_of((Gaussian(density=4.0, centre=(0, 0, 0), tint=scenes.RED), affine((1, 1, condition))))
    composed = scene.composed()
    settings, numbers = DistilConfig(rays=30_000, steps=400), VMField.size_of(SHAPE, (48, 48, 48))
    generator = torch.Generator().manual_seed(0)
    student = VM.empty(composed, way_of(SHAPE), numbers, generator, "one")
    sampler = RaySampler([composed.occupancy.tight_aabb(0)])
    student, _ = distill(composed, student, sampler, settings, rgb=False)
    rays_o, rays_d = rays_at(composed.occupancy.tight_aabb(0) * 0.5, 1000, seed=5, away=8.0)
    spans = np.tile([0.0, 16.0], (1000, 1))
    found = depth_along(student, rays_o, rays_d, spans, composed.origin)
    off = np.abs(np.exp(-found) - np.exp(-scene.depths(rays_o, rays_d)[0])).max()
    row.check(
        "A2",
        f"opacity off by, κ = {condition:g}",
        off,
        opacity_off(condition),
        at_most=True,
        scene="S2",
    )


# -- A3, A4, A9 ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("degree", [1, 2])
def test_a3_a_mirrored_scene_is_the_mirrored_picture(row, kind, degree):
    scene = scenes.s3_cube(degree, soft=True)
    mirrored = moved_camera(EYE, MIRROR)
    worst = np.inf
    for name, thing in ways(scene.under(MIRROR), kind).items():
        wanted = photo(*pair(ways(scene, kind)[name], EYE), step=STEP)
        worst = min(worst, psnr(photo(*pair(thing, mirrored), step=STEP), wanted))
    row.check("A3", f"{kind}: mirrored picture, degree {degree}", worst, 60, scene="S3", unit="dB")


def test_a3_a_mirror_survives_files(row, tmp_path, kind):
    """scene.json and fused bundle keep the determinant's sign, and the picture."""
    matrix = affine(turn(20) @ np.diag([1.0, -0.7, 1.2]))
    scene = CUBE.under(matrix)
    write_bundles(tmp_path, scene, kind)
    loaded = load_scene(str(tmp_path / "scene.json"))
    assert np.linalg.det(loaded.placed[0].object_to_world[:3, :3]) < 0
    composed = loaded.composed()
    found = photo(composed, EYE, composed.origin)
    if kind == "vm":
        done(tmp_path, "fuse", "scene.json", "-o", "fused.rfpack")
        fused = load_scene(str(tmp_path / "fused.rfpack"))
        assert np.linalg.det(fused.placed[0].object_to_world[:3, :3]) < 0
        again = fused.composed()
        assert psnr(photo(again, EYE, again.origin), found) >= 60
    wanted = photo(*pair(ways(scene, kind)["composed"], EYE))
    row.check("A3", f"{kind}: saved and read again", psnr(found, wanted), 50, scene="S3", unit="dB")


@pytest.mark.parametrize("degree", [1, 2])
def test_a4_turning_object_and_camera_together_changes_nothing(row, kind, degree):
    scene = scenes.s3_cube(degree, soft=True)
    worst, straight = np.inf, ways(scene, kind)
    pictures = {name: photo(*pair(thing, EYE), step=STEP) for name, thing in straight.items()}
    for linear in TURNS:
        matrix = affine(linear, (0.4, -0.3, 0.2))
        for name, thing in ways(scene.under(matrix), kind).items():
            found = photo(*pair(thing, moved_camera(EYE, matrix)), step=STEP)
            worst = min(worst, psnr(found, pictures[name]))
    row.check("A4", f"{kind}: turned together, degree {degree}", worst, 60, scene="S3", unit="dB")


def test_a4_the_red_front_is_seen_from_the_front(row, kind):
    """From 26 sides a probe, red from its front and blue from its back, has the colour of the formula."""
    facing = np.array([[-2.0, 0, 0], [0, 0, 0], [2.0, 0, 0]])
    probe = Box(1.0, 0.5, tint=Tint(facing=facing))
    worst = 0.0
    for linear in (*TURNS, np.diag([-1.0, 1, 1]), turn(50) * 2.5):
        matrix = affine(linear)
        for thing, origin in ways(scene_of((probe, matrix)), kind).values():
            at = np.tile(matrix[:3, 3], (26, 1))
            _, rgb = answers(thing, at, DIRECTIONS_26, origin)
            local = unit(DIRECTIONS_26 @ np.linalg.inv(linear).T)
            wanted = 1 / (1 + np.exp(-(local @ facing.T)))
            worst = max(worst, np.abs(rgb - wanted).max())
    row.check("A4", f"{kind}: colour off from 26 sides", worst, 1 / 255, at_most=True, scene="S3")


def test_a9_one_matrix_is_the_only_truth(row, kind):
    """Shading after turn and scale follows from the one matrix; there is no second rotation to give."""
    placing = {"name", "field", "opacity", "tint", "crops"}
    assert set(inspect.signature(Placed).parameters) - placing == {"object_to_world"}
    with pytest.raises(FormatError, match="expected one of them"):
        make_node("a", source="a.rfpack", matrix=np.eye(4).tolist(), rotation=[0, 0, 0, 1])
    scale, linear = 2.5, turn(70)
    matrix = affine(scale * linear, (0, 0, 0))
    camera = moved_camera(EYE, affine(linear, (0, 0, 0)))
    camera = dataclasses.replace(camera, camera_to_world=rescaled(camera.camera_to_world, scale))
    worst = np.inf
    for name, thing in ways(SOFT.under(matrix), kind).items():
        wanted = photo(*pair(ways(SOFT, kind)[name], EYE), step=STEP)
        worst = min(worst, psnr(photo(*pair(thing, camera), step=STEP * scale), wanted))
    row.check("A9", f"{kind}: turned and scaled by one matrix", worst, 60, scene="S3", unit="dB")


# -- A5, A8 --------------------------------------------------------------------------------------------------


def flattened(condition: float) -> np.ndarray:
    """A turned placement of that condition number."""
    return affine(turn(33) @ np.diag([1.0, 1.0, 1 / condition]) @ turn(-71, (0, 1, 0.3)))


@pytest.mark.parametrize("condition", [1e3, 1e5, 9e5])
def test_a5_nearly_flat_placements_stay_exact(row, condition):
    matrix = flattened(condition)
    placed = Placed("thin", Gaussian(), matrix)
    off = np.abs(placed.world_to_object @ matrix - np.eye(4)).max()
    row.check("A5", f"inverse times matrix, κ = {condition:g}", off, 5e-9, at_most=True)
    figure = worst_depth_error(matrix, "analytic", count=200)
    row.check("A5", f"optical depth, κ = {condition:g}", figure, 1e-5, at_most=True, scene="S2")


@pytest.mark.parametrize("matrix", [flattened(1.1e6), flattened(1e7), affine((1, 0, 1)), affine(np.nan)])
def test_a5_flat_placements_are_refused(row, tmp_path, matrix):
    """By the engine, by the scene graph and by the commands that read it, in one sentence."""
    refused = 0
    with pytest.raises(ValueError):
        Placed("flat", Gaussian(), matrix)
    refused += 1
    with pytest.raises(FormatError):
        make_node("flat", source="a.rfpack", matrix=matrix.tolist())
    refused += 1
    write_bundles(tmp_path, scene_of(("a", Box(1.0, 0.5, tint=scenes.RED), np.eye(4))))
    graph = json.loads((tmp_path / "scene.json").read_text())
    graph["nodes"][0]["matrix"] = matrix.tolist()
    (tmp_path / "scene.json").write_text(json.dumps(graph))
    result = invoke(tmp_path, "render", "scene.json", "-o", "a.png")
    assert result.exit_code == 3 and "Traceback" not in result.stderr
    row.check("A5", "refusals of κ > 1e6", refused + 1, 3)


@pytest.mark.filterwarnings("ignore:.*stretched 2000 times")
def test_a5_two_placements_that_are_flat_only_together(row, tmp_path):
    """A scene of κ = 2e3 added under a κ of 2e3 would be placed by κ = 4e6."""
    write_bundles(tmp_path, scene_of(("a", Box(1.0, 0.5, tint=scenes.RED), np.eye(4))))
    done(tmp_path, "fuse", "scene.json", "-o", "fused.rfpack")
    thin = affine((1, 1, 5e-4))
    write_bundles(tmp_path, scene_of(("b", Box(1.0, 0.5, tint=scenes.BLUE), thin)), file="thin.json")
    numbers = ",".join(f"{v!r}" for v in thin.ravel().tolist())
    words = ("add", "fused.rfpack", "thin.json", "--name", "b", "--matrix", numbers, "-o", "more.rfpack")
    result = invoke(tmp_path, *words)
    assert "with a ratio of at most" in result.stderr and "Traceback" not in result.stderr
    row.check("A5", "exit code of κ = 4e6 by two placements", result.exit_code, 3)


def chain(*matrices: np.ndarray) -> SceneGraph:
    """Nodes each inside the one before, the last a leaf."""
    node = make_node("leaf", source="a.rfpack", matrix=matrices[-1].tolist())
    for i, matrix in reversed(list(enumerate(matrices[:-1]))):
        node = Node(f"level{i}", placement={"matrix": matrix.tolist()}, children=(node,))
    return SceneGraph((node,))


def test_a8_deep_chains_multiply_in_double(row, tmp_path):
    """64 levels: of identities exactly the identity; of shears and turns, each undone later, nearly so."""

    def world(graph):
        write_scene(tmp_path / "deep.json", graph, overwrite=True)
        return next(iter(read_scene(tmp_path / "deep.json").leaves())).object_to_world

    assert np.array_equal(world(chain(*[np.eye(4)] * 64)), np.eye(4))
    bent = [affine(turn(11 * i) @ np.array(SHEAR) * 0.9) for i in range(6)]
    there = [m for m in bent for _ in range(5)]
    back = [np.linalg.inv(m) for m in reversed(there)]
    off = np.abs(world(chain(*there[:16], *back[-16:])) - np.eye(4)).max()
    row.check("A8", "64 levels of shears undone, off by", off, 1e-6, at_most=True)
    with pytest.raises(FormatError, match="in the world"):
        chain(*[affine(10.0)] * 40)


# -- A6, A7 --------------------------------------------------------------------------------------------------


TABLE = ("table", Box(50.0, (0.5, 0.5, 0.25), tint=scenes.SAND), affine(1.0, (0, 0, -0.25)))


def marble_on_table(size: float) -> Scene:
    """S7: a small cube on a table of 1."""
    return scene_of(TABLE, ("marble", Box(8.0, 0.5, tint=scenes.RED), affine(size, (0, 0, size / 2))))


def test_a6_a_tiny_object_is_named_before_fusing(row, tmp_path):
    """One tensor has few voxels for a marble of a fiftieth of the table, and says so."""
    write_bundles(tmp_path, marble_on_table(0.02))
    words = ("fuse", "scene.json", "-o", "vm.rfpack", "--kind", "vm", "--no-finetune", "--max-size", "300kB")
    said = done(tmp_path, *words)
    across = {o["name"]: o["voxels_across"] for o in said["objects"]}
    assert across["marble"] < 8 < across["table"]
    named = [w for w in said["warnings"] if "'marble' is only" in w and "--kind blocks" in w]
    row.check("A6", "warnings of too few voxels across", len(named), 1, scene="S7")


@pytest.mark.parametrize("size", [0.03, pytest.param(1e-3, marks=pytest.mark.slow)])
def test_a6_a_composition_holds_a_tiny_object_as_it_was(row, size):
    """Down to a thousandth of the table, seen from close by."""
    scene = marble_on_table(size)
    found = ways(scene, "vm")
    eye = camera_at(size * np.array([3.0, 2.0, 2.0]), (0, 0, size / 2), size=20)
    truth = scene.image(eye)
    assert truth.std() > 0.05
    for name in ("composed", "composite"):
        shown = psnr(photo(*pair(found[name], eye)), truth)
        row.check("A6", f"close-up of a marble of {size:g}, {name}", shown, 40, scene="S7", unit="dB")


def test_a6_every_object_gets_its_share_of_the_questions(row):
    """Rays at objects of sizes from 1 to 1e-3, with steps as fine as the smallest."""
    parts = [(Box(3.0, 0.5, tint=scenes.RED), affine(10.0**-i, (1.5 * i, 0, 0))) for i in range(4)]
    composed = scene_of(*parts).composed("vm")
    boxes = [composed.occupancy.tight_aabb(0), *(p.aabb for p in composed.placed)]
    generator = torch.Generator().manual_seed(0)
    rays_o, rays_d = RaySampler(boxes).draw(4000, generator)
    hits = []
    for p in composed.placed:
        t0, t1 = scenes.interval_of_box(p.aabb[:3], p.aabb[3:], rays_o, rays_d)
        hits.append(np.mean(t1 > t0))
    row.check("A6", "share of rays through the smallest of four", min(hits), 0.05, scene="S7")


@pytest.mark.parametrize("kind_of_scene", ["composed", "composite"])
def test_a7_a_scene_far_away_looks_the_same(row, kind_of_scene):
    """Scene and camera moved by 1e4 to 1e7 units along the diagonal."""
    scene = scene_of(*[(p.name, p.field, p.object_to_world) for p in scenes.s8_boxes(3, 30).parts])
    eye = camera_at((2.5, 1.7, 1.4), size=48)
    wanted = photo(*pair(ways(scene, "vm")[kind_of_scene], eye))
    assert wanted.std() > 0.1
    for distance in (1e4, 1e6, 1e7):
        far = affine(1.0, (distance, -distance, distance))
        thing = ways(scene.under(far), "vm")[kind_of_scene]
        found = photo(*pair(thing, moved_camera(eye, far)))
        what = f"{kind_of_scene}: moved by {distance:g}"
        bar = 60 if distance <= 1e6 else 40
        row.check("A7", what, psnr(found, wanted), bar, scene="S7", unit="dB")


def test_a7_far_away_through_the_commands(row, tmp_path):
    """The same by files: scene.json and fused bundle at 1e6, camera in transforms.json."""
    from formats.images import read_image

    pictures = {}
    for distance in (0.0, 1e6):
        folder = tmp_path / f"{distance:g}"
        folder.mkdir()
        far = affine(1.0, np.array([1.0, -1, 1]) / 3**0.5 * distance)
        write_bundles(folder, scenes.s8_boxes(2, 30).under(far))
        write_camera(folder / "eye.json", moved_camera(camera_at((2.5, 1.7, 1.4), size=48), far))
        done(folder, "fuse", "scene.json", "-o", "fused.rfpack")
        for name in ("scene.json", "fused.rfpack"):
            done(folder, "render", name, "--cameras", "eye.json", "-o", f"{name}.png")
            pictures[distance, name] = read_image(folder / f"{name}.png")[..., :3] / 255
    for name in ("scene.json", "fused.rfpack"):
        figure = psnr(pictures[1e6, name], pictures[0.0, name])
        row.check("A7", f"{name} at 1e6 through the commands", figure, 60, scene="S7", unit="dB")
    assert read_bundle(tmp_path / "1e+06" / "fused.rfpack").scene.leaves()[0].object_to_world[0, 3] > 5e5
