"""What a URDF says a link looks like: its <visual>, meshes included, for pictures alone."""

from __future__ import annotations

import math
import os
import xml.etree.ElementTree as ET
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, cast

import numpy as np

from .._extras import require
from .._files import check_file, figure
from ..description import Shape
from ..description._reading import read_xml
from ..description.shape import Kind, merge_capsules
from ..description.urdf import UrdfModel
from ..typing import Array

_SUFFIXES = (".stl", ".obj", ".ply", ".off", ".dae", ".glb")
_LARGEST_FILE = 64 << 20  # bytes
_MOST = 2000  # visuals of a hand
_SIZES = {"box": "size", "sphere": "radius", "cylinder": "radius length", "capsule": "radius length"}


@dataclass(frozen=True)
class Mesh:
    """A surface in the frame of its link; lengths [m]."""

    vertices: Array
    """Corners of the faces, ``(n, 3)`` [m]."""
    faces: Array
    """``(m, 3)``, indices of vertices."""
    transform: Array
    """Pose in the frame of the link, ``(4, 4)``."""


@dataclass(frozen=True)
class Visuals:
    """What is drawn for each link, and what could not be read."""

    of_link: dict[str, tuple[Shape | Mesh, ...]]
    problems: tuple[str, ...]


def visuals(urdf: UrdfModel) -> Visuals:
    """``<visual>`` of each link, where there is one and all of it can be read; else its ``<collision>``.

    A mesh-only ``<collision>`` without ``<visual>`` is drawn, too. A mesh is looked for next to the URDF, and
    for ``package://name/rest`` in the folders above it as ``name/rest`` and ``rest``. Pictures do without
    what is missing: a problem is listed, not raised.
    """
    drawn: dict[tuple[str, str], tuple[Shape | Mesh, ...]] = {}
    problems: tuple[str, ...] = ()
    if urdf.path.suffix == ".urdf" and urdf.path.exists():  # else a description that outlived its file
        drawn, problems = _read(urdf.path.resolve(), os.stat(urdf.path).st_mtime_ns)
    found: dict[str, tuple[Shape | Mesh, ...]] = {}
    for link in urdf.links:
        looks, touches = (drawn.get((link.name, tag), ()) for tag in ("visual", "collision"))
        found[link.name] = looks or tuple(link.collisions) or touches
    return Visuals(found, problems)


@lru_cache(maxsize=8)
def _read(
    path: Path, changed: int
) -> tuple[dict[tuple[str, str], tuple[Shape | Mesh, ...]], tuple[str, ...]]:
    """(link, tag) -> its parts, none where one of them cannot be read; and why not."""
    root = read_xml(path, "URDF file", "robot")
    drawn, problems, left = {}, [], _MOST
    for link in root.findall("link"):
        name = link.get("name", "")
        for tag in ("visual", "collision"):
            elements = link.findall(tag)
            left -= len(elements)
            if not elements or left < 0:
                continue
            try:
                parts = [_part(path, element) for element in elements]
            except (ValueError, OSError) as error:
                problems.append(f"link '{name}', {tag}: {error}")
                continue
            shapes = merge_capsules(tuple(part for part in parts if isinstance(part, Shape)))
            drawn[name, tag] = (*shapes, *(part for part in parts if isinstance(part, Mesh)))
    return drawn, tuple(problems)


def _part(path: Path, element: ET.Element) -> Shape | Mesh:
    origin, geometry = element.find("origin"), element.find("geometry")
    if geometry is None or not len(geometry):
        raise ValueError("<geometry> is missing")
    pose = np.eye(4)
    if origin is not None:
        rpy = _numbers(origin.get("rpy", "0 0 0"), 3)  # about fixed axes, as the URDF standard has it
        pose[:3, :3] = require("scipy.spatial.transform").Rotation.from_euler("xyz", rpy).as_matrix()
        pose[:3, 3] = _numbers(origin.get("xyz", "0 0 0"), 3)
    shape = geometry[0]
    if shape.tag == "mesh":
        mesh = _load(path, shape.get("filename", ""))
        scale = np.array(_numbers(shape.get("scale", "1 1 1"), 3))
        return Mesh(np.asarray(mesh.vertices, dtype=np.float64) * scale, np.asarray(mesh.faces), pose)
    if shape.tag not in _SIZES:
        raise ValueError(f"<{shape.tag}> is not drawn")
    words = " ".join(shape.get(key, "") for key in _SIZES[shape.tag].split())
    size = _numbers(words, 3 if shape.tag == "box" else len(_SIZES[shape.tag].split()))
    if min(size) <= 0:
        raise ValueError(f"the size of a {shape.tag} must be positive, got '{words}'")
    return Shape(cast(Kind, shape.tag), tuple(size), pose)


def _load(urdf: Path, name: str) -> Any:
    places = [urdf.parent / name.removeprefix("file://")]
    if name.startswith("package://"):
        package, _, inside = name.removeprefix("package://").partition("/")
        parts = (f"{package}/{inside}", inside) if inside else ()
        places = [above / part for above in urdf.parents for part in parts]
    file = next((place for place in places if place.is_file()), None)
    if file is None:
        raise ValueError(f"the mesh '{name}' is not there")
    if file.suffix.lower() not in _SUFFIXES:
        raise ValueError(f"a mesh of kind '{file.suffix}' is not drawn; {', '.join(_SUFFIXES)} are")
    check_file(file, "mesh", _LARGEST_FILE)
    trimesh = require("trimesh")
    try:
        mesh = trimesh.load(str(file), force="mesh", process=False, skip_materials=True)
    except Exception as error:  # whatever a stranger's file makes trimesh raise
        raise ValueError(f"the mesh '{name}' cannot be read: {error or type(error).__name__}") from None
    if not len(mesh.faces) or not np.isfinite(mesh.vertices).all():
        raise ValueError(f"the mesh '{name}' has no faces, or vertices that are not finite")
    return mesh


def _numbers(text: str, n: int) -> list[float]:
    values = [value for value in map(figure, text.split()) if value is not None and math.isfinite(value)]
    if len(values) != n or len(text.split()) != n:
        raise ValueError(f"needs {n} finite numbers, got '{text}'")
    return values
