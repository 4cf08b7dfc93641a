"""What sources become where no kind is asked for."""

import pytest

from fusedrf_cli.bridge.training import trained_kind
from fusedrf_cli.requests import TrainRequest

ASKED = [
    ({}, "cpu", "hash"),
    ({"quality": "draft"}, "cpu", "vm"),
    ({"time_budget": 60.0}, "cpu", "vm"),
    ({"time_budget": 60.0}, "cuda", "hash"),
    ({"time_budget": 300.0}, "cpu", "hash"),
    ({"time_budget": 300.0, "quality": "draft"}, "cpu", "hash"),
    ({"sh_degree": 1}, "cpu", "vm"),
    ({"ranks": (8, 16)}, "cpu", "vm"),
    ({"kind": "cp"}, "cpu", "cp"),
]


@pytest.mark.parametrize("words, device, usual", ASKED)
def test_surroundings_become_what_shows_most_in_the_time_and_takes_the_options(words, device, usual):
    assert trained_kind(TrainRequest("photos", "out.rfpack", **words), True, device).name == usual


def test_an_object_becomes_planes_and_lines_and_what_shares_a_decoder_has_one():
    assert trained_kind(TrainRequest("photos", "out.rfpack")).name == "vm"
    several = TrainRequest(("a", "b"), "out.rfpack", shared_decoder=True)
    assert trained_kind(several, True).name == "dense-mlp"
