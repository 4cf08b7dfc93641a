"""Crops that hold nothing of what they crop."""

from collections.abc import Callable, Iterable
from typing import TypeVar

import numpy as np

from formats.nodes import Crop, Leaf
from formats.object_summary import world_aabb
from fusedrf_cli.errors import InvalidInput

T = TypeVar("T")


class NothingHeld(InvalidInput):
    """A crop holds nothing of a field."""

    def __init__(self, where: str, box: np.ndarray, crop: Crop):
        """box: (6,) of the field, in its own frame."""
        lies = ",".join(f"{number:.4g}" for number in world_aabb(box.tolist(), crop.object_to_shape))
        super().__init__(
            f"{where}: its crop holds nothing of it; in the frame of the node that is cropped it lies within "
            f"{lies}; give a box or a sphere that reaches into that"
        )


def where_held(make: Callable[..., T], found: Iterable[tuple]) -> list[T]:
    """What `make` gives of each leaf and what belongs to it; without those members of a group of which crops
    hold nothing while they hold something of others. Raises NothingHeld."""
    made: list[tuple[Leaf, T]] = []
    empty: list[tuple[Leaf, NothingHeld]] = []
    for leaf, *more in found:
        try:
            made.append((leaf, make(leaf, *more)))
        except NothingHeld as error:
            empty.append((leaf, error))
    shown = {leaf.groups[0] for leaf, _ in made if leaf.groups}
    for leaf, error in empty:
        if not leaf.groups or leaf.groups[0] not in shown:
            raise error
    return [one for _, one in made]
