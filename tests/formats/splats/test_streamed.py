"""Streamed SOG: a lod-meta.json, as SplatTransform writes it, and folders of SOGs in levels of detail."""

import json

import numpy as np
import pytest

from formats.errors import BadSplats, FormatError, MissingFile, NewerVersion
from formats.splats.reading import is_splats, newest_point_cloud, read_splats
from tests.formats.splats.writers import content, sog_files, written

FINE, COARSE, AROUND = [(4, 2), (5, 1)], (3, 0), (2, 3)
"""How many splats the SOGs of each level have, and of which degree."""


def index(**changed) -> dict:
    """Two leaves, each with a file of its own in the finest level, and with a share of one in the other."""
    bound = {"min": [-1, -1, -1], "max": [1, 1, 1]}
    fine = [{"file": 0, "offset": 0, "count": 4}, {"file": 1, "offset": 0, "count": 5}]
    coarse = [{"file": 2, "offset": 0, "count": 1}, {"file": 2, "offset": 1, "count": 2}]
    leaves = [{"bound": bound, "lods": {"0": f, "1": c}} for f, c in zip(fine, coarse, strict=True)]
    return {
        "version": 1,
        "count": 12,
        "counts": [9, 3],
        "lodLevels": 2,
        "environment": "env/meta.json",
        "filenames": ["0_0/meta.json", "0_1/meta.json", "1_0/meta.json"],
        "tree": {"bound": bound, "children": leaves},
    } | changed


def stored(tmp_path, meta: dict):
    """Its lod-meta.json; seeds tell the SOGs apart."""
    sizes = dict(zip(["0_0", "0_1", "1_0", "env"], [*FINE, COARSE, AROUND], strict=True))
    for seed, (folder, (count, degree)) in enumerate(sizes.items()):
        for name, data in sog_files(content(count, degree, seed)).items():
            written(tmp_path / folder / name, data)
    return written(tmp_path / "lod-meta.json", json.dumps(meta).encode())


def test_the_finest_level_and_the_surroundings(tmp_path):
    path = stored(tmp_path, index())
    assert is_splats(path) and newest_point_cloud(tmp_path) == path
    splats = read_splats(path)
    parts = [read_splats(tmp_path / folder / "meta.json") for folder in ("0_0", "0_1", "env")]
    assert splats.kind == "a streamed SOG, read in its finest level" and splats.up == (0, -1, 0)
    for name in ("centres", "scales", "rotations", "opacities"):
        found = np.concatenate([getattr(part, name) for part in parts])
        np.testing.assert_allclose(getattr(splats, name), found, rtol=1e-6)
    assert splats.harmonics.shape == (11, 16, 3) and not splats.harmonics[4:9, 4:].any()
    np.testing.assert_allclose(splats.harmonics[9:], parts[2].harmonics, rtol=1e-6)


def test_early_ones_without_version_and_surroundings(tmp_path):
    meta = {
        name: value for name, value in index().items() if name not in ("version", "environment", "counts")
    }
    assert len(read_splats(stored(tmp_path, meta))) == 9


def test_notes_of_many_parts_are_told_once(tmp_path):
    path = stored(tmp_path, index())
    for folder in ("0_0", "0_1"):
        meta = json.loads((tmp_path / folder / "meta.json").read_bytes()) | {"model": "antialiased"}
        written(tmp_path / folder / "meta.json", json.dumps(meta).encode())
    notes = read_splats(path).notes
    assert len(notes) == 1 and notes[0].startswith(f"{path}: was trained with antialiasing")


@pytest.mark.parametrize(
    ("changed", "error"),
    [
        ({"version": 2}, NewerVersion),
        ({"filenames": ["0_0/meta.json"]}, BadSplats),
        ({"filenames": ["0_0/meta.json"] * 3}, BadSplats),
        ({"filenames": ["0_0/meta.json", "1_0/../0_0/meta.json", "1_0/meta.json"]}, BadSplats),
        ({"filenames": ["0_0/meta.json", "0_9/meta.json", "1_0/meta.json"]}, MissingFile),
        ({"filenames": ["/0_0/meta.json", "https://a.b/meta.json", "1_0/meta.json"]}, FormatError),
        ({"tree": {}}, BadSplats),
        ({"tree": {"lods": {"0": {"file": 2}, "1": {"file": 2}}}}, BadSplats),
        ({"tree": {"lods": {"0": {"file": -1}}}}, BadSplats),
        ({"tree": []}, BadSplats),
    ],
)
def test_what_the_index_says_wrongly(changed, error, tmp_path):
    with pytest.raises(error):
        read_splats(stored(tmp_path, index(**changed)))


def test_a_part_is_not_looked_for_in_another_folder(tmp_path):
    path = stored(tmp_path, index())
    for name, data in sog_files(content(5, 1)).items():
        written(tmp_path / name, data)
    (tmp_path / "0_1/meta.json").unlink()
    with pytest.raises(MissingFile, match="names '0_1/meta.json', which is not there"):
        read_splats(path)
