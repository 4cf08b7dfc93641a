"""`--device` is heeded by every kind and every command that computes; here no device is really another."""

import contextlib
import shutil

import pytest

from fusedrf_cli.bridge.scene import load_scene, write_field
from fusedrf_cli.engine.fields.computed import ComputedField
from fusedrf_cli.engine.fields.streamed import opened
from tests.analytic.export import sparse_field
from tests.analytic.fields import Box, Tint
from tests.bridge.conftest import FIELDS, done, part

AT = ("--name", "blue", "-t", "0.7,0,0")
STORED = {
    "vm": FIELDS["red"],
    "sparse": sparse_field(Box(20.0, (0.3, 0.3, 0.3), tint=Tint.of(0.9, 0.1, 0.1))),
}


@pytest.fixture(scope="module")
def fused(shop, tmp_path_factory):
    """The shop with floor, red and blue in one tensor."""
    folder = shutil.copytree(shop, tmp_path_factory.mktemp("fused") / "shop")
    done(folder, "fuse", "scene.json", "-o", "vm.rfpack", "--kind", "vm", "--no-rgb", "--max-size", "400kB")
    return folder


@pytest.fixture
def sent(monkeypatch) -> list[tuple[str, str]]:
    """(kind, device) of every field that is asked to go somewhere; none does."""
    found = []
    monkeypatch.setattr(
        ComputedField, "to", lambda self, place: found.append((self.kind, str(place))) or self
    )

    @contextlib.contextmanager
    def elsewhere(device, threads, progress):
        yield "cuda"

    for name in ("editing", "fusing"):
        monkeypatch.setattr(part(name), "engine", elsewhere)
    return found


@pytest.mark.parametrize("kind", STORED)
def test_every_kind_is_asked_where_it_should_be(tmp_path, sent, kind):
    path = str(tmp_path / "one.rfpack")
    write_field(path, STORED[kind], "one", precision="float16", overwrite=False)
    opened(load_scene(path, place="cuda").placed[0].field)
    assert (kind, "cuda") in sent


def test_an_addition_is_measured_there(fused, sent):
    done(fused, "add", "vm.rfpack", "blue.rfpack", *AT[:1], "second", *AT[2:], "-o", "more.rfpack", "-w")
    assert sent.count(("vm", "cuda")) >= 3  # the object, the field it is added to, and what they become


def test_what_a_deletion_uncovers_is_learnt_there(fused, sent, monkeypatch):
    taught = []
    run = part("editing").DistillRun
    monkeypatch.setattr(part("editing"), "DistillRun", lambda *words: taught.append(len(sent)) or run(*words))
    done(fused, "delete", "vm.rfpack", "blue", "-o", "less.rfpack", "--no-rgb", "-w")
    assert taught and sent[taught[0] - 1] == ("vm", "cuda")
