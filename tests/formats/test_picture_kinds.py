"""Photos of every kind that is opened read alike, large ones alone; EXIF turns all of a capture or none."""

import numpy as np
import pytest
from PIL import Image

import formats.images
from formats.captures import read_capture
from formats.errors import BadImage
from formats.images import FORMATS, as_stored, decoded_at_once, oriented, read_image
from formats.photos import load_photos
from tests.formats.test_captures import frame, write

QUARTERS = np.array([[200, 30, 30], [30, 180, 40], [40, 60, 210], [128, 128, 128]])
PIXELS = np.repeat(np.repeat(QUARTERS.reshape(2, 2, 3), 16, 0), 16, 1).astype(np.uint8)
GREY = np.asarray(Image.fromarray(PIXELS).convert("L"))
PICTURE = Image.fromarray(PIXELS)
CASES = {
    "palette.png": (PICTURE.quantize(4), PIXELS),
    "grey.png": (Image.fromarray(GREY), GREY),
    "grey_alpha.png": (PICTURE.convert("LA"), GREY),
    "grey16.png": (Image.fromarray(GREY.astype(np.uint16) * 257), GREY),
    "grey16.tif": (Image.fromarray(GREY.astype(np.uint16) * 257), GREY),
    "cmyk.jpg": (PICTURE.convert("CMYK"), PIXELS),
    "rgba.webp": (PICTURE.convert("RGBA"), PIXELS),
    "a.bmp": (PICTURE, PIXELS),
    "a.tga": (PICTURE, PIXELS),
    "a.ppm": (PICTURE, PIXELS),
    "a.avif": (PICTURE, PIXELS),
    "a.gif": (PICTURE.quantize(4), PIXELS),
}


@pytest.mark.parametrize("name", CASES)
def test_kinds_of_pictures(tmp_path, name):
    picture, expected = CASES[name]
    more = (
        {"lossless": True}
        if name.endswith("webp")
        else {"quality": 98}
        if name[-3:] in ("jpg", "vif")
        else {}
    )
    picture.save(tmp_path / name, **more)
    read = read_image(tmp_path / name)
    expected = expected if expected.ndim == 3 else np.repeat(expected[..., None], 3, 2)
    for y, x in ((8, 8), (8, 24), (24, 8), (24, 24)):
        assert np.abs(read[y, x, :3].astype(int) - expected[y, x]).max() <= 6 and read[y, x, 3] == 255


def test_sixteen_bits_are_rounded(tmp_path):
    levels = np.arange(65536, dtype=np.uint16).reshape(256, 256)
    Image.fromarray(levels).save(tmp_path / "a.png")
    read = read_image(tmp_path / "a.png")
    assert (read[..., 0] == np.rint(levels / 257).astype(int)).all()


@pytest.mark.parametrize(
    "data, what",
    [
        (b"v/1\x01\2\0\0\0", "OpenEXR.*PNG"),
        (b"%!PS-Adobe", "PSD, PDF, EPS"),
        (b"8BPS\0\1", "PSD"),
        (b"#?RADIANCE\n", "HDR"),
    ],
)
def test_other_pictures_are_named(tmp_path, data, what):
    (tmp_path / "a.png").write_bytes(data + bytes(100))
    with pytest.raises(BadImage, match=rf"a\.png: is .*{what}"):
        read_image(tmp_path / "a.png")


def test_nothing_else_is_opened():
    from PIL import Image as Pillow

    assert not {"EPS", "PSD", "PDF", "WMF", "FITS", "MSP", "PCD"} & set(FORMATS)
    Pillow.init()
    assert {"PNG", "JPEG", "WEBP", "TIFF"} <= set(FORMATS) & set(Pillow.OPEN)


# --- orientation --------------------------------------------------------------------------------------------


def stored(path, size, orientation: int) -> None:
    exif = Image.Exif()
    exif[0x0112] = orientation
    pixels = np.random.default_rng(0).integers(0, 256, (size[1], size[0], 3), np.uint8)
    Image.fromarray(pixels).save(path, exif=exif)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_stored_is_the_inverse_of_oriented(orientation):
    pixels = np.arange(24).reshape(4, 6)
    assert (as_stored(oriented(pixels, orientation), orientation) == pixels).all()


def orientations(folder, photos: dict, **keys) -> list[int]:
    """How photos, named by size and EXIF, are read whose poses are of the sizes given."""
    frames = []
    for i, ((size, exif), camera) in enumerate(photos.items()):
        stored(folder / f"{i}.png", size, exif)
        frames.append(frame(f"{i}.png", w=camera[0], h=camera[1]))
    write(folder, frames=frames, fl_x=80)
    return [view.orientation for view in read_capture(folder).train]


def test_exif_is_decided_once(tmp_path):
    """A square and an upside-down photo tell nothing themselves: another that is turned by a quarter does."""
    turned = {
        ((100, 80), 6): (80, 100),
        ((100, 80), 3): (100, 80),
        ((90, 90), 8): (90, 90),
        ((100, 80), 1): (100, 80),
    }
    assert orientations(tmp_path, turned) == [6, 3, 8, 1]
    as_they_are = turned | {((100, 80), 6): (100, 80)}
    assert orientations(tmp_path, as_they_are) == [1, 1, 1, 1]


def test_nearly_square_photos_are_told_by_their_exact_shape(tmp_path):
    assert orientations(tmp_path, {((101, 100), 6): (100, 101)}) == [6]
    assert orientations(tmp_path, {((101, 100), 6): (101, 100)}) == [1]


def test_what_nothing_tells_is_said(tmp_path):
    assert orientations(tmp_path, {((90, 90), 6): (90, 90), ((80, 80), 1): (80, 80)}) == [1, 1]
    assert "EXIF turns 1 of 2 photos, such as 0.png" in " ".join(read_capture(tmp_path).notes)


# --- memory -------------------------------------------------------------------------------------------------


def test_large_photos_are_decoded_alone(monkeypatch):
    monkeypatch.setattr(formats.images.os, "cpu_count", lambda: 64)
    assert decoded_at_once(5000, 5000) == 1 and decoded_at_once(1000, 1000) == 33
    assert decoded_at_once(16384, 16384) == 1


def test_bands_are_the_picture(tmp_path):
    """Read in bands of a few rows and at once, turned and made smaller."""
    pixels = np.random.default_rng(0).integers(0, 256, (61, 47, 4), np.uint8)
    Image.fromarray(pixels).save(tmp_path / "a.png")
    words = [(o, r) for o in range(1, 9) for r in (1, 3)]
    whole = [read_image(tmp_path / "a.png", *word) for word in words]
    for word, expected in zip(words, whole, strict=True):
        assert (read_image(tmp_path / "a.png", *word, at_once=200) == expected).all()


def test_alpha_that_is_not_used_weighs_no_colours(tmp_path):
    pixels = np.random.default_rng(0).integers(0, 256, (8, 8, 4), np.uint8)
    Image.fromarray(pixels).save(tmp_path / "a.png")
    Image.fromarray(pixels[..., :3]).save(tmp_path / "b.png")
    assert (read_image(tmp_path / "a.png", 1, 2, alpha=False) == read_image(tmp_path / "b.png", 1, 2)).all()


def test_a_photo_that_changed_is_named(tmp_path):
    stored(tmp_path / "a.png", (100, 80), 1)
    write(tmp_path, fl_x=80)
    (view,) = read_capture(tmp_path).train
    stored(tmp_path / "a.png", (50, 40), 1)
    with pytest.raises(formats.images.MixedSizes, match=r"a\.png is 50x40 now, expected 100x80"):
        load_photos([view])
