"""Scenes in which radiance-field methods fail, numbered S1 to S12, each with its truth in closed form.

A scene is a handful of placed analytic fields. `sigma`, `depth` and `pixels` are its truth, computed here in
float64 and independently of the engine; `placed` and `composed` are the same scene in any field kind.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from fusedrf_cli.engine.composition.affine import Placed
from fusedrf_cli.engine.composition.composed import ComposedField
from fusedrf_cli.engine.composition.composite import as_composite
from fusedrf_cli.engine.kinds.vm.field import VMField
from fusedrf_cli.engine.rendering.cameras import Camera, FramingConfig, look_at
from tests.analytic.export import exported, vm_field
from tests.analytic.fields import AnalyticField, Box, Gaussian, Tint, interval_of_box
from tests.analytic.rays import DIRECTIONS_26, affine, moved_rays, turn

RED, GREEN, BLUE = Tint.of(0.9, 0.15, 0.1), Tint.of(0.1, 0.8, 0.2), Tint.of(0.1, 0.2, 0.9)
GREY, SAND = Tint.of(0.5, 0.5, 0.5), Tint.of(0.8, 0.7, 0.5)
HUES = (RED, GREEN, BLUE, SAND, GREY)


@dataclass(frozen=True)
class Part:
    """One placed analytic field."""

    name: str
    field: AnalyticField
    object_to_world: np.ndarray


@dataclass(frozen=True)
class Scene:
    """Placed analytic fields, in node order."""

    parts: tuple[Part, ...]

    # -- the scene in the engine -----------------------------------------------------------------------------

    def placed(self, kind: str = "analytic", **options) -> list[Placed]:
        """The parts in a field kind (export.py, which takes the options), equal fields exported once."""
        made = {id(p.field): p.field for p in self.parts}
        made = {key: exported(field, kind, **options) for key, field in made.items()}
        return [Placed(p.name, made[id(p.field)], p.object_to_world) for p in self.parts]

    def composed(self, kind: str = "analytic", rule: str = "max", **options) -> ComposedField:
        """The engine's naive composition of the parts in a field kind."""
        return ComposedField(self.placed(kind, **options), rule)

    def composite(self, **options) -> tuple[ComposedField, np.ndarray]:
        """The composition of the parts as vm fields that compiled loops answer, and the world position (3,)
        of its frame's origin."""
        composed = as_composite(self.composed("vm", **options))
        return composed, composed.origin

    def under(self, matrix: np.ndarray) -> "Scene":
        """The whole scene placed once more by a (4, 4) affine."""
        return Scene(tuple(replace(p, object_to_world=matrix @ p.object_to_world) for p in self.parts))

    # -- the truth -------------------------------------------------------------------------------------------

    def sigmas(self, points: np.ndarray, dirs: np.ndarray) -> np.ndarray:
        """(P, N) σ of every part at world points along unit dirs (N, 3): σ_object |M^-1 d|."""
        found = []
        for part in self.parts:
            x, _, longer = moved_rays(np.linalg.inv(part.object_to_world), points, dirs)
            found.append(part.field.sigma(x) * longer)
        return np.array(found)

    def sigma(self, points: np.ndarray, dirs: np.ndarray, rule: str = "max") -> np.ndarray:
        """(N,) σ of the scene under a rule."""
        sigmas = self.sigmas(points, dirs)
        return sigmas.max(0) if rule == "max" else sigmas.sum(0)

    def depths(self, rays_o: np.ndarray, rays_d: np.ndarray) -> np.ndarray:
        """(P, N) optical depth of every part along whole world rays (N, 3): its own along its own ray."""
        found = []
        for part in self.parts:
            o, d, _ = moved_rays(np.linalg.inv(part.object_to_world), rays_o, rays_d)
            found.append(part.field.depth(o, d))
        return np.array(found)

    def intervals(self, rays_o: np.ndarray, rays_d: np.ndarray) -> np.ndarray:
        """(P, N, 2) distances between which each world ray is in the matter of each part."""
        found = []
        for part in self.parts:
            o, d, longer = moved_rays(np.linalg.inv(part.object_to_world), rays_o, rays_d)
            t = interval_of_box(part.field.matter[:3], part.field.matter[3:], o, d)
            found.append(np.stack(t, 1) / longer[:, None])
        return np.array(found)

    def pixels(self, rays_o: np.ndarray, rays_d: np.ndarray, rule: str = "max") -> np.ndarray:
        """(N, 4) premultiplied rgb and opacity of world rays (N, 3) through parts of even density.

        Between the faces a ray crosses, σ and colour do not change, so the volume integral is a sum; exact
        for tints that do not change with the place.
        """
        spans = self.intervals(rays_o, rays_d)
        hit = spans[..., 1] > spans[..., 0]
        ends = np.sort(np.where(hit[..., None], spans, 0.0).transpose(1, 0, 2).reshape(len(rays_o), -1), 1)
        out, trans = np.zeros((len(rays_o), 4)), np.ones(len(rays_o))
        for t0, t1 in zip(ends.T[:-1], ends.T[1:], strict=True):
            at = rays_o + ((t0 + t1) / 2)[:, None] * rays_d
            sigma, rgb = self.answer(at, rays_d, rule)
            light = trans * -np.expm1(-sigma * (t1 - t0))
            out[:, :3] += light[:, None] * rgb
            trans = trans - light
        out[:, 3] = 1 - trans
        return out

    def answer(self, points: np.ndarray, dirs: np.ndarray, rule: str) -> tuple[np.ndarray, np.ndarray]:
        """σ (N,) and rgb (N, 3) of the scene at world points along unit dirs (N, 3), ties to the first."""
        sigmas = self.sigmas(points, dirs)
        if rule == "max":
            share = (np.arange(len(sigmas))[:, None] == sigmas.argmax(0)) * 1.0
        else:
            share = sigmas / np.maximum(sigmas.sum(0), 1e-300)
        rgb = np.zeros((len(points), 3))
        for part, weight in zip(self.parts, share, strict=True):
            x, d, _ = moved_rays(np.linalg.inv(part.object_to_world), points, dirs)
            rgb += weight[:, None] * part.field.colour(x, d)
        return (sigmas.max(0) if rule == "max" else sigmas.sum(0)), rgb

    def image(self, camera: Camera, background=(1.0, 1.0, 1.0), rule: str = "max") -> np.ndarray:
        """(H, W, 3) float64 picture of the truth over a background."""
        found = self.pixels(*camera.rays(), rule)
        rgb = found[:, :3] + (1 - found[:, 3:]) * np.asarray(background)
        return rgb.reshape(camera.height, camera.width, 3)


def scene_of(*parts: tuple) -> Scene:
    """A scene of (field, (4, 4)) or (name, field, (4, 4)); the others are named a, b, c, ..."""
    named = [part if len(part) == 3 else (f"n{i:03d}", *part) for i, part in enumerate(parts)]
    return Scene(tuple(Part(*part) for part in named))


def camera_at(eye, target=(0.0, 0.0, 0.0), size: int = 64, up=(0.0, 0.0, 1.0)) -> Camera:
    """A square camera of the framing field of view at eye (3,) that looks at target (3,)."""
    focal = 0.5 * size / np.tan(FramingConfig.fov / 2)
    pose = look_at(np.asarray(eye, float), np.asarray(target, float), np.asarray(up, float))
    return Camera(pose, focal, focal, size / 2, size / 2, size, size)


def moved_camera(camera: Camera, matrix: np.ndarray) -> Camera:
    """The camera under a rigid (4, 4) motion or mirror image."""
    return replace(camera, camera_to_world=matrix @ camera.camera_to_world)


# -- the scenes --------------------------------------------------------------------------------------------

DEPTHS = (0.1, 0.7, 2.0, 8.0)


def s1_slabs(tau_a: float, tau_b: float, overlap: bool = False) -> Scene:
    """Two media, each a slab one unit thick in x and 16 wide, one behind the other or through each other:
    a ray at an angle θ to x sees exp(-τ / cos θ) of each."""
    wide = (0.5, 8.0, 8.0)
    apart = 0.0 if overlap else 0.75
    return scene_of(
        ("a", Box(tau_a, wide, tint=RED), affine(1.0, (-apart, 0, 0))),
        ("b", Box(tau_b, wide, tint=BLUE), affine(1.0, (apart, 0, 0))),
    )


def s2_blobs(condition: float, count: int = 3, seed: int = 0, spread: float = 2.5) -> Scene:
    """Gaussian blobs far enough apart not to overlap much, each under a random affine whose singular values
    span `condition`, every other one a mirror image; depth by erf."""
    rng = np.random.default_rng(seed)
    parts = []
    for i in range(count):
        left, right = (np.linalg.qr(rng.normal(size=(3, 3)))[0] for _ in range(2))
        sizes = np.array([1.0, condition ** rng.uniform(0.2, 0.8), condition]) / condition**0.5
        linear = left @ np.diag(sizes) @ right
        linear *= np.sign(np.linalg.det(linear)) * (-1) ** i
        parts.append((Gaussian(), affine(linear, spread * rng.normal(size=3))))
    return scene_of(*parts)


def s3_cube(degree: int = 1, density: float = 400.0, soft: bool = False) -> Scene:
    """An opaque cube whose six faces differ in colour (red grows with x, green with y, blue with z) and whose
    colour turns with the view by SH of a degree, 0 to 2; soft is a blob in its stead, whose picture does not
    depend on where a ray's samples lie."""
    facing = 0.9 * np.array([[-1.0, 0.3, 0], [0, -1, 0.3], [0.3, 0, -1]]) * (degree >= 1)
    bands = np.random.default_rng(3).normal(size=(3, 5)) if degree >= 2 else np.zeros((3, 0))
    tint = Tint(facing=facing, slope=4.0 * np.eye(3), bands=bands)
    blob = Gaussian(20.0, (0.0, 0.0, 0.0), 0.2, tint=tint)
    return scene_of(("cube", blob if soft else Box(density, 0.5, tint=tint), np.eye(4)))


def s4_twins(offset: float = 0.0, density: float = 1e3, noise: float = 0.0) -> Scene:
    """Two cubes of one density, the second moved along x by an offset in its own voxels, with noise of a
    share in both densities; the winner is the denser, the first on a tie."""
    red, blue = (Box(density, 0.5, noise=noise, seed=s, tint=t) for s, t in ((1, RED), (2, BLUE)))
    return scene_of(("red", red, np.eye(4)), ("blue", blue, affine(1.0, (offset * red.voxel_size, 0, 0))))


def s5_comb(width: float, voxel: float = 0.05, count: int = 8, wires: bool = False) -> Scene:
    """Plates (or wires, thin in y too), `width` voxels thick and one of eight voxels apart, opaque: a picture
    along z is covered for width / 8 of its pixels where the comb is, a plate's square for wires."""
    half = np.array([width * voxel / 2, width * voxel / 2 if wires else 0.5, 0.25])
    plate = Box(1000.0 / voxel, half, tint=GREEN)
    starts = (np.arange(count) - (count - 1) / 2) * 8 * voxel
    at = [(x, y, 0.0) for x in starts for y in (starts if wires else (0.0,))]
    return scene_of(*[(plate, affine(1.0, where)) for where in at])


def s6_room(fog: float = 0.3) -> Scene:
    """A box full of fog with two solids in it, and one that reaches out through a wall; slab algebra."""
    return scene_of(
        ("fog", Box(fog, (2.0, 2.0, 1.0), tint=GREY), np.eye(4)),
        ("red", Box(80.0, (0.3, 0.3, 0.3), tint=RED), affine(turn(25, (0, 0, 1)), (-0.7, -0.4, -0.3))),
        ("blue", Box(80.0, (0.25, 0.25, 0.5), tint=BLUE), affine(1.0, (0.6, 0.5, -0.2))),
        ("rod", Box(60.0, (0.8, 0.1, 0.1), tint=SAND), affine(turn(10, (0, 1, 0)), (1.9, -0.8, 0.2))),
    )


def s8_boxes(count: int, degrees: float, seed: int = 0) -> Scene:
    """`count` opaque boxes of different sizes and hues on a jittered lattice, all turned about one axis by an
    angle."""
    rng = np.random.default_rng(seed)
    side = int(np.ceil(count ** (1 / 3)))
    cells = np.stack(np.meshgrid(*[np.arange(side)] * 3, indexing="ij"), -1).reshape(-1, 3)[:count]
    parts = []
    for i, cell in enumerate(cells):
        half = rng.uniform(0.12, 0.3, 3)
        where = 1.1 * (cell - (side - 1) / 2) + rng.uniform(-0.15, 0.15, 3)
        parts.append((Box(60.0, half, tint=HUES[i % len(HUES)]), affine(turn(degrees), where)))
    return scene_of(*parts)


S9_VALUES = {"NaN": np.nan, "inf": np.inf, "-inf": -np.inf, "1e30": 1e30, "1e4": 1e4, "-1": -1.0}


def s9_hostile(value: float) -> VMField:
    """A vm cube with one number in the middle of its density line replaced; which answers are allowed is a
    rule, not an integral."""
    field = vm_field(Box(5.0, 0.5, tint=RED))
    field.sections()["density_line_0"][NODE, 0] = value
    return field


NODE = 7  # a texel in the middle


def s9_odd() -> dict[str, AnalyticField]:
    """Teachers that are well formed and odd: nothing at all, opaque everywhere, matter in a thousandth."""
    return {
        "empty": Box(0.0, 0.5, tint=GREY),
        "full": Box(1e4, 0.5, tint=RED),
        "one voxel": Box(1e3, 0.5 / NODE, tint=BLUE),
    }


def s10_chain(count: int = 32, seed: int = 0) -> tuple[Scene, list[str]]:
    """A floor, then `count` objects to add one after the other, and the order in which to delete them."""
    rng = np.random.default_rng(seed)
    floor = ("floor", Box(40.0, (3.0, 3.0, 0.2), tint=SAND), affine(1.0, (0, 0, -0.2)))
    side = int(np.ceil(count**0.5))
    objects = []
    for i in range(count):
        half = rng.uniform(0.12, 0.22, 3)
        where = 5.0 * (np.array([i % side, i // side]) + 0.5) / side - 2.5
        placed = affine(turn(rng.uniform(0, 90), (0, 0, 1)), (*where, half[2]))
        objects.append((f"object{i:02d}", Box(60.0, half, tint=HUES[i % len(HUES)]), placed))
    scene = scene_of(floor, *objects)
    return scene, [f"object{i:02d}" for i in rng.permutation(count)]


S11_RADII = (0.5, 1.0, 2.0, 10.0, 100.0)


def s11_far_objects(radius: float) -> Scene:
    """An object at a distance from the origin, its size a tenth of it, in front of a far wall that stands for
    the sky: its world-space depth is that of its box wherever it stands."""
    half = 0.1 * radius
    return scene_of(
        ("object", Box(0.7 / (2 * half), half, tint=RED), affine(turn(30, (0, 0, 1)), (radius, 0, 0))),
        ("sky", Box(1.0, (5.0, 400.0, 400.0), tint=BLUE), affine(1.0, (300.0, 0, 0))),
    )


def s12_rays(scene: Scene) -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
    """(what, origins, unit directions) of the rays that renderers stumble over, towards a scene's first part:
    from inside, from its faces, edges and corners, along the axes and the diagonals."""
    part = scene.parts[0]
    box = part.field.matter
    half, centre = (box[3:] - box[:3]) / 2, (box[3:] + box[:3]) / 2
    spots = {"inside": np.zeros(3), "far": np.array([-7.0, 0.13, 0.21])}
    spots |= {"face": np.array([1.0, 0, 0]), "edge": np.array([1.0, 1, 0]), "corner": np.ones(3)}
    for what, at in spots.items():
        origins = np.tile(centre + at * half, (26, 1))
        o, d, _ = moved_rays(part.object_to_world, origins, DIRECTIONS_26)
        yield what, o, d
