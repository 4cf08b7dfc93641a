"""Every file that a command writes is held to -w, and to what can be written, before any work."""

import os
import shutil
from dataclasses import dataclass

import pytest


@dataclass(frozen=True)
class Writes:
    """A command line, and all that it writes."""

    words: tuple[str, ...]
    files: tuple[str, ...] = ()
    folders: tuple[str, ...] = ()


FUSED = ("chair.rfpack", "-o", "out.rfpack")
EDITED = dict(files=("out.rfpack",))
COMMANDS = {
    "pose": Writes(("pose", "photos", "-o", "out"), folders=("out",)),
    "train": Writes(("train", "photos", "-o", "out.rfpack"), **EDITED),
    "import": Writes(("import", *FUSED), **EDITED),
    "compose": Writes(("compose", "chair.rfpack", "-o", "out.json"), files=("out.json",)),
    "fuse": Writes(("fuse", *FUSED), **EDITED),
    "convert": Writes(("convert", *FUSED, "--kind", "sparse"), **EDITED),
    "add": Writes(("add", "chair.rfpack", "table.rfpack", "--name", "n", "-o", "out.rfpack"), **EDITED),
    "delete": Writes(("delete", "chair.rfpack", "n", "-o", "out.rfpack"), **EDITED),
    "move": Writes(("move", "chair.rfpack", "n", "-t", "1,0,0", "-o", "out.rfpack"), **EDITED),
    "duplicate": Writes(("duplicate", "chair.rfpack", "n", "m", "-o", "out.rfpack"), **EDITED),
    "rename": Writes(("rename", "chair.rfpack", "n", "m", "-o", "out.rfpack"), **EDITED),
    "replace": Writes(("replace", "chair.rfpack", "n", "table.rfpack", "-o", "out.rfpack"), **EDITED),
    "crop": Writes(("crop", "chair.rfpack", "n", "0,0,0,1", "-o", "out.rfpack"), **EDITED),
    "tint": Writes(("tint", "chair.rfpack", "n", "1,0,0", "-o", "out.rfpack"), **EDITED),
    "extract": Writes(
        ("extract", *FUSED, "--box", "0,0,0,1,1,1", "--preview", "look"), ("out.rfpack",), ("look",)
    ),
    "undo": Writes(("undo", *FUSED), **EDITED),
    "a picture": Writes(("render", *FUSED[:2], "out.png"), files=("out.png",)),
    "a picture and its depth": Writes(
        ("render", *FUSED[:2], "out.png", "--depth"), files=("out.png", "out_depth.png")
    ),
    "pictures": Writes(("render", *FUSED[:2], "out", "--orbit", "2"), folders=("out",)),
    "a film": Writes(("render", *FUSED[:2], "out.gif", "--orbit", "2"), files=("out.gif",)),
    "chart": Writes(("chart", *FUSED[:2], "out"), folders=("out",)),
}
HISTORY = ("add", "delete", "move", "duplicate", "rename", "replace", "crop", "tint")
OUTPUTS = [(name, output) for name, writes in COMMANDS.items() for output in writes.files + writes.folders]


@pytest.fixture
def refused(run, bridge, folder):
    """refused("train", ...) -> the exit code and sentence of a command that does no work and changes
    nothing."""

    def refused(*words: str) -> tuple[int, str]:
        (folder / "photos").mkdir(exist_ok=True)
        before = [(path, path.lstat()) for path in sorted(folder.rglob("*"))]
        result = run(*words)
        assert bridge.call is None and result.stdout == "" and result.stderr.count("\n") == 1
        assert [(path, path.lstat()) for path in sorted(folder.rglob("*"))] == before
        return result.exit_code, result.stderr

    return refused


def test_all_commands_that_write_are_here(run):
    from fusedrf_cli.main import COMMANDS as ALL

    writing = {name for name in ALL if "--output" in run(name, "--help").stdout}
    assert writing == {writes.words[0] for writes in COMMANDS.values()}


@pytest.mark.parametrize("name, output", OUTPUTS)
def test_what_is_there_is_not_replaced_unasked(refused, folder, name, output):
    (folder / output).write_text("mine")
    code, said = refused(*COMMANDS[name].words)
    assert (code, "exists already" in said) == (1, True) or (code, "is a file" in said) == (2, True)
    assert output in said
    (folder / output).unlink()
    (folder / output).mkdir()
    (folder / output / "mine").touch()
    code, said = refused(*COMMANDS[name].words)
    assert code in (1, 5) and output in said and ("exists already" in said or "in the way" in said)


@pytest.mark.parametrize("name, output", OUTPUTS)
def test_what_cannot_be_replaced_is_refused(refused, folder, name, output):
    """Not with -w either; nor is it waited for."""
    os.mkfifo(folder / output)
    code, said = refused(*COMMANDS[name].words, "-w")
    assert code == 5 and "in the way" in said and output in said
    words = [word.replace(output, f"nowhere/{output}") for word in COMMANDS[name].words]
    if output in COMMANDS[name].words:
        code, said = refused(*words, "-w")
        assert code == 5 and "does not exist" in said


@pytest.mark.parametrize("name, output", OUTPUTS)
def test_what_another_process_writes_is_refused(refused, folder, name, output):
    from formats.locks import output_lock

    with output_lock(folder / output):
        code, said = refused(*COMMANDS[name].words)
    assert code == 5 and "another fusedrf is writing it" in said and output in said


@pytest.mark.parametrize("name", HISTORY)
def test_a_folder_that_cannot_keep_what_was_is_refused(refused, folder, name):
    (folder / "out.rfpack.history").write_text("mine")
    code, said = refused(*COMMANDS[name].words, "--undoable")
    assert code == 5 and "out.rfpack.history" in said and "no folder" in said


def test_two_outputs_of_one_name_are_refused(refused):
    code, said = refused("extract", *FUSED, "--box", "0,0,0,1,1,1", "--preview", "./out.rfpack")
    assert code == 2 and "two outputs" in said


@pytest.mark.parametrize(
    "words, says",
    [
        (
            ("render", *FUSED[:2], "out.jpg"),
            "no .jpg is written; give a name that ends in .png, .gif, .mp4, or",
        ),
        (("chart", *FUSED[:2], "out.svg"), "no .svg is written; give a folder"),
        (("extract", *FUSED, "--box", "0,0,0,1,1,1", "--preview", "a.webp"), "no .webp is written"),
    ],
)
def test_names_of_files_that_are_not_written_make_no_folders(refused, words, says):
    code, said = refused(*words)
    assert code == 2 and says in said and "ends in a slash" in said


@pytest.mark.parametrize("output", ["out", "out.jpg/", "there.jpg", "v1.5", "out.PNG"])
def test_names_of_folders_and_of_files_that_are_written(run, bridge, folder, output):
    (folder / "there.jpg").mkdir()
    assert run("render", *FUSED[:2], output).exit_code == 0 and bridge.call[1]["output"] == output


def test_an_output_has_a_name(refused):
    assert refused("fuse", "chair.rfpack", "-o", "") == (
        5,
        "Error: the path of the output is empty; name a file\n",
    )


def test_a_dash_is_a_file_where_it_is_not_stdout(refused, folder):
    (folder / "-").write_text("mine")
    assert refused("fuse", "chair.rfpack", "-o", "-")[0] == 1


@pytest.mark.parametrize("name, output", OUTPUTS)
def test_the_next_run_removes_what_a_killed_one_left(run, bridge, folder, name, output):
    """Whatever it does itself; but not what is somebody else's."""
    if name in ("compose", "undo"):
        pytest.skip("it has no bridge to stand in for")
    (folder / "photos").mkdir()
    token = "0123456789ab"
    left = [
        f".{output}.{token}.tmp",
        f".{output}.checkpoint.{token}.tmp",
        f"..{output}.{token}.tmp.{token}.tmp",
        f".{output}.{token}.tmp.checkpoint",
        f"..{output}.{token}.tmp.checkpoint.{token}.tmp",
    ]
    others = [
        f"{output}.checkpoint",
        f".{output}.tmp",
        f".{output}",
        f".x{output}.{token}.tmp",
        f"{output}.{token}.tmp",
    ]
    for place in left + others:
        (folder / place).write_text("left")
    assert run(*COMMANDS[name].words).exit_code == 0
    assert not [place for place in left if (folder / place).exists()]
    assert all((folder / place).exists() for place in others)
    shutil.rmtree(folder / "photos")
