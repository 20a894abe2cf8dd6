"""A hand's MJCF: its files and elements, compiled by MuJoCo, as links and joints."""

from __future__ import annotations

import os
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from .._extras import require
from .._files import figure
from ..exceptions import DescriptionError
from ..typing import Array
from ._reading import listed, read_xml
from .mjcf_transmission import MjcfTransmission, element_name
from .shape import Shape
from .urdf import UrdfJoint, UrdfLink, UrdfModel, root_of

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


_WORLD = "world"
_LIGHT = 2e-6  # [kg]: MuJoCo's bound, not a body's


@dataclass
class MjcfHand:
    """What :func:`read_mjcf` found.

    ``tables`` are those of a transmission file, without pads: nothing in an MJCF says what is meant to touch.
    """

    urdf: UrdfModel
    tables: dict[str, Any]
    model: Any
    """MuJoCo's, which measures tendons on their ways."""
    hinges: tuple[int, ...]
    """Its joints in the order of q."""


def read_mjcf(path: str | Path, base_link: str | None = None, named: Iterable[str] = ()) -> MjcfHand:
    """Read the hand at ``path``: what ``base_link`` carries, or all that stands on the world.

    Joints that slide or are balls are held and things that nothing drives are left out, with notes.
    ``named``: as of :meth:`~torch_ekm.description.urdf.UrdfModel.below`.

    Raises:
        DescriptionError: as :func:`~torch_ekm.description.mjcf.compile_mjcf`; no hinge, no such link, a loop
            closed by ``weld``, an equality of tendons that is not linear.
        MissingExtraError: mujoco is not installed.
    """
    path = Path(path)
    return _Conversion(path, base_link or _WORLD, named, *compile_mjcf(path)).hand


class _Conversion:
    def __init__(
        self, path: Path, base: str, named: Iterable[str], model: Any, meshes: set[str], notes: list[str]
    ) -> None:
        self.model, self.meshes = model, meshes
        self._mj = require("mujoco")
        self._kind = self._mj.mjtJoint
        self.hinges: list[int] = []
        self.names: dict[int, str] = {}
        self.held: list[tuple[str, str]] = []
        """Joints that are no hinges, and their links."""
        self.frames: dict[int, tuple[str, Array]] = {0: (_WORLD, np.eye(4))}
        """Of each body: its link, and its frame in the link's."""
        self.of: dict[str, list[str]] = {}
        """Notes on several things, and their names."""
        links, joints = self._tree()
        name = model.names[: model.names.index(b"\0")].decode() or path.stem
        robot = UrdfModel(path, name, tuple(links), tuple(joints), root_of(path, links, joints))
        urdf = robot.below(base, named)
        self.whole = urdf is robot
        self.notes = [*notes, *urdf.notes]
        self.of = self.of if self.whole else {}
        inside = {joint.child: joint.name for joint in urdf.joints}
        self.hinges = [j for j in self.hinges if self.names[j] in inside.values()]
        if held := [joint for joint, link in self.held if link in inside]:
            self.notes.append(listed("hands have hinges; joints of other kinds are held", held))
        if not self.hinges:
            raise DescriptionError(path, "; ".join(["there is no hinge joint", *self.notes]))
        names = {j: self.names[j] for j in self.hinges}
        carried = {link for _, link in self.held}
        reader = MjcfTransmission(urdf, model, names, self.frames, carried, self.whole, self._note)
        tables = reader.tables()
        gravity = robot.pose(base)[:3, :3].T @ model.opt.gravity
        hand = {"name": name, "base_link": base, "gravity": (gravity + 0.0).tolist()}
        self._note_meshes(urdf)
        notes = [*self.notes, *(listed(note, names) for note, names in self.of.items())]
        urdf = replace(urdf, notes=tuple(notes))
        self.hand = MjcfHand(urdf, {"hand": hand, **tables}, model, tuple(self.hinges))

    def _note(self, note: str, name: str) -> None:
        self.of.setdefault(note, []).append(name)

    def _note_meshes(self, urdf: UrdfModel) -> None:
        for link in urdf.links:
            if link.name in self.meshes:
                self._note("links whose meshes are not read, and touch nothing", link.name)
                if link.mass < _LIGHT:
                    self._note("without their meshes these have no mass, and 1 mg here", link.name)

    # -- links and joints ---------------------------------------------------------------------------

    def _tree(self) -> tuple[list[UrdfLink], list[UrdfJoint]]:
        model = self.model
        names = {b: element_name(model, "body", b) for b in range(1, model.nbody)}
        left_out, links, joints = self._things(names), [self._link(_WORLD, 0, np.eye(4))], []
        for b in sorted(left_out & set(model.body_rootid.tolist())):
            self._note("these move and nothing drives them: they are left out", names[b])
        frame = self.frames
        for b, name in names.items():
            if b in left_out:
                continue
            parent, offset = frame[int(model.body_parentid[b])]
            at = offset @ self._pose(model.body_pos[b], model.body_quat[b])
            own = np.flatnonzero(model.jnt_bodyid == b).tolist()
            hinges = [j for j in own if model.jnt_type[j] == int(self._kind.mjJNT_HINGE)]
            self.held += [(model.joint(j).name or name, name) for j in own if j not in hinges]
            for k, j in enumerate(hinges):
                child = name if k == len(hinges) - 1 else f"{name}/{k + 1}"
                joint = element_name(model, "joint", j)
                anchor, axis, back = self._pose(model.jnt_pos[j]), model.jnt_axis[j], np.zeros(4)
                self._mj.mju_axisAngle2Quat(back, axis, -model.qpos0[model.jnt_qposadr[j]])
                placed = at @ anchor @ self._pose(np.zeros(3), back)
                limits = model.jnt_range[j].tolist() if model.jnt_limited[j] else (-np.inf, np.inf)
                joints.append(UrdfJoint(joint, "revolute", parent, child, placed, axis, *limits))
                self.hinges.append(j)
                self.names[j] = joint
                parent, at = child, self._pose(-model.jnt_pos[j])
                if child != name:
                    links.append(UrdfLink(child, 0.0, np.zeros(3), np.zeros((3, 3)), ()))
            if not hinges:
                joints.append(
                    UrdfJoint(f"{name}/fixed", "fixed", parent, name, at, np.array([1.0, 0.0, 0.0]), 0.0, 0.0)
                )
                at = np.eye(4)
            links.append(self._link(name, b, at))
            frame[b] = (name, at)
        return links, joints

    def _things(self, bodies: Iterable[int]) -> set[int]:
        """Bodies that move on the world and that nothing drives, with all that they carry.

        Where there is neither actuator nor tendon nor equality: those that float and carry no joint.
        """
        model, kinds = self.model, {}
        for kind, body in zip(model.jnt_type.tolist(), model.jnt_bodyid.tolist(), strict=True):
            kinds.setdefault(int(model.body_rootid[body]), []).append(kind)
        data = self._mj.MjData(model)
        self._mj.mj_forward(model, data)
        dofs = {*data.moment_colind.tolist(), *model.ten_J_colind.tolist()}
        for kind, *ends in zip(model.eq_type, model.eq_obj1id, model.eq_obj2id, strict=True):
            dofs |= {int(model.jnt_dofadr[j]) for j in ends if kind == self._mj.mjtEq.mjEQ_JOINT and j >= 0}
        driven = {int(model.body_rootid[model.dof_bodyid[dof]]) for dof in dofs}
        floats = [int(self._kind.mjJNT_FREE)]
        found = {root for root, on_it in kinds.items() if (root not in driven if driven else on_it == floats)}
        return {body for body in bodies if int(model.body_rootid[body]) in found}

    def _link(self, name: str, body: int, at: Array) -> UrdfLink:
        model = self.model
        inertial = at @ self._pose(model.body_ipos[body], model.body_iquat[body])
        inertia = inertial[:3, :3] @ np.diag(model.body_inertia[body]) @ inertial[:3, :3].T
        geoms = range(model.body_geomadr[body], model.body_geomadr[body] + model.body_geomnum[body])
        shapes = [shape for g in geoms if body and (shape := self._shape(name, g, at)) is not None]
        if at[:3, 3].any():
            self._note("pads of these links count from the joint, which is not where the body begins", name)
        mass, origin = float(model.body_mass[body]), tuple(at[:3, 3].tolist())
        return UrdfLink(name, mass, inertial[:3, 3], inertia, tuple(shapes), name in self.meshes, origin)

    def _shape(self, link: str, geom: int, at: Array) -> Shape | None:
        model, kinds = self.model, self._mj.mjtGeom
        kind, (x, y, z) = int(model.geom_type[geom]), (2 * model.geom_size[geom]).tolist()
        place = at @ self._pose(model.geom_pos[geom], model.geom_quat[geom])
        if not (model.geom_contype[geom] or model.geom_conaffinity[geom]):
            return None  # it is only drawn
        if kind == kinds.mjGEOM_BOX:
            return Shape("box", (x, y, z), place)
        if kind == kinds.mjGEOM_SPHERE:
            return Shape("sphere", (x / 2,), place)
        if kind in (kinds.mjGEOM_CAPSULE, kinds.mjGEOM_CYLINDER):
            return Shape("capsule" if kind == kinds.mjGEOM_CAPSULE else "cylinder", (x / 2, y), place)
        self._note("shapes other than box, sphere, capsule and cylinder touch nothing, those of", link)
        return None

    def _pose(self, position: Array, quaternion: Sequence[float] | Array = (1.0, 0.0, 0.0, 0.0)) -> Array:
        matrix, rotation = np.eye(4), np.zeros(9)
        self._mj.mju_quat2Mat(rotation, np.array(quaternion))
        matrix[:3, :3], matrix[:3, 3] = rotation.reshape(3, 3), position
        return matrix
