"""One content as each format of splats stores it, written by hand after the format's specification."""

import gzip
import io
import json
import struct
import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from tests.formats.gltf import Gltf

try:
    from compression import zstd
except ImportError:  # before Python 3.14
    from backports import zstd

SH_0 = 0.28209479177387814
RIGHT_UP_BACK = np.array([1, -1, -1])
SH_FLIPS = np.array([-1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1])
"""Signs of the coefficients 1 to 15 where y and z change theirs: spz's `flipSh` with x = 1, y = z = -1.
Those of degree 4 are read by nobody here."""


@dataclass
class Content:
    """Splats as `formats.splats.splats.Splats` holds them, in float64."""

    centres: np.ndarray
    scales: np.ndarray
    rotations: np.ndarray
    opacities: np.ndarray
    harmonics: np.ndarray

    def __len__(self) -> int:
        return len(self.centres)

    @property
    def rest(self) -> np.ndarray:
        """(N, K - 1, 3)."""
        return self.harmonics[:, 1:]

    @property
    def bytes_of_colours(self) -> np.ndarray:
        """(N, 4) uint8 red, green, blue and opacity."""
        rgb = 0.5 + SH_0 * self.harmonics[:, 0]
        return to_bytes(np.concatenate([rgb, self.opacities[:, None]], 1) * 255)


def content(count: int = 5, degree: int = 3, seed: int = 0) -> Content:
    """Different along every axis, of colours in [0, 1]; w is positive in rotations."""
    rng = np.random.default_rng(seed)
    rotations = rng.normal(size=(count, 4))
    rotations *= np.sign(rotations[:, :1]) / np.linalg.norm(rotations, axis=1, keepdims=True)
    harmonics = rng.uniform(-0.9, 0.9, (count, (degree + 1) ** 2, 3))
    harmonics[:, 0] = rng.uniform(-1.7, 1.7, (count, 3))
    return Content(
        rng.normal(size=(count, 3)) * [1, 2, 3],
        np.exp(rng.uniform(-5, -1, (count, 3))),
        rotations,
        rng.uniform(0.05, 0.95, count),
        harmonics,
    )


def to_bytes(values: np.ndarray) -> np.ndarray:
    return np.clip(np.round(values), 0, 255).astype(np.uint8)


def logit(opacities: np.ndarray) -> np.ndarray:
    return np.log(opacities / (1 - opacities))


# --- .ply ---------------------------------------------------------------------------------------------------


def ply_columns(splats: Content) -> dict[str, np.ndarray]:
    """As `save_ply` of 3DGS names them: `f_rest` goes through all coefficients of red, then of green."""
    columns = dict(zip("xyz", splats.centres.T, strict=True))
    columns |= {f"n{axis}": np.zeros(len(splats)) for axis in "xyz"}
    columns |= {f"f_dc_{c}": splats.harmonics[:, 0, c] for c in range(3)}
    rest = splats.rest.transpose(0, 2, 1).reshape(len(splats), -1)
    columns |= {f"f_rest_{i}": column for i, column in enumerate(rest.T)}
    columns["opacity"] = logit(splats.opacities)
    columns |= {f"scale_{i}": column for i, column in enumerate(np.log(splats.scales).T)}
    return columns | {f"rot_{i}": column for i, column in enumerate(1.7 * splats.rotations.T)}


def table(columns: dict[str, np.ndarray], coding: str = "binary_little_endian", comment: str = "") -> bytes:
    """A .ply of vertices with float columns."""
    lines = ["ply", f"format {coding} 1.0", *([f"comment {comment}"] if comment else [])]
    lines += [f"element vertex {len(next(iter(columns.values())))}"]
    lines += [f"property float {name}" for name in columns]
    head = "\n".join([*lines, "end_header\n"]).encode()
    rows = np.stack(list(columns.values()), 1)
    if coding == "ascii":
        return head + "".join(" ".join(map(repr, row)) + "\n" for row in rows.tolist()).encode()
    return head + rows.astype("<f4" if coding == "binary_little_endian" else ">f4").tobytes()


def ply(splats: Content, coding: str = "binary_little_endian") -> bytes:
    return table(ply_columns(splats), coding)


def compressed_ply(splats: Content) -> bytes:
    """SuperSplat's: least and largest of 256 splats, and shares between them."""
    rgb = 0.5 + SH_0 * splats.harmonics[:, 0]
    names = ["x", "y", "z", "scale_x", "scale_y", "scale_z", "r", "g", "b"]
    values = np.concatenate([splats.centres, np.log(splats.scales), rgb], 1)
    starts = range(0, len(splats), 256)
    low = np.array([values[i : i + 256].min(0) for i in starts], np.float32)
    high = np.array([values[i : i + 256].max(0) for i in starts], np.float32)
    chunk = np.arange(len(splats)) // 256
    shares = (values - low[chunk]) / np.where(high > low, high - low, 1)[chunk]

    def pack(columns, widths):
        total = np.zeros(len(splats), np.uint32)
        for share, width in zip(np.transpose(columns), widths, strict=True):
            total = total << np.uint32(width) | np.round(share * (2**width - 1)).astype(np.uint32)
        return total

    largest = np.abs(splats.rotations).argmax(1)
    others = np.array(
        [np.delete(q * np.sign(q[i]), i) for q, i in zip(splats.rotations, largest, strict=True)]
    )
    turns = pack(others / np.sqrt(2) + 0.5, (10, 10, 10)) | (largest << 30).astype(np.uint32)
    colours = np.concatenate([shares[:, 6:], splats.opacities[:, None]], 1)
    vertices = [
        *(pack(shares[:, :3], (11, 10, 11)), turns),
        *(pack(shares[:, 3:6], (11, 10, 11)), pack(colours, (8, 8, 8, 8))),
    ]
    rest = splats.rest.transpose(0, 2, 1).reshape(len(splats), -1)
    lines = ["ply", "format binary_little_endian 1.0", f"element chunk {len(low)}"]
    lines += [f"property float {side}_{name}" for side in ("min", "max") for name in names]
    lines += [f"element vertex {len(splats)}"]
    lines += [f"property uint packed_{name}" for name in ("position", "rotation", "scale", "color")]
    if rest.shape[1]:
        lines += [f"element sh {len(splats)}"]
        lines += [f"property uchar f_rest_{i}" for i in range(rest.shape[1])]
    parts = [
        np.concatenate([low, high], 1).astype("<f4"),
        np.stack(vertices, 1).astype("<u4"),
        np.clip(np.floor((rest / 8 + 0.5) * 256), 0, 255).astype(np.uint8),
    ]
    return "\n".join([*lines, "end_header\n"]).encode() + b"".join(part.tobytes() for part in parts)


# --- .splat and .ksplat -------------------------------------------------------------------------------------


def splat(splats: Content) -> bytes:
    """32 bytes each; colours of degree 0."""
    numbers = np.concatenate([splats.centres, splats.scales], 1).astype("<f4").tobytes()
    turns = to_bytes(splats.rotations * 128 + 128)
    colours = splats.bytes_of_colours
    return b"".join(
        numbers[24 * i : 24 * i + 24] + colours[i].tobytes() + turns[i].tobytes() for i in range(len(splats))
    )


def ksplat(splats: Content, level: int = 0, bucket: int = 2, block: float = 40.0) -> bytes:
    """Two sections; buckets are of `bucket` splats each about their mean, the last one has fewer."""
    cuts = [0, len(splats) // 2, len(splats)]
    sections = [_ksplat_section(splats, slice(*cuts[i : i + 2]), level, bucket, block) for i in range(2)]
    head = struct.pack("<BBHIIIIHHfff", 0, 1, 0, 2, 2, len(splats), len(splats), level, 0, 0, 0, 0)
    head += struct.pack("<ff", -1.0, 1.0)
    parts = [head.ljust(4096, b"\0"), *(each[0].ljust(1024, b"\0") for each in sections)]
    return b"".join(parts) + b"".join(each[1] for each in sections)


def _ksplat_section(splats: Content, part: slice, level: int, bucket: int, block: float) -> tuple:
    centres = splats.centres[part]
    count, half = len(centres), 32767
    groups = [centres[i : i + bucket] for i in range(0, count, bucket)] if level else []
    full = sum(len(group) == bucket for group in groups)
    sizes = [len(group) for group in groups[full:]]
    middles = np.array([group.mean(0) for group in groups], np.float32).reshape(-1, 3)
    data = np.array(sizes, "<u4").tobytes() + middles.astype("<f4").tobytes()
    degree = {1: 0, 4: 1, 9: 2, 16: 3}[splats.harmonics.shape[1]]
    for row in range(count):
        i = part.start + row
        if level:
            offset = (centres[row] - middles[row // bucket]) / (block / 2) * half
            data += np.clip(np.round(offset) + half, 0, 2 * half + 1).astype("<u2").tobytes()
        else:
            data += centres[row].astype("<f4").tobytes()
        kind = "<f2" if level else "<f4"
        data += splats.scales[i].astype(kind).tobytes() + splats.rotations[i].astype(kind).tobytes()
        data += splats.bytes_of_colours[i].tobytes()
        for band in range(1, degree + 1):  # a degree at a time, in it a colour at a time
            values = splats.harmonics[i, band**2 : (band + 1) ** 2].T
            if level == 2:
                data += to_bytes((values + 1) / 2 * 255).tobytes()
            else:
                data += values.astype(kind).tobytes()
    head = struct.pack("<IIIIfHHI", count, count, bucket if level else 0, len(groups), block, 12, 0, 0)
    return head + struct.pack("<IIIH", len(data), full, len(sizes), degree), data


# --- .spz ---------------------------------------------------------------------------------------------------


def spz_streams(splats: Content, version: int, fraction: int = 12, turned: bool = True) -> list[bytes]:
    """Positions, alphas, colours, scales, rotations, harmonics, with the axes right, up, back."""
    axes = RIGHT_UP_BACK if turned else np.ones(3)
    flips = np.ones(splats.rest.shape[1])
    flips[:15] = SH_FLIPS[: len(flips)] if turned else 1
    if version == 1:
        positions = (splats.centres * axes).astype("<f2").tobytes()
    else:
        fixed = np.round(splats.centres * axes * 2**fraction).astype("<i4")
        positions = fixed.reshape(-1, 1).view(np.uint8)[:, :3].tobytes()
    xyzw = np.roll(splats.rotations, -1, axis=1) * [*axes, 1]
    return [
        positions,
        to_bytes(splats.opacities * 255).tobytes(),
        to_bytes((splats.harmonics[:, 0] * 0.15 + 0.5) * 255).tobytes(),
        to_bytes((np.log(splats.scales) + 10) * 16).tobytes(),
        b"".join(_spz_rotation(q, version) for q in xyzw),
        to_bytes(splats.rest * flips[:, None] * 128 + 128).tobytes(),
    ]


def _spz_rotation(q: np.ndarray, version: int) -> bytes:
    if version < 3:
        return to_bytes(q[:3] * np.sign(q[3]) * 127.5 + 127.5).tobytes()
    largest = int(np.abs(q).argmax())
    q, total = q * np.sign(q[largest]), largest
    for i in range(4):
        if i != largest:
            total = total << 10 | (q[i] < 0) << 9 | int(511 * abs(q[i]) / np.sqrt(0.5) + 0.5)
    return struct.pack("<I", total)


def spz_header(splats: Content, version: int, flags: int = 0, last: int = 0, fraction: int = 12) -> bytes:
    degree = {1: 0, 4: 1, 9: 2, 16: 3, 25: 4}[splats.harmonics.shape[1]]
    return struct.pack("<4sIIBBBB", b"NGSP", version, len(splats), degree, fraction, flags, last)


def spz(splats: Content, version: int = 3, turned: bool = True) -> bytes:
    streams = spz_streams(splats, version, turned=turned)
    if version < 4:
        return gzip.compress(spz_header(splats, version) + b"".join(streams), mtime=0)
    return spz_container(splats, [stream for stream in streams if stream])


def spz_container(splats: Content, streams: list[bytes], extensions: bytes = b"") -> bytes:
    """Version 4."""
    packed = [zstd.compress(stream) for stream in streams]
    head = spz_header(splats, 4, flags=2 if extensions else 0, last=len(streams))
    head += struct.pack("<I", 32 + len(extensions)) + bytes(12) + extensions
    sizes = [struct.pack("<QQ", len(p), len(s)) for p, s in zip(packed, streams, strict=True)]
    return head + b"".join(sizes) + b"".join(packed)


# --- SOG ----------------------------------------------------------------------------------------------------


def webp(pixels: np.ndarray, width: int | None = None) -> bytes:
    """(N, 3 or 4) pixels in rows of `width`."""
    width = width or 4
    rows = np.concatenate([pixels, np.zeros((-len(pixels) % width, pixels.shape[1]), np.uint8)])
    out = io.BytesIO()
    Image.fromarray(rows.reshape(-1, width, pixels.shape[1])).save(out, "WEBP", lossless=True, exact=True)
    return out.getvalue()


def sog_files(splats: Content, version: int = 2) -> dict[str, bytes]:
    """meta.json and its pictures."""
    logs = np.sign(splats.centres) * np.log1p(np.abs(splats.centres))
    mins, maxs = logs.min(0), logs.max(0)
    fixed = np.round((logs - mins) / (maxs - mins) * 65535).astype(int)
    meta = {"means": {"mins": mins.tolist(), "maxs": maxs.tolist(), "files": ["l.webp", "u.webp"]}}
    files = {"l.webp": webp((fixed & 255).astype(np.uint8)), "u.webp": webp((fixed >> 8).astype(np.uint8))}
    largest = np.abs(splats.rotations).argmax(1)
    others = np.array(
        [np.delete(q * np.sign(q[i]), i) for q, i in zip(splats.rotations, largest, strict=True)]
    )
    turns = np.concatenate([to_bytes((others * np.sqrt(2) + 1) / 2 * 255), 252 + largest[:, None]], 1)
    files["q.webp"] = webp(turns.astype(np.uint8))
    meta["quats"] = {"files": ["q.webp"]}
    colours, opacities = splats.harmonics[:, 0], splats.opacities
    scales = np.log(splats.scales)
    if version == 1:
        meta["means"]["shape"] = [len(splats), 3]
        values = np.concatenate([colours, logit(opacities)[:, None]], 1)
    else:
        meta |= {"version": 2, "count": len(splats)}
        values = np.concatenate([colours, opacities[:, None]], 1)
    meta["scales"], files["s.webp"] = _sog_values(scales, "s.webp", version)
    meta["sh0"], files["c.webp"] = _sog_values(values, "c.webp", version)
    if splats.rest.size:
        meta["shN"], palette, labels = _sog_rest(splats.rest, version)
        files |= {"p.webp": palette, "n.webp": labels}
    return {"meta.json": json.dumps(meta).encode()} | files


def _sog_values(values: np.ndarray, name: str, version: int) -> tuple[dict, bytes]:
    """Three columns through a codebook and the fourth as it is, or all through ranges (version 1)."""
    if version == 1:
        low, high = values.min(0), values.max(0)
        picture = to_bytes((values - low) / (high - low) * 255)
        return {"mins": low.tolist(), "maxs": high.tolist(), "files": [name]}, webp(picture)
    book = np.linspace(values[:, :3].min(), values[:, :3].max(), 256)
    picture = np.abs(values[:, :3, None] - book).argmin(2).astype(np.uint8)
    picture = np.concatenate([picture, to_bytes(values[:, 3:] * 255)], 1)
    return {"codebook": book.tolist(), "files": [name]}, webp(picture)


def _sog_rest(rest: np.ndarray, version: int) -> tuple[dict, bytes, bytes]:
    """A palette with an entry for each splat, from its end to its beginning."""
    count, width = rest.shape[:2]
    book = np.linspace(rest.min(), rest.max(), 256)
    picture = np.zeros((-(-count // 64) * 64, width, 3), np.uint8)
    picture[:count] = np.abs(rest[::-1, :, :, None] - book).argmin(3)
    labels = np.arange(count)[::-1]
    labels = np.stack([labels & 255, labels >> 8, 0 * labels], 1).astype(np.uint8)
    meta = {"files": ["p.webp", "n.webp"]}
    if version == 1:
        meta |= {"mins": float(book[0]), "maxs": float(book[-1])}
    else:
        meta |= {"count": count, "bands": {3: 1, 8: 2, 15: 3}[width], "codebook": book.tolist()}
    return meta, webp(picture.reshape(-1, 3), 64 * width), webp(labels)


def zipped(files: dict[str, bytes]) -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as pack:
        for name, data in files.items():
            pack.writestr(zipfile.ZipInfo(name), data)
    return out.getvalue()


def sog(splats: Content, version: int = 2) -> bytes:
    return zipped(sog_files(splats, version))


# --- glTF ---------------------------------------------------------------------------------------------------


def gltf(splats: Content, **node) -> Gltf:
    """One primitive of splats, at a node."""
    made = Gltf()
    made.doc["nodes"][0] |= node
    made.doc["extensionsUsed"] = ["KHR_gaussian_splatting"]
    arrays = {
        "SCALE": splats.scales,
        "ROTATION": np.roll(splats.rotations, -1, axis=1),
        "OPACITY": splats.opacities,
    }
    for degree in range(4):
        for n, k in enumerate(range(degree**2, min((degree + 1) ** 2, splats.harmonics.shape[1]))):
            arrays[f"SH_DEGREE_{degree}_COEF_{n}"] = splats.harmonics[:, k]
    attributes = {"POSITION": made.accessor(splats.centres.astype(np.float32))}
    for name, array in arrays.items():
        attributes[f"KHR_gaussian_splatting:{name}"] = made.accessor(array.astype(np.float32))
    extension = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    primitive = {"attributes": attributes, "mode": 0, "extensions": {"KHR_gaussian_splatting": extension}}
    made.doc["meshes"] = [{"primitives": [primitive]}]
    made.primitive = primitive
    return made


def gltf_of_spz(splats: Content, name: str = "KHR_gaussian_splatting_compression_spz_2", **node) -> Gltf:
    """One primitive whose splats are an .spz with the primitive's own axes."""
    made = gltf(splats, **node)
    packed = {name: {"bufferView": made.view(spz(splats, 3, turned=False))}}
    made.primitive["extensions"] = {"KHR_gaussian_splatting": {"extensions": packed}}
    made.doc["extensionsRequired"] = ["KHR_gaussian_splatting", name]
    return made


def glb(splats: Content) -> bytes:
    """With glTF's axes, which are left, up, front: a .ply's turned by 180 degrees about z."""
    w, x, y, z = splats.rotations.T
    signs = np.array([1, -1, 1, -1, 1, -1, 1, -1, 1, -1, 1, -1, 1, -1, 1, -1])
    turned = Content(
        splats.centres * [-1, -1, 1],
        splats.scales,
        np.stack([-z, -y, x, w], 1),
        splats.opacities,
        splats.harmonics * signs[: splats.harmonics.shape[1], None],
    )
    return as_glb(gltf(turned))


def as_glb(made: Gltf) -> bytes:
    text = json.dumps(made.doc | {"buffers": [{"byteLength": len(made.blob)}]}).encode()
    return glb_of(text, made.blob)


def glb_of(text: bytes, blob: bytes) -> bytes:
    """A .glb of JSON and its binary chunk."""
    text, blob = text + b" " * (-len(text) % 4), blob + bytes(-len(blob) % 4)
    heads = struct.pack("<II", len(text), 0x4E4F534A), struct.pack("<II", len(blob), 0x004E4942)
    chunks = heads[0] + text + heads[1] + blob
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def written(path: Path, data: bytes) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)
    return path
