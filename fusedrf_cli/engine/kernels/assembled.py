"""Device functions of fields that are assembled of encodings and decoders.

A field has four *slots*: `density` and `colour` hold encodings, `sigma` and `rgb` the decoders that read
them. Each is filled by a module of scalar functions (engine/encodings, engine/decoders). `assemble` makes of
four of them what kernels/loops.py expects of a kind: one flat namespace, in which the names of a slot have
its prefix. That is done by replacing names in the code of its functions, so that one module can fill two
slots and numba sees plain functions, which it can keep on disk and which kernels/cuda.py can bind again.

In a slot's functions these names get the prefix of the slot: its own functions, names in capitals (the
constants of its `sizes`, and of its module), and the fields of its `Arrays`, read as `field.NAME`.
`features_NAME` means NAME of the slot that is read: sigma reads density, rgb reads colour, and colour may
read sigma, whose outputs can be the features of the colour.
"""

import math
from functools import cache
from types import FunctionType, ModuleType
from typing import NamedTuple

from fusedrf_cli.engine.decoders.activations import COLOURS
from fusedrf_cli.engine.kernels.primitives import LINE, sigmoid

READS = {"density": "", "colour": "sigma", "sigma": "density", "rgb": "colour"}
"""Every slot, in the order of a field's numbers, and the slot that it reads."""
BASE = "params", "lo", "side"
"""Fields of every assembly's Arrays: numbers (P,); corner (3,) and sides (3,) of the cube of `unit`."""


# -- what the loops ask of a kind ----------------------------------------------------------------------------


def unit_of(field, p):
    """The coordinates of a point in the unit cube of the field's box."""
    return (
        (p[0] - field.lo[0]) / field.side[0],
        (p[1] - field.lo[1]) / field.side[1],
        (p[2] - field.lo[2]) / field.side[2],
    )


def density(field, grid, index, p, d, scratch):
    """See loops.py; a cell is (unit coordinates, what the density's encoding located there)."""
    unit = unit_of(field, p)
    cell = density_locate(field, unit)
    strides = density_steps_at(field, cell, unit, index)
    if strides == 0:
        return 0.0, 0.0, 0, (unit, cell)
    sigma, pre = sigma_at(field, unit, cell, scratch)
    return sigma, pre, strides, (unit, density_located(field, cell, scratch))


def unpack_cell(field, packed, p):
    """See loops.py."""
    unit = unit_of(field, p)
    return unit, density_locate(field, unit)


def shared_cell(field, cell):
    """What the colour's encoding located, where that is the density's as well."""
    return cell[1]


def separate_cell(field, cell):
    """The same, where it is another."""
    return colour_locate(field, cell[0])


def sigma_alone(field, unit, cell, scratch):
    """What sigma says of a cell."""
    return sigma_forward(field, cell, scratch)


def sigma_known(field, unit, cell, scratch):
    """The same, by a lane where one knows it (ahead.py)."""
    lane = sigma_lane_of(unit, scratch)
    return sigma_of_lane(field, lane, scratch) if lane >= 0 else sigma_forward(field, cell, scratch)


def lane_of(field, p, scratch):
    """See ahead.py."""
    return sigma_lane_of(unit_of(field, p), scratch)


def enter_lane(field, grid, p, lane, scratch):
    """See ahead.py."""
    unit = unit_of(field, p)
    cell = density_locate(field, unit)
    if density_steps_at(field, cell, unit, 0) == 0:
        return lane
    sigma_enter_lane(field, cell, unit, lane, scratch)
    return lane + 1


def fill_lanes(field, count, scratch):
    """See ahead.py."""
    sigma_fill_lanes(field, count, scratch)


LOOKING = lane_of, enter_lane, fill_lanes


def kept_density(field, grid, index, p, d, scratch):
    """`density` with a cell of three: 1 says that what sigma hands on of it is in scratch, where a `colour`
    that follows at once finds it, unless it is in a lane."""
    sigma, pre, strides, cell = plain_density(field, grid, index, p, d, scratch)
    return sigma, pre, strides, (cell[0], cell[1], 1)


def unkept_cell(field, packed, p):
    """`unpack_cell` with such a cell, of which nothing is in scratch."""
    cell = plain_unpack_cell(field, packed, p)
    return cell[0], cell[1], 0


def whole_cell(field, cell):
    """All of a cell, for a colour's encoding that reads what sigma hands on."""
    return cell


def ray_setup(field, d, scratch):
    """See loops.py."""
    rgb_ray_setup(field, d, scratch)


def ray_backward(field, d, scratch, grad):
    """See loops.py."""
    rgb_ray_backward(field, d, scratch, grad)


def plain_logits(field, cell, r, g, b, scratch):
    """The logits of a colour, to which the density's encoding adds none."""
    return r, g, b


def shifted_logits(field, cell, r, g, b, scratch):
    """The same, where it does."""
    red, green, blue = density_logits(field, cell[1], scratch)
    return r + red, g + green, b + blue


def colour(field, cell, p, d, scratch, memory, at):
    """See loops.py."""
    rgb_point_setup(field, cell[0], scratch)
    r, g, b = rgb_forward(field, colour_cell(field, cell), d, scratch, memory, at)
    r, g, b = shown_logits(field, cell, r, g, b, scratch)
    return shown(r), shown(g), shown(b)


def shown(x):
    """The colour that a logit is, by the activation of decoders/activations.py."""
    if COLOUR_ACTIVATION == 0:
        return float(sigmoid(x))
    if COLOUR_ACTIVATION == 1:
        return float(max(x + 0.5, 0.0))
    return float(x) if COLOUR_ACTIVATION == 2 else float(math.exp(min(max(x, -10.0), 10.0)))


def shown_backward(colour, d_colour):
    """The gradient of the logit of a colour."""
    if COLOUR_ACTIVATION == 0:
        return d_colour * colour * (1 - colour)
    if COLOUR_ACTIVATION == 1:
        return d_colour if colour > 0 else 0.0
    return d_colour if COLOUR_ACTIVATION == 2 else d_colour * colour


def backward(field, cell, p, d, pre, d_sigma, shaded, rgb, d_rgb, scratch, memory, at, grad):
    """See loops.py; colour first, since it may send back to what sigma hands on."""
    if shaded:
        d_red, d_green = shown_backward(rgb[0], d_rgb[0]), shown_backward(rgb[1], d_rgb[1])
        d_logits = d_red, d_green, shown_backward(rgb[2], d_rgb[2])
        rgb_backward(field, colour_cell(field, cell), d, d_logits, scratch, memory, at, grad)
        density_logits_backward(field, cell[1], d_logits, scratch)
    sigma_backward(field, cell[1], pre, d_sigma, scratch, grad)


TEMPLATES = unit_of, density, unpack_cell, ray_setup, ray_backward, colour, shown, shown_backward, backward


# -- where an encoding has the hook that they call; else the loops' own serve --------------------------------


def slot_pack_cell(cell):
    """See loops.py."""
    return density_pack_cell(cell[1])


def slot_unpack_cell(field, packed, p):
    """See loops.py."""
    unit = unit_of(field, p)
    return unit, density_unpack_cell(field, packed, unit)


def slot_next_index(field, grid, cell, n_steps, strides, index, p, direction, t_local, t_begin, step):
    """See loops.py."""
    return density_next_index(field, cell[1], n_steps, strides, index, p, direction, t_local, t_begin, step)


def slot_is_inside(field, grid, p):
    """See loops.py."""
    return density_is_inside(field, grid, p)


def prefetch_density(field, array, packed, p):
    """See loops.py."""
    density_prefetch_at(field, array, unpack_cell(field, packed, p)[1])


def prefetch_colour(field, array, packed, p):
    """See loops.py."""
    colour_prefetch_at(field, array, colour_cell(field, unpack_cell(field, packed, p)))


OPTIONAL = {
    "pack_cell": (slot_pack_cell, "density_pack_cell"),
    "unpack_cell": (slot_unpack_cell, "density_unpack_cell"),
    "next_index": (slot_next_index, "density_next_index"), "is_inside": (slot_is_inside, "density_is_inside"),
    "prefetch_density": (prefetch_density, "density_prefetch_at"),
    "prefetch_colour": (prefetch_colour, "colour_prefetch_at"),
}  # fmt: skip
"""By name, and the hook that each calls."""


# -- what a module may leave out -----------------------------------------------------------------------------


class NoArrays(NamedTuple):
    """Nothing is read beside `params`."""


def locate(field, unit):
    """The point itself."""
    return unit


def steps_at(field, cell, unit, index):
    """Every sample in the box stands for one step."""
    u, v, w = unit
    edge = 1e-9  # share of a box by which rounding may put a point on its face outside
    return 1 if min(u, min(v, w)) >= -edge and max(u, max(v, w)) <= 1 + edge else 0


def located(field, cell, scratch):
    """The cell, of which no more is known now."""
    return cell


def logits_backward(field, cell, d_logits, scratch):
    """Nothing was added to a colour's logits."""


def no_point_setup(field, unit, scratch):
    """The colour asks for no point."""


def no_ray_setup(field, d, scratch):
    """Nothing is known of a ray."""


def no_ray_backward(field, d, scratch, grad):
    """Nothing is gathered for a ray."""


HOOKS = {
    "locate": locate, "steps_at": steps_at, "located": located, "is_inside": None, "pack_cell": None,
    "unpack_cell": None, "next_index": None, "forward": None, "backward": None, "summed": None,
    "lane_of": None, "enter_lane": None, "fill_lanes": None, "of_lane": None, "hand_on": None,
    "summed_backward": None, "logits": None, "logits_backward": logits_backward, "prefetch_at": None,
    "point_setup": no_point_setup, "ray_setup": no_ray_setup, "ray_backward": no_ray_backward,
}  # fmt: skip
"""What the loops above and other slots call, and what serves where a module leaves it out; the rest of a
module is reached from there."""


# -- one namespace of four slots -----------------------------------------------------------------------------


@cache
def assemble(density: ModuleType, colour: ModuleType, sigma: ModuleType, rgb: ModuleType) -> ModuleType:
    """A kind's module of device functions, with `functions`, `Arrays` and `sizes`, of these encodings and
    decoders. Raises ValueError where a slot reads what another lacks, or two slots give one name two
    meanings."""
    slots = {"density": density, "colour": colour, "sigma": sigma, "rgb": rgb}
    label = "_".join(module.__name__.split(".")[-1] for module in slots.values())
    assembly = ModuleType(f"{__name__}.{label}.device_functions")
    names = vars(assembly) | {"sigmoid": sigmoid, "math": math}
    for slot, module in slots.items():
        for name, value in slot_names(slot, module, slots.get(READS[slot]), assembly).items():
            if names.setdefault(name, value) is not value:
                raise ValueError(f"'{name}' of '{module.__name__}' has two meanings")
    templates = {template.__name__: template for template in TEMPLATES}
    templates |= {name: template for name, (template, hook) in OPTIONAL.items() if hook in names}
    looks = hasattr(sigma, "fill_lanes") and "density_next_index" not in names
    templates["sigma_at"] = sigma_known if looks else sigma_alone
    templates |= {template.__name__: template for template in LOOKING if looks}
    shared = colour is density or getattr(colour, "locate", locate) is None
    templates["colour_cell"] = shared_cell if shared else separate_cell
    if getattr(colour, "READS_SCRATCH", False):
        plain = {f"plain_{name}": templates[name] for name in ("density", "unpack_cell")}
        templates |= plain | {"density": kept_density, "unpack_cell": unkept_cell, "colour_cell": whole_cell}
    templates["shown_logits"] = shifted_logits if hasattr(density, "logits") else plain_logits
    names |= {name: renamed(template, name, assembly, {}) for name, template in templates.items()}
    functions = {name: value for name, value in names.items() if isinstance(value, FunctionType)}
    vars(assembly).update(names, Arrays=arrays_type(slots), functions=functions, sizes=constants)
    return assembly


def slot_names(slot: str, module: ModuleType, read: ModuleType | None, assembly: ModuleType) -> dict:
    """What the functions of a slot need, by the name that it has in the one namespace."""
    names, fields = {}, set(arrays_of(module)._fields)
    if taken := fields & {*BASE, "shape", "dtype", "type"}:
        raise ValueError(f"'{module.__name__}' may not call its arrays {sorted(taken)}")
    hooks = {name: getattr(module, name, default) for name, default in HOOKS.items()}
    pending = {name: hook for name, hook in hooks.items() if hook is not None}
    known_as = dict(pending)
    while pending:
        name, function = pending.popitem()
        # of the slot's module, or of one that it takes functions from
        new, module_names = {}, function.__globals__
        for used in function.__code__.co_names:
            value = module_names.get(used)
            if used.startswith("features_"):
                needed = used.removeprefix("features_")
                if not isinstance(getattr(read, needed, None), FunctionType):
                    raise ValueError(f"'{module.__name__}' reads '{needed}', which '{read.__name__}' lacks")
                new[used] = f"{READS[slot]}_{needed}"
            elif isinstance(value, FunctionType) or used.isupper() or used in fields:
                new[used] = f"{slot}_{used}"
                if isinstance(value, FunctionType):
                    if known_as.setdefault(used, value) is not value:
                        raise ValueError(f"'{used}' of '{module.__name__}' has two meanings")
                    if new[used] not in names:
                        pending[used] = value
                elif used.isupper() and used in module_names:
                    names[new[used]] = value
            # numpy, kernels/primitives.py
            elif used in module_names and names.setdefault(used, value) is not value:
                raise ValueError(f"'{used}' of '{module.__name__}' has two meanings")
        names[f"{slot}_{name}"] = renamed(function, f"{slot}_{name}", assembly, new)
    return names


def renamed(function: FunctionType, name: str, assembly: ModuleType, new: dict[str, str]) -> FunctionType:
    """A function of an assembly under a name, in whose code globals and attributes have `new` names."""
    code = function.__code__
    code = code.replace(co_names=tuple(new.get(n, n) for n in code.co_names))
    other = FunctionType(code, vars(assembly), name, function.__defaults__)
    # code that is kept is found in another process by a module that can be imported
    other.__module__, other.__doc__ = function.__module__, function.__doc__
    return other


def arrays_of(module: ModuleType) -> type:
    """The type of the arrays of an encoding or a decoder."""
    return getattr(module, "Arrays", NoArrays)


def arrays_type(slots: dict[str, ModuleType]) -> type:
    """The type of the arrays of an assembly: one for each, found in this module by its name, without
    which another process would take it for another type and compile all loops over it again."""
    name = "Arrays_" + "_".join(module.__name__.replace(".", "_") for module in slots.values())
    if name not in globals():
        prefixed = [
            f"{slot}_{field}" for slot, module in slots.items() for field in arrays_of(module)._fields
        ]
        arrays = NamedTuple(name, [(field, object) for field in (*BASE, *prefixed)])
        arrays.__module__ = __name__
        globals()[name] = arrays
    return globals()[name]


def constants(field) -> dict[str, int | float]:
    """The constants of a field's namespace by name: those of each slot (engine/fields/assembled.py) with its
    prefix, and AT, where its ROOM numbers of scratch begin, on a cache line."""
    named, start = {}, 0
    of_loops = "KEPT", "LEARN_FROM", "SHADING_COST", "LANES", "LANE_ROOM"  # which loops read
    for slot, filled in field.slots.items():
        slot_sizes = filled.sizes
        named |= {name if name in of_loops else f"{slot}_{name}": value for name, value in slot_sizes.items()}
        named[f"{slot}_AT"] = start
        start += -(-slot_sizes.get("ROOM", 0) // LINE) * LINE
    shown_by = COLOURS.index(field.colour_activation)
    named |= {f"{slot}_LANE_AT": start for slot in field.slots}
    return {"KEPT": 0, **named, "COLOUR_ACTIVATION": shown_by, "SCRATCH": start}
