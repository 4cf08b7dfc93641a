"""fusedrf for other people's programs: its verbs (verbs.py), which read and write files as commands do, and
scenes as functions of torch (scene.py). docs/python.md has examples.

>>> fuse("scene.json", "fused.rfpack", max_size=10_000_000)["psnr"]
>>> sigma, rgb = open_scene("fused.rfpack").query(points, dirs)
"""

from fusedrf_cli import verbs
from fusedrf_cli.engine.composition.affine import rigid_motion
from fusedrf_cli.engine.rendering.cameras import Camera, look_at
from fusedrf_cli.engine.rendering.differentiable import Picture, camera_rays
from fusedrf_cli.scene import Scene, open_scene
from fusedrf_cli.verbs import *  # noqa: F403  (verbs.__all__)

__all__ = ["Camera", "Picture", "Scene", "camera_rays", "look_at", "open_scene", "rigid_motion"]
__all__ += verbs.__all__
