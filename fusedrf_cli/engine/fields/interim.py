"""Thin calls over what fields offer today."""

from dataclasses import replace

import numpy as np
import torch

from fusedrf_cli.engine.fields.occupancy import PROBES


def resolution_of(field):
    if hasattr(field, "resolution"):
        return field.resolution
    if hasattr(field, "tensors") and len(field.blocks) == 1:
        return field.tensors[0].resolution
    return None


def peaks(field, lo, cell, cells):
    if hasattr(field, "peaks"):
        return field.peaks(lo, cell, cells, PROBES)
    sigma = np.zeros(len(cells), np.float32)
    field.loops.density_at_cells(field.kernel_shape[0], field.arrays, 0, lo, cell, cells, PROBES, sigma)
    return sigma


def box_of(field):
    return field.tensors[0].aabb if hasattr(field, "tensors") else field.aabb


def moved(field, origin):
    if hasattr(field, "moved"):
        return field.moved(origin)
    shift = np.eye(4)
    shift[:3, 3] = -origin
    blocks = tuple(replace(b, object_to_field=shift @ b.object_to_field) for b in field.blocks)
    return type(field).assembled(field.shape, field.tensors, blocks, field.params)


def stored(field, as_stored):
    if hasattr(field, "stored"):
        return field.stored(as_stored)
    if field.kind == "vm":
        back = field.with_params(torch.zeros_like(field.params))
        for t in range(len(field.tensors)):
            target = back.sections(t)
            for name, view in field.sections(t).items():
                target[name].copy_(torch.from_numpy(as_stored(view.detach().cpu().numpy(), name)))
        return back
    if field.kind == "sparse":
        back = field.with_params(field.params.clone())
        held = {"rows": (back.rows, back.fine)} | (
            {"bands": (back.bands, back.coarse)} if back.coarse else {}
        )
        for name, (view, lattice) in held.items():
            free = view[: lattice.free]
            free.copy_(torch.from_numpy(as_stored(free.cpu().numpy(), name)))
        back.settle()
        return back
    arrays, metadata = field.state()
    arrays = {n: as_stored(a, n) if a.dtype == np.float32 else a for n, a in arrays.items()}
    return type(field).from_state(arrays, metadata)
