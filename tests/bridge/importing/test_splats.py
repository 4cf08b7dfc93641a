"""Splat files by the whole command."""

from pathlib import Path

import imageio.v3 as imageio
import numpy as np
import pytest
import torch

from formats.bundle import OpenBundle
from formats.errors import BadSplats, UnknownCheckpoint
from formats.splats import dot_splat
from fusedrf_cli import verbs
from fusedrf_cli.bridge.importing.splats import shells_of
from fusedrf_cli.bridge.memory import resident
from fusedrf_cli.engine.kinds.planes import PlanesKind
from fusedrf_cli.errors import InvalidInput, ResourceProblem, UsageProblem
from fusedrf_cli.python import open_scene
from fusedrf_cli.requests import Input
from tests.formats.splats.writers import content, ply, sog_files, written, zipped


def splat_file(path: Path, centres: np.ndarray, scale: float = 0.05) -> Path:
    """A .splat of opaque balls: 32 bytes each."""
    kinds = [("at", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("turn", "u1", 4)]
    rows = np.zeros(len(centres), kinds)
    rows["at"], rows["scale"], rows["turn"] = centres, scale, (255, 128, 128, 128)
    rows["rgba"] = (255, 128, 0, 255)
    path.write_bytes(rows.tobytes())
    return path


def test_a_file_becomes_a_bundle_that_answers_and_knows_what_is_up(tmp_path):
    centres = np.random.default_rng(0).uniform(-1, 1, (50, 3))
    file, bundle = splat_file(tmp_path / "balls.splat", centres), tmp_path / "balls.rfpack"
    report = verbs.import_field(file, bundle)
    assert report["fields"] == [{"name": "balls", "kind": "splats", "splats": 50, "sh_degree": 0}]
    graph = OpenBundle(bundle).scene
    assert graph.up == (0.0, -1.0, 0.0)
    scene = open_scene(bundle)
    sigma, rgb = scene.query(torch.from_numpy(centres[:5]), torch.tensor([[0.0, 0, 1]] * 5))
    assert (sigma.detach() > 1).all()
    np.testing.assert_allclose(rgb.detach(), np.tile([1, 128 / 255, 0], (5, 1)), atol=1e-2)
    verbs.import_field(file, bundle, overwrite=True, up=(0, 0, 2))
    assert OpenBundle(bundle).scene.up == (0.0, 0.0, 1.0)
    verbs.rename(bundle, "balls", "marbles", tmp_path / "renamed.rfpack")
    assert OpenBundle(tmp_path / "renamed.rfpack").scene.up == (0.0, 0.0, 1.0)


def test_what_is_made_of_a_scene_is_upright_as_the_scene_is(tmp_path):
    centres = np.random.default_rng(0).uniform(-1, 1, (300, 3))
    bundle = tmp_path / "balls.rfpack"
    verbs.import_field(splat_file(tmp_path / "balls.splat", centres), bundle)
    verbs.extract(bundle, tmp_path / "few.rfpack", boxes=((-0.5, -0.5, -0.5, 0.5, 0.5, 0.5),))
    verbs.fuse(bundle, tmp_path / "fused.rfpack", time_budget=10)
    for made in ("few", "fused"):
        assert OpenBundle(tmp_path / f"{made}.rfpack").scene.up == (0.0, -1.0, 0.0)


@pytest.mark.parametrize("kind", ["vm", pytest.param("planes", marks=pytest.mark.slow)])
def test_one_field_is_learnt_of_what_does_not_fit_as_it_is(kind, tmp_path, monkeypatch):
    """An import is not made coarser, so that as a node it takes what it takes; of the kind that is best in so
    few bytes."""
    if kind == "vm":
        monkeypatch.setattr(PlanesKind, "few", 200_000)
    centres = np.random.default_rng(0).uniform(-1, 1, (20_000, 3))
    bundle, fused = tmp_path / "balls.rfpack", tmp_path / "fused.rfpack"
    verbs.import_field(splat_file(tmp_path / "balls.splat", centres), bundle)
    report = verbs.fuse(bundle, fused, max_size=300_000, time_budget=2)
    assert report["kind"] == kind and report["bytes"] <= 300_000
    assert "as nodes the sources take" in report["kind_because"]
    assert any(f"one field of the kind {kind} is learnt instead" in said for said in report["warnings"])
    assert not any("--kind blocks" in said for said in report["warnings"])  # which did not fit
    with pytest.raises(UsageProblem, match="--max-size is too small"):
        verbs.fuse(bundle, tmp_path / "none.rfpack", max_size=2_000)
    assert not (tmp_path / "none.rfpack").exists()


def test_what_was_chosen_instead_of_nodes_goes_on(tmp_path, monkeypatch):
    """By the very words of the run that was interrupted, which say no kind."""
    monkeypatch.setattr(PlanesKind, "few", 200_000)
    centres = np.random.default_rng(0).uniform(-1, 1, (20_000, 3))
    bundle, fused = tmp_path / "balls.rfpack", tmp_path / "fused.rfpack"
    verbs.import_field(splat_file(tmp_path / "balls.splat", centres), bundle)

    def stop(*_, **__):
        raise KeyboardInterrupt

    words = {"max_size": 300_000, "time_budget": 2}
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr("fusedrf_cli.engine.distillation.distill.query_teacher", stop)
        verbs.fuse(bundle, fused, **words)
    assert fused.with_name("fused.rfpack.checkpoint").exists() and not fused.exists()
    report = verbs.fuse(bundle, fused, **words, resume=True)
    assert report["kind"] == "vm" and report["kind_because"] == "the run that went on had chosen it"
    assert fused.exists() and not fused.with_name("fused.rfpack.checkpoint").exists()


def test_what_lies_far_away_becomes_a_field_of_its_own(tmp_path):
    rng = np.random.default_rng(1)
    centres = np.concatenate([rng.uniform(-1, 1, (400, 3)), rng.uniform(-300, 300, (3, 3))])
    report = verbs.import_field(splat_file(tmp_path / "room.splat", centres), tmp_path / "room.rfpack")
    assert sum(field["splats"] for field in report["fields"]) == 403 and len(report["fields"]) > 1
    assert any("fields that add up" in note for note in report["notes"])
    (group,) = OpenBundle(tmp_path / "room.rfpack").scene.nodes
    assert group.name == "room" and group.composition == "add"
    points = torch.from_numpy(centres[[0, -1]])
    sigma, _ = open_scene(tmp_path / "room.rfpack").query(points, torch.tensor([[0.0, 0, 1]] * 2))
    assert (sigma.detach() > 1).all()


def shown_share(picture: Path) -> float:
    """Of the pixels of a picture over white, how many show anything."""
    return float((imageio.imread(picture)[..., :3].min(-1) < 200).mean())


def test_pictures_show_what_most_splats_are_whatever_lies_far_from_them(tmp_path):
    """Of a bundle, of a scene that places it beside others, and of what is fused of that; what far splats
    are cropped to takes no more memory than the others."""
    rng = np.random.default_rng(1)
    ball = rng.uniform(-1, 1, (600, 3))
    alone, stray = tmp_path / "alone.rfpack", tmp_path / "stray.rfpack"
    verbs.import_field(splat_file(tmp_path / "alone.splat", ball, 0.1), alone)
    far = np.concatenate([ball, [[50, 50, 50], [-3e4, 0, 1e5]]])
    verbs.import_field(splat_file(tmp_path / "stray.splat", far, 0.1), stray)
    verbs.compose([Input(path=str(stray), translate=(3, 0, 0)), str(alone)], tmp_path / "pair.json")
    verbs.compose([Input(path=str(stray), crop=(0, 0, 0, 4))], tmp_path / "cropped.json")
    verbs.fuse(tmp_path / "pair.json", tmp_path / "fused.rfpack")
    for scene, least in (("alone.rfpack", 0.1), ("stray.rfpack", 0.1), ("pair.json", 0.04),
                         ("cropped.json", 0.03), ("fused.rfpack", 0.04)):  # fmt: skip
        verbs.render(tmp_path / scene, tmp_path / "seen.png", size=(48, 48), overwrite=True)
        assert shown_share(tmp_path / "seen.png") > least, scene


def test_info_says_how_large_splats_are(tmp_path):
    corners = np.array([[-1.0, -2, -3], [1, 2, 3]])
    verbs.import_field(splat_file(tmp_path / "two.splat", corners, 0.1), tmp_path / "two.rfpack")
    (node,) = verbs.info(tmp_path / "two.rfpack")["nodes"]
    box = np.array(node["world_aabb"])
    assert (box[:3] < corners[0] - 0.1).all() and (box[3:] > corners[1] + 0.1).all()
    np.testing.assert_allclose(box.reshape(2, 3), corners, atol=0.8)


def test_a_bundle_does_not_get_the_name_of_something_else(tmp_path):
    file = splat_file(tmp_path / "two.splat", np.zeros((2, 3)))
    with pytest.raises(UsageProblem, match=r"two.png: what is written is no .png file; .* NAME.rfpack"):
        verbs.import_field(file, tmp_path / "two.png")
    verbs.import_field(file, tmp_path / "two.rfpack")
    with pytest.raises(UsageProblem, match=r"no .glb file; .* NAME.json"):
        verbs.compose([tmp_path / "two.rfpack"], tmp_path / "scene.glb")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["two.rfpack", "two.splat"]


def test_shells_hold_every_splat_once():
    rng = np.random.default_rng(2)
    middles = rng.normal(size=(3000, 3)) * np.exp(rng.normal(0, 2, (3000, 1)))
    shells = shells_of(np.concatenate([middles - 0.01, middles + 0.01], 1))
    assert len(shells) > 1 and sorted(np.concatenate(shells)) == list(range(3000))


def test_more_splats_than_memory_has_room_for_are_refused_before_they_are_read(tmp_path, monkeypatch):
    monkeypatch.setattr(dot_splat, "gathered", None)  # which would fail
    file = splat_file(tmp_path / "balls.splat", np.zeros((100_000, 3)))
    with pytest.raises(ResourceProblem, match="for 100,000 splats"):
        verbs.import_field(file, tmp_path / "balls.rfpack", memory=resident() + (200 << 20))


@pytest.mark.parametrize("share", [0.001, 0.01, 0.05])
def test_whole_objects_are_told_from_what_lies_far_away(share):
    """Of a cloud, three of 2,000 may be as far out as what lies far away."""
    rng = np.random.default_rng(3)
    solid, cloud = rng.uniform(-1, 1, (2000, 3)), rng.normal(size=(2000, 3)) / 4
    far = rng.normal(size=(int(2000 * share), 3)) + [0, 60, 0]
    for middles in (solid, cloud, solid * [1, 1, 0.01]):
        for others, counts in ((far[:0], [2000]), (far, [2000, len(far)])):
            at = np.concatenate([middles, others])
            shells = shells_of(np.concatenate([at - 0.01, at + 0.01], 1))
            assert np.allclose([len(shell) for shell in shells], counts, atol=3)


def test_a_file_without_splats_is_refused(tmp_path):
    (tmp_path / "notes.txt").write_text("no splats")
    with pytest.raises(Exception, match="notes.txt") as caught:
        verbs.import_field(tmp_path / "notes.txt", tmp_path / "out.rfpack")
    assert caught.value.exit_code == InvalidInput.exit_code and not (tmp_path / "out.rfpack").exists()


@pytest.mark.parametrize(
    "words, say",
    [
        ({"aabb": (-1, -1, -1, 1, 1, 1)}, "--aabb, --near and --far are for files without one"),
        ({"near": 1.0}, "--aabb, --near and --far are for files without one"),
        ({"up": (0, 0, 0)}, "0,0,0 is no direction"),
    ],
)
def test_what_does_not_apply_is_refused(tmp_path, words, say):
    file = splat_file(tmp_path / "balls.splat", np.zeros((3, 3)))
    with pytest.raises(UsageProblem, match=say):
        verbs.import_field(file, tmp_path / "balls.rfpack", **words)
    assert [path.name for path in tmp_path.iterdir()] == ["balls.splat"]


def test_a_time_is_said_to_be_of_no_use(tmp_path):
    file = splat_file(tmp_path / "balls.splat", np.zeros((3, 3)))
    report = verbs.import_field(file, tmp_path / "balls.rfpack", time=2.0)
    assert "nothing in it moves, and --time is not used" in report["notes"]


@pytest.mark.parametrize(
    "network", ["point_cloud/iteration_9/deformation.pth", "deform/iteration_9/deform.pth", "other.pth"]
)
@pytest.mark.parametrize("whole", [True, False])
def test_splats_that_a_network_moves_are_said_to_rest(network, whole, tmp_path):
    cloud = tmp_path / "run/point_cloud/iteration_9/point_cloud.ply"
    for file, data in ((cloud, ply(content(4))), (tmp_path / "run" / network, b"x")):
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(data)
    notes = verbs.import_field(tmp_path / "run" if whole else cloud, tmp_path / "out.rfpack")["notes"]
    assert any("stand where they rest" in note for note in notes) == ("other" not in network)


def test_the_folder_of_a_sog_and_an_archive_of_splats(tmp_path):
    for name, data in sog_files(content(4, 0)).items():
        written(tmp_path / "scene" / name, data)
    report = verbs.import_field(tmp_path / "scene", tmp_path / "scene.rfpack")
    assert report["system"] == "Gaussian splats" and report["fields"][0]["kind"] == "splats"
    packed = written(tmp_path / "scene.zip", zipped({"a/balls.splat": bytes(32)}))
    with pytest.raises(UnknownCheckpoint, match="is an archive, no checkpoint; unpack it, and give"):
        verbs.import_field(packed, tmp_path / "b.rfpack")


def test_a_file_cut_short_and_a_folder_say_what_to_do(tmp_path):
    file = splat_file(tmp_path / "balls.splat", np.zeros((3, 3)))
    file.write_bytes(file.read_bytes()[:-5])
    with pytest.raises(BadSplats, match="91 bytes are no whole splats of 32 bytes; copy it again"):
        verbs.import_field(file, tmp_path / "balls.rfpack")
    file.write_bytes(b"\xff" * 91)
    with pytest.raises(
        UnknownCheckpoint, match="Gaussian splats, but cut short or of no format that is read"
    ):
        verbs.import_field(file, tmp_path / "balls.rfpack")
    with pytest.raises(UnknownCheckpoint, match="of splats give the file itself"):
        verbs.import_field(tmp_path, tmp_path / "balls.rfpack")
