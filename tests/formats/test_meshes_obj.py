"""Wavefront .obj and .mtl as people's programs write them: a textured square in each of many ways."""

import numpy as np
import pytest
from PIL import Image

from formats.errors import BadMesh
from formats.meshes import _load
from tests.formats.gltf import facing, notes_of

SIDE = 8
PICTURE = np.random.default_rng(1).integers(0, 256, (SIDE, SIDE, 3), dtype=np.uint8)
SQUARE = "v -1 -1 0\nv 1 -1 0\nv 1 1 0\nv -1 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"


@pytest.fixture
def folder(tmp_path):
    """.../m for the mesh, with pictures in it and around."""
    for name in ("m/wood.png", "m/my wood.png", "m/tex/wood.png", "images/wood.png"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(PICTURE).save(tmp_path / name)
    return tmp_path / "m"


def written(
    folder, material="map_Kd wood.png", lib="mtllib a.mtl", use="usemtl wood", faces="f 1/1 2/2 3/3 4/4"
):
    (folder / "a.mtl").write_text(f"newmtl wood\n{material}\n")
    (folder / "a.obj").write_text(f"{lib}\n{SQUARE}{use}\n{faces}\n")
    return folder / "a.obj"


def shows(path, pixels=PICTURE, off=1) -> bool:
    return bool(np.abs(facing(path, SIDE)[..., :3].astype(int) - pixels).max() <= off)


NAMES = [
    "wood.png",
    "my wood.png",
    "tex\\wood.png",
    "./tex//wood.png",
    "../images/wood.png",
    "C:\\work\\model\\wood.png",
    "/home/other/wood.png",
    "\\\\server\\share\\wood.png",
    "lost/folder/wood.png",
    "Wood.PNG",
    "TEX/WOOD.png",
    '"my wood.png"',
    "-s 1.0 1.0 1.0 wood.png",
    "-s 1 1 -o 0 0 my wood.png",
    "-clamp on wood.png",
    "-bm 0.5 -mm 0 1 -imfchan l wood.png",
    "-blendu on -blendv off -texres 64 wood.png",
]


@pytest.mark.parametrize("name", NAMES)
def test_pictures_are_found(folder, name):
    assert shows(written(folder, f"map_Kd {name}"))


@pytest.mark.parametrize(
    "lib",
    [
        "mtllib ./a.mtl",
        'mtllib "a.mtl"',
        "mtllib A.MTL",
        "mtllib b.mtl a.mtl",
        "mtllib b.mtl\nmtllib a.mtl",
        "# mtllib none\nmtllib a.mtl",
    ],
)
def test_libraries_are_found(folder, lib):
    (folder / "b.mtl").write_text("newmtl stone\nKd 0.2 0.2 0.2\n")
    assert shows(written(folder, lib=lib))


def test_names_in_other_encodings(folder):
    """A library in Windows' letters names a file whose name is UTF-8, its accent put together otherwise."""
    Image.fromarray(PICTURE).save(folder / "gru\u0308n.png")
    path = written(folder)
    (folder / "a.mtl").write_bytes("newmtl wood\nmap_Kd grün.png\n".encode("cp1252"))
    assert shows(path)


@pytest.mark.parametrize("end", ["\r\n", "\r"])
def test_line_ends_marks_and_continuations(folder, end):
    path = written(folder, faces="f 1/1 2/2 \\\n 3/3 4/4 # a square")
    for file in (path, folder / "a.mtl"):
        file.write_bytes(b"\xef\xbb\xbf" + file.read_text().replace("\n", end).encode())
    assert shows(path)


def test_lost_files_are_named(folder):
    assert "lost.png" in notes_of(written(folder, "map_Kd lost.png"))
    path = written(folder, lib="mtllib lost.mtl")
    assert shows(path) and "lost.mtl" in notes_of(path) and "a.mtl is taken" in notes_of(path)
    (folder / "a.mtl").unlink()
    assert "wood" in notes_of(path) and (facing(path)[..., :3] == 255).all()


def test_one_material_needs_no_usemtl(folder):
    assert shows(written(folder, use=""))
    (folder / "b.mtl").write_text("newmtl stone\nKd 0.2 0.2 0.2\n")
    path = written(folder, use="", lib="mtllib a.mtl b.mtl")
    assert "materials that no face uses: wood, stone" in notes_of(path)


def test_tints_and_placeholders(folder):
    """A coloured Kd tints the picture; a grey one stands for none."""
    tinted = written(folder, "Kd 1 0.5 0.25\nmap_Kd wood.png")
    assert shows(tinted, PICTURE * [1, 0.5, 0.25])
    for kd in ("0.8 0.8 0.8", "0 0 0", "0.5"):
        path = written(folder, f"Kd {kd}\nmap_Kd wood.png")
        assert shows(path) and "grey Kd" in notes_of(path)
    assert (facing(written(folder, "Kd 0.2 0.4 0.6"))[..., :3] == [51, 102, 153]).all()


def test_scale_offset_and_clamp(folder):
    """Half of the picture, from a quarter on; clamped from half on."""
    assert shows(written(folder, "map_Kd -s 1 1 -o 0.5 0.25 wood.png"), np.roll(PICTURE, (2, -4), (0, 1)))
    seen = facing(written(folder, "map_Kd -clamp on -o 0.5 0 wood.png"), SIDE)[..., :3]
    assert np.abs(seen.astype(int) - PICTURE[:, np.clip(np.arange(SIDE) + 4, 0, 7)]).max() <= 1


@pytest.mark.parametrize(
    "line, alpha",
    [("d 0.5", 128), ("d -halo 0.5", 128), ("Tr 0.75", 64), ("d 1\nTr 0", 255), ("Tr 1", 255), ("", 255)],
)
def test_see_through(folder, line, alpha):
    assert np.abs(facing(written(folder, f"Kd 1 0 0\n{line}"))[..., 3].astype(int) - alpha).max() <= 1


def test_what_is_not_seen_is_named(folder):
    assert "not shown" in notes_of(written(folder, "d 0\nmap_Kd wood.png"))


def test_coverage(folder):
    """map_d covers by its alpha channel, or else by its brightness; map_Kd's alpha alone does not count."""
    grey = np.zeros((2, 2), np.uint8)
    grey[:, 0] = 255
    Image.fromarray(grey).save(folder / "cover.png")
    Image.fromarray(np.dstack([np.full((2, 2), 9, np.uint8)] * 3 + [grey])).save(folder / "both.png")
    for lines in ("map_Kd wood.png\nmap_d cover.png", "map_Kd both.png\nmap_d both.png"):
        alpha = facing(written(folder, lines), 4)[..., 3]
        assert (alpha[:, 0] == 255).all() and (alpha[:, 3] == 0).all()
    path = written(folder, "map_Kd both.png")
    assert (facing(path)[..., 3] == 255).all() and "transparency of both.png" in notes_of(path)


def test_unused_maps_are_named(folder):
    notes = notes_of(written(folder, "map_Kd wood.png\nmap_Bump bumps.png\nmap_Ks shine.png"))
    assert "bumps.png" in notes and "shine.png" in notes
    path = written(folder, "Kd 0 0 0\nKe 1 1 1\nmap_Ke wood.png")
    assert shows(path) and "glows" in notes_of(path)


# --- geometry -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "faces",
    [
        "f 1 2 3 4",
        "f 1// 2// 3// 4//",
        "f 1//1 2//1 3//1 4//1",
        "f 1/1/1 2/2/1 3/3/1 4/4/1",
        "f 1 2 3\nf 1/1 3/3 4/4",
        "f -4 -3 -2 -1",
        "f -4/-4 -3/-3 -2/-2 -1/-1",
    ],
)
def test_ways_to_write_faces(folder, faces):
    (folder / "a.obj").write_text(SQUARE + "vn 0 0 1\n" + faces + "\n")
    assert len(_load(folder / "a.obj").triangles[1]) == 2 and (facing(folder / "a.obj") == 255).all()


def test_negative_indices_count_from_where_they_stand(folder):
    lines = ["v 9 9 0", *SQUARE.splitlines()[:4], "f -4 -3 -2 -1", "v 7 7 0"]
    (folder / "a.obj").write_text("\n".join(lines))
    assert (facing(folder / "a.obj") == 255).all()


@pytest.mark.parametrize(
    "colours, expected",
    [("0.2 0.4 0.6", [51, 102, 153]), ("51 102 153", [51, 102, 153]), ("0.2 0.4 0.6 1", [51, 102, 153])],
)
def test_vertex_colours(folder, colours, expected):
    lines = [f"{line} {colours}" if line.startswith("v ") else line for line in SQUARE.splitlines()]
    (folder / "a.obj").write_text("\n".join([*lines, "f 1 2 3 4"]))
    assert (facing(folder / "a.obj")[..., :3] == expected).all()


def test_concave_polygons_keep_their_shape(folder):
    """An L of one polygon, whichever corner it begins at: three quarters of the square."""
    corners = [(-1, -1), (1, -1), (1, 0), (0, 0), (0, 1), (-1, 1)]
    lines = [f"v {x} {y} 0" for x, y in corners]
    for turn in range(6):
        order = [(turn + i) % 6 + 1 for i in range(6)]
        (folder / "a.obj").write_text("\n".join([*lines, "f " + " ".join(map(str, order))]))
        alpha = facing(folder / "a.obj", 16)[..., 3]
        assert (alpha[:8, 8:] == 0).all() and (alpha > 0).sum() == 192


def test_far_from_the_origin(folder):
    """Map coordinates in metres: the same pictures."""
    (folder / "a.obj").write_text(SQUARE + "f 1 2 3 4\n")
    moved = [f"v {432100 + x} {5411200 + y} 310" for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    (folder / "b.obj").write_text("\n".join([*moved, "f 1 2 3 4"]))
    near, far = _load(folder / "a.obj"), _load(folder / "b.obj")
    assert np.array_equal(near.triangles[0], far.triangles[0])
    assert far.vertices - near.vertices == pytest.approx(np.tile([432100, 5411200, 310], (4, 1)))


@pytest.mark.parametrize(
    "text",
    [
        "v 0 0\nf 1 1 1",
        "v 0 0 x\nf 1 1 1",
        SQUARE + "f 1 2 9",
        SQUARE + "f 1 2 0",
        SQUARE + "f 1 2 -9",
        SQUARE + "f a b c",
        "\ufeff".encode("utf-16").decode("latin-1"),
    ],
)
def test_broken(folder, text):
    (folder / "a.obj").write_bytes(text.encode("latin-1", "replace"))
    with pytest.raises(BadMesh, match=r"a\.obj"):
        _load(folder / "a.obj")


def test_lines_and_curves_are_told(folder):
    path = written(folder, faces="f 1/1 2/2 3/3 4/4\nl 1 2\np 3\ncurv 0 1 1 2")
    assert "points and lines are left out" in notes_of(path) and "free-form" in notes_of(path)


def test_a_large_picture_is_made_smaller(folder, monkeypatch):
    monkeypatch.setattr("formats.surfaces.pictures.MAX_TEXELS", 16)
    monkeypatch.setattr("formats.surfaces.pictures.LEAST_SHARE", 16)
    path = written(folder)
    means = PICTURE.reshape(4, 2, 4, 2, 3).mean((1, 3))
    assert np.abs(facing(path, 4)[..., :3] - means).max() <= 1 and "2 times smaller" in notes_of(path)


def test_a_picture_beyond_memory_is_told(folder, monkeypatch):
    monkeypatch.setattr("formats.surfaces.pictures.FREE_BYTES", 100)
    monkeypatch.setattr("formats.surfaces.pictures.BYTES_PER_BYTE", 0)
    assert "too large" in notes_of(written(folder))


@pytest.mark.parametrize(
    "lib, use, material",
    [
        ("# from C:\\work\\\nmtllib a.mtl", "usemtl wood", "map_Kd wood.png"),
        ("mtllib a.mtl # materials", "usemtl wood # oak", "map_Kd wood.png # oak"),
        ("mtllib a.mtl", 'usemtl "Wood"', "map_Kd file:///home/me/wood.png"),
        ("mtllib a.mtl", "usemtl wood", "map_Kd -colorspace sRGB wood.png"),
        ("", "usemtl wood", "map_Kd wood.png"),
    ],
)
def test_comments_quotes_addresses_and_unknown_options(folder, lib, use, material):
    path = written(folder, material, lib, use)
    assert shows(path) and bool(notes_of(path)) == (lib == "")


def test_comments_that_end_in_a_backslash_take_no_vertex(folder):
    path = written(folder)
    path.write_text(path.read_text().replace("v 1 1 0", "# C:\\tmp\\\nv 1 1 0"))
    assert shows(path)


def test_materials_in_other_encodings(folder):
    path = written(folder)
    path.write_text(f"mtllib a.mtl\n{SQUARE}usemtl Wände\nf 1/1 2/2 3/3 4/4\n")
    (folder / "a.mtl").write_bytes("newmtl Wände\nmap_Kd wood.png\n".encode("cp1252"))
    assert shows(path) and notes_of(path) == ""


def test_glow_of_black_is_named(folder):
    assert "map_ke wood.png" in notes_of(written(folder, "Ke 0 0 0\nmap_Ke wood.png"))


def test_other_files_that_are_called_are_named(folder):
    assert "other files" in notes_of(written(folder, faces="f 1/1 2/2 3/3 4/4\ncall b.obj"))


def test_polypaint(folder):
    """ZBrush's comments: mask, red, green and blue of each vertex."""
    path = folder / "a.obj"
    path.write_text(f"{SQUARE}#MRGB ff336699ff336699\n#MRGB ff336699ff336699\nf 1 2 3 4\n")
    assert (facing(path)[..., :3] == [51, 102, 153]).all()
    path.write_text(f"{SQUARE}#MRGB ff336699\nf 1 2 3 4\n")
    assert (facing(path)[..., :3] == 255).all() and "ZBrush" in notes_of(path)


def test_pictures_of_unknown_words_and_small_faces_are_named(folder):
    path = written(folder, "map_Kd wood.png\nalbedo oak.png", faces="f 1/1 2/2 3/3 4/4\nf 1,2,3")
    notes = notes_of(path)
    assert shows(path) and "albedo oak.png" in notes and "fewer than three" in notes


def test_capitals(folder):
    path = written(folder, "MAP_KD WOOD.PNG", "MTLLIB a.mtl", "USEMTL wood", "F 1/1 2/2 3/3 4/4")
    assert shows(path)


@pytest.mark.parametrize(
    "text", ["wood.png -s 1 1 1", '"wood.png" -o 0 0', "wood.png -clamp off", "my wood.png -bm 1"]
)
def test_options_behind_a_picture(folder, text):
    assert shows(written(folder, f"map_Kd {text}"))


@pytest.mark.parametrize("text", ["-o 1.2.3 wood.png", "-s . wood.png", "wood.png -o x"])
def test_options_that_are_no_numbers_are_named(folder, text):
    assert "not understood" in notes_of(written(folder, f"map_Kd {text}"))


def test_a_picture_whose_name_looks_like_options(folder):
    Image.fromarray(PICTURE).save(folder / "a.png -s b.png")
    assert shows(written(folder, "map_Kd a.png -s b.png"))


def test_tiles(folder):
    """Two squares beside each other and one above: 1001, 1002 and 1011; a lost tile is named."""
    colours = {1001: (200, 0, 0), 1002: (0, 200, 0), 1011: (0, 0, 200)}
    for tile, colour in colours.items():
        Image.new("RGB", (2, 2), colour).save(folder / f"skin.{tile}.png")
    path = written(folder, "Kd 1 1 1\nmap_Kd skin.<UDIM>.png")
    corners = [(x, y) for y in (0, 1, 2) for x in (0, 1, 2)]
    text = "".join(f"v {x - 1} {y - 1} 0\nvt {x} {y}\n" for x, y in corners)
    faces = "".join(
        "f " + " ".join(f"{i}/{i}" for i in (a, a + 1, a + 4, a + 3)) + "\n" for a in (1, 2, 4, 5)
    )
    path.write_text(f"mtllib a.mtl\n{text}usemtl wood\n{faces}")
    seen = facing(path, 4)[..., :3]
    assert (seen[3, 0] == colours[1001]).all() and (seen[3, 3] == colours[1002]).all()
    assert (seen[0, 0] == colours[1011]).all() and (seen[0, 3] == 255).all()
    assert "skin.1012.png" in notes_of(path) and "no face uses" not in notes_of(path)


def test_materials_of_one_name(folder):
    """The first is shown; others are named where they differ."""
    twice = written(folder, "map_Kd wood.png\nnewmtl wood\nKd 1 0 0")
    assert shows(twice) and "more than once" in notes_of(twice)
    (folder / "b.mtl").write_text("newmtl wood\nKd 1 0 0\n")
    path = written(folder, lib="mtllib a.mtl b.mtl")
    assert shows(path) and "more than once" in notes_of(path)
    same = written(folder, "map_Kd wood.png\nnewmtl wood\nmap_Kd wood.png")
    assert shows(same) and notes_of(same) == ""


def test_lines_of_no_material_are_named(folder):
    path = written(folder)
    (folder / "a.mtl").write_text("Kd 1 0 0\nnewmtl wood\nmap_Kd wood.png\n")
    assert shows(path) and "kd before its first newmtl belongs to no material" in notes_of(path)


@pytest.mark.parametrize("line, said", [("Tf 0.2 0.5 1", True), ("Tf 1 1 1", False), ("Tf 0 0 0", False)])
def test_light_filters_are_named(folder, line, said):
    assert ("Tf" in notes_of(written(folder, f"Kd 1 1 1\n{line}"))) == said
