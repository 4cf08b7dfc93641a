"""`--device` is heeded by every kind and every command that computes; here no device is really another."""

import pytest

from fusedrf_cli.bridge.field_bundle import write_field
from fusedrf_cli.bridge.scene import load_scene
from fusedrf_cli.engine.fields.computed import ComputedField
from fusedrf_cli.engine.fields.streamed import opened
from tests.analytic.export import sparse_field
from tests.analytic.fields import Box, Tint
from tests.bridge.conftest import FIELDS

STORED = {
    "vm": FIELDS["red"],
    "sparse": sparse_field(Box(20.0, (0.3, 0.3, 0.3), tint=Tint.of(0.9, 0.1, 0.1))),
}


@pytest.fixture
def sent(monkeypatch) -> list[tuple[str, str]]:
    """(kind, device) of every field that is asked to go somewhere; none does."""
    found = []
    monkeypatch.setattr(
        ComputedField, "to", lambda self, device: found.append((self.kind, str(device))) or self
    )

    return found


@pytest.mark.parametrize("kind", STORED)
def test_every_kind_is_asked_where_it_should_be(tmp_path, sent, kind):
    path = str(tmp_path / "one.rfpack")
    write_field(path, STORED[kind], "one", precision="float16", overwrite=False)
    opened(load_scene(path, device="cuda").placed[0].field)
    assert (kind, "cuda") in sent
