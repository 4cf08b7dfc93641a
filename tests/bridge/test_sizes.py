"""What a field is said to take in a bundle, against what it takes."""

import numpy as np
import pytest
import torch

from formats.records import FieldRecord, encode_field
from fusedrf_cli.bridge.sizes import BundleSizes
from fusedrf_cli.engine.kinds.vm.field import Block, VMField, VMShape, VMTensor
from fusedrf_cli.engine.kinds.vm.students import contents_of
from fusedrf_cli.engine.kinds.vm.trimming import without_unread


@pytest.mark.parametrize("precision", ["float16", "float32", "int8", "int4"])
@pytest.mark.parametrize("share", [0.0005, 0.3])
def test_a_vm_field_takes_what_was_said(precision, share):
    """Never more, and little less: the headers' part is a bound."""
    shape, rng = VMShape(16, 24, 2), np.random.default_rng(3)
    held = [rng.random((40, 50, 30)) < share for _ in range(3)]
    resolutions = ((50, 62, 33), (41, 50, 40), (30, 30, 60))
    tensors = tuple(
        VMTensor(r, np.array([0, 0, 0, 1.0, 1, 1]), 25.0, occupied=h)
        for r, h in zip(resolutions, held, strict=True)
    )
    params = torch.randn(sum(shape.size(r) for r in resolutions), generator=torch.Generator().manual_seed(0))
    blocks = tuple(
        Block(t, np.eye(4) + np.pi * np.pad(np.ones((3, 1)), ((0, 1), (3, 0))), f"the block number {t}")
        for t in range(3)
    )
    field = without_unread(VMField.assembled(shape, tensors, blocks, params))
    found = len(encode_field(FieldRecord(field.kind, *field.state()), precision))
    said = BundleSizes().of(contents_of(shape, tensors, len(blocks)), precision)
    assert found <= said <= 1.01 * found + 8000
