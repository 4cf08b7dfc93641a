"""What stands far from the world's origin, or is counted in tiny or huge units, is learnt, shown and edited as what
stands at the origin: every command on the same scene after a similarity of the world."""

import json
import shutil
from functools import partial

import numpy as np
import pytest

from formats.bundle import read_bundle
from formats.images import read_image
from formats.scene import SceneGraph, make_node, read_scene, write_scene
from fusedrf_cli.bridge.scene import write_field
from tests.bridge.conftest import FIELDS, PLACES, done, invoke, write_scene_of, write_views

WORLDS = {
    "map grid": (1.0, (432100.0, 5411200.0, 310.0)),
    "millimetres": (1000.0, (0.0, 0.0, 0.0)),
    "nanometres": (1e9, (3e9, -1e10, 2e9)),
    "tiny": (1e-9, (0.0, 2e-8, 0.0)),
    "tiny and far": (1e-3, (5e5, 5e5, 0.0)),
    "farthest": (1.0, (-7e11, 1e12, 3e10)),
}
"""The unit, and where the origin of a scene of ordinary size comes to lie."""


def moved_world(folder, unit: float, at) -> None:
    """The photos' cameras after a similarity."""
    for split in ("train", "test"):
        path = folder / f"transforms_{split}.json"
        content = json.loads(path.read_text())
        for frame in content["frames"]:
            pose = np.array(frame["transform_matrix"])
            pose[:3, 3] = unit * pose[:3, 3] + at
            frame["transform_matrix"] = pose.tolist()
        path.write_text(json.dumps(content))


def decibels(one, other) -> float:
    return -10 * np.log10(max(np.mean((one / 255.0 - other / 255.0) ** 2), 1e-12))


def words_of(unit: float, at, box) -> str:
    """A box (6,) of the ordinary world as an option gives it."""
    return ",".join(repr(float(x)) for x in unit * np.array(box) + np.tile(at, 2))


def placed_scene(folder, unit: float, at, *names: str, file: str = "scene.json") -> None:
    """The scene of some of the solids in another world."""
    nodes = [
        make_node(
            n, source=f"{n}.rfpack", scale=[unit] * 3, translation=unit * np.array(PLACES[n]) + at, background=n == "floor"
        )
        for n in names
    ]
    write_scene(folder / file, SceneGraph(tuple(nodes)), overwrite=True)


@pytest.fixture(scope="module", params=[(1.0, (0.0, 0.0, 0.0)), *WORLDS.values()], ids=["ordinary", *WORLDS])
def world(request, shop, tmp_path_factory):
    """A shop in which everything was done in one world."""
    folder = shutil.copytree(shop, tmp_path_factory.mktemp("world") / "shop")
    unit, at = request.param[0], np.array(request.param[1])
    moved_world(folder / "photos", unit, at)
    placed_scene(folder, unit, at, "floor", "red", "blue")
    placed_scene(folder, unit, at, "floor", "red", file="pair.json")
    report = partial(done, folder)
    said = {}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(part("training"), "QUALITY", LONGER)
        box = words_of(unit, at, [-0.5, -0.5, -0.5, 0.5, 0.5, 0.5])
        said["train"] = report("train", "photos", "-o", "trained.rfpack", "--sh-degree", "1", f"--aabb={box}", "--holdout", "4")
        said["eval"] = report("eval", "trained.rfpack", "--against", "photos")
        said["place"] = report("train", "photos", "-o", "place.rfpack", "--sh-degree", "1", "--unbounded", "--holdout", "4")
    for kind in ("blocks", "vm", "sparse"):
        said[kind] = report("fuse", "scene.json", "-o", f"{kind}.rfpack", "--kind", kind, "--no-rgb")
    t = ",".join(repr(float(x)) for x in unit * np.array(PLACES["blue"]) + at)
    report("fuse", "pair.json", "-o", "two.rfpack")
    said["add"] = report("add", "two.rfpack", "blue.rfpack", "--name", "blue", f"-t={t}", "-s", repr(unit), "-o", "three.rfpack")
    said["move"] = report("move", "three.rfpack", "blue", f"-t={unit * 0.3!r},0,0", "-o", "moved.rfpack")
    said["delete"] = report("delete", "three.rfpack", "red", "-o", "less.rfpack")
    for name in ("trained", "place", "blocks", "vm", "sparse", "three", "moved", "less"):
        report("validate", f"{name}.rfpack")
        report("info", f"{name}.rfpack")
    for name in ("scene.json", "trained.rfpack", "place.rfpack", "blocks.rfpack", "vm.rfpack", "sparse.rfpack", "three.rfpack", "moved.rfpack", "less.rfpack"):
        report("render", name, "-o", f"{name}.png", "--size", "48x48")
        report("render", name, "-o", f"{name}-orbit", "--orbit", "3", "--size", "48x48")
    (folder / "said.json").write_text(json.dumps(said))
    return folder
