"""Every kind on the same scenes, the paper's Tables 1 and 2 with figures instead of ticks:
python -m benchmarks.table1 DATA [--out docs] [--share 1] [--kind KIND] [--only PART] [--keep FOLDER]
(or make bench-table1 DATA=…)

DATA is a folder with chair/, fox/, bear/ and fuze/fuze.obj; --share multiplies all seconds of learning. OUT
gets table1.md and, in table1/, the tables and plots that it is made of, part by part:
    trained    each kind on each capture: held-out PSNR over minutes, bytes
    composed   N copies of each kind's chair, all different to the renderer: memory and a frame
    students   four trained objects distilled into one field of each kind, of several sizes, with and without
               finetuning on rays
    converted  each kind once into the next, against the weaker of both trained for as long
    others     compositions of other systems: ranks put side by side (CCNeRF), and densities added up
               (D²NeRF), against the composite
Rows that a run leaves out stay as they were, each with its commit.
"""

import argparse
import csv
import tempfile
from collections.abc import Callable, Iterator
from copy import copy
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from benchmarks.commit import commit_column, commit_line
from benchmarks.paper.figures import over_time
from benchmarks.paper.sources import four_objects
from benchmarks.paper.table import markdown
from benchmarks.paper.work import Work, course, fusedrf, median_frame, tell, write_csv
from fusedrf_cli import plots
from fusedrf_cli.bridge.scene import load_scene
from fusedrf_cli.engine.composition.affine import Placed
from fusedrf_cli.engine.composition.composed import ComposedField
from fusedrf_cli.engine.composition.composite import Composite
from fusedrf_cli.engine.distillation.occupancy_update import occupancy_of
from fusedrf_cli.engine.fields.occupancy import enclosing, texels
from fusedrf_cli.engine.fields.streamed import opened
from fusedrf_cli.engine.kinds import registry
from fusedrf_cli.engine.kinds.vm.field import VMField
from fusedrf_cli.engine.rendering.cameras import Camera, framing_camera
from fusedrf_cli.engine.rendering.metrics import psnr
from fusedrf_cli.engine.rendering.volume import render_image
from fusedrf_cli.engine.settings import current

SCENES = {"chair": (60, 300), "fox": (60, 180), "bear": (60, 180)}
"""Seconds of learning of each capture."""
EVERY = 8  # photos of which one is held out, where a capture has no test set
NUMBERS = 1, 2, 4, 8  # of copies
SIZES = 1, 3, 10, 25  # megabytes of a student
LEAST_FILLED = 0.35  # of the megabytes, or else the kind has no larger student
KEYS = {
    "trained": ("kind", "capture", "minutes"), "composed": ("kind", "N"),
    "students": ("kind", "at most, MB", "finetuned"), "converted": ("from", "to", "minutes"),
    "others": ("way", "N"),
}  # fmt: skip
"""Of each part, the columns by which a row is known."""
ABOUT = {
    "trained": "PSNR is of the test set of the chair, and of every eighth photo, which is held out, of the "
    "others; *minutes* are the time budget of learning.",
    "composed": "N copies of each kind's chair stand side by side in a frame of 400 × 400; the renderer does "
    "not know that they are alike. *MB held* are their numbers and cells in memory, *frame* is the median of "
    "five as composed, and *naive* that of the composition that asks every field at every sample.",
    "students": "Four trained objects that fill the frame, distilled into one field of each kind in a minute "
    "of learning: PSNR against the scene as composed on views that nothing was learnt from, and of the "
    "pixels that it covers; *seconds* are those of the whole command. `mlp` is of one size.",
    "converted": "Each kind once into the next. *Lost* is the PSNR of the weaker of both kinds, trained from "
    "photos for as long, less that of the converted field, on the chair's test set.",
    "others": "N chairs of the kind `vm` side by side. *ranks* are those fields' components put side by side "
    "on one grid (Tang et al., NeurIPS 2022, CCNeRF, sec. 3.4), by which objects must be neither turned nor "
    "scaled; *add* is a scene whose densities add up (Wu et al., NeurIPS 2022, D²NeRF). PSNR is against the "
    "composite by the rule `max`.",
}


@dataclass(frozen=True)
class TableConfig:
    """How kinds are compared."""

    lesson: float = 60.0
    """Seconds of a student's learning."""
    conversion: float = 300.0
    frame: int = 400
    """Pixels a side."""
    frames: int = 5
    """That are timed."""


@dataclass(frozen=True)
class Run:
    """Where a run reads and writes, what it measures, and the rows so far."""

    data: Path
    out: Path
    folder: Path
    share: float
    kinds: list[str]

    def rows(self, part: str) -> list[dict]:
        """Those of a part that are there."""
        path = self.out / "table1" / f"{part}.csv"
        if not path.exists():
            return []
        with path.open(newline="", encoding="utf-8") as file:
            return list(csv.DictReader(file))

    def note(self, part: str, row: dict) -> None:
        """Put a row in place of one of the same keys, or behind the others, and write the page."""
        row = {name: f"{v:.4g}" if isinstance(v, float) else str(v) for name, v in row.items()}
        tell(f"{part}: {row}")
        key = [row[name] for name in KEYS[part]]
        rows = [r for r in self.rows(part) if [r[name] for name in KEYS[part]] != key] + [
            row | commit_column()
        ]
        write_csv(self.out / "table1" / f"{part}.csv", sorted(rows, key=lambda r: r[KEYS[part][0]]))
        write_page(self)

    def field(self, kind: str, capture: str, seconds: float) -> Path:
        """Where such a field is kept."""
        return self.folder / f"{capture}-{kind}-{seconds:g}.rfpack"


# -- measuring -----------------------------------------------------------------------------------------------


def trained(run: Run, kind: str, capture: str, seconds: float) -> float:
    """Train a field, and note its row; the held-out PSNR."""
    path, folder = run.field(kind, capture, seconds), run.data / capture
    tested = (folder / "transforms_test.json").exists()
    words = () if tested else ("--holdout", str(EVERY))
    report = fusedrf(
        run.folder,
        "train",
        str(folder),
        "-o",
        path.name,
        "--kind",
        kind,
        "--time-budget",
        str(seconds),
        *words,
    )
    if tested:
        report["holdout"] = fusedrf(run.folder, "eval", path.name, "--against", str(folder))["mean"]
    run.note(
        "trained",
        {
            "kind": kind, "capture": capture, "minutes": seconds / 60,
            "PSNR": report["holdout"]["psnr"], "SSIM": report["holdout"]["ssim"],
            "MB": report["bytes"] / 1e6, "steps": report["steps"],
        },
    )  # fmt: skip
    return report["holdout"]["psnr"]


def known(run: Run, kind: str, capture: str, seconds: float) -> float:
    """The held-out PSNR of a field, which is trained unless it is there with its row."""
    minutes = f"{seconds / 60:.4g}"
    for row in run.rows("trained"):
        if [row[name] for name in KEYS["trained"]] == [kind, capture, minutes]:
            if run.field(kind, capture, seconds).exists():
                return float(row["PSNR"])
    return trained(run, kind, capture, seconds)


def all_trained(run: Run) -> None:
    """See the part `trained`."""
    for capture, budgets in SCENES.items():
        for kind in run.kinds:
            for seconds in budgets:
                trained(run, kind, capture, seconds * run.share)


def copies(field: Placed, count: int) -> list[Placed]:
    """Fields side by side along x that share no number."""
    wide = 1.1 * (field.aabb[3] - field.aabb[0])
    placed = []
    for i in range(count):
        matrix = field.object_to_world.copy()
        matrix[0, 3] += i * wide
        own = field.field.with_params(field.field.params.clone())
        placed.append(replace(field, field=own, object_to_world=matrix, name=f"{field.name}-{i}"))
    return placed


def camera_of_all(placed: list[Placed], size: int) -> Camera:
    """A camera that frames fields."""
    box = enclosing([p.aabb for p in placed])
    return framing_camera(box, 0.9, 0.45, size, size)


def held_bytes(placed: list[Placed]) -> int:
    """Of the numbers that fields hold, and of their cells; vertices that nothing reaches take no memory."""
    numbers = sum(array.nbytes for p in placed for array in p.field.state()[0].values())
    return numbers + sum(p.field.occupancy.skip.nbytes for p in placed)


def composed(run: Run) -> None:
    """See the part `composed`."""
    config, seconds = current(TableConfig), SCENES["chair"][0] * run.share
    for kind in run.kinds:
        if not run.field(kind, "chair", seconds).exists():
            trained(run, kind, "chair", seconds)
        (one,) = load_scene(str(run.field(kind, "chair", seconds))).placed
        for count in NUMBERS:
            placed = copies(replace(one, field=opened(one.field)), count)
            camera = camera_of_all(placed, config.frame)
            whole, alone = Composite(placed), ComposedField(placed)
            naive = median_frame(alone, camera, alone.origin, 1)
            frame = median_frame(whole, camera, whole.origin, config.frames)
            held = held_bytes(placed) / 1e6
            run.note(
                "composed", {"kind": kind, "N": count, "MB held": held, "frame, s": frame, "naive, s": naive}
            )


def students(run: Run) -> None:
    """See the part `students`."""
    config = current(TableConfig)
    scene = four_objects(Work(run.folder, run.out, run.data))
    held = course(scene, config.frame)
    for kind in run.kinds:
        for megabytes in SIZES:
            for word in ("--no-finetune", "--finetune"):
                path = scene.with_name(f"student-{kind}-{megabytes}.rfpack")
                words = ("--kind", kind, "--max-size", f"{megabytes}MB", "--from-scratch", word)
                words += ("--time-budget", str(config.lesson * run.share))
                try:
                    report = fusedrf(scene.parent, "fuse", scene.name, "-o", path.name, *words)
                except RuntimeError as error:  # a kind whose smallest is larger
                    tell(str(error))
                    continue
                found = held.quality(path)
                run.note(
                    "students",
                    {
                        "kind": kind, "at most, MB": megabytes, "finetuned": word == "--finetune",
                        "PSNR": found["psnr"], "covered": found["covered"], "SSIM": found["ssim"],
                        "MB": report["bytes"] / 1e6, "seconds": report["total_seconds"],
                    },
                )  # fmt: skip
            if path.exists() and path.stat().st_size < LEAST_FILLED * 1e6 * megabytes:
                break  # a network is of one size


def converted(run: Run) -> None:
    """See the part `converted`."""
    seconds = current(TableConfig).conversion * run.share
    alone = {kind: known(run, kind, "chair", seconds) for kind in run.kinds}
    for source, target in zip(run.kinds, [*run.kinds[1:], run.kinds[0]], strict=True):
        path = run.folder / f"converted-{source}-{target}.rfpack"
        given = run.field(source, "chair", seconds).name
        words = ("-o", path.name, "--kind", target, "--time-budget", str(seconds))
        report = fusedrf(run.folder, "convert", given, *words)
        shown = fusedrf(run.folder, "eval", path.name, "--against", str(run.data / "chair"))["mean"]["psnr"]
        weaker = min(alone[source], alone[target])
        run.note(
            "converted",
            {
                "from": source, "to": target, "minutes": seconds / 60, "PSNR": shown,
                "of the source": alone[source],
                "of the target, trained": alone[target], "lost": weaker - shown,
                "MB": report["bytes"] / 1e6,
            },
        )  # fmt: skip


def concatenated(placed: list[Placed]) -> VMField:
    """One field with the components of all, each on the grid over them all."""
    box = enclosing([p.aabb for p in placed])
    voxel = min(p.field.voxel_size for p in placed)
    resolution, wide = texels(box, int(np.ceil((box[3:] - box[:3]).max() / voxel))), []
    for p in placed:
        moved = copy(p.field)
        moved.box = p.field.box + np.tile(p.object_to_world[:3, 3], 2)
        wide.append(moved.resampled(box, resolution).sections())
    first, count = placed[0].field, len(placed)
    shape = replace(
        first.shape,
        density_rank=count * first.shape.density_rank, colour_rank=count * first.shape.colour_rank,
    )  # fmt: skip
    whole = type(first)(shape, box, resolution, first.scale, first.shift)
    for name, target in whole.sections().items():
        parts = [sections[name] for sections in wide]
        if name == "colour_basis":  # components of a mode lie together
            parts = [part.unflatten(-1, (3, -1)) for part in parts]
            target.copy_(torch.cat(parts, -1).flatten(-2))
        else:
            target.copy_(torch.cat(parts, -1))
    return whole.with_occupancy(occupancy_of(whole))


def others(run: Run) -> None:
    """See the part `others`."""
    config, seconds = current(TableConfig), SCENES["chair"][0] * run.share
    if not run.field("vm", "chair", seconds).exists():
        trained(run, "vm", "chair", seconds)
    (one,) = load_scene(str(run.field("vm", "chair", seconds))).placed
    for count in NUMBERS[1:]:
        placed = copies(replace(one, field=opened(one.field)), count)
        whole = concatenated(placed)
        ways = {
            "composite": Composite(placed),
            "ranks": Composite([Placed("ranks", whole, np.eye(4))]),
            "add": Composite(placed, rule="add"),
        }
        camera = camera_of_all(placed, config.frame)
        shown = {way: render_image(scene, camera, origin=scene.origin).over() for way, scene in ways.items()}
        for way, scene in ways.items():
            held = whole.params.nbytes if way == "ranks" else held_bytes(placed)
            alike = "" if way == "composite" else f"{psnr(shown[way], shown['composite']):.1f}"
            frame = median_frame(scene, camera, scene.origin, config.frames)
            run.note(
                "others",
                {"way": way, "N": count, "MB held": held / 1e6, "frame, s": frame, "PSNR": alike},
            )


PARTS: dict[str, Callable[[Run], None]] = {
    "trained": all_trained, "composed": composed, "students": students, "converted": converted,
    "others": others,
}  # fmt: skip


# -- the page ------------------------------------------------------------------------------------------------


def charts(run: Run) -> Iterator[tuple[str, str]]:
    """Of each part that has plots, these."""
    rows = run.rows("trained")
    for capture in dict.fromkeys(row["capture"] for row in rows):
        lines: dict[str, list[tuple[float, float]]] = {}
        for row in (r for r in rows if r["capture"] == capture):
            lines.setdefault(row["kind"], []).append((float(row["minutes"]), float(row["PSNR"])))
        name = f"table1/{capture}.svg"
        over_time(lines, {}, ("minutes of learning", f"PSNR of {capture}, held out, dB"), run.out / name)
        yield "trained", name
    rows = [row for row in run.rows("students") if row["finetuned"] == "True"]
    lines = {}
    for row in rows:
        lines.setdefault(row["kind"], []).append((float(row["MB"]), float(row["PSNR"])))
    if lines:
        over_time(lines, {}, ("MB", "PSNR of one distilled field, dB"), run.out / "table1/students.svg")
        yield "students", "table1/students.svg"


def write_page(run: Run) -> None:
    """table1.md and its plots."""
    drawn = list(charts(run))
    text = f"# Every kind on the same scenes\n\n{commit_line()}\n\nWritten by `make bench-table1`.\n"
    for part, what in ABOUT.items():
        if rows := run.rows(part):
            text += f"\n## {part.capitalize()}\n\n{what}\n\n{markdown(rows)}"
            text += "".join(f"\n![{part}]({name})\n" for of, name in drawn if of == part)
    (run.out / "table1.md").write_text(text, encoding="utf-8")


def main() -> None:
    """Measure what was asked for; the page is written anew after each row."""
    imported = registry.IMPORTED
    trains = [k.name for k in registry.kinds() if k.trains and k.field is not None and k.name not in imported]
    parser = argparse.ArgumentParser(prog="python -m benchmarks.table1", description=__doc__)
    parser.add_argument("data", type=Path, help="a folder of captures")
    parser.add_argument("--out", type=Path, default=Path(__file__).parents[1] / "docs")
    parser.add_argument("--share", type=float, default=1.0, help="of the seconds of learning")
    parser.add_argument("--kind", action="append", choices=trains, help="this kind; may be repeated")
    parser.add_argument("--only", action="append", choices=PARTS, help="this part; may be repeated")
    parser.add_argument("--keep", type=Path, help="a folder in which fields are kept")
    asked = parser.parse_args()
    plots.check()
    (asked.out / "table1").mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as name:
        folder = (asked.keep or Path(name)).resolve()
        folder.mkdir(parents=True, exist_ok=True)
        run = Run(asked.data.resolve(), asked.out.resolve(), folder, asked.share, asked.kind or trains)
        for part in asked.only or PARTS:
            PARTS[part](run)


if __name__ == "__main__":
    main()
