"""Colours times a tint: what stands in for a kind's `colour` and `backward` where a field has
tints.

Here `own_colour` and `own_backward` mean the kind's, and `field.tint` is (1, 3). Fields without tints are
compiled without any of it.
"""

from functools import cache
from typing import NamedTuple

import numpy as np


def colour(field, place, p, d, scratch, memory, at):
    """See loops.py: the kind's, times the tint."""
    red, green, blue = own_colour(field, place, p, d, scratch, memory, at)
    return red * field.tint[0, 0], green * field.tint[0, 1], blue * field.tint[0, 2]


def backward(field, place, p, d, pre, d_sigma, shaded, rgb, d_rgb, scratch, memory, at, grad):
    """See loops.py: the kind's, which knows of no tint. Under one of 0 nothing is sent back, whatever the
    colour was."""
    red, green, blue = field.tint[0, 0], field.tint[0, 1], field.tint[0, 2]
    bare = rgb[0] / max(red, 1e-6), rgb[1] / max(green, 1e-6), rgb[2] / max(blue, 1e-6)
    sent = d_rgb[0] * red, d_rgb[1] * green, d_rgb[2] * blue
    own_backward(field, place, p, d, pre, d_sigma, shaded, bare, sent, scratch, memory, at, grad)


def tinted(functions: dict) -> dict:
    """A kind's functions by name, and those above in place of two of them."""
    return functions | {
        "own_colour": functions["colour"],
        "own_backward": functions["backward"],
        "colour": colour,
        "backward": backward,
    }


def with_tints(arrays: NamedTuple, tints: np.ndarray) -> NamedTuple:
    """A kind's Arrays and a tint (1, 3) behind them."""
    return tinted_arrays(type(arrays))(*arrays, np.ascontiguousarray(tints, np.float64))


@cache
def tinted_arrays(plain: type) -> type:
    """The type of a kind's Arrays with tints: one for each, since compiled code is kept by type. It is found
    in this module by its name, without which another process would take it for another type and compile all
    loops over it again."""
    name = f"{plain.__module__}.{plain.__qualname__}".replace(".", "_") + "_tinted"
    made = NamedTuple(name, [*plain.__annotations__.items(), ("tint", object)])
    made.__module__ = __name__
    globals()[name] = made
    return made
