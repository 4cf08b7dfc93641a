"""A kind from another package: the one of docs/kinds.md, installed outside the tree, and broken ones."""

import json
import os
import re
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest
import torch
import trimesh

from tests.engine.conftest import BOX
from tests.engine.kernels.interpreted import assert_answers, assert_gradients

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "kinds.md"
# The command line, but that a draft is some steps: no clock decides what is learnt.
BRIEF = """
from fusedrf_cli.bridge.training import TrainPresets
from fusedrf_cli.engine.distillation.config import TrainConfig
from fusedrf_cli.engine.settings import using
from fusedrf_cli.main import main
with using(TrainPresets(draft=TrainConfig(longest=16, steps=300, samples=1 << 12))):
    main()
"""


def installed(folder: Path, name: str, files: dict[str, str], entry: str) -> None:
    """A package as pip leaves it: modules, and metadata that name its entry point."""
    for path, text in files.items():
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        (folder / path).write_text(text)
    metadata = folder / f"{name}-1.0.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
    (metadata / "entry_points.txt").write_text(f"[fusedrf.kinds]\n{entry}\n")


def page_files() -> dict[str, str]:
    """The modules of the page, by path: a heading names one, the next block of Python is its text."""
    found = re.findall(r"## `(fusedrf_cubes/\w+\.py)`.*?```python\n(.*?)```", PAGE.read_text(), re.S)
    assert [path for path, _ in found] == [f"fusedrf_cubes/{n}.py" for n in ("encoding", "field", "__init__")]
    return dict(found)


def fusedrf(folder: Path, *words: str) -> subprocess.CompletedProcess:
    """A command in a process that finds the packages of a folder, with little to learn."""
    paths = os.pathsep.join([str(folder / "site"), str(ROOT)])
    return subprocess.run(
        [sys.executable, "-c", BRIEF, *words],
        cwd=folder, env={**os.environ, "PYTHONPATH": paths}, capture_output=True, text=True,
    )  # fmt: skip


@pytest.fixture
def cubes(tmp_path):
    """A folder whose `site` has the page's kind."""
    installed(tmp_path / "site", "fusedrf_cubes", page_files(), "cubes = fusedrf_cubes")
    return tmp_path


def test_the_page_s_encoding_answers_and_sends_back_as_its_reference(cubes, monkeypatch):
    monkeypatch.syspath_prepend(str(cubes / "site"))
    page = import_module("fusedrf_cubes.field")
    field = page.CubesField(page.CubesShape(), BOX, (5, 4, 6), 3.0, 0.3)
    generator = torch.Generator().manual_seed(0)
    field = field.with_params(torch.randn(len(field.params), generator=generator, dtype=torch.float64))
    assert [group.rate for group in field.groups()] == [40.0, 40.0]
    assert_answers(field)
    for shaded in (True, False):
        assert_gradients(field, shaded)
    for name in [name for name in sys.modules if name.startswith("fusedrf_cubes")]:
        monkeypatch.delitem(sys.modules, name)


@pytest.mark.slow
def test_the_page_s_kind_is_listed_trained_and_rendered(cubes):
    ball = trimesh.creation.icosphere(subdivisions=2)
    ball.visual.vertex_colors = [200, 60, 40, 255]
    ball.export(cubes / "ball.glb")
    listed = fusedrf(cubes, "kinds", "--json")
    assert listed.returncode == 0, listed.stderr
    assert any(
        kind["name"] == "cubes" and kind["package"] == "fusedrf_cubes"
        for kind in json.loads(listed.stdout)["kinds"]
    )
    learnt = fusedrf(
        cubes, "train", "ball.glb", "-o", "ball.rfpack", "--kind", "cubes", "--views", "8", "--size", "32",
        "--quality", "draft", "--json",
    )  # fmt: skip
    assert learnt.returncode == 0, learnt.stderr
    report = json.loads(learnt.stdout)
    assert report["kind"] == "cubes" and report["training_psnr"] > 20
    shown = fusedrf(cubes, "render", "ball.rfpack", "-o", "ball.png", "--size", "32x32")
    assert shown.returncode == 0, shown.stderr
    (cubes / "elsewhere").mkdir()
    elsewhere = fusedrf(
        cubes / "elsewhere", "render", str(cubes / "ball.rfpack"), "-o", str(cubes / "no.png")
    )
    assert elsewhere.returncode == 3 and "unknown kind 'cubes'" in elsewhere.stderr
    assert not (cubes / "no.png").exists()


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("raise RuntimeError('no luck')", "does not load (RuntimeError: no luck)"),
        pytest.param(
            "import a_module_that_is_not_there",
            "does not load (ModuleNotFoundError",
            marks=pytest.mark.slow,
        ),
        pytest.param("KIND = 3", "is no Kind of that name", marks=pytest.mark.slow),
    ],
)
def test_a_broken_plug_in_breaks_only_itself(tmp_path, text, said):
    installed(tmp_path / "site", "broken_kind", {"broken_kind.py": text}, "broken = broken_kind")
    listed = fusedrf(tmp_path, "kinds")
    assert listed.returncode == 0 and "vm" in listed.stdout and "broken" in listed.stdout + listed.stderr
    refused = fusedrf(tmp_path, "train", str(ROOT / "examples"), "-o", "x.rfpack", "--kind", "broken")
    assert refused.returncode == 3 and said in refused.stderr and "broken_kind" in refused.stderr
    assert not (tmp_path / "x.rfpack").exists()
