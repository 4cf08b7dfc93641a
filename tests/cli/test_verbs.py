"""The verbs take what the commands take, with the same defaults, and refuse the same."""

import inspect
import json
from pathlib import Path

import click
import numpy as np
import pytest

from formats.errors import OutputExists, ResourceError
from formats.locks import output_lock
from formats.scene import read_scene
from fusedrf_cli import verbs
from fusedrf_cli.engine.rendering.volume import RenderConfig
from fusedrf_cli.engine.settings import current
from fusedrf_cli.errors import InvalidInput, UsageProblem
from fusedrf_cli.main import COMMANDS, cli

VERBS = verbs.__all__
OF_FILES = {"compose", "history", "info", "kinds", "undo", "validate"}
REPORTING = {"as_json", "quiet", "verbose"}
PLACED = {"translate", "rotate", "scale", "matrix", "name", "crop", "opacity", "tint", "hidden"}
"""What belongs to an input of `compose`."""


def asked(name: str) -> dict[str, inspect.Parameter]:
    """The parameters of a verb but for `progress` and `settings`."""
    words = inspect.signature(getattr(verbs, name)).parameters.items()
    return {k: p for k, p in words if k not in ("progress", "settings")}


def test_settings_are_in_force_while_a_verb_works(bridge, folder, monkeypatch):
    found = []
    monkeypatch.setattr(bridge, "render", lambda request, progress: found.append(current(RenderConfig)))
    verbs.render("chair.rfpack", "a.png", settings=[RenderConfig(early_stop=0.5)])
    verbs.render("chair.rfpack", "a.png")
    assert found == [RenderConfig(early_stop=0.5), RenderConfig()]


def command_of(name: str) -> str:
    """The command of a verb, which Python may not call the same."""
    return {"import_field": "import"}.get(name, name)


def test_every_command_has_a_verb():
    assert [*map(command_of, VERBS), "completion"] == list(COMMANDS)


@pytest.mark.parametrize("name", VERBS)
def test_a_command_and_its_verb_take_the_same(name):
    command = cli.get_command(click.Context(cli), command_of(name))
    taken = {p.name for p in command.params if p.expose_value} - REPORTING
    if name == "compose":
        taken -= PLACED | {"background_node"}
    assert taken == asked(name).keys()


@pytest.mark.parametrize("name", sorted(set(VERBS) - OF_FILES))
def test_a_command_line_and_a_verb_ask_the_bridge_for_the_same(run, bridge, folder, name):
    """By defaults, with what has none."""
    (folder / "photos").mkdir()
    files = {"fused": "chair.rfpack", "source": "table.rfpack", "scene": "chair.rfpack", "photos": "photos"}
    words = {
        "names": ("a",),
        "name": "a",
        "new_name": "b",
        "output": "out",
        "kind": "cp",
        "field": "chair.rfpack",
    }
    words |= files | {"path": "chair.rfpack", "bundle": "chair.rfpack", "against": "table.rfpack"}
    needed = {k: words[k] for k, p in asked(name).items() if p.default is p.empty}
    needed |= {"translate": (1, 0, 0)} if name == "move" else {}
    getattr(verbs, name)(**needed)
    by_verb = bridge.call
    line = []
    for parameter in cli.get_command(click.Context(cli), command_of(name)).params:
        if parameter.name in needed:
            value = needed[parameter.name]
            value = ",".join(map(str, value)) if parameter.name == "translate" else value
            line += [parameter.opts[0]] if isinstance(parameter, click.Option) else []
            line += [value] if isinstance(value, str) else value
    assert run(command_of(name), *line).exit_code == 0
    assert str(sorted(bridge.call[1].items())) == str(sorted(by_verb[1].items()))


@pytest.mark.parametrize(
    "words, says",
    [
        ({"seed": "7"}, "seed: Expected `int`"),
        ({"max_size": 0}, "max_size: Expected `int` >= 1"),
        ({"sh_degree": 4}, "sh_degree"),
        ({"quality": "superb"}, "quality"),
        ({"aabb": (0, 0, 0, 1, 1)}, "aabb"),
    ],
)
def test_a_word_of_another_kind_is_refused(bridge, folder, words, says):
    with pytest.raises(UsageProblem, match=says):
        verbs.train("chair.rfpack", "out.rfpack", **words)
    assert bridge.call is None
    with pytest.raises(TypeError, match="qualty"):
        verbs.train("chair.rfpack", "out.rfpack", qualty="draft")


def test_paths_and_arrays_are_words(bridge, folder):
    verbs.train([folder / "chair.rfpack", "table.rfpack"], Path("out"), shared_decoder=True)
    assert bridge.call[1]["source"] == (str(folder / "chair.rfpack"), "table.rfpack")
    place = np.eye(4) * [2, 2, 2, 1]
    words = {"name": "a", "matrix": place, "memory": np.int64(3)}
    verbs.add(folder / "chair.rfpack", "table.rfpack", Path("out"), **words)
    name, given = bridge.call
    assert (given["fused"], given["output"], given["memory"]) == (str(folder / "chair.rfpack"), "out", 3)
    np.testing.assert_array_equal(bridge.request.object_to_world, place)
    with pytest.raises(UsageProblem, match="--matrix"):
        verbs.add("chair.rfpack", "table.rfpack", "out", name="a", matrix=place, scale=2)


def test_files_are_composed_told_of_and_checked(folder):
    lamp = {"path": "chair.rfpack", "name": "lamp", "translate": (1, 0, 0), "scale": 2}
    report = verbs.compose(["table.rfpack", lamp], "scene.json")
    assert [node["name"] for node in report["nodes"]] == ["table", "lamp"] and report["warnings"] == []
    _, placed = read_scene("scene.json").leaves()
    np.testing.assert_array_equal(
        placed.object_to_world, [*np.diag([2.0, 2, 2, 1])[:3] + np.eye(4)[3] * [[1], [0], [0]], [0, 0, 0, 1]]
    )
    assert json.loads(json.dumps(verbs.info("scene.json")))["nodes"][1]["name"] == "lamp"
    assert verbs.validate(["scene.json"])["valid"] is True
    Path("table.rfpack").write_bytes(b"")
    with pytest.raises(InvalidInput) as caught:
        verbs.validate(["scene.json", "chair.rfpack"])
    assert [file["valid"] for file in caught.value.report["files"]] == [False, True]


def test_outputs_are_held_as_those_of_commands(bridge, folder):
    with pytest.raises(OutputExists):
        verbs.fuse("chair.rfpack", "table.rfpack")
    with output_lock("out"), pytest.raises(ResourceError, match="another fusedrf is writing it"):
        verbs.fuse("chair.rfpack", "out")
    assert bridge.call is None


def test_warnings_are_part_of_the_report(bridge, folder, monkeypatch):
    def warned(request, progress):
        progress.warn("odd")
        return {"mean": 1}

    monkeypatch.setattr(bridge, "evaluate", warned)
    assert verbs.eval("chair.rfpack", "table.rfpack") == {"mean": 1, "warnings": ["odd"]}
