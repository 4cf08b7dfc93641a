"""What each part of distilling is worth: python -m benchmarks.ablation FOLDER [SCENE.json] [--share S]

Distils a scene into one `vm` tensor of 12 million numbers by the recipe of `fuse --kind vm`, with five seeds,
and with one part at a time left out or put back to what FusedRF says; within the same steps where nothing
else is said, and judged on the same views, which nothing is trained on: of the scene, and of each object from
where and as large as it was photographed. Without a scene, one is made in FOLDER: four objects of
examples/make_scene.py, trained briefly. With --share, a share of the rays and steps that `fuse` takes. Prints
a Markdown table and writes FOLDER/ablation.csv.
"""

import argparse
import csv
import subprocess
import sys
from dataclasses import dataclass, field, replace
from pathlib import Path

import torch

from fusedrf_cli.bridge.looks import looks_of
from fusedrf_cli.bridge.scene import background_of, load_scene
from fusedrf_cli.engine.composition.affine import Placed
from fusedrf_cli.engine.composition.composed import ComposedField
from fusedrf_cli.engine.distillation.distill import DistillReport, DistillRun, Recipe
from fusedrf_cli.engine.distillation.judging import Judge
from fusedrf_cli.engine.distillation.losses import LossConfig
from fusedrf_cli.engine.distillation.sampler import RaySampler
from fusedrf_cli.engine.distillation.schedule import Schedule
from fusedrf_cli.engine.fields.streamed import opened
from fusedrf_cli.engine.kinds.student import DistilConfig, StudentConfig, Way
from fusedrf_cli.engine.kinds.vm import KIND as VM

VIEWS, VIEW_SIZE, VIEWS_SEED = 8, (200, 200), 11
TRAINED = ("--quality", "draft", "--views", "40", "--size", "200", "--max-size", "4MB")
PLACES = (
    ("ground.rfpack", ("--background-node",)),
    ("tower.rfpack", ("-t", "-0.8,0.4,0.06")),
    ("arch.rfpack", ("-t", "0.5,0.6,0.06", "-r", "0,0,35")),
    ("ball.rfpack", ("-t", "0.6,-0.7,0.06", "-s", "0.5")),
)


@dataclass(frozen=True)
class Variant:
    """One way to distil."""

    name: str
    recipe: Recipe = Recipe()
    config: dict = field(default_factory=dict)
    """What it changes of how a student learns."""
    from_scratch: bool = False
    rgb: bool = True
    rays: float = 1.0
    """The share of the rays that are asked."""
    steps: float = 1.0
    """The share of the steps from points."""
    numbers: float = 1.0
    """The share of the numbers."""
    seed: int = 0


class Steady(Schedule):
    """The rate falls from the first step to the last, whatever is found on the way."""

    end = 1.0

    def look(self, share: float, psnr: float) -> None:
        """Nothing follows from it."""

    def factor(self, share: float) -> float:
        """An exponential fall."""
        return self.config.rate_decay**share


def evenly(depth: torch.Tensor, transmittance: torch.Tensor) -> torch.Tensor:
    """About as many points as `matter_first` keeps, whatever they hold."""
    return torch.full_like(depth, 0.25)


def all_alike(transmittance: torch.Tensor) -> torch.Tensor:
    """Every point counts as much as any other."""
    return torch.ones_like(transmittance)


def raw_depth(depth: torch.Tensor, wanted: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """The squared error of σ itself, in optical depths of a step."""
    return (depth - wanted) ** 2, 2 * (depth - wanted)


def opacity(depth: torch.Tensor, wanted: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """The squared error of alpha; a student that is opaque feels nothing of it."""
    off = torch.exp(-wanted) - torch.exp(-depth)
    return off**2, 2 * off * torch.exp(-depth)


def capped_depth(depth: torch.Tensor, wanted: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """The squared error of optical depth up to what looks opaque."""
    off = depth - wanted.clamp_max(LossConfig.opaque)
    off[(depth >= LossConfig.opaque) & (wanted >= LossConfig.opaque)] = 0
    return off**2, 2 * off


WHOLE = Recipe()
PAPER = Recipe(evenly, raw_depth, all_alike, Steady)
LOW = {"rate": 0.02, "rgb_rate": 0.002, "coarse_from": None}
VARIANTS = (
    *(Variant(f"nothing, seed {seed}", seed=seed) for seed in range(5)),
    Variant("the pictures", rgb=False),
    Variant("the background's weights", from_scratch=True),
    Variant("the rays: half of them", rays=0.5),
    Variant("the rays: a quarter", rays=0.25),
    Variant("told more: twice the steps", steps=2.0),
    Variant("told more: twice the rays and steps", rays=2.0, steps=2.0),
    Variant("more numbers: twice", numbers=2.0),
    Variant("more of all: twice the numbers, rays and steps", rays=2.0, steps=2.0, numbers=2.0),
    Variant("points where matter is seen: evenly instead", replace(WHOLE, chance=evenly)),
    Variant("points by transmittance: all alike", replace(WHOLE, visibility=all_alike)),
    Variant("log1p of depth: raw depth", replace(WHOLE, density_loss=raw_depth)),
    Variant("log1p of depth: depth up to opaque", replace(WHOLE, density_loss=capped_depth)),
    Variant("log1p of depth: alpha", replace(WHOLE, density_loss=opacity)),
    Variant("the high rate: a quarter", config={"rate": 0.25 * DistilConfig.rate}),
    Variant("half the resolution first", config={"coarse_from": None}),
    Variant("the schedule: a steady fall", replace(WHOLE, schedule=Steady)),
    Variant("all of it: points evenly, raw depth, one resolution, a steady fall of a low rate", PAPER, LOW),
)


def made_scene(folder: Path) -> Path:
    """The scene of PLACES in a folder, made and trained where it is not there yet."""
    scene = folder / "scene.json"
    if scene.exists():
        return scene
    maker = Path(__file__).parent.parent / "examples" / "make_scene.py"
    subprocess.run([sys.executable, str(maker), str(folder)], check=True, stdout=subprocess.DEVNULL)
    call = [sys.executable, "-m", "fusedrf_cli"]
    for source, _ in PLACES:
        if not (folder / source).exists():
            mesh = Path(source).with_suffix(".glb").name
            subprocess.run([*call, "train", mesh, "-o", source, *TRAINED], cwd=folder, check=True)
    words = [word for source, placed in PLACES for word in (source, *placed)]
    subprocess.run([*call, "compose", *words, "-o", scene.name], cwd=folder, check=True)
    return scene


@dataclass(frozen=True)
class Task:
    """A scene to be distilled, and what its students are judged by."""

    composed: ComposedField
    background: Placed
    sampler: RaySampler
    settings: DistilConfig
    judge: Judge

    @classmethod
    def of(cls, scene: Path, share: float) -> "Task":
        """The scene as `fuse --kind vm` takes it up, with a share of its rays and steps."""
        loaded = load_scene(str(scene))
        composed = loaded.composed()
        name = background_of(loaded).placed.name
        placed = composed.placed[[p.name for p in loaded.placed].index(name)]
        background = Placed(name, opened(placed.field), placed.object_to_world)
        looks = looks_of(loaded, composed, VIEWS, VIEW_SIZE, VIEWS_SEED)
        judge = Judge(composed, [look.camera for look in looks], composed.origin)
        whole = DistilConfig()
        fewer = {name: round(share * getattr(whole, name)) for name in ("rays", "steps", "rgb_steps")}
        settings = replace(whole, **fewer)
        return cls(composed, background, RaySampler.of(composed), settings, judge)

    def distilled(self, variant: Variant) -> DistillReport:
        """What distilling by a variant's recipe gives."""
        told = round(variant.rays * self.settings.rays), round(variant.steps * self.settings.steps)
        settings = replace(self.settings, seed=variant.seed, rays=told[0], steps=told[1], **variant.config)
        most = round(variant.numbers * StudentConfig.told_numbers)
        plan = VM.plan(self.composed.aabb, self.composed.voxel_size, Way(), most)
        generator, student = torch.Generator().manual_seed(settings.seed), None
        if not variant.from_scratch:
            student = VM.taken_over(self.background, plan, self.composed, generator)
        if student is None:
            student = VM.empty(self.composed, Way(), most, generator, "fused")
        run = DistillRun(
            self.composed, student, self.sampler, settings, variant.rgb, variant.recipe, self.judge
        )
        return run.finish()[1]


COLUMNS = ("left out", "psnr after points", "psnr after pictures", "seconds", "steps")


def row_of(variant: Variant, report: DistillReport) -> list[str]:
    """A row of the table."""
    after = "" if report.psnr_after_rgb is None else f"{report.psnr_after_rgb:.2f}"
    steps = " + ".join(str(count) for count in report.steps.values())
    seconds = f"{sum(report.seconds.values()):.0f}"
    return [variant.name, f"{report.psnr_before_rgb:.2f}", after, seconds, steps]


def main() -> None:
    """Measure all variants."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("scene", type=Path, nargs="?")
    parser.add_argument("--share", type=float, default=1.0)
    given = parser.parse_args()
    given.folder.mkdir(parents=True, exist_ok=True)
    task = Task.of(given.scene or made_scene(given.folder), given.share)
    print(f"| {' | '.join(COLUMNS)} |\n|{'---|' * len(COLUMNS)}")
    with (given.folder / "ablation.csv").open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow(COLUMNS)
        for variant in VARIANTS:
            row = row_of(variant, task.distilled(variant))
            print(f"| {' | '.join(row)} |", flush=True)
            table.writerow(row)
            file.flush()


if __name__ == "__main__":
    main()
