"""What a field is said to take in a bundle, against what it takes."""

import numpy as np
import pytest
import torch

from formats.records import FieldRecord, encode_field
from fusedrf_cli.bridge.sizes import BundleSizes
from fusedrf_cli.engine.fields.occupancy import OccupancyGrid
from fusedrf_cli.engine.kinds.vm.builder import contents_of
from fusedrf_cli.engine.kinds.vm.field import VMField, VMShape
from fusedrf_cli.engine.kinds.vm.trimming import without_unread


@pytest.mark.parametrize("precision", ["float16", "float32", "int8", "int4"])
@pytest.mark.parametrize("share", [0.0005, 0.3])
def test_a_vm_field_takes_what_was_said(precision, share):
    """Never more, and little less: the headers' part is a bound."""
    box, occupied = np.array([0, 0, 0, 1.0, 1, 1]), np.random.default_rng(3).random((40, 50, 30)) < share
    shape, resolution = VMShape(16, 24, 2), (50, 62, 33)
    params = torch.randn(VMField.size_of(shape, resolution), generator=torch.Generator().manual_seed(0))
    whole = VMField(shape, box, resolution, 25.0, params=params, occupancy=OccupancyGrid(box, occupied))
    field = without_unread(whole)
    found = len(encode_field(FieldRecord(field.kind, *field.state()), precision))
    said = BundleSizes().of(contents_of(field, None), precision)
    assert found <= said <= 1.01 * found + 8000
