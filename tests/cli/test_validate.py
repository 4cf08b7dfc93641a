import json

import pytest


@pytest.fixture
def scene(run):
    run("compose", "chair.rfpack", "table.rfpack", "-t", "1,0,0", "-o", "scene.json")
    return "scene.json"


def damage(path, at: int) -> None:
    data = bytearray(path.read_bytes())
    data[at] ^= 1
    path.write_bytes(data)


def test_what_was_written_is_valid(run, scene):
    result = run("validate", scene, "chair.rfpack", "--json")
    assert result.exit_code == 0
    assert json.loads(result.stdout)["valid"] is True
    assert [file["path"] for file in json.loads(result.stdout)["files"]] == [scene, "chair.rfpack"]


def test_a_scene_by_pipe_is_followed_to_its_sources(run, scene, folder):
    data = (folder / scene).read_bytes()
    assert run("validate", "-", stdin=data).exit_code == 0
    (folder / "table.rfpack").unlink()
    result = run("validate", "-", stdin=data)
    assert result.exit_code == 3 and "table.rfpack" in result.stderr


def test_one_flipped_bit_anywhere_is_found(run, folder):
    path = folder / "chair.rfpack"
    whole = path.read_bytes()
    for at in range(0, len(whole), 97):
        damage(path, at)
        result = run("validate", "chair.rfpack")
        assert result.exit_code in (3, 4), at
        assert result.stderr.startswith("Error: ") and result.stderr.count("\n") == 1
        path.write_bytes(whole)


def test_damage_in_a_source_is_damage_of_the_scene(run, scene, folder):
    damage(folder / "table.rfpack", -300)
    result = run("validate", scene)
    assert result.exit_code == 3 and "table.rfpack" in result.stderr


def test_all_files_are_checked_and_the_bad_ones_named(run, folder):
    damage(folder / "chair.rfpack", 0)
    result = run("validate", "chair.rfpack", "table.rfpack", "--json")
    assert result.exit_code == 3 and "1 of 2" in result.stderr
    report = json.loads(result.stdout)
    assert report["valid"] is False
    assert [file["valid"] for file in report["files"]] == [False, True]
    assert "chair.rfpack" in report["files"][0]["problem"] and report["files"][1]["problem"] is None


def test_a_newer_file_has_the_exit_code_of_versions(run, folder):
    (folder / "newer.json").write_text('{"format": "rfpack", "version": "2.0", "nodes": []}')
    assert run("validate", "newer.json").exit_code == 4


def test_a_source_outside_needs_permission(run, folder):
    (folder / "sub").mkdir()
    run("compose", "chair.rfpack", "-o", "sub/scene.json", "--allow-outside")
    assert run("validate", "sub/scene.json").exit_code == 3
    assert run("validate", "sub/scene.json", "--allow-outside").exit_code == 0
