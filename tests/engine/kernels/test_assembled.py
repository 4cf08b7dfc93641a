"""Fields assembled of encodings and decoders: products of them against the torch references of their parts.
The loops' functions are run by Python, so that nothing is compiled."""

from dataclasses import dataclass
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
import torch

from fusedrf_cli.engine.decoders import sh, sh_basis, sh_mlp, softplus_sum, tensorf_mlp
from fusedrf_cli.engine.encodings import grid, line, plane_line
from fusedrf_cli.engine.fields.assembled import AssembledField, Slot
from fusedrf_cli.engine.kernels import loops, parts, specialise
from fusedrf_cli.engine.kernels.assembled import READS, TEMPLATES, assemble
from fusedrf_cli.engine.spaces import bounded, unbounded

from ..conftest import BOX, points_in, unit
from .interpreted import interpreted

DENSITIES = {
    "line": (line, {"rank": 8}),
    "plane_line": (plane_line, {"rank": 8}),
    "grid": (grid, {"numbers": 1}),
}
FEATURES = DENSITIES | {"plane_line": (plane_line, {"rank": 16}), "grid": (grid, {"numbers": 13})}
SIGMAS = {"softplus_sum": (softplus_sum, {})}
COLOURS = {
    "sh_basis": lambda width: (sh_basis, {"width": width, "coefficients": 4}),
    "sh": lambda width: (sh, {"width": width, "coefficients": 4 if width >= 12 else 1}),
    "sh_mlp": lambda width: (sh_mlp, {"width": width, "hidden": 8}),
    "tensorf_mlp": lambda width: (tensorf_mlp, {"width": width, "rows": 5, "hidden": 11}),
}


@dataclass(frozen=True)
class Recipe:
    """Names of what fills the slots."""

    density: str
    colour: str
    sigma: str
    rgb: str


class Product(AssembledField):
    """A field of any encodings and decoders."""

    kind, shape_type = "product", Recipe

    @classmethod
    def slots_of(cls, shape: Recipe) -> dict[str, Slot]:
        density, colour = DENSITIES[shape.density], FEATURES[shape.colour]
        width = colour[0].sizes(**colour[1])["WIDTH"]
        return {
            "density": Slot(*density, "density_"),
            "colour": Slot(*colour, "colour_"),
            "sigma": Slot(*SIGMAS[shape.sigma], "sigma_"),
            "rgb": Slot(*COLOURS[shape.rgb](width), "rgb_"),
        }


PRODUCTS = [Recipe(e, e, "softplus_sum", c) for e in DENSITIES for c in COLOURS]
PRODUCTS += [Recipe("line", "grid", "softplus_sum", "sh_basis")]


@pytest.fixture(params=PRODUCTS, ids=lambda recipe: "-".join(vars(recipe).values()))
def field(request):
    made = Product(request.param, BOX, (5, 8, 7), 3.0, -0.5)
    generator = torch.Generator().manual_seed(0)
    return made.with_params(0.5 * torch.randn(len(made.params), generator=generator, dtype=torch.float64))


def asked(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Points in the box and unit directions."""
    return points_in(BOX, count), unit(np.random.default_rng(1).normal(size=(count, 3)))


def answer(names, field, p, d):
    """(σ, rgb) of the device functions at a point."""
    scratch, memory = np.zeros(names["SCRATCH"]), np.empty(max(names["KEPT"], 1))
    sigma, _, steps, at = names["density"](field.arrays, field.grid, 0, p, d, scratch)
    assert steps == 1
    names["begin"](field.arrays, 0, d, scratch)
    return sigma, names["colour"](field.arrays, at, p, d, scratch, memory, 0)


def test_device_functions_answer_as_the_references_of_their_parts(field):
    names, (points, dirs) = interpreted(field), asked(12)
    wanted = field.reference(field.params, torch.from_numpy(points), torch.from_numpy(dirs))
    for i, (p, d) in enumerate(zip(points.tolist(), dirs.tolist(), strict=True)):
        sigma, rgb = answer(names, field, tuple(p), tuple(d))
        assert sigma == pytest.approx(float(wanted[0][i]), rel=1e-9)
        np.testing.assert_allclose(rgb, wanted[1][i], atol=1e-10)


@pytest.mark.parametrize("shaded", [True, False])
def test_device_functions_send_back_what_autograd_does(field, shaded):
    """Two samples of each ray, so that what a ray gathers is sent once; a sample that is not shaded sends
    back by its density alone."""
    names, (points, dirs) = interpreted(field), asked(6)
    arrays, grid = field.arrays, field.grid
    grad = np.zeros(len(field.params))
    rng = np.random.default_rng(2)
    d_sigma, d_rgb = rng.normal(size=6), rng.normal(size=(6, 3)) * shaded
    dirs = dirs[[0, 0, 1, 1, 2, 2]]
    for i in range(0, 6, 2):
        d, scratch = tuple(dirs[i]), np.zeros(names["SCRATCH"])
        names["begin"](arrays, 0, d, scratch)
        for k in (i, i + 1):
            p, memory = tuple(points[k]), np.empty(max(names["KEPT"], 1))
            _, pre, _, at = names["density"](arrays, grid, 0, p, d, scratch)
            rgb = names["colour"](arrays, at, p, d, scratch, memory, 0) if shaded else (0.0, 0.0, 0.0)
            sent = d_sigma[k], shaded, rgb, tuple(d_rgb[k])
            names["backward"](arrays, at, p, d, pre, *sent, scratch, memory, 0, grad)
        names["end"](arrays, 0, d, scratch, grad)
    params = field.params.clone().requires_grad_()
    answers = field.reference(params, torch.from_numpy(points), torch.from_numpy(dirs))
    torch.autograd.backward(answers, (torch.from_numpy(d_sigma), torch.from_numpy(d_rgb)))
    assert (params.grad != 0).sum() > 20
    np.testing.assert_allclose(grad, params.grad, atol=1e-10)


def test_references_are_differentiable_in_numbers_points_and_directions(field):
    points, dirs = (torch.from_numpy(values).requires_grad_() for values in asked(8))
    leaves = field.params.clone().requires_grad_(), points, dirs
    assert torch.autograd.gradcheck(field.reference, leaves, fast_mode=True, eps=1e-7, atol=1e-6, rtol=1e-5)


def test_no_answer_is_beyond_the_bound(field):
    """`check_answers` keeps the answers of a file's numbers finite: its bounds hold at random points, and are
    not far from what is reached."""
    said = {}
    field.check_density, field.check_logit = (
        lambda most: said.update(density=most), lambda most: said.update(logit=most)
    )  # fmt: skip
    field.check_answers()
    points, dirs = (torch.from_numpy(values) for values in asked(500))
    sigma, rgb = field.reference(field.params, points, dirs)
    raw = torch.expm1(sigma / field.scale).log() - field.shift
    assert raw.abs().max() <= said["density"] < 1e4
    assert rgb.logit().abs().max() <= said["logit"] < 1e6


def test_what_is_prefetched_lies_in_the_numbers(field):
    """Also at points outside the box, where nobody answers."""
    names = interpreted(field)
    for p in points_in(BOX, 50, margin=0.05).tolist():
        names["ahead_density"](field.arrays, field.arrays.params, 0, tuple(p))
        names["ahead_colour"](field.arrays, field.arrays.params, 0, tuple(p))


def test_one_assembly_and_one_type_of_arrays_for_the_same_parts(field):
    slots = [slot.module for slot in field.slots.values()]
    assert assemble(*slots) is assemble(*slots) and type(field.arrays) is assemble(*slots).Arrays


@pytest.mark.parametrize("space", [bounded, unbounded])
def test_no_two_parts_of_a_namespace_define_one_name(field, space):
    """The namespace is flat and the later name wins: a name of a slot that hides one of the loops, of the
    space or of kernels/parts.py would be called in its place. Hooks of loops.py are there to be hidden."""
    bodies = vars(field.bodies)
    own = {name for name in {*bodies, *field.bodies.sizes(field)} if not name.startswith("__")}
    hooks, settings = {template.__name__ for template in TEMPLATES}, {"LEARN_FROM", "SHADING_COST"}
    for module, allowed in ((loops, hooks | settings), (space, settings), (parts, set())):
        others = {name for name in own & set(vars(module)) if bodies.get(name) is not vars(module)[name]}
        assert others <= allowed


def test_names_get_the_prefix_of_their_slot(field):
    names, _ = specialise.namespace(field.bodies, bounded)
    for slot in READS:
        assert f"{slot}_forward" in names
    code = names["sigma_forward"].__code__
    assert "density_summed" in code.co_names and "sigma_activation" in code.co_names


def module_of(text: str, base: ModuleType) -> ModuleType:
    """A module as `base`, with other functions beside its own."""
    other = ModuleType("other")
    vars(other).update({k: v for k, v in vars(base).items() if k != "__name__"})
    exec(text, vars(other))
    return other


def test_what_does_not_fit_is_named():
    lacking = module_of("", line)
    del lacking.summed
    with pytest.raises(ValueError, match="softplus_sum' reads 'summed', which 'other' lacks"):
        assemble(lacking, line, softplus_sum, sh_basis)
    hidden = module_of("def prefetch_at(field, array, unit):\n    np.zeros(1)\nnp = 3", line)
    with pytest.raises(ValueError, match="'np' of '.*' has another meaning in another slot"):
        assemble(hidden, line, softplus_sum, sh_basis)
    unreadable = module_of("", line)
    unreadable.Arrays = SimpleNamespace(_fields=("shape",))
    with pytest.raises(ValueError, match="may not call its arrays"):
        assemble(unreadable, line, softplus_sum, sh_basis)
