"""Every command that writes numbers, in 8 and 4 bits, on the shop's tiny scenes."""

import shutil
from typing import get_args

import numpy as np
import pytest

from formats.archive import read_archive
from formats.bundle import read_bundle, read_headers
from formats.records import PRECISIONS
from fusedrf_cli.bridge.field_bundle import stored, write_field
from fusedrf_cli.bridge.scene import load_scene
from fusedrf_cli.engine.distillation.config import TrainConfig
from fusedrf_cli.engine.fields.streamed import opened
from fusedrf_cli.engine.kinds.vm import KIND
from fusedrf_cli.engine.rendering.metrics import psnr
from fusedrf_cli.requests import Precision
from tests.bridge.conftest import done, part

VM = ("--kind", "vm", "--no-finetune", "--max-size", "400kB")
AT = ("--name", "blue", "-t", "0.7,0,0")


@pytest.fixture(scope="module")
def fused(shop, tmp_path_factory):
    """The shop with two objects fused in each precision; the one of 4 bits keeps its sources."""
    folder = shutil.copytree(shop, tmp_path_factory.mktemp("fused") / "shop")
    for precision, more in (("float16", ()), ("float32", ()), ("int8", ()), ("int4", ("--keep-sources",))):
        words = ("fuse", "pair.json", "-o", f"{precision}.rfpack", *VM, "--precision", precision)
        done(folder, *words, *more)
    return folder


@pytest.fixture
def folder(tmp_path, fused):
    return shutil.copytree(fused, tmp_path / "shop")


def told(path, node: int = 0) -> str:
    """The precision of the field of one of a bundle's nodes."""
    scene, headers = read_headers(path)
    return headers[scene.nodes[node].field].precision


def stored_arrays(path) -> dict[str, bytes]:
    """The bytes of every array of a bundle's placed field as they lie in the file, by name."""
    scene, headers = read_headers(path)
    member = scene.nodes[0].field
    view = read_archive(path)[member]
    return {name: bytes(view[spec.start : spec.stop]) for name, spec in headers[member].specs.items()}


def test_the_command_line_offers_what_the_format_has():
    assert set(get_args(Precision)) == set(PRECISIONS)


def test_a_fused_field_is_stored_as_asked_within_the_size(folder, picture):
    wanted = picture("pair.json")
    for precision in ("float16", "int8", "int4"):
        path = folder / f"{precision}.rfpack"
        inside = sum((folder / f"{n}.rfpack").stat().st_size for n in ("floor", "red") if precision == "int4")
        assert told(path) == precision and path.stat().st_size <= 400_000 + inside
        assert psnr(picture(path.name), wanted) > 15


def test_training_in_8_bits(report, folder, picture):
    words = ("train", "photos", "--sh-degree", "1", "--aabb", "-0.5,-0.5,-0.5,0.5,0.5,0.5", "-o", "a.rfpack")
    report(*words, "--precision", "int8")
    assert told(folder / "a.rfpack") == "int8"
    assert picture("a.rfpack").min() < 0.9


def test_fewer_bits_leave_room_for_more_texels():
    train, box, longest = part("training"), np.array([0, 0, 0, 2.0, 1, 1]), {}
    settings = TrainConfig(longest=256)
    for precision in PRECISIONS:
        found = longest[precision] = train.fitting_longest(KIND, box, settings, 1_000_000, precision)
        sizes = [
            train.bytes_of(KIND.untrained(box, n, settings.storage), precision) for n in (found, found + 4)
        ]
        assert sizes[0] <= 1_000_000 < sizes[1]
    assert longest["float32"] < longest["float16"] < longest["int8"] < longest["int4"]


@pytest.mark.parametrize("precision", ["int8", "int4", "float32"])
def test_edits_keep_the_precision_and_every_number(report, folder, precision):
    report("add", f"{precision}.rfpack", "blue.rfpack", *AT, "-o", "more.rfpack")
    report("delete", "more.rfpack", "blue", "-o", "less.rfpack")
    assert told(folder / "more.rfpack") == told(folder / "less.rfpack") == precision
    before, more, less = (stored_arrays(folder / f"{n}.rfpack") for n in (precision, "more", "less"))
    assert before == less == more
    assert len(read_headers(folder / "more.rfpack")[1]) == len(read_headers(folder / "less.rfpack")[1]) + 1


def test_another_precision_is_taken_where_it_is_asked_for(report, folder, picture):
    for precision in ("float32", "int8"):
        words = ("-o", f"more-{precision}.rfpack", "--precision", precision)
        report("add", "int8.rfpack", "blue.rfpack", *AT, *words)
        assert told(folder / f"more-{precision}.rfpack", 1) == precision
        assert told(folder / f"more-{precision}.rfpack") == "int8"
    assert psnr(picture("more-int8.rfpack"), picture("more-float32.rfpack")) > 40


def test_kept_sources_keep_their_own_bytes(report, folder):
    report("add", "int4.rfpack", "blue.rfpack", *AT, "-o", "more.rfpack")
    sources = {next(iter(read_bundle(folder / f"{name}.rfpack").fields)) for name in ("floor", "red")}
    headers = read_headers(folder / "more.rfpack")[1]
    assert {headers[member].precision for member in sources} == {"float16"}


@pytest.mark.parametrize("precision", PRECISIONS)
def test_what_is_measured_is_what_will_be_read(folder, precision):
    """`stored` gives the field that a bundle gives, from numbers that no precision but one holds."""
    field = opened(load_scene(str(folder / "float32.rfpack")).placed[0].field)
    write_field(str(folder / "a.rfpack"), field, "a", precision=precision, overwrite=False)
    back = opened(load_scene(str(folder / "a.rfpack")).placed[0].field)
    assert (stored(field, precision).params == back.params).all()
    assert bool((back.params == field.params).all()) == (precision == "float32")
