"""Fields assembled of encodings and decoders: products of them against the torch references of their parts.
The loops' functions are run by Python, so that nothing is compiled."""

from dataclasses import dataclass
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
import torch

from fusedrf_cli.engine.decoders import (
    density_linear,
    density_sum,
    direction_basis,
    direction_texture,
    mlp,
    rgb,
    sh,
    sh_basis,
    sh_mlp,
    trunk,
)
from fusedrf_cli.engine.encodings import (
    frequencies,
    grid,
    hash_grid,
    hash_runs,
    line,
    plane_line,
    plane_line_hash,
    planes,
    sparse_grid,
    sparse_rows,
    spheres,
    trunk_features,
    warped_frequencies,
)
from fusedrf_cli.engine.encodings.hash_runs import HashGrid
from fusedrf_cli.engine.fields.assembled import AssembledField, Slot
from fusedrf_cli.engine.kernels import ahead, instances, learning, light, loops, primitives, specialise
from fusedrf_cli.engine.kernels.assembled import LOOKING, OPTIONAL, READS, TEMPLATES, assemble
from fusedrf_cli.engine.spaces import bounded, unbounded

from ..conftest import BOX, points_in
from .interpreted import assert_answers, assert_gradients, interpreted, samples

RUNS = HashGrid((0.31, 0.07), 64)
HASHED = {"features": 2, "levels": hash_grid.levels_of(4, 6, 3, 1.7)}
HELD, AROUND = {"rows": 40, "blocks": 6}, {"wide": 7, "high": 4, "layers": 3, "columns": 20}
BY_ALL = [{"scale": 5.0, "side": 5, "rows": 32, "hashed": True, "offset": 0.0}] * 3
WARP = {"count": 2, "hidden": 8, "layers": 3, "skip": 2}
SHEET = {"count": 3, "hidden": 16, "layers": 1, "skip": 0}
WARPED = {"count": 1, "warp": WARP, "sheet": SHEET, "coordinates": 3, "coordinate_count": 2}
PLANES = {"features": 8, "scales": [(4, 3, 5), (7, 6, 2)]}
DENSITIES = {
    "line": (line, {"rank": 8}),
    "plane_line": (plane_line, {"rank": 8}),
    "grid": (grid, {"numbers": 1}),
    "hash_grid": (hash_grid, HASHED),
    "hash_runs": (hash_runs, {"hashed": RUNS}),
    "plane_line_hash": (plane_line_hash, {"rank": 8, "hashed": RUNS}),
    "frequencies": (frequencies, {"count": 2}),
    "frame_frequencies": (frequencies, {"count": 3, "frame": True}),
    "planes": (planes, PLANES),
    "planes_lines": (planes, PLANES | {"summed": True, "lines": True, "margin": 0.3}),
    "warped_frequencies": (warped_frequencies, WARPED),
    "still_too": (warped_frequencies, WARPED | {"still": True, "warp": SHEET, "sheet": WARP}),
    "always_hashed": (hash_grid, {"features": 2, "levels": BY_ALL}),
    "sparse_grid": (sparse_grid, HELD),
    "spheres": (spheres, {"numbers": 1, **AROUND}),
}
FEATURES = DENSITIES | {"plane_line": (plane_line, {"rank": 16}), "grid": (grid, {"numbers": 13})}
FEATURES |= {"sparse_rows": (sparse_rows, {"numbers": 13, "rows": HELD["rows"]})}
FEATURES |= {"spheres": (spheres, {"numbers": 3, **AROUND})}
FEATURES |= {name: (trunk_features, {"outputs": count}) for name, count in (("of 16", 16), ("of 8", 8))}
SIGMAS = {
    "density_sum": lambda width: (density_sum, {}),
    "exp": lambda width: (density_sum, {"activation": "exp"}),
    "relu": lambda width: (density_sum, {"activation": "relu"}),
    "linear": lambda width: (density_linear, {"width": width}),
    "trunk": lambda width: (trunk, {"width": width, "hidden": 8, "outputs": 16}),
    "exp_trunk": lambda width: (trunk, {"width": width, "hidden": 8, "outputs": 8, "activation": "exp"}),
    "limited": lambda width: (density_sum, {"activation": "exp", "limits": (-0.5, 0.5)}),
    "deep_trunk": lambda width: (trunk, {"width": width, "hidden": 8, "outputs": 8, "layers": 4, "skip": 2}),
}
COLOURS = {
    "rgb": lambda width: (rgb, {"width": width}),
    "sh_basis": lambda width: (sh_basis, {"width": width, "coefficients": 4}),
    "sh": lambda width: (sh, {"width": width, "coefficients": 4 if width >= 12 else 1}),
    "direction_basis": lambda width: (direction_basis, {"width": width, "hidden": 8}),
    "deep_basis": lambda width: (direction_basis, {"width": width, "hidden": 16, "layers": 3}),
    "own_basis": lambda width: (
        direction_basis,
        {"width": width, "hidden": 8, "own": width // 3, "frequencies": 2, "squashed": True},
    ),
    "texture": lambda width: (direction_texture, {"width": width, "own": width // 3, "side": 3}),
    "sh_mlp": lambda width: (sh_mlp, {"width": width, "hidden": 8}),
    "mlp": lambda width: (mlp, {"width": width, "rows": 5, "hidden": 11}),
    "deep_mlp": lambda width: (
        mlp,
        {"width": width, "rows": 0, "hidden": 8, "layers": 3, "frequencies": 3, "diffuse": True},
    ),
    "dimmed_mlp": lambda width: (mlp, {"width": width, "rows": 5, "hidden": 8, "dimmed": 6, "diffuse": True}),
    "mlp_of_harmonics": lambda width: (
        mlp,
        {"width": width, "rows": 0, "hidden": 8, "frequencies": 0, "direction": "harmonics"},
    ),
    "mlp_of_waves": lambda width: (
        mlp,
        {"width": width, "rows": 0, "hidden": 8, "frequencies": 4, "direction": "waves", "point": True},
    ),
    "mlp_of_points": lambda width: (
        mlp,
        {"width": width, "rows": 4, "hidden": 8, "layers": 1, "point": True, "limits": (-0.5, 0.5)},
    ),
}


@dataclass(frozen=True)
class Recipe:
    """Names of what fills the slots."""

    density: str
    colour: str
    sigma: str
    rgb: str
    shown: str = "sigmoid"


class Product(AssembledField):
    """A field of any encodings and decoders."""

    kind, shape_type = "product", Recipe

    @property
    def colour_activation(self) -> str:
        return self.shape.shown

    @classmethod
    def slots_of(cls, shape: Recipe) -> dict[str, Slot]:
        density, colour = DENSITIES[shape.density], FEATURES[shape.colour]
        width = colour[0].sizes(**colour[1])["WIDTH"]
        sigma = SIGMAS[shape.sigma](density[0].sizes(**density[1])["WIDTH"])
        return {
            "density": Slot(*density, "density_"),
            "colour": Slot(*colour, "colour_"),
            "sigma": Slot(*sigma, "sigma_"),
            "rgb": Slot(*COLOURS[shape.rgb](width), "rgb_"),
        }


PRODUCTS = [Recipe(e, e, "density_sum", c) for e in ("line", "plane_line", "grid") for c in COLOURS]
PRODUCTS += [Recipe("plane_line", "plane_line", "relu", "sh", shown) for shown in ("relu", "none", "exp")]
PRODUCTS += [Recipe("plane_line_hash", "plane_line", "density_sum", c) for c in COLOURS]
PRODUCTS += [
    Recipe("plane_line_hash", "grid", "exp", "sh"),
    Recipe("hash_runs", "hash_runs", "trunk", "rgb"),
    Recipe("line", "grid", "exp", "sh_basis"),
    Recipe("grid", "line", "relu", "sh"),
    Recipe("hash_grid", "of 16", "trunk", "sh_mlp"),
    Recipe("hash_grid", "hash_grid", "exp_trunk", "sh_mlp"),
    Recipe("frequencies", "of 8", "exp_trunk", "sh_mlp"),
    Recipe("frame_frequencies", "of 8", "deep_trunk", "deep_mlp"),
    Recipe("always_hashed", "grid", "exp_trunk", "mlp_of_points"),
    Recipe("line", "grid", "limited", "mlp_of_harmonics"),
    Recipe("still_too", "of 8", "exp_trunk", "dimmed_mlp"),
    Recipe("warped_frequencies", "of 8", "deep_trunk", "sh_mlp"),
    Recipe("planes_lines", "planes", "density_sum", "deep_basis"),
    Recipe("plane_line", "frequencies", "density_sum", "sh_mlp"),
    Recipe("planes", "of 16", "linear", "direction_basis"),
    Recipe("spheres", "spheres", "relu", "sh", "relu"),
    Recipe("sparse_grid", "sparse_rows", "density_sum", "texture"),
    Recipe("sparse_grid", "sparse_rows", "relu", "own_basis", "relu"),
]


def product(recipe: Recipe) -> Product:
    """A field of random numbers in float64; rows of a hash grid are asked at about half of its points."""
    scale, shift = (300.0, -6.0) if recipe.density == "plane_line_hash" else (3.0, 0.3)
    bare = Product(recipe, BOX, (5, 8, 7), scale, shift)
    generator = torch.Generator().manual_seed(0)
    field = bare.with_params(0.5 * torch.randn(len(bare.params), generator=generator, dtype=torch.float64))
    counts = {"blocks": HELD["blocks"], "vertices": HELD["rows"], "columns": AROUND["columns"]}
    for part, numbers in zip(field.parts, field.sections().values(), strict=True):
        if part.whole:
            count = counts[part.name.rpartition("_")[2]]
            numbers.copy_(torch.randint(-1, count, part.shape, generator=generator))
    return field


@pytest.fixture(params=PRODUCTS, ids=lambda recipe: "-".join(vars(recipe).values()))
def field(request):
    return product(request.param)


def test_device_functions_answer_as_the_references_of_their_parts(field):
    assert_answers(field)


@pytest.mark.parametrize("shaded", [True, False])
def test_device_functions_send_back_what_autograd_does(field, shaded):
    assert_gradients(field, shaded)


@pytest.mark.slow
@pytest.mark.parametrize("number", range(1, 9))
def test_compiled_products_answer_and_send_back_as_their_references(number):
    """Of parts that no kind is made of, which nothing else compiles."""
    field = product(PRODUCTS[-number])
    points, dirs = (torch.from_numpy(values) for values in samples(field, 200))
    params = field.params.clone().requires_grad_()
    expected = field.reference(params, points, dirs)
    answers = field.query(points, dirs)
    torch.testing.assert_close(answers, tuple(value.detach() for value in expected), rtol=1e-7, atol=1e-9)
    sent = torch.randn(200, dtype=torch.float64), torch.randn(200, 3, dtype=torch.float64)
    torch.autograd.backward(expected, sent)
    rows = np.zeros((1, len(params)))
    field.query_backward(points, dirs, *sent, rows)
    np.testing.assert_allclose(rows[0], params.grad, rtol=1e-6, atol=1e-8)


def test_references_are_differentiable_in_numbers_points_and_directions(field):
    if field.shape.sigma == "limited":
        pytest.skip("beyond its limits a gradient goes on where the function does not")
    points, dirs = (torch.from_numpy(values).requires_grad_() for values in samples(field, 8))
    leaves = field.params.clone().requires_grad_(), points, dirs
    assert torch.autograd.gradcheck(field.reference, leaves, fast_mode=True, eps=1e-7, atol=1e-6, rtol=1e-5)


def test_no_answer_is_beyond_the_bound(field):
    """`check_answers` keeps the answers of a file's numbers finite: its bounds hold at random points, and are
    not far from what is reached."""
    bounds = {}
    field.check_density, field.check_logit = (
        lambda most: bounds.update(density=most), lambda most: bounds.update(logit=most)
    )  # fmt: skip
    field.check_answers()
    points, dirs = (torch.from_numpy(values) for values in samples(field, 500))
    sigma, rgb = field.reference(field.params, points, dirs)
    deep = field.shape.sigma == "deep_trunk" or field.shape.density == "still_too"
    far = 100 if deep else 1  # bounds multiply from layer to layer
    if field.slots["sigma"].sizes["ACTIVATION"] == 0:
        raw = torch.expm1(sigma / field.scale).log() - field.shift
        assert raw.abs().max() <= bounds["density"] < 1e4 * far
    assert raw_colour(field, rgb[sigma > 0]).abs().max() <= bounds["logit"] < 1e6 * far


def raw_colour(field, rgb):
    """What a colour was before its activation, where that tells."""
    if field.shape.shown == "sigmoid":
        return rgb.logit()
    return rgb.log() if field.shape.shown == "exp" else rgb - 0.5 * (field.shape.shown == "relu") * (rgb > 0)


def test_what_is_prefetched_lies_in_the_numbers(field):
    """Also at points outside the box, where nobody answers."""
    names = interpreted(field)
    for p in points_in(BOX, 50, margin=0.05).tolist():
        names["prefetch_density"](field.arrays, field.arrays.params, 0, tuple(p))
        names["prefetch_colour"](field.arrays, field.arrays.params, 0, tuple(p))


def test_a_place_is_made_again_of_what_is_kept_of_it():
    """Whether rows of a hash grid were asked is known of a point alone when its density was; the colour comes
    out right whatever was asked in between."""
    field = product(Recipe("plane_line_hash", "plane_line", "density_sum", "sh_basis"))
    names, (points, dirs) = interpreted(field), samples(field, 30)
    d, scratch, memory = tuple(dirs[0]), np.zeros(names["SCRATCH"]), np.empty(names["KEPT"])
    along = torch.from_numpy(dirs[:1]).expand(30, 3)
    expected = field.reference(field.params, torch.from_numpy(points), along)[1].numpy()
    kept = [
        names["pack_cell"](names["density"](field.arrays, field.grid, 0, tuple(p), d, scratch)[3])
        for p in points
    ]
    assert 5 < sum(kept) < 25
    names["ray_setup"](field.arrays, d, scratch)
    for p, held, colour in zip(points, kept, expected, strict=True):
        place = names["unpack_cell"](field.arrays, held, tuple(p))
        shown = names["colour"](field.arrays, place, tuple(p), d, scratch, memory, 0)
        np.testing.assert_allclose(shown, colour, atol=1e-10)


def test_one_assembly_and_one_type_of_arrays_for_the_same_parts(field):
    slots = [slot.module for slot in field.slots.values()]
    assert assemble(*slots) is assemble(*slots) and type(field.arrays) is assemble(*slots).Arrays


@pytest.mark.parametrize("space", [bounded, unbounded])
def test_no_two_parts_of_a_namespace_define_one_name(field, space):
    """The namespace is flat and the later name wins: a name of a slot that hides one of the loops, of the
    space or of kernels/primitives.py would be called in its place. Hooks of loops.py are there to be
    hidden."""
    device_module = vars(field.device_module)
    own = {name for name in {*device_module, *field.device_module.sizes(field)} if not name.startswith("__")}
    hooks = {template.__name__ for template in TEMPLATES} | set(OPTIONAL)
    settings = {"LEARN_FROM", "SHADING_COST"}
    for module in (loops, ahead, learning, space, primitives, instances, light):
        looking = {template.__name__ for template in LOOKING} | {"LANES", "LANE_ROOM"}
        allowed = {loops: hooks | settings, space: settings, ahead: looking}.get(module, set())
        others = {
            name for name in own & set(vars(module)) if device_module.get(name) is not vars(module)[name]
        }
        assert others <= allowed


def test_names_get_the_prefix_of_their_slot(field):
    names, functions = specialise.namespace(field.device_module, bounded)
    for slot in READS:
        assert {f"{slot}_forward", f"{slot}_summed"} & set(names)
    assert "sigma_activation" in functions["sigma_backward"].__code__.co_names
    for name, function in functions.items():
        assert not [used for used in function.__code__.co_names if used.startswith("features_")], name


def module_of(text: str, base: ModuleType) -> ModuleType:
    """A module as `base`, with other functions beside its own."""
    other = ModuleType("other")
    vars(other).update({k: v for k, v in vars(base).items() if k != "__name__"})
    exec(text, vars(other))
    return other


def test_what_does_not_fit_is_named():
    lacking = module_of("", line)
    del lacking.summed
    with pytest.raises(ValueError, match="density_sum' reads 'summed', which 'other' lacks"):
        assemble(lacking, line, density_sum, sh_basis)
    hidden = module_of("def prefetch_at(field, array, unit):\n    np.zeros(1)\nnp = 3", line)
    with pytest.raises(ValueError, match="'np' of '.*' has two meanings"):
        assemble(hidden, line, density_sum, sh_basis)
    unreadable = module_of("", line)
    unreadable.Arrays = SimpleNamespace(_fields=("shape",))
    with pytest.raises(ValueError, match="may not call its arrays"):
        assemble(unreadable, line, density_sum, sh_basis)
