"""glTF 2.0's JSON, strictly typed: the parts that are read, and how a document is decoded within limits."""

from typing import Annotated, TypeVar

import msgspec

from formats.errors import BadJson, BadMesh, LimitExceeded

MAX_JSON = 1 << 30
MAX_LOOSE = 64 << 20
"""Larger ones are read in one way alone, not mended."""
MAX_VALUES = 3_000_000
MAX_OBJECTS = 500_000
"""Commas and brackets of a document, and its objects: what bounds the memory of parsing it."""

Index = Annotated[int, msgspec.Meta(ge=0, le=2**53)]
Size = Index
Vec2 = Annotated[list[float], msgspec.Meta(min_length=2, max_length=2)]
Vec3 = Annotated[list[float], msgspec.Meta(min_length=3, max_length=3)]
Vec4 = Annotated[list[float], msgspec.Meta(min_length=4, max_length=4)]
Mat4 = Annotated[list[float], msgspec.Meta(min_length=16, max_length=16)]
Extensions = dict[str, msgspec.Raw]
Kind = TypeVar("Kind")


class Part(msgspec.Struct, rename="camel", gc=False):
    """Any object of glTF."""

    extensions: Extensions = {}

    def extension(self, name: str, kind: type[Kind], where: object) -> Kind | None:
        """One of its extensions, None without it. Raises BadJson, BadMesh."""
        return typed(self.extensions[name], kind, f"{where}: {name}") if name in self.extensions else None


class Named(Part):
    name: str = ""


class Asset(msgspec.Struct, rename="camel", gc=False):
    version: str
    min_version: str | None = None


class Head(msgspec.Struct, rename="camel", gc=False):
    """What is looked at before the rest is typed."""

    asset: Asset | None = None


class SparsePart(Part, kw_only=True):
    buffer_view: Index
    byte_offset: Size = 0
    component_type: int = 5123
    """Of the indices; the values have their accessor's."""


class Sparse(Part, kw_only=True):
    count: Size
    indices: SparsePart
    values: SparsePart


class Accessor(Named, kw_only=True):
    component_type: int
    count: Size
    type: str
    buffer_view: Index | None = None
    byte_offset: Size = 0
    normalized: bool = False
    sparse: Sparse | None = None


class BufferView(Named, kw_only=True):
    buffer: Index
    byte_length: Size
    byte_offset: Size = 0
    byte_stride: Size = 0


class Buffer(Named, kw_only=True):
    byte_length: Size
    uri: str | None = None


class TextureInfo(Part, kw_only=True):
    index: Index
    tex_coord: Index = 0


class Metallic(Part):
    base_color_factor: Vec4 | None = None
    base_color_texture: TextureInfo | None = None
    metallic_roughness_texture: TextureInfo | None = None


class Material(Named):
    pbr_metallic_roughness: Metallic = msgspec.field(default_factory=Metallic)
    normal_texture: TextureInfo | None = None
    occlusion_texture: TextureInfo | None = None
    emissive_texture: TextureInfo | None = None
    emissive_factor: Vec3 | None = None
    alpha_mode: str = "OPAQUE"
    alpha_cutoff: float = 0.5
    double_sided: bool = False


class Glossiness(Part):
    """KHR_materials_pbrSpecularGlossiness."""

    diffuse_factor: Vec4 | None = None
    diffuse_texture: TextureInfo | None = None
    specular_glossiness_texture: TextureInfo | None = None


class EmissiveStrength(Part):
    emissive_strength: float = 1.0


class TextureTransform(Part):
    offset: Vec2 | None = None
    rotation: float = 0.0
    scale: Vec2 | None = None
    tex_coord: Index | None = None


class Texture(Named):
    source: Index | None = None
    sampler: Index | None = None


class Sourced(Part):
    """An extension that names another picture of a texture."""

    source: Index | None = None


class Sampler(Named):
    mag_filter: int | None = None
    wrap_s: int = 10497
    wrap_t: int = 10497


class Image(Named):
    uri: str | None = None
    buffer_view: Index | None = None


class Primitive(Part, kw_only=True):
    attributes: dict[str, Index]
    indices: Index | None = None
    material: Index | None = None
    mode: int = 4
    targets: list[dict[str, Index]] = []


class Mesh(Named, kw_only=True):
    primitives: list[Primitive]
    weights: list[float] = []


class Node(Named):
    children: list[Index] = []
    mesh: Index | None = None
    skin: Index | None = None
    matrix: Mat4 | None = None
    translation: Vec3 | None = None
    rotation: Vec4 | None = None
    scale: Vec3 | None = None
    weights: list[float] | None = None


class Visibility(Part):
    visible: bool = True


class Instancing(Part):
    attributes: dict[str, Index] = {}


class Skin(Named, kw_only=True):
    joints: list[Index]
    inverse_bind_matrices: Index | None = None


class Scene(Named):
    nodes: list[Index] = []


class Draco(Part, kw_only=True):
    buffer_view: Index
    attributes: dict[str, Index]


class Meshopt(Part, kw_only=True):
    buffer: Index
    byte_length: Size
    byte_stride: Size
    count: Size
    mode: str
    byte_offset: Size = 0
    filter: str = "NONE"


class Document(Part):
    extensions_used: list[str] = []
    extensions_required: list[str] = []
    accessors: list[Accessor] = []
    buffer_views: list[BufferView] = []
    buffers: list[Buffer] = []
    images: list[Image] = []
    materials: list[Material] = []
    meshes: list[Mesh] = []
    nodes: list[Node] = []
    samplers: list[Sampler] = []
    scene: Index | None = None
    scenes: list[Scene] = []
    skins: list[Skin] = []
    textures: list[Texture] = []
    animations: list[msgspec.Raw] = []


def decode(data: bytes, where: str) -> Document:
    """The document of glTF's JSON. Raises BadJson, BadMesh (another version, wrong types), LimitExceeded."""
    data = data.removeprefix(b"\xef\xbb\xbf")
    _check_limits(data, where)
    asset = typed(data, Head, where).asset
    if asset is None:
        raise BadMesh(f"{where}: not glTF 2.0, since it states no version; convert the file to glTF 2.0")
    needed = asset.min_version or asset.version
    if asset.version.split(".")[0] != "2" or (asset.min_version or "2.0") not in ("2", "2.0"):
        raise BadMesh(f"{where}: needs glTF {needed[:20]!r}, but 2.0 is read; convert the file to glTF 2.0")
    return typed(data, Document, where)


def typed(data: bytes | msgspec.Raw, kind: type[Kind], where: str) -> Kind:
    """JSON as a struct. Raises BadJson, BadMesh."""
    try:
        try:
            return msgspec.json.decode(data, type=kind)
        except msgspec.ValidationError:
            if len(bytes(data)) > MAX_LOOSE:
                raise
            return msgspec.json.decode(msgspec.json.encode(_plain(msgspec.json.decode(data))), type=kind)
    except msgspec.ValidationError as error:
        raise BadMesh(f"{where}: not valid glTF: {error}; export it again") from error
    except (msgspec.DecodeError, RecursionError, ValueError) as error:
        raise BadJson(f"{where}: not strict JSON: {error}") from error


def _plain(value):
    """JSON as exporters should write it: without nulls, and whole numbers without a point."""
    if isinstance(value, dict):
        return {name: _plain(entry) for name, entry in value.items() if entry is not None}
    if isinstance(value, list):
        return [_plain(entry) for entry in value]
    return int(value) if isinstance(value, float) and value.is_integer() else value


def _check_limits(data: bytes, where: str) -> None:
    objects = data.count(b"{")
    values = data.count(b",") + data.count(b"[") + objects
    if values > MAX_VALUES or objects > MAX_OBJECTS:
        raise LimitExceeded(
            f"{where}: glTF of about {values:,} values and {objects:,} objects, but at most {MAX_VALUES:,} "
            f"and {MAX_OBJECTS:,} are read"
        )
