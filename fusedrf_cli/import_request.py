"""What `import` is asked, with its defaults (requests.py)."""

from dataclasses import KW_ONLY, dataclass

from fusedrf_cli.request_parts import Box, Count, Positive, Precision, Vector, Writing


@dataclass(frozen=True)
class ImportRequest(Writing):
    """Another system's file to a bundle."""

    path: str
    output: str
    _: KW_ONLY
    name: str | None = None
    """Of the node; None: the file's stem."""
    precision: Precision = "float32"
    aabb: Box | None = None
    """Of a field whose file does not say where it lies."""
    near: Positive | None = None
    far: Positive | None = None
    """The distances from the cameras between which it lies, where there is no box."""
    cameras: str | None = None
    """The capture that the field was learnt from, whose cameras the bundle keeps."""
    time: float | None = None
    """That a moving scene is taken at."""
    up: Vector | None = None
    """Which way of its world is up, of any length but 0; None: as the habit of its format has it."""
    memory: Count | None = None
