"""What .ply files of splats have beside the usual columns."""

import numpy as np
import pytest

from formats.errors import BadSplats, LimitExceeded
from formats.splats import splats as limits
from formats.splats.reading import is_splats, read_splats
from tests.formats.splats import writers
from tests.formats.splats.writers import content, ply_columns, table, written


def read(tmp_path, columns, **more):
    return read_splats(written(tmp_path / "a.ply", table(columns, **more)))


def test_properties_in_any_order(tmp_path):
    columns = ply_columns(content())
    names = list(columns)
    np.random.default_rng(0).shuffle(names)
    straight, shuffled = (read(tmp_path, {n: columns[n] for n in order}) for order in (columns, names))
    for name in ("centres", "scales", "rotations", "opacities", "harmonics"):
        assert np.array_equal(getattr(straight, name), getattr(shuffled, name))


def test_f_rest_goes_through_a_colour_after_the_other(tmp_path):
    """`f_rest_i` of degree 1: red has 0 to 2, green 3 to 5, blue 6 to 8."""
    columns = ply_columns(content(2, 1)) | {f"f_rest_{i}": np.full(2, float(i)) for i in range(9)}
    assert read(tmp_path, columns).harmonics[1, 1:].tolist() == [[0, 3, 6], [1, 4, 7], [2, 5, 8]]


@pytest.mark.parametrize(
    ("axis", "up"),
    [
        ("z", (0, 0, 1)),  # nerfstudio's
        ("y", (0, -1, 0)),  # Brush's, whichever way is up
        ("0 1.5 -2", (0, 0.6, -0.8)),  # Brush's, which was told
        ("0 0 0", (0, -1, 0)),
        ("a b c", (0, -1, 0)),
    ],
)
def test_the_vertical_axis(axis, up, tmp_path):
    assert read(tmp_path, ply_columns(content()), comment=f"Vertical Axis: {axis}").up == pytest.approx(up)


def test_opacities_are_logits_also_infinite_ones(tmp_path):
    columns = ply_columns(content(3)) | {"opacity": np.array([np.inf, -np.inf, 0])}
    assert read(tmp_path, columns).opacities.tolist() == [1, 0, 0.5]


def test_what_is_not_honoured_is_told(tmp_path):
    columns = ply_columns(content()) | {"semantic": np.zeros(5), "nx": np.ones(5)}
    assert "properties that are not honoured: semantic" in read(tmp_path, columns).notes[0]


def test_numbers_that_are_none_are_left_out_and_told(tmp_path):
    expected = content(6)
    columns = ply_columns(expected)
    for i, (name, value) in enumerate([("x", np.nan), ("scale_1", np.inf), ("rot_2", np.nan)]):
        columns[name][i] = value
    columns["f_rest_44"][3] = -np.inf
    columns["z"][4] = 1e20
    splats = read(tmp_path, columns)
    np.testing.assert_allclose(splats.centres, expected.centres[5:], rtol=1e-6)
    assert "5 splats have NaN, infinite or absurd numbers" in splats.notes[0]


@pytest.mark.parametrize("lost", ["rot_0", "opacity", "rot_3"])
def test_what_splats_lack_is_named(lost, tmp_path):
    columns = ply_columns(content())
    del columns[lost]
    with pytest.raises(BadSplats, match=f"its splats lack '{lost}'; export it again"):
        read(tmp_path, columns)


def test_without_a_sound_splat_an_error(tmp_path):
    with pytest.raises(BadSplats, match="no splat with finite numbers"):
        read(tmp_path, ply_columns(content()) | {"x": np.full(5, np.nan)})


def test_rotations_of_no_length_are_none_and_discs_have_some_thickness(tmp_path):
    zero = {f"rot_{i}": np.zeros(5) for i in range(4)}
    splats = read(tmp_path, ply_columns(content()) | zero | {"scale_0": np.full(5, -200.0)})
    assert splats.rotations.tolist() == [[1, 0, 0, 0]] * 5
    assert "5 splats have a quaternion of no length" in splats.notes[0]
    np.testing.assert_allclose(splats.scales[:, 0], 1e-6 * splats.scales.max(1), rtol=1e-5)


def test_two_axes_are_a_disc(tmp_path):
    """2D Gaussian splatting."""
    columns = ply_columns(content())
    del columns["scale_2"]
    splats = read(tmp_path, columns)
    np.testing.assert_allclose(splats.scales[:, 2], 1e-6 * splats.scales[:, :2].max(1), rtol=1e-5)
    assert "discs" in splats.notes[0]


def test_one_axis_is_a_ball(tmp_path):
    """As MonoGS saves isotropic splats, which it repeats for all axes."""
    columns = {name: c for name, c in ply_columns(content()).items() if name not in ("scale_1", "scale_2")}
    splats = read(tmp_path, columns)
    np.testing.assert_allclose(splats.scales, content().scales[:, [0, 0, 0]], rtol=1e-6)
    assert splats.notes == ()


def test_numbers_of_other_types(tmp_path):
    """Doubles are read; whole numbers stand for something that the file does not say."""
    data = table(ply_columns(content()) | {"opacity": np.arange(5)}, coding="ascii")
    doubles = read_splats(written(tmp_path / "a.ply", data.replace(b"property float", b"property double")))
    plain = read_splats(written(tmp_path / "a.ply", data))
    assert np.array_equal(doubles.scales, plain.scales) and np.array_equal(doubles.centres, plain.centres)
    whole = written(tmp_path / "a.ply", data.replace(b"float opacity", b"uchar opacity"))
    with pytest.raises(BadSplats, match="stores 'opacity' as uint8, expected float32"):
        read_splats(whole)


@pytest.mark.parametrize("comment", ["SplatRenderMode: mip", "antialiased 1"])
def test_antialiasing_is_told(comment, tmp_path):
    assert "antialiasing" in read(tmp_path, ply_columns(content()), comment=comment).notes[0]
    assert read(tmp_path, ply_columns(content()), comment="antialiased 0").notes == ()


def test_the_filter_of_mip_splatting(tmp_path):
    """Variances grow by its square, and opacity shrinks as the volume grows."""
    expected = content()
    splats = read(tmp_path, ply_columns(expected) | {"filter_3D": np.full(5, 0.1)})
    variances = expected.scales**2 + 0.01
    np.testing.assert_allclose(splats.scales, np.sqrt(variances), rtol=1e-5)
    share = np.sqrt(np.prod(expected.scales**2, 1) / np.prod(variances, 1))
    np.testing.assert_allclose(splats.opacities, expected.opacities * share, rtol=1e-5)


def test_colours_as_bytes(tmp_path):
    columns = {name: c for name, c in ply_columns(content(2, 0)).items() if not name.startswith("f_dc")}
    columns |= {"red": np.array([0.0, 255]), "green": np.array([51.0, 51]), "blue": np.zeros(2)}
    colours = 0.5 + writers.SH_0 * read(tmp_path, columns).harmonics[:, 0]
    np.testing.assert_allclose(colours, [[0, 0.2, 0], [1, 0.2, 0]], atol=1e-6)


@pytest.mark.parametrize(
    ("without", "sentence"), [("x", "lack 'x'"), ("rot_3", "lack 'rot_3'"), ("f_dc_2", "lack 'f_dc_2'")]
)
def test_missing_columns(without, sentence, tmp_path):
    columns = ply_columns(content())
    del columns[without]
    with pytest.raises(BadSplats, match=sentence):
        read(tmp_path, columns)


def test_harmonics_of_no_degree(tmp_path):
    columns = ply_columns(content())
    del columns["f_rest_44"]
    with pytest.raises(BadSplats, match="44 numbers of spherical harmonics"):
        read(tmp_path, columns)


def test_harmonics_with_one_missing(tmp_path):
    """Not those of a lower degree: the numbers of red, green and blue would be mixed up."""
    columns = ply_columns(content())
    del columns["f_rest_9"]
    with pytest.raises(BadSplats, match="'f_rest_10', but only 9 of those before it"):
        read(tmp_path, columns)


def test_harmonics_of_degree_4_are_cut(tmp_path):
    expected = content(3, 4)
    splats = read(tmp_path, ply_columns(expected))
    np.testing.assert_allclose(splats.harmonics, expected.harmonics[:, :16], atol=1e-6)
    assert "degree 4" in splats.notes[0]


def test_points_and_meshes_of_that_ending_are_no_splats(tmp_path):
    assert not is_splats(written(tmp_path / "a.ply", table({name: np.zeros(2) for name in "xyz"})))


def test_counts_are_held_against_bytes_and_limits(tmp_path, monkeypatch):
    data = writers.ply(content()).replace(b"vertex 5", b"vertex 99999999999")
    with pytest.raises(BadSplats, match="ends before the last of 99,999,999,999"):
        read_splats(written(tmp_path / "a.ply", data))
    monkeypatch.setattr(limits, "MAX_SPLATS", 4)
    with pytest.raises(LimitExceeded, match="at most 4"):
        read(tmp_path, ply_columns(content()))


def test_compressed_splats_need_their_chunks(tmp_path):
    data = writers.compressed_ply(content(5))
    fewer = data.replace(b"element chunk 1", b"element chunk 0")
    with pytest.raises(BadSplats):
        read_splats(written(tmp_path / "a.ply", fewer))


def test_compressed_splats_of_early_versions_have_no_range_of_colours(tmp_path):
    """Colours are between 0 and 1 then."""
    names = ["x", "y", "z", "scale_x", "scale_y", "scale_z"]
    lines = ["ply", "format binary_little_endian 1.0", "element chunk 1"]
    lines += [f"property float {side}_{name}" for side in ("min", "max") for name in names]
    lines += ["element vertex 1"]
    lines += [f"property uint packed_{name}" for name in ("position", "rotation", "scale", "color")]
    chunk = np.array([[0] * 3 + [-1] * 3 + [2] * 3 + [1] * 3], "<f4")
    packed = np.array(
        [2047 << 21 | 0 << 11 | 2047, 3 << 30 | 512 << 20 | 0 << 10 | 1023, 0, 0x00336699], "<u4"
    )
    data = "\n".join([*lines, "end_header\n"]).encode() + chunk.tobytes() + packed.tobytes()
    splats = read_splats(written(tmp_path / "a.ply", data))
    assert splats.centres.tolist() == [[2, 0, 2]]
    np.testing.assert_allclose(splats.scales, np.exp([[-1, -1, -1]]), rtol=1e-6)
    np.testing.assert_allclose(splats.opacities, [0.6])
    np.testing.assert_allclose(0.5 + writers.SH_0 * splats.harmonics[0, 0], [0, 0.2, 0.4], atol=1e-6)
    half = np.sqrt(0.5)
    expected = np.array([(512 / 1023 - 0.5) * np.sqrt(2), -half, half, 0])  # the largest, z, is what is left
    np.testing.assert_allclose(splats.rotations[0], expected, atol=2e-3)
