"""`--memory`: what is foretold is what is taken, and too much is refused before any of it is."""

import contextlib
import json
import os
import subprocess
import sys
import tempfile
import time
import tracemalloc
import weakref
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
import torch

from formats.bundle import OpenBundle, read_bundle
from formats.records import FieldRecord
from formats.scene import SceneGraph, make_node, write_scene
from fusedrf_cli.bridge import memory, trained_sources
from fusedrf_cli.bridge.field_bundle import write_field
from fusedrf_cli.bridge.field_cache import FieldCache
from fusedrf_cli.bridge.memory import Memory
from fusedrf_cli.bridge.runtime import load_checkpoint, save_checkpoint
from fusedrf_cli.bridge.scene import load_scene, needs_of
from fusedrf_cli.engine.distillation.optimiser import Adam
from fusedrf_cli.engine.fields.occupancy import OccupancyGrid
from fusedrf_cli.engine.kinds import registry
from fusedrf_cli.engine.kinds.sparse.bricks import BrickTree
from fusedrf_cli.engine.kinds.sparse.field import SparseField, SparseShape
from fusedrf_cli.engine.kinds.sparse.lattice import VertexLattice
from fusedrf_cli.engine.kinds.vm.field import VMField, VMShape
from fusedrf_cli.engine.kinds.vm_mlp.field import untrained
from fusedrf_cli.engine.rendering.volume import render_rays
from fusedrf_cli.errors import ResourceProblem
from tests.analytic import scenes
from tests.analytic.export import vm_field
from tests.analytic.fields import Box
from tests.bundles import write_single

ROOT = Path(__file__).parents[2]
COMMANDS = {
    "train": ("train", "photos", "-o", "out.rfpack"),
    "fuse": ("fuse", "scene.json", "-o", "out.rfpack"),
    "fuse vm": ("fuse", "scene.json", "--kind", "vm", "-o", "out.rfpack"),
    "add": ("add", "red.rfpack", "blue.rfpack", "--name", "new", "-o", "out.rfpack"),
    "render": ("render", "scene.json", "-o", "out.png"),
    "eval": ("eval", "red.rfpack", "--against", "photos"),
}


@pytest.mark.parametrize("name", COMMANDS)
def test_too_much_is_refused_with_the_numbers(run, folder, name):
    before = sorted(folder.iterdir())
    result = run(*COMMANDS[name], "--memory", "20MB")
    assert result.exit_code == 5 and sorted(folder.iterdir()) == before
    assert "needs about" in result.stderr and "20 MB --memory allows; " in result.stderr
    assert result.stderr.startswith("Error: ") and result.stderr.count("\n") == 1


def test_moments_and_gradients_are_gone_before_a_field_is_measured(run, folder, monkeypatch):
    """They are six times its numbers, and measuring makes copies of those."""
    made, alive, begin, measure = [], [], Adam.__init__, trained_sources.measure

    def begun(self, *words, **more):
        made.append(weakref.ref(self))
        begin(self, *words, **more)

    def noted(*words):
        alive.append(sum(held() is not None for held in made))
        return measure(*words)

    monkeypatch.setattr(Adam, "__init__", begun)
    monkeypatch.setattr(trained_sources, "measure", noted)
    words = "--holdout", "4", "--time-budget", "1"
    result = run("train", "photos", "-o", "out.rfpack", *words)
    assert result.exit_code == 0, result.stderr
    assert alive == [0] and made


def test_a_checkpoint_is_written_without_a_copy_of_the_run(tmp_path):
    """And comes back as it was."""
    arrays = {
        "params": np.arange(1 << 22, dtype=np.float32),
        "none": np.zeros((0, 3), np.uint8),
        "turned": np.arange(12.0).reshape(3, 4).T,
        "drawn": np.array([5, -1]),
    }
    tracemalloc.start()
    save_checkpoint(str(tmp_path / "out"), arrays, {"command": "train", "name": "Süd"})
    taken = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert taken < arrays["params"].nbytes / 4
    found, state = load_checkpoint(str(tmp_path / "out"), "train")
    assert state == {"command": "train", "name": "Süd"} and found.keys() == arrays.keys()
    for name, array in arrays.items():
        assert found[name].dtype == array.dtype and np.array_equal(found[name], array)


def test_nothing_is_read_before_the_refusal(folder, monkeypatch):
    monkeypatch.setattr("formats.bundle.OpenBundle.field", lambda *_: pytest.fail("read"))
    with pytest.raises(ResourceProblem):
        load_scene(str(folder / "scene.json"), budget=Memory(1))


def test_by_default_the_limit_is_what_is_free(monkeypatch):
    monkeypatch.setattr(memory, "available", lambda: 1_000_000)
    found = Memory()
    assert found.limit == found.base + 800_000
    assert found.report()["predicted_bytes"] is None  # nothing was expected yet
    with pytest.raises(ResourceProblem, match="are to be had"):
        found.expect({"much": 1e9}, advice="ask for less")
    assert found.report()["predicted_bytes"] > 1e9


def test_what_is_free_heeds_a_control_group(monkeypatch):
    whole = memory.available()
    group = {"memory.max": "3000000", "memory.current": "1000000"}
    real = Path.read_text
    monkeypatch.setattr(Path, "read_text", lambda self: group.get(self.name) or real(self))
    assert memory.available() == 2_000_000 < whole
    group["memory.max"] = "max"
    assert memory.available() > 2_000_000


def test_sources_that_do_not_fit_are_read_again(report, folder, picture):
    """The picture of a scene is the same with room for one field as with room for all."""
    loaded = load_scene(str(folder / "scene.json"))
    loaded.field_cache.resize(max(loaded.sizes))
    reads = []
    take = loaded.field_cache.take
    loaded.field_cache.take = lambda key, size, read: take(key, size, lambda: reads.append(key) or read())
    rays = np.tile([[0.0, 0, 5.0]], (3, 1)), np.tile([[0.0, 0, -1.0]], (3, 1))
    found = render_rays(loaded.composed(), *rays)
    assert len(reads) > 3
    assert np.array_equal(found, render_rays(load_scene(str(folder / "scene.json")).composed(), *rays))


def test_a_field_cache_keeps_what_was_asked_for_last():
    field_cache, reads = FieldCache(10), []
    for key in "abacab":
        field_cache.take(key, 5, lambda key=key: reads.append(key) or key)
    assert "".join(reads) == "abcb"
    field_cache.resize(0)
    field_cache.take("z", 50, lambda: "z")
    assert field_cache.take("z", 50, lambda: pytest.fail("read again")) == "z"


# -- few bytes that say many numbers -------------------------------------------------------------------------

BOX = [0.0, 0.0, 0.0, 1.0, 1.0, 1.0]


def boxed(path: Path, name: str, texels: int, full: bool, precision: str, cells: int = 1, **shape) -> Path:
    """A pack of one field over a box, so many texels and cells a side, all of them empty or full."""
    kind = registry.kind(name).field
    grid = OccupancyGrid(np.array(BOX), np.full((cells,) * 3, full))
    bare = kind(kind.shape_type(**shape), BOX, (texels,) * 3, 1.0, params=torch.zeros(0), occupancy=grid)
    numbers = np.random.default_rng(0).standard_normal

    def stored(part):
        if part.on_vertices and not full:  # of which none is used
            return np.zeros((0, part.columns) if part.columns else 0, np.float32)
        return 0.1 * (numbers if full else np.zeros)(bare.stored_shape(part)).astype(np.float32)

    arrays = {part.name: stored(part) for part in bare.parts}
    metadata = {
        **{"aabb": BOX, "resolution": [texels] * 3, "scale": 1.0, "shift": -8.0, "shape": asdict(bare.shape)},
        "cells": {"aabb": BOX, "counts": [cells] * 3},
    }
    arrays["occupancy"] = np.packbits(grid.occupied)
    record = FieldRecord(name, arrays, metadata)
    write_single(path, record, name, precision=precision)
    return path


def placed(path: Path, name: str, texels: int, full: bool, precision: str, cells=1, blocks=1) -> Path:
    """A pack of one tensor, in one block or several."""
    shape = VMShape()
    parts = VMField.parts_of(shape, (texels,) * 3)
    make = np.random.default_rng(0).standard_normal if full else np.zeros
    arrays = {f"tensor_0.{part.name}": 0.1 * make(part.shape).astype(np.float32) for part in parts}
    arrays["tensor_0.occupancy"] = np.packbits(np.full((cells,) * 3, full))
    if name == "vm-mlp":
        weights = untrained(3 * shape.coefficients, 64, torch.Generator().manual_seed(0))
        arrays |= {f"network.{key}": weight.numpy() for key, weight in weights.items()}
    moves = [np.eye(4) for _ in range(blocks)]
    for i, move in enumerate(moves):
        move[0, 3] = 0.6 * i
    told = {"resolution": [texels] * 3, "aabb": BOX, "scale": 1.0, "shift": -8.0, "occupancy": [cells] * 3}
    ranks = {"density_rank": shape.density_rank, "colour_rank": shape.colour_rank, "sh_degree": 2}
    named = [{"tensor": 0, "object_to_field": m.tolist(), "name": f"b{i}"} for i, m in enumerate(moves)]
    metadata = {"aabb": BOX, "shape": ranks, "tensors": [told], "blocks": named}
    write_single(path, FieldRecord(name, arrays, metadata), name, precision=precision)
    return path


def bricks(path: Path, side: int, level: int = 0) -> Path:
    """A pack of bricks: so many a side, or a row of single ones deep in their top cells."""
    at = np.argwhere(np.ones((side,) * 3 if not level else (side, 1, 1), bool))
    counts = tuple(at.max(0) + 1)
    masks = np.ones((len(at), 4, 4, 4), bool)
    tree = BrickTree.of(np.zeros(3), 1 / side, counts, np.full(len(at), level, np.uint8), at << level, masks)
    field = SparseField(SparseShape(), VertexLattice(tree, 4), 1.0)
    write_single(path, FieldRecord("sparse", *field.state()), "sparse", precision="int8")
    return path


PACKS = {
    "dense, empty": lambda path: boxed(path, "dense", 200, False, "float16"),
    "dense, full": lambda path: boxed(path, "dense", 110, True, "float16", 64),
    "dense-mlp, empty": lambda path: boxed(path, "dense-mlp", 200, False, "float16"),
    "dense-mlp, full": lambda path: boxed(path, "dense-mlp", 100, True, "int8", 64),
    "cp, empty": lambda path: boxed(path, "cp", 8000, False, "int8", density_rank=1024, colour_rank=1024),
    "cp, full": lambda path: boxed(path, "cp", 4000, True, "int4", density_rank=1024, colour_rank=1024),
    "vm, empty": lambda path: placed(path, "vm", 1000, False, "int8"),
    "vm, full": lambda path: placed(path, "vm", 500, True, "float32", 64),
    "vm-mlp": lambda path: placed(path, "vm-mlp", 500, True, "int8", 64),
    "blocks": lambda path: placed(path, "vm", 200, True, "float16", 128, blocks=4),
    "cells": lambda path: placed(path, "vm", 2, True, "float16", 320),
    "sparse, full": lambda path: bricks(path, 24),
    "sparse, deep": lambda path: bricks(path, 30, level=7),
}
LOADED = """
import json, sys
from fusedrf_cli.bridge import memory, scene
from fusedrf_cli.engine import kernels
budget = memory.Memory()
loaded = scene.load_scene(sys.argv[1], budget=budget)
loaded.placed[0].field.occupancy.arrays
print(json.dumps([budget.base, budget.predicted - memory.MemoryConfig.compiled, memory.peak()]))
"""


def test_pages_that_nobody_writes_are_not_counted(tmp_path):
    """A field of 260³ vertices without any: what is foretold is what it takes, not what its copies would."""
    needs = {}
    for name, texels, full in (("empty", 260, False), ("full", 40, True)):
        bundle = OpenBundle(boxed(tmp_path / name, "dense", texels, full, "float16"))
        needs[name] = needs_of(bundle, *bundle.headers)
    assert needs["empty"].held > 1 << 30 > 64 << 20 > needs["empty"].resident
    assert needs["full"].resident == needs["full"].held > 4 * 16 * 40**3


WHOLE = [name for name in PACKS if name.split(",")[0] in ("dense", "dense-mlp", "cp", "vm")]


@pytest.mark.slow
@pytest.mark.parametrize("name", WHOLE)
def test_a_whole_render_takes_no_more_than_foretold(tmp_path, name):
    """With kernels that are compiled already."""
    words = "render", str(PACKS[name](tmp_path / "a.rfpack")), "-o", "a.png", "--size", "256x256"
    for _ in range(2):
        said, peak = measured(tmp_path, *words)
    assert peak <= 1.1 * said["memory"]["predicted_bytes"]


@pytest.mark.slow
@pytest.mark.parametrize("name", PACKS)
def test_reading_takes_no_more_than_foretold(tmp_path, name):
    """The emptiest and the fullest pack of each kind: what its numbers need once they are in arrays."""
    path = PACKS[name](tmp_path / "a.rfpack")
    words = [sys.executable, "-c", LOADED, str(path)]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(words, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    base, foretold, peak = json.loads(done.stdout)
    assert foretold - base > 20 << 20 and peak <= 1.05 * foretold


@pytest.mark.parametrize("verb", ["render", "eval", "fuse", "add", "extract", "convert"])
def test_a_thousand_bytes_that_say_gigabytes_are_refused(run, folder, verb):
    """Before any of it is allocated, whatever is free here."""
    boxed(folder / "big.rfpack", "dense", 8192, False, "float16")
    words = {
        "render": ("big.rfpack", "-o", "out.png"),
        "eval": ("big.rfpack", "--against", "red.rfpack"),
        "fuse": ("big.rfpack", "-o", "out.rfpack"),
        "add": ("red.rfpack", "big.rfpack", "--name", "new", "-o", "out.rfpack"),
        "extract": ("big.rfpack", "--box", "0,0,0,0.5,0.5,0.5", "-o", "out.rfpack"),
        "convert": ("big.rfpack", "--kind", "vm", "-o", "out.rfpack"),
    }
    result = run(verb, *words[verb])
    assert result.exit_code == 5 and "needs about" in result.stderr, result.stderr


def test_a_box_that_no_reader_would_take_is_refused_before_work(run, folder):
    before = sorted(folder.iterdir())
    result = run("train", "photos", "-o", "out.rfpack", "--aabb", "-0.5,-0.5,0,0.5,0.5,0.0005")
    assert result.exit_code == 2 and "times as long as it is thin" in result.stderr, result.stderr
    assert sorted(folder.iterdir()) == before


# -- against real processes ----------------------------------------------------------------------------------

BIG = {
    "render": ("render", "o0.rfpack", "-o", "a.png", "--size", "1500x1500"),
    "render a scene": ("render", "s2.json", "-o", "a.png", "--size", "400x400"),
    "fuse": ("fuse", "s4.json", "-o", "out.rfpack"),
    "fuse vm": ("fuse", "s2.json", "--kind", "vm", "--time-budget", "20", "-o", "out.rfpack"),
    "add": ("add", "o0.rfpack", "o1.rfpack", "--name", "new", "-t", "1,0,0", "-o", "out.rfpack"),
    "eval": ("eval", "o0.rfpack", "--against", "s2.json", "--size", "500x500"),
    "train": (
        "train",
        "ball.ply",
        "--quality",
        "draft",
        "--views",
        "40",
        "--size",
        "400",
        "-o",
        "out.rfpack",
    ),
}


@pytest.fixture(scope="module")
def large(tmp_path_factory) -> Path:
    """Eight sources of 7 MB each in memory, scenes of 2, 4 and 8 of them, and a mesh."""
    import trimesh

    folder = tmp_path_factory.mktemp("large")
    rng = np.random.default_rng(0)
    for i in range(8):
        field = vm_field(Box(30.0, 0.5, tint=scenes.HUES[i % 5]), (120,) * 3, shape=VMShape(), cells=32)
        field.params.numpy()[:] += rng.normal(0, 1e-3, field.params.numel())
        write_field(str(folder / f"o{i}.rfpack"), field, f"o{i}", precision="float16", overwrite=False)
    for n in (2, 4, 8):
        nodes = [make_node(f"o{i}", source=f"o{i}.rfpack", translation=(1.2 * i, 0, 0)) for i in range(n)]
        write_scene(folder / f"s{n}.json", SceneGraph(tuple(nodes)))
    trimesh.creation.icosphere(subdivisions=3).export(folder / "ball.ply")
    return folder


def measured(folder: Path, *words: str) -> tuple[dict, int]:
    """The JSON report of a command in a process of its own, and the most bytes it was seen to hold."""
    code = "from fusedrf_cli.main import main; main()"
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    words = [sys.executable, "-c", code, *words, "--json", *(("-w",) if "-o" in words else ())]
    peak, page = 0, os.sysconf("SC_PAGE_SIZE")
    with tempfile.TemporaryFile() as output:
        with subprocess.Popen(words, cwd=folder, env=environment, stdout=output) as process:
            held = Path(f"/proc/{process.pid}/statm")  # the usage told by wait4 may be this process's own
            while process.poll() is None:
                with contextlib.suppress(OSError, IndexError):
                    peak = max(peak, int(held.read_text().split()[1]) * page)
                time.sleep(0.01)
        output.seek(0)
        assert process.returncode == 0
        return json.loads(output.read()), peak


@pytest.mark.slow
@pytest.mark.parametrize("name", BIG)
def test_the_peak_is_as_foretold(large, name):
    measured(large, *BIG[name])  # compiles, which takes memory of its own
    said, peak = measured(large, *BIG[name])
    assert said["memory"]["peak_bytes"] == pytest.approx(peak, rel=0.1)
    assert said["memory"]["predicted_bytes"] == pytest.approx(peak, rel=0.25)


@pytest.mark.slow
def test_teachers_are_streamed_where_memory_is_short(large):
    """Eight teachers in little more than two need: the same fields as with all of them in memory, and not
    much more memory than is allowed: pictures of the naive composition of eight fields, which streaming
    draws, take a third more than is foretold. The peaks of two teachers are no measure: they differ by 30 MB
    from run to run."""
    limit = ("--max-size", "1.5MB")  # what two hold would not fit, so that as many numbers learn from eight
    two, _ = measured(large, "fuse", "s2.json", *limit, "-o", "free2.rfpack")
    measured(large, "fuse", "s8.json", *limit, "-o", "free8.rfpack")
    allowed = two["memory"]["predicted_bytes"] + (8 << 20)
    _, peak = measured(large, "fuse", "s8.json", *limit, "--memory", str(allowed), "-o", "tight8.rfpack")
    free, tight = (read_bundle(large / f"{name}8.rfpack").scene.leaves() for name in ("free", "tight"))
    assert [(leaf.name, leaf.field) for leaf in free] == [(leaf.name, leaf.field) for leaf in tight]
    assert peak <= 1.4 * allowed
