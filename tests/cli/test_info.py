import json

from formats.bundle import read_summary


def test_info_as_json_is_the_summary(run):
    result = run("info", "chair.rfpack", "--json")
    assert json.loads(result.stdout) == {**read_summary("chair.rfpack"), "warnings": []}


def test_info_of_a_pipe_is_info_of_the_file(run, folder):
    run("compose", "table.rfpack", "--background-node", "chair.rfpack", "-t", "1,2,3", "-o", "scene.json")
    of_file = json.loads(run("info", "scene.json", "--json").stdout)
    of_pipe = json.loads(run("info", "-", "--json", stdin=(folder / "scene.json").read_bytes()).stdout)
    assert of_pipe == {**of_file, "path": "-"}


def test_info_for_people_shows_the_tree(run):
    run("compose", "table.rfpack", "--background-node", "chair.rfpack", "-t", "1,2.5,3", "-o", "scene.json")
    lines = run("info", "scene.json").stdout.splitlines()
    assert lines[-3:] == [
        "  name   source        background  at",
        "  table  table.rfpack  yes         0 0 0",
        "  chair  chair.rfpack              1 2.5 3",
    ]


def test_info_for_people_shows_the_fields(run):
    lines = run("info", "chair.rfpack").stdout.splitlines()
    assert "  chair  vm                -1 -1 -1 1 1 2" not in lines
    assert any(
        line.split() == ["chair", "vm", "0", "0", "0", "-1", "-1", "-1", "1", "1", "2"] for line in lines
    )
    assert any(line.endswith(" 96") and "fields/" in line for line in lines)


def test_info_of_rubbish_is_one_line(run, folder):
    (folder / "rubbish").write_bytes(b"\x00" * 100)
    result = run("info", "rubbish")
    assert result.exit_code == 3 and result.stderr.count("\n") == 1
    assert run("info", "-", stdin="{").exit_code == 3
