"""Names of files are distinct on any disk, and as they were where they can be."""

import os

import pytest

from formats.filenames import DEPTH, depth_of, distinct, folded


@pytest.mark.parametrize(
    "names, expected",
    [
        (["a", "b"], ["a", "b"]),
        (["a", "a", "a"], ["a", "a-2", "a-3"]),
        (["a", "A"], ["a", "A-2"]),
        (["\u00e9", "e\u0301"], ["\u00e9", "e\u0301-2"]),
        (["stra\u00dfe", "STRASSE"], ["stra\u00dfe", "STRASSE-2"]),
        (["a", "a_depth"], ["a", "a_depth-2"]),
        (["a_depth", "a"], ["a_depth", "a-2"]),
        (["a", "a-2", "A"], ["a", "a-2", "A-3"]),
        (["x" * 255, "x" * 254], ["x" * 200, "x" * 200 + "-2"]),
        ([chr(26085) * 85] * 2, [chr(26085) * 66, chr(26085) * 66 + "-2"]),
        ([], []),
    ],
)
def test_names_that_would_be_one_file(names, expected):
    found = distinct(names, ("", DEPTH))
    assert found == expected
    files = [folded(name + ending) for name in found for ending in ("", DEPTH)]
    assert len(set(files)) == len(files)
    assert all(len(os.fsencode(name + DEPTH + ".png")) <= 255 for name in found)


def test_without_depth_a_name_that_ends_so_is_one_like_others():
    assert distinct(["a", "a_depth"]) == ["a", "a_depth"]


def test_the_depth_lies_beside_its_picture(tmp_path):
    assert depth_of(tmp_path / "x.PNG") == tmp_path / "x_depth.png"
