"""Photos are matched to poses by name: at their own camera, or left out with a sentence."""

import json
import os
import shutil
import unicodedata
from pathlib import Path

import numpy as np
import pytest
from PIL import Image as Pillow

from formats.captures import read_capture
from formats.errors import BadSchema, NoViews
from formats.matching import match_photos
from formats.photos import load_photos
from formats.posing import photos_to_pose
from tests.formats.test_readers import BIG, binary_model, llff_rows, ring

POSES = ring(6, 4, np.zeros(3))
LEVELS = [40 * i + 20 for i in range(6)]
"""Photo i is of the grey LEVELS[i], so that it tells which it is."""


def grey(path: Path, i: int, size=(100, 80), kind: str | None = None) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Pillow.new("RGB", size, (LEVELS[i],) * 3).save(path, kind)


def capture(folder: Path, photos: dict[int, str], files: list[str], **keys) -> Path:
    """Photos by the number of their pose, and a transforms.json that names `files` in the order of POSES."""
    for i, name in photos.items():
        grey(folder / name, i)
    folder.mkdir(exist_ok=True)
    frames = [{"file_path": f, "transform_matrix": POSES[i]} for i, f in enumerate(files)]
    (folder / "transforms.json").write_text(json.dumps({"fl_x": 80, **keys, "frames": frames}))
    return folder


def numbers(read) -> list[int]:
    """The numbers of a capture's photos; each is checked to be at its own camera."""
    views, found = read.train + read.test, []
    loaded = load_photos(views)
    for i, view in enumerate(views):
        level = int(loaded.photo(i, view)[0, 0, 0])
        number = int(np.abs(np.array(LEVELS) - level).argmin())
        assert np.allclose(view.camera_to_world, POSES[number]), f"photo {number} is at another camera"
        found.append(number)
    return sorted(found)


def all_of(pattern: str) -> list[str]:
    return [pattern.format(i) for i in range(6)]


NFC, NFD = unicodedata.normalize("NFC", "gr\u00fcn"), unicodedata.normalize("NFD", "gr\u00fcn")
PATHS = {
    "as it is": ("images/p{}.png", "images/p{}.png", None),
    "without an ending": ("images/p{}.png", "./images/p{}", None),
    "backslashes": ("images/p{}.png", ".\\images\\p{}.png", None),
    "Windows": ("images/p{}.png", "C:\\Users\\me\\scene\\images\\p{}.png", "elsewhere"),
    "Unix": ("images/p{}.png", "/home/me/scene/images/p{}.png", "elsewhere"),
    "a URI": ("images/p{}.png", "file:///home/me/a%20scene/images/p{}.png", "elsewhere"),
    "a folder above": ("images/p{}.png", "../scene/images/p{}.png", "elsewhere"),
    "the name alone": ("images/p{}.png", "p{}.png", "elsewhere"),
    "another folder": ("images/p{}.png", "rgb/p{}.png", "elsewhere"),
    "an odd folder": ("shoot 7/p{}.png", "p{}.png", "elsewhere"),
    "photos beside the file": ("p{}.png", "D:/scan/images/p{}.png", "elsewhere"),
    "capitals": ("images/p{}.png", "Images/P{}.PNG", "elsewhere"),
    "another ending": ("images/p{}.png", "images/p{}.jpg", "another ending"),
    "an ending that is not read": ("images/p{}.png", "images/p{}.CR2", "another ending"),
    "an ending more": ("images/p{}.jpg.png", "images/p{}.jpg", "another ending"),
    "two dots": ("images/cam.v1.{}.png", "images/cam.v1.{}", None),
    "percent": ("images/my photo {}.png", "images/my%20photo%20{}.png", "other letters"),
    "percent on the disk": ("images/my%20photo%20{}.png", "images/my photo {}.png", "other letters"),
    "composed": (f"images/{NFD}{{}}.png", f"images/{NFC}{{}}.png", "other letters"),
    "decomposed": (f"images/{NFC}{{}}.png", f"images/{NFD}{{}}.png", "other letters"),
    "a copy alone": ("images_4/p{}.png", "/scan/images/p{}.png", "images_4"),
}


@pytest.mark.parametrize("held, said, note", PATHS.values(), ids=PATHS)
def test_paths_of_another_computer(tmp_path, held, said, note):
    folder = capture(tmp_path / "s", dict(enumerate(all_of(held))), all_of(said))
    read = read_capture(folder)
    assert numbers(read) == [0, 1, 2, 3, 4, 5] and read.missing == ()
    assert note in " ".join(read.notes) if note else read.notes == ()


def test_masks_and_other_captures_are_no_photos(tmp_path):
    """Pictures of the same names lie in masks/ and, of a photo that is gone, in another folder."""
    folder = capture(tmp_path / "s", dict(enumerate(all_of("images/p{}.png"))), all_of("p{}.png"))
    for i in range(6):
        grey(folder / f"masks/p{i}.png", 5 - i)
    assert numbers(read_capture(folder)) == [0, 1, 2, 3, 4, 5]
    (folder / "images/p3.png").unlink()
    grey(folder / "renders/p3.png", 0)
    for files in (all_of("p{}.png"), all_of("images/p{}.png")):
        read = read_capture(capture(folder, {}, files))
        assert numbers(read) == [0, 1, 2, 4, 5] and read.missing == (files[3],)
        assert files[3] in " ".join(read.notes)


RIG = [f"{side}/{i}.png" for i in range(3) for side in ("left", "right")]


def test_photos_of_a_rig(tmp_path):
    """Names that differ by their folder alone: what is there is found, what is not is no other's."""
    held = {i: f"images/{name}" for i, name in enumerate(RIG)}
    said = [f"C:\\scan\\images\\{name}" for name in RIG]
    assert numbers(read_capture(capture(tmp_path / "a", held, said))) == [0, 1, 2, 3, 4, 5]
    for where in ("images/", ""):
        left = {i: f"{where}{name}" for i, name in enumerate(RIG) if "left" in name}
        read = read_capture(capture(tmp_path / f"b{where}", left, said))
        assert numbers(read) == [0, 2, 4] and len(read.missing) == 3
    flat = {2 * i: f"images/{i}.png" for i in range(3)}
    with pytest.raises(NoViews, match=r"left/0\.png: its photo suits other paths too \(images/0\.png\)"):
        read_capture(capture(tmp_path / "c", flat, RIG))


def test_two_photos_that_suit_one_path(tmp_path):
    held = dict(enumerate(all_of("images/p{}.png")))
    folder = capture(tmp_path / "s", held, all_of("images/p{}.jpg"))
    grey(folder / "images/p2.tif", 3)
    read = read_capture(folder)
    assert numbers(read) == [0, 1, 3, 4, 5] and read.missing == ("images/p2.jpg",)
    assert "images/p2.png and images/p2.tif" in " ".join(read.notes)
    grey(folder / "images/p2.jpg", 2, kind="JPEG")  # the one itself
    assert numbers(read_capture(folder)) == [0, 1, 2, 3, 4, 5]
    two = capture(tmp_path / "t", {i: f"a/p{i}.png" for i in range(6)}, all_of("p{}.png"))
    shutil.copytree(two / "a", two / "b")
    with pytest.raises(NoViews, match=r"6 paths.*a/p0\.png and b/p0\.png"):
        read_capture(two)


def test_one_photo_serves_one_path(tmp_path):
    """The path that is its own; the other's photo is gone."""
    files = ["images/p0.png", "images/p0.jpg", *all_of("images/p{}.png")[2:]]
    read = read_capture(capture(tmp_path / "s", dict(enumerate(all_of("images/p{}.png"))), files))
    assert numbers(read) == [0, 2, 3, 4, 5] and read.missing == ("images/p0.jpg",)


def test_numbers_of_other_lengths_are_other_names(tmp_path):
    """Frames that were cut out of a film anew may be counted from another one."""
    folder = capture(tmp_path / "s", {i: f"images/f{i:04d}.png" for i in range(6)}, all_of("images/f{}.png"))
    with pytest.raises(
        NoViews, match=r"images/f0\.png.*6 others, such as images/f0000\.png.*under the names"
    ):
        read_capture(folder)


def test_nothing_outside_is_looked_for(tmp_path):
    """A path that leads out is followed as it is written, and only so."""
    for i in range(6):
        grey(tmp_path / f"photos/p{i}.png", i)
    assert numbers(read_capture(capture(tmp_path / "s", {}, all_of("../photos/p{}.png")))) == list(range(6))
    with pytest.raises(NoViews, match="holds no photos"):
        read_capture(capture(tmp_path / "s", {}, all_of("../images/photos/p{}.png")))


def test_links(tmp_path):
    """A linked folder is a folder; links in circles end."""
    folder = capture(tmp_path / "s", {i: f"store/p{i}.png" for i in range(6)}, all_of("D:/x/images/p{}.png"))
    os.symlink("store", folder / "images")
    os.symlink("..", folder / "store/up")
    os.symlink("self", folder / "self")
    assert numbers(read_capture(folder)) == list(range(6))
    outside = capture(tmp_path / "t", {}, all_of("D:/x/p{}.png"))
    os.symlink(folder / "store", outside / "other")
    with pytest.raises(NoViews, match="holds no photos"):
        read_capture(outside)
    os.symlink(folder / "store", outside / "images")
    assert numbers(read_capture(outside)) == list(range(6))


def test_poses_in_a_folder_of_their_own(tmp_path):
    folder = capture(tmp_path / "s", dict(enumerate(all_of("images/p{}.png"))), all_of("images/p{}.png"))
    (folder / "colmap").mkdir()
    shutil.move(folder / "transforms.json", folder / "colmap")
    assert numbers(read_capture(folder)) == list(range(6))


def test_hidden_and_empty_files_are_no_photos(tmp_path):
    files = [*all_of("images/p{}.png")[:5], "images/._p0.png"]
    folder = capture(tmp_path / "s", dict(enumerate(all_of("images/p{}.png"))), files)
    (folder / "images/._p0.png").write_bytes(b"\0\5\26\7" * 9)
    (folder / "images/p3.png").write_bytes(b"")
    read = read_capture(folder)
    assert numbers(read) == [0, 1, 2, 4] and read.missing == ("images/._p0.png", "images/p3.png")
    assert "2 photos are not there or empty and left out" in " ".join(read.notes)


KINDS = {
    "JPG": "JPEG",
    "Jpg": "JPEG",
    "jfif": "JPEG",
    "TIF": "TIFF",
    "WEBP": "WEBP",
    "Bmp": "BMP",
    "Tga": "TGA",
}


@pytest.mark.parametrize("ending", KINDS)
def test_endings(tmp_path, ending):
    """Of any case: of LLFF, of photos to pose, and where the JSON has small letters."""
    for i in range(6):
        grey(tmp_path / f"images/p{i}.{ending}", i, kind=KINDS[ending])
        (tmp_path / f"images/._p{i}.{ending}").write_bytes(b"\0\5\26\7")
        (tmp_path / f"images/p{i}.HEIC").write_bytes(b"of a phone, beside its JPEG")
    assert len(photos_to_pose(tmp_path)) == 6
    np.save(tmp_path / "poses_bounds.npy", llff_rows(6, (100, 80), 80.0))
    read = read_capture(tmp_path / "poses_bounds.npy")
    assert [view.image_path.name for view in read.train] == [f"p{i}.{ending}" for i in range(6)]
    assert numbers(read_capture(capture(tmp_path, {}, all_of(f"images/p{{}}.{ending.lower()}")))) == list(
        range(6)
    )


# --- smaller copies -----------------------------------------------------------------------------------------


def test_copies_that_are_not_whole_are_not_used(tmp_path):
    for i in range(6):
        grey(tmp_path / f"images/p{i}.png", i, (1200, 960))
        if i < 4:
            grey(tmp_path / f"images_2/p{i}.png", i, (600, 480))
    (tmp_path / "images_2/p4.png").write_bytes(b"")  # where the program that made them was ended
    read = read_capture(capture(tmp_path, {}, all_of("images/p{}.png"), **BIG))
    assert numbers(read) == list(range(6)) and {view.width for view in read.train} == {600}
    assert {view.image_path.parent.name for view in read.train} == {"images"}
    assert "images_2 has 4 of 6 photos and is not used" in " ".join(read.notes)
    grey(tmp_path / "images_2/p4.png", 4, (600, 480))
    grey(tmp_path / "images_2/p5.JPG", 5, (600, 480))
    assert {view.image_path.parent.name for view in read_capture(tmp_path).train} == {"images_2"}
    (tmp_path / "images/p5.png").unlink()
    assert numbers(read_capture(tmp_path)) == list(range(6))


# --- COLMAP -------------------------------------------------------------------------------------------------

NAMES = {
    "a folder that is not there": lambda name: f"rgb/{name}",
    "Windows": lambda name: f"C:\\scan\\{name}",
    "Unix": lambda name: f"/data/scan/{name}",
    "capitals": str.upper,
    "no ending": lambda name: name[:-4],
    "backslashes": lambda name: f".\\{name}",
}


@pytest.mark.parametrize("place", ["images", "input", "shoot", "."])
@pytest.mark.parametrize("change", NAMES.values(), ids=NAMES)
def test_names_of_a_model(tmp_path, change, place):
    names = [f"p{i}.png" for i in range(6)]
    binary_model(tmp_path / "sparse/0", [change(name) for name in names])
    for i, name in enumerate(names):
        grey(tmp_path / place / name, i)
    if place == "shoot" and {"rgb", "scan"} & set(change("").replace("\\", "/").split("/")):
        with pytest.raises(NoViews, match="shoot/p0.png"):  # two folders that contradict each other
            read_capture(tmp_path)
        return
    read = read_capture(tmp_path)
    levels = [load_photos([view]).pixels[0, 0] for view in read.train]
    assert levels == LEVELS and [view.name.lower() for view in read.train] == [f"p{i}" for i in range(6)]


def test_photos_under_other_names_are_not_matched_by_order(tmp_path):
    binary_model(tmp_path / "sparse/0", RIG)
    for i, name in enumerate(RIG):
        side, number = name.split("/")
        grey(tmp_path / f"images/{number[:-4]}_{side}.png", i)
    with pytest.raises(NoViews, match=r"6 photos such as left/0\.png.*6 others, such as images/0_left\.png"):
        read_capture(tmp_path)


# --- lists of names -----------------------------------------------------------------------------------------


def test_lists_of_file_names(tmp_path):
    files = all_of("images/p{}.png")
    photos = dict(enumerate(files))
    lists = {
        "train_filenames": [f"./{files[0]}", files[1], "gone.png"],
        "val_filenames": [files[1], files[2]],
    }
    read = read_capture(capture(tmp_path, photos, files, **lists, test_filenames=[]))
    assert ([view.name for view in read.train], [view.name for view in read.test]) == (
        ["p0", "p1"],
        ["p1", "p2"],
    )
    said = " ".join(read.notes)
    for part in ("3 frames are in no list", "1 photo is both learnt from and held out", "gone.png"):
        assert part in said
    with pytest.raises(BadSchema, match="have no frame's, but other/p0"):
        read_capture(capture(tmp_path, {}, files, train_filenames=["other/p0.png"]))


# --- many ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("prefix", ["", "C:/scan/"])
def test_folders_are_listed_once(tmp_path, monkeypatch, prefix):
    """However many photos there are, and where each has a folder of its own that is called alike."""
    for i in range(300):
        (tmp_path / f"f{i}").mkdir()
        (tmp_path / f"f{i}/p.png").write_bytes(b"x")
    listed, scandir = [], os.scandir

    def counted(path):
        listed.append(path)
        return scandir(path)

    monkeypatch.setattr(os, "scandir", counted)
    found = match_photos("it", tmp_path, [f"{prefix}f{i}/p.png" for i in range(300)], None)
    assert all(photo == tmp_path / file[len(prefix) :] for file, (photo, _) in found.photos.items())
    assert len(found.photos) == 300 and len(listed) < 4 * 302
