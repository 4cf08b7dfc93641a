"""A reader of bundles written from formats/SPEC.md alone: numpy, no code of the project.

Slow and plain; it answers points, one field at a time. Numbers in brackets are sections of the specification.
"""

import itertools
import json
import zipfile
from pathlib import Path

import numpy as np

CORNERS = np.array(list(itertools.product((0, 1), repeat=3)))
MODES = ((0, 1, 2), (0, 2, 1), (1, 2, 0))
TYPES = {"F16": np.float16, "F32": np.float32, "U8": np.uint8, "I32": np.int32}


def open_bundle(path: Path) -> tuple[dict, dict]:
    """The scene graph and the fields (kind, metadata, arrays) by member's name."""
    with zipfile.ZipFile(path) as archive:
        scene = json.loads(archive.read("scene.json"))
        fields = {n: field_of(archive.read(n)) for n in archive.namelist() if n != "scene.json"}
    for _, metadata, arrays in fields.values():  # 2.2
        for part, member in metadata.get("shared", {}).items():
            arrays |= {f"{part}.{name}": values for name, values in fields[member][2].items()}
    return scene, fields


def field_of(data: bytes) -> tuple[str, dict, dict]:
    """Section 2 and 2.1: kind, metadata and arrays, codes decoded."""
    length = int.from_bytes(data[:8], "little")
    header, body = json.loads(data[8 : 8 + length]), data[8 + length :]
    told = json.loads(header.pop("__metadata__")["fusedrf"])
    arrays = {
        name: np.frombuffer(body[slice(*at["data_offsets"])], TYPES[at["dtype"]]).reshape(at["shape"])
        for name, at in header.items()
    }
    for name, coded in told.get("coded", {}).items():
        runs = arrays[f"{name}.runs"] if coded.get("runs") else None
        scales, codes = arrays.pop(f"{name}.scales"), arrays.pop(f"{name}.codes")
        arrays[name] = decoded(coded["bits"], tuple(coded["shape"]), scales, codes, runs)
    return told["kind"], told["metadata"], arrays


def decoded(bits: int, shape: tuple, scales: np.ndarray, codes: np.ndarray, runs) -> np.ndarray:
    """2.1: float32 numbers of an array of codes."""
    scale = np.zeros(shape, np.float32)
    if len(shape) == 3:
        for i, j in np.ndindex(scales.shape[:2]):
            scale[8 * i : 8 * i + 8, 8 * j : 8 * j + 8] = scales[i, j]
    else:
        row = block = 0
        for run in runs if runs is not None else [shape[0]]:
            for start in range(0, int(run), 64):
                end = min(start + 64, int(run))
                scale[row + start : row + end] = scales[block]
                block += 1
            row += int(run)
    if bits == 4:
        codes = np.stack([codes & 15, codes >> 4], 1).ravel()
    number = np.zeros(shape, np.float32)
    number[scale > 0] = codes[: np.count_nonzero(scale)].astype(np.float32) - (128 if bits == 8 else 8)
    return scale * number / np.float32(127 if bits == 8 else 7)


def contract(x: np.ndarray, d: np.ndarray, space: str | dict) -> tuple[np.ndarray, np.ndarray]:
    """2.3: coordinates (N, 3) of points, and rho (N,) along d (N, 3)."""
    constants = dict(space) if isinstance(space, dict) else {"name": space}
    name = constants.pop("name")
    if name == "bounded":
        return x, np.ones(len(x))
    if name == "ndc":
        scales = np.array([constants.get("scale_x", 1.0), constants.get("scale_y", 1.0)])

        def coordinates(x: np.ndarray) -> np.ndarray:
            return np.concatenate([scales * x[:, :2], -x[:, 2:] - 2], 1) / -x[:, 2:]

        return coordinates(x), moved(coordinates, x, d)
    if name != "unbounded":
        shell, order = constants.get("shell", 1.0), {"contracted_l2": 2, "contracted_linf": np.inf}[name]

        def coordinates(x: np.ndarray) -> np.ndarray:
            x = x * [constants.get(f"stretch_{axis}", 1.0) for axis in "xyz"]
            n = np.maximum(np.linalg.norm(x, order, 1, keepdims=True), 1)
            return np.where(n > 1, (1 + shell - shell / n) * x / n, x)

        per_y, n = constants.get("contracted_density", 0.0), np.linalg.norm(x, axis=1)
        if per_y == 2:
            units = [constants.get(f"unit_{axis}", 1.0) for axis in "xyz"]
            length = np.linalg.norm(units * d, axis=1)
            return coordinates(x), length * np.where(n > 1, shell * np.maximum((x * d).sum(1), 0) / n**3, 0)
        return coordinates(x), moved(coordinates, x, d) if per_y else np.ones(len(x))
    n = np.abs(x).max(1)
    far, axis = n > 1, np.abs(x).argmax(1)
    y = np.where(far[:, None], x / np.maximum(n, 1)[:, None], x)
    rows = np.flatnonzero(far)
    y[rows, axis[rows]] = np.sign(x[rows, axis[rows]]) * (2 - 1 / n[rows])
    return y, np.where(far, 1 / np.maximum(n, 1) ** 2, 1)


def moved(coordinates, x: np.ndarray, d: np.ndarray) -> np.ndarray:
    """(N,) the length of the derivative of coordinates along d, by differences."""
    step = 1e-5 * np.abs(x).max(1, keepdims=True)
    change = coordinates(x + step * d) - coordinates(x - step * d)
    return np.linalg.norm(change, axis=1) / (2 * step[:, 0])


def harmonics(count: int, d: np.ndarray) -> np.ndarray:
    """2.6: (N, count)."""
    x, y, z = d.T
    values = [
        0.28209479177387814 + 0 * x,
        *(0.4886025119029199 * v for v in (-y, z, -x)),
        1.0925484305920792 * x * y, -1.0925484305920792 * y * z,
        0.31539156525252005 * (2 * z**2 - x**2 - y**2), -1.0925484305920792 * x * z,
        0.5462742152960396 * (x**2 - y**2), -0.5900435899266435 * y * (3 * x**2 - y**2),
        2.890611442640554 * x * y * z, -0.4570457994644658 * y * (4 * z**2 - x**2 - y**2),
        0.3731763325901154 * z * (2 * z**2 - 3 * x**2 - 3 * y**2),
        -0.4570457994644658 * x * (4 * z**2 - x**2 - y**2), 1.445305721320277 * z * (x**2 - y**2),
        -0.5900435899266435 * x * (x**2 - 3 * y**2),
    ]  # fmt: skip
    return np.stack(values[:count], 1)


def lin(grid: np.ndarray, unit: np.ndarray) -> np.ndarray:
    """(N, R) values of a grid (n_1, .., n_D, R) between its texels at unit coordinates (N, D)."""
    total = 0.0
    at = unit * (np.array(grid.shape[:-1]) - 1)
    low = np.clip(np.floor(at).astype(int), 0, np.array(grid.shape[:-1]) - 2)
    for corner in itertools.product((0, 1), repeat=unit.shape[1]):
        weight = np.where(corner, at - low, 1 - (at - low)).prod(1)
        total = total + weight[:, None] * grid[tuple((low + corner).T)]
    return total


def logistic(v: np.ndarray) -> np.ndarray:
    return 1 / (1 + np.exp(-v))


def cells_of(arrays: dict, name: str, counts: list[int]) -> np.ndarray:
    """2.5 and 2.6: (X, Y, Z) bool."""
    size = int(np.prod(counts))
    if name in arrays:
        return np.unpackbits(arrays[name])[:size].reshape(counts).astype(bool)
    bricks = [-(-n // 4) for n in counts]
    count = int(np.prod(bricks))
    bits = np.unpackbits(arrays[f"{name}.bricks"])
    some, full = bits[:count].astype(bool), bits[count : 2 * count].astype(bool)
    inner = np.zeros((count, 64), bool)
    inner[full] = True
    inner[some & ~full] = np.unpackbits(arrays[f"{name}.mixed"], axis=1)
    grid = inner.reshape(*bricks, 4, 4, 4).transpose(0, 3, 1, 4, 2, 5).reshape([4 * n for n in bricks])
    return grid[: counts[0], : counts[1], : counts[2]]


def occupied(cells: np.ndarray, box: np.ndarray, y: np.ndarray) -> np.ndarray:
    """(N,) whether points lie in an occupied cell."""
    index = np.floor((y - box[:3]) / (box[3:] - box[:3]) * cells.shape).astype(int)
    inside = ((index >= 0) & (index < cells.shape)).all(1)
    index = np.clip(index, 0, np.array(cells.shape) - 1)
    return inside & cells[tuple(index.T)]


def density(f: np.ndarray, told: dict) -> np.ndarray:
    return told["scale"] * np.logaddexp(0, f + told.get("shift", 0.0))


def answer(field: tuple, x: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """σ (N,) and rgb (N, 3) of a field at points (N, 3) of its frame along unit directions (N, 3)."""
    kind, told, arrays = field
    if kind in ("vm", "vm-mlp"):
        return of_tensors(kind, told, arrays, x, d)
    if kind == "sparse":
        return of_bricks(told, arrays, x, d)
    if kind in ("hash", "planes", "mlp"):
        return of_networks(kind, told, arrays, x, d)
    return of_grid(kind, told, arrays, x, d)


def of_grid(kind: str, told: dict, arrays: dict, x: np.ndarray, d: np.ndarray):
    """2.6: `cp`, `dense` and `dense-mlp`."""
    box, cells = np.array(told["aabb"]), told["cells"]
    y, rho = contract(x, d, cells.get("space", "bounded"))
    unit = (y - box[:3]) / (box[3:] - box[:3])
    grid = cells_of(arrays, "occupancy", cells["counts"])
    here = occupied(grid, np.array(cells["aabb"]), y) & ((unit >= 0) & (unit <= 1)).all(1)
    unit = np.clip(unit, 0, 1)
    shape = told["shape"]
    if kind == "cp":
        products = {
            what: np.prod([lin(arrays[f"{what}_line_{a}"], unit[:, a : a + 1]) for a in range(3)], 0)
            for what in ("density", "colour")
        }
        f, basis = products["density"].sum(1), arrays["colour_basis"]
        shown = harmonics(basis.shape[1], d)
        rgb = np.einsum("nk,ckq,nq->nc", shown, basis, products["colour"])
    else:
        used = used_vertices(grid, np.array(cells["aabb"]), box, told["resolution"])
        whole = {}
        for name in ("density", "colour"):
            stored = arrays[name].reshape(used.sum(), -1)
            whole[name] = np.zeros((*used.shape, stored.shape[1]))
            whole[name][used] = stored
        f, rows = lin(whole["density"], unit)[:, 0], lin(whole["colour"], unit)
        if kind == "dense":
            count = (shape["sh_degree"] + 1) ** 2
            rgb = (rows.reshape(-1, 3, count) * harmonics(count, d)[:, None]).sum(2)
        else:
            inner = np.concatenate([rows, harmonics(16, d)], 1)
            inner = np.maximum(inner @ arrays["decoder.hidden.weight"] + arrays["decoder.hidden.bias"], 0)
            rgb = (inner @ arrays["decoder.out.weight"] + arrays["decoder.out.bias"])[:, :3]
    return np.where(here, rho * density(f, told), 0), logistic(rgb)


def of_networks(kind: str, told: dict, arrays: dict, x: np.ndarray, d: np.ndarray):
    """2.6: `hash`, `planes` and `mlp`."""
    box, cells, shape = np.array(told["aabb"]), told["cells"], told["shape"]
    y, rho = contract(x, d, cells.get("space", "bounded"))
    here = occupied(cells_of(arrays, "occupancy", cells["counts"]), np.array(cells["aabb"]), y)
    if kind == "hash":
        u = (y - box[:3]) / (box[3:] - box[:3]).max()
        features = hashed_levels(shape, told["resolution"], arrays, u)
    elif kind == "planes":
        u = (y - box[:3]) / (box[3:] - box[:3])
        here, u = here & ((u >= 0) & (u <= 1)).all(1), np.clip(u, 0, 1)
        features = levels_of_planes(shape, told["resolution"], arrays, u)
    if kind != "mlp":
        weights = arrays["sigma_weights"]
        f = features @ weights[:-1] + weights[-1]
    else:
        at = 2 * (y - box[:3]) / (box[3:] - box[:3]) - 1
        waves = [wave(2**level * at) for level in range(shape["count"]) for wave in (np.sin, np.cos)]
        read = np.concatenate([at, *waves], 1)
        read = np.pad(read, ((0, 0), (0, -read.shape[1] % 8)))
        features = read
        for i in range(shape["layers"] + 1):
            layer = arrays[f"sigma_layer_{i}"]
            features = features @ layer[:-1] + layer[-1]
            if i and i == shape["skip"]:
                features = features + read @ arrays["sigma_again"]
            features = np.maximum(features, 0) if i < shape["layers"] else features
        f = features[:, 0]
    inner = np.concatenate([features, harmonics(16, d)], 1)
    inner = np.maximum(inner @ arrays["rgb_hidden.weight"] + arrays["rgb_hidden.bias"], 0)
    rgb = (inner @ arrays["rgb_out.weight"] + arrays["rgb_out.bias"])[:, :3]
    return np.where(here, rho * density(f, told), 0), logistic(rgb)


def levels_of_planes(shape: dict, resolution: list[int], arrays: dict, u: np.ndarray) -> np.ndarray:
    """2.6: the features of `planes` of a `planes` field."""
    levels = []
    for level in range(shape["levels"]):
        product = np.ones((len(u), shape["features"]))
        for m, pair in enumerate(([0, 1], [0, 2], [1, 2])):
            plane = arrays[f"density_plane_{level}_{m}"]
            assert plane.shape[:2] == tuple(max(2, -(-resolution[a] // 2**level)) for a in pair)
            product = product * lin(plane, u[:, pair])
        levels.append(product)
    return np.concatenate(levels, 1)


def hashed_levels(shape: dict, resolution: list[int], arrays: dict, u: np.ndarray) -> np.ndarray:
    """2.6: the features of a `hash_grid` of a `hash` field."""
    count, found, first = shape["levels"], [], 0
    scales = [16 * (shape["finest"] / 16) ** (level / max(count - 1, 1)) - 1 for level in range(count)]
    sides = [int(np.ceil(s)) + 1 for s in scales]
    numbers = [min(-(-(side**3) // 8) * 8, 2 ** shape["log2_rows"]) for side in sides]
    rows = all_rows(arrays, "density_rows", sum(numbers))
    for level, (s, side, number) in enumerate(zip(scales, sides, numbers, strict=True)):
        features = np.zeros((len(u), shape["features"]))
        if level == 0 or s <= 2 * max(resolution):
            low = np.floor(s * u + 0.5).astype(int)
            for corner in np.ndindex(2, 2, 2):
                i, j, k = (low + corner).T
                row = (k * side + j) * side + i
                if side**3 > number:
                    row = i ^ (j * 2654435761) ^ (k * 805459861)
                share = np.where(corner, s * u + 0.5 - low, 1 - (s * u + 0.5 - low)).prod(1)
                features += share[:, None] * rows[first + row % number]
        found.append(features)
        first += number
    features = np.concatenate(found, 1)
    return np.pad(features, ((0, 0), (0, -features.shape[1] % 8)))


def used_vertices(cells: np.ndarray, cells_box: np.ndarray, box: np.ndarray, resolution) -> np.ndarray:
    """2.6: (nx, ny, nz) bool."""
    side = (cells_box[3:] - cells_box[:3]) / cells.shape
    used = np.zeros(resolution, bool)
    for vertex in np.ndindex(*resolution):
        voxel = (box[3:] - box[:3]) / (np.array(resolution) - 1)
        p = box[:3] + vertex * voxel
        low = np.floor((p - voxel - cells_box[:3]) / side).astype(int)
        high = np.floor((p + voxel - cells_box[:3]) / side).astype(int) + 1
        run = tuple(slice(max(a, 0), max(b, 0)) for a, b in zip(low, high, strict=True))
        used[vertex] = cells[run].any()
    return used


def of_tensors(kind: str, told: dict, arrays: dict, x: np.ndarray, d: np.ndarray):
    """2.6: `vm` and `vm-mlp`; the densest block answers."""
    best, rgb = np.zeros(len(x)), np.zeros((len(x), 3))
    for block in told["blocks"]:
        t, inverse = block["tensor"], np.linalg.inv(np.array(block["object_to_field"]))
        tensor = told["tensors"][t]
        own = {n.split(".", 1)[1]: a for n, a in arrays.items() if n.startswith(f"tensor_{t}.")}
        v = d @ inverse[:3, :3].T
        stretch = np.linalg.norm(v, axis=1)
        own_x, own_d = x @ inverse[:3, :3].T + inverse[:3, 3], v / stretch[:, None]
        y, rho = contract(own_x, own_d, tensor.get("space", "bounded"))
        box = np.array(tensor["aabb"])
        here = occupied(cells_of(own, "occupancy", tensor["occupancy"]), box, y)
        unit = np.clip((y - box[:3]) / (box[3:] - box[:3]), 0, 1)
        f, added = products(own, "density", unit).sum(1), np.zeros((len(x), 4))
        if "hashed" in tensor:
            asked = f + tensor["shift"] > -6
            added = np.where(asked[:, None], detail(own, tensor["hashed"], y), 0)
        sigma = np.where(here, stretch * rho * density(f + added[:, 0], tensor), 0)
        colours = products(own, "colour", unit)
        direction = v / stretch[:, None]
        if kind == "vm":
            shown = harmonics(own["colour_basis"].shape[1], direction)
            logits = np.einsum("nk,ckq,nq->nc", shown, own["colour_basis"], colours) + added[:, 1:]
            colour = logistic(logits) * block.get("tint", [1, 1, 1])
        else:
            basis = own["colour_basis"].reshape(27, -1)
            colour = network(arrays, np.concatenate([colours @ basis.T, direction], 1))
        wins = sigma > best
        best, rgb = np.where(wins, sigma, best), np.where(wins[:, None], colour, rgb)
    return best, rgb


def products(own: dict, what: str, unit: np.ndarray) -> np.ndarray:
    """(N, 3 R) products of planes and lines, mode after mode."""
    return np.concatenate(
        [
            lin(own[f"{what}_plane_{m}"], unit[:, [a, b]]) * lin(own[f"{what}_line_{m}"], unit[:, [c]])
            for m, (a, b, c) in enumerate(MODES)
        ],
        1,
    )


def network(arrays: dict, u: np.ndarray) -> np.ndarray:
    """2.6: `vm-mlp`."""
    i = np.concatenate([u, np.sin(u), np.sin(2 * u), np.cos(u), np.cos(2 * u)], 1)
    for layer in range(3):
        i = i @ arrays[f"network.{layer}.weight"].T + arrays[f"network.{layer}.bias"]
        i = np.maximum(i, 0) if layer < 2 else logistic(i)
    return i


def all_rows(own: dict, name: str, count: int) -> np.ndarray:
    """2.5: (count, ·) the rows of a hash grid, of which a file may hold few."""
    if f"{name}_blocks" not in own:
        return own[name]
    blocks = -(-count // 64)
    some = np.unpackbits(own[f"{name}_blocks"])[:blocks].astype(bool)
    held = np.zeros((blocks, 16), bool)
    held[some] = np.unpackbits(own[f"{name}_held"], axis=1)
    whole = np.zeros((count, own[name].shape[1]))
    whole[np.repeat(held.ravel(), 4)[:count]] = own[name]
    return whole


def detail(own: dict, hashed: dict, y: np.ndarray) -> np.ndarray:
    """2.4 and 2.5: (N, 4)."""
    rows, total = hashed["rows"], np.zeros((len(y), 4))
    whole = all_rows(own, "detail", len(hashed["spacings"]) * rows)
    for level, h in enumerate(hashed["spacings"]):
        low = np.floor(y / h).astype(np.int64)
        for corner in CORNERS:
            i, j, k = (low + corner).T
            weight = np.where(corner, y / h - low, 1 - (y / h - low)).prod(1)
            run, k4 = np.floor_divide(k, 4), np.mod(k, 4)
            with np.errstate(over="ignore"):
                q = (i * 2654435761) ^ (j * 805459861) ^ (run * 3674653429)
            row = rows * level + 4 * ((q ^ (q >> 15)) % (rows // 4)) + k4
            total += weight[:, None] * whole[row]
    return total


class Bricks:
    """2.6: the tree of a `sparse` field, and its vertices by their places in units of 1/512 of a top cell."""

    def __init__(self, told: dict, arrays: dict):
        self.told = told
        bits = np.unpackbits(arrays["nodes"]).reshape(-1, 2)
        codes = iter((2 * bits[:, 0] + bits[:, 1]).tolist())
        nodes, side, bricks = [np.array(c) * 512 for c in np.ndindex(*told["counts"])], 512, []
        while nodes:
            split = []
            for low in nodes:
                code = next(codes)
                if code == 1:
                    bricks.append((low, side))
                elif code == 2:
                    split.append(low)
            side //= 2
            nodes = [low + side * c for low in split for c in CORNERS]
        masks = np.unpackbits(arrays["masks"]).reshape(-1, 4, 4, 4).astype(bool)
        self.bricks = list(zip(bricks, masks, strict=True))

    def voxels(self, n: int) -> dict:
        """Active voxels, n along a brick: (lower corner, side) by nothing else."""
        found = {}
        for (low, side), mask in self.bricks:
            m = 4 // n
            wide = mask.reshape(n, m, n, m, n, m).any((1, 3, 5))
            for v in np.argwhere(wide):
                corner = low + v * (side // n)
                found[tuple(int(c) for c in corner), side // n] = True
        return found

    def rows(self, stored: np.ndarray, n: int) -> tuple[dict, dict]:
        """Active voxels, and the numbers of their vertices by place."""
        voxels = self.voxels(n)
        vertices = sorted({tuple((np.array(low) + w * c).tolist()) for low, w in voxels for c in CORNERS})
        holder = {v: self.holder(v, voxels) for v in vertices}
        free = [v for v in vertices if holder[v] is None]
        free.sort(key=lambda v: interleaved(np.array(v) + 512 * np.array(self.told["phase"])))
        numbers = dict(zip(free, stored.astype(np.float64), strict=True))
        for v in sorted((v for v in vertices if holder[v]), key=lambda v: -holder[v][1]):
            numbers[v] = between(numbers, *holder[v], np.array(v, float))
        return voxels, numbers

    @staticmethod
    def holder(vertex: tuple, voxels: dict):
        """The widest active voxel on whose face or edge a vertex hangs; None of a free one."""
        widths = sorted({w for _, w in voxels}, reverse=True)
        for w in widths:
            for c in CORNERS:
                low = tuple(int((p - o) // w * w) for p, o in zip(vertex, c, strict=True))
                inside = all(a <= p <= a + w for a, p in zip(low, vertex, strict=True))
                if inside and (low, w) in voxels:
                    corner = all((p - a) % w == 0 for a, p in zip(low, vertex, strict=True))
                    return None if corner else (low, w)
        return None


def interleaved(q: np.ndarray) -> int:
    """The bits of three whole numbers, x the highest of three."""
    total = 0
    for bit in range(24):
        for axis in range(3):
            total |= (int(q[axis]) >> bit & 1) << (3 * bit + 2 - axis)
    return total


def between(numbers: dict, low: tuple, side: int, at: np.ndarray) -> np.ndarray:
    """Trilinear interpolation in a voxel."""
    share = (at - low) / side
    total = 0.0
    for c in CORNERS:
        weight = np.where(c, share, 1 - share).prod()
        if weight:
            total = total + weight * numbers[tuple((np.array(low) + side * c).tolist())]
    return total


def of_bricks(told: dict, arrays: dict, x: np.ndarray, d: np.ndarray):
    """2.6: `sparse`."""
    y, rho = contract(x, d, told.get("space", "bounded"))
    units = (y - np.array(told["aabb"])[:3]) / np.array(told["top"]) * 512
    bricks = Bricks(told, arrays)
    count = (told["sh_degree"] + 1) ** 2
    voxels, rows = bricks.rows(arrays["rows"], 4)
    wide, bands = bricks.rows(arrays["bands"], 2) if count > 1 else (None, None)
    sigma, rgb, shown = np.zeros(len(x)), np.zeros((len(x), 3)), harmonics(count, d)
    for n, u in enumerate(units):
        fine = voxel_around(voxels, u)
        if fine is None:
            continue
        row = between(rows, *fine, u)
        logits = shown[n, 0] * row[1:]
        if count > 1:
            logits = logits + between(bands, *voxel_around(wide, u), u).reshape(3, -1) @ shown[n, 1:]
        sigma[n], rgb[n] = rho[n] * density(row[:1], told)[0], logistic(logits)
    return sigma, rgb


def voxel_around(voxels: dict, u: np.ndarray):
    """The active voxel that holds a point."""
    for w in {w for _, w in voxels}:
        low = tuple((np.floor(u / w) * w).astype(int).tolist())
        if (low, w) in voxels:
            return low, w
    return None
