"""Kept bundles of all that is written, and what they answer: `python -m tests.promises.golden NAME...`.

Each case of CASES writes NAME.rfpack to tests/formats/golden/kept, with NAME.rfpack.history where edits were
kept, and NAME.npz beside it: what the bundle answers, and what it answers after some edits. They are kept for
ever: a case that is changed is another case, under another name. Without names those are written that are
not there yet.
"""

import json
import shutil
import sys
import tempfile
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from click.testing import CliRunner

from formats.bundle import read_bundle
from formats.camera_set import CameraSet
from formats.errors import FormatWarning
from formats.scene import SHOWING_KEYS, Node, SceneGraph, make_node, write_scene
from formats.views import View
from fusedrf_cli.engine.settings import using
from fusedrf_cli.main import cli
from fusedrf_cli.python import Camera, look_at, open_scene
from tests.promises.packs import GOLDEN

KEPT = GOLDEN / "kept"
POINTS = 96
SIDE = 16  # pixels of the pictures
SAMPLES = 400  # of their rays
SHORT = 0.002  # step, in units of the field's frame
FAR = np.array([-7e11, 5411200.0, 1e12])


@dataclass(frozen=True)
class Case:
    """A kept bundle."""

    make: Callable[[Path], None]
    """Writes kept.rfpack into a folder, where whole commands may be run."""
    eye: tuple[float, float, float] = (2.1, -1.6, 1.3)
    at: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Where the picture is taken from, and what it looks at."""
    box: tuple[float, ...] = (-1.0, -1.0, -1.0, 1.0, 1.0, 1.0)
    """Where points are asked, in the world."""
    spread: float = 0.0
    """Powers of ten by which some of them lie farther from what the picture looks at."""
    edits: dict[str, tuple[str, ...]] = field(default_factory=dict)
    """Command lines by name: a verb and its words, of which FUSED is the bundle; `-o` is put behind."""
    bar: float = 55.0
    cropped: bool = False
    """Whether it has crops, which were rounded inwards to cells when it was kept, and are exact now."""
    """PSNR in dB to which the picture is kept."""
    others: tuple[Callable[[Path], None], ...] = ()
    """Bundles that may answer as this one does; points where one does not are not asked."""


def answers(path: Path, points: np.ndarray, dirs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """σ (N,) and rgb (N, 3) of a bundle at points (N, 3) of the world along unit dirs (N, 3)."""
    sigma, rgb = open_scene(path).query(torch.from_numpy(points), torch.from_numpy(dirs))
    return sigma.numpy().astype(np.float64), rgb.numpy().astype(np.float64)


def view(case: Case) -> Camera:
    """The camera of a case's pictures."""
    pose = look_at(np.array(case.eye), np.array(case.at), np.array([0.0, 0.0, 1.0]))
    return Camera(pose, 1.2 * SIDE, 1.2 * SIDE, SIDE / 2, SIDE / 2, SIDE, SIDE)


def picture(path: Path, case: Case) -> np.ndarray:
    """(SIDE, SIDE, 4) float64 premultiplied colours and opacity: the sum Σ T (1 - exp(-σ δ)) (rgb, 1) over
    SAMPLES of what the bundle answers, however it is drawn."""
    camera, away = view(case), np.linalg.norm(np.subtract(case.eye, case.at))
    directions = camera.local_directions().reshape(-1, 3) @ camera.camera_to_world[:3, :3].T
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    ends = away * (np.geomspace(0.01, 1000, SAMPLES + 1) if case.spread else np.linspace(0, 2, SAMPLES + 1))
    middles, spans = (ends[1:] + ends[:-1]) / 2, np.diff(ends)
    at = camera.camera_to_world[:3, 3] + middles[:, None, None] * directions
    sigma, rgb = answers(path, at.reshape(-1, 3), np.tile(directions, (SAMPLES, 1)))
    depths = sigma.reshape(SAMPLES, -1) * spans[:, None]
    left = np.exp(-np.concatenate([np.zeros((1, depths.shape[1])), np.cumsum(depths, 0)]))
    weights = left[:-1] - left[1:]
    colours = (weights[..., None] * rgb.reshape(SAMPLES, -1, 3)).sum(0)
    return np.concatenate([colours, 1 - left[-1][:, None]], 1).reshape(SIDE, SIDE, 4)


def drawn(path: Path, case: Case) -> np.ndarray:
    """(SIDE, SIDE, 4) float64: the same as the program draws it, by short steps: by its own a toy of few
    texels has few samples."""
    shown = open_scene(path).render(view(case), step=SHORT)
    return torch.cat([shown.rgb, shown.opacity[..., None]], 2).double().numpy()


def decibels(one: np.ndarray, other: np.ndarray) -> float:
    """PSNR of two pictures."""
    return float(-10 * np.log10(max(np.mean((one - other) ** 2), 1e-12)))


def edited(path: Path, words: tuple[str, ...], output: Path) -> dict:
    """The report of an edit of a bundle, which has to succeed."""
    named = [str(path) if word == "FUSED" else word for word in words]
    named = [
        str(KEPT / word) if word.endswith(".rfpack") and word == Path(word).name else word for word in named
    ]
    result = CliRunner().invoke(cli, [*named, "-o", str(output), "--json"])
    assert result.exit_code == 0, result.stderr
    return json.loads(result.stdout)


def told_for_sure(
    case: Case, points: np.ndarray, dirs: np.ndarray, sigma: np.ndarray, folder: Path
) -> np.ndarray:
    """(N,) bool: at which points the bundles that may answer as this one does answer as it does, σ (N,)."""
    same = np.ones(len(sigma), bool)
    for make in case.others:
        make(folder)
        same &= answers(folder / "kept.rfpack", points, dirs)[0] == sigma
    return same


def asked(path: Path, case: Case, folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """Points (POINTS, 3) of a case's box, half of them in matter, and unit directions."""
    rng, box = np.random.default_rng(5), np.array(case.box)
    points = box[:3] + rng.random((100 * POINTS, 3)) * (box[3:] - box[:3])
    points = case.at + (points - case.at) * 10 ** (case.spread * rng.random((len(points), 1)))
    dirs = rng.normal(size=points.shape)
    dirs /= np.linalg.norm(dirs, axis=1, keepdims=True)
    sigma = answers(path, points, dirs)[0]
    there, same = sigma > 0, told_for_sure(case, points, dirs, sigma, folder)
    points, dirs, there = points[same], dirs[same], there[same]
    kept = np.sort(
        np.concatenate([np.flatnonzero(there)[: POINTS // 2], np.flatnonzero(~there)[: POINTS // 2]])
    )
    assert there.sum() >= POINTS // 4
    return points[kept], dirs[kept]


def keep(name: str, case: Case) -> None:
    """Write a case's bundle, what was kept of its past, and what it answers."""
    from tests.bridge.conftest import TINY, make_tiny, stock_fields

    with tempfile.TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch, using(*TINY):
        make_tiny(patch)
        patch.chdir(folder)
        stock_fields(Path(folder))
        case.make(Path(folder))
        KEPT.mkdir(exist_ok=True)
        path = Path(shutil.copy(Path(folder) / "kept.rfpack", KEPT / f"{name}.rfpack"))
        past = Path(folder) / "kept.rfpack.history"
        if past.exists():
            shutil.copytree(past, KEPT / f"{name}.rfpack.history", dirs_exist_ok=True)
        points, dirs = asked(path, case, Path(folder))
        sigma, rgb = answers(path, points, dirs)
        shown = picture(path, case)
        found = {"points": points, "dirs": dirs, "sigma": sigma, "rgb": rgb, "picture": shown}
        for edit, words in case.edits.items():
            out = Path(folder) / f"{edit}.rfpack"
            edited(path, words, out)
            found[f"{edit} sigma"], found[f"{edit} rgb"] = answers(out, points, dirs)
    found["drawn"] = np.array(decibels(drawn(path, case), shown))  # by grids as fine as they are in use
    exact = ("points", "dirs")
    np.savez_compressed(
        KEPT / f"{name}.npz", **{k: v if k in exact else v.astype(np.float32) for k, v in found.items()}
    )


# -- what is kept --------------------------------------------------------------------------------------------


def numbers(make: Callable, **where) -> Callable[[Path], None]:
    """A case of one field as it is."""

    def made(folder: Path) -> None:
        write(folder / "kept.rfpack", make(), **where)

    return made


def write(path: Path, made, precision: str = "float16", origin=None, **more) -> None:
    from fusedrf_cli.bridge.field_bundle import write_field

    write_field(str(path), made, path.stem, precision=precision, overwrite=True, origin=origin, **more)


def coded(make: Callable[[Path], None]) -> Callable[[Path], None]:
    """The same with small arrays in 8 bits too."""

    def made(folder: Path) -> None:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("formats.quantisation.LEAST", {2: 512, 3: 256})
            make(folder)

    return made


def tensor(seed: int = 0, resolution=(9, 11, 10), **more):
    """A `vm` field of random numbers of the shape that tests compile."""
    from tests.engine.conftest import THIRTY_TWO, random_vm

    return random_vm(THIRTY_TWO, resolution, torch.float32, seed, cells=more.pop("cells", 4), **more)


def boxed(kind: str, unbounded: bool = False):
    """A field of a kind on one grid, bounded or of all of space."""
    from fusedrf_cli.engine.fields.occupancy import OccupancyGrid
    from fusedrf_cli.engine.kinds import registry
    from fusedrf_cli.engine.spaces import unbounded as space
    from fusedrf_cli.engine.spaces.unbounded import WHOLE
    from tests.engine.kinds.cases import random_boxed

    made = random_boxed(kind, torch.float32)
    if not unbounded:
        return made
    grid = OccupancyGrid.full(WHOLE, 8, space)
    there = abs(grid.centres()).max(1) > 1.3
    grid = grid.marked(there.reshape(grid.occupied.shape))
    field = registry.kind(kind).field(made.shape, WHOLE, (9, 9, 9), 1.0, -0.5, occupancy=grid)
    generator = torch.Generator().manual_seed(3)
    return field.with_params(torch.randn(field.size, generator=generator, dtype=torch.float64).float())


def sparse(unbounded: bool = False, depth: int = 1):
    """Bricks of several levels; of all of space, those of a box around the core's corner."""
    from fusedrf_cli.engine.kinds.sparse.field import SparseField
    from fusedrf_cli.engine.spaces import unbounded as space
    from tests.engine.kinds.sparse_cases import random_sparse

    made = random_sparse(2, depth, torch.float32)
    return SparseField(made.shape, made.fine, made.scale, made.params, space) if unbounded else made


def network(unbounded: bool = False):
    """A vm-mlp field, bounded or of all of space."""
    from fusedrf_cli.engine.kinds.vm.field import VMShape
    from tests.analytic.export import with_network
    from tests.engine.kinds.cases import random_vm_mlp

    made = random_vm_mlp(torch.float32, cells=4)
    if not unbounded:
        return made
    shape = VMShape(made.shape.density_rank, made.shape.colour_rank, made.shape.sh_degree)
    return with_network(walls(shape, hashed=False), made.weights)


def walls(shape=None, hashed: bool = True, resolution: int = 17, seed: int = 0):
    """A closed room of mottled walls around an empty core, in all of space, with a hashed detail."""
    from fusedrf_cli.engine.encodings.hash_runs import HashGrid
    from fusedrf_cli.engine.fields.occupancy import OccupancyGrid
    from fusedrf_cli.engine.kinds.vm.field import VMField
    from fusedrf_cli.engine.spaces import unbounded
    from fusedrf_cli.engine.spaces.unbounded import WHOLE
    from tests.engine.conftest import THIRTY_TWO

    generator = torch.Generator().manual_seed(seed)
    detail = HashGrid((1.0, 0.5), 256) if hashed else None
    made = VMField.create(replace(shape or THIRTY_TWO, hashed=detail), WHOLE, (resolution,) * 3, generator)
    if hashed:
        made.sections()["density_detail"].normal_(0, 0.3, generator=generator)
    grid = OccupancyGrid.full(WHOLE, 16, unbounded)
    there = (abs(grid.centres()).max(1) > 1.6).reshape(grid.occupied.shape)
    made = made.with_occupancy(grid.marked(there))
    made.shift = float(np.log(np.expm1(0.8 / made.scale)))
    return made.with_params(4 * made.params)


def furnished():
    """Far walls and a ball in the core that shows some of the detail's rows."""
    from fusedrf_cli.engine.encodings.hash_runs import HashGrid
    from fusedrf_cli.engine.fields.occupancy import OccupancyGrid
    from fusedrf_cli.engine.kinds.vm.field import VMField
    from fusedrf_cli.engine.spaces import unbounded
    from fusedrf_cli.engine.spaces.unbounded import WHOLE
    from tests.engine.conftest import THIRTY_TWO

    generator = torch.Generator().manual_seed(3)
    shape = replace(THIRTY_TWO, hashed=HashGrid((1 / 8, 1 / 16), 1 << 12))
    made = VMField.create(shape, WHOLE, (25,) * 3, generator)
    made.sections()["density_detail"].normal_(0, 0.5, generator=generator)
    grid = OccupancyGrid.full(WHOLE, 32, unbounded)
    at = grid.centres()
    there = (abs(at).max(1) > 1.9) | (np.linalg.norm(at - [0.3, 0, 0], axis=1) < 0.3)
    made = made.with_occupancy(grid.marked(there.reshape(grid.occupied.shape)))
    made.shift = float(np.log(np.expm1(20 / made.scale)))
    return made.with_params(4 * made.params)


LIES = np.array(
    [[2.0, 0, 0, 0.1], [0, 2, 0, 0], [0, 0, 2, -0.2], [0, 0, 0, 1]]
)  # a place's core, in the world


def cameras(surroundings: bool = True, scale: float = 1.0, centre=(0.0, 0.0, 0.0)) -> dict:
    """Five cameras around a point of the world, one held out, of two lenses, as a bundle keeps them."""
    views = []
    for i in range(5):
        angle = 1.2 * i
        eye = scale * np.array([1.5 * np.cos(angle), 1.5 * np.sin(angle), 0.6 + 0.1 * i]) + centre
        pose = look_at(eye, np.array(centre, float), np.array([0.0, 0.0, 1.0]))
        bent = {"distortion": (0.05, -0.02, 0.001, 0.0, 0.0)} if i == 2 else {}
        views.append(View(f"photo_{i}", pose, 24.0, 24.0, 16.0, 12.0, 32, 24, **bent))
    return CameraSet(
        tuple(views[:4]), tuple(views[4:]), np.array(centre, float), 1.6 * scale, surroundings
    ).content()


def done(*words: str) -> dict:
    """The report of a command line in the current folder, which has to succeed."""
    result = CliRunner().invoke(cli, [*words, "--json"])
    assert result.exit_code == 0, result.stderr
    return json.loads(result.stdout)


def node(name: str, **words) -> Node:
    """A node of the scene graph; words are of `make_node`, and what is shown of it."""
    showing = {key: words.pop(key) for key in SHOWING_KEYS if key in words}
    return make_node(
        name,
        showing={key: v if key in ("visible", "opacity") else list(v) for key, v in showing.items()},
        **words,
    )


TURN = (0.0, np.sin(0.4), 0.0, np.cos(0.4))
MIRRORED = np.diag([0.5, -0.6, 0.4, 1.0])
MIRRORED[:3, 3] = 0.4, 0.5, 0.3


def small_objects(folder: Path) -> None:
    """one, two and three: random `vm` fields, of which the second has a detail."""
    from fusedrf_cli.engine.encodings.hash_runs import HashGrid

    write(folder / "one.rfpack", tensor(1))
    write(folder / "two.rfpack", tensor(2, hashed=HashGrid((0.31, 0.07), 64), scale=30.0, shift=-6.0))
    write(folder / "three.rfpack", tensor(3, (7, 8, 9)))


def scene_of_objects(folder: Path, composition: str = "max", **more) -> None:
    """Turned, stretched, mirrored and copied objects in groups, some with a crop, an opacity or a tint."""
    small_objects(folder)
    third = node("third", source="one.rfpack", matrix=MIRRORED, tint=(0.4, 0.8, 1.0))
    nodes = (
        node(
            "ground", source="three.rfpack", scale=(0.9, 0.9, 0.4), translation=(0, 0, -0.6), background=True
        ),
        node(
            "first", source="one.rfpack", rotation=TURN, scale=(0.4, 0.5, 0.6), translation=(-0.5, 0.1, 0.2)
        ),
        node("second", source="two.rfpack", scale=(0.5,) * 3, translation=(0.3, -0.4, 0), opacity=0.5),
        node(
            "group", translation=(0.1, 0.0, 0.1), rotation=(0, 0, np.sin(0.3), np.cos(0.3)), children=(third,)
        ),
        node(
            "ball", source="three.rfpack", scale=(0.5,) * 3, translation=(-0.2, -0.5, 0.5),
            crop=(0.0, 0.0, 0.0, 0.9), tint=(1.0, 0.3, 0.2),
        ),
        node("hidden", source="two.rfpack", visible=False),
    )  # fmt: skip
    write_scene(folder / "objects.json", SceneGraph(nodes, composition, **more), overwrite=True)


def fused_blocks(folder: Path) -> None:
    scene_of_objects(folder, framing=(-1.0, -1.0, -1.0, 1.0, 1.0, 1.0))
    done("fuse", "objects.json", "-o", "kept.rfpack", "--kind", "blocks")


def blocks_with_sources(folder: Path) -> None:
    scene_of_objects(folder)
    done(
        "fuse",
        "objects.json",
        "-o",
        "kept.rfpack",
        "--kind",
        "blocks",
        "--keep-sources",
        "--precision",
        "int8",
    )


def edited_blocks(folder: Path) -> None:
    """A chain of edits, each of which keeps what was before it."""
    small_objects(folder)
    nodes = (
        node("one", source="one.rfpack", scale=(0.5,) * 3),
        node("three", source="three.rfpack", scale=(0.4,) * 3, translation=(0.6, 0, 0)),
    )
    write_scene(folder / "pair.json", SceneGraph(nodes), overwrite=True)
    done("fuse", "pair.json", "-o", "kept.rfpack", "--kind", "blocks")
    last = ("-o", "kept.rfpack", "-w", "--undoable")
    done(
        "add",
        "kept.rfpack",
        "two.rfpack",
        "--name",
        "two",
        "-t",
        "-0.5,0,0.2",
        "-s",
        "0.4",
        "-r",
        "0,20,0",
        *last,
    )
    done("move", "kept.rfpack", "one", "-t", "0,0.3,0.1", "-r", "10,20,30", "-s", "1.1,0.9,1", *last)
    done("duplicate", "kept.rfpack", "three", "three again", "-t", "-1.0,-0.4,0", *last)
    done("rename", "kept.rfpack", "one", "first", *last)
    done("replace", "kept.rfpack", "two", "three.rfpack", *last)
    done("delete", "kept.rfpack", "three", *last)


def stock_place(folder: Path, composition: str = "max", **more) -> None:
    """place.json: a captured place with its cameras, and objects in it, one outside of its core."""
    small_objects(folder)
    write(
        folder / "room.rfpack", walls(), "float16", LIES, cameras=cameras(), framing=(-3.0,) * 3 + (3.0,) * 3
    )
    nodes = (
        node("room", source="room.rfpack", background=True),
        node("first", source="one.rfpack", scale=(0.4,) * 3, translation=(-0.3, 0.2, 0.1), rotation=TURN),
        node(
            "second", source="two.rfpack", scale=(0.4,) * 3, translation=(0.5, -0.3, 0), tint=(1.0, 0.5, 0.3)
        ),
        node("far one", source="three.rfpack", scale=(1.2,) * 3, translation=(5.0, 1.0, 0.3)),
    )
    write_scene(folder / "place.json", SceneGraph(nodes, composition, **more), overwrite=True)


def fused_place(folder: Path) -> None:
    stock_place(folder)
    done("fuse", "place.json", "-o", "kept.rfpack", "--kind", "blocks")


def place_with_sources(folder: Path) -> None:
    """Edited, with what was before and the sources inside."""
    stock_place(folder)
    done(
        "fuse", "place.json", "-o", "kept.rfpack", "--kind", "blocks", "--keep-sources", "--precision", "int8"
    )
    done("move", "kept.rfpack", "first", "-t", "0.1,0,0.2", "-o", "kept.rfpack", "-w", "--undoable")


def extracted(*words: str) -> Callable[[Path], None]:
    def made(folder: Path) -> None:
        write(folder / "room.rfpack", furnished(), "int8", LIES, cameras=cameras())
        done("extract", "room.rfpack", "--sphere", "0.7,0,-0.2,0.7", "-o", "kept.rfpack", *words)

    return made


def held_in_blocks(folder: Path) -> None:
    """An object of held rows in another scene."""
    extracted()(folder)
    shutil.move(folder / "kept.rfpack", folder / "ball.rfpack")
    small_objects(folder)
    nodes = (
        node("one", source="one.rfpack", scale=(0.4,) * 3, translation=(-0.6, 0, 0)),
        node("ball", source="ball.rfpack", translation=(-0.3, 0.2, 0.1)),
    )
    write_scene(folder / "pair.json", SceneGraph(nodes), overwrite=True)
    done("fuse", "pair.json", "-o", "kept.rfpack", "--kind", "blocks")


def learnt(kind: str, *words: str, size: str = "60kB") -> Callable[[Path], None]:
    """The shop's scene, distilled to a kind."""

    def made(folder: Path) -> None:
        kept = ("pair.json", "-o", "kept.rfpack", "--kind", kind, "--max-size", size, "--no-finetune")
        done("fuse", *kept, *words)

    return made


def learnt_with_sources(kind: str, size: str) -> Callable[[Path], None]:
    """The same with the sources inside, and one more object beside what was learnt."""

    def made(folder: Path) -> None:
        small_sources(folder)
        learnt(kind, "--keep-sources", size=size)(folder)
        done("add", "kept.rfpack", "three.rfpack", "--name", "three", "-t", "0.6,0,0.2", "-s", "0.3",
             "-o", "kept.rfpack", "-w", "--undoable", "--no-finetune")  # fmt: skip

    return made


def small_sources(folder: Path) -> None:
    """pair.json of two small solids, and three.rfpack."""
    from tests.bridge.conftest import FIELDS

    small_objects(folder)
    for name in ("floor", "red"):
        field = FIELDS[name]
        write(
            folder / f"{name}.rfpack",
            field.resampled(field.box, (6, 6, 6)).with_occupancy(field.occupancy),
        )


def sunk(folder: Path) -> None:
    """pair.json of the floor and the red box, which stands in it and hides a part of it."""
    small_sources(folder)
    nodes = (
        node("floor", source="floor.rfpack", background=True),
        node("red", source="red.rfpack", translation=(-0.3, 0.1, 0.25)),
    )
    write_scene(folder / "pair.json", SceneGraph(nodes), overwrite=True)


def restored(folder: Path) -> None:
    """A distilled field out of which an object was cut: a small tensor shows what it hid."""
    sunk(folder)
    learnt("vm", "--keep-sources", size="120kB")(folder)
    done("delete", "kept.rfpack", "red", "-o", "kept.rfpack", "-w", "--undoable", "--no-finetune")


def learnt_place(folder: Path) -> None:
    """What stands in a captured place learnt into one tensor beside it."""
    stock_place(folder)
    scene = json.loads((folder / "place.json").read_text())
    scene["nodes"] = scene["nodes"][:3]
    (folder / "place.json").write_text(json.dumps(scene))
    done(
        "fuse",
        "place.json",
        "-o",
        "kept.rfpack",
        "--kind",
        "vm",
        "--max-size",
        "200kB",
        "--no-finetune",
        "--keep-sources",
    )


def filled(folder: Path) -> None:
    """A hole of a distilled field that goes on smoothly with what is around it."""
    sunk(folder)
    learnt("vm", size="120kB")(folder)
    (folder / "red.rfpack").unlink()
    (folder / "floor.rfpack").unlink()
    done("delete", "kept.rfpack", "red", "-o", "kept.rfpack", "-w", "--fill", "--no-finetune")


def nodes_of_kinds(composition: str) -> Callable[[Path], None]:
    """A bundle of several nodes, as `Scene.save` writes it, of four kinds; two show one field."""

    def made(folder: Path) -> None:
        small_objects(folder)
        write(folder / "grid.rfpack", boxed("dense"))
        write(folder / "lines.rfpack", boxed("cp"))
        write(folder / "bricks.rfpack", sparse())
        nodes = (
            node("grid", source="grid.rfpack", scale=(0.6,) * 3, translation=(-0.4, 0, 0), background=True),
            node("lines", source="lines.rfpack", scale=(0.5,) * 3, rotation=TURN, translation=(0.4, 0.1, 0)),
            node("bricks", source="bricks.rfpack", scale=(0.4,) * 3, translation=(0.2, 0.5, -0.4)),
            node("one", source="one.rfpack", matrix=MIRRORED),
            node("again", source="one.rfpack", scale=(0.3,) * 3, translation=(-0.5, -0.6, 0.5)),
        )
        write_scene(folder / "mixed.json", SceneGraph(nodes, composition), overwrite=True)
        open_scene(folder / "mixed.json").save(folder / "kept.rfpack")

    return made


def shown_nodes(folder: Path, less: float = 0.0) -> None:
    """Version 1.2: a bundle whose nodes have crops, by so much less on each side, opacities and tints, in
    groups."""
    from formats.bundle import BundleWriter
    from formats.records import FieldRecord

    writer = BundleWriter()
    members = [writer.add_field(FieldRecord(f.kind, *f.state())) for f in (tensor(1), boxed("dense"))]
    inner = (
        node("ball", field=members[0], crop=(0.1, 0.0, 0.0, 0.8 - less), tint=(0.3, 0.9, 0.6)),
        node(
            "part",
            field=members[1],
            translation=(0.2, 0.3, 0),
            crop=(-0.5 + less, -0.9 + less, -0.9 + less, 0.9 - less, 0.7 - less, 0.8 - less),
        ),
    )
    nodes = (
        node("group", scale=(0.7,) * 3, rotation=TURN, opacity=0.6, tint=(1.0, 0.8, 0.5), children=inner),
        node("box", field=members[1], scale=(0.4,) * 3, translation=(-0.5, -0.5, 0.2), tint=(0.2, 0.4, 1.0)),
        node("hidden", field=members[0], visible=False),
    )
    writer.write(folder / "kept.rfpack", SceneGraph(nodes, generator="fusedrf"), overwrite=True)


def far_blocks(folder: Path) -> None:
    """Version 1.3: a fused scene far from the world's origin, of a large unit."""
    small_objects(folder)
    unit = 1000.0
    nodes = tuple(
        node(name, source=f"{name}.rfpack", scale=(s * unit,) * 3, translation=FAR + unit * np.array(at))
        for name, s, at in (("one", 0.5, (-0.4, 0, 0)), ("three", 0.4, (0.6, 0.2, 0)))
    )
    write_scene(folder / "far.json", SceneGraph(nodes), overwrite=True)
    done("fuse", "far.json", "-o", "kept.rfpack", "--kind", "blocks")


def far_place(folder: Path) -> None:
    """Version 1.3: a captured place of a far world with its cameras."""
    lies = LIES.copy()
    lies[:3, :3] *= 1000
    lies[:3, 3] = FAR
    camera_set = cameras(scale=2000.0, centre=FAR)
    write(folder / "kept.rfpack", walls(), "int8", lies, cameras=camera_set)


def around(unit: float, centre=(0.0, 0.0, 0.0)) -> tuple[float, ...]:
    """The box of a cube about a point."""
    return tuple(np.concatenate([np.array(centre) - unit, np.array(centre) + unit]).tolist())


PLACE = {"eye": (0.6, -0.5, 0.9), "at": (-0.3, 0.2, 0.0), "box": around(2.0), "spread": 2.0}
CASES = {
    **{
        f"vm-{precision}": Case(numbers(lambda: tensor(4, (17, 18, 16)), precision=precision))
        for precision in ("float16", "float32", "int8", "int4")
    },
    "vm-detail": Case(extracted("--invert"), **PLACE),
    "vm-place": Case(numbers(walls, origin=LIES, cameras=cameras(), precision="int8"), **PLACE),
    "held": Case(coded(extracted()), box=(0.0, -0.7, -0.9, 1.4, 0.7, 0.5), at=(0.7, 0.0, -0.2)),
    "held-in-blocks": Case(held_in_blocks, edits={
        "delete": ("delete", "FUSED", "one"),
        "move": ("move", "FUSED", "ball", "-t", "0.1,0,0", "-r", "0,0,30"),
    }),
    "vm-mlp": Case(numbers(network)),
    "vm-mlp-place": Case(numbers(lambda: network(True), origin=LIES), **PLACE),
    "sparse-float16": Case(numbers(sparse)),
    "sparse-int8": Case(coded(numbers(sparse, precision="int8"))),
    "sparse-place": Case(numbers(lambda: sparse(True), origin=LIES), **PLACE),
}  # fmt: skip
for _kind in ("cp", "dense", "dense-mlp"):
    CASES[_kind] = Case(numbers(lambda kind=_kind: boxed(kind)))
    CASES[f"{_kind}-place"] = Case(numbers(lambda kind=_kind: boxed(kind, True), origin=LIES), **PLACE)
CASES |= {
    "blocks": Case(fused_blocks, edits={
        "delete": ("delete", "FUSED", "first", "ball"),
        "move": ("move", "FUSED", "second", "-t", "0.1,0.2,0", "-r", "0,30,0", "-s", "1.2"),
        "duplicate": ("duplicate", "FUSED", "third", "fourth", "-t", "-0.5,-0.5,0"),
        "rename": ("rename", "FUSED", "ground", "floor"),
        "extract": ("extract", "FUSED", "--name", "third"),
        "without": ("extract", "FUSED", "--name", "second", "--invert"),
        "add": ("add", "FUSED", "vm-float16.rfpack", "--name", "more", "-t", "0.5,0.5,0.5", "-s", "0.3"),
        "replace": ("replace", "FUSED", "first", "vm-float16.rfpack"),
    }),
    "blocks-with-sources": Case(blocks_with_sources, edits={
        "delete": ("delete", "FUSED", "second"), "fuse": ("fuse", "FUSED", "--kind", "blocks"),
    }),
    "blocks-edited": Case(edited_blocks, edits={
        "undo": ("undo", "FUSED"),
        "delete": ("delete", "FUSED", "first"),
        "move": ("move", "FUSED", "three again", "-t", "0.2,0,0"),
    }),
    "place": Case(fused_place, **PLACE, edits={
        "delete": ("delete", "FUSED", "second"),
        "move": ("move", "FUSED", "far one", "-t", "-1,0,0", "-r", "0,0,40"),
        "duplicate": ("duplicate", "FUSED", "first", "other", "-t", "0.2,-0.5,0.1"),
        "extract": ("extract", "FUSED", "--name", "first"),
    }),
    "place-with-sources": Case(place_with_sources, **PLACE, edits={
        "undo": ("undo", "FUSED"), "delete": ("delete", "FUSED", "first"),
    }),
    "learnt-vm": Case(learnt_with_sources("vm", "120kB"), edits={
        "undo": ("undo", "FUSED"), "delete": ("delete", "FUSED", "three"),
        "move": ("move", "FUSED", "three", "-t", "0,0.1,0"),
    }),
    "learnt-sparse": Case(learnt_with_sources("sparse", "80kB"), edits={"undo": ("undo", "FUSED")}),
    "learnt-dense": Case(learnt("dense", size="80kB")),
    "learnt-place": Case(learnt_place, **PLACE),
    "restored": Case(restored, edits={"undo": ("undo", "FUSED")}),
    "filled": Case(filled),
    "nodes-max": Case(nodes_of_kinds("max")),
    "nodes-add": Case(nodes_of_kinds("add")),
    "nodes-shown": Case(
        shown_nodes,
        bar=24.0,
        cropped=True,
        others=(partial(shown_nodes, less=0.25), partial(shown_nodes, less=-0.25))
    ),
    "far-blocks": Case(
        far_blocks, tuple(FAR + [2100, -1600, 1300]), tuple(FAR), around(1000.0, FAR),
        edits={"delete": ("delete", "FUSED", "one"), "move": ("move", "FUSED", "three", "-t", "100,0,50")},
    ),
    "far-place": Case(
        far_place, tuple(FAR + [600, -500, 900]), tuple(FAR + [-300, 200, 0]), around(2000.0, FAR), 2.0
    ),
}  # fmt: skip


def main(names: list[str]) -> None:
    """Write the cases of those names, or all that are not there yet."""
    for name in names or [name for name in CASES if not (KEPT / f"{name}.npz").exists()]:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", FormatWarning)
            keep(name, CASES[name])
        files = [KEPT / f"{name}.rfpack", KEPT / f"{name}.npz", *KEPT.glob(f"{name}.rfpack.history/*")]
        scene = read_bundle(files[0]).scene
        print(name, scene.version, [file.stat().st_size for file in files], flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
