"""Device functions run by Python itself: an oracle's other half that waits for no compiler."""

from collections.abc import Callable
from types import FunctionType

from fusedrf_cli.engine.kernels import specialise


def interpreted(field) -> dict[str, Callable]:
    """The namespace of a field's loops, as plain functions over numpy arrays."""
    sizes = field.bodies.sizes(field)
    names, functions = specialise.namespace(field.bodies, field.space)
    names |= sizes
    for name, value in {**names, **functions}.items():
        function = getattr(value, "py_func", functions.get(name))
        if function is not None:
            names[name] = FunctionType(function.__code__, names, name, function.__defaults__)
    names["literally"], names["prefetch"] = lambda value: value, lambda array, index: array[index]
    return names
