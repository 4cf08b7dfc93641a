"""Checkpoints of splats, written here as their trainers write them, against a .ply of the same splats."""

import json
import math
import random

import numpy as np
import pytest
import torch

from formats.bundle import OpenBundle
from formats.errors import FormatError, UnknownCheckpoint
from formats.foreign.systems import open_checkpoint
from formats.splats import splats as limits
from formats.splats.reading import read_splats
from fusedrf_cli import verbs
from fusedrf_cli.bridge.importing import READERS, splat_checkpoints
from fusedrf_cli.bridge.memory import Memory
from fusedrf_cli.errors import InvalidInput, UsageProblem
from fusedrf_cli.python import open_scene
from tests.formats.foreign.samples import spoilt
from tests.formats.splats import writers
from tests.formats.splats.writers import Content, content

ARRAYS = "centres", "scales", "rotations", "opacities", "harmonics"
TURN, SCALE, SHIFT = 0.7, 0.4, np.array([0.3, -0.2, 0.1])
FRAME = np.array([[1, 0, 0], [0, math.cos(TURN), -math.sin(TURN)], [0, math.sin(TURN), math.cos(TURN)]])


def tensor(values: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(values.astype(np.float32))


def of_all(splats: Content) -> dict[str, torch.Tensor]:
    """What every trainer learns of splats; quaternions are not of length 1."""
    return {
        "means": tensor(splats.centres),
        "scales": tensor(np.log(splats.scales)),
        "quats": tensor(1.7 * splats.rotations),
        "opacities": tensor(writers.logit(splats.opacities)),
    }


def save_3dgs(folder, splats: Content, degree: int | None = None, step: int = 30000, **changed):
    """`torch.save((gaussians.capture(), iteration), model_path + "/chkpnt" + …)`, after a step of Adam."""
    coefficients = splats.harmonics.shape[1]
    first, rest = (tensor(x).contiguous() for x in (splats.harmonics[:, :1], splats.rest))
    own = of_all(splats)
    arrays = {"_xyz": own["means"], "_features_dc": first, "_features_rest": rest, "_scaling": own["scales"]}
    arrays |= {"_rotation": own["quats"], "_opacity": own["opacities"][:, None]} | changed
    arrays = {name: torch.nn.Parameter(value) for name, value in arrays.items()}
    groups = [{"params": [value], "lr": 1e-9, "name": name} for name, value in arrays.items()]
    optimizer = torch.optim.Adam(groups, lr=0.0, eps=1e-15)
    for value in arrays.values():
        value.grad = torch.zeros_like(value)
    optimizer.step()
    seen = torch.zeros(len(splats)), torch.zeros(len(splats), 1), torch.zeros(len(splats), 1)
    degree = math.isqrt(coefficients) - 1 if degree is None else degree
    model = (degree, *arrays.values(), *seen, optimizer.state_dict(), np.float32(4.5))
    torch.save((model, step), folder / f"chkpnt{step}.pth")
    return folder / f"chkpnt{step}.pth"


def save_gsplat(folder, splats: Content, name="ckpt_29999_rank0.pt", settings=None, more=None, **changed):
    """`torch.save(data, f"{ckpt_dir}/ckpt_{step}_rank{world_rank}.pt")` of simple_trainer.py, whose harmonics
    are parts of one array."""
    colours = tensor(splats.harmonics)
    state = of_all(splats) | {"sh0": colours[:, :1], "shN": colours[:, 1:]} | changed
    state = torch.nn.ParameterDict({n: value for n, value in state.items() if value is not None}).state_dict()
    (folder / "ckpts").mkdir(exist_ok=True)
    torch.save({"step": 29999, "splats": state} | (more or {}), folder / "ckpts" / name)
    for file, text in (settings or {}).items():
        (folder / file).write_text(text)
    return folder / "ckpts" / name


def save_splatfacto(
    folder, splats: Content, prefix="_model.gauss_params.", settings="", more=None, **changed
):
    """nerfstudio's `Trainer.save_checkpoint` of a pipeline; without harmonics colours are logits."""
    first = splats.harmonics[:, 0]
    if splats.harmonics.shape[1] == 1:
        first = writers.logit(0.5 + writers.SH_0 * first)
    own = of_all(splats)
    own |= {"opacities": own["opacities"][:, None], "features_dc": tensor(first)}
    own |= {"features_rest": tensor(splats.rest)} | changed
    state = {prefix + name: value for name, value in own.items() if value is not None}
    state |= {"_model.device_indicator_param": torch.empty(0), "_model.lpips.net.lin0.weight": torch.ones(1)}
    state |= {"datamanager.a": torch.ones(1)} | (more or {})
    models = folder / "nerfstudio_models"
    models.mkdir(exist_ok=True)
    file = {"step": 29999, "pipeline": state, "optimizers": {}, "schedulers": {}, "scalers": {}}
    torch.save(file, models / "step-000029999.ckpt")
    (folder / "config.yml").write_text(
        "!!python/object:nerfstudio.engine.trainer.TrainerConfig\n"
        "pipeline: !!python/object:nerfstudio.pipelines.base_pipeline.VanillaPipelineConfig\n"
        "  model: !!python/object:nerfstudio.models.splatfacto.SplatfactoModelConfig\n"
        f"    sh_degree: 3\n{settings}"
    )
    return models / "step-000029999.ckpt"


SAVE = {"3dgs": save_3dgs, "gsplat": save_gsplat, "splatfacto": save_splatfacto}


def read(path):
    """What is imported of a checkpoint, and its only field."""
    checkpoint = open_checkpoint(path)
    imported = getattr(splat_checkpoints, READERS[checkpoint.system][1])(checkpoint, Memory())
    (node,) = imported.nodes
    return imported, node.field


def as_ply(folder, splats: Content, without: tuple[str, ...] = ()):
    """The same splats by way of a .ply."""
    columns = {n: c for n, c in writers.ply_columns(splats).items() if n not in without}
    return read_splats(writers.written(folder / "same.ply", writers.table(columns)))


def assert_same(field, splats) -> None:
    for name in ARRAYS:
        np.testing.assert_array_equal(getattr(field, name), getattr(splats, name), err_msg=name)


# --- the same as a .ply -------------------------------------------------------------------------------------


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("system", SAVE)
def test_splats_are_those_of_a_ply(system, degree, tmp_path):
    splats = content(60, degree)
    path = SAVE[system](tmp_path, splats)
    assert open_checkpoint(path).system == system
    _, field = read(path)
    expected = as_ply(tmp_path, splats)
    if system == "splatfacto" and not degree:
        np.testing.assert_allclose(field.harmonics, expected.harmonics, atol=1e-5)
        field.harmonics = expected.harmonics
    assert_same(field, expected)


def test_harmonics_that_are_not_in_use_do_not_count(tmp_path):
    splats = content(40)
    imported, field = read(save_3dgs(tmp_path, splats, degree=1))
    splats.harmonics = splats.harmonics[:, :4]
    assert_same(field, as_ply(tmp_path, splats))
    assert "by degree 1 so far" in imported.notes[0]


def test_discs_are_flat(tmp_path):
    splats = content(40)
    expected = as_ply(tmp_path, splats, without=("scale_2",))
    of_two, field = read(save_3dgs(tmp_path, splats, _scaling=tensor(np.log(splats.scales[:, :2]))))
    assert_same(field, expected)
    path = save_gsplat(tmp_path, splats, "ckpt_29999.pt", {"cfg.json": '{"model_type": "2dgs"}'})
    of_three, field = read(path)
    assert_same(field, expected)
    assert "discs of 2D Gaussian splatting" in of_two.notes[0] and "discs" in of_three.notes[0]


def test_the_parts_of_all_gpus_are_one_field(tmp_path):
    splats = content(60)
    for rank in range(3):
        part = Content(*(getattr(splats, name)[rank * 20 : rank * 20 + 20] for name in ARRAYS))
        last = save_gsplat(tmp_path, part, f"ckpt_29999_rank{rank}.pt")
    expected = as_ply(tmp_path, splats)
    for given in (last, tmp_path):
        imported, field = read(given)
        assert_same(field, expected)
        assert "all GPUs are taken: ckpt_29999_rank0.pt, ckpt_29999_rank1.pt" in " ".join(imported.notes)
    (tmp_path / "ckpts/ckpt_29999_rank1.pt").unlink()
    with pytest.raises(InvalidInput, match="ckpt_29999_rank1.pt is missing beside it"):
        verbs.import_field(last, tmp_path / "f.rfpack")


@pytest.mark.parametrize("prefix", ["_model.", "module._model.gauss_params.", "_model.module.gauss_params."])
def test_older_names_and_those_of_several_gpus(prefix, tmp_path):
    splats = content(40)
    expected = as_ply(tmp_path, splats)
    assert_same(read(save_splatfacto(tmp_path, splats, prefix))[1], expected)
    path = save_gsplat(tmp_path, splats, "ckpt_6999.pt", means=None, means3d=tensor(splats.centres))
    assert_same(read(path)[1], expected)


# --- where it lies ------------------------------------------------------------------------------------------


def test_splatfacto_lies_where_its_capture_does(tmp_path):
    """As nerfacto's: model = scale (R p + t)."""
    splats = content(60)
    save_splatfacto(tmp_path, splats)
    transform = np.concatenate([FRAME, SHIFT[:, None]], 1).tolist()
    (tmp_path / "dataparser_transforms.json").write_text(json.dumps({"transform": transform, "scale": SCALE}))
    as_ply(tmp_path, splats)
    report = verbs.import_field(tmp_path, tmp_path / "placed.rfpack", name="room")
    verbs.import_field(tmp_path / "same.ply", tmp_path / "model.rfpack")
    assert report["system"] == "nerfstudio's splatfacto"
    assert "dataparser_transforms.json is undone" in " ".join(report["notes"])
    rng = np.random.default_rng(1)
    around = splats.centres.repeat(3, 0)
    inside = around + rng.normal(size=around.shape) * splats.scales.repeat(3, 0).min(1, keepdims=True)
    d = rng.normal(size=inside.shape)
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    world = (inside / SCALE - SHIFT) @ FRAME
    numbers = [torch.from_numpy(x) for x in (world, d @ FRAME, inside, d)]
    with torch.no_grad():
        sigma, rgb = open_scene(tmp_path / "placed.rfpack").query(*numbers[:2])
        expected, colours = open_scene(tmp_path / "model.rfpack").query(*numbers[2:])
    assert (expected > 0).sum() > 100
    np.testing.assert_allclose(sigma, SCALE * expected, rtol=2e-3, atol=1e-3)
    np.testing.assert_allclose(rgb, colours, atol=2e-3)
    np.testing.assert_allclose(OpenBundle(tmp_path / "placed.rfpack").scene.up, FRAME[2], atol=1e-6)


def test_without_its_transforms_it_stays_where_it_was_learnt(tmp_path):
    imported, _ = read(save_splatfacto(tmp_path, content()))
    assert (imported.nodes[0].object_to_world == np.eye(4)).all() and imported.up == limits.UP_Z
    assert "no dataparser_transforms.json" in " ".join(imported.notes)


def test_what_gsplat_says_of_its_world(tmp_path):
    imported, _ = read(save_gsplat(tmp_path, content()))
    assert imported.up == limits.UP_Z and "keeps no word of how" in " ".join(imported.notes)
    imported, _ = read(save_gsplat(tmp_path, content(), settings={"cfg.yml": "normalize_world_space: false"}))
    assert imported.up == (0, -1, 0) and not imported.notes
    assert read(save_3dgs(tmp_path, content()))[0].up == (0, -1, 0)


@pytest.mark.parametrize("newest", [7000, 30000])
def test_the_folder_of_a_run_of_3dgs_is_its_newest_point_cloud(newest, tmp_path):
    run = tmp_path / "garden"
    for step in (5000, newest):
        place = run / f"point_cloud/iteration_{step}"
        place.mkdir(parents=True)
        writers.written(place / "point_cloud.ply", writers.ply(content(step // 1000)))
    (run / "cfg_args").write_text("Namespace(sh_degree=3)")
    (run / "cameras.json").write_text("[]")
    save_3dgs(run, content(4), step=5000)
    report = verbs.import_field(run, tmp_path / "f.rfpack")
    assert report["fields"][0]["splats"] == newest // 1000 and report["fields"][0]["name"] == "garden"
    assert f"iteration_{newest}" in report["notes"][0] and report["system"] == "Gaussian splats"


def test_the_folder_of_a_run_without_point_clouds_is_its_newest_checkpoint(tmp_path):
    save_3dgs(tmp_path, content(4), step=7000)
    save_3dgs(tmp_path, content(5), step=30000)
    report = verbs.import_field(tmp_path, tmp_path / "f.rfpack")
    assert report["fields"][0]["splats"] == 5 and report["system"] == "3D Gaussian splatting"


# --- what is told, and what is refused ----------------------------------------------------------------------


def test_what_is_not_honoured_is_told(tmp_path):
    more = {
        "_model.camera_optimizer.pose_adjustment": torch.ones(3, 6),
        "_model.bil_grids.grids": torch.ones(2),
    }
    imported, _ = read(
        save_splatfacto(tmp_path, content(), settings="    rasterize_mode: antialiased\n", more=more)
    )
    said = " ".join(imported.notes)
    assert "parts of its model that are not honoured: bil_grids, camera_optimizer" in said
    assert "antialiasing" in said
    more = {"pose_adjust": {"embeds.weight": torch.ones(2, 9)}, "post_processing": {"grids": torch.ones(2)}}
    path = save_gsplat(
        tmp_path,
        content(),
        settings={"cfg.yml": "antialiased: true"},
        more=more,
        semantics=torch.ones(5, 8),
    )
    said = " ".join(read(path)[0].notes)
    assert "parts of its run that are not honoured: pose_adjust, post_processing" in said
    assert "numbers of splats that are not honoured: semantics" in said and "antialiasing" in said


def test_colours_of_a_network_are_refused(tmp_path):
    path = save_gsplat(
        tmp_path, content(), sh0=None, shN=None, features=torch.ones(5, 32), colors=torch.ones(5, 3)
    )
    with pytest.raises(InvalidInput, match=r"made of a picture's code by a network \(app_opt\)"):
        verbs.import_field(path, tmp_path / "f.rfpack")


def test_splats_without_sound_numbers_are_left_out(tmp_path):
    splats = content(12)
    centres, logits = splats.centres.copy(), writers.logit(splats.opacities)
    centres[0, 1], logits[1] = np.nan, np.nan
    imported, field = read(save_gsplat(tmp_path, splats, means=tensor(centres), opacities=tensor(logits)))
    kept = Content(*(getattr(splats, name)[2:] for name in ARRAYS))
    assert_same(field, as_ply(tmp_path, kept))
    assert "2 splats have NaN, infinite or absurd numbers" in " ".join(imported.notes)


@pytest.mark.parametrize(
    ("system", "changed", "said"),
    [
        ("splatfacto", {"quats": None}, "no known system"),
        ("splatfacto", {"scales": None}, "'scales' is missing"),
        ("splatfacto", {"features_rest": torch.ones(5, 14, 3)}, "42 numbers of spherical harmonics"),
        (
            "splatfacto",
            {"features_rest": torch.ones(5, 45)},
            "shape [5, 'any', 3], found [5, 45]",
        ),
        ("splatfacto", {"opacities": torch.ones(4, 1)}, "should have shape [5, 1], found [4, 1]"),
        ("splatfacto", {"means": torch.full((5, 3), np.nan)}, "no splat with finite numbers"),
        ("gsplat", {"shN": None}, "'shN' is missing"),
        ("gsplat", {"quats": torch.ones(5, 4, 1)}, "no known system"),
        ("gsplat", {"scales": torch.ones(5, 4)}, "should have shape [5, 2 or 3], found [5, 4]"),
        ("gsplat", {"scales": torch.full((5, 3), np.inf)}, "no splat with finite numbers"),
        ("gsplat", {"opacities": torch.ones(5, 2)}, "should have shape [5], found [5, 2]"),
        ("gsplat", {n: torch.ones(0, *s) for n, s in {"means": (3,), "quats": (4,)}.items()}, "no splats"),
        ("3dgs", {"_scaling": torch.ones(5, 1)}, "should have shape [5, 2 or 3], found [5, 1]"),
        ("3dgs", {"_opacity": torch.ones(5)}, "should have shape [5, 1], found [5]"),
        ("3dgs", {"_rotation": torch.ones(6, 4)}, "should have shape [5, 4], found [6, 4]"),
        ("3dgs", {"degree": -1}, "'active_sh_degree' should be a whole number from 0 to 8"),
    ],
)
def test_what_does_not_fit_is_refused_in_a_sentence(system, changed, said, tmp_path):
    path, output = SAVE[system](tmp_path, content(), **changed), tmp_path / "f.rfpack"
    with pytest.raises((InvalidInput, UnknownCheckpoint)) as caught:
        verbs.import_field(path, output)
    assert str(caught.value).count(str(path)) == 1 and said in str(caught.value)
    assert caught.value.exit_code == 3 and not output.exists()


@pytest.mark.parametrize("system", SAVE)
def test_too_many_splats_are_refused_before_they_are_read(system, tmp_path, monkeypatch):
    path = SAVE[system](tmp_path, content())
    monkeypatch.setattr(limits, "MAX_SPLATS", 4)
    with pytest.raises(InvalidInput, match="counts 5 splats, but at most 4 are read"):
        verbs.import_field(path, tmp_path / "f.rfpack")


@pytest.mark.parametrize("system", SAVE)
def test_damaged_numbers_are_refused_or_read(system, tmp_path):
    path, outcomes = SAVE[system](tmp_path, content(12, 1)), set()
    whole = path.read_bytes()
    for index in range(60):
        path.write_bytes(spoilt(whole, random.Random(f"{system}/{index}")))
        try:
            _, field = read(path)
            assert all(np.isfinite(getattr(field, name)).all() for name in ARRAYS)
            outcomes.add("read")
        except FormatError as error:
            assert str(error).isprintable()
            outcomes.add("refused")
    assert outcomes == {"read", "refused"}


def test_a_box_is_of_no_use(tmp_path):
    with pytest.raises(UsageProblem, match="for files without one"):
        verbs.import_field(save_3dgs(tmp_path, content()), tmp_path / "f.rfpack", aabb=(-1, -1, -1, 1, 1, 1))
