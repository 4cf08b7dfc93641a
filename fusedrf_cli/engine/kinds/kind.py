"""What a kind of field is to the rest of the program."""

from dataclasses import dataclass

from fusedrf_cli.engine.fields.base import StoredField


@dataclass(frozen=True)
class Kind:
    """A kind of field: what it is called, what it is good for, and how its fields are made."""

    name: str
    """As people type it and as bundles say it."""
    good_for: str
    """One sentence for the list of kinds."""
    field: type[StoredField] | None
    """The class of its fields; None for a way of fusing whose fields are another kind's."""
