"""A scene in the browser: a stand-alone page, or served while it changes (viser)."""

from __future__ import annotations

import contextlib
import io
from pathlib import Path
from typing import Any

import numpy as np

from .._extras import require
from .._files import write_whole
from ..typing import Array
from .scene import Scene, shape_mesh
from .visuals import Mesh
from .web_guard import HOST, WebGuard


def save_animation(scene: Scene, path: Path) -> Path:
    """Write the frames as one stand-alone HTML page that can be turned and zoomed (viser)."""
    server, _ = start_server()
    try:
        serializer = server.get_scene_serializer()
        nodes = draw(server, scene)
        for frame in scene.transforms:
            place(server, nodes, frame)
            serializer.insert_sleep(0.25)  # [s] for each frame
        page = serializer.as_html()
    finally:
        with contextlib.redirect_stdout(io.StringIO()):
            server.stop()
    write_whole(path, page)
    return path


def start_server(port: int = 0) -> tuple[Any, str]:
    """A viser server for this machine, and the address to be opened: only who has it gets an answer.

    Args:
        port: the next free one is taken if it is not.

    Raises:
        MissingExtraError: viser is not installed.
        ParameterError: this version of viser cannot be guarded.
    """
    viser, guard = require("viser"), WebGuard()
    with contextlib.redirect_stdout(io.StringIO()):  # the caller says what is to be opened
        server = guard.start(lambda: viser.ViserServer(host=HOST, port=port, verbose=False))
    server.gui.configure_theme(show_share_button=False)  # it would open the viewer to the internet
    return server, guard.address(server.get_port())


def draw(server: Any, scene: Scene) -> list[Any]:
    """Add the scene to a viser server, seen from its side; returns a node for each shape."""
    server.scene.set_up_direction(tuple(-scene.down))
    nodes = []
    for i, (shape, colour) in enumerate(scene.shapes):
        mesh, flat = shape_mesh(shape), isinstance(shape, Mesh) or shape.kind == "box"
        vertices, faces = mesh.vertices.astype(np.float32), mesh.faces.astype(np.uint32)
        look = {"color": tuple(int(255 * c) for c in colour), "opacity": scene.opacity(i)}
        node = server.scene.add_mesh_simple(f"/shape_{i}", vertices, faces, flat_shading=flat, **look)
        nodes.append(node)
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
