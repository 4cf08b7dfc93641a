"""What is no capture: files and folders of other kinds, told by their first bytes and their endings."""

import re
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

from formats.errors import FormatError, MissingExtra, NotACapture
from formats.inputs import open_input
from formats.surfaces.unreadable import unreadable_mesh

HEAD = 4096
"""Bytes of a file that are looked at."""
MAX_FILES = 2000
"""At most so many entries of a folder, and of the folders in it, are looked at."""
HEIF = 'install the extra that reads it: pip install "fusedrf[heif]", or convert it to JPEG'


class Foreign(NamedTuple):
    """A kind of file that is no capture."""

    what: str
    """With its article."""
    cure: str
    """What to do, as an order."""
    extra: bool = False
    """Whether an extra that is not installed reads it."""


KINDS = {
    "film": (
        "a film",
        "take pictures from it, as by `ffmpeg -i FILM -vf fps=2 photos/%04d.jpg`, and give their folder",
    ),
    "archive": ("an archive", "unpack it and give the folder"),
    "record3d": (
        "a Record3D export",
        "convert it with nerfstudio's `ns-process-data record3d`, and give the folder",
    ),
    "heif": ("a HEIC photo", "give the folder of the photos"),
    "photo": ("a single photo", "give the folder of the photos"),
    "exr": ("an OpenEXR picture", "save it as PNG of 8 or 16 bits in sRGB"),
    "hdr": ("a Radiance HDR picture", "save it as PNG of 8 or 16 bits in sRGB"),
    "raw": ("a camera's raw photo", "develop it to JPEG or PNG"),
    "drawing": ("a drawing or document (PSD, PDF, EPS, SVG)", "save its picture as PNG"),
    "splats": ("a scene of Gaussian splats", "give the photos that it was made from"),
    "cloud": ("a cloud of points without faces", "give the photos that it was made from, or a mesh"),
    "mesh": ("a mesh", "give that file itself"),
    "model": ("a 3D model in a format that is not read", "export it as .glb"),
    "usd": ("a USD scene", "export it as .glb"),
    "metashape": (
        "Metashape's XML of cameras",
        "export COLMAP or convert it with nerfstudio's `ns-process-data metashape`, and give the folder",
    ),
    "realitycapture": (
        "RealityCapture's CSV of cameras",
        "export COLMAP or convert it with nerfstudio's `ns-process-data realitycapture`, and give the folder",
    ),
    "cameras": ("another program's list of cameras", "export a COLMAP model, and give its folder"),
    "colmap": ("one file of a COLMAP model or its database", "give the folder above sparse/ and images/"),
    "bundle": (
        "a bundle, a field that was learnt already",
        "see it with `fusedrf render`, or list it with `fusedrf info`",
    ),
    "checkpoint": ("another program's checkpoint or arrays", "give the photos that it was learnt from"),
    "text": ("a text", "give a capture's folder, its transforms.json, or a mesh"),
    "other": ("a file of an unknown kind", "give a capture's folder, its transforms.json, or a mesh"),
    "empty": ("an empty file", "copy or export it again"),
}
"""What each kind is, and what to do with it."""
MAGICS = (
    (rb"PK\x03\x04.{26}scene\.json", "bundle"),
    (rb"v/1\x01", "exr"),
    (rb"#\?(RADIANCE|RGBE)", "hdr"),
    (rb"8BPS|%PDF|%!PS|\xc5\xd0\xd3\xc6|(<\?xml[^>]*>\s*)?(<!--.*?-->\s*)?<svg", "drawing"),
    (rb"....ftypcrx |FUJIFILMCCD-RAW|II\x2a\0.{4}CR\x02", "raw"),
    (rb"....ftyp(hei[cxms]|hev[cmx]|mif1|msf1)", "heif"),
    (rb"....ftypavi[fs]", "photo"),
    (rb"....(ftyp|moov|mdat|wide)|RIFF....AVI |\x1aE\xdf\xa3|GIF8|FLV\x01|\0\0\x01[\xb3\xba]", "film"),
    (rb"\x89PNG|\xff\xd8\xff|RIFF....WEBP|BM.{4}\0\0\0\0|(II\x2a\0|MM\0\x2a)", "photo"),
    (rb"ply\r?\n(?s:.*)property \S+ (f_dc_0|scale_0|packed_position)\b", "splats"),
    (rb"ply\r?\n(?s:.*)element face|glTF", "mesh"),
    (rb"ply\r?\n|LASF|ASTM-E57|# \.PCD|VERSION \.?7", "cloud"),
    (rb"Kaydara FBX|BLENDER|(?s:.{0,200})<COLLADA", "model"),
    (rb"#usda|PXR-USDC", "usd"),
    (rb"(?s:.{0,400})<document(?s:.{0,800})<chunk", "metashape"),
    (rb"#name,\s*x,\s*y,\s*(alt|z)", "realitycapture"),
    (rb"NVM_V3|# Bundle file|(?s:.{0,400})<BlocksExchange", "cameras"),
    (rb"# (Camera|Image|3D point) list|SQLite format 3", "colmap"),
    (rb"\x93NUMPY|\x89HDF|\x80[\x02-\x05]", "checkpoint"),
)
"""The beginning of a file, and its kind."""
ENDINGS = {
    "film": "mp4 mov avi mkv webm m4v mpg mpeg mts m2ts ts 3gp wmv insv 360 lrv",
    "archive": "zip tar gz tgz bz2 xz 7z rar zst",
    "record3d": "r3d",
    "heif": "heic heif hif",
    "photo": "png jpg jpeg jfif webp bmp tga tif tiff avif ppm pgm pnm",
    "exr": "exr",
    "hdr": "hdr",
    "raw": "dng cr2 cr3 nef nrw arw raf orf rw2 pef srw",
    "drawing": "psd pdf eps svg ai",
    "splats": "splat ksplat spz sog sogs",
    "cloud": "las laz e57 pcd xyz pts ptx",
    "mesh": "obj gltf glb stl",
    "model": "fbx blend dae 3ds max ma mb c4d 3dm off x3d wrl skp step stp iges igs vrm",
    "usd": "usd usda usdc usdz",
    "metashape": "psx psz",
    "cameras": "nvm out lst rcproj xmp csv xml",
    "bundle": "rfpack",
    "checkpoint": "pth pt ckpt msgpack ingp npz npy pkl pickle h5 hdf5 safetensors onnx bin tensorf",
    "text": "txt md rtf doc docx html htm yaml yml log ini toml json",
}
BY_ENDING = {f".{ending}": kind for kind, endings in ENDINGS.items() for ending in endings.split()}
MODEL_FILES = [f"{name}.bin" for name in ("cameras", "images", "points3D", "frames", "rigs")]
"""Files of a COLMAP model, which do not begin in any way."""
CONTAINERS = (b"PK\x03\x04", b"\x1f\x8b", b"7z\xbc\xaf", b"Rar!", b"BZh", b"\xfd7zXZ", b"\x28\xb5\x2f\xfd")
"""Beginnings of archives, which many kinds of files are inside: those are told by their endings."""


def identify(head: bytes, ending: str) -> Foreign | None:
    """What a file is by its first HEAD bytes, and by the ending of its name, such as ".mp4", where those do
    not say; None where neither does."""
    kind = _kind(head, ending.lower())
    if kind is None:
        return None
    what, cure = KINDS[kind]
    missing = kind == "heif" and not find_spec("pillow_heif")
    return Foreign(what, HEIF if missing else cure, missing)


def _kind(head: bytes, ending: str) -> str | None:
    if not head:
        return "empty"
    for start, kind in MAGICS:
        if re.match(start, head, re.DOTALL):
            return "raw" if kind == "photo" and BY_ENDING.get(ending) == "raw" else kind
    named = BY_ENDING.get(ending)
    if head.startswith(CONTAINERS) or head[257:262] == b"ustar":
        return named or "archive"
    return named


def not_a_capture(path: Path) -> FormatError:
    """The error for a file or folder that is no capture, and in which nothing is that can be posed."""
    return _of_folder(path) if path.is_dir() else _of_file(path)


def _of_file(path: Path) -> FormatError:
    if sentence := unreadable_mesh(path):
        return NotACapture(sentence)
    found = _identified(path)
    if found is None:
        text = b"\0" not in _head(path)
        found = Foreign(*KINDS["text" if text else "other"])
    kind = MissingExtra if found.extra else NotACapture
    return kind(f"{path}: is {found.what}, no capture; {found.cure}")


def other_cameras(path: Path) -> Foreign | None:
    """What a file of cameras is that is not read, by its first bytes; None for others."""
    found = identify(_head(path), "")
    kinds = ("metashape", "realitycapture", "cameras")
    return found if found is not None and found[:2] in [KINDS[kind] for kind in kinds] else None


def _identified(path: Path) -> Foreign | None:
    if path.name in MODEL_FILES:
        return Foreign(*KINDS["colmap"])
    return identify(_head(path), path.suffix)


def _head(path: Path) -> bytes:
    with open_input(path) as file:
        return file.read(HEAD)


# --- JSON ---------------------------------------------------------------------------------------------------


def is_json(path: Path) -> bool:
    """Whether a file begins as a JSON object, a list or a comment does."""
    return _head(path).removeprefix(b"\xef\xbb\xbf").lstrip()[:1] in (b"{", b"[", b"/")


def foreign_json(path: Path) -> FormatError | None:
    """The error for a JSON file that is of another kind than a transforms.json; None where it is one, or of
    no known kind."""
    head = _head(path).removeprefix(b"\xef\xbb\xbf").lstrip()
    if re.match(rb'\{\s*"format"\s*:\s*"rfpack"', head):
        what, cure = "a scene of fields", "see it with `fusedrf render`, or fuse it with `fusedrf fuse`"
    elif head.startswith(b"[") and b'"rotation"' in head and b'"position"' in head:
        what, cure = "the list of cameras of a splat scene", "give its photos with their COLMAP model"
    elif re.search(rb'"(sfm_data_version|shots)"|"version"\s*:\s*\[', head):
        what, cure = KINDS["cameras"]
    elif head.startswith(b"["):
        what = "a JSON list of frames, as Luma and `ns-export cameras` write it"
        cure = 'give the transforms.json of the photos, an object with "frames" and the lens of the cameras'
    elif b'"camera_path"' in head or b'"keyframes"' in head:
        what, cure = "a path of cameras without photos", "give it to `fusedrf render --path`"
    elif re.match(rb'\{\s*"(transform|scale)"\s*:', head):
        what = "what nerfstudio did to the poses of a capture"
        cure = "give the folder of that capture, with its photos and transforms.json"
    elif b'"asset"' in head and b'"version"' in head:
        what, cure = "a glTF file", "name it .gltf"
    else:
        return None
    return NotACapture(f"{path}: is {what}, no capture; {cure}")


# --- folders ------------------------------------------------------------------------------------------------


def _of_folder(path: Path) -> FormatError:
    """The error for a folder without photos and without poses."""
    files = list(_entries(path))
    if not files:
        return NotACapture(f"{path}: the folder is empty; give the folder that the photos lie in")
    photos = [file for file in files if BY_ENDING.get(file.suffix.lower()) in ("photo", "heif")]
    if any((path / name).is_file() for name in ("metadata", "metadata.json")) and (path / "rgbd").is_dir():
        what, cure = KINDS["record3d"]
        return NotACapture(f"{path}: is {what}, no capture; {cure}")
    if nested := sorted({file.parent for file in photos} - {path}):
        counts = [sum(file.parent == folder for file in photos) for folder in nested]
        most = nested[counts.index(max(counts))]
        cure = "give that folder" if len(nested) == 1 else "give that folder, or put all photos into one"
        return NotACapture(
            f"{path}: its photos lie in {_counted(len(nested), 'folder')} below it, {max(counts)} of them in "
            f"{most.relative_to(path)}; {cure}"
        )
    if (beside := beside_photos(path)) is None:
        return NotACapture(
            f"{path}: holds {_counted(len(files), 'file')} such as {files[0].name}, but no photos and no "
            "poses; give the folder that the photos lie in"
        )
    name, found = beside
    kind = MissingExtra if found.extra else NotACapture
    return kind(
        f"{path}: holds no photos that can be read and no poses, but {name}, {found.what}; {found.cure}"
    )


def beside_photos(folder: Path) -> tuple[str, Foreign] | None:
    """The name of a file in a folder that is neither a photo nor a text, and what it is; None without one."""
    for file in _entries(folder):
        found = _identified(file)
        if found is not None and found[:2] not in (KINDS["text"], KINDS["photo"], KINDS["empty"]):
            return file.name, found
    return None


def _counted(count: int, noun: str) -> str:
    return f"{count} {noun}{'s' * (count != 1)}"


def _entries(path: Path, depth: int = 2) -> Iterator[Path]:
    """Up to MAX_FILES visible files of a folder and of the folders in it, by name, its own first."""
    left, folders = MAX_FILES, [(path, depth)]
    while folders and left > 0:
        folder, deeper = folders.pop(0)
        try:
            entries = sorted(entry for entry in folder.iterdir() if entry.name[:1] not in (".", "_"))[:left]
        except OSError:
            continue
        left -= len(entries)
        yield from (entry for entry in entries if entry.is_file() and entry.name.lower() != "thumbs.db")
        folders += [(entry, deeper - 1) for entry in entries if deeper and entry.is_dir()]
