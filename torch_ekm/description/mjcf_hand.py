"""The hand that an MJCF describes: its tree as a URDF would have it, and its transmission.

Tendons give moment arms or are measured by MuJoCo, tendons and joints under an equality couplings, pinned
points loops, springs of joints and tendons springs, position actuators ranges and stiffnesses. What has no
counterpart is left out or approximated with a note.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from .._extras import require
from ..exceptions import DescriptionError
from ..typing import Array
from ._xml import listed
from .mjcf import compile_mjcf
from .mjcf_tendons import element_name
from .mjcf_transmission import MjcfTransmission
from .shape import Shape
from .urdf import UrdfJoint, UrdfLink, UrdfModel, root_of

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
