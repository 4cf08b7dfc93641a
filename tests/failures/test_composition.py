"""Composition, B1 to B16: ties, media, emptiness, extremes, order, and what mixing kinds and sizes does."""

import itertools
import json
import time
from functools import cache

import numpy as np
import pytest
import torch

from formats.bundle import read_bundle
from formats.errors import FormatError
from formats.records import FieldRecord, decode_field, encode_field
from formats.scene import NODE_KEYS, SceneGraph, make_node, write_scene
from fusedrf_cli.bridge.field_bundle import write_field
from fusedrf_cli.bridge.scene import load_scene, make_field
from fusedrf_cli.engine.composition.affine import Placed
from fusedrf_cli.engine.composition.composed import ComposedField
from fusedrf_cli.engine.composition.composite import as_composite
from fusedrf_cli.engine.distillation.distill import distill
from fusedrf_cli.engine.distillation.sampler import RaySampler
from fusedrf_cli.engine.fields.occupancy import OccupancyGrid
from fusedrf_cli.engine.kinds import registry
from fusedrf_cli.engine.kinds.builder import StorageSetting
from fusedrf_cli.engine.kinds.vm import KIND as VM
from fusedrf_cli.engine.kinds.vm.field import VMField
from fusedrf_cli.engine.rendering.metrics import psnr
from fusedrf_cli.engine.rendering.volume import render_rays
from fusedrf_cli.engine.spaces import unbounded
from fusedrf_cli.errors import InvalidInput
from tests.analytic import scenes
from tests.analytic.export import EXPORTERS, SHAPE, exported, vm_field, way_of
from tests.analytic.fields import Activation, Box
from tests.analytic.files import write_bundles
from tests.analytic.measure import LSB, answers, depth_along, photo, worst_relative
from tests.analytic.rays import affine, points_in, turn, unit
from tests.analytic.scenes import Scene, camera_at, scene_of
from tests.bridge.conftest import TinySettings, done, invoke
from tests.bundles import field_kinds

pytestmark = pytest.mark.usefixtures("quick")

EYE = camera_at((3.2, 2.1, 1.7), size=32)
FOUR = scenes.s8_boxes(4, 20)


def piecewise_pixels(field, origin, scene: Scene, rays_o, rays_d) -> np.ndarray:
    """(N, 4) premultiplied rgb and opacity that a field's own σ and colour give, asked once between every two
    faces a ray crosses: the volume integral where the scene is piecewise even."""
    spans = scene.intervals(rays_o, rays_d)
    hit = spans[..., 1] > spans[..., 0]
    ends = np.sort(np.where(hit[..., None], spans, 0.0).transpose(1, 0, 2).reshape(len(rays_o), -1), 1)
    out, trans = np.zeros((len(rays_o), 4)), np.ones(len(rays_o))
    for t0, t1 in itertools.pairwise(ends.T):
        sigma, rgb = answers(field, rays_o + ((t0 + t1) / 2)[:, None] * rays_d, rays_d, origin)
        light = trans * -np.expm1(-sigma * (t1 - t0))
        out[:, :3] += light[:, None] * rgb
        trans = trans - light
    out[:, 3] = 1 - trans
    return out


def around(scene: Scene, count: int = 400, seed: int = 3) -> tuple[np.ndarray, np.ndarray]:
    """Points and directions (count, 3) in and a little around a scene."""
    boxes = np.stack([p.aabb for p in scene.placed()])
    box = np.concatenate([boxes[:, :3].min(0), boxes[:, 3:].max(0)])
    return points_in(box, count, seed, margin=0.1), unit(points_in(box, count, seed + 1) + 1e-3)


# -- B1, B2, B5 ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("density", [1.0, 1e5, 1e20])
def test_b1_the_denser_wins_in_any_order(row, density):
    """Three cubes in one place, densities a millionth apart: alpha is 1 of all of them from 1e4 on."""
    parts = [
        (name, Box(density * (1 + i * 1e-6), 0.5, tint=tint), np.eye(4))
        for i, (name, tint) in enumerate((("a", scenes.RED), ("b", scenes.GREEN), ("c", scenes.BLUE)))
    ]
    points, dirs = around(scene_of(*parts))
    alone = scene_of(parts[2]).composed("vm")
    wanted = [answers(f, points, dirs) for f in (alone, as_composite(alone))]
    assert np.count_nonzero(wanted[0][0]) > 100
    flips = 0
    for order in itertools.permutations(parts):
        composed = scene_of(*order).composed("vm")
        for field, (sigma, rgb) in zip((composed, as_composite(composed)), wanted, strict=True):
            found = answers(field, points, dirs, composed.origin)
            flips += np.count_nonzero((found[1] != rgb).any(1) & (sigma > 0))
            flips += np.count_nonzero(np.abs(found[0] - sigma) > 2e-7 * sigma)
    row.check(
        "B1", f"answers that differ with the order, σ = {density:g}", flips, 0, at_most=True, scene="S4"
    )


def test_b1_ties_go_to_the_lower_node(row):
    """The rule of DESIGN, in the naive composition and in the fast one alike."""
    wrong = 0
    for first, second in ((scenes.RED, scenes.BLUE), (scenes.BLUE, scenes.RED)):
        scene = scene_of((Box(50.0, 0.5, tint=first), np.eye(4)), (Box(50.0, 0.5, tint=second), np.eye(4)))
        points, dirs = around(scene)
        for field in (scene.composed("vm"), as_composite(scene.composed("vm"))):
            sigma, rgb = answers(field, points, dirs)
            wrong += np.count_nonzero(np.abs(rgb - first(points, dirs)).max(1)[sigma > 0] > 1e-5)
    row.check("B1", "ties not won by the lower node", wrong, 0, at_most=True, scene="S4")


@pytest.mark.parametrize("count", [4, pytest.param(30, marks=pytest.mark.slow)])
@pytest.mark.parametrize("way", ["composed", "composite"])
def test_b2_coplanar_faces_do_not_flicker(row, way, count):
    """Two cubes in one place, densities within ±2 %: which wins is a function of the place alone, so that the
    frames of a camera that turns by 1e-5 rad each look the same."""
    scene = scenes.s4_twins(noise=0.02)
    composed = scene.composed("vm")
    field = composed if way == "composed" else as_composite(composed)
    frames = []
    for i in range(count):
        angle = 1e-5 * i
        eye = camera_at((2.2 * np.cos(0.6 + angle), 2.2 * np.sin(0.6 + angle), 0.9), size=32)
        frames.append(photo(field, eye, composed.origin))
    both = np.mean(np.asarray(frames[0])[12:20, 12:20].std((0, 1)))
    assert both > 0.05  # both colours are there to flicker between
    flicker = float(np.std(frames, axis=0).mean() / LSB)
    row.check("B2", f"{way}: flicker of {count} frames, LSB", flicker, 0.5, at_most=True, scene="S4")


def test_b2_the_winner_is_that_of_the_rule(row):
    """Where the truth's densities differ by more than rounding, the engine's winner is the truth's."""
    scene = scenes.s4_twins(offset=0.5, noise=0.02)
    points, dirs = around(scene, 4000)
    sigmas = scene.sigmas(points, dirs)
    clear = np.abs(sigmas[0] - sigmas[1]) > 1e-5 * sigmas.max(0)
    wanted = scene.answer(points, dirs, "max")[1]
    assert clear.sum() > 1000
    wrong = 0
    for field in (scene.composed("vm"), as_composite(scene.composed("vm"))):
        rgb = answers(field, points, dirs, scene.composed().origin)[1]
        wrong += np.count_nonzero(np.abs(rgb - wanted)[clear & (sigmas.max(0) > 0)].max(1) > 1e-4)
    row.check("B2", "winners that are not the denser", wrong, 0, at_most=True, scene="S4")


ROD = scene_of(
    ("box", Box(60.0, 0.5, tint=scenes.RED), affine(turn(20), (0, 0, 0))),
    ("rod", Box(80.0, (1.2, 0.15, 0.15), tint=scenes.BLUE), affine(turn(-15, (0, 1, 1)), (0, 0, 0))),
)


@pytest.mark.parametrize("way", ["composed", "composite"])
def test_b5_a_rod_through_a_box(row, way):
    """Every winner is that of the analytic union; the pixels along its outlines are reported apart."""
    composed = ROD.composed("vm")
    field = composed if way == "composed" else as_composite(composed)
    points, dirs = around(ROD, 20_000)
    faces = [
        np.abs(
            np.abs((points - p.object_to_world[:3, 3]) @ np.linalg.inv(p.object_to_world[:3, :3]).T)
            - p.field.aabb[3:]
        ).min(1)
        for p in ROD.parts
    ]
    clear = np.min(faces, 0) > 1e-5
    sigma, rgb = answers(field, points, dirs, composed.origin)
    truth = ROD.answer(points, dirs, "max")
    off = (np.abs(sigma - truth[0]) > 1e-4 * truth[0]) | (
        (np.abs(rgb - truth[1]).max(1) > 1e-4) & (truth[0] > 0)
    )
    row.check("B5", f"{way}: wrong winners", np.count_nonzero(off & clear), 0, at_most=True, scene="S4")
    wanted = ROD.image(EYE)
    found = photo(field, EYE, composed.origin, step=0.004)
    band = outline(wanted)
    what = f"{way}: against the truth, away from outlines"
    row.check("B5", what, psnr(found[~band], wanted[~band]), 50, scene="S4", unit="dB")
    row.check("B5", f"{way}: in a band of 4 px", psnr(found[band], wanted[band]), 25, scene="S4", unit="dB")


def outline(picture: np.ndarray, width: int = 2) -> np.ndarray:
    """(H, W) bool: pixels within `width` of a step in a picture."""
    from scipy.ndimage import binary_dilation

    steps = np.zeros(picture.shape[:2], bool)
    for axis in (0, 1):
        jump = np.abs(np.diff(picture, axis=axis)).max(2) > 0.02
        steps |= np.pad(jump, [(0, 1), (0, 0)] if axis == 0 else [(0, 0), (0, 1)])
    return binary_dilation(steps, np.ones((3, 3)), iterations=width)


# -- B3, B4, B6 ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("depths", [(0.7, 8.0), pytest.param(scenes.DEPTHS, marks=pytest.mark.slow)])
@pytest.mark.parametrize("rule", ["max", "add"])
def test_b3_media_through_each_other(row, kind, rule, depths):
    """Opacity of two slabs one behind the other and through each other, up to 4 x 4 depths, at three
    angles."""
    worst = 0.0
    rays_d = np.array([[np.cos(a), np.sin(a), 0.0] for a in (0.0, 0.4, 0.9)])
    for a, b, overlap in itertools.product(depths, depths, (False, True)):
        scene = scenes.s1_slabs(a, b, overlap)
        composed = scene.composed(kind, rule)
        ways = [composed]
        if rule == "max" and kind == "vm":
            ways.append(as_composite(composed))
        depth = (max(a, b) if overlap and rule == "max" else a + b) / rays_d[:, 0]
        for field in ways:
            found = piecewise_pixels(field, composed.origin, scene, -5 * rays_d, rays_d)
            worst = max(worst, np.abs(found[:, 3] - (1 - np.exp(-depth))).max())
            worst = max(worst, np.abs(found - scene.pixels(-5 * rays_d, rays_d, rule)).max())
    row.check("B3", f"{kind}, {rule}: opacity and colour off by", worst, 1e-4, at_most=True, scene="S1")


@pytest.mark.parametrize("way", ["composed", "composite"])
def test_b4_fog_around_solids(row, way):
    """The fog does not feel the solids outside their matter: bit for bit where a ray misses them."""
    room = scenes.s6_room()
    inside = Scene(room.parts[:3])  # without the rod, which would move the box that rays start from
    pictures = {}
    for name, scene in (("with", inside), ("without", Scene(room.parts[:1]))):
        composed = scene.composed("vm")
        field = composed if way == "composed" else as_composite(composed)
        rays_o, rays_d = EYE.rays()
        pictures[name] = render_rays(field, rays_o - composed.origin, rays_d, step=0.05)
    boxes = [p.aabb for p in inside.placed("vm")[1:]]
    t = [scenes.interval_of_box(b[:3] - 0.1, b[3:] + 0.1, rays_o, rays_d) for b in boxes]
    misses = ~np.any([t1 > t0 for t0, t1 in t], 0)
    fogged = misses & (pictures["without"][:, 3] > 0.05)
    assert fogged.sum() > 100
    changed = np.abs(pictures["with"] - pictures["without"])[fogged, :4]
    if way == "composed":
        row.check("B4", f"{way}: fog changed beside solids", changed.max(), 0, at_most=True, scene="S6")
    else:  # whose steps are as coarse as the block they are in, counted in the finest one's
        figure = -10 * np.log10((changed**2).mean())
        row.check("B4", f"{way}: fog beside solids as it was", figure, 40, scene="S6", unit="dB")
    composed = room.composed("vm")
    field = composed if way == "composed" else as_composite(composed)
    found = piecewise_pixels(field, composed.origin, room, rays_o, rays_d)
    off = np.abs(found - room.pixels(rays_o, rays_d)).max()
    row.check("B4", f"{way}: room against slab algebra", off, 1e-4, at_most=True, scene="S6")


@pytest.mark.parametrize("rule", ["max", "add"])
def test_b6_the_empty_lends_no_colour(row, kind, rule):
    """Thin fog of σ = 0.1 in the boxes of seven fields that are empty there."""
    nothing = [(Box(0.0, 0.5, tint=scenes.BLUE), affine(1.0, (0, 0, 0.01 * i))) for i in range(7)]
    scene = scene_of(*nothing, (Box(0.1, 0.5, tint=scenes.RED), np.eye(4)))
    composed = scene.composed(kind, rule)
    points, dirs = (
        points_in(np.array([-0.4, -0.4, -0.4, 0.4, 0.4, 0.4]), 300),
        unit(points_in(np.ones(6) * [-1, -1, -1, 1, 1, 1], 300)),
    )
    worst = 0.0
    for field in [composed] + ([as_composite(composed)] if kind == "vm" and rule == "max" else []):
        worst = max(
            worst, np.abs(answers(field, points, dirs, composed.origin)[1] - scenes.RED(points, dirs)).max()
        )
    row.check("B6", f"{kind}, {rule}: colour off by", worst, 1e-5, at_most=True, scene="S9")


# -- B7, B8, B9, B10 -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("way", ["blocks", "vm"])
def test_b7_fusing_with_an_empty_field_is_fusing_without(row, tmp_path, way):
    box = ("box", Box(20.0, 0.4, tint=scenes.RED), affine(turn(20)))
    empty = ("empty", scenes.s9_odd()["empty"], affine(1.0, (2, 1, 0)))
    write_bundles(tmp_path, scene_of(box, empty))
    write_bundles(tmp_path, scene_of(box), file="alone.json")
    words = ("--kind", way, "--no-finetune", "--max-size", "300kB")
    said = done(tmp_path, "fuse", "scene.json", "-o", "both.rfpack", *words)
    done(tmp_path, "fuse", "alone.json", "-o", "alone.rfpack", *words)
    assert any("'empty' is empty" in w for w in said["warnings"])
    both, alone = (read_bundle(tmp_path / f"{n}.rfpack") for n in ("both", "alone"))
    same = list(both.fields) == list(alone.fields)  # members are named for their bytes
    row.check("B7", f"{way}: the same field bit for bit", same, 1, scene="S9")


def test_b7_nothing_but_empty_fields(row, tmp_path):
    write_bundles(tmp_path, scene_of(("empty", scenes.s9_odd()["empty"], np.eye(4))))
    result = invoke(tmp_path, "fuse", "scene.json", "-o", "fused.rfpack")
    assert "are empty" in result.stderr and not (tmp_path / "fused.rfpack").exists()
    row.check("B7", "exit code where all is empty", result.exit_code, 3, scene="S9")
    done(tmp_path, "render", "scene.json", "-o", "empty.png", "--size", "20x20")


def test_b8_an_opaque_box_from_inside(row, kind):
    """The first cell stops the ray, in its own colour."""
    field = exported(scenes.s9_odd()["full"], kind)
    rays_d = unit(points_in(Box(half=1.0).aabb, 200))
    for thing in (field, ComposedField([Placed("full", field, np.eye(4))])):
        found = render_rays(thing, np.zeros((200, 3)) + 0.01, rays_d)
        off = np.abs(found[:, :4] - [*scenes.RED(rays_d, rays_d)[0], 1.0]).max()
        row.check(
            "B8", f"{kind}: opacity and colour from inside, off by", off, 1 / 255, at_most=True, scene="S9"
        )


def test_b8_an_opaque_teacher_gives_finite_losses(row):
    teacher = scene_of((Box(1e8, 0.5, tint=scenes.RED), np.eye(4))).composed("vm")
    settings, numbers = TinySettings(steps=20, rays=1000), VMField.size_of(SHAPE, (16, 16, 16))
    student = VM.empty(teacher, way_of(SHAPE), numbers, torch.Generator().manual_seed(0), "one")
    student, report = distill(teacher, student, RaySampler([teacher.occupancy.tight_aabb(0)]), settings)
    told = (report.psnr_before_rgb, report.psnr_after_rgb, student.params.abs().max())
    row.check("B8", "finite figures of a distilled opaque box", np.isfinite(told).sum(), 3, scene="S9")


@pytest.mark.parametrize("name", scenes.S9_VALUES)
def test_b9_hostile_numbers_are_refused_by_name_or_harmless(row, tmp_path, name):
    """NaN and infinity never load; what is finite renders finite, in either order, or does not load."""
    value = scenes.S9_VALUES[name]
    field = scenes.s9_hostile(value)
    arrays, metadata = field.state()
    record = FieldRecord("vm", arrays, metadata)
    if not np.isfinite(value):
        clean, _ = vm_field(Box(5.0, 0.5, tint=scenes.RED)).state()
        data = bytearray(encode_field(FieldRecord("vm", clean, metadata), "float32"))
        spoiled = bytes(data).replace(
            np.ascontiguousarray(clean["tensor_0.density_line_0"]).tobytes(),
            np.ascontiguousarray(arrays["tensor_0.density_line_0"]).tobytes(),
        )
        with pytest.raises(FormatError, match=r"'tensor_0.density_line_0' has 1 of 256 values"):
            decode_field(spoiled, "bundle")
        row.check("B9", f"{name} refused with array and count", 1, 1, scene="S9")
        return
    try:
        loaded = make_field(decode_field(encode_field(record, "float32"), "bundle"), "bundle")
    except InvalidInput as error:
        assert name == "1e30" and "would reach 5.77e+31 by arrays 'tensor_0.density*'" in str(error)
        row.check("B9", f"{name} refused with array and size", 1, 1, scene="S9")
        return
    other = vm_field(Box(5.0, 0.5, tint=scenes.BLUE))
    pictures = []
    for order in ((loaded, other), (other, loaded)):
        composed = ComposedField([Placed(f"n{i}", f, np.eye(4)) for i, f in enumerate(order)])
        pictures += [photo(f, EYE) for f in (composed, as_composite(composed))]
    assert all(np.isfinite(p).all() for p in pictures)
    row.check("B9", f"{name}: pictures finite", sum(np.isfinite(p).all() for p in pictures), 4, scene="S9")


def test_b9_finite_numbers_that_multiply_to_infinity_are_refused(row):
    """1e30 times 1e30 is infinite in float32, and the difference of two such is NaN."""
    field = vm_field(Box(5.0, 0.5, tint=scenes.RED))
    refused = 0
    for what in ("density", "colour"):
        arrays, metadata = field.state()
        arrays = {k: v.copy() for k, v in arrays.items()}
        arrays[f"tensor_0.{what}_plane_1"][..., 2], arrays[f"tensor_0.{what}_line_1"][..., 2] = 1e30, -1e30
        arrays["tensor_0.colour_basis"][..., 10] = 1.0  # mode 1, component 2
        with pytest.raises(InvalidInput, match=f"would reach .* by arrays 'tensor_0.{what}"):
            make_field(FieldRecord("vm", arrays, metadata), "bundle")
        refused += 1
    arrays, metadata = exported(Box(5.0, 0.5, tint=scenes.RED), "vm-mlp").state()
    arrays["network.0.weight"], arrays["network.1.weight"] = (
        arrays[f"network.{i}.weight"] * np.float32(1e30) for i in (0, 1)
    )
    with pytest.raises(InvalidInput, match="logit would reach"):
        make_field(FieldRecord("vm-mlp", arrays, metadata), "bundle")
    row.check("B9", "overflowing products refused", refused + 1, 3, scene="S9")


def test_b9_negative_densities_cannot_be_stored(row):
    """σ = scale softplus(.) and the scale is positive."""
    arrays, metadata = vm_field(Box(5.0, 0.5, tint=scenes.RED)).state()
    metadata["tensors"][0]["scale"] = -1.0
    with pytest.raises(InvalidInput, match="scale should be positive"):
        make_field(FieldRecord("vm", arrays, metadata), "bundle")
    row.check("B9", "negative scale refused", 1, 1, scene="S9")


@pytest.mark.skipif("crop" not in NODE_KEYS, reason="a node of scene.json has no crop box yet")
def test_b10_a_crop_box_keeps_floaters_out(row, tmp_path):
    """A node's `crop`, six numbers in its object's frame, cuts what lies outside."""
    write_bundles(tmp_path, scene_of(("box", Box(20.0, 0.5, tint=scenes.RED), np.eye(4))))
    graph = json.loads((tmp_path / "scene.json").read_text())
    graph["nodes"][0]["crop"] = [-0.5, -0.5, -0.5, 0.0, 0.5, 0.5]
    (tmp_path / "scene.json").write_text(json.dumps(graph))
    composed = load_scene(str(tmp_path / "scene.json")).composed()
    points = points_in(np.array([0.01, -0.5, -0.5, 0.5, 0.5, 0.5]), 200)
    sigma, _ = answers(composed, points, unit(points), composed.origin)
    row.check("B10", "density outside the crop box", sigma.max(), 0.0, at_most=True)


# -- B11, B12 ------------------------------------------------------------------------------------------------


def copies(count: int) -> Scene:
    """One box, many times, on a lattice."""
    box = Box(40.0, 0.3, tint=scenes.RED)
    places = itertools.islice(itertools.product(range(10), repeat=2), count)
    return scene_of(*[(box, affine(turn(7 * i, (0, 0, 1)), (x, y, 0))) for i, (x, y) in enumerate(places)])


def test_b11_a_hundred_copies_are_stored_once(row, tmp_path):
    sizes, seconds = {}, {}
    for count in (1, 100):
        write_bundles(tmp_path, copies(count), file=f"{count}.json")
        started = time.perf_counter()
        said = done(tmp_path, "fuse", f"{count}.json", "-o", f"{count}.rfpack")
        sizes[count], seconds[count] = said["bytes"], time.perf_counter() - started
    grown = (sizes[100] - sizes[1]) / 1000
    row.check("B11", "kB that 99 more copies cost", grown, 100, at_most=True, seconds=seconds[100])
    fields = load_scene(str(tmp_path / "100.rfpack")).fields
    assert len({field.member for field in fields}) == 1 and len(fields) == 100


@pytest.mark.parametrize("count", [6, pytest.param(24, marks=pytest.mark.slow)])
def test_b12_order_changes_no_answer(row, kind, count):
    """Orders of four overlapping objects, under max and add, and as a composite: bit for bit."""
    parts = [
        (f"p{i}", Box(d, 0.5, tint=t), affine(turn(17 * i), (0.25 * i, 0, 0)))
        for i, (d, t) in enumerate(zip((3.0, 5.0, 8.0, 2.0), scenes.HUES[:4], strict=True))
    ]
    points, dirs = around(scene_of(*parts), 1500)
    first, differing = {}, 0
    fields = {name: exported(field, kind) for name, field, _ in parts}
    for order in list(itertools.permutations(parts))[:: 24 // count]:
        placed = [Placed(name, fields[name], matrix) for name, _, matrix in order]
        found = {rule: ComposedField(placed, rule) for rule in ("max", "add")}
        origin = found["max"].origin
        if all(type(p.field) is VMField for p in placed):
            found["composite"] = as_composite(found["max"])
        for way, field in found.items():
            sigma, rgb = answers(field, points, dirs, origin)
            wanted = first.setdefault(way, (sigma, rgb))
            shown = sigma > 0
            differing += np.count_nonzero(sigma != wanted[0]) + np.count_nonzero((rgb != wanted[1])[shown])
    assert np.count_nonzero(first["max"][0]) > 300
    row.check("B12", f"{kind}: answers that differ in {count} orders", differing, 0, at_most=True, scene="S8")


@pytest.mark.parametrize("count", [2, pytest.param(24, marks=pytest.mark.slow)])
def test_b12_order_changes_no_distilled_field(row, tmp_path, count):
    """The same seed, and the nodes in other orders: the same bytes of the one tensor."""
    members = set()
    for i, order in enumerate(itertools.islice(itertools.permutations(FOUR.parts), 0, 24, 24 // count)):
        write_bundles(tmp_path, Scene(order), file=f"{i}.json")
        words = ("--kind", "vm", "--max-size", "300kB", "--from-scratch")
        done(tmp_path, "fuse", f"{i}.json", "-o", f"{i}.rfpack", *words)
        members |= set(read_bundle(tmp_path / f"{i}.rfpack").fields)
    row.check("B12", f"distilled fields of {count} orders", len(members), 1, at_most=True, scene="S8")


# -- B13 to B16 ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("radius", scenes.S11_RADII)
def test_b13_objects_far_out_keep_their_depth(row, kind, radius):
    scene = scenes.s11_far_objects(radius)
    rays_d = unit(
        np.array([radius, 0, 0]) + 0.05 * radius * points_in(np.array([-1.0, -1, -1, 1, 1, 1]), 100)
    )
    rays_o = np.zeros((100, 3)) - 0.4 * radius * np.array([1.0, 0, 0])
    spans = scene.intervals(rays_o, rays_d)[0]
    spans = np.where(spans[:, 1:] > spans[:, :1], spans, 0.0)
    composed = scene.composed(kind)
    found = depth_along(composed, rays_o, rays_d, spans, composed.origin, nodes=8)
    figure = worst_relative(found, scene.depths(rays_o, rays_d)[0])
    row.check("B13", f"{kind}: depth at r = {radius:g}, relative", figure, 1e-5, at_most=True, scene="S11")


def test_b13_a_contracted_sky_keeps_its_depth(row, kind):
    """A place of one even density in its coordinates is σ / n² per length of its frame, n the largest
    coordinate where that is beyond the core (MERF, eq. 2): from the middle a ray along an axis meets a depth
    of 1 + (1 - 1/r) times it up to r, through r = 1 and whatever lies behind."""
    made = registry.kind(kind)
    if not made.trains:
        pytest.skip(f"{kind} does not fill space by itself")
    field = made.create(
        made.untrained(unbounded.WHOLE, 17, StorageSetting()), torch.Generator().manual_seed(0), "sky"
    )
    field = field.with_occupancy(OccupancyGrid.full(unbounded.WHOLE, 8, unbounded))
    field.params.zero_()
    x = np.array([[1.0, 0, 0]])
    while (even := float(answers(field, 0.5 * x, x)[0][0])) > 1:  # numbers that are densities: thinner
        field.params.sub_(1.0)
    for radius in (0.5, 1 - 1e-6, 1 + 1e-6, 2.0, 10.0, 100.0, 1000.0):
        at = radius * np.array([[1.0, 0.3, -0.7], [-0.2, -1.0, 0.1], [0.6, 0.9, 1.0]])
        found = answers(field, at, unit(at))[0] * max(1.0, radius) ** 2
        figure = np.abs(found / even - 1).max()
        what = f"{kind}: σ of a place at r = {radius:g}, relative"
        row.check("B13", what, figure, 1e-5, at_most=True, scene="S11")
    for radius, depth in ((0.5, 1.5), (1.0, 1.0), (2.0, 0.5)):
        seen = float(render_rays(field, radius * x, x, step=1e-3, early_stop=0.0)[0, 3])
        figure = abs(-np.log1p(-seen) / even / depth - 1)
        what = f"{kind}: depth from r = {radius:g} on, relative"
        row.check("B13", what, figure, 5e-3, at_most=True, scene="S11")


@cache
def portrait(kind: str) -> np.ndarray:
    """The soft cube composed with a box, in one kind."""
    soft = scenes.s3_cube(1, soft=True).parts[0]
    box = Box(60.0, (0.2, 0.5, 0.3), tint=scenes.GREEN)
    scene = scene_of(("soft", soft.field, affine(turn(30))), ("box", box, affine(1.0, (-0.9, 0.3, 0.1))))
    composed = scene.composed(kind)
    return photo(composed, EYE, composed.origin, step=0.02)


@pytest.mark.parametrize("pair", list(itertools.combinations(sorted(field_kinds()), 2)), ids="-".join)
def test_b14_kinds_agree_on_the_same_scene(row, pair):
    figure = psnr(portrait(pair[0]), portrait(pair[1]))
    assert portrait(pair[0]).std() > 0.1
    row.check("B14", f"{pair[0]} against {pair[1]}", figure, 50, scene="S3", unit="dB")


def test_b14_kinds_mix_in_one_scene(row):
    """Every other object of another kind, against all of one kind."""
    kinds = itertools.cycle(sorted(EXPORTERS))
    mixed = [
        Placed(p.name, exported(p.field, kind), p.object_to_world)
        for p, kind in zip(FOUR.parts, kinds, strict=False)
    ]
    mixed, pure = ComposedField(mixed), FOUR.composed("vm")
    figure = psnr(photo(mixed, EYE, mixed.origin), photo(pure, EYE, pure.origin))
    row.check("B14", "kinds mixed in one scene", figure, 50, scene="S8", unit="dB")


class Ramp(Box):
    """A surface in x: σ = scale softplus(steepness (x - at) / voxel), so that interpolating before or after
    the activation puts it in different places."""

    def __init__(self, steepness: float = 6.0, at: float = 0.013):
        super().__init__(density=1.0, half=0.5, tint=scenes.RED)
        self.slope, self.at = steepness / self.voxel_size, at
        self.scale = 30.0

    @property
    def activation(self):
        one = np.ones_like
        return Activation(self.scale, ((lambda x: self.slope * (x - self.at) + 8.0, one, one),))

    def sigma(self, points):
        return self.scale * np.logaddexp(0, self.slope * (points[:, 0] - self.at))


def surface(field, origin=0.0) -> float:
    """x at which the optical depth from -x on passes ln 2, along the axis."""
    x = np.linspace(-0.499, 0.499, 20_001)
    points = np.stack([x, 0 * x, 0 * x], 1)
    sigma, _ = answers(field, points, np.tile([1.0, 0, 0], (len(x), 1)), origin)
    return float(x[np.searchsorted(np.cumsum(sigma) * (x[1] - x[0]), np.log(2))])


def test_b15_surfaces_stay_where_they_were(row, kind):
    """Stored in half precision, resampled finer, coarser and off the lattice, and made smaller."""
    ramp = Ramp()
    wanted = surface(ramp)
    field = exported(ramp, kind)
    arrays, metadata = field.state()
    record = decode_field(encode_field(FieldRecord(kind, arrays, metadata), "float16"), "bundle")
    conversions = {"as it is": field, "stored": make_field(record, "bundle")}
    if hasattr(field, "resampled"):
        for n in (11, 23, 46):
            conversions[f"{n} texels"] = field.resampled(field.aabb, (n, n, n))
    if type(field) is VMField:
        made = registry.kind(field.kind)
        voxel = float((field.box[3:] - field.box[:3]).max()) / 11
        conversions["shrunk"] = made.reduction(made.outline(field), voxel, StorageSetting()).make(field)
    shifts = {name: abs(surface(f) - wanted) / ramp.voxel_size for name, f in conversions.items()}
    row.check("B15", f"{kind}: surface moved, voxels", max(shifts.values()), 0.05, at_most=True, scene="S3")


def test_b16_every_object_is_told_its_voxels(row, tmp_path):
    """32 texels on a large box beside 64 on a small one: under a small --max-size the report says who is
    held coarser than it was; with room for all, nobody is."""
    large, small = Box(30.0, 1.0, tint=scenes.SAND), Box(30.0, 0.3, tint=scenes.RED)
    composed = ComposedField(
        [
            Placed("large", vm_field(large, (32,) * 3), np.eye(4)),
            Placed("small", vm_field(small, (64,) * 3), affine(turn(20), (1.3, 0, 0))),
        ]
    )

    nodes = []
    for p in composed.placed:
        write_field(str(tmp_path / f"{p.name}.rfpack"), p.field, p.name, precision="float16", overwrite=False)
        nodes.append(make_node(p.name, source=f"{p.name}.rfpack", matrix=p.object_to_world.tolist()))
    write_scene(tmp_path / "scene.json", SceneGraph(tuple(nodes)))
    told = 0
    for size, coarse in (("25MB", 0), ("120kB", 1)):
        said = done(tmp_path, "fuse", "scene.json", "-o", f"{size}.rfpack", "--max-size", size)
        objects = {o["name"]: o for o in said["objects"]}
        assert objects["small"]["own_voxel"] == pytest.approx(0.6 / 63, rel=1e-6)
        assert objects["large"]["own_voxel"] == pytest.approx(2 / 31, rel=1e-6)
        found = [o for o in objects.values() if o["held_voxel"] > 1.001 * o["own_voxel"]]
        assert bool(found) == bool(coarse)
        told += any("coarser voxels than their own" in w for w in said["warnings"]) == bool(coarse)
    row.check("B16", "fusions that tell who is held coarser", told, 2, scene="S7")
