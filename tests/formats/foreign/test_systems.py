"""Checkpoints are told by what they hold, a run's folder is its newest one, and all else is named."""

import gzip
import os
import random
import re
import shutil

import msgpack
import numpy as np
import pytest
import torch

from formats.errors import FormatError, NewerVersion, NotAFile, OlderVersion, UnknownCheckpoint
from formats.foreign.systems import SYSTEMS as KNOWN
from formats.foreign.systems import open_checkpoint
from tests.formats.foreign.samples import (
    BESIDE,
    PVD_MODELS,
    SYSTEMS,
    flax_checkpoint,
    hash_model,
    read_all,
    snapshot,
    spoilt,
    state,
    svox2,
    weights,
    write,
)


def test_every_known_system_is_tried():
    assert set(SYSTEMS) == set(KNOWN)


@pytest.mark.parametrize("system", SYSTEMS)
def test_a_checkpoint_is_told_by_what_it_holds(system, tmp_path):
    path = write(system, tmp_path)
    shutil.copy(path, tmp_path / "renamed.bin")
    assert open_checkpoint(tmp_path / "renamed.bin").system == system
    checkpoint = open_checkpoint(path)
    assert checkpoint.system == system and checkpoint.path == path and checkpoint.notes == []
    assert list(checkpoint.beside) == list(BESIDE.get(system, {}))
    assert isinstance(checkpoint.entries, dict)
    assert str(open_checkpoint(str(tmp_path)).path) == str(path)


@pytest.mark.parametrize("model", PVD_MODELS)
def test_every_network_of_pvd_is_told(model, tmp_path):
    torch.save({"epoch": 1, "model": PVD_MODELS[model]}, tmp_path / "a.pth")
    assert open_checkpoint(tmp_path / "a.pth").system == "pvd"


def test_old_layouts_are_told(tmp_path):
    np.savez(tmp_path / "a.npz", links=np.zeros((2, 2, 2), np.int32), data=np.zeros((8, 28), np.float32))
    assert open_checkpoint(tmp_path / "a.npz").system == "svox2"
    svox2(tmp_path / "b.npz", np.savez_compressed)
    assert open_checkpoint(tmp_path / "b.npz").entries["links"].array()[1, 1, 1] == 7
    (tmp_path / "c.msgpack").write_bytes(msgpack.packb(snapshot()))
    assert open_checkpoint(tmp_path / "c.msgpack").system == "instant-ngp"
    torch.save(hash_model(16), tmp_path / "d.pth", _use_new_zipfile_serialization=False)
    assert open_checkpoint(tmp_path / "d.pth").system == "torch-ngp"


def test_grids_of_tensorf_in_dvgo_are_told(tmp_path):
    grids = {f"density.{name}": weights(1, 2, 2, 2) for name in ("xy_plane", "z_vec")}
    grids |= {"k0.xy_plane": weights(1, 2, 2, 2), "k0.f_vec": weights(2, 3)}
    torch.save({"model_kwargs": {"num_voxels": 8}, "model_state_dict": grids}, tmp_path / "a.tar")
    assert open_checkpoint(tmp_path / "a.tar").system == "dvgo"


# --- folders ------------------------------------------------------------------------------------------------


def test_a_folder_is_its_newest_checkpoint(tmp_path):
    for name in ("000100.tar", "000090.tar", "001000.tar"):
        torch.save({"network_fn_state_dict": state("pts_linears.0.weight")}, tmp_path / name)
    np.savez(tmp_path / "poses.npz", a=np.zeros(3))
    (tmp_path / "readme.txt").write_text("runs")
    checkpoint = open_checkpoint(tmp_path)
    assert checkpoint.path.name == "001000.tar" and "001000.tar is taken" in checkpoint.notes[0]


def test_a_folder_of_gsplat_is_its_last_step_of_all_gpus(tmp_path):
    path = write("gsplat", tmp_path)
    for name in ("ckpt_6999_rank0.pt", "ckpt_29999_rank1.pt", "ckpt_29999_rank12.pt"):
        shutil.copy(path, path.with_name(name))
    assert open_checkpoint(tmp_path).path == path


def test_a_folder_of_dvgo_is_its_last_fine_checkpoint(tmp_path):
    write("dvgo", tmp_path)
    for name in ("coarse_last.tar", "fine_020000.tar"):
        shutil.copy(tmp_path / "fine_last.tar", tmp_path / name)
    assert open_checkpoint(tmp_path).path.name == "fine_last.tar"


def test_a_folder_with_several_fields_is_refused(tmp_path):
    for name in ("chair.th", "lego.th"):
        shutil.copy(write("tensorf", tmp_path / "run"), tmp_path / name)
    with pytest.raises(UnknownCheckpoint, match="2 checkpoints: chair.th, lego.th; give one"):
        open_checkpoint(tmp_path)


def test_a_damaged_newest_checkpoint_is_not_passed_over(tmp_path):
    for name in ("000100.tar", "001000.tar"):
        torch.save({"network_fn_state_dict": state("pts_linears.0.weight")}, tmp_path / name)
    os.truncate(tmp_path / "001000.tar", 200)
    with pytest.raises(FormatError, match="001000.tar"):
        open_checkpoint(tmp_path)


def test_a_run_of_nerfstudio_is_named_by_its_config(tmp_path):
    path = write("nerfacto", tmp_path)
    assert open_checkpoint(tmp_path / "config.yml").path == path


def test_settings_that_cannot_be_read_are_noted(tmp_path):
    path = write("nerfacto", tmp_path)
    (tmp_path / "config.yml").write_text("a: [")
    checkpoint = open_checkpoint(path)
    assert list(checkpoint.beside) == ["dataparser_transforms.json"]
    assert "config.yml" in checkpoint.notes[0] and "it is not used" in checkpoint.notes[0]


# --- what is no checkpoint ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "name, data, said",
    [
        ("a.rfpack", b"PK\3\4" + bytes(26) + b"scene.json", "a bundle"),
        (
            "a.ply",
            b"ply\nformat binary_little_endian 1.0\nproperty float f_dc_0\nend_header\n",
            "Gaussian splats",
        ),
        ("a.spz", gzip.compress(b"NGSP" + bytes(40), mtime=0), "Gaussian splats"),
        ("a.splat", bytes(64), "Gaussian splats"),
        ("a.glb", b"glTF" + bytes(40), "a mesh"),
        ("a.png", b"\x89PNG\r\n\x1a\n" + bytes(40), "fusedrf train"),
        ("a.mp4", bytes(4) + b"ftypisom" + bytes(40), "a film"),
        ("a.pth", b"", "an empty file"),
        ("a.pth", b"hello, this is no checkpoint", "known are TensoRF"),
        ("a.pth", bytes(100), "known are TensoRF"),
        ("a.pkl", b"\x80\x04]\x94.", "known are TensoRF"),
        ("a.zip", b"PK\5\6" + bytes(18), "unpack it"),
        ("a.gz", gzip.compress(b"hello", mtime=0), "unpack it"),
    ],
)
def test_other_files_are_named(name, data, said, tmp_path):
    (tmp_path / name).write_bytes(data)
    with pytest.raises(UnknownCheckpoint, match=said):
        open_checkpoint(tmp_path / name)


@pytest.mark.parametrize(
    "content, said",
    [
        (
            {"epoch": 1, "model": state("layer.weight", "layer.bias")},
            r"epoch, model \(model: layer.weight, layer.bias",
        ),
        ({"pipeline": state("_model.gauss_params.means")}, "_model.gauss_params.means"),
        ({"model": hash_model(16)["model"] | state("deform_net.0.weight")}, "encoder.embeddings"),
        (({"a": weights(2)}, 30_000), "holds tuple"),
        (((3, *[weights(5, 3)] * 11), 30_000), "holds gaussians, iteration"),
        (((3, weights(5, 3), {"a": weights(2)}), 30_000), "holds tuple"),
        ({}, "is empty"),
        ({str(n): n for n in range(1000)}, "and 992 more"),
    ],
)
def test_unknown_torch_files_list_their_keys(content, said, tmp_path):
    torch.save(content, tmp_path / "a.pth")
    with pytest.raises(UnknownCheckpoint, match=said):
        open_checkpoint(tmp_path / "a.pth")


def test_unknown_archives_and_flax_files_list_their_keys(tmp_path):
    np.savez(tmp_path / "a.npz", poses=np.zeros(3), world_mat_0=np.eye(4))
    with pytest.raises(UnknownCheckpoint, match="holds poses, world_mat_0"):
        open_checkpoint(tmp_path / "a.npz")
    content = flax_checkpoint()
    del content["optimizer"]["target"]["model"]["static_nerf"]
    (tmp_path / "checkpoint_1").write_bytes(msgpack.packb(content))
    with pytest.raises(UnknownCheckpoint, match="holds nerf_alpha, optimizer"):
        open_checkpoint(tmp_path / "checkpoint_1")


def test_versions_and_modes_of_snapshots(tmp_path):
    path = tmp_path / "a.msgpack"
    content = snapshot(version=2)
    path.write_bytes(msgpack.packb(content))
    with pytest.raises(NewerVersion, match="of version 2, and this fusedrf reads 1"):
        open_checkpoint(path)
    del content["snapshot"]["version"]
    path.write_bytes(msgpack.packb(content))
    with pytest.raises(OlderVersion, match="before July 2022"):
        open_checkpoint(path)
    content["snapshot"]["mode"] = "sdf"
    path.write_bytes(msgpack.packb(content))
    with pytest.raises(UnknownCheckpoint, match="'sdf', expected nerf"):
        open_checkpoint(path)
    del content["snapshot"]["mode"]
    path.write_bytes(msgpack.packb(content))
    with pytest.raises(UnknownCheckpoint, match="without a radiance field"):
        open_checkpoint(path)


def test_folders_without_checkpoints_and_pipes_are_refused(tmp_path):
    with pytest.raises(UnknownCheckpoint, match="no file named .th, .tar"):
        open_checkpoint(tmp_path)
    np.savez(tmp_path / "a.npz", poses=np.zeros(3))
    with pytest.raises(UnknownCheckpoint, match="a.npz is none"):
        open_checkpoint(tmp_path)
    os.mkfifo(tmp_path / "pipe.pth")
    with pytest.raises(NotAFile):
        open_checkpoint(tmp_path / "pipe.pth")


# --- damage -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("system", SYSTEMS)
def test_damaged_checkpoints_are_refused_or_read(system, tmp_path):
    whole = write(system, tmp_path).read_bytes()
    outcomes = set()
    for index in range(30):
        (tmp_path / "a").write_bytes(spoilt(whole, random.Random(f"{system}/{index}")))
        try:
            read_all(tmp_path / "a")
            outcomes.add("read")
        except FormatError as error:
            assert str(error).isprintable()
            outcomes.add("refused")
    assert "refused" in outcomes


@pytest.mark.parametrize(
    "entries, lacking",
    [
        (lambda table: table["state_dict"], "kwargs, state_dict/density_line.0, state_dict/app_line.0"),
        (lambda table: {"model": table}, "kwargs, state_dict/density_line.0, state_dict/app_line.0"),
    ],
)
def test_arrays_that_lie_elsewhere_are_said_to_be_a_systems(tmp_path, entries, lacking):
    lines = state("density_line.0", "density_plane.0", "app_line.0", "app_plane.0")
    torch.save(entries({"kwargs": {"aabb": weights(2, 3)}, "state_dict": lines}), tmp_path / "a.th")
    with pytest.raises(
        UnknownCheckpoint, match=f"as TensoRF names them, but {re.escape(lacking)} lack: give"
    ):
        open_checkpoint(tmp_path / "a.th")


@pytest.mark.parametrize("prefix", ["module.", "_orig_mod.", "module._orig_mod.", "_orig_mod.module."])
def test_names_of_a_model_on_several_gpus_or_compiled(prefix, tmp_path):
    path = write("torch-ngp", tmp_path)
    table = torch.load(path, weights_only=False)
    plain = [*table["model"]]
    table["model"] = {prefix + name: value for name, value in table["model"].items()}
    torch.save(table, path)
    checkpoint = open_checkpoint(path)
    assert checkpoint.system == "torch-ngp" and [*checkpoint.entries["model"]] == plain


def test_names_of_checkpoints_may_end_twice(tmp_path):
    path = write("torch-ngp", tmp_path)
    for step in (1, 3, 20):
        shutil.copy(path, tmp_path / f"ngp_ep{step:04d}.pth.pth")
    path.unlink()
    assert open_checkpoint(tmp_path).path.name == "ngp_ep0020.pth.pth"


def test_a_scene_that_moves_is_not_said_to_lack_anything(tmp_path):
    """torch-ngp's networks of moving scenes have all that the others have, and one more."""
    path = write("torch-ngp", tmp_path)
    table = torch.load(path, weights_only=False)
    table["model"] |= state("deform_net.0.weight")
    torch.save(table, path)
    with pytest.raises(UnknownCheckpoint, match="which no known system writes; known are TensoRF"):
        open_checkpoint(path)
