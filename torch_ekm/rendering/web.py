"""A scene in the browser: a stand-alone page (viser)."""

from __future__ import annotations

import contextlib
import io
from pathlib import Path
from typing import Any

import numpy as np

from .._extras import require
from .._files import write_whole
from .scene import Scene, shape_mesh
from .visuals import Mesh


def save_animation(scene: Scene, path: Path) -> Path:
    """Write the frames as one stand-alone HTML page that can be turned and zoomed.

    viser draws on a server; it listens on 127.0.0.1, at a port of its own, while the page is made.

    Raises:
        MissingExtraError: viser is not installed.
        OutputError: ``path`` cannot be written.
    """
    rotation = require("scipy.spatial.transform").Rotation
    with contextlib.redirect_stdout(io.StringIO()):
        server = require("viser").ViserServer(host="127.0.0.1", port=0, verbose=False)
        try:
            nodes = _draw(server, scene)
            serializer = server.get_scene_serializer()
            for frame in scene.transforms:
                with server.atomic():
                    for node, T in zip(nodes, frame, strict=True):
                        node.wxyz = rotation.from_matrix(T[:3, :3]).as_quat(scalar_first=True)
                        node.position = T[:3, 3]
                serializer.insert_sleep(0.25)  # [s] for each frame
            page = serializer.as_html()
        finally:
            server.stop()
    write_whole(path, page)
    return path


def _draw(server: Any, scene: Scene) -> list[Any]:
    """Add the scene to a viser server, seen from its side; returns a node for each shape."""
    server.scene.set_up_direction(tuple(-scene.down))
    nodes = []
    for i, (shape, colour) in enumerate(scene.shapes):
        mesh, flat = shape_mesh(shape), isinstance(shape, Mesh) or shape.kind == "box"
        vertices, faces = mesh.vertices.astype(np.float32), mesh.faces.astype(np.uint32)
        look = {"color": tuple(int(255 * c) for c in colour), "opacity": scene.opacity(i)}
        nodes.append(server.scene.add_mesh_simple(f"/shape_{i}", vertices, faces, flat_shading=flat, **look))
    position, focus, up = scene.camera
    server.initial_camera.position = tuple(position)
    server.initial_camera.look_at = tuple(focus)
    server.initial_camera.up = tuple(up)
    server.initial_camera.fov = 0.6  # [rad]
    return nodes
