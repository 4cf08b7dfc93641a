"""Analytic scenes as files: one bundle for every distinct field, and a scene.json that places them."""

import json
from pathlib import Path

import numpy as np

from formats.scene import SceneGraph, make_node, write_scene
from fusedrf_cli.bridge.field_bundle import write_field
from fusedrf_cli.engine.rendering.cameras import Camera
from tests.analytic.scenes import Scene


def write_bundles(
    folder: Path,
    scene: Scene,
    kind: str = "vm",
    file: str = "scene.json",
    composition: str = "max",
    precision: str = "float16",
) -> Path:
    """Write a scene of a field kind into a folder; returns the path of the scene graph."""
    sources, nodes = {}, []
    for part, placed in zip(scene.parts, scene.placed(kind), strict=True):
        if id(part.field) not in sources:
            sources[id(part.field)] = f"{part.name}.rfpack"
            path = str(folder / sources[id(part.field)])
            write_field(path, placed.field, part.name, precision=precision, overwrite=True)
        matrix = np.asarray(part.object_to_world).tolist()
        nodes.append(make_node(part.name, source=sources[id(part.field)], matrix=matrix))
    write_scene(folder / file, SceneGraph(tuple(nodes), composition), overwrite=True)
    return folder / file


def write_camera(path: Path, camera: Camera) -> None:
    """One camera as transforms.json, for `fusedrf render --cameras`."""
    content = {"fl_x": camera.fl_x, "fl_y": camera.fl_y, "cx": camera.cx, "cy": camera.cy}
    frame = {"file_path": path.stem, "transform_matrix": camera.camera_to_world.tolist()}
    path.write_text(json.dumps({**content, "w": camera.width, "h": camera.height, "frames": [frame]}))
