"""Damaged and hostile packs, made from good ones: as a disk, a network or an enemy would change them.

A *damaged* pack has other bytes than its writer wrote, and every reader has to notice. A *hostile* one was
sealed anew: its checksums are right, so what stands inside has to be judged by itself.
"""

import io
import json
import random
from collections.abc import Callable

from formats.archive import parse_archive, write_archive
from formats.bundle import SCENE, member_name

RAW = "\0raw\0"
TOKENS = r"""
NaN Infinity -Infinity 1e999 -0 -1 0 1 1.5 1e308 1e-308 -1e300 2147483648 4294967296 9007199254740993
9223372036854775808 true null [] {} [0] [0,0,0] [1e300,1e300,1e300] [null] [[1,0],[0]] [{"a":1}] "" "../x"
"/etc/passwd" "a\u0000b" "\ud800" "\u001b[2J" "\u202ex" "\uff0e\uff0e/x"
""".split()
TOKENS += ["9" * 5000, "0." + "1" * 5000, f'"{"x" * 5000}"', "[" * 900 + "]" * 900, "[" * 9000 + "]" * 9000]
TOKENS += ['{"a":' * 300 + "1" + "}" * 300, "[" + "0," * 9000 + "0]"]
EDGES = [0, 1, 2**7, 2**8 - 1, 2**15, 2**16 - 1, 2**31 - 1, 2**31, 2**32 - 1]


def mutated(pack: bytes, rng: random.Random) -> tuple[str, bytes, bool]:
    """(kind of mutation, bytes, whether they were sealed anew)."""
    kind = rng.choice(sorted(DAMAGES) + sorted(HOSTILITIES))
    if kind in DAMAGES:
        return kind, DAMAGES[kind](bytearray(pack), rng), False
    return kind, sealed(pack, HOSTILITIES[kind], rng), True


# --- damage -------------------------------------------------------------------------------------------------


def _flip(data: bytearray, rng: random.Random) -> bytes:
    for _ in range(rng.choice((1, 1, 1, 2, 8))):
        data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
    return bytes(data)


def _run(data: bytearray, rng: random.Random) -> tuple[int, int]:
    start = rng.randrange(len(data))
    return start, min(len(data), start + rng.choice((1, 2, 4, 16, 64, 512, 4096)))


def _overwrite(data: bytearray, rng: random.Random) -> bytes:
    start, stop = _run(data, rng)
    data[start:stop] = rng.choice(
        (rng.randbytes(stop - start), bytes(stop - start), b"\xff" * (stop - start))
    )
    return bytes(data)


def _remove(data: bytearray, rng: random.Random) -> bytes:
    start, stop = _run(data, rng)
    return bytes(data[:start] + data[stop:])


def _insert(data: bytearray, rng: random.Random) -> bytes:
    start, stop = _run(data, rng)
    return bytes(data[:start] + rng.choice((data[start:stop], rng.randbytes(stop - start))) + data[start:])


def _swap(data: bytearray, rng: random.Random) -> bytes:
    size = rng.choice((1, 64, 512))
    one, other = rng.randrange(len(data)), rng.randrange(len(data))
    data[one : one + size], data[other : other + size] = data[other : other + size], data[one : one + size]
    return bytes(data)


def _truncate(data: bytearray, rng: random.Random) -> bytes:
    return bytes(data[: rng.randrange(len(data))])


def _append(data: bytearray, rng: random.Random) -> bytes:
    return bytes(data + rng.choice((b"\0", b"PK\5\6" + bytes(18), bytes(data), rng.randbytes(100))))


def _edge(data: bytearray, rng: random.Random) -> bytes:
    """A number at the edge of what an integer holds, where a ZIP or safetensors header stands."""
    headers = [at for magic in (b"PK\3\4", b"PK\1\2", b"PK\5\6") for at in _all(bytes(data), magic)]
    at = min(rng.choice(headers) + rng.randrange(46), len(data) - 8)
    size = rng.choice((1, 2, 4, 8))
    data[at : at + size] = (rng.choice(EDGES) % 256**size).to_bytes(size, "little")
    return bytes(data)


def _all(data: bytes, part: bytes) -> list[int]:
    found, at = [], data.find(part)
    while at >= 0:
        found.append(at)
        at = data.find(part, at + 1)
    return found


DAMAGES = {
    "flip": _flip,
    "overwrite": _overwrite,
    "remove": _remove,
    "insert": _insert,
    "swap": _swap,
    "truncate": _truncate,
    "append": _append,
    "edge": _edge,
}


# --- hostility ----------------------------------------------------------------------------------------------


def sealed(pack: bytes, change: Callable, rng: random.Random) -> bytes:
    """`pack` with `change(scene, field, rng)` -> (scene, field) done to its bytes, under right checksums."""
    views = parse_archive(memoryview(pack), "good")
    scene, *names = views
    old = rng.choice(names)
    members = {name: bytes(view) for name, view in views.items()}
    members[SCENE], field = change(members[scene], members.pop(old), rng)
    new = member_name(field)
    members[SCENE] = members[SCENE].replace(old.encode(), new.encode())
    members[new] = field
    file = io.BytesIO()
    write_archive(file, [(SCENE, members.pop(SCENE)), *sorted(members.items())])
    return file.getvalue()


def spoilt_json(text: bytes, rng: random.Random) -> bytes:
    """JSON with one value or key of it changed to something unwelcome."""
    content = json.loads(text)
    places = list(_places(content))
    parent, key = rng.choice(places)
    how = rng.randrange(6)
    if how <= 2:
        parent[key] = RAW
    elif how == 3 and isinstance(parent, dict):
        parent[rng.choice(("unknown", "name", "children", "field", "matrix", "nodes", "\0", "x" * 300))] = (
            parent[key]
        )
    elif how == 4 and isinstance(parent, list):
        parent.extend([parent[key]] * rng.choice((1, 20, 300)))
    else:
        del parent[key]
    token = rng.choice(TOKENS)
    data = json.dumps(content).replace(json.dumps(RAW), token).encode("utf-8", "surrogatepass")
    if rng.random() < 0.1:  # a key twice
        data = data[:-1] + b"," + json.dumps(next(iter(content), "a")).encode() + b":0}"
    return data


def _places(content):
    items = content.items() if isinstance(content, dict) else enumerate(content)
    for key, value in list(items):
        yield content, key
        if isinstance(value, dict | list):
            yield from _places(value)


def _parts(field: bytes) -> tuple[bytes, bytes]:
    stop = 8 + int.from_bytes(field[:8], "little")
    return field[8:stop], field[stop:]


def _joined(header: bytes, data: bytes) -> bytes:
    return len(header).to_bytes(8, "little") + header + data


def _scene(scene: bytes, field: bytes, rng: random.Random):
    return spoilt_json(scene, rng), field


def _header(scene: bytes, field: bytes, rng: random.Random):
    header, data = _parts(field)
    return scene, _joined(spoilt_json(header, rng), data)


def _metadata(scene: bytes, field: bytes, rng: random.Random):
    header, data = _parts(field)
    content = json.loads(header)
    spoilt = spoilt_json(content["__metadata__"]["fusedrf"].encode(), rng)
    content["__metadata__"]["fusedrf"] = spoilt.decode("utf-8", "replace")
    return scene, _joined(json.dumps(content).encode(), data)


def _numbers(scene: bytes, field: bytes, rng: random.Random):
    header, data = _parts(field)
    damage = rng.choice(sorted(DAMAGES.keys() - {"edge"}))
    return scene, _joined(header, DAMAGES[damage](bytearray(data or b"\0"), rng))


def _bytes_of_scene(scene: bytes, field: bytes, rng: random.Random):
    return DAMAGES[rng.choice(sorted(DAMAGES.keys() - {"edge"}))](bytearray(scene), rng), field


def _bytes_of_field(scene: bytes, field: bytes, rng: random.Random):
    return scene, DAMAGES[rng.choice(sorted(DAMAGES.keys() - {"edge"}))](bytearray(field), rng)


HOSTILITIES = {
    "scene value": _scene,
    "header value": _header,
    "metadata value": _metadata,
    "numbers": _numbers,
    "scene bytes": _bytes_of_scene,
    "field bytes": _bytes_of_field,
}
