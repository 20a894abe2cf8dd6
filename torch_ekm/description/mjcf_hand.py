"""The hand that an MJCF describes: its tree as a URDF would have it, and its transmission.

Fixed tendons give moment arms, tendons and joints under an equality couplings, joint springs springs,
position actuators ranges and stiffnesses. What has no counterpart is left out or approximated with a note.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from .._extras import require
from ..exceptions import DescriptionError
from ..typing import Array
from ._toml import TODO
from ._xml import listed
from .branch import hand_below
from .mimic import unheld_joints
from .mjcf import compile_mjcf
from .mjcf_things import things
from .shape import Shape
from .urdf import UrdfJoint, UrdfLink, UrdfModel

_WORLD = "world"
_NARROW = (
    0.2  # a limited tendon is a coupling if it may move by less than this share of what its joints allow
)
_LIGHT = 2e-6  # [kg]: MuJoCo's bound, not a body's
_SAME_ARM = 0.1  # relative change of a moment arm up to which it counts as constant
_DRAWN = 200  # postures at which the arms of a spatial tendon are looked at


@dataclass
class MjcfHand:
    """What :func:`read_mjcf` found.

    ``tables`` are those of a transmission file, without pads: nothing in an MJCF says what is meant to touch.
    """

    urdf: UrdfModel
    tables: dict[str, Any]
    loose: list[str]
    """Joints that nothing holds."""


def read_mjcf(path: str | Path, base_link: str | None = None, named: Iterable[str] = ()) -> MjcfHand:
    """Read the hand at ``path``: what ``base_link`` carries, or all that stands on the world.

    Joints that slide or are balls are held and things that nothing drives are left out, with notes.
    ``named``: as of :func:`~torch_ekm.description.branch.hand_below`.

    Raises:
        DescriptionError: as :func:`~torch_ekm.description.mjcf.compile_mjcf`; no hinge, no such link, a loop
            closed by ``connect`` or ``weld``, an equality that is not linear.
        MissingExtraError: mujoco is not installed.
    """
    path = Path(path)
    return _Conversion(path, base_link or _WORLD, named, *compile_mjcf(path)).hand


class _Conversion:
    def __init__(
        self, path: Path, base: str, named: Iterable[str], model: Any, meshes: set[str], notes: list[str]
    ) -> None:
        self.path, self.model, self.meshes, self.base = path, model, meshes, base
        self._mj = require("mujoco")
        self._kind = self._mj.mjtJoint
        self.hinges: list[int] = []
        self.names: dict[int, str] = {}
        self.held: list[tuple[str, str]] = []
        """Joints that are no hinges, and their links."""
        self.of: dict[str, list[str]] = {}
        """Notes on several things, and their names."""
        links, joints = self._tree()
        name = model.names[: model.names.index(b"\0")].decode() or path.stem
        robot = UrdfModel(path, name, tuple(links), tuple(joints), _WORLD)
        urdf = hand_below(robot, base, named)
        self.whole = urdf is robot
        self.notes = [*notes, *urdf.notes]
        self.of = self.of if self.whole else {}
        inside = {joint.child: joint.name for joint in urdf.joints}
        self.hinges = [j for j in self.hinges if self.names[j] in inside.values()]
        if held := [joint for joint, link in self.held if link in inside]:
            self.notes.append(listed("hands have hinges; joints of other kinds are held", held))
        if not self.hinges:
            raise DescriptionError(path, "; ".join(["there is no hinge joint", *self.notes]))
        self.place = {int(model.jnt_dofadr[j]): k for k, j in enumerate(self.hinges)}
        self.lower, self.upper = np.array([self._limits(j) for j in self.hinges]).T
        self.gravity = robot.pose(base)[:3, :3].T @ model.opt.gravity
        self.urdf = urdf
        tables = self._tables(name)
        notes = [*self.notes, *(listed(note, names) for note, names in self.of.items())]
        self.hand = MjcfHand(replace(urdf, notes=tuple(notes)), tables, self.loose)

    def _note(self, note: str, name: str) -> None:
        self.of.setdefault(note, []).append(name)

    # -- links and joints ---------------------------------------------------------------------------

    def _tree(self) -> tuple[list[UrdfLink], list[UrdfJoint]]:
        model = self.model
        names = {b: model.body(b).name or f"body_{b}" for b in range(1, model.nbody)}
        left_out, links, joints = things(model, names), [self._link(_WORLD, 0, np.eye(4))], []
        for b in sorted(left_out & set(model.body_rootid.tolist())):
            self._note("these move and nothing drives them: they are left out", names[b])
        frame = {0: (_WORLD, np.eye(4))}
        """Of each body: its link, and its frame in the link's."""
        for b, name in names.items():
            if b in left_out:
                continue
            parent, offset = frame[int(model.body_parentid[b])]
            at = offset @ _pose(model.body_pos[b], self._rotation(model.body_quat[b]))
            kinds = [(j, int(model.jnt_type[j]) == self._kind.mjJNT_HINGE) for j in self._joints_of(b)]
            hinges = [j for j, hinge in kinds if hinge]
            self.held += [(model.joint(j).name or name, name) for j, hinge in kinds if not hinge]
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
        self._note("shapes other than box, sphere, capsule and cylinder touch nothing, those of", link)
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
        actuators = [actuator for actuator in actuators if actuator is not None]
        drives = [self._row(actuator["moment_arms"]) for actuator in actuators]
        couplings = list(self._equalities(actuated))
        for note, label, row, value in self._tendon_couplings(actuated):
            rows = [*drives, *(row for _, row, _ in couplings), row]
            if np.linalg.matrix_rank(rows) == len(rows):
                couplings.append((label, row, value))
            else:
                note = "tendons that tie joints with motors of their own are left out"
            self._note(note, label)
        for link in self.urdf.links:
            if link.name in self.meshes:
                self._note("links whose meshes are not read, and touch nothing", link.name)
                if link.mass < _LIGHT:
                    self._note("without their meshes these have no mass, and 1 mg here", link.name)
        rows, k = [*drives, *(row for _, row, _ in couplings)], self.model.jnt_stiffness[self.hinges]
        self.loose = unheld_joints(
            [self.names[j] for j in self.hinges], np.reshape(rows, (-1, len(k))), np.diag(k)
        )
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
        hand = {"name": name, "base_link": self.base, "gravity": (self.gravity + 0.0).tolist()}
        return {"hand": hand, "joints": springs, "actuators": actuators, "couplings": tables}

    def _rests(self, couplings: list[tuple[str, Array, float]]) -> Array:
        """Where springs are slack; joints that are coupled, at the nearest angles that obey the couplings."""
        rests = np.array([self.model.qpos_spring[self.model.jnt_qposadr[j]] for j in self.hinges])
        if not couplings:
            return rests
        C, length = np.array([row for _, row, _ in couplings]), np.array([value for *_, value in couplings])
        return rests + np.linalg.pinv(C) @ (length - C @ rests)

    def _actuator(self, k: int, actuated: set[int]) -> dict[str, Any] | None:
        """None: it drives no joint of the hand."""
        model, kinds = self.model, self._mj.mjtTrn
        name = model.actuator(k).name or f"actuator_{k}"
        row, offset = self._driven(k, actuated)
        if not row.any():
            if self.whole:
                self._note("actuators that drive no joint of the hand are left out", name)
            return None
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
            self._note("actuators without position control are taken as rigid, over their whole stroke", name)
        sign = -1.0 if pulls_back else 1.0
        finite = np.isfinite(length).all()
        table["range"] = sorted((sign * length).tolist()) if finite else [TODO, TODO]
        table["offset"] = sign * offset
        table["moment_arms"] = self._named(sign * row)
        table["tendon"] = bool(pulls_back or low >= 0)
        if int(model.actuator_trntype[k]) == kinds.mjTRN_TENDON and np.abs(row).max() < 0.1:
            self._note("these count in the length of their tendon, not in rad", name)
        return table

    def _driven(self, k: int, actuated: set[int]) -> tuple[Array, float]:
        """Moment arms ``(n_q,)`` and length at zero angles of an actuator; no arms: of another kind."""
        model, kinds = self.model, self._mj.mjtTrn
        gear, target = float(model.actuator_gear[k, 0]), int(model.actuator_trnid[k, 0])
        kind = int(model.actuator_trntype[k])
        if kind == kinds.mjTRN_TENDON:
            actuated.add(target)
            row, offset = self._tendon(target)
            return gear * row, gear * offset
        if kind in (kinds.mjTRN_JOINT, kinds.mjTRN_JOINTINPARENT):
            return gear * self._unit(target), 0.0
        return np.zeros(len(self.hinges)), 0.0

    def _unit(self, joint: int) -> Array:
        """1 at a joint, ``(n_q,)``; zeros: it is not of the hand."""
        return np.array([float(joint == j) for j in self.hinges])

    def _tendon(self, t: int) -> tuple[Array, float]:
        """Moment arms ``(n_q,)`` and length at zero angles: exact for fixed tendons."""
        model = self.model
        parts = range(model.tendon_adr[t], model.tendon_adr[t] + model.tendon_num[t])
        if all(int(model.wrap_type[w]) == self._mj.mjtWrap.mjWRAP_JOINT for w in parts):
            row = np.zeros(len(self.hinges))
            held = 0.0
            for w in parts:
                unit = self._unit(int(model.wrap_objid[w]))
                row += model.wrap_prm[w] * unit
                held += 0.0 if unit.any() else model.wrap_prm[w] * self._start(int(model.wrap_objid[w]))
            return row, float(held)
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
                if (place := self.place.get(int(model.ten_J_colind[i]))) is not None:
                    row[place] += data.ten_J[i]
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
                if not any(self._moves(e, end) for end in (model.eq_obj1id[e], model.eq_obj2id[e])):
                    continue  # what carries the hand, or the rest of the robot
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
            if row.any():
                yield name, row, value

    def _moves(self, equality: int, end: int) -> bool:
        """Whether a joint of the hand moves a body, or a site's body."""
        of_site = int(self.model.eq_objtype[equality]) == self._mj.mjtObj.mjOBJ_SITE
        body = int(self.model.site_bodyid[end] if of_site else end)
        name = self.model.body(body).name or f"body_{body}"
        return any(joint.kind != "fixed" for joint in self.urdf.joints_to(name))

    def _tied(self, kind: int, which: int, actuated: set[int]) -> tuple[Array, float]:
        """The row of a joint or tendon under an equality, and its value where MuJoCo counts from."""
        model = self.model
        if kind == self._mj.mjtEq.mjEQ_JOINT:
            row = self._unit(which)
            return row, self._start(which) if row.any() else 0.0
        actuated.add(which)
        row, offset = self._tendon(which)
        return row, float(model.tendon_length0[which]) - offset

    def _start(self, joint: int) -> float:
        """Where MuJoCo counts a joint from, and holds one that is not of the hand."""
        return float(self.model.qpos0[self.model.jnt_qposadr[joint]])

    def _tendon_couplings(self, used: set[int]) -> Iterator[tuple[str, str, Array, float]]:
        """Tendons that nobody pulls: stiff ones, and those that can hardly move, tie joints; with notes."""
        model = self.model
        for t in range(model.ntendon):
            if t in used:
                continue
            name = model.tendon(t).name or f"tendon_{t}"
            row, offset = self._tendon(t)
            if not row.any():
                continue
            shortest, longest = self._span(row)
            low, high = model.tendon_range[t].tolist()
            spring = model.tendon_lengthspring[t]
            if model.tendon_stiffness[t] > 0 and spring[0] == spring[1]:
                yield "tendons with springs tie their joints rigidly", name, row, float(spring[0]) - offset
            elif (
                model.tendon_limited[t]
                and high - low < _NARROW * (longest - shortest)
                and (row != 0).sum() > 1
            ):
                yield "tendons that can hardly move tie their joints", name, row, (low + high) / 2 - offset
            elif model.tendon_limited[t] or model.tendon_stiffness[t] > 0:
                self._note("tendons that only limit or spring are left out", name)

    def _span(self, row: Array) -> Array:
        """Least and largest ``row q`` within the joints' limits ``(2,)``."""
        pulled = row != 0
        ends = row[pulled] * np.array([self.lower, self.upper])[:, pulled]
        return np.array([ends.min(axis=0).sum(), ends.max(axis=0).sum()])

    def _row(self, named: dict[str, float]) -> Array:
        return np.array([named.get(self.names[j], 0.0) for j in self.hinges])

    def _named(self, row: Array) -> dict[str, float]:
        return {self.names[j]: float(row[k]) for k, j in enumerate(self.hinges) if row[k] != 0}


def _pose(position: Array, rotation: Array | None = None) -> Array:
    matrix = np.eye(4)
    matrix[:3, 3] = position
    if rotation is not None:
        matrix[:3, :3] = rotation
    return matrix
