"""What .spz files have beside their arrays, and how they are damaged."""

import gzip
import struct

import numpy as np
import pytest

from formats.errors import BadSplats, LimitExceeded, NewerVersion
from formats.splats.placing import placed
from formats.splats.reading import is_splats, read_splats
from formats.splats.spz import read_spz
from tests.formats.splats import writers
from tests.formats.splats.test_formats import SPZ, check
from tests.formats.splats.test_gltf import covariances
from tests.formats.splats.writers import content, spz, spz_container, spz_header, spz_streams, written


def read(tmp_path, data: bytes):
    return read_splats(written(tmp_path / "a.spz", data))


def packed(header: bytes, splats, version: int, more: bytes = b"") -> bytes:
    return gzip.compress(header + b"".join(spz_streams(splats, version)) + more)


@pytest.mark.parametrize("version", [1, 2, 3])
def test_early_versions_without_gzip(version, tmp_path):
    expected = content()
    plain = gzip.decompress(spz(expected, version))
    assert np.array_equal(read(tmp_path, plain).harmonics, read(tmp_path, spz(expected, version)).harmonics)


def test_the_axes_are_those_of_a_ply(tmp_path):
    """An .spz has y up and z back where a .ply has y down and z front."""
    splats = content()
    turned, straight = read(tmp_path, spz(splats)), read_spz("a", spz(splats), as_stored=True)
    assert np.array_equal(turned.centres, straight.centres * [1, -1, -1])
    assert np.array_equal(turned.rotations, straight.rotations * np.float32([1, 1, -1, -1]))
    assert np.array_equal(turned.harmonics[:, 1:], straight.harmonics[:, 1:] * writers.SH_FLIPS[:, None])
    assert (turned.up, straight.up) == ((0, -1, 0), (0, 1, 0))


@pytest.mark.parametrize("fraction", [0, 8, 20])
def test_bits_of_fraction(fraction, tmp_path):
    splats = content()
    splats.centres = np.array([[1, -1, 2], [0, 0, 0], [-3, 3, -2], [4, 5, 6], [-7, -7, 7]], float)
    streams = spz_streams(splats, 3, fraction)
    data = gzip.compress(spz_header(splats, 3, fraction=fraction) + b"".join(streams))
    assert np.array_equal(read(tmp_path, data).centres, splats.centres)


def test_antialiasing_extensions_and_degree_4_are_told(tmp_path):
    expected = content(5, 4)
    extension = struct.pack("<II", 0xADBE0002, 12) + bytes(12)
    legacy = packed(spz_header(expected, 3, flags=3), expected, 3, extension)
    container = bytearray(spz_container(expected, spz_streams(expected, 4), extension))
    container[14] |= 1
    for data in (legacy, bytes(container)):
        splats = read(tmp_path, data)
        notes = "\n".join(splats.notes)
        assert "antialiasing" in notes and "0xADBE0002" in notes and "degree 4" in notes
        np.testing.assert_allclose(splats.harmonics[:, 1:], expected.rest[:, :15], atol=0.5 / 128 + 1e-6)


@pytest.mark.parametrize(
    ("axes", "stated"),
    [
        (4, [[1, 0, 0], [0, -1, 0], [0, 0, -1]]),  # right, up, back
        (6, np.eye(3)),  # right, down, front
        (7, [[-1, 0, 0], [0, -1, 0], [0, 0, 1]]),  # left, up, front
        (8, [[1, 0, 0], [0, -1, 0], [0, 0, 1]]),  # right, up, front: a mirror
        (12, [[1, 0, 0], [0, 0, -1], [0, 1, 0]]),  # right, front, up: z is -y of a .ply, and y its z
        (11, [[-1, 0, 0], [0, 0, -1], [0, 1, 0]]),  # left, front, up: a mirror
    ],
)
def test_axes_that_an_extension_states(axes, stated, tmp_path):
    """`stated` takes what the file stores to right, down, front."""
    splats, extension = content(), struct.pack("<III", 0xADBE0003, 4, axes)
    streams = spz_streams(splats, 4, turned=False)
    read_back = read(tmp_path, spz_container(splats, streams, extension))
    matrix = np.eye(4)
    matrix[:3, :3] = stated
    expected = placed(read_spz("a", spz_container(splats, streams), as_stored=True), matrix)
    np.testing.assert_allclose(read_back.centres, expected.centres, atol=1e-6)
    np.testing.assert_allclose(read_back.harmonics, expected.harmonics, atol=1e-6)
    np.testing.assert_allclose(covariances(read_back), covariances(expected), atol=1e-6)
    assert read_back.up == (0, -1, 0) and read_back.notes == ()


def levelled(leaves, version: int = 3, flags: int = 128, parents: int = 2) -> bytes:
    """Spark's tree: inner splats, the root first, then leaves; opacities are halved, since inner ones go up
    to 2. Behind the usual arrays are numbers of children, and the first child of each."""
    inner = content(parents, 1, seed=9)
    fields = ("centres", "scales", "rotations", "opacities", "harmonics")
    both = writers.Content(
        *(np.concatenate([getattr(each, name) for each in (inner, leaves)]) for name in fields)
    )
    both.opacities = both.opacities / 2
    counts = np.array([1] * (parents - 1) + [len(leaves)] * (parents > 0) + [0] * len(leaves), "<u2")
    starts = np.where(counts, np.arange(len(both)) + 1, 0).astype("<u4")
    tree = counts.tobytes() + starts.tobytes()
    return packed(spz_header(both, version, flags=flags), both, version, tree)


@pytest.mark.parametrize(("version", "turn"), [(2, 0.05), (3, 1 / 511)])
def test_the_finest_of_levels_of_detail(version, turn, tmp_path):
    leaves = content(5, 1)
    leaves.opacities[:2] = 0, 1
    splats = read(tmp_path, levelled(leaves, version))
    check(splats, leaves, SPZ | {"opacities": 1 / 255, "rotations": turn})
    assert "5 of 7 splats, the finest" in splats.notes[0]
    assert np.array_equal(read(tmp_path, levelled(leaves, version, parents=0)).centres, splats.centres)


def test_levels_of_detail_that_are_cut_off_or_without_end(tmp_path):
    leaves = content(5, 1)
    with pytest.raises(BadSplats, match="ends within the children of 5 splats"):
        read(tmp_path, packed(spz_header(leaves, 3, flags=128), leaves, 3))
    endless = np.ones(5, "<u2").tobytes() + bytes(20)
    with pytest.raises(BadSplats, match="have no finest"):
        read(tmp_path, packed(spz_header(leaves, 3, flags=128), leaves, 3, endless))


def test_flags_that_are_not_known_are_told(tmp_path):
    for version in (3, 4):
        data = bytearray(spz(content(), 4) if version == 4 else gzip.decompress(spz(content(), 3)))
        data[14] |= 64
        assert "flags that are not honoured: 0x40" in read(tmp_path, bytes(data)).notes[0]


@pytest.mark.parametrize("version", [5, 2**32 - 1])
def test_newer_versions(version, tmp_path):
    for data in (packed(spz_header(content(), version), content(), 3), spz_header(content(), version)):
        with pytest.raises(NewerVersion, match=f"version {version}"):
            read(tmp_path, data)


@pytest.mark.parametrize("version", [1, 2, 3, 4])
def test_every_truncation_is_noticed(version, tmp_path):
    data = spz(content(), version)
    for length in range(30, len(data)):
        with pytest.raises(BadSplats):
            read_spz("a", data[:length])


@pytest.mark.parametrize("version", [1, 2, 3])
def test_every_flipped_bit_behind_gzip_is_noticed(version):
    """Its checksum covers all that is unpacked."""
    data, expected = spz(content(), version), read_spz("a", spz(content(), version))
    for at in range(10, len(data)):
        damaged = bytearray(data)
        damaged[at] ^= 1 << at % 8
        with pytest.raises((BadSplats, NewerVersion, LimitExceeded)):
            read_spz("a", bytes(damaged))
    assert len(expected) == 5


def test_counts_are_held_against_bytes(tmp_path):
    many = spz_header(content(), 3)[:8] + struct.pack("<I", 10**9) + spz_header(content(), 3)[12:]
    bomb = gzip.compress(many + bytes(10**6))
    with pytest.raises(LimitExceeded, match="1,000,000,000 splats"):
        read(tmp_path, bomb)
    fewer = many[:8] + struct.pack("<I", 1) + many[12:]
    with pytest.raises(BadSplats, match="goes on behind"):
        read(tmp_path, gzip.compress(fewer + bytes(5 << 20)))
    none = many[:8] + struct.pack("<I", 0) + many[12:]
    with pytest.raises(BadSplats, match="no splats"):
        read(tmp_path, gzip.compress(none))


def test_streams_that_unpack_to_more_than_is_stated(tmp_path):
    splats = content(5, 0)
    streams = [stream for stream in spz_streams(splats, 4) if stream]
    honest = spz_container(splats, streams)
    lying = spz_container(splats, [streams[0] + bytes(1 << 20), *streams[1:]])
    sizes = slice(32 + 8, 32 + 16)
    lying = lying[: sizes.start] + honest[sizes] + lying[sizes.stop :]
    with pytest.raises(BadSplats, match="a stream is not of the 45 bytes"):
        read(tmp_path, lying)
    with pytest.raises(BadSplats, match="behind its streams"):
        read(tmp_path, honest + b"\0")


def test_gzip_of_something_else_is_no_splats(tmp_path):
    assert not is_splats(written(tmp_path / "a.spz", gzip.compress(b"a text")))
