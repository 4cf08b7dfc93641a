"""Rays with the colours that they should show, in random order: of pictures, or of a teacher."""

from typing import NamedTuple

import numpy as np
import torch

from fusedrf_cli.engine.distillation.poses import Poses, poses_of
from fusedrf_cli.engine.distillation.shuffle import Shuffle
from fusedrf_cli.engine.fields.computed import Batch
from fusedrf_cli.engine.kernels.pixel_rays import rays_of_pixels
from fusedrf_cli.engine.rendering.cameras import Camera


class Pictures(NamedTuple):
    """Pictures of any sizes, pixel after pixel, row by row, picture after picture."""

    pixels: np.ndarray
    """(P, 4) uint8 straight alpha."""
    ignored: np.ndarray | None = None
    """(P,) bool: pixels that are never drawn, as a mask asks."""


class RayDataset:
    """Random pixels of posed pictures as rays with target colours."""

    def __init__(self, cameras: list[Camera], images: np.ndarray | Pictures, generator: torch.Generator):
        """images (n, H, W, 4) uint8 straight alpha, or pictures of the cameras' sizes."""
        pictures = images if isinstance(images, Pictures) else Pictures(images.reshape(-1, 4))
        self.images = torch.from_numpy(pictures.pixels)
        self.first = torch.tensor(np.cumsum([0, *(camera.width * camera.height for camera in cameras)]))
        self.ignored = None if pictures.ignored is None else torch.from_numpy(pictures.ignored)
        drawn = None if pictures.ignored is None else np.flatnonzero(~pictures.ignored)
        self.drawn = None if drawn is None else torch.from_numpy(drawn)
        keys = {camera.intrinsics: camera for camera in cameras}
        directions = [torch.from_numpy(c.local_directions()).reshape(-1, 3).float() for c in keys.values()]
        starts = dict(zip(keys, np.cumsum([0, *map(len, directions[:-1])]).tolist(), strict=True))
        self.local = torch.cat(directions)
        self.start = torch.tensor([starts[camera.intrinsics] for camera in cameras])
        self.set_poses(poses_of(cameras))
        self.pixel = np.array([1 / camera.fl_x for camera in cameras])
        """(n,) the angle of a pixel in the middle of each picture, in radians."""
        self.shuffle = Shuffle(len(self.images) if drawn is None else len(drawn), generator)

    def draw(self, count: int) -> tuple[np.ndarray, np.ndarray, torch.Tensor, np.ndarray]:
        """rays_o, rays_d (count, 3) float64, pixels (count, 4) float32 in [0, 1] and the numbers of their
        pictures (count,) int64, every pixel that is not ignored once before any comes again."""
        chosen = self.shuffle.draw(count)
        return self.of(chosen if self.drawn is None else self.drawn[chosen])

    def sample(self, count: int, generator: torch.Generator) -> tuple[np.ndarray, np.ndarray, torch.Tensor]:
        """As many random pixels of each picture, one picture after the other: rays_o, rays_d (n * count, 3)
        float64 and colours (n, count, 3), nan where a pixel is ignored or not opaque."""
        sizes = self.first.diff()[:, None]
        offsets = (torch.rand(len(sizes), count, generator=generator, dtype=torch.float64) * sizes).long()
        chosen = (self.first[:-1, None] + offsets).reshape(-1)
        rays_o, rays_d, pixels, _ = self.of(chosen)
        colours = pixels[:, :3]
        colours[pixels[:, 3] < 0.999] = torch.nan  # opaque is 1 within a rounding
        if self.ignored is not None:
            colours[self.ignored[chosen]] = torch.nan
        return rays_o, rays_d, colours.reshape(len(sizes), count, 3)

    def of(self, chosen: torch.Tensor) -> tuple[np.ndarray, np.ndarray, torch.Tensor, np.ndarray]:
        """Rays, pixels and pictures as in `draw`, of the pixels (N,), counted picture after picture."""
        count = len(chosen)
        rays_o, rays_d, pixels = np.empty((count, 3)), np.empty((count, 3)), np.empty((count, 4), np.float32)
        pictures = np.empty(count, np.int64)
        rays_of_pixels(
            chosen.numpy(),
            self.first.numpy(),
            self.start.numpy(),
            self.local.numpy().reshape(-1),
            (self.rotation.numpy(), self.position.numpy()),
            self.images.numpy().reshape(-1),
            (rays_o, rays_d, pixels, pictures),
        )
        return rays_o, rays_d, torch.from_numpy(pixels), pictures

    @property
    def poses(self) -> Poses:
        """Where the pictures were taken from."""
        return Poses(self.rotation.numpy(), self.position.numpy())

    def set_poses(self, poses: Poses) -> None:
        """Have the pictures taken from elsewhere."""
        self.rotation, self.position = (torch.from_numpy(part.copy()) for part in poses)


class TeacherRays:
    """Rays with what a teacher shows along them, over white, in random order."""

    def __init__(self, rays_o: np.ndarray, rays_d: np.ndarray, shown: np.ndarray, shuffle: Shuffle):
        """rays_o, rays_d (R, 3) float64, unit directions; shown (R, 4) float32, premultiplied."""
        self.rays_o, self.rays_d, self.shuffle = rays_o, rays_d, shuffle
        self.target = shown.copy()
        self.target[:, :3] += 1 - self.target[:, 3:]

    def batch(self, count: int, step: float, opacity_weight: float, early_stop: float) -> Batch:
        """The next rays, with samples so far apart, jittered."""
        chosen = self.shuffle.draw(count).numpy()
        generator = self.shuffle.generator
        jitter = torch.rand(len(chosen), generator=generator, dtype=torch.float64).numpy()
        white = np.ones((len(chosen), 3), np.float32)
        rays = self.rays_o[chosen], self.rays_d[chosen], jitter, self.target[chosen], white
        return Batch(*rays, opacity_weight, 0.0, step, early_stop)
