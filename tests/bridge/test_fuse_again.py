"""`fuse` of a fused bundle: built anew from what it was made of."""

import shutil

import numpy as np
import pytest

from formats.bundle import read_bundle

VM = ("--kind", "vm", "--no-finetune", "--max-size", "300kB")
BLOCKS = ("--kind", "blocks", "--no-finetune")
SMALL = (*BLOCKS, "--max-size", "30kB")


def members(path) -> list[str]:
    """Names of a bundle's fields, which are made of their content."""
    return list(read_bundle(path).fields)


def test_a_fused_bundle_is_fused_anew_from_what_is_in_it_now(report, folder):
    report("fuse", "scene.json", "-o", "fused.rfpack", *VM)
    report("delete", "fused.rfpack", "blue", "-o", "less.rfpack", "--no-finetune")
    report("fuse", "less.rfpack", "-o", "anew.rfpack", *BLOCKS)
    report("fuse", "pair.json", "-o", "direct.rfpack", *BLOCKS)
    assert members(folder / "anew.rfpack") == members(folder / "direct.rfpack")
    scenes = [read_bundle(folder / f"{name}.rfpack").scene for name in ("anew", "direct")]
    assert [node.name for node in scenes[0].nodes] == [node.name for node in scenes[1].nodes]
    for one, other in zip(*(scene.leaves() for scene in scenes), strict=True):
        np.testing.assert_allclose(one.object_to_world, other.object_to_world, atol=1e-12)


def test_what_is_as_its_source_is_needs_none(report, folder):
    report("fuse", "pair.json", "-o", "fused.rfpack", *BLOCKS)
    for name in ("floor", "red"):
        (folder / f"{name}.rfpack").unlink()
    said = report("fuse", "fused.rfpack", "-o", "anew.rfpack", *BLOCKS)
    assert members(folder / "anew.rfpack") == members(folder / "fused.rfpack") and not said["warnings"]


def test_sources_are_found_by_their_checksum(report, run, folder):
    report("fuse", "pair.json", "-o", "fused.rfpack", *SMALL)
    (folder / "attic" / "deep").mkdir(parents=True)
    (folder / "floor.rfpack").rename(folder / "attic" / "deep" / "renamed.rfpack")
    shutil.copy(folder / "blue.rfpack", folder / "floor.rfpack")  # of the right name, and another thing
    said = report("fuse", "fused.rfpack", "-o", "anew.rfpack", *SMALL, "--sources", "attic")
    assert members(folder / "anew.rfpack") == members(folder / "fused.rfpack")
    assert not any("is not found" in warning for warning in said["warnings"])
    said = report("fuse", "fused.rfpack", "-o", "itself.rfpack", *SMALL)
    assert "'floor' is not found" in said["warnings"][0] and "--sources" in said["warnings"][0]
    (folder / "empty").mkdir()
    result = run("fuse", "fused.rfpack", "-o", "no.rfpack", "--sources", "empty")
    assert result.exit_code == 3 and "'floor'" in result.stderr and not (folder / "no.rfpack").exists()


def test_sources_kept_inside_need_no_file(report, folder):
    report("fuse", "pair.json", "-o", "fused.rfpack", *BLOCKS, "--keep-sources")
    direct = members(folder / "fused.rfpack")
    for name in ("floor", "red"):
        (folder / f"{name}.rfpack").unlink()
    said = report("fuse", "fused.rfpack", "-o", "anew.rfpack", *BLOCKS, "--keep-sources")
    assert members(folder / "anew.rfpack") == direct and not said["warnings"]


def test_sources_of_what_has_none(run, folder):
    for scene in ("pair.json", "red.rfpack"):
        result = run("fuse", scene, "-o", "no.rfpack", "--sources", ".")
        assert result.exit_code == 2 and "--sources" in result.stderr
    result = run("fuse", "pair.json", "-o", "no.rfpack", "--sources", "red.rfpack")
    assert result.exit_code == 2 and "no folder" in result.stderr
    assert run("fuse", "pair.json", "-o", "no.rfpack", "--sources", "nowhere").exit_code == 3


@pytest.mark.slow
def test_a_converted_field_is_the_one_that_was_named(report, folder):
    """Not what it was once made of, although that is there."""
    report("fuse", "pair.json", "-o", "fused.rfpack", *VM)
    found = []
    for with_sources in (True, False):
        if not with_sources:
            (folder / "red.rfpack").unlink()
        report("convert", "fused.rfpack", "--kind", "sparse", "-o", f"{with_sources}.rfpack")
        found.append(members(folder / f"{with_sources}.rfpack"))
    assert found[0] == found[1]
