import itertools
import json
import warnings

import click
import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from formats.errors import FormatWarning
from formats.scene import make_node
from fusedrf_cli.errors import QualityNotReached, UsageProblem
from fusedrf_cli.option_types import (
    AffineType,
    BoxType,
    BytesType,
    ColourType,
    DirectionType,
    DownscaleType,
    PositiveType,
    ScaleType,
    SizeType,
    VectorType,
)
from fusedrf_cli.placement import node_words, quaternion, turn_upright

IDENTITY = ((1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1))
SPELLED = "1,0,0,0, 0,1,0,0, 0,0,1,0, 0,0,0,1"


@pytest.mark.parametrize(
    "kind, text, value",
    [
        (PositiveType(), "0.5", 0.5),
        (SizeType(), "800x600", (800, 600)),
        (SizeType(), "1X1", (1, 1)),
        (BytesType(), "25MB", 25_000_000),
        (BytesType(), "1.5kib", 1536),
        (BytesType(), "300", 300),
        (VectorType(), "1,-2.5,3e2", (1.0, -2.5, 300.0)),
        (DirectionType(), "-90,30", (-90.0, 30.0)),
        (ScaleType(), "2", (2.0, 2.0, 2.0)),
        (ScaleType(), "1,-1,1", (1.0, -1.0, 1.0)),
        (BoxType(), "-1,-1,-1,1,1,2", (-1.0, -1.0, -1.0, 1.0, 1.0, 2.0)),
        (DownscaleType(), "auto", None),
        (DownscaleType(), "4", 4),
        (ColourType(), "white", (1.0, 1.0, 1.0)),
        (ColourType(), "#ff0033", (1.0, 0.0, 0.2)),
        (ColourType(), "transparent", None),
        (AffineType(), SPELLED, IDENTITY),
        (AffineType(), str([list(row) for row in IDENTITY]), IDENTITY),
    ],
)
def test_a_type_reads_what_it_should(kind, text, value):
    assert kind(text) == value


@pytest.mark.parametrize(
    "kind, texts",
    [
        (PositiveType(), ["0", "-1", "nan", "inf", "1,2", "", "x"]),
        (SizeType(), ["800", "0x1", "1x99999", "-1x2", "1.5x2", "1x2x3", ""]),
        (BytesType(), ["0", "-1", "1XB", "MB", "1ib", "nan", "9" * 400, ""]),
        (VectorType(), ["1,2", "1,2,3,4", "1,2,nan", "1,2,inf", "1,2,1e999", "a,b,c", ""]),
        (DirectionType(), ["1", "1,2,3", "0,91", "0,-90.1", "nan,0", ""]),
        (ScaleType(), ["0", "1,0,1", "1,2", "nan", ""]),
        (BoxType(), ["0,0,0,1,1", "0,0,0,0,1,1", "1,1,1,0,0,0", "0,0,0,1,1,inf"]),
        (DownscaleType(), ["0", "65", "-2", "1.5", "half", ""]),
        (ColourType(), ["#fff", "#gggggg", "red", "", "#ff00331"]),
        (AffineType(), ["1,2,3", SPELLED + ",0", SPELLED[:-1] + "2", SPELLED.replace("1", "nan", 1), ""]),
    ],
)
def test_a_type_refuses_what_it_should_not_read(kind, texts):
    for text in texts:
        with pytest.raises(click.BadParameter, match="is not"):
            kind.convert(text, None, None)


@pytest.mark.parametrize("text", [SPELLED, json.dumps(IDENTITY), SPELLED.replace(",", " ")])
def test_an_affine_may_lie_in_a_file(tmp_path, text):
    path = tmp_path / "matrix"
    path.write_text(text)
    assert AffineType()(str(path)) == IDENTITY


def test_an_affine_may_come_by_pipe(run, bridge):
    words = ("add", "chair.rfpack", "table.rfpack", "-o", "out", "--name", "a", "--matrix", "-")
    assert run(*words, stdin=SPELLED.replace("1,0,0,0,", "1,0,0,5,")).exit_code == 0
    assert bridge.request.object_to_world[0].tolist() == [1, 0, 0, 5]


# --- placement ----------------------------------------------------------------------------------------------


def about(axis: int, degrees: float) -> np.ndarray:
    """Right-handed turn about a world axis, written out."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    rotation = np.eye(3)
    one, two = (axis + 1) % 3, (axis + 2) % 3
    rotation[[one, one, two, two], [one, two, one, two]] = c, -s, s, c
    return rotation


@given(st.tuples(*[st.floats(-1000, 1000)] * 3))
def test_a_rotation_turns_about_x_then_y_then_z(degrees):
    expected = about(2, degrees[2]) @ about(1, degrees[1]) @ about(0, degrees[0])
    placed = make_node("a", rotation=quaternion(degrees)).node_to_parent[:3, :3]
    np.testing.assert_allclose(placed, expected, atol=1e-12)


@given(st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda up: np.linalg.norm(up) > 1e-3))
@example((0.0, -1.0, 0.0))
@example((1.0, 0.0, 0.0))
@example((0.0, 0.0, -1.0))
def test_what_is_up_anywhere_is_turned_to_z(up):
    turn = make_node("a", rotation=quaternion(turn_upright(up))).node_to_parent[:3, :3]
    np.testing.assert_allclose(turn @ up, [0, 0, np.linalg.norm(up)], atol=1e-12)


def test_an_object_is_scaled_then_turned_then_moved():
    words = node_words((1, 2, 3), (0, 0, 90), (2, 1, 1), None)
    tip = make_node("a", **words).node_to_parent @ [1, 0, 0, 1]
    np.testing.assert_allclose(tip, [1, 4, 3, 1], atol=1e-12)


def test_a_matrix_goes_with_no_other_word():
    words = [(1, 0, 0), (0, 0, 90), (2, 2, 2)]
    for given_words in itertools.product(*[(None, word) for word in words]):
        if any(given_words):
            with pytest.raises(UsageProblem, match="--matrix"):
                node_words(*given_words, IDENTITY)
    assert node_words(None, None, None, IDENTITY) == {"matrix": IDENTITY}


# --- commands and their bridge ------------------------------------------------------------------------------

EDIT = ("fused", "output", "overwrite", "memory", "undoable")
COMMON = {"device": "auto", "threads": None, "seed": 0, "overwrite": False, "memory": None}


def test_train_hands_on_what_was_asked(run, bridge):
    run("train", "chair.rfpack", "-o", "out", "--max-size", "1MB", "--aabb", "0,0,0,1,1,1", "--holdout", "8")
    name, asked = bridge.call
    assert name == "train"
    assert asked == COMMON | {
        "source": "chair.rfpack",
        "output": "out",
        "ranks": None,
        "kind": None,
        "shared_decoder": False,
        "sh_degree": None,
        "max_size": 1_000_000,
        "target_psnr": None,
        "time_budget": None,
        "quality": None,
        "views": 100,
        "size": 400,
        "holdout": 8,
        "precision": None,
        "aabb": (0, 0, 0, 1, 1, 1),
        "downscale": None,
        "unbounded": None,
        "centre": None,
        "radius": None,
        "masks": "ignore",
        "refine_poses": False,
        "resume": False,
    }


def test_train_takes_several_sources_that_share_a_decoder(run, bridge):
    run("train", "chair.rfpack", "table.rfpack", "--shared-decoder", "-o", "out")
    assert bridge.call[1]["source"] == ("chair.rfpack", "table.rfpack") and bridge.call[1]["shared_decoder"]


@pytest.mark.parametrize(
    "words, says",
    [
        (("table.rfpack",), "2 sources become fields of one bundle only with --shared-decoder"),
        (("table.rfpack", "chair.rfpack"), "3 sources"),
        (("--shared-decoder",), "--shared-decoder is of several sources"),
        (("table.rfpack", "--shared-decoder", "--aabb", "0,0,0,1,1,1"), "--aabb is of one capture's world"),
        (("table.rfpack", "--shared-decoder", "--centre", "0,0,0"), "--centre is of one capture's world"),
        (("table.rfpack", "--shared-decoder", "--radius", "2"), "--radius is of one capture's world"),
    ],
)
def test_sources_that_do_not_go_together_are_refused(run, bridge, words, says):
    result = run("train", "chair.rfpack", *words, "-o", "out")
    assert result.exit_code == 2 and says in result.stderr and result.stderr.count("\n") == 1
    assert bridge.call is None


def test_fuse_hands_on_a_scene_by_pipe(run, bridge):
    run("fuse", "-", "-o", "out", "--no-rgb", "--device", "cpu", "--threads", "2", "--seed", "5")
    name, asked = bridge.call
    assert name == "fuse"
    assert asked == COMMON | {
        "scene": "-",
        "output": "out",
        "device": "cpu",
        "threads": 2,
        "seed": 5,
        "kind": "auto",
        "max_size": None,
        "target_psnr": None,
        "time_budget": None,
        "finetune": False,
        "from_scratch": False,
        "keep_sources": False,
        "precision": None,
        "ranks": None,
        "sh_degree": None,
        "resume": False,
        "sources": None,
        "allow_outside": False,
    }


def test_add_hands_on_one_matrix(run, bridge):
    run("add", "chair.rfpack", "table.rfpack", "-o", "out", "--name", "a", "-t", "1,0,0", "-s", "2")
    name, asked = bridge.call
    matrix = bridge.request.object_to_world
    assert (name, asked["fused"], asked["source"], asked["output"]) == (
        "add",
        "chair.rfpack",
        "table.rfpack",
        "out",
    )
    assert matrix.tolist() == [[2, 0, 0, 1], [0, 2, 0, 0], [0, 0, 2, 0], [0, 0, 0, 1]]
    assert set(asked) == {*EDIT, "source", "name", "precision", "translate", "rotate", "scale", "matrix"}


def test_delete_hands_on_its_names(run, bridge):
    run("delete", "chair.rfpack", "a", "b", "-o", "out")
    name, asked = bridge.call
    assert (name, asked["fused"], asked["names"]) == ("delete", "chair.rfpack", ("a", "b"))
    more = {"names", "allow_outside", "refit", "fill", "finetune", "time_budget"}
    assert set(asked) == {*COMMON, *EDIT, *more}


@pytest.mark.parametrize(
    "words, shape",
    [
        (("-1,-1,0,1,1,1", "-o", "out"), (-1, -1, 0, 1, 1, 1)),
        (("-o", "out", "-.5,0,0,2"), (-0.5, 0, 0, 2)),
        (("-o", "out", "--", "-1,0,0,2"), (-1, 0, 0, 2)),
        (("-o", "out"), None),
    ],
)
def test_a_shape_may_begin_with_a_minus_sign(run, bridge, words, shape):
    assert run("crop", "chair.rfpack", "a", *words).exit_code == 0
    assert bridge.call[1]["shape"] == shape
    assert "No such option '-x'" in run("crop", "chair.rfpack", "a", "-x", *words).stderr
    assert "red, green and blue from 0 to 1" in run("tint", "chair.rfpack", "a", "-1,0,0", "-o", "t").stderr
    assert run("move", "chair.rfpack", "a", "-t", "-1,0,0", "-o", "m").exit_code == 0
    assert bridge.call[1]["translate"] == (-1, 0, 0)


@pytest.mark.parametrize(
    "words, says",
    [
        (("delete", "chair.rfpack", "a", "b", "a"), "a: is to be deleted twice; give each name once"),
        (("rename", "chair.rfpack", "a", "a"), "'a' is its name already; give a new one"),
        (("rename", "chair.rfpack", "a", ""), "node name '' is no name; give one of at least one"),
        (("fuse", ""), "'SCENE' is an empty path; give that of a file"),
    ],
)
def test_names_and_paths_that_cannot_be(run, bridge, words, says):
    result = run(*words, "-o", "out.rfpack")
    assert result.exit_code in (2, 3) and says in result.stderr and bridge.call is None


@pytest.mark.parametrize(
    "colour, background", [("transparent", None), ("black", (0, 0, 0)), (None, (1.0, 1.0, 1.0))]
)
def test_render_hands_on_a_background(run, bridge, colour, background):
    run("render", "chair.rfpack", "-o", "out.png", *(["--background", colour] if colour else []))
    name, asked = bridge.call
    assert (name, asked["scene"], asked["output"]) == ("render", "chair.rfpack", "out.png")
    assert asked["background"] == background
    others = {"cameras", "path", "views", "orbit", "look_at", "view_from", "zoom", "up", "size", "depth"}
    others |= {"near", "far", "step", "reference"}
    wanted = {*COMMON, "scene", "output", "background", "allow_outside", "fps", *others}
    assert set(asked) == wanted - {"seed"}


def test_options_are_taken_by_their_earlier_names_and_shown_by_their_own(run, bridge):
    run("fuse", "-", "-o", "out", "--no-rgb")
    assert bridge.call[1]["finetune"] is False
    run("fuse", "-", "-o", "out", "--no-finetune", "--rgb")
    assert bridge.call[1]["finetune"] is True
    run("render", "chair.rfpack", "-o", "out.png", "--naive", "--from", "10,20")
    assert bridge.call[1]["reference"] and bridge.call[1]["view_from"] == (10, 20)
    run("delete", "chair.rfpack", "a", "-o", "out", "--keep-history")
    assert bridge.call[1]["undoable"]
    shown = run("render", "--help").stdout + run("fuse", "--help").stdout + run("delete", "--help").stdout
    earlier = ("--naive", "--from", "--rgb", "--no-rgb", "--keep-history")
    assert not any(f"{name} " in shown for name in earlier)


def test_render_hands_on_where_to_look(run, bridge):
    words = ("--orbit", "4", "--look-at", "1,-2,0.5", "--view-from", "-90,30", "--zoom", "2")
    words += ("--up", "0,-2,0")
    assert run("render", "chair.rfpack", "-o", "out", *words).exit_code == 0
    asked = bridge.call[1]
    found = [asked[word] for word in ("orbit", "look_at", "view_from", "zoom", "up", "views")]
    assert found == [4, (1, -2, 0.5), (-90, 30), 2, (0, -2, 0), None]
    run("render", "chair.rfpack", "-o", "out", "--up", "auto")
    assert bridge.call[1]["up"] is None


@pytest.mark.parametrize(
    "words, says",
    [
        (("--orbit", "3", "--cameras", "table.rfpack"), "give one of them"),
        (("--orbit", "3", "--views", "capture"), "give one of them"),
        (("--views", "heldout", "--zoom", "2"), "do not apply to --views"),
        (("--cameras", "table.rfpack", "--look-at", "0,0,0"), "do not apply to --cameras"),
        (("--path", "table.rfpack", "--from", "0,0"), "do not apply to --path"),
        (("--views", "capture", "--up", "0,0,1"), "do not apply to --views"),
        (("--up", "0,0,0"), "not 0,0,0"),
        (("--views", "all"), "'capture', 'heldout'"),
    ],
)
def test_render_takes_one_choice_of_views(run, bridge, words, says):
    result = run("render", "chair.rfpack", "-o", "out", *words)
    assert result.exit_code == 2 and says in result.stderr and bridge.call is None


def test_eval_hands_on_both_sides(run, bridge):
    run("eval", "chair.rfpack", "--against", "table.rfpack", "--size", "40x30")
    name, asked = bridge.call
    sides = asked["bundle"], asked["against"], asked["size"]
    assert (name, *sides) == ("evaluate", "chair.rfpack", "table.rfpack", (40, 30))
    wanted = {"split", "size", "memory", "allow_outside", "device", "threads", "bundle", "against"}
    assert set(asked) == wanted


# --- what every command does --------------------------------------------------------------------------------


@pytest.mark.parametrize("output, code", [("table.rfpack", 1), ("nowhere/out.rfpack", 5)])
def test_an_output_in_the_way_is_refused_before_any_work(run, bridge, folder, output, code):
    before = (folder / "table.rfpack").read_bytes()
    result = run("fuse", "chair.rfpack", "-o", output)
    assert result.exit_code == code and bridge.call is None
    assert (folder / "table.rfpack").read_bytes() == before


def test_overwrite_lets_an_output_be_replaced(run, bridge):
    assert run("fuse", "chair.rfpack", "-o", "table.rfpack", "-w").exit_code == 0
    assert bridge.call[1]["overwrite"] is True


REPORT = {
    "output": "out.rfpack",
    "bytes": 1_234_567,
    "seconds": {"load": 0.5, "learn": 61.25},
    "psnr": {"before_rgb": 31.234567, "after_rgb": float("inf"), "stored": None, "views": 4},
    "generator": "",
    "holdout": None,
    "views": [{"name": "r_0", "psnr": 30.5}, {"name": "r_10", "psnr": np.float32(31.5)}],
}


def test_a_report_for_people_has_units(run, bridge):
    bridge.report = REPORT
    assert run("fuse", "chair.rfpack", "-o", "out.rfpack").stdout.splitlines() == [
        "wrote out.rfpack (1.23 MB)",
        "seconds: load 0.5 s, learn 61.25 s",
        "psnr: before rgb 31.23 dB, after rgb inf dB, views 4",
        "views:",
        "  name  psnr",
        "  r_0   30.5 dB",
        "  r_10  31.5 dB",
    ]
    bridge.report = {"psnr": {"covered": 22.5, "covered_share": 0.5, "worst": {"name": "a", "bytes": 2000}}}
    assert run("fuse", "chair.rfpack", "-o", "out.rfpack").stdout.splitlines() == [
        "psnr:",
        "  covered: 22.5 dB",
        "  covered share: 0.5",
        "  worst: name a, bytes 2 kB",
    ]


def test_a_report_as_json_is_one_object_and_nothing_else(run, bridge):
    bridge.report = REPORT
    result = run("fuse", "chair.rfpack", "-o", "out.rfpack", "--json")
    psnr = {**REPORT["psnr"], "after_rgb": None}  # JSON has no infinity
    views = [REPORT["views"][0], {"name": "r_10", "psnr": 31.5}]
    assert json.loads(result.stdout) == {**REPORT, "psnr": psnr, "views": views, "warnings": []}


def test_quiet_keeps_the_answer_and_drops_the_summary(run, bridge):
    bridge.report = REPORT
    assert run("fuse", "chair.rfpack", "-o", "out.rfpack", "-q").stdout == ""
    bridge.report = {"mean": {"psnr": 31.0}}
    assert run("eval", "chair.rfpack", "--against", "chair.rfpack", "-q").stdout == "mean: psnr 31 dB\n"


def test_the_report_of_an_error_is_printed_before_it(run, bridge):
    bridge.error = QualityNotReached("31 dB of 40 dB", report={"psnr": 31.0})
    result = run("fuse", "chair.rfpack", "-o", "out.rfpack", "--target-psnr", "40", "--json")
    assert (result.exit_code, result.stderr) == (7, "Error: 31 dB of 40 dB\n")
    assert json.loads(result.stdout) == {"psnr": 31.0, "warnings": []}


@pytest.mark.parametrize(
    "category, flags, shown",
    [
        (FormatWarning, [], "Warning: odd\n"),
        (FormatWarning, ["-q"], "Warning: odd\n"),
        (UserWarning, ["-v"], "odd\n"),
    ],
)
def test_warnings_of_libraries_become_lines(run, bridge, category, flags, shown):
    bridge.fuse = lambda request, progress: warnings.warn("odd", category, stacklevel=1) or {"a": 1}
    with warnings.catch_warnings():
        warnings.simplefilter("default")
        result = run("fuse", "chair.rfpack", "-o", "out", "--json", *flags)
    assert result.stderr == shown
    assert json.loads(result.stdout)["warnings"] == (["odd"] if category is FormatWarning else [])
