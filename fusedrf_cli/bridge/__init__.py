"""The one place where both the engine and the formats are known: read, make engine objects, work, write,
report.

Every function takes one request (fusedrf_cli/requests.py) and somebody to tell of progress, writes its output
whole or not at all, and returns a JSON-able report.
"""

from fusedrf_cli.bridge.charting import chart
from fusedrf_cli.bridge.converting import convert
from fusedrf_cli.bridge.deleting import delete
from fusedrf_cli.bridge.evaluating import evaluate
from fusedrf_cli.bridge.extracting import extract
from fusedrf_cli.bridge.fusing import fuse
from fusedrf_cli.bridge.importing import import_field
from fusedrf_cli.bridge.kind_list import list_kinds
from fusedrf_cli.bridge.posing import pose
from fusedrf_cli.bridge.rendering import render
from fusedrf_cli.bridge.replacing import replace
from fusedrf_cli.bridge.trained_sources import train
from fusedrf_cli.bridge.transforming import add, duplicate, move, rename, show

__all__ = [
    "add",
    "chart",
    "convert",
    "delete",
    "duplicate",
    "evaluate",
    "extract",
    "fuse",
    "import_field",
    "list_kinds",
    "move",
    "pose",
    "rename",
    "render",
    "replace",
    "show",
    "train",
]
