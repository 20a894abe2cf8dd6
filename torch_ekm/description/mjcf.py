"""Read an MJCF through MuJoCo: what stands in the file and in those that it includes, and nothing else.

Only what a hand needs is handed over: bodies, joints, primitive shapes, tendons, equalities, actuators.
Meshes and textures are never opened, and no file outside the folder of the first one is.
"""

from __future__ import annotations

import os
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

from .._extras import require
from ..exceptions import DescriptionError
from ._xml import read_xml

_MOST_ELEMENTS = 20_000  # of all files together
_MOST_FILES = 50
_READ = ("compiler", "option", "default", "worldbody", "tendon", "equality", "actuator")
_NOT_READ = {  # of elements that are
    "camera", "light", "plugin", "flag", "material", "texture", "hfield", "skin", "flexcomp", "numeric",
}  # fmt: skip
_BUILDS = {"attach", "composite", "replicate"}  # bodies that do not stand in the file
_ATTRIBUTES = {"compiler": ("meshdir", "texturedir", "assetdir", "coordinate"), "": ("material", "user")}


def compile_mjcf(path: Path) -> tuple[Any, set[str]]:
    """MuJoCo's model, and the names of the bodies that have meshes.

    A body without a mass of its own gets 1 mg: it may have stood in a mesh.

    Raises:
        DescriptionError: a file is missing, too large, malformed, outside the folder or includes itself, or
            MuJoCo refuses what it says.
        MissingExtraError: mujoco is not installed.
    """
    root = _read(path)[0]
    strict = ET.Element("mujoco", model=root.get("model", path.stem))
    ET.SubElement(strict, "compiler", boundmass="1e-6", boundinertia="1e-12", balanceinertia="true")
    for element in root:
        if element.tag in _READ:
            strict.append(element)
    meshes: set[str] = set()
    for element in strict.iter():
        _strip(path, element, meshes)
    mujoco = require("mujoco")
    try:
        return mujoco.MjModel.from_xml_string(ET.tostring(strict, encoding="unicode")), meshes
    except RecursionError:
        raise DescriptionError(path, "elements are nested too deep") from None
    except (ValueError, RuntimeError) as error:
        raise DescriptionError(path, f"MuJoCo: {' '.join(str(error).split())}") from None


def mjcf_files(path: Path) -> list[Path]:
    """The file and all that it includes, in the order in which they are read.

    Raises:
        DescriptionError: as :func:`compile_mjcf`, of the files alone.
    """
    return _read(path)[1]


def _read(path: Path) -> tuple[ET.Element, list[Path]]:
    """The root element, includes in their places, and the files that were read."""
    reader = _Reader(path)
    try:
        return reader.read(path, ()), reader.files
    except RecursionError:
        raise DescriptionError(path, "elements are nested too deep") from None


def _real(path: Path) -> Path:
    return Path(os.path.realpath(path))  # as resolve(), which raises where links lead in a circle


class _Reader:
    """Files of one folder, each in the place of its ``<include>``."""

    def __init__(self, path: Path) -> None:
        self.folder = _real(path).parent
        self.elements = 0
        self.files: list[Path] = []

    def read(self, path: Path, above: tuple[Path, ...]) -> ET.Element:
        real = _real(path)
        if not real.is_relative_to(self.folder):
            raise DescriptionError(above[-1], f"<include> of '{path}', which is outside {self.folder}")
        if real in above:
            raise DescriptionError(above[-1], f"<include> of '{path.name}', which includes this file")
        self.files.append(path)
        root = read_xml(path, "MJCF file", "mujoco", "mujocoinclude")
        self.elements += sum(1 for _ in root.iter())
        if self.elements > _MOST_ELEMENTS or len(self.files) > _MOST_FILES:
            most = f"at most {_MOST_ELEMENTS} elements and {_MOST_FILES} files are read"
            raise DescriptionError(path, f"{most}, includes among them")
        self._expand(path, root, (*above, real))
        return root

    def _expand(self, path: Path, element: ET.Element, above: tuple[Path, ...]) -> None:
        for child in list(element):
            if child.tag != "include":
                self._expand(path, child, above)
                continue
            file = child.get("file")
            if not file:
                raise DescriptionError(path, "an <include> has no file")
            place = list(element).index(child)
            element[place : place + 1] = list(self.read(self.folder / file, above))


def _strip(path: Path, element: ET.Element, meshes: set[str]) -> None:
    """Take out what is not read."""
    for name in (*_ATTRIBUTES.get(element.tag, ()), *_ATTRIBUTES[""]):
        element.attrib.pop(name, None)
    for child in list(element):
        if child.tag in _BUILDS:
            raise DescriptionError(path, f"<{child.tag}> is not supported: write out what it makes")
        mesh = child.tag == "geom" and (child.get("mesh") or child.get("type") in ("mesh", "hfield", "sdf"))
        if mesh and element.tag == "body":
            meshes.add(element.get("name", ""))
        if child.tag in _NOT_READ or (mesh and element.tag != "default"):
            element.remove(child)
        elif "file" in child.attrib:
            raise DescriptionError(path, f"<{child.tag} file=...>: only <include> may name a file")
