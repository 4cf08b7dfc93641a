"""Scenes as functions of torch: open a bundle, ask it, render it, learn its numbers, a camera's pose or where
an object stands, and save it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from fusedrf_cli.bridge.saving import save_scene
from fusedrf_cli.bridge.scene import LoadedScene, grouped, load_scene, short_origin
from fusedrf_cli.engine.composition.composed import ComposedField
from fusedrf_cli.engine.composition.composite import as_composite
from fusedrf_cli.engine.composition.differentiable import Poses, numbers, query
from fusedrf_cli.engine.fields.base import RadianceField
from fusedrf_cli.engine.fields.occupancy import placed_box
from fusedrf_cli.engine.fields.streamed import opened
from fusedrf_cli.engine.rendering.cameras import Camera, framing_camera
from fusedrf_cli.engine.rendering.differentiable import (
    Picture,
    render_image,
    render_rays,
    seen_from,
    shifted,
)
from fusedrf_cli.engine.spaces import bounded


def open_scene(path: str | Path, device: str = "cpu", allow_outside: bool = False) -> "Scene":
    """The scene of a bundle or a scene.json, its fields' numbers on a device of torch.

    Sources outside the scene's folder are refused unless allow_outside. Raises a `formats` error or
    InvalidInput, one sentence each, for a file that is missing or is not what it should be.
    """
    return Scene(load_scene(str(path), allow_outside, device=device))


class Scene:
    """Fields placed in a world, and the rule by which they are one field.

    Answers are tensors on the fields' device, differentiable in what is asked, in the fields' numbers and in
    `placements`. Lengths are the world's; directions have unit length.
    """

    def __init__(self, loaded: LoadedScene):
        self._loaded = loaded
        read: dict[int, RadianceField] = {}
        self.fields: dict[str, RadianceField] = {}
        """Each node's field by name; nodes that show the same one share it."""
        self.placements: dict[str, torch.Tensor] = {}
        """Where each node stands: (4, 4) float64, object to world. Another tensor may be put in place of one,
        and may require a gradient."""
        for source in loaded.fields:
            key = id(source.placed.field)
            if key not in read:
                read[key] = opened(source.placed.field)
            self.fields[source.placed.name] = read[key]
            self.placements[source.placed.name] = torch.from_numpy(source.placed.object_to_world.copy())
        self._composed = None

    @property
    def names(self) -> list[str]:
        """The nodes that hold a field, in order."""
        return list(self.fields)

    @property
    def rule(self) -> str:
        """How fields that overlap are one: by "max" the densest one answers, by "add" densities add up."""
        return self._loaded.composition

    @property
    def aabb(self) -> np.ndarray:
        """(6,) float64 box in the world outside of which nothing is."""
        field, origin, _ = self._current_field()
        return placed_box(field.occupancy.look_at_box, origin)

    def parameters(self) -> list[torch.Tensor]:
        """The numbers (P,) of each field, once, made to require gradients: what an optimiser is given."""
        different = {id(field): field for field in self.fields.values()}
        return [params.requires_grad_() for field in different.values() for params in numbers(field)]

    def query(self, points: torch.Tensor, dirs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """σ (N,) per unit of length and rgb (N, 3) in [0, 1] at points (N, 3), along unit dirs (N, 3)."""
        field, origin, poses = self._current_field()
        points, dirs, per_length = seen_from(origin, points, dirs)
        sigma, rgb = query(field, points, dirs, poses)
        return sigma if per_length is None else sigma * per_length.to(sigma), rgb

    def render_rays(
        self,
        rays_o: torch.Tensor,
        rays_d: torch.Tensor,
        *,
        near: float = 0.0,
        step: float | None = None,
        early_stop: float | None = None,
    ) -> torch.Tensor:
        """(N, 5) premultiplied rgb, opacity and Σ w t of rays (N, 3) with unit directions.

        near is the distance at which rays begin. step is the distance of samples in what is finest, None: as
        fine as that is; in other fields they lie as much farther apart as these are coarser. Samples behind
        which less light than early_stop is left are not asked. Both are lengths of the world, or of the frame
        of a field that fills all of space, where there is one. Where nothing needs a gradient this is many
        times faster.
        """
        field, origin, poses = self._current_field()
        how = {"poses": poses, "origin": origin, "near": near, "step": step, "early_stop": early_stop}
        return render_rays(field, rays_o, rays_d, **how)

    def render(
        self,
        camera: Camera,
        pose: torch.Tensor | None = None,
        *,
        step: float | None = None,
        early_stop: float | None = None,
    ) -> Picture:
        """The view of a camera, from `pose` (4, 4), camera to world, where it is given in place of the
        camera's own; see `render_rays`."""
        field, origin, poses = self._current_field()
        how = {"origin": origin, "step": step, "early_stop": early_stop}
        return render_image(field, camera, pose=pose, poses=poses, **how)

    def camera(self, azimuth: float, elevation: float, width: int, height: int) -> Camera:
        """A camera outside the scene that frames all of it; azimuth from +x about +z, elevation above the xy
        plane, radians."""
        return framing_camera(self.aabb, azimuth, elevation, width, height)

    def save(self, path: str | Path, *, precision: str = "float16", overwrite: bool = False) -> int:
        """Write the scene as it is now as one bundle, and return its bytes: precision is that of the fields'
        numbers, "float32", "float16", "int8" or "int4". Raises a `formats` error where that cannot be."""
        how = {"precision": precision, "overwrite": overwrite}
        return save_scene(path, self._loaded, self.fields, self._now(), **how)

    def _now(self) -> dict[str, np.ndarray]:
        """(4, 4) float64 placements as they are now. Raises ValueError for what is none."""
        unknown = sorted(self.placements.keys() ^ self.fields.keys())
        if unknown:
            raise ValueError(f"placements should be of {', '.join(self.names)}, found '{unknown[0]}'")
        now = {name: pose.detach().cpu().double().numpy().copy() for name, pose in self.placements.items()}
        for name, pose in now.items():
            if pose.shape != (4, 4) or not np.allclose(pose[3], [0, 0, 0, 1], rtol=0, atol=1e-5):
                raise ValueError(f"the placement of '{name}' should be (4, 4) with a last row of 0, 0, 0, 1")
            pose[3] = [0, 0, 0, 1]
        return now

    def _current_field(self) -> tuple[RadianceField, np.ndarray, Poses | None]:
        """The field that answers for the scene, where its frame lies in the world (a position (3,), or a
        placement (4, 4)), and those placements in its frame that need a gradient."""
        now = self._now()
        learnt = {name: pose for name, pose in self.placements.items() if pose.requires_grad}
        shown = {placed.name: placed for placed in self._loaded.placed}
        (name, placement), *others = now.items()
        alone = not others and not learnt and shown[name].as_it_is
        moved = np.array_equal(placement[:3, :3], np.eye(3))
        if alone and (moved or self.fields[name].occupancy.space is not bounded):
            return self.fields[name], short_origin(placement), None
        known = self._composed and {p.name: p.object_to_world for p in self._composed[0]}
        if not known or any(not np.array_equal(known[name], pose) for name, pose in now.items()):
            placed = [
                replace(shown[name], field=self.fields[name], object_to_world=pose)
                for name, pose in now.items()
            ]
            parts = grouped(placed, [source.groups for source in self._loaded.fields], self.rule)
            self._composed = placed, as_composite(ComposedField(parts, self.rule))
        field = self._composed[1]
        return field, field.origin, shifted(learnt, field.origin)
