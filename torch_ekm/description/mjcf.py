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
from .._text import figure
from ..exceptions import DescriptionError
from ._xml import listed, read_xml

_MOST_ELEMENTS = 20_000  # of all files together
_MOST_FILES = 50
_READ = ("compiler", "option", "default", "worldbody", "tendon", "equality", "actuator")
_NOT_READ = {  # of elements that are
    "camera", "light", "plugin", "flag", "material", "texture", "hfield", "skin", "flexcomp", "numeric",
}  # fmt: skip
_BUILDS = {"attach", "composite"}  # bodies that do not stand in the file
_BOUNDS = {"boundmass": "1e-6", "boundinertia": "1e-12", "balanceinertia": "true"}  # least, kg and kg m^2
_ATTRIBUTES = ("material", "user")  # that are not read, ...
_SETTINGS = {  # ... and of elements that only set something, all that is
    "option": {"gravity"},
    "default": {"class"},
    "compiler": {"angle", "autolimits", "eulerseq", "inertiafromgeom", "inertiagrouprange"} | _BOUNDS.keys(),
}


def compile_mjcf(path: Path) -> tuple[Any, set[str], list[str]]:
    """MuJoCo's model, the names of the bodies that have meshes, and notes.

    A body without a mass of its own gets 1 mg: it may have stood in a mesh.

    Raises:
        DescriptionError: a file is missing, too large, malformed or includes itself, or MuJoCo refuses what
            it says.
        MissingExtraError: mujoco is not installed.
    """
    reader = _Reader(path)
    root = reader.root
    strict = ET.Element("mujoco", model=root.get("model", path.stem))
    ET.SubElement(strict, "compiler", _BOUNDS)
    for element in root:
        if element.tag in _READ:
            strict.append(element)
    notes = [listed("files outside the folder are not read", reader.left_out)] if reader.left_out else []
    if _made(strict) > _MOST_ELEMENTS:
        raise DescriptionError(path, f"replicas make more than {_MOST_ELEMENTS} elements")
    plugins = [one for actuators in strict.iter("actuator") for one in actuators.findall("plugin")]
    if plugins:
        named = [one.get("name", one.get("plugin", "")) for one in plugins]
        notes.append(listed("actuators of plugins are left out", named))
    total = "-1"
    for element in strict.iter():
        total = element.get("settotalmass", total)
        _strip(path, element)
    mujoco = require("mujoco")
    kinds = mujoco.mjtGeom.mjGEOM_MESH, mujoco.mjtGeom.mjGEOM_HFIELD, mujoco.mjtGeom.mjGEOM_SDF
    try:
        spec = mujoco.MjSpec.from_string(ET.tostring(strict, encoding="unicode"))
        drawn = [geom for geom in spec.geoms if geom.meshname or geom.type in kinds]
        meshes = {geom.parent.name for geom in drawn}
        for geom in drawn:  # no mesh is read
            spec.delete(geom)
        model = spec.compile()
        if float(total) > 0:  # MuJoCo complains of the attribute
            mujoco.mj_setTotalmass(model, float(total))
        return model, meshes, notes
    except RecursionError:
        raise DescriptionError(path, "elements are nested too deep") from None
    except (ValueError, RuntimeError) as error:
        raise DescriptionError(path, f"MuJoCo: {' '.join(str(error).split())}") from None


def _made(element: ET.Element) -> float:
    """How many elements there are once all replicas are made."""
    count = figure(element.get("count", "1")) if element.tag == "replicate" else 1
    return max(1.0, count or 1.0) * (1 + sum(map(_made, element)))


def mjcf_files(path: Path) -> list[Path]:
    """The file and all that it includes, in the order in which they are read.

    Raises:
        DescriptionError: as :func:`compile_mjcf`, of the files alone.
    """
    return _Reader(path).files


def _real(path: Path) -> Path:
    return Path(os.path.realpath(path))  # as resolve(), which raises where links lead in a circle


class _Reader:
    """Files of one folder, each in the place of its ``<include>``."""

    def __init__(self, path: Path) -> None:
        self.folder = _real(path).parent
        self.elements = 0
        self.files: list[Path] = []
        self.left_out: list[str] = []
        try:
            self.root = self._read(path, ())
        except RecursionError:
            raise DescriptionError(path, "elements are nested too deep") from None

    def _read(self, path: Path, above: tuple[Path, ...]) -> ET.Element:
        real = _real(path)
        if not real.is_relative_to(self.folder):  # a file may be a stranger's
            self.left_out.append(os.path.relpath(path, self.folder))
            return ET.Element("mujocoinclude")
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
            element[place : place + 1] = list(self._read(self.folder / file, above))


def _strip(path: Path, element: ET.Element) -> None:
    """Take out what is not read."""
    settings = _SETTINGS.get(element.tag, set(element.attrib).difference(_ATTRIBUTES))
    for name in set(element.attrib) - settings:
        del element.attrib[name]
    for child in list(element):
        if child.tag in _BUILDS:
            raise DescriptionError(path, f"<{child.tag}> is not supported: write out what it makes")
        if child.tag in _NOT_READ:
            element.remove(child)
        elif "file" in child.attrib:
            raise DescriptionError(path, f"<{child.tag} file=...>: only <include> may name a file")
