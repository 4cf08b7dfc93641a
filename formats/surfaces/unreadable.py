"""Files of three dimensions that are not read: what they are, and what to do."""

from pathlib import Path

from formats.errors import FormatError
from formats.inputs import open_input

CONVERT = "open it in Blender and export glTF (.glb)"
SPLATS = "a cloud of Gaussian splats, not a mesh"
SPLATS_HELP = "give the photos that it was made of"
POINTS = "a cloud of points, not a mesh"
POINTS_HELP = "make a surface of it first (in MeshLab or CloudCompare), or give the photos"
SIGNATURES = (
    (b"Kaydara FBX Binary", "an FBX model", CONVERT),
    (b"PXR-USDC", "a USD scene", CONVERT),
    (b"#usda", "a USD scene", CONVERT),
    (b"BLENDER", "a Blender file", CONVERT),
    (b"#VRML", "a VRML scene", CONVERT),
    (b"LASF", POINTS, POINTS_HELP),
    (b"ASTM-E57", POINTS, POINTS_HELP),
)
ENDINGS = {
    **dict.fromkeys((".fbx",), ("an FBX model", CONVERT)),
    **dict.fromkeys((".usd", ".usda", ".usdc", ".usdz"), ("a USD scene", CONVERT)),
    ".blend": ("a Blender file", CONVERT),
    ".dae": ("a COLLADA scene", CONVERT),
    ".3ds": ("a 3DS model", CONVERT),
    ".max": ("a 3ds Max scene", "export glTF (.glb) from 3ds Max"),
    ".c4d": ("a Cinema 4D scene", "export glTF (.glb) from Cinema 4D"),
    **dict.fromkeys((".ma", ".mb"), ("a Maya scene", "export glTF (.glb) from Maya")),
    **dict.fromkeys((".x3d", ".wrl", ".vrml"), ("an X3D or VRML scene", CONVERT)),
    **dict.fromkeys((".3mf", ".amf"), ("a model for printing", CONVERT)),
    **dict.fromkeys((".x", ".lwo", ".ac", ".b3d", ".md2", ".md5mesh"), ("a mesh", CONVERT)),
    ".abc": ("an Alembic scene", CONVERT),
    ".skp": ("a SketchUp model", "export glTF (.glb) from SketchUp"),
    **dict.fromkeys(
        (".step", ".stp", ".iges", ".igs", ".brep"), ("a CAD model", "export a mesh (.glb or .stl) of it")
    ),
    **dict.fromkeys((".dxf", ".dwg"), ("a drawing", "export a mesh (.glb or .stl) of it")),
    ".mtl": ("a library of materials", "give the .obj that names it"),
    ".b3dm": ("a 3D Tiles tile", "convert it to .glb"),
    **dict.fromkeys((".splat", ".ksplat", ".spz", ".sog"), (SPLATS, SPLATS_HELP)),
    **dict.fromkeys((".las", ".laz", ".e57", ".pcd", ".pts", ".ptx", ".xyz"), (POINTS, POINTS_HELP)),
    ".drc": ("a bare Draco mesh", "save it within a .glb"),
}


def unreadable_mesh(path: Path | str) -> str | None:
    """A sentence on a file that holds a scene, mesh or cloud of a kind that is not read; None for others."""
    try:
        with open_input(path) as file:
            head = file.read(1 << 16)
    except FormatError:
        return None
    what = _ply(head) if head.startswith(b"ply") else _other(head, Path(path).suffix.lower())
    return what and f"{path}: is {what[0]}, which cannot be read; {what[1]}"


def _ply(head: bytes) -> tuple[str, str] | None:
    head = head.partition(b"end_header")[0]
    if b"f_dc_0" in head or b"packed_scale" in head or b"element sh" in head and b"element chunk" in head:
        return SPLATS, SPLATS_HELP
    if b"element face" in head or b"element tristrips" in head:
        return None
    return POINTS, POINTS_HELP


def _other(head: bytes, ending: str) -> tuple[str, str] | None:
    for signature, what, to_do in SIGNATURES:
        if head.startswith(signature):
            return what, to_do
    if head.lstrip().startswith(b";") and b"FBX" in head[:200]:
        return "an FBX model", CONVERT
    return ENDINGS.get(ending)
