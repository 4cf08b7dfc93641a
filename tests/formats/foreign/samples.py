"""Small files as other systems write them, and damage to them that keeps checksums right."""

import gzip
import io
import random
import zipfile
from collections.abc import Callable
from pathlib import Path

import msgpack
import numpy as np
import torch

from formats.foreign.stored import StoredTensor
from formats.foreign.systems import open_checkpoint
from tests.promises.mutations import DAMAGES, EDGES

BLIND = sorted(DAMAGES.keys() - {"edge"})


def weights(*shape: int, seed: int = 0) -> torch.Tensor:
    """Random numbers of a shape."""
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed)) - 0.5


def state(*names: str, **shapes: tuple[int, ...]) -> dict:
    """A state dict of small tensors."""
    return {name: weights(2, 2) for name in names} | {n: weights(*s) for n, s in shapes.items()}


def flax_array(array: np.ndarray) -> msgpack.ExtType:
    return msgpack.ExtType(1, msgpack.packb((array.shape, array.dtype.name, array.tobytes())))


def snapshot(version: int = 1) -> dict:
    """A snapshot of instant-ngp without most of what one holds."""
    return {
        "encoding": {"otype": "HashGrid", "n_levels": 2},
        "snapshot": {
            "aabb": {"max": [float("inf")] * 3, "min": [0.0, 0.0, 0.0]},
            "density_grid_binary": bytes(range(64)),
            "mode": "nerf",
            "n_params": 64,
            "params_binary": bytes(128),
            "version": version,
        },
    }


def flax_checkpoint() -> dict:
    layer = {"kernel": flax_array(np.arange(6, dtype=np.float32).reshape(2, 3))}
    scalar = msgpack.ExtType(3, msgpack.packb(((), "float32", np.float32(1.5).tobytes())))
    model = {"static_nerf": {"nerf_mlps_fine": {"MLP_0": {"hidden_0": layer}}}, "warp_field": layer}
    return {"nerf_alpha": scalar, "optimizer": {"state": {}, "target": {"model": model}}}


def dvgo(**more) -> dict:
    kwargs = {"xyz_min": np.zeros(3, np.float32), "num_voxels": 8, "alpha_init": np.float64(0.5)}
    grids = state("xyz_min") | {"density.grid": weights(1, 1, 2, 2, 2), "k0.grid": weights(1, 3, 2, 2, 2)}
    return {"global_step": 7, "model_kwargs": kwargs, "model_state_dict": grids | more}


def hash_model(levels: int) -> dict:
    names = ("encoder.embeddings", "sigma_net.0.weight", "color_net.0.weight")
    return {"epoch": 1, "model": state(*names) | {"encoder.offsets": torch.arange(levels + 1)}}


GAUSSIANS = {
    "means": weights(5, 3),
    "scales": weights(5, 3),
    "quats": weights(5, 4),
    "opacities": weights(5, 1),
}
REST = weights(5, 3, 3)
TORCH: dict[str, tuple[str, object]] = {
    "tensorf": (
        "lego.th",
        {
            "kwargs": {"aabb": weights(2, 3), "gridSize": [2, 2, 2]},
            "state_dict": state("density_line.0", "app_line.0"),
            "alphaMask.shape": (1, 1, 2, 2, 2),
            "alphaMask.mask": np.array([255], np.uint8),
        },
    ),
    "dvgo": ("fine_last.tar", dvgo()),
    "dcvgo": ("fine_last.tar", dvgo(scene_center=weights(3), scene_radius=weights(3))),
    "dbivoxgo": (
        "fine_last.tar",
        {
            "model_kwargs": {},
            "model_state_dict": state("scene_radius", "density.0.grid", "density.1.grid", "k0.0.grid"),
        },
    ),
    "ccnerf": ("hotdog.th", {"kwargs": {"degree": 3}, "state_dict": state("S_vec.0", "sigma_vec.0")}),
    "d-nerf": (
        "000200.tar",
        {"network_fn_state_dict": state("_occ.pts_linears.0.weight", "_time.0.weight")},
    ),
    "dmpigo": ("fine_last.tar", dvgo(act_shift=weights(1, 1, 1, 1, 4))),
    "nerf-pytorch": (
        "000200.tar",
        {
            "global_step": 200,
            "network_fn_state_dict": state("pts_linears.0.weight"),
            "optimizer_state_dict": {},
        },
    ),
    "hashnerf": (
        "000200.tar",
        {
            "network_fn_state_dict": state("sigma_net.0.weight"),
            "embed_fn_state_dict": state("embeddings.0.weight"),
        },
    ),
    "krrish-nerf": ("checkpoint00200.ckpt", {"iter": 200, "model_coarse_state_dict": state("layer1.weight")}),
    "torch-ngp": ("ngp_ep0002.pth", hash_model(16)),
    "pvd": ("hash.pth", hash_model(14)),
    "nerfacto": (
        "nerfstudio_models/step-000000600.ckpt",
        {
            "step": 600,
            "pipeline": state(
                "_model.field.mlp_base.model.params",
                "_model.field.mlp_head.tcnn_encoding.params",
                "_model.proposal_networks.0.aabb",
            ),
        },
    ),
    "splatfacto": (
        "nerfstudio_models/step-000029999.ckpt",
        {
            "step": 29999,
            "pipeline": {f"_model.gauss_params.{name}": value for name, value in GAUSSIANS.items()}
            | {"_model.gauss_params.features_dc": weights(5, 3), "_model.gauss_params.features_rest": REST},
        },
    ),
    "gsplat": (
        "ckpts/ckpt_29999_rank0.pt",
        {"step": 29999, "splats": GAUSSIANS | {"sh0": weights(5, 1, 3), "shN": REST}},
    ),
    "3dgs": (
        "chkpnt30000.pth",
        (
            (1, GAUSSIANS["means"], weights(5, 1, 3), REST)
            + (GAUSSIANS["scales"], GAUSSIANS["quats"], GAUSSIANS["opacities"])
            + (weights(5), weights(5, 1), weights(5, 1), {"state": {}, "param_groups": [{"lr": 0.1}]}, 2.5),
            30000,
        ),
    ),
    "k-planes": (
        "model.pth",
        {"model": state("field.grids.0.0", "field.sigma_net.params"), "lr_scheduler": None},
    ),
}
PVD_MODELS = {
    "mlp": state("nerf_mlp.0.weight", "sigma_net.0.weight"),
    "vm": state("sigma_mat.0", "color_mat.0") | {"basis_mat.weight": weights(15, 6)},
    "tensors": {"tensor_volume.0": weights(1, 4, 2, 2, 2)},
}
CONFIG = """!!python/object:nerfstudio.engine.trainer.TrainerConfig
_target: !!python/name:nerfstudio.engine.trainer.Trainer ''
data: &id001 !!python/object/apply:pathlib.PosixPath
- data
- scene
again: *id001
pipeline: !!python/object:nerfstudio.pipelines.base_pipeline.VanillaPipelineConfig
  model: !!python/object:nerfstudio.models.nerfacto.NerfactoModelConfig
    average_init_density: 0.01
    proposal_samples: !!python/tuple
    - 96
    - 64
"""
NERFSTUDIO = {
    "config.yml": CONFIG,
    "dataparser_transforms.json": '{"transform": [[1, 0, 0, 0]], "scale": 0.5}',
}
BESIDE = {
    "nerfacto": NERFSTUDIO,
    "splatfacto": NERFSTUDIO,
    "gsplat": {"cfg.yml": "normalize_world_space: true\nbilateral_grid_shape: !!python/tuple\n- 16\n- 8\n"},
    "nerf-pytorch": {"args.txt": "multires = 10\ndatadir = ./data/a=b\nft_path = None\nwhite_bkgd = True\n"},
    "k-planes": {
        "config.py": "import os\nconfig = {'density_activation': 'trunc_exp', 'reso': [1, 2], 'a': -1}\n"
    },
    "dvgo": {"config.py": "data = dict(datadir='./x', inverse_y=False)\nbase = os.system('touch x')\n"},
    "d2nerf": {"options.json": '{"use_shadow_model": true}'},
    "svox2": {"args.json": '{"background_brightness": 0.5}'},
    "pvd": {
        "args.txt": "('PE', 10)\n('ckpt', 'a=b')\n('stage_iters', {'stage1': -1})\n('f', open('x'))\n"
        "('odd',)\n('steps', [1e10])\n\npsnr: 30.12 \nssim: 0.95\n"
    },
    "krrish-nerf": {"config.yml": "models: {coarse: {num_layers: 4}}\n"},
}


def old_torch(folder: Path) -> Path:
    """A checkpoint of before torch 1.6."""
    torch.save(TORCH["krrish-nerf"][1], folder / "a.ckpt", _use_new_zipfile_serialization=False)
    return folder / "a.ckpt"


def compressed_npz(folder: Path) -> Path:
    svox2(folder / "a.npz", np.savez_compressed)
    return folder / "a.npz"


def svox2(path: Path, save: Callable = np.savez) -> None:
    rows = np.arange(8, dtype=np.int32).reshape(2, 2, 2)
    numbers = {"density_data": np.ones((8, 1), np.float32), "sh_data": np.ones((8, 3), np.float16)}
    save(path, radius=np.ones(3), links=rows, basis_type=np.int64(1), **numbers)


def write(system: str, folder: Path) -> Path:
    """The checkpoint of a system in a run's folder, with the settings beside it."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in BESIDE.get(system, {}).items():
        (folder / name).write_text(text)
    if system == "svox2":
        path = folder / "ckpt.npz"
        svox2(path)
    elif system == "instant-ngp":
        path = folder / "base.ingp"
        path.write_bytes(gzip.compress(msgpack.packb(snapshot()), mtime=0))
    elif system == "d2nerf":
        path = folder / "checkpoint_100"
        path.write_bytes(msgpack.packb(flax_checkpoint()))
    else:
        name, content = TORCH[system]
        path = folder / name
        path.parent.mkdir(exist_ok=True)
        torch.save(content, path)
    return path


SYSTEMS = (*TORCH, "svox2", "instant-ngp", "d2nerf")


def read_all(path: Path) -> None:
    """Open a checkpoint and read every number of it."""
    level = [open_checkpoint(path).entries]
    while level:
        level = [inner for value in level for inner in (value.values() if isinstance(value, dict) else value)]
        for tensor in level:
            if isinstance(tensor, StoredTensor):
                assert tensor.array().shape == tensor.shape
        level = [value for value in level if isinstance(value, dict | list | tuple)]


# --- hostile files ------------------------------------------------------------------------------------------


def torch_zip(pickle: bytes, *storages: bytes, method: int = zipfile.ZIP_STORED) -> bytes:
    """A torch archive of any pickle, with storages "0", "1", …"""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", method) as archive:
        archive.writestr("a/data.pkl", pickle)
        for key, storage in enumerate(storages):
            archive.writestr(f"a/data/{key}", storage)
    return file.getvalue()


def spoilt(data: bytes, rng: random.Random) -> bytes:
    """Damage to a file: blind, or inside its members under right checksums."""
    if rng.random() < 0.7:
        if data[:4] == b"PK\3\4":
            return _rezipped(data, rng)
        if data[:2] == b"\x1f\x8b":
            return gzip.compress(_damaged(gzip.decompress(data), rng), 1, mtime=0)
    return _damaged(data, rng)


def _rezipped(data: bytes, rng: random.Random) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(data)) as old, zipfile.ZipFile(file, "w") as new:
        names = old.namelist()
        weights = [20 if name.endswith(".pkl") else 1 for name in names]
        (chosen,) = rng.choices(names, weights)
        for name in names:
            member = old.read(name)
            new.writestr(name, _damaged(member, rng) if name == chosen else member)
    return file.getvalue()


def _damaged(data: bytes, rng: random.Random) -> bytes:
    if len(data) > 8 and rng.random() < 0.5:
        at, size = rng.randrange(len(data) - 8), rng.choice((1, 2, 4, 8))
        number = (rng.choice(EDGES) % 256**size).to_bytes(size, "little" if rng.random() < 0.7 else "big")
        return data[:at] + number + data[at + size :]
    return DAMAGES[rng.choice(BLIND)](bytearray(data or b"\0"), rng)
