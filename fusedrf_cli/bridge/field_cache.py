"""The fields of a scene that are in memory: as many as there is room for."""

from collections import OrderedDict
from collections.abc import Callable

from fusedrf_cli.engine.fields.base import RadianceField


class FieldCache:
    """Fields that were read; the one not asked for longest makes room for the next."""

    def __init__(self, room: float = float("inf")):
        """room in bytes; the field asked for last stays even where it is larger."""
        self.room = room
        self._held: OrderedDict[str, tuple[RadianceField, int]] = OrderedDict()

    def take(self, key: str, size: int, read: Callable[[], RadianceField]) -> RadianceField:
        """The field of that key, of `size` bytes, read where it is not here."""
        if key not in self._held:
            self._clear(self.room - size)
            self._held[key] = read(), size
        self._held.move_to_end(key)
        return self._held[key][0]

    def resize(self, room: float) -> None:
        """Another limit, kept from now on."""
        self.room = room
        self._clear(room)

    def _clear(self, room: float) -> None:
        while self._held and sum(size for _, size in self._held.values()) > room:
            self._held.popitem(last=False)
