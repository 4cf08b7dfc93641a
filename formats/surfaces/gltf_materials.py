"""glTF's materials: base colour, emission, alpha, samplers, and a note on all else that they name."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from formats.errors import listed
from formats.surfaces import gltf_schema as schema
from formats.surfaces.accessors import Buffers, data_uri, is_data
from formats.surfaces.pictures import Pictures
from formats.surfaces.surface import Notes, Texture

GLOSSINESS = "KHR_materials_pbrSpecularGlossiness"
TRANSFORM = "KHR_texture_transform"
STRENGTH = "KHR_materials_emissive_strength"
UNLIT = "KHR_materials_unlit"
PICTURE_EXTENSIONS = ("KHR_texture_basisu", "EXT_texture_webp", "EXT_texture_avif", "MSFT_texture_dds")
"""Name another picture than `source`, which is left for readers that do not know them."""
WRAPS = {10497: "repeat", 33071: "clamp", 33648: "mirror"}
NEAREST = 9728
MODES = ("OPAQUE", "MASK", "BLEND")


class Slot(NamedTuple):
    """A factor, a texture, the set of coordinates it takes and what is done to them."""

    factor: np.ndarray
    """(4,) float32."""
    texture: Texture | None
    tex_coord: int
    transform: np.ndarray | None
    """(2, 3) on columns (u, v, 1)."""


@dataclass(frozen=True, eq=False)
class Appearance:
    """What of a material is shown."""

    base: Slot
    glow: Slot | None
    cutoff: float | None
    blend: bool
    single_sided: bool


PLAIN = Appearance(Slot(np.ones(4, np.float32), None, 0, None), None, None, False, True)
"""Where a primitive has no material: glTF's default, white."""


class Materials:
    """Reads each material and picture once."""

    def __init__(self, document: schema.Document, buffers: Buffers, notes: Notes):
        self.document, self.buffers, self.notes = document, buffers, notes
        self.looks: dict[int, Appearance] = {}
        self.used: set[int] = set()
        """Of the document's images, those that are shown."""
        self.pictures = Pictures(len(document.images), notes)

    def look(self, index: int | None) -> Appearance:
        """What material `index` shows. Raises BadMesh."""
        if index is None:
            return PLAIN
        if index not in self.looks:
            self.looks[index] = self._look(self.buffers.item("materials", index), index)
        return self.looks[index]

    def _look(self, material: schema.Material, index: int) -> Appearance:
        name = f"material {material.name[:60]!r}" if material.name else f"material {index}"
        self._tell_unused(material, name)
        metallic = material.pbr_metallic_roughness
        factor, info = metallic.base_color_factor, metallic.base_color_texture
        glossy = material.extension(GLOSSINESS, schema.Glossiness, self.buffers.path)
        if glossy is not None:
            required = GLOSSINESS in self.document.extensions_required
            if required or glossy.diffuse_factor or glossy.diffuse_texture:  # or it says nothing of colour
                factor, info = glossy.diffuse_factor, glossy.diffuse_texture
        base = self._slot(factor, info, name)
        if material.alpha_mode not in MODES:
            self.notes.add(f"the unknown alphaMode {material.alpha_mode[:20]!r} is shown as OPAQUE", name)
        cutoff = material.alpha_cutoff if material.alpha_mode == "MASK" else None
        blend = material.alpha_mode == "BLEND"
        return Appearance(base, self._glow(material, name), cutoff, blend, not material.double_sided)

    def _glow(self, material: schema.Material, name: str) -> Slot | None:
        stated = material.extension(STRENGTH, schema.EmissiveStrength, self.buffers.path)
        strength = 1.0 if stated is None else stated.emissive_strength
        factor = [max(strength, 0) * max(value, 0) for value in material.emissive_factor or (0, 0, 0)]
        if max(factor) == 0:
            return None
        self.notes.add("glows, which is added to its colour", name)
        return self._slot([*factor, 1], material.emissive_texture, name)

    def _slot(self, factor: list[float] | None, info: schema.TextureInfo | None, name: str) -> Slot:
        colour = np.clip(np.array(factor or [1, 1, 1, 1], np.float32), 0, 1000)
        if info is None:
            return Slot(colour, None, 0, None)
        tex_coord, transform = info.tex_coord, None
        moved = info.extension(TRANSFORM, schema.TextureTransform, self.buffers.path)
        if moved is not None:
            transform = _transform(moved)
            tex_coord = tex_coord if moved.tex_coord is None else moved.tex_coord
        return Slot(colour, self._texture(info.index, name), tex_coord, transform)

    # --- textures -------------------------------------------------------------------------------------------

    def _texture(self, index: int, name: str) -> Texture | None:
        texture = self.buffers.item("textures", index)
        others = [texture.extension(n, schema.Sourced, self.buffers.path) for n in PICTURE_EXTENSIONS]
        sources = [other.source for other in others if other is not None]
        for source in (*sources, texture.source):
            pixels = None if source is None else self._picture(source, name)
            if pixels is not None:
                self.used.add(source)
                return Texture(pixels, *self._sampling(texture))
        if not sources and texture.source is None:
            others = f" but by {listed(texture.extensions)}" if texture.extensions else ""
            self.notes.add(f"has a texture without a picture{others}, which is shown white", name)
        return None

    def _sampling(self, texture: schema.Texture) -> tuple[tuple[str, str], bool]:
        if texture.sampler is None:
            return ("repeat", "repeat"), False
        sampler = self.buffers.item("samplers", texture.sampler)
        wraps = tuple(WRAPS.get(mode, "repeat") for mode in (sampler.wrap_s, sampler.wrap_t))
        return wraps, sampler.mag_filter == NEAREST

    def _picture(self, index: int, name: str) -> np.ndarray | None:
        """The pixels of an image, or None and a note where it cannot be read."""
        image = self.buffers.item("images", index)
        return self.pictures.get(index, lambda: self._image_bytes(image, image_label(image, index)), name)

    def _image_bytes(self, image: schema.Image, label: str) -> tuple[bytes, str]:
        if image.buffer_view is not None:
            return bytes(self.buffers.view(image.buffer_view)), label
        if image.uri is None:
            return b"", label
        if is_data(image.uri):
            return data_uri(image.uri, label), label
        return self.buffers.beside.read(image.uri, uri=True)

    # --- notes ----------------------------------------------------------------------------------------------

    def _tell_unused(self, material: schema.Material, name: str) -> None:
        """A note on every texture and extension of a material that is not shown."""
        metallic = material.pbr_metallic_roughness
        slots = {
            "normalTexture": material.normal_texture,
            "occlusionTexture": material.occlusion_texture,
            "metallicRoughnessTexture": metallic.metallic_roughness_texture,
        }
        unused = [slot for slot, info in slots.items() if info is not None]
        known = (GLOSSINESS, STRENGTH, UNLIT)
        unused += [extension for extension in material.extensions if extension not in known]
        glossy = material.extension(GLOSSINESS, schema.Glossiness, self.buffers.path)
        unused += ["specularGlossinessTexture"] if glossy and glossy.specular_glossiness_texture else []
        if unused:
            self.notes.add(f"shown unlit, by colour alone; not used: {listed(unused)}", name)

    def tell_unused(self) -> None:
        """A note on materials that nothing shown has, and on pictures that no shown material uses."""
        materials = enumerate(self.document.materials)
        unused = [material.name or f"material {i}" for i, material in materials if i not in self.looks]
        if unused:
            self.notes.add(f"materials that nothing shown has: {listed(unused)}")
        tried = self.used | {index for index, pixels in self.pictures.pixels.items() if pixels is None}
        unused = [image_label(i, n) for n, i in enumerate(self.document.images) if n not in tried]
        if unused:
            self.notes.add(f"pictures that no shown colour uses: {listed(unused)}")


def image_label(image: schema.Image, index: int) -> str:
    if image.uri is not None and not is_data(image.uri):
        return image.uri[:200]
    return f"image {index}" + (f" ({image.name[:60]})" if image.name else "")


def _transform(moved: schema.TextureTransform) -> np.ndarray:
    """(2, 3) translation * rotation * scale of KHR_texture_transform, turned as in Khronos' own viewer and
    test model: the code in the extension's text turns the other way."""
    (x, y), (s, t) = moved.offset or (0, 0), moved.scale or (1, 1)
    c, w = math.cos(moved.rotation), math.sin(moved.rotation)
    return np.array([[c * s, w * t, x], [-w * s, c * t, y]])
