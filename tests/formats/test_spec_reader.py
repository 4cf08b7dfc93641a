"""A reader written from the specification alone agrees with the engine, for every kind and precision."""

from pathlib import Path

import numpy as np
import pytest
import torch
from click.testing import CliRunner

from formats.bundle import BundleWriter
from formats.records import FieldRecord, decode_field, encode_field
from formats.scene import SceneGraph, make_node
from fusedrf_cli.bridge.scene import make_field
from fusedrf_cli.engine.fields.occupancy import OccupancyGrid
from fusedrf_cli.engine.spaces import contracted_l2, contracted_linf, ndc, space_of, unbounded
from fusedrf_cli.main import cli
from fusedrf_cli.python import open_scene
from tests.bundles import write_single
from tests.engine.conftest import points_in, unit
from tests.engine.kinds.cases import KINDS  # noqa: F401  (a fixture)
from tests.formats import spec_reader

COUNT = 200
CUBE = Path(__file__).parent / "golden" / "cube.rfpack"


SLOW = ("sparse, levels and bands",)  # its vertices are found one by one
PRECISIONS = ("float32", "float16", "int8", "int4")
TRIED = [(n, p) for n in KINDS for p in PRECISIONS if p == "int8" or n not in SLOW]


@pytest.mark.parametrize("name, precision", TRIED)
def test_a_reader_written_from_the_specification_answers_as_the_engine(name, precision, tmp_path):
    """By the torch reference, in float32 as numbers are read."""
    made = KINDS[name]()
    arrays, metadata = made.state()
    record = FieldRecord(made.kind, arrays, metadata)
    write_single(tmp_path / "a.rfpack", record, "node", precision=precision)
    field = make_field(decode_field(encode_field(record, precision), "here"), "here")
    points = points_in(field.aabb, COUNT, margin=0.05)
    dirs = unit(np.random.default_rng(5).normal(size=(COUNT, 3)))
    sigma, rgb = field.reference(field.params.double(), torch.from_numpy(points), torch.from_numpy(dirs))
    _, fields = spec_reader.open_bundle(tmp_path / "a.rfpack")
    own = next(f for f in fields.values() if f[0] != "part")
    found, colours = spec_reader.answer(own, points, dirs)
    assert (sigma > 0).sum() > COUNT // 20
    np.testing.assert_allclose(found, sigma.numpy(), rtol=1e-4, atol=1e-6)
    seen = found > 0
    np.testing.assert_allclose(colours[seen], rgb.numpy()[seen], atol=1e-5)


SPACES = {
    "unbounded": unbounded,
    "L2": contracted_l2,
    "Linf": contracted_linf,
    "L2 of DVGO": space_of(contracted_l2, shell=0.2, contracted_density=1.0),
    "Linf of DVGO": space_of(contracted_linf, shell=0.2, contracted_density=1.0),
    "spheres of svox2": space_of(contracted_l2, contracted_density=2.0, unit_x=0.8, unit_z=1.4),
    "stretched": space_of(contracted_linf, stretch_x=2.0, stretch_z=0.5, contracted_density=1.0),
    "NDC": ndc,
    "NDC of a camera": space_of(ndc, scale_x=2.1, scale_y=2.8),
}


@pytest.mark.parametrize("space", SPACES.values(), ids=SPACES)
def test_the_words_of_spaces(space, tmp_path):
    made = KINDS["dense"]().resampled(space.WHOLE, (6, 6, 6))
    made = made.with_occupancy(OccupancyGrid.full(space.WHOLE, 4, space))
    write_single(tmp_path / "a.rfpack", FieldRecord(made.kind, *made.state()), "node")
    _, fields = spec_reader.open_bundle(tmp_path / "a.rfpack")
    points = space.inv_contract(torch.from_numpy(points_in(0.9 * space.WHOLE, COUNT)))
    dirs = unit(np.random.default_rng(5).normal(size=(COUNT, 3)))
    field = make_field(decode_field(encode_field(FieldRecord(made.kind, *made.state())), "here"), "here")
    assert field.space is space
    sigma, rgb = field.answers(field.params.double(), points, torch.from_numpy(dirs))
    found, colours = spec_reader.answer(next(iter(fields.values())), points.numpy(), dirs)
    assert (sigma > 0).sum() > COUNT // 20
    np.testing.assert_allclose(found, sigma.numpy(), rtol=1e-3, atol=1e-6)
    np.testing.assert_allclose(colours[found > 0], rgb.numpy()[found > 0], atol=1e-4)


def test_the_worked_field_of_the_specification(tmp_path):
    """Its bytes, the answer that SPEC 5.1 works out by hand, and a picture."""
    density = np.zeros((2, 2, 2), np.float32)
    density[1] = 1
    arrays = {
        "density": density.ravel(),
        "colour": np.tile(np.float32([4, 0, -4]), (8, 1)),
        "occupancy": np.array([128], np.uint8),
    }
    box = [0, 0, 0, 1, 1, 1]
    cells = {"aabb": box, "counts": [1, 1, 1]}
    metadata = {"aabb": box, "resolution": [2, 2, 2], "scale": 2.0, "shift": 0.0, "cells": cells}
    writer = BundleWriter()
    member = writer.add_field(FieldRecord("dense", arrays, metadata | {"shape": {"sh_degree": 0}}))
    node = make_node("cube", field=member, translation=[0, 0, 3], scale=[2, 2, 2])
    writer.write(tmp_path / "cube.rfpack", SceneGraph((node,)))
    assert (tmp_path / "cube.rfpack").read_bytes() == CUBE.read_bytes()
    where, along = np.array([[1.0, 1, 4]]), np.array([[0.0, 0, 1]])
    sigma, rgb = open_scene(CUBE).query(torch.from_numpy(where), torch.from_numpy(along))
    (own,) = spec_reader.open_bundle(CUBE)[1].values()
    found, colours = spec_reader.answer(own, (where - [0, 0, 3]) / 2, along)
    assert float(sigma[0]) == pytest.approx(0.974077, abs=1e-6) == found[0] / 2
    np.testing.assert_allclose(rgb[0].detach(), [0.755540, 0.5, 0.244460], atol=1e-6)
    np.testing.assert_allclose(colours[0], [0.755540, 0.5, 0.244460], atol=1e-6)
    picture = tmp_path / "cube.png"
    result = CliRunner().invoke(cli, ["render", str(CUBE), "-o", str(picture), "--size", "16x16"])
    assert result.exit_code == 0 and picture.exists()
