"""Whatever bytes a file of splats is made of, reading ends in sound splats or in an error of the program."""

import pytest

from formats.errors import FormatError
from formats.splats.reading import read_splats
from tests.formats.splats.writers import written
from tests.promises.splat_inputs import FORMATS, splats


def test_mutations_of_every_format(tmp_path):
    """`make fuzz` takes 2,000 of each."""
    result = splats(40, 0, tmp_path)
    assert result["wrong"] == []
    assert {key.partition(": ")[2] for key in result["counts"]} == {"read", "refused", "no splats"}


@pytest.mark.parametrize("name", FORMATS)
def test_every_truncation_is_noticed(name, tmp_path):
    """A .splat may end behind any splat."""
    data = FORMATS[name]
    for length in range(0, len(data), max(1, len(data) // 60)):
        if name == "splat" and not length % 32 and length:
            continue
        if name == "ply ascii" and length > len(data) - 8:
            continue  # digits of the last number
        with pytest.raises(FormatError):
            read_splats(written(tmp_path / "a", data[:length]))
