"""`kinds`: what kinds of field there are."""

from fusedrf_cli.engine.kinds import registry
from fusedrf_cli.requests import KindsRequest


def list_kinds(request: KindsRequest, progress) -> dict:
    """Every kind: what it is good for, what it does, and the package it comes from. One that does not load is
    named in a warning."""
    rows = []
    for name in registry.names():
        try:
            kind = registry.kind(name)
        except registry.BrokenKind as error:
            progress.warn(str(error))
            continue
        does = ["train"] if kind.trains else []
        does += ["fuse"] if kind.field is None else ["fuse", "convert"]
        does = ["import"] if name in registry.IMPORTED else does
        rows.append(
            {"name": name, "good_for": kind.good_for, "does": does, "package": registry.package_of(name)}
        )
    return {"kinds": rows}
