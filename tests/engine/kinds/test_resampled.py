"""Students that ask: a field on a lattice is copied, others are fitted, what shows nothing is left out."""

import numpy as np
import pytest
import torch

from fusedrf_cli.bridge.sizes import BundleSizes
from fusedrf_cli.engine.composition.affine import Placed
from fusedrf_cli.engine.composition.composed import ComposedField
from fusedrf_cli.engine.fields.box import DENSITY_SCALE_PER_EXTENT
from fusedrf_cli.engine.kinds import registry
from fusedrf_cli.engine.kinds.builder import BuildRequest
from fusedrf_cli.engine.kinds.resampled import ResampledBuilder, texel_grid_of
from tests.engine.composition.test_resample import ball, likeness, placed
from tests.engine.conftest import BOX, THIRTY_TWO, points_in, random_vm, unit


def asked(scene: ComposedField, limit: int = 4_000_000, degree: int | None = None) -> ResampledBuilder:
    """A dense student of a scene."""
    return ResampledBuilder(
        registry.kind("dense"), scene, BuildRequest(BundleSizes(), limit, sh_degree=degree)
    )


def moved_vm(shift=(0.0, 0.0, 0.0)) -> ComposedField:
    """A scene of one random VM field, moved and not turned."""
    scale = DENSITY_SCALE_PER_EXTENT / float((BOX[3:] - BOX[:3]).mean())
    field = random_vm(THIRTY_TWO, (12, 14, 13), torch.float32, scale=scale)
    matrix = np.eye(4)
    matrix[:3, 3] = shift
    return ComposedField([Placed("one", field, matrix)])


@pytest.mark.parametrize("shift", [(0.0, 0.0, 0.0), (0.3, -1.0, 2.0)])
def test_a_field_on_a_lattice_is_copied_to_what_it_says_everywhere(shift):
    """A plane times a line is linear along every axis between texels, and so are vertices."""
    scene = moved_vm(shift)
    degree = THIRTY_TWO.sh_degree
    student = asked(scene, degree=degree)
    student._shown = scene.occupancy  # nothing of it is hidden here
    plan = student.largest_of(student.plain(), student.request.limit)
    lattice = texel_grid_of(scene)
    field = student.copied(student.kind.plan_at(lattice.aabb, lattice.resolution, plan.storage), lattice)
    points = torch.from_numpy(points_in(BOX, 500))
    points = points + torch.from_numpy(scene.placed[0].object_to_world[:3, 3])
    dirs = torch.from_numpy(unit(np.random.default_rng(1).standard_normal((500, 3))))
    (sigma, rgb), (wanted, colour) = field.query(points, dirs), scene.query(points, dirs)
    assert torch.allclose(sigma, wanted.float(), rtol=1e-4, atol=1e-5)
    # harmonics fitted to one side's directions are shrunk a little where no direction tells of them
    assert (rgb - colour)[wanted > 0].abs().quantile(0.9) < 0.02


def test_a_turned_field_and_two_fields_have_no_lattice():
    field = random_vm(THIRTY_TWO, (12, 14, 13), torch.float32)
    turned = Placed("one", field, placed(field, turned=0.3).object_to_world)
    assert texel_grid_of(ComposedField([turned])) is None
    assert texel_grid_of(ComposedField([placed(field), placed(field, at=(3, 0, 0))])) is None
    assert texel_grid_of(ComposedField([placed(ball())])) is None


def test_a_fitted_scene_looks_like_itself_within_its_bytes():
    scene = ComposedField([placed(ball(voxel=0.06)), placed(ball(voxel=0.1), 0.6, (1.0, 0.2, 0.1))])
    student = asked(scene)
    found = []
    for limit in (700_000, 1_600_000):
        made = student.build(student.plain(), limit)
        assert made.bytes <= limit
        found.append(likeness(made.field, scene, 64))
    assert found[1] > 30 and found[1] > found[0] + 0.3


def test_what_no_ray_sees_has_no_numbers():
    """The middle of a dense ball shows nothing."""
    teacher = ball(density=4000.0, voxel=0.02)
    scene = ComposedField([placed(teacher)])
    student = asked(scene)
    made = student.build(student.plain(), 1_000_000)
    middle = scene.placed[0].object_to_world[:3, 3] + teacher.centre
    assert not made.field.occupancy.contains(middle[None])[0]
    assert made.field.occupancy.contains(middle[None] + [[0.59, 0.0, 0.0]])[0]


def test_too_few_bytes_make_nothing():
    student = asked(ComposedField([placed(ball())]))
    assert student.build(student.plain(), 100) is None
    assert student.smallest() > 100


def test_the_longer_it_learns_the_more_pictures_it_is_shown():
    """By 40,000 rays a second, from one lesson to twelve, at up to five times the rate; without a time budget
    one lesson."""
    student = asked(moved_vm())
    told = [student.distil_config_for(1000, seconds) for seconds in (None, 1.0, 20.0, 60.0, 3600.0)]
    assert [config.rays for config in told] == [400_000, 400_000, 800_000, 2_400_000, 4_800_000]
    rates = [config.rgb_rate / told[0].rgb_rate for config in told]
    assert rates == pytest.approx([1, 1, 2, 5, 5]) and told[3].time_budget == 60.0


def test_kinds_on_vertices_are_known():
    """Without making a field: `convert` lets these grow larger."""
    on_vertices = {kind.name for kind in registry.kinds() if kind.on_vertices}
    assert on_vertices == {"dense", "dense-mlp"}
