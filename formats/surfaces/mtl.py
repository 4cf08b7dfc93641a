"""Wavefront's material libraries (.mtl) as paint.

Colours are sRGB. A picture (`map_Kd`) is multiplied by a colour (`Kd`) that tints it; a grey one beside a
picture is what exporters write for "none", so that the picture is shown as it is. `d`, `Tr` and `map_d` are
alpha, `Ke` glows.
"""

import re
from dataclasses import dataclass, field, replace

import numpy as np

from formats.errors import listed
from formats.surfaces.lines import lines_of
from formats.surfaces.named_files import Beside
from formats.surfaces.pictures import Pictures
from formats.surfaces.surface import Notes, Paint, Texture, opaque

ONE_WORD = ("-blendu", "-blendv", "-bm", "-boost", "-cc", "-clamp", "-imfchan", "-texres", "-type")
ARGUMENTS = {**dict.fromkeys(ONE_WORD, 1), "-mm": 2}
"""Options of a map and how many words follow; -o, -s and -t take one to three numbers."""
PLACING = ("-o", "-s", "-t")
WITHOUT_LOOKS = ("-blendu", "-blendv", "-bm", "-boost", "-texres", "-type", "-colorspace")

MAPS = re.compile(r"(map_\w+|norm|bump|disp|decal|refl)$")
ENDING = r"\.(?:png|jpe?g|tga|bmp|tiff?|exr|hdr|dds|webp|gif|psd)"
PICTURE = re.compile(ENDING + "$", re.IGNORECASE)
"""What a word that is not known names."""
BEHIND = re.compile(rf"(.*{ENDING}\"?)\s+(-[a-z]+\s.*)", re.IGNORECASE)
"""Options that some write behind the name of a picture."""
TILES = re.compile("<udim>", re.IGNORECASE)
FIRST_TILE, TILES_ACROSS = 1001, 10
SHOWN = ("map_kd", "map_ka", "map_d", "map_ke")
GREY = 1 / 512
MAX_MATERIALS = 100_000


@dataclass
class Map:
    """A picture that a material names and how it is laid on."""

    name: str
    options: dict[str, list[str]]

    def numbers(self, option: str, default: float) -> np.ndarray:
        """(2,) of -o or -s."""
        given = self.options.get(option, [])[:2]
        return np.array([*map(float, given), *[default] * (2 - len(given))])


@dataclass
class Material:
    """One `newmtl`, as it is written."""

    name: str
    colours: dict[str, tuple[float, ...]] = field(default_factory=dict)
    """kd, ka, ke, tf, rgb each."""
    alpha: float = 1.0
    maps: dict[str, Map] = field(default_factory=dict)

    @property
    def base(self) -> Map | None:
        """The picture that is shown."""
        return self.maps.get("map_kd", self.maps.get("map_ka"))

    @property
    def placed(self) -> Map:
        """The picture whose options place the coordinates."""
        return self.base or self.maps.get("map_d") or Map("", {})

    @property
    def tiled(self) -> bool:
        """Whether each tile of the coordinates has a picture of its own."""
        return any(TILES.search(each.name) for each in self.maps.values())

    def tile(self, number: int) -> "Material":
        """What is shown in one tile."""
        maps = {word: Map(TILES.sub(str(number), m.name), m.options) for word, m in self.maps.items()}
        return replace(self, name=f"{self.name} <UDIM {number}>", maps=maps)


@dataclass(frozen=True, eq=False)
class Appearance:
    """What of a material is shown."""

    paint: Paint
    """Without coordinates."""
    glow: Paint | None
    blend: bool
    scale: np.ndarray
    offset: np.ndarray
    """Of the texture's coordinates (u, v up)."""


def parse_mtl(data: bytes, notes: Notes, file: str) -> dict[str, Material]:
    """Materials by name; of several of one name the first."""
    materials, current = {}, None
    for line in lines_of(data):
        word, _, rest = line.partition(" ")
        word, rest = word.lower(), rest.strip()
        if word == "newmtl":
            check_repeated(materials.get(current and current.name), current, notes)
            current = Material(rest)
            materials.setdefault(rest, current)
            if len(materials) > MAX_MATERIALS:
                notes.add(f"{file} has more than {MAX_MATERIALS:,} materials, the rest is left out")
                return materials
        elif current is None:
            notes.add(f"{file}: {word} before its first newmtl belongs to no material")
        else:
            try:
                _set(current, word, rest)
            except ValueError:
                notes.add(f"{file}: {word} {rest[:40]!r} of material {current.name[:60]!r} is not understood")
    check_repeated(materials.get(current and current.name), current, notes)
    return materials


def check_repeated(first: Material | None, other: Material | None, notes: Notes) -> None:
    """Note that two materials of one name differ."""
    if first is not None and first != other:
        notes.add("is there more than once, the first is shown", f"material {first.name[:60]!r}")


def _set(material: Material, word: str, rest: str) -> None:
    if word in ("kd", "ka", "ke", "tf"):
        numbers = tuple(map(float, rest.split()))
        if len(numbers) not in (1, 3) or not np.isfinite(numbers).all():
            raise ValueError
        material.colours[word] = numbers * 3 if len(numbers) == 1 else numbers
    elif word in ("d", "tr"):
        value = float(rest.split()[-1]) if rest else 1.0
        if not np.isfinite(value):
            raise ValueError
        if word == "d":
            material.alpha = value
        elif value < 1 and material.alpha == 1:  # Tr 1 is written for opaque, too
            material.alpha = 1 - value
    elif MAPS.match(word) or PICTURE.search(rest):
        material.maps[word] = _map(rest)


def _map(rest: str) -> Map:
    """The file is what is left behind the options, with its spaces."""
    options: dict[str, list[str]] = {}
    if not PICTURE.search(rest) and (behind := BEHIND.fullmatch(rest)):
        rest = f"{behind[2]} {behind[1]}"
    while match := re.match(r"(-[A-Za-z]+)\s+", rest):
        option = match[1].lower()
        if option in PLACING:
            values = re.match(r"(?:[-+]?[\d.]+(?:[eE][-+]?\d+)?\s+){1,3}", rest[match.end() :])
        elif option in ARGUMENTS:
            values = re.match(rf"(?:\S+\s+){{{ARGUMENTS[option]}}}", rest[match.end() :])
        else:  # not known: with one word, unless nothing would be left
            values = re.match(r"\S+\s+(?=\S)", rest[match.end() :])
            if values is None:
                break
        if values is None:
            raise ValueError
        options[option] = values[0].split()
        if option in PLACING:
            list(map(float, options[option]))  # ValueError here, where it becomes a note
        rest = rest[match.end() + values.end() :]
    return Map(rest.strip().strip('"'), options)


class Appearances:
    """What materials show; each picture is read once."""

    def __init__(self, materials: dict[str, Material], beside: Beside, notes: Notes):
        self.materials, self.beside, self.notes = materials, beside, notes
        self.looks: dict[str, Appearance] = {}
        maps = [item for material in materials.values() for item in material.maps.items()]
        named = {m.name for word, m in maps if word in SHOWN}
        self.pictures = Pictures(len(named), notes)

    def look(self, name: str) -> Appearance:
        if name not in self.looks:
            self.looks[name] = self._look(self.materials[name])
        return self.looks[name]

    def _look(self, material: Material) -> Appearance:
        called = f"material {material.name[:60]!r}"
        maps = material.maps
        base, placed = material.base, material.placed
        if "map_ka" in maps and "map_kd" not in maps:
            self.notes.add("has no map_Kd, its map_Ka is shown", called)
        if len(set(material.colours.get("tf", (1,)))) > 1:
            self.notes.add("tints what shines through it (Tf), which is not shown", called)
        self._tell_unused(material, base, called)
        texture, coverage = self._texture(base, called), self._texture(maps.get("map_d"), called)
        if coverage is not None:
            coverage = Texture(_as_alpha(coverage.pixels), coverage.wrap)
        colour = self._colour(material, base, texture, called)
        if material.alpha < 1:
            gone = "wholly see-through (d 0 or Tr 1), so that it is not shown"
            self.notes.add("see-through, which is blended" if material.alpha > 0 else gone, called)
        if texture is not None and coverage is None and (texture.pixels[..., 3] < 255).any():
            self.notes.add(
                f"the transparency of {base.name} is not shown, since no map_d asks for it", called
            )
            texture = replace(texture, pixels=opaque(texture.pixels))
        factor = np.array([*colour, np.clip(material.alpha, 0, 1)], np.float32)
        return Appearance(
            Paint(factor, texture, coverage=coverage),
            self._glow(material, called),
            material.alpha < 1 or coverage is not None,
            placed.numbers("-s", 1),
            placed.numbers("-o", 0),
        )

    def _colour(self, material: Material, base: Map | None, texture: Texture | None, called: str):
        kd = material.colours.get("kd")
        if kd is None or base is None:
            return np.clip(kd or (1, 1, 1), 0, 1)
        if max(kd) - min(kd) > GREY:
            return np.clip(kd, 0, 1)
        if texture is not None and abs(kd[0] - 1) > GREY:
            self.notes.add(f"has the grey Kd {kd[0]:.3g} beside a picture, which is shown as it is", called)
        return np.ones(3) if texture is not None else np.clip(kd, 0, 1)

    def _glow(self, material: Material, called: str) -> Paint | None:
        ke = material.colours.get("ke", (0, 0, 0))
        texture = self._texture(material.maps.get("map_ke"), called)
        if max(ke) <= 0:
            return None
        self.notes.add("glows, which is added to its colour", called)
        return Paint(np.array([*np.clip(ke, 0, 1000), 1], np.float32), texture)

    def _texture(self, picture: Map | None, called: str) -> Texture | None:
        if picture is None:
            return None
        pixels = self.pictures.get(picture.name, lambda: self.beside.read(picture.name), called)
        wrap = "clamp" if picture.options.get("-clamp", ["off"])[0].lower() == "on" else "repeat"
        return None if pixels is None else Texture(pixels, (wrap, wrap))

    def _tell_unused(self, material: Material, base: Map | None, called: str) -> None:
        glows = max(material.colours.get("ke", (0,))) > 0
        shown = {"map_kd", "map_d", "map_ke"} if glows else {"map_kd", "map_d"}
        unused = [f"{word} {m.name}" for word, m in material.maps.items() if word not in shown]
        unused = [text for text in unused if base is None or not text.endswith(f" {base.name}")]
        if unused:
            self.notes.add(f"shown unlit, by colour alone; not used: {listed(unused)}", called)
        odd = {
            option
            for word, m in material.maps.items()
            for option in m.options
            if word in SHOWN and option not in ("-o", "-s", "-clamp", *WITHOUT_LOOKS)
        }
        if odd:
            self.notes.add(f"has pictures with {listed(sorted(odd))}, which is not honoured", called)

    def tell_unused(self) -> None:
        unused = [name for name in self.materials if name not in self.looks]
        if unused:
            self.notes.add(f"materials that no face uses: {listed(unused)}")


def _as_alpha(pixels: np.ndarray) -> np.ndarray:
    """The alpha of a picture that has one, else its brightness."""
    if (pixels[..., 3] < 255).any():
        return pixels
    bright = np.rint(pixels[..., :3] @ np.array([0.299, 0.587, 0.114])).astype(np.uint8)
    return np.dstack([pixels[..., :3], bright])
