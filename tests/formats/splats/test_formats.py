"""Every format says of one content what its specification lets it say; none is told by its name."""

from functools import partial

import numpy as np
import pytest

from formats.errors import BadSplats
from formats.splats.reading import is_splats, read_splats
from formats.splats.splats import admitted
from formats.splats.spz import UNSTATED
from tests.formats.splats import writers
from tests.formats.splats.writers import content, written

HALF_BYTE = 0.5 / 255
EXACT = {"centres": 1e-6, "scales": 1e-5, "rotations": 1e-6, "opacities": 1e-6, "colours": 1e-5, "rest": 1e-6}
BYTES = EXACT | {"opacities": HALF_BYTE, "colours": HALF_BYTE / writers.SH_0}
FIXED = {"scales": np.expm1(0.5 / 16), "colours": HALF_BYTE / 0.15, "rest": 0.5 / 128 + 1e-6}
SPZ = BYTES | FIXED | {"centres": 0.5 / 4096, "rotations": 1 / 511}
KSPLAT = BYTES | {"centres": 10.1 / 32767, "scales": 1e-3, "rotations": 1e-3}
FORMATS = {
    "ply": (writers.ply, 3, EXACT),
    "ply big": (partial(writers.ply, coding="binary_big_endian"), 2, EXACT),
    "ply ascii": (partial(writers.ply, coding="ascii"), 1, EXACT),
    "ply of one colour": (writers.ply, 0, EXACT),
    "ply compressed": (
        writers.compressed_ply,
        3,
        {
            "centres": 0.02,
            "scales": 5e-3,
            "rotations": 2e-3,
            "opacities": 2e-3,
            "colours": 0.01,
            "rest": 4 / 256,
        },
    ),
    "ply compressed, one colour": (
        writers.compressed_ply,
        0,
        {"centres": 0.02, "scales": 5e-3, "rotations": 2e-3, "opacities": 2e-3, "colours": 0.01, "rest": 0},
    ),
    "splat": (writers.splat, 0, BYTES | {"rotations": 0.01}),
    "ksplat 0": (writers.ksplat, 2, BYTES),
    "ksplat 0, degree 3": (writers.ksplat, 3, BYTES),
    "ksplat 1": (partial(writers.ksplat, level=1), 1, KSPLAT | {"rest": 1e-3}),
    "ksplat 2": (partial(writers.ksplat, level=2), 2, KSPLAT | {"rest": 1 / 255}),
    "ksplat 2, one colour": (partial(writers.ksplat, level=2), 0, KSPLAT),
    "spz 1": (partial(writers.spz, version=1), 0, SPZ | {"centres": 5e-3, "rotations": 0.05}),
    "spz 2": (partial(writers.spz, version=2), 1, SPZ | {"rotations": 0.05}),
    "spz 3": (partial(writers.spz, version=3), 3, SPZ),
    "spz 4": (partial(writers.spz, version=4), 3, SPZ),
    "spz 4, one colour": (partial(writers.spz, version=4), 0, SPZ),
    "sog 1": (
        partial(writers.sog, version=1),
        2,
        {
            "centres": 1e-3,
            "scales": 0.01,
            "rotations": 6e-3,
            "opacities": 6e-3,
            "colours": 0.01,
            "rest": 5e-3,
        },
    ),
    "sog 2": (
        partial(writers.sog, version=2),
        3,
        {
            "centres": 1e-3,
            "scales": 0.01,
            "rotations": 6e-3,
            "opacities": 2e-3,
            "colours": 0.01,
            "rest": 5e-3,
        },
    ),
    "glb": (writers.glb, 3, EXACT),
}


def check(splats, expected, bounds) -> None:
    """Numbers within `bounds`; those of scales are relative, and q and -q are one rotation."""
    assert splats.centres.dtype == splats.scales.dtype == splats.rotations.dtype == np.float32
    assert splats.opacities.dtype == splats.harmonics.dtype == np.float32
    assert splats.harmonics.shape == expected.harmonics.shape
    np.testing.assert_allclose(splats.centres, expected.centres, rtol=0, atol=bounds["centres"])
    np.testing.assert_allclose(splats.scales, expected.scales, rtol=bounds["scales"])
    signs = np.sign((splats.rotations * expected.rotations).sum(1, keepdims=True))
    np.testing.assert_allclose(splats.rotations * signs, expected.rotations, rtol=0, atol=bounds["rotations"])
    np.testing.assert_allclose(np.linalg.norm(splats.rotations, axis=1), 1, atol=1e-6)
    np.testing.assert_allclose(splats.opacities, expected.opacities, rtol=0, atol=bounds["opacities"] * 1.01)
    colours = splats.harmonics[:, 0]
    np.testing.assert_allclose(colours, expected.harmonics[:, 0], rtol=0, atol=bounds["colours"] * 1.01)
    np.testing.assert_allclose(splats.harmonics[:, 1:], expected.rest, rtol=0, atol=bounds["rest"] * 1.01)


@pytest.mark.parametrize("name", FORMATS)
def test_one_content_in_every_format(name, tmp_path):
    write, degree, bounds = FORMATS[name]
    expected = content(7, degree)
    path = written(tmp_path / "named.otherwise", write(expected))
    assert is_splats(path)
    splats = read_splats(path)
    check(splats, expected, bounds)
    assert [*splats.notes] == [f"{path}: {UNSTATED}"] * name.startswith("spz")
    assert splats.up == (0, -1, 0)


@pytest.mark.parametrize("name", ["ply compressed", "ksplat 1", "sog 2", "spz 4"])
def test_more_splats_than_a_chunk_a_bucket_and_a_row(name, tmp_path):
    write, degree, bounds = FORMATS[name]
    expected = content(600, degree, seed=2)
    bounds = bounds | {"centres": bounds["centres"] * 2}
    check(read_splats(written(tmp_path / "a", write(expected))), expected, bounds)


@pytest.mark.parametrize(
    "data",
    [
        b"",
        bytes(64),
        b"x" * 320,
        b"the quick brown fox jumps over\r\n" * 40,
        np.random.default_rng(0).bytes(3200),
        np.random.default_rng(1).normal(size=800).astype("<f4").tobytes(),
        b"glTF" + bytes(28),
        b"PK\3\4" + bytes(60),
        b"\x1f\x8b" + bytes(62),
        b'{"frames": []}',
        writers.table(dict.fromkeys("xyz", np.zeros(4))),
        writers.zipped({"scene.json": b"{}", "a.webp": b""}),
        writers.zipped({"archive/data.pkl": b"", "meta.json": b"{}"}),
    ],
)
def test_other_files_are_no_splats(data, tmp_path):
    assert not is_splats(written(tmp_path / "a.splat", data))


@pytest.mark.parametrize(
    ("data", "sentence"),
    [
        (b"RAD0" + bytes(200), "a .rad of Spark"),
        (b"spx\3" + bytes(124), "an .spx of Reall3D.*gsbox x2p"),
        (b'{ "version": "5.0", "totalSplats": 12, "totalLevel": 2}', "an .lcc of XGRIDS.*splat-transform"),
        (b'{"totalLevels": 5, "splatType": ".sog", "totalSplats": 9}', "an .lcc of XGRIDS"),
        (
            writers.ply(content()).replace(b"end_header", b"element codebook_centers 256\nend_header"),
            "a quantised .ply of Reduced-3DGS",
        ),
        (writers.ply(content()).replace(b"f_rest_0\n", b"f_anchor_feat_0\n"), "a .ply of Scaffold-GS"),
        (writers.ply(content()).replace(b"f_rest_0\n", b"trbf_center\n"), "a .ply of Spacetime Gaussians"),
        (
            b'{"means": {"shape": [9, 3], "dtype": "float32"}, "quats": {}, "opacities": {}, "sh0": {}}',
            "the meta.json of gsplat's PNG compression",
        ),
    ],
)
def test_known_formats_that_are_not_read(data, sentence, tmp_path):
    path = written(tmp_path / "a.splat", data)
    for ask in (is_splats, read_splats):
        with pytest.raises(BadSplats, match=f"is {sentence}"):
            ask(path)


def test_meshes_are_no_splats(tmp_path):
    from tests.formats.gltf import Gltf
    from tests.promises.inputs import glb, gltf, ply, ply_text

    assert not any(is_splats(make(tmp_path / make.__name__)) for make in (glb, gltf, ply, ply_text))
    assert not is_splats(Gltf().write(tmp_path / "square.glb"))


class Refused(Exception):
    """Stands for memory that there is not."""


@pytest.mark.parametrize("made, degree, _", FORMATS.values(), ids=FORMATS)
def test_how_many_there_are_is_asked_before_they_are_read(made, degree, _, tmp_path):
    path, counts = written(tmp_path / "a", made(content(7, degree))), []
    with admitted(counts.append):
        read_splats(path)
    assert 7 in counts

    def refuse(count: int) -> None:
        raise Refused

    with admitted(refuse), pytest.raises(Refused):
        read_splats(path)
    assert len(read_splats(path)) == 7


def test_a_level_of_ksplat_that_is_not_known_is_named(tmp_path):
    data = bytearray(writers.ksplat(content(3, 0)))
    data[20:22] = (3).to_bytes(2, "little")
    with pytest.raises(BadSplats, match="compression level 3, and 0 to 2 are read"):
        read_splats(written(tmp_path / "a", bytes(data)))
