"""The hand that an MJCF describes: its tree as a URDF would have it, and its transmission.

Tendons give moment arms or are measured by MuJoCo, tendons and joints under an equality couplings, pinned
points loops, springs of joints and tendons springs, position actuators ranges and stiffnesses. What has no
counterpart is refused, or approximated with a note.
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
from .mjcf_tendons import RoutedTendons
from .shape import Shape
from .urdf import UrdfJoint, UrdfLink, UrdfModel

_WORLD = "world"
_NARROW = (
    0.2  # a limited tendon is a coupling if it may move by less than this share of what its joints allow
)
_DRAWN = 200  # postures at which the length of a spatial tendon is looked at
_OFF = 1e-9  # [rad] or [m] by which springs at rest may miss an equality


@dataclass
class MjcfHand:
    """What :func:`read_mjcf` found.

    ``tables`` are those of a transmission file, without pads: nothing in an MJCF says what is meant to touch.
    """

    urdf: UrdfModel
    tables: dict[str, Any]
    notes: list[str] = field(default_factory=list)
    model: Any = None
    """MuJoCo's, which measures tendons on their ways."""
    hinges: tuple[int, ...] = ()
    """Its joints in the order of q."""


def read_mjcf(path: str | Path) -> MjcfHand:
    """Read the hand at ``path``; the tree stands on the world, without what carries it there.

    Raises:
        DescriptionError: as :func:`~torch_ekm.description.mjcf.compile_mjcf`; a joint that slides or is a
            ball, a loop closed by ``weld``, an equality of tendons that is not linear, an actuator without a
            joint or a tendon.
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
        self.hand = MjcfHand(self.urdf, self._tables(name), self.notes, model, tuple(self.hinges))

    # -- links and joints ---------------------------------------------------------------------------

    def _tree(self) -> tuple[list[UrdfLink], list[UrdfJoint]]:
        model = self.model
        names = {b: model.body(b).name or f"body_{b}" for b in range(1, model.nbody)}
        left_out, links, joints = self._objects(names), [self._link(_WORLD, 0, np.eye(4))], []
        frame = {0: (_WORLD, np.eye(4))}
        """Of each body: its link, and its frame in the link's."""
        self._frame = frame
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
        self._loops: list[dict[str, Any]] = []
        couplings = [*self._equalities(actuated), *self._tendon_couplings(actuated)]
        meshes = sorted(self.meshes & {link.name for link in self.urdf.links})
        if meshes:
            self.notes.append(f"meshes are not read: those of {', '.join(meshes)} touch nothing")
        rests, couplings = self._rests(couplings)
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
        found = {"hand": hand, "joints": springs, "actuators": actuators, "couplings": tables}
        return found | {"tendon_springs": [*self._springs()], "loops": self._loops}

    def _rests(
        self, couplings: list[tuple[str, Array, float]]
    ) -> tuple[Array, list[tuple[str, Array, float]]]:
        """Where springs are slack, joints without a spring at angles that obey the couplings; and these. One
        that springs at rest do not obey is a loop with a value of its own."""
        rests = np.array([self.model.qpos_spring[self.model.jnt_qposadr[j]] for j in self.hinges])
        if not couplings:
            return rests, couplings
        C, length = np.array([row for _, row, _ in couplings]), np.array([value for *_, value in couplings])
        loose = np.array([self.model.jnt_stiffness[j] == 0 for j in self.hinges])
        rests[loose] += np.linalg.pinv(C[:, loose]) @ (length - C @ rests)
        off = np.abs(length - C @ rests) > _OFF
        for apart, (name, row, value) in zip(off, couplings, strict=True):
            if apart:
                self._loops.append({"name": name, "moment_arms": self._named(row), "value": value})
        return rests, [one for apart, one in zip(off, couplings, strict=True) if not apart]

    def _actuator(self, k: int, actuated: set[int]) -> dict[str, Any]:
        model, kinds = self.model, self._mj.mjtTrn
        name = model.actuator(k).name or f"actuator_{k}"
        row, offset, gear, tendon = self._driven(k, name, actuated)
        length = self._span(row) + offset if tendon is None else self._spatial_span(tendon, gear)
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
        if tendon is None:
            table |= {"offset": sign * offset, "moment_arms": self._named(sign * row)}
        else:
            table["mjcf_tendons"] = {self._tendon_name(tendon): sign * gear}
        table["tendon"] = bool(pulls_back or low >= 0)
        if int(model.actuator_trntype[k]) == kinds.mjTRN_TENDON and np.abs(row).max() < 0.1:
            told = "plants and models count in its largest arm"
            self.notes.append(f"'{name}' counts in the length of its tendon, not in rad; {told}")
        return table

    def _driven(self, k: int, name: str, actuated: set[int]) -> tuple[Array, float, float, int | None]:
        """Moment arms ``(n_q,)`` and length at zero angles of an actuator, its gear, and its tendon if that
        has a way of its own."""
        model, kinds = self.model, self._mj.mjtTrn
        gear, target = float(model.actuator_gear[k, 0]), int(model.actuator_trnid[k, 0])
        kind = int(model.actuator_trntype[k])
        if kind == kinds.mjTRN_JOINT or kind == kinds.mjTRN_JOINTINPARENT:
            if target not in self.hinges:
                raise DescriptionError(self.path, f"actuator '{name}' drives a joint that is not of the hand")
            return gear * np.eye(len(self.hinges))[self.hinges.index(target)], 0.0, gear, None
        if kind == kinds.mjTRN_TENDON:
            actuated.add(target)
            row, offset = self._tendon(target)
            return gear * row, gear * offset, gear, None if self._is_fixed(target) else target
        raise DescriptionError(self.path, f"actuator '{name}' drives neither a joint nor a tendon")

    def _tendon_name(self, t: int) -> str:
        return self.model.tendon(t).name or f"tendon_{t}"

    def _parts(self, t: int) -> range:
        return range(self.model.tendon_adr[t], self.model.tendon_adr[t] + self.model.tendon_num[t])

    def _is_fixed(self, t: int) -> bool:
        joint = self._mj.mjtWrap.mjWRAP_JOINT
        return all(int(self.model.wrap_type[w]) == joint for w in self._parts(t))

    def _tendon(self, t: int) -> tuple[Array, float]:
        """Moment arms ``(n_q,)`` and length at zero angles: exact for fixed tendons, else at rest."""
        model = self.model
        if self._is_fixed(t):
            row = np.zeros(len(self.hinges))
            for w in self._parts(t):
                joint = int(model.wrap_objid[w])
                if joint not in self.hinges:
                    raise DescriptionError(
                        self.path, f"tendon '{model.tendon(t).name}' has a joint that slides"
                    )
                row[self.hinges.index(joint)] += model.wrap_prm[w]
            return row, 0.0
        rest = np.array([model.qpos_spring[model.jnt_qposadr[j]] for j in self.hinges])
        length, J = RoutedTendons(model, [{t: 1.0}], self.hinges)(rest)
        return J[0], float(length[0] - J[0] @ rest)

    def _spatial_span(self, t: int, gear: float) -> Array:
        """Least and largest length of a tendon within the joints' limits ``(2,)``, as far as seen."""
        low, high = np.maximum(self.lower, -np.pi), np.minimum(self.upper, np.pi)
        draw, routed = np.random.default_rng(0), RoutedTendons(self.model, [{t: gear}], self.hinges)
        lengths = [routed(q)[0][0] for q in (low, high, *draw.uniform(low, high, (_DRAWN, len(low))))]
        return np.array([min(lengths), max(lengths)])

    def _springs(self) -> Iterator[dict[str, Any]]:
        """Springs over tendons."""
        for t in np.flatnonzero(self.model.tendon_stiffness > 0).tolist():
            table: dict[str, Any] = {"name": self._tendon_name(t)}
            if self._is_fixed(t):
                table["moment_arms"] = self._named(self._tendon(t)[0])
            else:
                table["mjcf_tendons"] = {self._tendon_name(t): 1.0}
            ends = self.model.tendon_lengthspring[t].tolist()
            yield table | {"stiffness": float(self.model.tendon_stiffness[t]), "slack": ends}

    def _equalities(self, actuated: set[int]) -> Iterator[tuple[str, Array, float]]:
        """``C q = c``, one row for each equality."""
        model, kinds = self.model, self._mj.mjtEq
        for e in range(model.neq):
            kind, name = int(model.eq_type[e]), model.equality(e).name or f"equality_{e}"
            first, second = int(model.eq_obj1id[e]), int(model.eq_obj2id[e])
            if not model.eq_active0[e]:
                continue
            if kind == kinds.mjEQ_CONNECT:
                self._connect(e, name)
                continue
            if kind != kinds.mjEQ_JOINT and kind != kinds.mjEQ_TENDON:
                problem = f"equality '{name}' welds bodies: only joints, tendons and points are tied"
                raise DescriptionError(self.path, problem)
            if np.any(model.eq_data[e, 2:5]) and second >= 0:
                self._curve(e, kind, name)
                continue
            constant, slope = model.eq_data[e, :2].tolist()
            tied = {first: 1.0} | ({second: -slope} if second >= 0 else {})
            if kind == kinds.mjEQ_TENDON and not all(map(self._is_fixed, tied)):
                actuated |= set(tied)
                value = constant + sum(weight * model.tendon_length0[t] for t, weight in tied.items())
                weights = {self._tendon_name(t): weight for t, weight in tied.items()}
                self._loops.append({"name": name, "mjcf_tendons": weights, "value": float(value)})
                continue
            row, value = self._tied(kind, first, actuated)
            value += constant
            if second >= 0:
                other, there = self._tied(kind, second, actuated)
                row, value = row - slope * other, value - slope * there
            yield name, row, value

    def _connect(self, e: int, name: str) -> None:
        """Points of two links, where MuJoCo pins them."""
        model, links, points = self.model, [], []
        of_sites = int(model.eq_objtype[e]) == self._mj.mjtObj.mjOBJ_SITE
        for k, which in enumerate((int(model.eq_obj1id[e]), int(model.eq_obj2id[e]))):
            body = int(model.site_bodyid[which]) if of_sites else which
            point = model.site_pos[which] if of_sites else model.eq_data[e, 3 * k : 3 * k + 3]
            if body not in self._frame:
                raise DescriptionError(self.path, f"equality '{name}' pins what is not of the hand")
            link, frame = self._frame[body]
            links.append(link)
            points.append((frame[:3, :3] @ point + frame[:3, 3]).tolist())
        self._loops.append({"name": name, "links": links, "points": points})

    def _curve(self, e: int, kind: int, name: str) -> None:
        """A joint that follows another along a polynomial of up to the fourth power."""
        model = self.model
        first, second = int(model.eq_obj1id[e]), int(model.eq_obj2id[e])
        if kind != self._mj.mjtEq.mjEQ_JOINT or not {first, second} <= set(self.hinges):
            raise DescriptionError(
                self.path, f"equality '{name}' is not linear: only those of hinges need not be"
            )
        start, other = (float(model.qpos0[model.jnt_qposadr[j]]) for j in (first, second))
        curve = np.polynomial.Polynomial(model.eq_data[e, :5])(np.polynomial.Polynomial([-other, 1.0]))
        arms = {self.names[first]: 1.0, self.names[second]: (-curve.deriv().coef).tolist()}
        self._loops.append({"name": name, "moment_arms": arms, "value": start + float(curve(0.0))})

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
        """Tendons that nobody pulls: those that can hardly move tie their joints."""
        model, left_out = self.model, []
        for t in range(model.ntendon):
            if t in used:
                continue
            name = model.tendon(t).name or f"tendon_{t}"
            row, offset = self._tendon(t)
            shortest, longest = self._span(row)
            low, high = model.tendon_range[t].tolist()
            if (
                model.tendon_limited[t]
                and high - low < _NARROW * (longest - shortest)
                and (row != 0).sum() > 1
            ):
                self.notes.append(
                    f"tendon '{name}' ties its joints, without the {high - low:.3g} that it may move"
                )
                yield name, row, (low + high) / 2 - offset
            elif model.tendon_limited[t]:
                left_out.append(name)

        if left_out:
            self.notes.append(f"tendons that only limit are left out: {', '.join(left_out)}")

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
