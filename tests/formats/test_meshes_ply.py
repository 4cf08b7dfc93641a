"""Polygons in .ply, in text and both byte orders, and files that are no meshes."""

import struct

import numpy as np
import pytest
from PIL import Image

from formats.captures import read_capture
from formats.errors import BadMesh, FormatError, LimitExceeded
from formats.meshes import _load, is_mesh, mesh_facts
from tests.formats.gltf import CORNERS, facing, notes_of

SIDE = 8
PICTURE = np.random.default_rng(2).integers(0, 256, (SIDE, SIDE, 3), dtype=np.uint8)
UV = [(0, 0), (1, 0), (1, 1), (0, 1)]
CODES = {"uchar": "B", "ushort": "H", "int": "i", "float": "f", "double": "d"}


def ply(path, coding, vertex, faces, comments=""):
    """`vertex`: {name: (kind, numbers)}; `faces`: {name: (length kind or None, kind, rows)}."""
    head = [
        f"format {coding} 1.0",
        *comments.splitlines(),
        f"element vertex {len(next(iter(vertex.values()))[1])}",
    ]
    head += [f"property {kind} {name}" for name, (kind, _) in vertex.items()]
    head += [f"element face {len(next(iter(faces.values()))[2])}"]
    for name, (length, kind, _) in faces.items():
        head.append(f"property list {length} {kind} {name}" if length else f"property {kind} {name}")
    rows = [
        [(kind, value) for kind, value in zip((k for k, _ in vertex.values()), row, strict=True)]
        for row in zip(*(numbers for _, numbers in vertex.values()), strict=True)
    ]
    for row in zip(*(rows for _, _, rows in faces.values()), strict=True):
        cells = []
        for (length, kind, _), value in zip(faces.values(), row, strict=True):
            cells += [(length, len(value)), *((kind, each) for each in value)] if length else [(kind, value)]
        rows.append(cells)
    if coding == "ascii":
        body = "".join(" ".join(str(value) for _, value in row) + "\n" for row in rows).encode()
    else:
        order = "<" if "little" in coding else ">"
        body = b"".join(struct.pack(order + CODES[kind], value) for row in rows for kind, value in row)
    path.write_bytes("\n".join(["ply", *head, "end_header", ""]).encode() + body)
    return path


def square(**more) -> dict:
    return {axis: ("float", CORNERS[:, i].tolist()) for i, axis in enumerate("xyz")} | more


QUAD = {"vertex_indices": ("uchar", "int", [[0, 1, 2, 3]])}
CODINGS = ["ascii", "binary_little_endian", "binary_big_endian"]


@pytest.mark.parametrize("coding", CODINGS)
@pytest.mark.parametrize("rows", [[[0, 1, 2, 3]], [[0, 1, 2], [0, 2, 3]], [[0, 1, 2, 3], [0, 1, 2]]])
def test_polygons(tmp_path, coding, rows):
    path = ply(tmp_path / "a.ply", coding, square(), {"vertex_index": ("uchar", "int", rows)})
    assert (facing(path) == 255).all()


@pytest.mark.parametrize("coding", CODINGS)
@pytest.mark.parametrize("names", [("s", "t"), ("u", "v"), ("texture_u", "texture_v"), ("s0", "t0"), None])
def test_textures(tmp_path, coding, names):
    """Coordinates of vertices, and of corners as MeshLab writes them."""
    Image.fromarray(PICTURE).save(tmp_path / "my wood.png")
    vertex, faces = square(), dict(QUAD)
    if names is None:
        faces["texcoord"] = ("uchar", "float", [[x for pair in UV for x in pair]])
    else:
        vertex |= {name: ("float", [pair[i] for pair in UV]) for i, name in enumerate(names)}
    path = ply(tmp_path / "a.ply", coding, vertex, faces, "comment TextureFile my wood.png")
    assert np.abs(facing(path, SIDE)[..., :3].astype(int) - PICTURE).max() <= 1


def test_several_pictures(tmp_path):
    """texnumber says which: the left half is red, the right blue; a lost one is named."""
    for name, colour in (("r.png", (255, 0, 0)), ("b.png", (0, 0, 255))):
        Image.new("RGB", (4, 4), colour).save(tmp_path / name)
    x, y = [-1, 0, 0, -1, 1, 1], [-1, -1, 1, 1, -1, 1]
    vertex = {"x": ("float", x), "y": ("float", y), "z": ("float", [0] * 6)}
    faces = {
        "vertex_indices": ("uchar", "int", [[0, 1, 2, 3], [1, 4, 5, 2]]),
        "texcoord": ("uchar", "float", [[0.5] * 8] * 2),
        "texnumber": ("", "int", [0, 1]),
    }
    said = "comment TextureFile r.png\ncomment TextureFile b.png"
    path = ply(tmp_path / "a.ply", "binary_little_endian", vertex, faces, said)
    seen = facing(path, 4)[..., :3]
    assert (seen[:, 0] == [255, 0, 0]).all() and (seen[:, 3] == [0, 0, 255]).all()
    (tmp_path / "b.png").unlink()
    assert "b.png" in notes_of(path)
    assert mesh_facts(path)["textures"] == ["4x4"]


@pytest.mark.parametrize("coding", CODINGS)
@pytest.mark.parametrize("kind, scale", [("uchar", 255), ("ushort", 65535), ("float", 1), ("float", 255)])
def test_colours(tmp_path, coding, kind, scale):
    """Of vertices and of faces, in every unit."""
    rgb = [51 / 255 * scale, 102 / 255 * scale, 153 / 255 * scale]
    rgb = rgb if kind == "float" else [round(part) for part in rgb]
    hues = list(zip(("red", "green", "blue"), rgb, strict=True))
    for vertex, faces in (
        (square(**{hue: (kind, [part] * 4) for hue, part in hues}), QUAD),
        (square(), QUAD | {hue: ("", kind, [part]) for hue, part in hues}),
    ):
        path = ply(tmp_path / "a.ply", coding, vertex, faces)
        assert np.abs(facing(path)[..., :3].astype(int) - [51, 102, 153]).max() <= 1


def test_strips(tmp_path):
    """As Stanford's scans have them: -1 ends a strip, and every second triangle is turned."""
    rows = [f"{x} {y} 0" for x, y in ((-1, -1), (1, -1), (-1, 1), (1, 1))]
    head = "ply\nformat ascii 1.0\nelement vertex 4\n" + "".join(f"property float {axis}\n" for axis in "xyz")
    head += "element tristrips 1\nproperty list int int vertex_indices\nend_header\n"
    path = tmp_path / "a.ply"
    path.write_text(head + "\n".join(rows) + "\n8 0 1 2 -1 2 1 3 -1\n")
    points, faces = _load(path).triangles
    assert faces.tolist() == [[0, 1, 2], [2, 1, 3]] and (facing(path) == 255).all()
    path.write_text(head + "\n".join(rows) + "\n4 0 1 2 3\n")
    assert _load(path).triangles[1].tolist() == [[0, 1, 2], [1, 3, 2]]


@pytest.mark.parametrize("coding", CODINGS)
@pytest.mark.parametrize("element", ["vertex", "face"])
def test_counts_are_held_against_bytes(tmp_path, coding, element):
    path = ply(tmp_path / "a.ply", coding, square(), QUAD)
    data, count = path.read_bytes(), {"vertex": b"4", "face": b"1"}[element]
    for more in (b"5000", b"1000000000000", b"99999999999999999999"):
        path.write_bytes(
            data.replace(
                b"element %s %s" % (element.encode(), count), b"element %s %s" % (element.encode(), more)
            )
        )
        with pytest.raises((BadMesh, LimitExceeded), match=r"a\.ply"):
            _load(path)


@pytest.mark.parametrize("coding", CODINGS)
def test_cut_and_changed(tmp_path, coding):
    Image.fromarray(PICTURE).save(tmp_path / "wood.png")
    faces = QUAD | {"texcoord": ("uchar", "float", [[x for pair in UV for x in pair]])}
    path = ply(tmp_path / "a.ply", coding, square(), faces, "comment TextureFile wood.png")
    data = path.read_bytes()
    for at in range(20, len(data)):
        for changed in (data[:at], data[:at] + b"\xff" + data[at + 1 :]):
            path.write_bytes(changed)
            try:
                _load(path)
            except FormatError as error:
                assert "a.ply" in str(error)


# --- STL ----------------------------------------------------------------------------------------------------


def test_stl_is_told_by_its_size(tmp_path):
    """A binary file may begin with "solid"; one that is cut is refused, bytes behind its end are told."""
    triangle = struct.pack("<12fH", 0, 0, 1, *CORNERS[[0, 1, 2]].ravel().tolist(), 0)
    path = tmp_path / "a.stl"
    path.write_bytes(b"solid facet".ljust(80) + struct.pack("<I", 2) + 2 * triangle)
    assert len(_load(path).triangles[1]) == 2
    path.write_bytes(path.read_bytes() + b"more")
    assert "behind its last triangle" in notes_of(path)
    path.write_bytes(bytes(80) + struct.pack("<I", 3) + 2 * triangle)
    with pytest.raises(BadMesh, match="ends before"):
        _load(path)


# --- what is no mesh ----------------------------------------------------------------------------------------

SPLATS = "ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nproperty float f_dc_0\nend_header\n"
POINTS = "ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nend_header\n"


@pytest.mark.parametrize(
    "name, data, what",
    [
        ("a.fbx", b"Kaydara FBX Binary  \x00", "FBX"),
        ("a.usdz", b"PK\x03\x04", "USD"),
        ("a.ply", SPLATS.encode(), "splats"),
        ("b.ply", POINTS.encode(), "points"),
        ("a.dae", b"<?xml?>", "COLLADA"),
        ("a.blend", b"BLENDER-v300", "Blender"),
    ],
)
def test_other_files_are_called_what_they_are(tmp_path, name, data, what):
    (tmp_path / name).write_bytes(data)
    assert not is_mesh(tmp_path / name)
    for read in (read_capture, _load):
        with pytest.raises(FormatError, match=what):
            read(tmp_path / name)


def test_headers_as_people_write_them(tmp_path):
    """Line ends of old Macs, spaces behind the end, capitals, empty lines."""
    hues = {hue: ("uchar", [part] * 4) for hue, part in (("Red", 51), ("Green", 102), ("Blue", 153))}
    vertex = {name.upper(): column for name, column in square().items()} | hues
    path = ply(tmp_path / "a.ply", "ascii", vertex, QUAD)
    plain = path.read_bytes()
    for written in (
        plain,
        plain.replace(b"\n", b"\r"),
        plain.replace(b"end_header\n", b"end_header \n"),
        plain.replace(b"end_header\n", b"end_header\n\n"),
    ):
        path.write_bytes(written)
        assert (facing(path)[..., :3] == [51, 102, 153]).all()


def test_strips_beside_faces(tmp_path):
    head = "ply\nformat ascii 1.0\nelement vertex 4\n" + "".join(f"property float {axis}\n" for axis in "xyz")
    lists = "property list int int vertex_indices\n"
    head += f"element face {{}}\n{lists}element tristrips 1\n{lists}end_header\n"
    rows = "\n".join(f"{x} {y} 0" for x, y in ((-1, -1), (1, -1), (-1, 1), (1, 1)))
    path = tmp_path / "a.ply"
    for n, lines in ((1, "3 0 1 2\n3 2 1 3\n"), (0, "4 0 1 2 3\n")):
        path.write_text(f"{head.format(n)}{rows}\n{lines}")
        assert (facing(path) == 255).all()


def test_colours_of_vertices_and_of_faces(tmp_path):
    """One of both is shown, which is said: those that differ."""
    for reds, shown in (([0] * 4, 255), ([102, 102, 102, 103], 102)):
        vertex = square(red=("uchar", reds), green=("uchar", [0] * 4), blue=("uchar", [0] * 4))
        faces = QUAD | {hue: ("", "uchar", [part]) for hue, part in (("red", 255), ("green", 0), ("blue", 0))}
        path = ply(tmp_path / "a.ply", "binary_little_endian", vertex, faces)
        assert (facing(path)[16, 16, :3] == [shown, 0, 0]).all() and "of vertices and of faces" in notes_of(
            path
        )


def test_coordinates_without_a_picture_are_told(tmp_path):
    path = ply(tmp_path / "a.ply", "ascii", square(s=("float", [0] * 4), t=("float", [0] * 4)), QUAD)
    assert "names none" in notes_of(path)


def test_wide_integers_hold_colours_of_8_bits(tmp_path):
    hues = {hue: ("int", [part] * 4) for hue, part in (("red", 51), ("green", 102), ("blue", 153))}
    path = ply(tmp_path / "a.ply", "binary_big_endian", square(**hues), QUAD)
    assert (facing(path)[..., :3] == [51, 102, 153]).all()


def test_numbers_that_are_no_colours_are_named(tmp_path):
    vertex = square(nx=("float", [0] * 4), Quality=("float", [0, 1, 2, 3]), scalar_C2M=("float", [0] * 4))
    path = ply(tmp_path / "a.ply", "binary_little_endian", vertex, QUAD | {"label": (None, "int", [7])})
    notes = notes_of(path)
    assert "quality (vertex), scalar_c2m (vertex), label (face)" in notes and "nx" not in notes
    path.write_bytes(
        path.read_bytes().replace(b"element face", b"element material 0\nproperty int a\nelement face")
    )
    assert "material" in notes_of(path)
    assert notes_of(ply(path, "ascii", square(), QUAD)) == ""
