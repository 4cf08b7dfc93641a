"""`fuse --kind sparse`, and edits of what it makes, as whole commands."""

import shutil

import numpy as np
import pytest

from formats.bundle import read_bundle
from fusedrf_cli.bridge.scene import make_field
from fusedrf_cli.engine.kinds.sparse.builder import SparseBuilder
from fusedrf_cli.engine.rendering.metrics import psnr
from tests.bridge.conftest import PLACES, TinySettings, done
from tests.bridge.test_edit import AT, blues, covered

SPARSE = ("--kind", "sparse", "--max-size", "600kB", "--precision", "float16")


@pytest.fixture(scope="module", autouse=True)
def short(tiny):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(SparseBuilder, "distil_config", TinySettings(steps=0, rgb_steps=10, rgb_rate=0.015))
        yield


@pytest.fixture(scope="module")
def made(short, shop, tmp_path_factory):
    """The shop with sparse.rfpack, floor and red fused to bricks, sources inside; and what fusing said."""
    folder = shutil.copytree(shop, tmp_path_factory.mktemp("made") / "shop")
    return folder, done(folder, "fuse", "pair.json", "-o", "sparse.rfpack", *SPARSE, "--keep-sources")


@pytest.fixture
def folder(tmp_path, made):
    return shutil.copytree(made[0], tmp_path / "shop")


@pytest.fixture
def fused(made):
    """What the fusing said."""
    return made[1]


def field_of(folder, name: str):
    bundle = read_bundle(folder / name)
    leaf = bundle.scene.leaves()[0]
    return make_field(bundle.fields[leaf.field], name), leaf.object_to_world[:3, 3]


def rows_by_place(folder, name: str) -> dict:
    """Bytes of every free row by its place in the world."""
    field, origin = field_of(folder, name)
    places = np.round(field.fine.positions[: field.fine.free] + origin, 5)
    return {tuple(p): r.tobytes() for p, r in zip(places, field.rows.numpy(), strict=False)}


def test_a_scene_becomes_bricks(fused, folder, picture):
    inside = sum((folder / f"{name}.rfpack").stat().st_size for name in ("floor", "red"))
    assert fused["kind"] == "sparse" and fused["bytes"] <= 600_000 + inside
    chosen = fused["chosen"]
    assert chosen["vertices"] > 1000 and sum(level["bricks"] for level in chosen["levels"]) > 50
    assert "needs" in chosen["why"] and chosen["sh_degree"] in (0, 1, 2)
    assert psnr(picture("sparse.rfpack"), picture("pair.json")) > 25
    assert fused["psnr"]["before_rgb"] > 22


@pytest.mark.parametrize("limit", [60_000, 150_000])
def test_a_file_is_filled_and_no_more_than_that(report, limit):
    said = report(
        "fuse",
        "pair.json",
        "-o",
        "small.rfpack",
        "--kind",
        "sparse",
        "--max-size",
        str(limit),
        "--no-finetune",
    )
    assert 0.75 * limit < said["bytes"] <= limit


@pytest.mark.slow
def test_equal_seeds_give_equal_bytes(report, folder):
    for name in ("one", "two"):
        report("fuse", "pair.json", "-o", f"{name}.rfpack", *SPARSE)
    assert (folder / "one.rfpack").read_bytes() == (folder / "two.rfpack").read_bytes()


def test_added_and_deleted_it_is_as_before(fused, report, folder, picture):
    """What is added is a node, and the bricks stay as they are."""
    before = picture("sparse.rfpack")
    said = report("add", "sparse.rfpack", "blue.rfpack", *AT, "-o", "more.rfpack")
    assert said["touched"]["nodes"] == 2
    more = picture("more.rfpack")
    assert blues(more) > 20 and blues(before) == 0
    away = ~covered("blue")
    assert psnr(more[away], before[away]) >= 40  # on another lattice
    report("delete", "more.rfpack", "blue", "-o", "less.rfpack")
    assert np.array_equal(picture("less.rfpack"), before)
    one, other = (read_bundle(folder / f"{name}.rfpack") for name in ("sparse", "less"))
    assert one.fields.keys() == other.fields.keys() and one.scene.nodes == other.scene.nodes


def test_of_a_deleted_object_no_other_number_changes(fused, report, folder):
    said = report("delete", "sparse.rfpack", "red", "-o", "less.rfpack")
    aabb = np.asarray(said["touched"]["aabb"])
    rows = [rows_by_place(folder, f"{name}.rfpack") for name in ("sparse", "less")]
    assert rows[1].items() <= rows[0].items()
    outside = [p for p in rows[0] if (p < aabb[:3] - 0.1).any() or (p > aabb[3:] + 0.1).any()]
    assert outside and all(p in rows[1] for p in outside)


def test_what_a_deleted_object_hid_comes_back_from_its_source(fused, report, picture):
    """The red box, which stands on the floor, taken out where the floor's source is kept inside."""
    said = report("delete", "sparse.rfpack", "red", "-o", "less.rfpack")
    assert said["restored"]
    report("compose", "floor.rfpack", "-t", ",".join(map(str, PLACES["floor"])), "-o", "floor.json")
    assert psnr(picture("less.rfpack"), picture("floor.json")) > 22


def test_the_last_object_cannot_be_deleted(fused, run):
    result = run("delete", "sparse.rfpack", "red", "floor", "-o", "less.rfpack")
    assert result.exit_code == 3 and "would leave nothing" in result.stderr


def test_a_sparse_field_can_be_fused_again(fused, folder, report, picture):
    report("compose", "sparse.rfpack", "blue.rfpack", "-t", "0.7,0,0", "-o", "again.json")
    said = done(folder, "fuse", "again.json", "-o", "again.rfpack", *SPARSE, "--no-finetune")
    assert said["kind"] == "sparse" and blues(picture("again.rfpack")) > 20
