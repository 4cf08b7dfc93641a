"""Blocks: a way of fusing vm fields whose result is a vm field, each source in its object's own axes."""

from fusedrf_cli.engine.kinds.blocks.students import BlocksKind

KIND = BlocksKind()
