"""What is no capture: files and folders of other kinds, told by their first bytes and their endings."""

import re
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

from formats.errors import BadMesh, FormatError, MissingExtra, NotABundle, NotACapture, counted
from formats.safe_input import open_input

HEAD = 1 << 14
"""Bytes of a file that are looked at."""
TORCH = re.compile(rb"[^/\0]{1,200}/(data\.pkl|byteorder|version)")
"""A name in the ZIP archives that PyTorch writes."""
MAX_FILES = 2000
"""At most so many entries of a folder, and of the folders in it, are looked at."""
HEIF = 'install the extra that reads it: pip install "fusedrf[heif]", or convert it to JPEG'
OLDER_BLENDER = "convert it to glTF (.glb) with assimp or Blender 4.5 or older"
BLENDER = "open it in Blender and export glTF (.glb)"
EXPORT = "export glTF (.glb) from "
CAD = "export a mesh (.glb or .stl) of it"
PNG = "save it as PNG of 8 or 16 bits in sRGB"
COLMAP = "export COLMAP or convert it with nerfstudio's `ns-process-data {}`, and give the folder"
MESHES = "give a .glb, .gltf, .obj, .ply, .stl or .off with faces"
TRAIN = "learn a field of it with `fusedrf train`; of splats `fusedrf import` makes a bundle"
GIVE = "give a capture's folder, its transforms.json, or a mesh"


class Kind(NamedTuple):
    """A kind of file that is no capture."""

    what: str
    """With its article."""
    cure: str
    """What to do, as an order."""
    endings: str = ""
    """Of its names, with spaces between them, where the first bytes do not say."""
    start: bytes = b"(?!)"
    """A pattern of its first bytes."""


class OtherFile(NamedTuple):
    """What a file is that is no capture, and what to do."""

    kind: str
    """Of KINDS."""
    what: str
    cure: str
    extra: bool = False
    """Whether an extra that is not installed reads it."""

    def error(self, sentence: str, kind: type[FormatError] = NotACapture) -> FormatError:
        """The error of that kind, or of the extra that is missing."""
        return (MissingExtra if self.extra else kind)(f"{sentence}; {self.cure}")


KINDS = {  # the first whose pattern fits counts
    "bundle": Kind(
        "a bundle, a field that was learnt already",
        "see it with `fusedrf render`, or list it with `fusedrf info`",
        "rfpack",
        rb"PK\x03\x04.{26}scene\.json",
    ),
    "exr": Kind("an OpenEXR picture", PNG, "exr", rb"v/1\x01"),
    "hdr": Kind("a Radiance HDR picture", PNG, "hdr", rb"#\?(RADIANCE|RGBE)"),
    "document": Kind(
        "a drawing or document (PSD, PDF, EPS, SVG)",
        "save its picture as PNG",
        "psd pdf eps svg ai",
        rb"8BPS|%PDF|%!PS|\xc5\xd0\xd3\xc6|(<\?xml[^>]*>\s*)?(<!--.*?-->\s*)?<svg",
    ),
    "raw": Kind(
        "a camera's raw photo",
        "develop it to JPEG or PNG",
        "dng cr2 cr3 nef nrw arw raf orf rw2 pef srw",
        rb"....ftypcrx |FUJIFILMCCD-RAW|II\x2a\0.{4}CR\x02",
    ),
    "heif": Kind(
        "a HEIC photo",
        "give the folder of the photos",
        "heic heif hif",
        rb"....ftyp(hei[cxms]|hev[cmx]|mif1|msf1)",
    ),
    "photo": Kind(
        "a single photo",
        "give the folder of the photos",
        "png jpg jpeg jfif webp bmp tga tif tiff avif ppm pgm pnm",
        rb"\x89PNG|\xff\xd8\xff|RIFF....WEBP|BM.{4}\0\0\0\0|II\x2a\0|MM\0\x2a|....ftypavi[fs]",
    ),
    "film": Kind(
        "a film",
        "take pictures from it, as by `ffmpeg -i FILM -vf fps=2 photos/%04d.jpg`, and give their folder",
        "mp4 mov avi mkv webm m4v mpg mpeg mts m2ts ts 3gp wmv insv 360 lrv",
        rb"....(ftyp|moov|mdat|wide)|RIFF....AVI |\x1aE\xdf\xa3|GIF8|FLV\x01|\0\0\x01[\xb3\xba]",
    ),
    "record3d": Kind(
        "a Record3D export",
        "convert it with nerfstudio's `ns-process-data record3d`, and give the folder",
        "r3d",
    ),
    "splats": Kind(
        "a scene of Gaussian splats",
        "make a bundle of it with `fusedrf import`",
        "splat ksplat spz sog sogs lcc lcc2 rad spx",
        rb"ply[\r\n].*(property \S+ (f_dc_0|scale_0|packed_(position|scale))\b|element chunk.*element sh\b)",
    ),
    "mesh": Kind(
        "a mesh",
        "give that file itself",
        "obj gltf glb stl off",
        rb"ply[\r\n].*element (face|tristrips)|glTF",
    ),
    "cloud": Kind(
        "a cloud of points without faces",
        "give the photos that it was made from, or make a surface of it (in MeshLab or CloudCompare)",
        "las laz e57 pcd xyz pts ptx",
        rb"ply[\r\n]|LASF|ASTM-E57|# \.PCD|VERSION \.?7",
    ),
    "fbx": Kind("an FBX model", BLENDER, "fbx", rb"Kaydara FBX|\s*;.{0,199}FBX"),
    "usd": Kind("a USD scene", BLENDER, "usd usda usdc usdz", rb"#usda|PXR-USDC"),
    "blender": Kind("a Blender file", BLENDER, "blend", rb"BLENDER"),
    "collada": Kind("a COLLADA scene", OLDER_BLENDER, "dae", rb".{0,200}<COLLADA"),
    "vrml": Kind("an X3D or VRML scene", BLENDER, "x3d wrl vrml", rb"#(VRML|X3D)"),
    "printing": Kind("a model for printing", "save it as .obj or .stl", "3mf amf"),
    "alembic": Kind("an Alembic scene", BLENDER, "abc"),
    "model": Kind("a 3D model in a format that is not read", BLENDER, "3ds x lwo ac b3d md2 md5mesh vrm"),
    "max": Kind("a 3ds Max scene", EXPORT + "3ds Max", "max"),
    "cinema": Kind("a Cinema 4D scene", EXPORT + "Cinema 4D", "c4d"),
    "maya": Kind("a Maya scene", EXPORT + "Maya", "ma mb"),
    "sketchup": Kind("a SketchUp model", EXPORT + "SketchUp", "skp"),
    "rhino": Kind("a Rhino model", EXPORT + "Rhino", "3dm"),
    "cad": Kind("a CAD model", CAD, "step stp iges igs brep"),
    "drawing": Kind("a drawing", CAD, "dxf dwg"),
    "materials": Kind("a library of materials", "give the .obj that names it", "mtl"),
    "tile": Kind("a 3D Tiles tile", "convert it to .glb", "b3dm"),
    "draco": Kind("a bare Draco mesh", "save it within a .glb", "drc", rb"DRACO"),
    "metashape": Kind(
        "Metashape's XML of cameras",
        COLMAP.format("metashape"),
        "psx psz",
        rb".{0,400}<document.{0,800}<chunk",
    ),
    "realitycapture": Kind(
        "RealityCapture's CSV of cameras",
        COLMAP.format("realitycapture"),
        start=rb"#name,\s*x,\s*y,\s*(alt|z)",
    ),
    "cameras": Kind(
        "another program's list of cameras",
        "export a COLMAP model, and give its folder",
        "nvm out lst rcproj xmp csv xml",
        rb"NVM_V3|# Bundle file|.{0,400}<BlocksExchange|(#[^\n]*\n)*# *timestamp tx ty tz|"
        rb'\s*[\[{].{0,400}"(sfm_data_version|shots)"',
    ),
    "colmap": Kind(
        "one file of a COLMAP model or its database",
        "give the folder above sparse/ and images/",
        start=rb"# (Camera|Image|3D point) list|SQLite format 3",
    ),
    "checkpoint": Kind(
        "another program's checkpoint or arrays",
        "make a bundle of it with `fusedrf import`, or give the photos that it was learnt from",
        "pth pt ckpt msgpack ingp npz npy pkl pickle h5 hdf5 safetensors onnx bin tensorf",
        rb"\x93NUMPY|\x89HDF|\x80[\x02-\x05]",
    ),
    "archive": Kind(
        "an archive", "unpack it and give the folder", "zip tar gz tgz bz2 xz 7z rar zst", rb".{257}ustar"
    ),
    "empty": Kind("an empty file", "copy or export it again", start=rb"\Z"),
    "text": Kind("a text", GIVE, "txt md rtf doc docx html htm yaml yml log ini toml json"),
    "other": Kind("a file of an unknown kind", GIVE),
}
BY_ENDING = {f".{ending}": name for name, kind in KINDS.items() for ending in kind.endings.split()}
MODEL_FILES = [f"{name}.bin" for name in ("cameras", "images", "points3D", "frames", "rigs")]
"""Files of a COLMAP model, which do not begin in any way."""
CAMERA_FILE = re.compile(r"cameras(_\w+)?\.npz|traj(ectory)?\.(txt|log)|\d+_cam\.txt")
"""Names of lists of cameras that do not begin in any way: NeuS's, Replica's, those of Tanks and Temples and
MVSNet's."""
CONTAINERS = (b"PK\x03\x04", b"\x1f\x8b", b"7z\xbc\xaf", b"Rar!", b"BZh", b"\xfd7zXZ", b"\x28\xb5\x2f\xfd")
"""Beginnings of archives, which many kinds of files are inside: those are told by their endings."""


def identify(head: bytes, ending: str) -> OtherFile | None:
    """What a file is by its first HEAD bytes, and by the ending of its name, such as ".mp4", where those do
    not say; None where neither does."""
    name = _kind(head.partition(b"end_header")[0] if head.startswith(b"ply") else head, ending.lower())
    return None if name is None else _foreign(name)


def _foreign(name: str) -> OtherFile:
    missing = name == "heif" and not find_spec("pillow_heif")
    return OtherFile(name, KINDS[name].what, HEIF if missing else KINDS[name].cure, missing)


def _kind(head: bytes, ending: str) -> str | None:
    named = BY_ENDING.get(ending)
    for name, kind in KINDS.items():
        if re.match(kind.start, head, re.DOTALL):
            return "raw" if name == "photo" and named == "raw" else name
    return named or ("archive" if head.startswith(CONTAINERS) else None)


def not_a_capture(path: Path) -> FormatError:
    """The error for a file or folder that is no capture, and in which nothing is that can be posed."""
    if path.is_dir():
        return _of_folder(path)
    other = _named(path)
    return other.error(f"{path}: is {other.what}, no capture")


def not_a_bundle(path: Path, head: bytes) -> NotABundle | None:
    """The error for a file of another sort, by its first bytes, where a bundle or a scene is expected; None
    where they do not tell."""
    checkpoint = head.startswith(b"PK") and TORCH.search(head)
    other = _foreign("checkpoint") if checkpoint else identify(head, path.suffix)
    if other is None or other.kind in ("bundle", "text", "other", "archive"):
        return None
    cure = TRAIN if other.kind == "mesh" else other.cure
    return NotABundle(f"{path}: is {other.what}, neither a bundle nor a scene; {cure}")


def not_a_mesh(path: Path) -> BadMesh:
    """The error for a file that is no mesh of a kind that is read."""
    other = _named(path)
    cure = MESHES if other.kind in ("text", "other") else other.cure
    return BadMesh(f"{path}: is {other.what}, no mesh; {cure}")


def kind_of(path: Path) -> str:
    """What a file is, of KINDS."""
    return _named(path).kind


def other_cameras(path: Path) -> OtherFile | None:
    """What a file of cameras is that is not read, by its name or its first bytes; None for others."""
    other = _foreign("cameras") if CAMERA_FILE.fullmatch(path.name) else identify(_head(path), "")
    return other if other and other.kind in ("metashape", "realitycapture", "cameras") else None


def _named(path: Path) -> OtherFile:
    return _identified(path) or _foreign("other" if b"\0" in _head(path) else "text")


def _identified(path: Path) -> OtherFile | None:
    return _foreign("colmap") if path.name in MODEL_FILES else identify(_head(path), path.suffix)


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
        what, cure = KINDS["cameras"][:2]
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
        return _foreign("record3d").error(f"{path}: is {KINDS['record3d'].what}, no capture")
    if nested := sorted({file.parent for file in photos} - {path}):
        counts = [sum(file.parent == folder for file in photos) for folder in nested]
        most = nested[counts.index(max(counts))]
        unused = [file for file in files if file not in photos and other_cameras(file)]
        more = f"; {unused[0].name}, {other_cameras(unused[0]).what}, is not used" if unused else ""
        cure = "give that folder" if len(nested) == 1 else "give that folder, or put all photos into one"
        return NotACapture(
            f"{path}: its photos lie in {counted(len(nested), 'folder', 'folders')} below it, "
            f"{max(counts)} of them in {most.relative_to(path)}; {cure}{more}"
        )
    if (beside := beside_photos(path)) is None:
        return NotACapture(
            f"{path}: holds {counted(len(files), 'file', 'files')} such as {files[0].name}, but no "
            "photos and no poses; give the folder that the photos lie in"
        )
    name, other = beside
    return other.error(f"{path}: holds no photos that can be read and no poses, but {name}, {other.what}")


def beside_photos(folder: Path) -> tuple[str, OtherFile] | None:
    """The name of a file in a folder that is neither a photo nor a text, and what it is; None without one."""
    for file in _entries(folder):
        other = _identified(file)
        if other is not None and other.kind not in ("text", "photo", "empty"):
            return file.name, other
    return None


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
