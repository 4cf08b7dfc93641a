"""The one place where both the engine and the formats are known: read, make engine objects, work, write,
report.

Every function takes paths and plain values, writes its output whole or not at all, and returns a JSON-able
report.
"""

from fusedrf_cli.bridge.chart import chart
from fusedrf_cli.bridge.edit import add, delete
from fusedrf_cli.bridge.evaluate import evaluate
from fusedrf_cli.bridge.fuse import fuse
from fusedrf_cli.bridge.render import render
from fusedrf_cli.bridge.train import train

__all__ = ["add", "chart", "delete", "evaluate", "fuse", "render", "train"]
