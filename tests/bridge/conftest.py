"""A folder of tiny solid fields, and the real bridge made small enough to run in seconds."""

import contextlib
import importlib
import json
import shutil
import signal
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from formats.captures import write_capture
from formats.images import read_image
from formats.scene import SceneGraph, make_node, write_scene
from formats.views import View
from fusedrf_cli.bridge.building import BuildingConfig
from fusedrf_cli.bridge.evaluating import EvaluationConfig
from fusedrf_cli.bridge.evaluation_views import EvaluationViewConfig
from fusedrf_cli.bridge.field_bundle import write_field
from fusedrf_cli.bridge.inpainting import InpaintingConfig
from fusedrf_cli.bridge.training import TrainPresets
from fusedrf_cli.engine.distillation.config import TrainConfig
from fusedrf_cli.engine.distillation.finetune import FinetuneConfig
from fusedrf_cli.engine.distillation.optimiser import Adam
from fusedrf_cli.engine.fields.occupancy import OccupancyConfig
from fusedrf_cli.engine.kinds.allocation import AllocationConfig
from fusedrf_cli.engine.kinds.distil_config import DistilConfig
from fusedrf_cli.engine.kinds.resampled import ResampledBuilder
from fusedrf_cli.engine.kinds.sparse.builder import SparseBuilder
from fusedrf_cli.engine.kinds.vm.builder import VMBuilderConfig
from fusedrf_cli.engine.kinds.vm.field import VMField
from fusedrf_cli.engine.rendering.cameras import orbit
from fusedrf_cli.engine.rendering.volume import render_image
from fusedrf_cli.engine.settings import using
from fusedrf_cli.main import cli
from fusedrf_cli.signals import interrupt
from tests.analytic.export import SHAPE, vm_field
from tests.analytic.fields import Box, Tint

TinySettings = partial(
    DistilConfig,
    rays=3000,
    steps=50,
    points_per_step=1 << 13,
    rgb_steps=10,
    rgb_samples=1 << 12,
    views=2,
    view_size=32,
)
"""A distillation of a second."""


PLACES = {"floor": (0, 0, -0.7), "red": (-0.5, 0, 0), "blue": (0.7, 0, 0)}


def part(name: str):
    """A module of the bridge: its package's attributes of that name are the functions."""
    return importlib.import_module(f"fusedrf_cli.bridge.{name}")


def solid(rgb, half=(0.3, 0.3, 0.3), density: float = 20.0) -> VMField:
    """A box of one density and one colour around its origin, on 16 x 16 x 16 texels."""
    return vm_field(Box(density, half, tint=Tint.of(*rgb)))


FIELDS = {
    "floor": solid((0.3, 0.6, 0.3), (1.4, 0.8, 0.2)),
    "red": solid((0.9, 0.1, 0.1)),
    "blue": solid((0.1, 0.2, 0.9)),
}


def write_scene_of(folder: Path, *names: str, file: str = "scene.json", **more) -> None:
    """A scene of some of the solids at their PLACES; `more` are words of the scene graph."""
    nodes = [
        make_node(n, source=f"{n}.rfpack", translation=PLACES[n], background=n == "floor") for n in names
    ]
    write_scene(folder / file, SceneGraph(tuple(nodes), **more))


def write_views(folder: Path, field=None, at=(0.0, 0.0, 0.0), side: int = 24, around: int = 5) -> None:
    """A capture of views of a field (the red box) that stands somewhere, `around` it from above and as many
    from below; of each the last is a test view."""
    field, at = field or FIELDS["red"], np.array(at, np.float64)
    box = 4 / 3 * field.aabb + np.tile(at, 2)
    cameras = orbit(box, around, side, side) + orbit(box, around, side, side, elevation=-0.5)
    views, pixels = [], []
    for i, c in enumerate(cameras):
        shot = render_image(field, c, origin=at)
        alpha = shot.opacity[..., None]
        straight = shot.rgb / np.maximum(alpha, 1e-6)
        pixels.append(np.rint(255 * np.clip(np.concatenate([straight, alpha], -1), 0, 1)).astype(np.uint8))
        views.append(View(f"r_{i}", c.camera_to_world, c.fl_x, c.fl_y, c.cx, c.cy, side, side))
    test = [around - 1, 2 * around - 1]
    train = [i for i in range(len(views)) if i not in test]
    for split, chosen in (("train", train), ("test", test)):
        write_capture(folder, [views[i] for i in chosen], np.stack([pixels[i] for i in chosen]), split)


DRAFT = TrainConfig(longest=24, steps=60, samples=1 << 13, steps_to_show=1)
TINY = (
    OccupancyConfig(scene_cells=48),
    EvaluationViewConfig(whole=2, most_objects=0),
    EvaluationConfig(size=(96, 96)),
    BuildingConfig(views=2),
    VMBuilderConfig(SHAPE),
    InpaintingConfig(None, settings=TinySettings(), numbers=VMField.size_of(SHAPE, (20, 20, 20))),
    TrainPresets(DRAFT, DRAFT, DRAFT, DRAFT),
    TinySettings(),
    FinetuneConfig(rays=15_000, steps=30, rays_per_step=500),
    AllocationConfig(ranks=()),  # others would be compiled
)
"""Coarse grids, few steps, and few pictures to judge by."""


def make_tiny(patch: pytest.MonkeyPatch) -> None:
    """Few steps, small pictures: what is tested here is the way, not the quality."""
    for made in (SparseBuilder, ResampledBuilder):
        patch.setattr(
            made, "distil_config", replace(made.distil_config, points_per_step=1 << 13, views=2, view_size=32)
        )


@pytest.fixture(scope="module", autouse=True)
def tiny():
    with pytest.MonkeyPatch.context() as patch, using(*TINY):
        make_tiny(patch)
        yield


def stock_fields(folder: Path) -> None:
    """floor, red and blue as bundles, scene.json of all three, and pair.json of two."""
    for name, field in FIELDS.items():
        write_field(str(folder / f"{name}.rfpack"), field, name, precision="float16", overwrite=False)
    write_scene_of(folder, "floor", "red", "blue")
    write_scene_of(folder, "floor", "red", file="pair.json")


@pytest.fixture(scope="session")
def shop(tmp_path_factory) -> Path:
    """A folder with the fields and scenes, and photos of the red box."""
    folder = tmp_path_factory.mktemp("shop")
    stock_fields(folder)
    write_views(folder / "photos")
    return folder


def invoke(folder: Path, *words: str):
    """click's Result of a command line in a folder."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        return CliRunner().invoke(cli, words)


def done(folder: Path, *words: str) -> dict:
    """The JSON report of a command line that has to succeed."""
    result = invoke(folder, *words, "--json")
    assert result.exit_code == 0, result.stderr
    return json.loads(result.stdout)


@pytest.fixture
def folder(tmp_path, shop) -> Path:
    """A copy of the shop that a test may spoil."""
    return Path(shutil.copytree(shop, tmp_path / "shop"))


@pytest.fixture
def run(folder):
    """run("info", "red.rfpack") -> click's Result, in `folder`."""
    return partial(invoke, folder)


@pytest.fixture
def report(folder):
    """report("fuse", ...) -> the JSON of a command that succeeds, in `folder`."""
    return partial(done, folder)


@pytest.fixture
def picture(folder, report):
    """picture("fused.rfpack", …) -> (H, W, 3) in [0, 1] of a scene from one camera over white, with more
    words for `render`."""
    transforms = folder / "eye.json"
    c = orbit(np.array([-1.4, -0.8, -0.9, 1.4, 0.8, 0.4]), 1, 48, 48)[0]
    content = {"fl_x": c.fl_x, "fl_y": c.fl_y, "cx": c.cx, "cy": c.cy, "w": 48, "h": 48}
    frame = {"file_path": "eye", "transform_matrix": c.camera_to_world.tolist()}
    transforms.write_text(json.dumps({**content, "frames": [frame]}))

    def picture(scene: str, *words: str) -> np.ndarray:
        report("render", scene, "--cameras", "eye.json", "-o", "eye.png", "-w", *words)
        return read_image(folder / "eye.png")[..., :3] / 255

    return picture


def blues(image: np.ndarray) -> int:
    """How many pixels of a picture are as blue as the blue box."""
    return int(((image[..., 2] > 0.6) & (image[..., 0] < 0.4) & (image[..., 1] < 0.45)).sum())


@pytest.fixture
def interrupted_in_step(monkeypatch):
    """with interrupted_in_step(6): SIGINT comes during the 6th step, before it moves the numbers."""

    @contextlib.contextmanager
    def interrupted_in_step(at: int, times: int = 1):
        step, calls = Adam.step, []

        def interrupted(self, rate):
            calls.append(rate)
            if len(calls) == at:
                for _ in range(times):
                    signal.raise_signal(signal.SIGINT)
            step(self, rate)

        previous = signal.signal(signal.SIGINT, interrupt)  # as the process itself has it
        try:
            with monkeypatch.context() as patch:
                patch.setattr(Adam, "step", interrupted)
                yield
        finally:
            signal.signal(signal.SIGINT, previous)
        assert len(calls) >= at

    return interrupted_in_step
