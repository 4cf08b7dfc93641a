"""Triangles in .stl and polygons in .off, as text and binary, with the colours that programs put there."""

import struct

import numpy as np
import pytest

from formats.errors import BadMesh
from formats.meshes import _load
from tests.formats.gltf import CORNERS, FACES, facing, notes_of

TRIANGLES = CORNERS[FACES.reshape(-1, 3)]


def binary(path, header: bytes = b"", more: int = 0):
    rows = [struct.pack("<12fH", 0, 0, 1, *triangle.ravel(), more) for triangle in TRIANGLES]
    path.write_bytes(header.ljust(80, b"\0") + struct.pack("<I", len(rows)) + b"".join(rows))
    return path


def text(name: str = "square") -> str:
    facets = [
        "facet normal 0 0 1\nouter loop\n"
        + "".join(f"vertex {x:e} {y:E} {z:g}\n" for x, y, z in triangle)
        + "endloop\nendfacet\n"
        for triangle in TRIANGLES
    ]
    return f"solid {name}\n" + "".join(facets) + f"endsolid {name}\n"


@pytest.mark.parametrize(
    "header, more, colour",
    [
        (b"", 0, (255, 255, 255)),
        (b"solid binary", 0, (255, 255, 255)),
        (b"", 0x8000 | 31 << 10, (255, 0, 0)),  # VisCAM
        (b"", 0x8000 | 31, (0, 0, 255)),
        (b"COLOR=\x33\x66\x99\xff", 0x8000, (51, 102, 153)),  # Magics
        (b"COLOR=\x33\x66\x99\xff,MATERIAL=", 0, (51, 102, 153)),
        (b"COLOR=\x33\x66\x99\xff", 31, (255, 0, 0)),
        (b"COLOR=\x33\x66\x99\xff", 31 << 10, (0, 0, 255)),
    ],
)
def test_colours_of_binary_stl(tmp_path, header, more, colour):
    path = binary(tmp_path / "a.stl", header, more)
    assert (facing(path)[..., :3] == colour).all() and notes_of(path) == ""


def test_spare_bytes_that_are_no_colours(tmp_path):
    path = binary(tmp_path / "a.stl", more=7)
    assert (facing(path) == 255).all() and "spare bytes" in notes_of(path)


def test_text_stl(tmp_path):
    path = tmp_path / "a.stl"
    for data in (text().encode(), b"\xef\xbb\xbf" + text("Gehäuse").encode(), text("ü").encode("latin-1")):
        for written in (data, data.upper(), data.replace(b"\n", b"\r\n")):
            path.write_bytes(written)
            assert (facing(path) == 255).all() and notes_of(path) == ""
    path.write_bytes(text().encode()[:-120])
    assert "endsolid" in notes_of(path)
    path.write_bytes(b"")
    with pytest.raises(BadMesh, match=r"a\.stl"):
        _load(path)


ARROW = "-1 -1 0\n1 -1 0\n1 1 0\n0 -0.5 0\n-1 1 0\n"
"""A square out of which a triangle is cut from above, which no fan from its first corner fills."""


@pytest.mark.parametrize(
    "data, colour",
    [
        (f"OFF\n5 1 0\n{ARROW}5 0 1 2 3 4\n", (255, 255, 255)),
        (f"OFF 5 1 0\n# corners\n{ARROW}\n5 0 1 2 3 4 # all\n", (255, 255, 255)),
        (f"5 1\n{ARROW}5 0 1 2 3 4\n", (255, 255, 255)),
        (f"OFF\n5 1 0\n{ARROW}5 0 1 2 3 4 51 102 153\n", (51, 102, 153)),
        (f"OFF\n5 1 0\n{ARROW}5 0 1 2 3 4 0.2 0.4 0.6 1.0\n", (51, 102, 153)),
        ("COFF\n5 1 0\n" + ARROW.replace("\n", " 51 102 153 255\n") + "5 0 1 2 3 4\n", (51, 102, 153)),
        ("NOFF\n5 1 0\n" + ARROW.replace("\n", " 0 0 1\n") + "5 0 1 2 3 4\n", (255, 255, 255)),
        ("CNOFF\n5 1 0\n" + ARROW.replace("\n", " 0 0 1 .2 .4 .6 1\n") + "5 0 1 2 3 4\n", (51, 102, 153)),
    ],
)
def test_off(tmp_path, data, colour):
    path = tmp_path / "a.off"
    path.write_text(data)
    picture = facing(path)
    x, y = np.meshgrid((np.arange(32) + 0.5) / 16 - 1, 1 - (np.arange(32) + 0.5) / 16)
    inside = y < 1.5 * np.abs(x) - 0.5
    assert ((picture[..., 3] > 0) == inside).all() and (picture[inside][:, :3] == colour).all()


@pytest.mark.parametrize(
    "data",
    [
        "",
        "OFF",
        "OFF\n5 1 0\n",
        "OFF BINARY\n5 1 0\n",
        "4OFF\n5 1 0\n",
        f"OFF\n5 1 0\n{ARROW}9 0 1 2 3 4\n",
        f"OFF\n5 1 0\n{ARROW}5 0 1 2 3 7\n",
        f"OFF\n5 1 0\n{ARROW}-1 0\n",
        f"OFF\n5 1 0\n{ARROW.replace('1', 'nan')}5 0 1 2 3 4\n",
        f"OFF\n999999999999999 1 0\n{ARROW}",
    ],
)
def test_broken_off(tmp_path, data):
    path = tmp_path / "a.off"
    path.write_text(data)
    with pytest.raises(BadMesh, match=r"a\.off"):
        _load(path)


def test_stl_that_counts_none(tmp_path):
    path = binary(tmp_path / "a.stl")
    path.write_bytes(path.read_bytes()[:80] + bytes(4) + path.read_bytes()[84:])
    assert (facing(path) == 255).all() and "counts no triangles" in notes_of(path)


@pytest.mark.parametrize(
    "keyword, behind, shown, said",
    [
        ("COFF", "51 102 153 255", True, ""),
        ("STCOFF", "51 102 153 255 0.5 0.5", True, "no colours"),
        ("STCNOFF", "0 0 1 0.2 0.4 0.6 1.0 0.5 0.5", True, "no colours"),
        ("STOFF", "0.5 0.5", False, "no colours"),
        ("OFF", "0.2 0.4 0.6 0.5", True, "transparency"),
    ],
)
def test_numbers_behind_vertices(tmp_path, keyword, behind, shown, said):
    path = tmp_path / "a.off"
    rows = "".join(f"{x} {y} 0 {behind}\n" for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1)))
    path.write_text(f"{keyword}\n4 1 0\n{rows}4 0 1 2 3\n")
    assert (facing(path)[..., :3] == ([51, 102, 153] if shown else [255] * 3)).all()
    assert said in notes_of(path) and (said != "") == (notes_of(path) != "")
