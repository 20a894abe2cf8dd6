"""A scene in the browser: a stand-alone page, or served while it changes (viser)."""

from __future__ import annotations

import contextlib
import io
from pathlib import Path
from typing import Any

import numpy as np

from .._extras import require
from ..typing import Array
from .scene import Scene, shape_mesh


def save_animation(scene: Scene, path: Path) -> Path:
    """Write the frames as one stand-alone HTML page that can be turned and zoomed (viser)."""
    server = start_server()
    try:
        serializer = server.get_scene_serializer()
        nodes = draw(server, scene)
        for frame in scene.transforms:
            place(server, nodes, frame)
            serializer.insert_sleep(0.25)  # [s] for each frame
        path.write_text(serializer.as_html(), encoding="utf-8")
    finally:
        with contextlib.redirect_stdout(io.StringIO()):
            server.stop()
    return path


def start_server(port: int = 0) -> Any:
    """A viser server for this machine that keeps quiet: the caller says what address is to be opened.

    Raises:
        MissingExtraError: viser is not installed.
    """
    viser = require("viser")
    with contextlib.redirect_stdout(io.StringIO()):
        return viser.ViserServer(host="127.0.0.1", port=port, verbose=False)


def draw(server: Any, scene: Scene) -> list[Any]:
    """Add the scene to a viser server, seen from its side; returns a node for each shape."""
    server.scene.set_up_direction(tuple(-scene.down))
    nodes = []
    for i, (shape, colour) in enumerate(scene.shapes):
        mesh = shape_mesh(shape)
        nodes.append(
            server.scene.add_mesh_simple(
                f"/shape_{i}",
                np.asarray(mesh.vertices, dtype=np.float32),
                np.asarray(mesh.faces, dtype=np.uint32),
                color=tuple(int(255 * c) for c in colour),
                flat_shading=shape.kind == "box",
                opacity=scene.opacity(i),
            )
        )
    position, focus, up = scene.camera
    server.initial_camera.position = tuple(position)
    server.initial_camera.look_at = tuple(focus)
    server.initial_camera.up = tuple(up)
    server.initial_camera.fov = 0.6  # [rad]
    return nodes


def place(server: Any, nodes: list[Any], transforms: Array) -> None:
    """Move the nodes to one frame of a scene, ``(n_shapes, 4, 4)``, all at once."""
    rotation = require("scipy.spatial.transform").Rotation
    with server.atomic():
        for node, T in zip(nodes, transforms, strict=True):
            node.wxyz = rotation.from_matrix(T[:3, :3]).as_quat(scalar_first=True)
            node.position = T[:3, 3]
