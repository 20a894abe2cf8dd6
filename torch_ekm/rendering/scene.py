"""The hand and its object, to look at: a still picture and a stand-alone animation.

Both are drawn from the collision shapes of the descriptions, so that what one sees is what touches.
"""

from __future__ import annotations

import contextlib
import io
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from .._extras import require
from ..description import HandDescription, ObjectDescription, Shape
from ..kinematics import HandKinematics

Array = NDArray[np.float64]
_PALM, _PHALANX, _TIP, _OBJECT = (0.45, 0.47, 0.50), (0.72, 0.74, 0.77), (0.00, 0.45, 0.70), (0.90, 0.62, 0.0)


@dataclass(frozen=True)
class Scene:
    """Poses of everything that is drawn, in the hand frame; ``frames`` along the first axis."""

    shapes: list[tuple[Shape, tuple[float, float, float]]]
    transforms: Array
    """``(n_frames, n_shapes, 4, 4)``"""
    down: Array
    """Direction of gravity in the hand frame: down in the picture."""


def make_scene(
    hand: HandDescription,
    obj: ObjectDescription | None,
    q: Array,
    position: Array | None,
    rotation: Array | None,
    gravity: Array,
) -> Scene:
    """Place the shapes of the hand, and of the object if there is one, for each frame.

    Args:
        q: ``(n_frames, n_q)`` [rad].
        position: ``(n_frames, 3)`` [m].
        rotation: ``(n_frames, 3, 3)``.
        gravity: ``(3,)`` [m/s^2], hand frame.
    """
    kinematics = HandKinematics(hand)
    links = kinematics(torch.as_tensor(q, dtype=torch.float64))
    pads = {pad.link for pad in hand.pads}
    shapes: list[tuple[Shape, tuple[float, float, float]]] = []
    transforms: list[Array] = []
    for link in hand.urdf.links:
        colour = _TIP if link.name in pads else _PALM if link.name == hand.base_link else _PHALANX
        pose = links.of(link.name).numpy()
        for shape in link.collisions:
            shapes.append((shape, colour))
            transforms.append(pose @ shape.transform)
    pose = np.broadcast_to(np.eye(4), (len(q), 4, 4)).copy()
    if obj is not None:
        pose[:, :3, :3], pose[:, :3, 3] = rotation, position
    for shape in obj.shapes if obj is not None else ():
        shapes.append((shape, _OBJECT))
        transforms.append(pose @ shape.transform)
    return Scene(shapes, np.stack(transforms, axis=1), gravity / np.linalg.norm(gravity))


def shape_mesh(shape: Shape) -> Any:
    """The shape as a ``trimesh.Trimesh`` in its own frame."""
    trimesh = require("trimesh")
    if shape.kind == "box":
        return trimesh.creation.box(shape.size)
    if shape.kind == "sphere":
        return trimesh.creation.icosphere(subdivisions=3, radius=shape.size[0])
    if shape.kind == "cylinder":
        return trimesh.creation.cylinder(shape.size[0], shape.size[1], sections=48)
    mesh = trimesh.creation.capsule(shape.size[1], shape.size[0], count=[24, 24])
    mesh.apply_translation(-mesh.bounds.mean(axis=0))  # centred, whatever the library's convention
    return mesh


def save_picture(scene: Scene, path: Path, frames: Sequence[int] = (-1,), size: int = 640) -> Path:
    """Draw some frames side by side with PyVista.

    An OpenGL that is broken or missing can abort the whole process, so the drawing runs in a process of
    its own; if that fails, matplotlib draws a plainer picture.
    """
    arrays = path.with_suffix(".npz")
    np.savez(arrays, transforms=scene.transforms[list(frames)], down=scene.down)
    meshes = [shape_mesh(shape) for shape, _ in scene.shapes]
    code = "import sys; from torch_ekm.rendering.scene import _draw_saved; _draw_saved(*sys.argv[1:])"
    shapes = arrays.with_name(arrays.stem + "_shapes.npz")
    _save_meshes(shapes, meshes, [colour for _, colour in scene.shapes])
    try:
        command = [sys.executable, "-c", code, str(arrays), str(shapes), str(path), str(size)]
        done = subprocess.run(command, capture_output=True, timeout=120, check=False)
        if done.returncode != 0 or not path.exists():
            _draw_matplotlib(meshes, scene, list(frames), path, size)
    except subprocess.TimeoutExpired:
        _draw_matplotlib(meshes, scene, list(frames), path, size)
    finally:
        arrays.unlink(missing_ok=True)
        shapes.unlink(missing_ok=True)
    return path


def _camera(scene_down: Array, points: Array) -> tuple[Array, Array, Array]:
    """Position, focus and up: from the thumb's side, so that the pinch is seen from the side."""
    focus = points.mean(axis=0)
    up = -scene_down
    side = np.array([0.35, -1.0, 0.45])  # radial side (index finger), a little from the front and palm
    side -= 0.5 * (side @ up) * up
    return focus + 0.34 * side / np.linalg.norm(side), focus, up


def _save_meshes(path: Path, meshes: list[Any], colours: list[tuple[float, float, float]]) -> None:
    arrays: dict[str, Array] = {"colours": np.array(colours)}
    for i, mesh in enumerate(meshes):
        arrays[f"v{i}"], arrays[f"f{i}"] = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    np.savez(path, **arrays)  # type: ignore[arg-type]


def _draw_saved(arrays: str, shapes: str, path: str, size: str) -> None:
    """In a process of its own: draw with PyVista."""
    pyvista = require("pyvista")
    data, solid = np.load(arrays), np.load(shapes)
    n, width = len(data["transforms"]), int(size)
    plotter = pyvista.Plotter(
        off_screen=True, shape=(1, n), border=False, window_size=(width * n, width * 3 // 4)
    )
    for k in range(n):
        plotter.subplot(0, k)
        plotter.set_background("white")
        for i, colour in enumerate(solid["colours"]):
            faces = solid[f"f{i}"]
            mesh = pyvista.PolyData(solid[f"v{i}"], np.c_[np.full(len(faces), 3), faces].ravel())
            mesh = mesh.transform(data["transforms"][k, i], inplace=False)
            plotter.add_mesh(
                mesh,
                color=colour,
                smooth_shading=True,
                split_sharp_edges=True,
                specular=0.3,
                specular_power=15,
            )
        focus_points = data["transforms"][:, :, :3, 3].reshape(-1, 3)
        position, focus, up = _camera(data["down"], focus_points)
        plotter.camera_position = [tuple(position), tuple(focus), tuple(up)]
        plotter.enable_anti_aliasing("ssaa")
    plotter.screenshot(path)


def _draw_matplotlib(meshes: list[Any], scene: Scene, frames: list[int], path: Path, size: int) -> None:
    collection = require("mpl_toolkits.mplot3d.art3d").Poly3DCollection
    figure = require("matplotlib.figure").Figure(figsize=(size / 100 * len(frames), size / 100))
    up = -scene.down  # matplotlib's z is up in the picture: turn everything there
    forward = np.array([1.0, 0.0, 0.0]) - up[0] * up
    forward /= np.linalg.norm(forward)
    turn = np.stack([forward, np.cross(up, forward), up])
    centre = turn @ scene.transforms[:, :, :3, 3].reshape(-1, 3).mean(axis=0)
    for k, frame in enumerate(frames):
        axis = figure.add_subplot(1, len(frames), k + 1, projection="3d")
        for i, (mesh, (_, colour)) in enumerate(zip(meshes, scene.shapes, strict=True)):
            T = scene.transforms[frame, i]
            vertices = (mesh.vertices @ T[:3, :3].T + T[:3, 3]) @ turn.T
            axis.add_collection3d(collection(vertices[mesh.faces], facecolors=colour, shade=True))
        for name, middle in zip("xyz", centre, strict=True):
            getattr(axis, f"set_{name}lim")(middle - 0.06, middle + 0.06)
        axis.set_axis_off()
        axis.set_box_aspect((1, 1, 1), zoom=1.4)
        axis.view_init(elev=15, azim=70)
    figure.savefig(path, dpi=100)


def save_animation(scene: Scene, path: Path, frame_seconds: float = 0.25) -> Path:
    """Write the frames as one stand-alone HTML page that can be turned and zoomed (viser)."""
    server = start_server("127.0.0.1", 0)
    try:
        serializer = server.get_scene_serializer()
        nodes = draw(server, scene)
        for frame in scene.transforms:
            place(server, nodes, frame)
            serializer.insert_sleep(frame_seconds)
        path.write_text(serializer.as_html(), encoding="utf-8")
    finally:
        with contextlib.redirect_stdout(io.StringIO()):
            server.stop()
    return path


def start_server(host: str, port: int) -> Any:
    """A viser server that keeps quiet: what address is to be opened, if any, is the caller's to say.

    Raises:
        MissingExtraError: viser is not installed.
    """
    viser = require("viser")
    with contextlib.redirect_stdout(io.StringIO()):
        return viser.ViserServer(host=host, port=port, verbose=False)


def draw(server: Any, scene: Scene) -> list[Any]:
    """Add the scene to a viser server, seen from the thumb's side; returns a node for each shape."""
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
            )
        )
    position, focus, up = _camera(scene.down, scene.transforms[:, :, :3, 3].reshape(-1, 3))
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
