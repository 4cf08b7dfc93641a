"""SOG: zips and folders, old and new, and what is wrong with them."""

import io
import json
import zipfile

import numpy as np
import pytest

from formats.errors import BadJson, BadSplats, FormatError, LimitExceeded, MissingFile, NewerVersion
from formats.splats.reading import is_splats, read_splats
from tests.formats.splats.writers import content, sog_files, webp, written, zipped


def read(tmp_path, files: dict[str, bytes]):
    return read_splats(written(tmp_path / "a.sog", zipped(files)))


def changed(files: dict[str, bytes], **entries) -> dict[str, bytes]:
    meta = json.loads(files["meta.json"])
    return files | {"meta.json": json.dumps(meta | entries).encode()}


def test_a_folder_of_pictures_and_a_zip_with_a_folder(tmp_path):
    files = sog_files(content())
    for name, data in files.items():
        written(tmp_path / "scene" / name, data)
    assert is_splats(tmp_path / "scene/meta.json")
    loose = read_splats(tmp_path / "scene/meta.json")
    for pack in (files, {f"scene/{name}": data for name, data in files.items()}):
        assert np.array_equal(read(tmp_path, pack).centres, loose.centres)


def test_a_codebook_whose_first_entry_is_missing(tmp_path):
    """As the engine mends it: one step before the second entry."""
    files = sog_files(content())
    meta = json.loads(files["meta.json"])
    mended = meta["scales"]["codebook"]
    mended[0] = mended[1] + (mended[1] - mended[255]) / 255
    expected = read(tmp_path, changed(files, scales=meta["scales"]))
    mended[0] = None
    assert np.array_equal(read(tmp_path, changed(files, scales=meta["scales"])).scales, expected.scales)


def test_codebooks_of_few_splats(tmp_path):
    """Early writers wrote as many entries as there were numbers. Bytes beyond them stand for nothing."""
    files, book = sog_files(content(3, 0)), [-4.0, -3, -2, -1.5, -1, 0, 0.5, 0.75, 1]
    files["s.webp"] = webp(np.arange(9, dtype=np.uint8).reshape(3, 3))
    few = changed(files, scales={"codebook": book, "files": ["s.webp"]})
    np.testing.assert_allclose(read(tmp_path, few).scales, np.exp(book).reshape(3, 3), rtol=1e-6)
    splats = read(tmp_path, changed(files, scales={"codebook": book[:7], "files": ["s.webp"]}))
    assert len(splats) == 2 and "1 splat has NaN" in splats.notes[0]


def test_a_single_splat(tmp_path):
    """Its ranges have no width."""
    with np.errstate(invalid="ignore"):
        splats, expected = read(tmp_path, sog_files(content(1, 0))), content(1, 0)
    np.testing.assert_allclose(splats.centres, expected.centres, rtol=1e-5)


def test_rotations_without_a_tag_are_none(tmp_path):
    files = sog_files(content())
    files["q.webp"] = webp(np.tile(np.uint8([200, 10, 30, 251]), (5, 1)))
    assert read(tmp_path, files).rotations.tolist() == [[1, 0, 0, 0]] * 5


def test_labels_beyond_the_palette_are_told(tmp_path):
    files = sog_files(content())
    files["n.webp"] = webp(np.tile(np.uint8([255, 255, 0]), (5, 1)))
    splats = read(tmp_path, files)
    assert not splats.harmonics[:, 1:].any() and "5 splats have no entry" in splats.notes[0]


@pytest.mark.parametrize(("model", "word"), [("antialiased", "antialiasing"), ("2dgs", "discs")])
def test_how_it_was_trained_is_told(model, word, tmp_path):
    assert word in read(tmp_path, changed(sog_files(content()), model=model)).notes[0]


def test_labels_before_the_palette_as_the_text_has_them(tmp_path):
    files = sog_files(content(40))
    expected = read(tmp_path, dict(files))
    meta = json.loads(files["meta.json"])
    palette, labels = (files.pop(name) for name in meta["shN"]["files"])
    files |= {"shN_labels.webp": labels, "shN_centroids.webp": palette}
    meta["shN"]["files"] = ["shN_labels.webp", "shN_centroids.webp"]
    files["meta.json"] = json.dumps(meta).encode()
    np.testing.assert_array_equal(read(tmp_path, files).harmonics, expected.harmonics)


def test_antialiasing_as_playcanvas_states_it(tmp_path):
    assert "antialiasing" in read(tmp_path, changed(sog_files(content()), antialias=True)).notes[0]
    assert read(tmp_path, changed(sog_files(content()), antialias=False)).notes == ()


def test_splats_that_move_are_refused(tmp_path):
    """SplatTransform's .sogst, whose still part is a SOG byte for byte."""
    with pytest.raises(BadSplats, match="the format 'sogst', and only SOGs that stand still"):
        read(tmp_path, changed(sog_files(content()), version=1, format="sogst"))


def test_several_in_a_zip_are_not_one(tmp_path):
    files = {f"{folder}/{name}": data for folder in "ab" for name, data in sog_files(content()).items()}
    with pytest.raises(BadSplats, match="holds 2 SOGs"):
        read(tmp_path, files)
    assert len(read(tmp_path, files | sog_files(content(4)))) == 4  # at the root, where it has to be


def test_newer_versions(tmp_path):
    with pytest.raises(NewerVersion, match="version 3"):
        read(tmp_path, changed(sog_files(content()), version=3))


@pytest.mark.parametrize(
    ("entries", "error"),
    [
        ({"count": 0}, BadSplats),
        ({"count": -1}, BadSplats),
        ({"count": 17}, BadSplats),
        ({"count": 10**12}, LimitExceeded),
        ({"means": {}}, BadSplats),
        ({"scales": {"files": ["s.webp"]}}, BadSplats),
        ({"quats": {"files": ["none.webp"]}}, BadSplats),
        ({"quats": {"files": ["../q.webp"]}}, BadSplats),
        ({"quats": {"files": ["meta.json"]}}, BadSplats),
        ({"shN": {"files": ["l.webp", "u.webp"]}}, BadSplats),
    ],
)
def test_what_meta_says_wrongly(entries, error, tmp_path):
    with pytest.raises(error):
        read(tmp_path, changed(sog_files(content()), **entries))


def test_a_picture_that_is_none_or_too_large(tmp_path):
    files = sog_files(content())
    with pytest.raises(BadSplats, match="no WebP"):
        read(tmp_path, files | {"q.webp": b"\x89PNG" + bytes(40)})
    with pytest.raises(BadSplats, match="cannot be decoded"):
        read(tmp_path, files | {"q.webp": files["q.webp"][:-20]})
    with pytest.raises(LimitExceeded, match="3000x3000 pixels"):
        read(tmp_path, files | {"q.webp": webp(np.zeros((9_000_000, 4), np.uint8), 3000)})


def test_a_picture_that_a_zip_unpacks_to_far_more_than_it_has(tmp_path):
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as pack:
        for name, data in sog_files(content()).items():
            pack.writestr(name, data + bytes(64 << 20) if name == "q.webp" else data)
    with pytest.raises(LimitExceeded, match="q.webp has 67,"):
        read_splats(written(tmp_path / "a.sog", out.getvalue()))


def test_names_do_not_lead_out_of_the_folder(tmp_path):
    files = changed(sog_files(content()), quats={"files": ["/etc/hostname"]})
    for name, data in files.items():
        written(tmp_path / "scene" / name, data)
    with pytest.raises(MissingFile):
        read_splats(tmp_path / "scene/meta.json")


def test_json_that_is_none(tmp_path):
    with pytest.raises(BadJson):
        read(tmp_path, sog_files(content()) | {"meta.json": b'{"means": '})


def test_every_flipped_bit_of_a_picture_is_noticed(tmp_path):
    """The checksums of the zip cover them."""
    data = zipped(sog_files(content()))
    start = data.index(b"RIFF")
    for at in range(start, start + 60):
        damaged = bytearray(data)
        damaged[at] ^= 1 << at % 8
        with pytest.raises(FormatError):
            read_splats(written(tmp_path / "a.sog", bytes(damaged)))
