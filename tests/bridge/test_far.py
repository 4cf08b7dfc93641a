"""What stands far from the world's origin, or is counted in tiny or huge units, is learnt, shown and edited
as the same at the origin: whole commands, before and after a similarity of the world."""

import json
import shutil
from functools import partial

import numpy as np
import pytest

from formats.bundle import read_bundle
from formats.images import read_image
from formats.scene import SceneGraph, make_node, write_scene
from fusedrf_cli.engine.distillation.fit import FitRun
from fusedrf_cli.engine.rendering.metrics import psnr
from tests.bridge.conftest import PLACES, done, invoke

ORDINARY = (1.0, (0.0, 0.0, 0.0))
WORLDS = {
    "map grid": (1.0, (432100.0, 5411200.0, 310.0)),
    "nanometres": (1e9, (3e9, -1e10, 2e9)),
    "tiny": (1e-9, (0.0, 2e-8, 0.0)),
    "farthest": (1e3, (-7e11, 1e12, 3e10)),
}
"""The unit, and where the origin of a scene of ordinary size comes to lie."""
TRIED = ["nanometres", *(pytest.param(w, marks=pytest.mark.slow) for w in WORLDS if w != "nanometres")]
SIDE = ("--size", "48x48")


class World:
    """A folder of fields and photos in a world, and its points and lengths as options give them."""

    def __init__(self, folder, unit: float, at):
        self.folder, self.unit, self.at = folder, unit, np.array(at)
        self.report = partial(done, folder)

    def lengths(self, *numbers: float) -> str:
        return ",".join(repr(float(number)) for number in self.unit * np.array(numbers))

    def point(self, *numbers: float) -> str:
        return ",".join(map(repr, (self.unit * np.array(numbers) + self.at).tolist()))

    def box(self, low: float, high: float) -> str:
        return f"{self.point(*[low] * 3)},{self.point(*[high] * 3)}"

    def move_cameras(self) -> None:
        """The photos in this world."""
        for path in (self.folder / "photos").glob("transforms_*.json"):
            content = json.loads(path.read_text())
            for frame in content["frames"]:
                pose = np.array(frame["transform_matrix"])
                pose[:3, 3] = self.unit * pose[:3, 3] + self.at
                frame["transform_matrix"] = pose.tolist()
            path.write_text(json.dumps(content))

    def place(self, file: str, *names: str) -> None:
        """A scene of some of the solids in this world."""
        nodes = (
            make_node(
                name,
                source=f"{name}.rfpack",
                scale=[self.unit] * 3,
                translation=self.unit * np.array(PLACES[name]) + self.at,
            )
            for name in names
        )
        write_scene(self.folder / file, SceneGraph(tuple(nodes)), overwrite=True)

    def pictures(self, scene: str, *words: str) -> np.ndarray:
        """(N, 48, 48, C) in [0, 1] that `render` takes."""
        self.report("render", scene, "-o", "pictures", "-w", *words)
        return np.stack([read_image(path) / 255 for path in sorted((self.folder / "pictures").iterdir())])


@pytest.fixture(scope="module")
def worlds(shop, tmp_path_factory):
    """worlds("tiny") -> that world, where the photos have been learnt and the scene fused and edited."""
    made = {}

    def world(name: str) -> World:
        if name not in made:
            folder = shutil.copytree(shop, tmp_path_factory.mktemp("world") / "shop")
            made[name] = filled(World(folder, *WORLDS.get(name, ORDINARY)))
        return made[name]

    return world


def filled(world: World) -> World:
    """The commands of a user who works there."""
    report = world.report
    world.move_cameras()
    world.place("scene.json", "floor", "red", "blue")
    world.place("pair.json", "floor", "red")
    learnt = ("--sh-degree", "1", "--holdout", "4")
    world.box_psnr, world.place_psnr = (
        report("train", "photos", "-o", name, *learnt, *more)["holdout"]["psnr"]
        for name, more in (
            ("box.rfpack", (f"--aabb={world.box(-0.5, 0.5)}",)),
            ("all.rfpack", ("--unbounded",)),
        )
    )
    report("fuse", "pair.json", "-o", "pair.rfpack")
    blue = ("--name", "blue", "-t", world.point(*PLACES["blue"]), "-s", repr(world.unit))
    report("add", "pair.rfpack", "blue.rfpack", *blue, "-o", "three.rfpack")
    report("move", "three.rfpack", "blue", "-t", world.lengths(-0.1, 0.3, 0), "-o", "moved.rfpack")
    report("delete", "moved.rfpack", "red", "-o", "less.rfpack")
    report("extract", "three.rfpack", "--name", "blue", "-o", "alone.rfpack")
    beside = ("-t", world.lengths(0, 0.6, 0.2), "-r", "0,0,30")
    report("duplicate", "three.rfpack", "red", "red-2", *beside, "-o", "two.rfpack")
    ball = f"{world.point(*PLACES['red'])},{0.6 * world.unit!r}"
    report("extract", "three.rfpack", "--sphere", ball, "--invert", "-o", "cut.rfpack")
    report("add", "box.rfpack", "blue.rfpack", *blue, "-o", "both.rfpack")
    for name in ("box", "all", "pair", "three", "moved", "less", "alone", "two", "cut", "both"):
        report("validate", f"{name}.rfpack")
        report("info", f"{name}.rfpack")
    return world


@pytest.mark.parametrize("name", TRIED)
def test_photos_are_learnt_as_at_the_origin(worlds, name):
    here, there = worlds("ordinary"), worlds(name)
    assert abs(there.box_psnr - here.box_psnr) < 0.2 and abs(there.place_psnr - here.place_psnr) < 0.2
    found = there.report("eval", "box.rfpack", "--against", "photos")["mean"]["psnr"]
    assert abs(found - here.report("eval", "box.rfpack", "--against", "photos")["mean"]["psnr"]) < 0.2


@pytest.mark.parametrize("name", TRIED)
def test_scenes_and_what_is_made_of_them_show_the_same(worlds, name):
    here, there = worlds("ordinary"), worlds(name)
    bundles = ("pair", "three", "moved", "less", "alone", "two", "cut")
    for scene in ("scene.json", *(f"{bundle}.rfpack" for bundle in bundles)):
        views = (("--orbit", "2"), ("--view-from", "30,20", "--zoom", "1.5"))
        for words in views:
            one, other = here.pictures(scene, *words, *SIDE), there.pictures(scene, *words, *SIDE)
            assert psnr(one, other) >= 60 and one.std() > 0.05
    at = ("--look-at", here.point(0.2, 0, 0)), ("--look-at", there.point(0.2, 0, 0))
    one, other = here.pictures("scene.json", *at[0], *SIDE), there.pictures("scene.json", *at[1], *SIDE)
    assert psnr(one, other) >= 60


@pytest.mark.parametrize("name", TRIED)
def test_far_bundles_keep_their_cameras_and_tell_older_readers(worlds, name):
    here, there = worlds("ordinary"), worlds(name)
    for bundle in ("box.rfpack", "all.rfpack"):
        one, other = here.pictures(bundle, "--views", "capture"), there.pictures(bundle, "--views", "capture")
        assert psnr(one, other) > 25  # learnt anew, from where the photos were taken
    scene = read_bundle(there.folder / "box.rfpack").scene
    assert scene.version == "1.3" and scene.far
    scene = read_bundle(here.folder / "box.rfpack").scene
    assert scene.version == "1.1" and not scene.far and not scene.nodes[0].placement


@pytest.mark.parametrize(
    ("unit", "at", "words"),
    [(1e3, (1e14, 0, 0), "1e+13"), (1e-13, (0, 0, 0), "scales by")],
)
def test_what_could_not_be_written_is_refused_before_anything_is_learnt(folder, monkeypatch, unit, at, words):
    world = World(folder, unit, at)
    world.move_cameras()
    monkeypatch.setattr(FitRun, "start", lambda *_: pytest.fail("it was learnt"))
    for more in ((f"--aabb={world.box(-0.5, 0.5)}",), ("--unbounded",)):
        result = invoke(folder, "train", "photos", "-o", "out.rfpack", *more)
        assert result.exit_code in (3, 4) and words in result.stderr, result.stderr
    assert not (folder / "out.rfpack").exists()
