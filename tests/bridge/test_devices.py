"""`--device` is heeded by every kind and every command that computes; here no device is really another."""

import contextlib
import shutil
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from fusedrf_cli.bridge.scene import load_scene, write_field
from fusedrf_cli.engine.composition.affine import Placed
from fusedrf_cli.engine.composition.composed import ComposedField
from fusedrf_cli.engine.fields.computed import ComputedField
from fusedrf_cli.engine.fields.streamed import opened
from fusedrf_cli.engine.kinds.vm import KIND as VM
from fusedrf_cli.progress import NullProgress
from tests.analytic.export import SHAPE, sparse_field, way_of
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


def test_what_an_edit_learns_is_learnt_there(sent):
    scene = ComposedField([Placed("red", FIELDS["red"], np.eye(4))])
    student = VM.empty(scene, way_of(SHAPE), SHAPE.size((16,) * 3), torch.Generator().manual_seed(0), "")
    asked = SimpleNamespace(seed=0, rgb=False, time_budget=None)
    teach = part("editing").Teacher(asked, False, "cuda", NullProgress())
    teach(scene, student, [scene.occupancy.tight_aabb(0)], True)
    assert sent == [("vm", "cuda"), ("vm", "cpu")]
