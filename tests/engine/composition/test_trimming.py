"""Trimming: texels that nothing reads change no answer, and truncation is the nearest of lower rank."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from fusedrf_cli.engine.encodings.plane_line import MODES
from fusedrf_cli.engine.kinds.vm.field import VMField, VMShape
from fusedrf_cli.engine.kinds.vm.trimming import (
    common_shape,
    fewer_components,
    leading,
    read_texels,
    reshaped,
    truncated,
    without_unread,
)
from tests.engine.conftest import BOX, SIXTY_FOUR, THIRTY_TWO, points_in, random_vm, unit


def sparse_vm(seed: int, resolution=(21, 34, 9)):
    """A random field of which few cells are occupied."""
    field = random_vm(THIRTY_TWO, resolution=resolution, dtype=torch.float32, seed=seed, cells=12)
    held = np.random.default_rng(seed).random(field.occupancy.occupied.shape) < 0.01
    held[0, 0, 0] = held[-1, -1, -1] = True
    return field.with_occupancy(replace(field.occupancy, occupied=held))


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_unread_texels_change_no_answer(seed):
    field = sparse_vm(seed)
    trimmed = without_unread(field)
    grid = field.occupancy
    cells = np.argwhere(grid.occupied)
    rng = np.random.default_rng(seed)
    within = rng.random((400, len(cells), 3))
    within[0], within[1] = 0.0, 1 - 1e-12  # both corners of every cell too
    points = torch.from_numpy((grid.aabb[:3] + (cells + within) * grid.cell).reshape(-1, 3))
    dirs = torch.from_numpy(unit(rng.normal(size=points.shape)))
    for found, wanted in zip(trimmed.query(points, dirs), field.query(points, dirs), strict=True):
        assert torch.equal(found, wanted)
    assert (trimmed.params == 0).sum() > (field.params == 0).sum()


def test_a_texel_is_read_if_and_only_if_a_point_of_an_occupied_cell_weighs_it():
    field = sparse_vm(5)
    occupied = field.occupancy.occupied
    cells = np.argwhere(occupied)
    ends = (cells / occupied.shape, (cells + 1) / occupied.shape)  # unit cube
    for mode, (a, b, _) in enumerate(MODES):
        wanted = np.zeros((field.resolution[a], field.resolution[b]), bool)
        for low, high in zip(*ends, strict=True):
            touched = []
            for axis in (a, b):
                n = field.resolution[axis]
                at = np.arange(n) / (n - 1)
                touched.append((at > low[axis] - 1 / (n - 1) + 1e-9) & (at < high[axis] + 1 / (n - 1) - 1e-9))
            wanted |= np.outer(*touched)
        assert np.array_equal(read_texels(field, mode), wanted) and not wanted.all()


def test_density_loses_what_eckart_and_young_say():
    rng = np.random.default_rng(0)
    plane, line = rng.normal(size=(7, 9, 16)), rng.normal(size=(11, 16))
    whole = plane.reshape(-1, 16) @ line.T
    values = np.linalg.svd(whole, compute_uv=False)
    for rank in (8, 16):
        p, q = leading(plane, line, rank)
        error = np.linalg.norm(p.reshape(-1, rank) @ q.T - whole)
        assert error == pytest.approx(np.linalg.norm(values[rank:]), abs=1e-9)


def test_colour_of_lower_rank_is_kept_exactly():
    """24 components that are mixtures of 8 lose nothing at rank 8, whichever of them are kept."""
    rng = np.random.default_rng(1)
    plane = rng.normal(size=(6, 5, 24))
    line, basis = np.zeros((10, 24)), np.zeros((4, 24))
    line[:, :8], basis[:, :8] = rng.normal(size=(10, 8)), rng.normal(size=(4, 8))
    of = rng.integers(0, 8, 24)
    of[:8] = np.arange(8)
    scale = rng.uniform(0.5, 2, 24)
    line, basis = line[:, of] * scale, basis[:, of]
    kept, mixed = fewer_components(plane, line, basis, 8)
    whole = np.einsum("abr,cr,kr->abck", plane, line, basis)
    found = np.einsum("abr,cr,kr->abck", mixed, line[:, kept], basis[:, kept])
    np.testing.assert_allclose(found, whole, atol=1e-6)


def test_colour_keeps_more_energy_than_any_prefix():
    rng = np.random.default_rng(2)
    plane, line, basis = (rng.normal(size=s) for s in ((6, 5, 24), (10, 24), (9, 24)))
    plane *= rng.permutation(0.7 ** np.arange(24))
    whole = np.einsum("abr,cr,kr->abck", plane, line, basis)
    kept, mixed = fewer_components(plane, line, basis, 16)
    error = np.linalg.norm(np.einsum("abr,cr,kr->abck", mixed, line[:, kept], basis[:, kept]) - whole)
    strongest = np.argsort(-np.linalg.norm(plane, axis=(0, 1)))[:16]
    naive = np.einsum("abr,cr,kr->abck", plane[..., strongest], line[:, strongest], basis[:, strongest])
    assert error < np.linalg.norm(naive - whole)


def test_a_truncated_field_keeps_its_box_and_drops_bands():
    field = random_vm(VMShape(16, 24, 2), resolution=(6, 7, 8))
    small = truncated(field, VMShape(8, 16, 1))
    assert small.shape == VMShape(8, 16, 1) and small.resolution == field.resolution
    assert truncated(field, VMShape(24, 24, 3)) is field
    flat = truncated(field, VMShape(16, 24, 0)).sections()
    assert torch.equal(flat["colour_basis"], field.sections()["colour_basis"][:, :1])
    assert torch.equal(flat["colour_plane_1"], field.sections()["colour_plane_1"])


def test_ranks_that_are_there_already_stay():
    field = random_vm(SIXTY_FOUR)
    assert truncated(field, VMShape(8, 16, 3)) is field


def test_more_components_change_no_answer():
    """Of a narrow field and its widened copy; the narrow one by its reference, whose loops nothing else
    compiles."""
    narrow = random_vm(VMShape(8, 8, 0), dtype=torch.float64)
    wide = reshaped(narrow, SIXTY_FOUR)
    points, dirs = torch.from_numpy(points_in(BOX, 500)), torch.from_numpy(unit(points_in(BOX, 500, 4)))
    for found, wanted in zip(
        wide.query(points, dirs), narrow.answers(narrow.params, points, dirs), strict=True
    ):
        torch.testing.assert_close(found, wanted, rtol=1e-9, atol=1e-9)
    assert wide.shape == SIXTY_FOUR and reshaped(wide, SIXTY_FOUR) is wide


def test_common_shape_holds_all():
    assert common_shape([VMShape(8, 24, 0), VMShape(16, 8, 2)]) == VMShape(16, 24, 2)


class SourceFolder(torch.Tensor):
    """Numbers that are not the CPU's: they have no view as an array."""

    @property
    def device(self):
        return torch.device("cuda:0")

    def numpy(self, *words, **more):
        raise TypeError("can't convert cuda:0 device type tensor to numpy. Use Tensor.cpu() first.")

    def to(self, device, *words, **more):
        here = torch.device(device).type == "cpu"
        return self.as_subclass(torch.Tensor) if here else self


def test_numbers_of_another_device_are_truncated_alike(monkeypatch):
    """A GPU's tensors are no arrays; here their place is taken by tensors that refuse to be any."""
    field = random_vm(VMShape(16, 24, 2), dtype=torch.float32)
    there = field.with_params(field.params.clone().as_subclass(SourceFolder))
    to = VMField.to

    def moved(self, device):
        if torch.device(device).type != "cpu":
            return self.with_params(self.params.as_subclass(SourceFolder))
        return to(self, device)

    monkeypatch.setattr(VMField, "to", moved)
    found = truncated(there, VMShape(8, 16, 1))
    assert type(found.params) is SourceFolder
    wanted = truncated(field, VMShape(8, 16, 1)).params
    assert torch.equal(found.params.as_subclass(torch.Tensor), wanted)
