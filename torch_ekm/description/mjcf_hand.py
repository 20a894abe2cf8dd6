"""The hand that an MJCF describes: its tree as a URDF would have it, and its transmission.

Fixed tendons give moment arms, tendons and joints under an equality couplings, joint springs springs,
position actuators ranges and stiffnesses. What has no counterpart is refused, or approximated with a note.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from .._extras import require
from ..exceptions import DescriptionError
from ..typing import Array
from .mjcf import compile_mjcf
from .shape import Shape
from .urdf import UrdfJoint, UrdfLink, UrdfModel

_WORLD = "world"
_NARROW = (
    0.2  # a limited tendon is a coupling if it may move by less than this share of what its joints allow
)
_SAME_ARM = 0.1  # relative change of a moment arm up to which it counts as constant
_DRAWN = 200  # postures at which the arms of a spatial tendon are looked at


@dataclass
class MjcfHand:
    """What :func:`read_mjcf` found.

    ``tables`` are those of a transmission file, without pads: nothing in an MJCF says what is meant to touch.
    """

    urdf: UrdfModel
    tables: dict[str, Any]
    notes: list[str] = field(default_factory=list)


def read_mjcf(path: str | Path) -> MjcfHand:
    """Read the hand at ``path``; the tree stands on the world, without what carries it there.

    Raises:
        DescriptionError: as :func:`~torch_ekm.description.mjcf.compile_mjcf`; a joint that slides or is a
            ball, a loop closed by ``connect`` or ``weld``, an equality that is not linear, an actuator
            without a joint or a tendon.
        MissingExtraError: mujoco is not installed.
    """
    path = Path(path)
    model, meshes = compile_mjcf(path)
    return _Conversion(path, model, meshes).hand


class _Conversion:
    def __init__(self, path: Path, model: Any, meshes: set[str]) -> None:
        self.path, self.model, self.meshes = path, model, meshes
        self._mj = require("mujoco")
        self._kind = self._mj.mjtJoint
        self.notes: list[str] = []
        self.hinges: list[int] = []
        self.names: dict[int, str] = {}
        links, joints = self._tree()
        name = model.names[: model.names.index(b"\0")].decode() or path.stem
        self.urdf = UrdfModel(path, name, tuple(links), tuple(joints), _WORLD)
        if not self.hinges:
            raise DescriptionError(path, "there is no hinge joint")
        self.place = {int(model.jnt_dofadr[j]): k for k, j in enumerate(self.hinges)}
        self.lower, self.upper = np.array([self._limits(j) for j in self.hinges]).T
        self.hand = MjcfHand(self.urdf, self._tables(name), self.notes)

    # -- links and joints ---------------------------------------------------------------------------

    def _tree(self) -> tuple[list[UrdfLink], list[UrdfJoint]]:
        model = self.model
        names = {b: model.body(b).name or f"body_{b}" for b in range(1, model.nbody)}
        left_out, links, joints = self._objects(names), [self._link(_WORLD, 0, np.eye(4))], []
        frame = {0: (_WORLD, np.eye(4))}
        """Of each body: its link, and its frame in the link's."""
        for b, name in names.items():
            if b in left_out:
                continue
            parent, offset = frame[int(model.body_parentid[b])]
            at = offset @ _pose(model.body_pos[b], self._rotation(model.body_quat[b]))
            hinges = [j for j in self._joints_of(b) if self._is_hinge(j)]
            for k, j in enumerate(hinges):
                child = name if k == len(hinges) - 1 else f"{name}/{k + 1}"
                joint = model.joint(j).name or f"joint_{j}"
                anchor, axis = _pose(model.jnt_pos[j]), model.jnt_axis[j]
                reference = float(model.qpos0[model.jnt_qposadr[j]])
                back = _pose(np.zeros(3), self._about(axis, -reference))
                joints.append(
                    UrdfJoint(joint, "revolute", parent, child, at @ anchor @ back, axis, *self._limits(j))
                )
                self.hinges.append(j)
                self.names[j] = joint
                parent, at = child, _pose(-model.jnt_pos[j])
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

    def _joints_of(self, body: int) -> range:
        first = int(self.model.body_jntadr[body])
        return range(first, first + int(self.model.body_jntnum[body]))

    def _is_hinge(self, joint: int) -> bool:
        kind = int(self.model.jnt_type[joint])
        if kind == self._kind.mjJNT_FREE:
            body = self.model.body(self.model.jnt_bodyid[joint]).name
            self.notes.append(f"'{body}' floats in the file; here it stands where the file puts it")
            return False
        if kind != self._kind.mjJNT_HINGE:
            sort = "slides" if kind == self._kind.mjJNT_SLIDE else "is a ball joint"
            raise DescriptionError(
                self.path, f"joint '{self.model.joint(joint).name}' {sort}; hands have hinges"
            )
        return True

    def _objects(self, names: dict[int, str]) -> set[int]:
        """Bodies that float and carry no joint, with all that is fixed to them: things, not hands."""
        model, left_out = self.model, set()
        for b, name in names.items():
            kinds = [int(model.jnt_type[j]) for j in self._joints_of(b)]
            tree = {b}
            for c in names:  # parents come first
                if int(model.body_parentid[c]) in tree:
                    tree.add(c)
            moving = sum(len(self._joints_of(c)) for c in tree)
            if int(self._kind.mjJNT_FREE) in kinds and moving == 1:
                left_out |= tree
                self.notes.append(f"'{name}' floats and has no joints: it is left out")
        return left_out

    def _limits(self, joint: int) -> tuple[float, float]:
        if not self.model.jnt_limited[joint]:
            return -np.inf, np.inf
        lower, upper = self.model.jnt_range[joint].tolist()
        return lower, upper

    def _link(self, name: str, body: int, at: Array) -> UrdfLink:
        model = self.model
        inertial = at @ _pose(model.body_ipos[body], self._rotation(model.body_iquat[body]))
        inertia = inertial[:3, :3] @ np.diag(model.body_inertia[body]) @ inertial[:3, :3].T
        geoms = range(model.body_geomadr[body], model.body_geomadr[body] + model.body_geomnum[body])
        shapes = [shape for g in geoms if body and (shape := self._shape(name, g, at)) is not None]
        mass = float(model.body_mass[body])
        return UrdfLink(name, mass, inertial[:3, 3], inertia, tuple(shapes), name in self.meshes)

    def _shape(self, link: str, geom: int, at: Array) -> Shape | None:
        model, kinds = self.model, self._mj.mjtGeom
        kind, (x, y, z) = int(model.geom_type[geom]), (2 * model.geom_size[geom]).tolist()
        place = at @ _pose(model.geom_pos[geom], self._rotation(model.geom_quat[geom]))
        if not (model.geom_contype[geom] or model.geom_conaffinity[geom]):
            return None  # it is only drawn
        if kind == kinds.mjGEOM_BOX:
            return Shape("box", (x, y, z), place)
        if kind == kinds.mjGEOM_SPHERE:
            return Shape("sphere", (x / 2,), place)
        if kind in (kinds.mjGEOM_CAPSULE, kinds.mjGEOM_CYLINDER):
            return Shape("capsule" if kind == kinds.mjGEOM_CAPSULE else "cylinder", (x / 2, y), place)
        self.notes.append(
            f"a shape of '{link}' is neither box, sphere, capsule nor cylinder: it touches nothing"
        )
        return None

    def _rotation(self, quaternion: Array) -> Array:
        matrix = np.zeros(9)
        self._mj.mju_quat2Mat(matrix, quaternion)
        return matrix.reshape(3, 3)

    def _about(self, axis: Array, angle: float) -> Array:
        quaternion = np.zeros(4)
        self._mj.mju_axisAngle2Quat(quaternion, axis, angle)
        return self._rotation(quaternion)

    # -- transmission -------------------------------------------------------------------------------

    def _tables(self, name: str) -> dict[str, Any]:
        actuated: set[int] = set()
        actuators = [self._actuator(k, actuated) for k in range(self.model.nu)]
        if not actuators:
            raise DescriptionError(self.path, "there is no actuator")
        couplings = [*self._equalities(actuated), *self._tendon_couplings(actuated)]
        meshes = sorted(self.meshes & {link.name for link in self.urdf.links})
        if meshes:
            self.notes.append(f"meshes are not read: those of {', '.join(meshes)} touch nothing")
        rests = self._rests(couplings)
        springs = {
            self.names[j]: {
                "spring": float(self.model.jnt_stiffness[j]),
                "rest": float(rests[k]),
                "friction": float(self.model.dof_frictionloss[self.model.jnt_dofadr[j]]),
            }
            for k, j in enumerate(self.hinges)
        }
        tables = [{"name": label, "joints": self._named(row)} for label, row, _ in couplings]
        hand = {"name": name, "base_link": _WORLD, "gravity": self.model.opt.gravity.tolist()}
        return {"hand": hand, "joints": springs, "actuators": actuators, "couplings": tables}

    def _rests(self, couplings: list[tuple[str, Array, float]]) -> Array:
        """Where springs are slack; joints that are coupled, at the nearest angles that obey the couplings."""
        rests = np.array([self.model.qpos_spring[self.model.jnt_qposadr[j]] for j in self.hinges])
        if not couplings:
            return rests
        C, length = np.array([row for _, row, _ in couplings]), np.array([value for *_, value in couplings])
        return rests + np.linalg.pinv(C) @ (length - C @ rests)

    def _actuator(self, k: int, actuated: set[int]) -> dict[str, Any]:
        model, kinds = self.model, self._mj.mjtTrn
        name = model.actuator(k).name or f"actuator_{k}"
        row, offset = self._driven(k, name, actuated)
        length = self._span(row) + offset
        gain, bias = float(model.actuator_gainprm[k, 0]), float(model.actuator_biasprm[k, 1])
        table: dict[str, Any] = {"name": name}
        low, high = model.actuator_forcerange[k] if model.actuator_forcelimited[k] else (-1.0, 1.0)
        pulls_back = high <= 0  # MuJoCo's tendons pull where they shorten; here where `a` grows
        if bias < 0 < gain:
            if model.actuator_ctrllimited[k]:
                length = gain / -bias * model.actuator_ctrlrange[k]
            table["stiffness"] = -bias
        else:
            self.notes.append(
                f"actuator '{name}' has no position control: taken as rigid, over its whole stroke"
            )
        if not np.isfinite(length).all():
            raise DescriptionError(self.path, f"actuator '{name}' has no range, nor have all its joints")
        sign = -1.0 if pulls_back else 1.0
        table["range"] = sorted((sign * length).tolist())
        table["offset"] = sign * offset
        table["moment_arms"] = self._named(sign * row)
        table["tendon"] = bool(pulls_back or low >= 0)
        if int(model.actuator_trntype[k]) == kinds.mjTRN_TENDON and np.abs(row).max() < 0.1:
            self.notes.append(f"'{name}' counts in the length of its tendon, not in rad")
        return table

    def _driven(self, k: int, name: str, actuated: set[int]) -> tuple[Array, float]:
        """Moment arms ``(n_q,)`` and length at zero angles of an actuator."""
        model, kinds = self.model, self._mj.mjtTrn
        gear, target = float(model.actuator_gear[k, 0]), int(model.actuator_trnid[k, 0])
        kind = int(model.actuator_trntype[k])
        if kind == kinds.mjTRN_JOINT or kind == kinds.mjTRN_JOINTINPARENT:
            if target not in self.hinges:
                raise DescriptionError(self.path, f"actuator '{name}' drives a joint that is not of the hand")
            return gear * np.eye(len(self.hinges))[self.hinges.index(target)], 0.0
        if kind == kinds.mjTRN_TENDON:
            actuated.add(target)
            row, offset = self._tendon(target)
            return gear * row, gear * offset
        raise DescriptionError(self.path, f"actuator '{name}' drives neither a joint nor a tendon")

    def _tendon(self, t: int) -> tuple[Array, float]:
        """Moment arms ``(n_q,)`` and length at zero angles: exact for fixed tendons."""
        model = self.model
        parts = range(model.tendon_adr[t], model.tendon_adr[t] + model.tendon_num[t])
        if all(int(model.wrap_type[w]) == self._mj.mjtWrap.mjWRAP_JOINT for w in parts):
            row = np.zeros(len(self.hinges))
            for w in parts:
                joint = int(model.wrap_objid[w])
                if joint not in self.hinges:
                    raise DescriptionError(
                        self.path, f"tendon '{model.tendon(t).name}' has a joint that slides"
                    )
                row[self.hinges.index(joint)] += model.wrap_prm[w]
            return row, 0.0
        return self._spatial(t)

    def _spatial(self, t: int) -> tuple[Array, float]:
        """Moment arms at the springs' rest, and a note that says how far from there they hold."""
        model, data = self.model, self._mj.MjData(self.model)

        def arms(q: Array) -> tuple[Array, float]:
            for angle, j in zip(q, self.hinges, strict=True):
                data.qpos[model.jnt_qposadr[j]] = angle
            self._mj.mj_forward(model, data)
            row = np.zeros(len(self.hinges))
            first = int(model.ten_J_rowadr[t])
            for i in range(first, first + int(model.ten_J_rownnz[t])):
                row[self.place[int(model.ten_J_colind[i])]] += data.ten_J[i]
            return row, float(data.ten_length[t])

        rest = np.array([model.qpos_spring[model.jnt_qposadr[j]] for j in self.hinges])
        row, length = arms(rest)
        low, high = np.maximum(self.lower, rest - np.pi), np.minimum(self.upper, rest + np.pi)
        draw, holds = np.random.default_rng(0), np.inf
        for _ in range(_DRAWN):
            q = draw.uniform(low, high)
            if np.abs(arms(q)[0] - row).max() > _SAME_ARM * np.abs(row).max():
                holds = min(holds, float(np.abs(q - rest)[row != 0].max(initial=0.0)))
        where = "everywhere" if np.isinf(holds) else f"within {np.degrees(holds):.0f} deg of there"
        name = model.tendon(t).name
        self.notes.append(f"tendon '{name}' has the moment arms of the rest posture, right to 10 % {where}")
        return row, length - float(row @ rest)

    def _equalities(self, actuated: set[int]) -> Iterator[tuple[str, Array, float]]:
        """``C q = c``, one row for each equality."""
        model, kinds = self.model, self._mj.mjtEq
        for e in range(model.neq):
            kind, name = int(model.eq_type[e]), model.equality(e).name or f"equality_{e}"
            if kind != kinds.mjEQ_JOINT and kind != kinds.mjEQ_TENDON:
                raise DescriptionError(
                    self.path, f"equality '{name}' closes a loop: only joints and tendons are tied"
                )
            if np.any(model.eq_data[e, 2:5]):
                raise DescriptionError(self.path, f"equality '{name}' is not linear: couplings are")
            first, second = int(model.eq_obj1id[e]), int(model.eq_obj2id[e])
            constant, slope = model.eq_data[e, :2].tolist()
            row, value = self._tied(kind, first, actuated)
            value += constant
            if second >= 0:
                other, there = self._tied(kind, second, actuated)
                row, value = row - slope * other, value - slope * there
            yield name, row, value

    def _tied(self, kind: int, which: int, actuated: set[int]) -> tuple[Array, float]:
        """The row of a joint or tendon under an equality, and its value where MuJoCo counts from."""
        model = self.model
        if kind == self._mj.mjtEq.mjEQ_JOINT:
            if which not in self.hinges:
                raise DescriptionError(self.path, f"joint '{model.joint(which).name}' is tied and slides")
            row = np.eye(len(self.hinges))[self.hinges.index(which)]
            return row, float(model.qpos0[model.jnt_qposadr[which]])
        actuated.add(which)
        row, offset = self._tendon(which)
        return row, float(model.tendon_length0[which]) - offset

    def _tendon_couplings(self, used: set[int]) -> Iterator[tuple[str, Array, float]]:
        """Tendons that nobody pulls: stiff ones and those that can hardly move tie their joints."""
        model, left_out = self.model, []
        for t in range(model.ntendon):
            if t in used:
                continue
            name = model.tendon(t).name or f"tendon_{t}"
            row, offset = self._tendon(t)
            shortest, longest = self._span(row)
            low, high = model.tendon_range[t].tolist()
            spring = model.tendon_lengthspring[t]
            if model.tendon_stiffness[t] > 0 and spring[0] == spring[1]:
                self.notes.append(f"the spring of tendon '{name}' ties its joints rigidly")
                yield name, row, float(spring[0]) - offset
            elif (
                model.tendon_limited[t]
                and high - low < _NARROW * (longest - shortest)
                and (row != 0).sum() > 1
            ):
                self.notes.append(
                    f"tendon '{name}' ties its joints, without the {high - low:.3g} that it may move"
                )
                yield name, row, (low + high) / 2 - offset
            elif model.tendon_limited[t] or model.tendon_stiffness[t] > 0:
                left_out.append(name)

        if left_out:
            self.notes.append(f"tendons that only limit or spring are left out: {', '.join(left_out)}")

    def _span(self, row: Array) -> Array:
        """Least and largest ``row q`` within the joints' limits ``(2,)``."""
        ends = np.array([row * self.lower, row * self.upper])[:, row != 0]
        return np.array([ends.min(axis=0).sum(), ends.max(axis=0).sum()])

    def _named(self, row: Array) -> dict[str, float]:
        return {self.names[j]: float(row[k]) for k, j in enumerate(self.hinges) if row[k] != 0}


def _pose(position: Array, rotation: Array | None = None) -> Array:
    matrix = np.eye(4)
    matrix[:3, 3] = position
    if rotation is not None:
        matrix[:3, :3] = rotation
    return matrix
