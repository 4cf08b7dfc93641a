"""`crop` of an imported field with a hash grid: whole commands, and what is left against what there was."""

import numpy as np
import pytest
import torch

from fusedrf_cli.bridge.rendering import renderable
from fusedrf_cli.bridge.scene import load_scene
from fusedrf_cli.engine.composition.crops import Crop, Crops
from fusedrf_cli.engine.fields.base import sampling_step
from fusedrf_cli.engine.fields.streamed import opened
from fusedrf_cli.engine.rendering.volume import render_rays
from tests.analytic.rays import moved_rays, points_in, rays_at
from tests.bridge.conftest import done, invoke
from tests.engine.composition.test_crops import slowly

from .test_instant_ngp import Snapshot, root_of, written

BALL = [0.1, -0.1, 0.05, 0.7]
WORDS = ",".join(map(str, BALL))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A bundle of a snapshot, and two others: a part of it, and the part that was moved."""
    folder = tmp_path_factory.mktemp("imports")
    written(root_of(Snapshot()), folder)
    done(folder, "import", "base.ingp", "-o", "base.rfpack")
    done(folder, "crop", "base.rfpack", "base", WORDS, "-o", "part.rfpack", "--undoable")
    done(folder, "move", "part.rfpack", "base", "-t", "1,2,3", "-r", "20,0,50", "-o", "moved.rfpack")
    return folder


def answers(path, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """σ and rgb of a scene at world points, naively and as the composite answers."""
    composed = load_scene(str(path)).composed()
    dirs = torch.tensor([[0.0, 0.6, 0.8]]).double().expand(len(points), 3)
    sigma, rgb = composed.query(torch.from_numpy(points - composed.origin), dirs)
    return sigma.numpy(), rgb.numpy()


def test_what_is_left_is_what_there_was_to_the_face_of_the_crop(folder):
    (leaf,) = load_scene(str(folder / "base.rfpack")).graph.leaves()
    own = points_in(np.array([-0.7, -0.9, -0.8, 0.9, 0.7, 0.8]), 9000)
    world = own @ leaf.object_to_world[:3, :3].T + leaf.object_to_world[:3, 3]
    whole, rgb = answers(folder / "base.rfpack", world)
    part, same = answers(folder / "part.rfpack", world)
    held = np.linalg.norm(own - BALL[:3], axis=1) <= BALL[3]
    shown = whole > 0
    assert (shown & held).sum() > 200 and (shown & ~held).sum() > 200
    np.testing.assert_allclose(part, whole * held, rtol=1e-5)
    np.testing.assert_allclose(same[shown & held], rgb[shown & held], atol=1e-6)


def test_undo_brings_the_whole_of_it_back(folder):
    done(folder, "undo", "part.rfpack", "-o", "back.rfpack", "-w")
    assert (folder / "back.rfpack").read_bytes() == (folder / "base.rfpack").read_bytes()


def test_a_crop_that_reaches_none_of_its_cells_says_where_it_lies(folder):
    result = invoke(folder, "crop", "base.rfpack", "base", "9,9,9,10,10,10", "-o", "none.rfpack")
    assert result.exit_code == 3 and "its crop holds nothing of it" in result.stderr
    assert not (folder / "none.rfpack").exists()


def test_two_parts_of_one_field_are_one_in_memory(folder):
    done(folder, "duplicate", "part.rfpack", "base", "twin", "-t", "3,0,0", "-o", "two.rfpack", "-w")
    done(folder, "crop", "two.rfpack", "twin", "0,0,0,0.4,0.4,0.4", "-o", "two.rfpack", "-w")
    placed = load_scene(str(folder / "two.rfpack")).placed
    assert placed[0].field is placed[1].field
    assert not np.array_equal(placed[0].crops.aabb, placed[1].crops.aabb)


def test_fusing_keeps_the_numbers_and_the_crop(folder):
    done(folder, "fuse", "part.rfpack", "-o", "kept.rfpack", "-w")
    kept, base = (load_scene(str(folder / name)) for name in ("kept.rfpack", "base.rfpack"))
    assert kept.placed[0].crops and kept.fields[0].member == base.fields[0].member


def test_rays_meet_the_samples_that_lie_in_the_crop(folder):
    """Of a part that was turned and moved, against a loop over its own samples."""
    loaded = load_scene(str(folder / "moved.rfpack"))
    (placed,), (scene, origin) = loaded.placed, renderable(loaded)
    field, crops = opened(placed.field), Crops((Crop.of(tuple(BALL), np.eye(4)),))
    rays = rays_at(crops.aabb, 200, away=2.5)
    wanted = slowly(field, crops, *rays)
    world_o, world_d, longer = moved_rays(placed.object_to_world, *rays)
    step = sampling_step(scene)
    found = render_rays(scene, world_o - origin, world_d, step=step, early_stop=0.0)
    found[:, 4] /= longer
    same = np.abs(found - wanted).max(1) < 5e-3
    assert wanted[:, 3].max() > 0.1 and same.mean() > 0.97
    assert np.abs(found - wanted)[same][:, 3].max() < 5e-5
