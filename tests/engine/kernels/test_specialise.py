"""One set of loops for all kinds: names that tell compiled code apart, and code that is found again."""

import os
import subprocess
import sys
from types import FunctionType, ModuleType

import pytest

from fusedrf_cli.engine.decoders import density_sum, sh, sh_basis
from fusedrf_cli.engine.encodings import bricks, line, plane_line
from fusedrf_cli.engine.kernels import ahead, instances, learning, light, loops, primitives, specialise
from fusedrf_cli.engine.kernels.assembled import assemble
from fusedrf_cli.engine.spaces import SPACES, bounded, unbounded
from tests.engine.kinds.cases import KINDS

VM = assemble(plane_line, plane_line, density_sum, sh_basis)
CP = assemble(line, line, density_sum, sh_basis)
SPARSE = assemble(bricks, bricks, density_sum, sh)
SIZES = {"RANK": 8, "SCRATCH": 1, "KEPT": 0}

SCRIPT = """
import numpy as np, sys, torch
from fusedrf_cli.engine import kernels
from fusedrf_cli.engine.kernels.loops import PointValues, PointBatch
from fusedrf_cli.engine.kernels.specialise import Loops
from fusedrf_cli.engine.spaces import bounded
sys.path.insert(0, {folder!r})
import toy
told = []
field, grid = toy.Arrays(np.ones(4)), kernels.GridArrays(np.zeros((1, 1, 1), np.uint8), *np.eye(3))
grid = grid._replace(lo=np.zeros(3), hi=np.ones(3), cell=np.ones(3))
with kernels.report_compilation(lambda: told.append(1)):
    for rank in map(int, sys.argv[1:]):
        found = PointValues(np.zeros(1), np.zeros((1, 3)))
        asked = PointBatch(np.full((1, 3), 0.5), np.eye(3)[:1], True)
        sizes = {{"RANK": rank, "SCRATCH": 1, "KEPT": 0}}
        Loops(toy, sizes, bounded).each("query_point", field, grid, asked, 1, found)
        print(found.sigma[0], found.rgb[0, 0])
print(len(told))
"""

TOY = """
from typing import NamedTuple
from fusedrf_cli.engine.kernels.primitives import sigmoid
class Arrays(NamedTuple):
    params: object
def sizes(field):
    return {}
def density(field, grid, k, p, d, scratch):
    return RANK * field.params[0], 0.0, 1, 0
def colour(field, place, p, d, scratch, memory, at):
    return SHOWN
def backward(field, place, p, d, pre, d_sigma, shaded, rgb, d_rgb, scratch, memory, at, grad):
    pass
""".replace("SHOWN", "0.25, 0.5, 0.75")


@pytest.fixture
def ask(tmp_path):
    """What a process of its own answers for fields of some sizes, and whether it compiled anything."""
    (tmp_path / "toy.py").write_text(TOY)
    # one thread: its loops take less long to compile, in a cache that is the engine's own choice
    environment = os.environ | {"XDG_CACHE_HOME": str(tmp_path / "cache"), "NUMBA_NUM_THREADS": "1"}
    environment.pop("NUMBA_CACHE_DIR", None)

    def run(*ranks: int, script: str = SCRIPT) -> list[str]:
        script = script.format(folder=str(tmp_path))
        command = [sys.executable, "-c", script, *map(str, ranks)]
        done = subprocess.run(command, env=environment, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        return done.stdout.split("\n")[:-1]

    run.folder = tmp_path
    return run


def test_sizes_and_changed_files_have_code_of_their_own_and_a_second_process_compiles_nothing(ask):
    """Two sizes of one kind, in one cache: without a name of its own one would load the other's code."""
    assert ask(8, 16) == ["8.0 0.25", "16.0 0.25", "1"]
    assert ask(16, 8) == ["16.0 0.25", "8.0 0.25", "0"]
    # its functions are inlined into loops of another file, where numba looks for no change
    (ask.folder / "toy.py").write_text(TOY.replace("0.25, 0.5", "0.35, 0.5"))
    assert ask(8) == ["8.0 0.35", "1"]


PARTS = """
import numpy as np, sys
from types import SimpleNamespace
from fusedrf_cli.engine import kernels
from fusedrf_cli.engine.decoders import density_sum, rgb
from fusedrf_cli.engine.kernels.assembled import assemble
from fusedrf_cli.engine.kernels.loops import PointValues, PointBatch
from fusedrf_cli.engine.kernels.specialise import Loops
from fusedrf_cli.engine.spaces import bounded
sys.path.insert(0, {folder!r})
import flat
told, device_module = [], assemble(flat, flat, density_sum, rgb)
sizes = {{"density": flat.sizes(), "colour": flat.sizes(), "sigma": density_sum.sizes(), "rgb": rgb.sizes(3)}}
slots = {{name: SimpleNamespace(sizes=s) for name, s in sizes.items()}}
sizes = device_module.sizes(SimpleNamespace(slots=slots, colour_activation="sigmoid"))
field = device_module.Arrays(np.ones(4), np.zeros(3), np.ones(3), np.array([1.0, 20.0]))
grid = kernels.GridArrays(np.zeros((1, 1, 1), np.uint8), np.zeros(3), np.ones(3), np.ones(3))
with kernels.report_compilation(lambda: told.append(1)):
    found = PointValues(np.zeros(1), np.zeros((1, 3)))
    asked = PointBatch(np.full((1, 3), 0.5), np.eye(3)[:1], True)
    Loops(device_module, sizes, bounded).each("query_point", field, grid, asked, 1, found)
print(found.sigma[0], round(found.rgb[0, 0], 6))
print(len(told))
"""
FLAT = """
def sizes():
    return {"WIDTH": 3}
def forward(field, unit, scratch, out, base):
    out[base] = 0.0
    out[base + 1], out[base + 2] = 0.0, 0.0
def backward(field, unit, d, base, scratch, grad):
    pass
def summed(field, unit, scratch):
    return field.params[1]
def summed_backward(field, unit, d, base, scratch, grad):
    pass
"""


def test_a_second_process_compiles_nothing_of_an_assembled_field(ask):
    """Its module is made while running: what is kept is found by the modules of its parts."""
    (ask.folder / "flat.py").write_text(FLAT)
    assert ask(script=PARTS) == ["21.0 0.5", "1"]
    assert ask(script=PARTS) == ["21.0 0.5", "0"]


def tag(device_module: ModuleType = VM, sizes: dict = SIZES, space: ModuleType = bounded) -> str:
    return specialise.specialised(device_module, sizes, space)[0]


def test_kinds_sizes_and_spaces_have_names_of_their_own():
    sizes = [SIZES | {"density_RANK": rank} for rank in (8, 16)]
    tags = [tag(), tag(SPARSE), tag(CP), *(tag(sizes=each) for each in sizes), tag(space=unbounded)]
    assert len(set(tags)) == len(tags) and tag() == tags[0]


def test_what_means_the_same_is_compiled_once():
    """And what reads a size, or calls what does, for each size."""
    (_, few), (_, more) = (specialise.specialised(VM, SIZES | {"density_RANK": n}, bounded) for n in (8, 16))
    own = {"density", "query_point", "train_ray", "peak_of_cell"}
    assert all(few[name] is not more[name] for name in own)
    assert all(few[name] is more[name] for name in ("piece", "next_sample", "march_ray", "march"))
    _, others = specialise.specialised(CP, SIZES, bounded)
    assert others["march"] is few["march"] and others["sh_basis"] is few["sh_basis"]
    _, curved = specialise.specialised(VM, SIZES | {"density_RANK": 8}, unbounded)
    assert curved["density_forward"] is few["density_forward"] and curved["march"] is not few["march"]


def test_a_meaning_is_what_a_function_does():
    """Not how its names are spelt, but all that it reads and calls."""

    def meaning_of(text: str, **names) -> str:
        exec(text, names)
        functions = {n: f for n, f in names.items() if isinstance(f, FunctionType)}
        return specialise.Meanings(names, functions).of("f")

    plain = meaning_of("def f(x): return x + A", A=1)
    assert plain == meaning_of("def f(x): return x + B", B=1)
    others = [
        meaning_of("def f(x): return x + A", A=2),
        meaning_of("def f(x): return x - A", A=1),
        meaning_of("def f(x): return x.A + A", A=1),
        meaning_of("def f(x, y=1): return x + A", A=1),
        meaning_of("def f(x): return x + 1", A=1),
        meaning_of("def g(x): return x + 1\ndef f(x): return g(x)"),
        meaning_of("def g(x): return x + A\ndef f(x): return g(x)", A=1),
        meaning_of("def g(x): return x + A\ndef f(x): return g(x)", A=2),
        meaning_of("def f(x): return g(x)", g=max),
        meaning_of("def f(x): return g(x)", g=min),
        meaning_of("def f(x): return min(x)"),
        meaning_of("def f(x): return max(x)"),
    ]
    assert len({plain, *others}) == 1 + len(others)


def test_every_loop_carries_the_name_of_its_item():
    runs = specialise.Loops(VM, SIZES, bounded)
    runs = [runs._over("each", item) for item in ("query_point", "show_ray")]
    assert len({run.py_func.__qualname__ for run in runs}) == 2


HOOKS = {
    "ray_setup", "ray_backward", "pack_cell", "unpack_cell", "next_index", "is_inside", "prefetch_density",
    "prefetch_colour", "COLOUR_FROM", "LEARN_FROM", "SHARED_COLOUR_FROM", "REST_FROM", "SHADING_COST",
    "next_sample", "next_change", "optical_length", "lane_of", "enter_lane", "fill_lanes", "LANES",
    "LANE_ROOM",
}  # fmt: skip
"""What a kind or a space may have in place of the loops' own, see loops.py."""


@pytest.mark.parametrize("space", SPACES.values(), ids=SPACES)
@pytest.mark.parametrize("name", KINDS)
def test_no_name_means_two_things_in_a_namespace(name, space):
    """It is flat, and the later name wins: a template's constant would be a kind's offset in scratch."""
    field = KINDS[name]()
    ours = [vars(module) for module in (primitives, loops, ahead, learning, instances, light, space)]
    theirs = vars(field.device_module)
    meanings: dict[str, object] = {}
    for names in (*ours, theirs, field.device_module.sizes(field)):
        for key, value in names.items():
            if not key.startswith("__") and key not in HOOKS:
                assert meanings.setdefault(key, value) is value, key


def test_what_a_kind_leaves_out_has_a_default():
    _, names = specialise.specialised(SPARSE, SIZES, bounded)
    assert names["ray_backward"].py_func.__code__ == SPARSE.ray_backward.__code__
    assert names["next_index"].py_func.__code__ == SPARSE.next_index.__code__
    _, names = specialise.specialised(CP, SIZES, bounded)
    assert names["next_index"].py_func.__code__ == loops.next_index.__code__
    assert names["ray_backward"].py_func.__code__ == CP.ray_backward.__code__
