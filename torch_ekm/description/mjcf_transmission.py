"""How the actuators of an MJCF act on its joints, tendons included."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from .._extras import require
from ..exceptions import DescriptionError
from ..typing import Array
from ._reading import TODO
from .hand import typical_arms
from .urdf import UrdfModel


def element_name(model: Any, kind: str, k: int) -> str:
    """The name of MuJoCo's k-th body, joint, tendon ...; of one without: a name that no other has."""
    name = getattr(model, kind)(k).name
    if not name:
        name, mj = f"{kind}_{k}", require("mujoco")
        while mj.mj_name2id(model, getattr(mj.mjtObj, f"mjOBJ_{kind.upper()}"), name) >= 0:
            name += "_"
    return name


class RoutedTendons:
    """``l(q) = W L(q)``, L the lengths of tendons as MuJoCo measures them.

    Args:
        model: MuJoCo's.
        weights: of the tendons in each length, by their indices.
        hinges: MuJoCo's joints in the order of q; all others stay where the file has them.
    """

    def __init__(self, model: Any, weights: Sequence[Mapping[int, float]], hinges: Sequence[int]) -> None:
        self._given = model, weights, hinges
        self._model, self._tendons = model, sorted({t for row in weights for t in row})
        self._weights = np.array([[row.get(t, 0.0) for t in self._tendons] for row in weights])
        self._q, self._v = model.jnt_qposadr[list(hinges)], model.jnt_dofadr[list(hinges)]
        self._mj = require("mujoco")
        self._data = self._mj.MjData(model)

    def __call__(self, q: Array) -> tuple[Array, Array]:
        mj, model, data = self._mj, self._model, self._data
        data.qpos[self._q] = q
        mj.mj_kinematics(model, data)
        mj.mj_comPos(model, data)
        mj.mj_tendon(model, data)
        J = np.zeros((model.ntendon, model.nv))
        mj.mju_sparse2dense(J, data.ten_J, model.ten_J_rownnz, model.ten_J_rowadr, model.ten_J_colind)
        return self._weights @ data.ten_length[self._tendons], self._weights @ J[self._tendons][:, self._v]

    def __deepcopy__(self, memo: dict[int, Any]) -> RoutedTendons:
        return self  # only what it measures with changes

    def __reduce__(self) -> tuple[type[RoutedTendons], tuple[Any, ...]]:
        return RoutedTendons, self._given


_NARROW = 0.2  # of what its joints allow: a limited tendon that may move by less is a coupling
_DRAWN = 200  # postures at which the length of a spatial tendon is looked at
_OFF = 1e-9  # [rad] or [m] by which springs at rest may miss an equality
_Tie = tuple[str, Array, float]
"""Name of a coupling, its row ``(n_q,)`` and its value."""


@dataclass(eq=False)
class MjcfTransmission:
    """Reads ``[joints]``, ``[[actuators]]``, ``[[couplings]]``, ``[[tendon_springs]]`` and ``[[loops]]``.

    Joints that are not of the hand stay where MuJoCo counts them from.
    """

    urdf: UrdfModel
    model: Any
    names: dict[int, str]
    """Of MuJoCo's joints, by their numbers; those of the hand in the order of q."""
    frames: dict[int, tuple[str, Array]]
    """Of MuJoCo's bodies: the link of each, and its frame in the link's."""
    held: set[str]
    """Links that another joint than a hinge carries, which is held."""
    whole: bool
    """Nothing of the file is left out."""
    note: Callable[[str, str], None]
    """Takes what is assumed, and of what."""

    def __post_init__(self) -> None:
        self._mj, self.hinges = require("mujoco"), list(self.names)
        joints = self.urdf.moving_joints
        self.lower = np.array([joint.lower for joint in joints])
        self.upper = np.array([joint.upper for joint in joints])
        self._rest = self.model.qpos_spring[self.model.jnt_qposadr[self.hinges]]
        self._drives: list[Array] = []
        self._loops: list[dict[str, Any]] = []
        self._used: set[int] = set()
        """Tendons that something pulls or ties."""

    def tables(self) -> dict[str, Any]:
        """All of them.

        Raises:
            DescriptionError: a weld of a part that moves, an equality of tendons that is not linear.
        """
        actuators = self._actuators()
        couplings = list(self._equalities())
        for t, note, tie in self._tendon_couplings():
            rows = [*self._drives, *(row for _, row, _ in couplings), tie[1]]
            if np.linalg.matrix_rank(rows) < len(rows):
                note = "tendons that tie joints with motors of their own are left out"
            elif self._is_fixed(t):
                couplings.append(tie)
            else:
                self._loops.append({"name": tie[0], "mjcf_tendons": {tie[0]: 1.0}, "value": tie[2]})
            self.note(note, tie[0])
        self._note_unread()
        rests, couplings = self._rests(couplings)
        friction = self.model.dof_frictionloss[self.model.jnt_dofadr[self.hinges]]
        figures = np.stack([self.model.jnt_stiffness[self.hinges], rests, friction], axis=1).tolist()
        keys = "spring", "rest", "friction"
        joints = {
            name: dict(zip(keys, of, strict=True))
            for name, of in zip(self.names.values(), figures, strict=True)
        }
        tied = [{"name": label, "joints": self._named(row)} for label, row, _ in couplings]
        tables = {"joints": joints, "actuators": actuators, "couplings": tied}
        return tables | {"tendon_springs": list(self._springs()), "loops": self._loops}

    def _rests(self, couplings: list[_Tie]) -> tuple[Array, list[_Tie]]:
        """Where springs are slack, joints without a spring at angles that obey the couplings; and these. One
        that springs at rest do not obey is a loop with a value of its own."""
        rests = self._rest.copy()
        if not couplings:
            return rests, couplings
        C, length = np.array([row for _, row, _ in couplings]), np.array([value for *_, value in couplings])
        loose = self.model.jnt_stiffness[self.hinges] == 0
        rests[loose] += np.linalg.pinv(C[:, loose]) @ (length - C @ rests)
        off = np.abs(length - C @ rests) > _OFF
        for apart, (name, row, value) in zip(off, couplings, strict=True):
            if apart:
                self._loops.append({"name": name, "moment_arms": self._named(row), "value": value})
        return rests, [one for apart, one in zip(off, couplings, strict=True) if not apart]

    # -- actuators ----------------------------------------------------------------------------------

    def _actuators(self) -> list[dict[str, Any]]:
        """Those with position control, and others that move what these do not."""
        found = [one for k in range(self.model.nu) if (one := self._actuator(k)) is not None]
        self._drives, kept = [row for table, row in found if "stiffness" in table], []
        for table, row in found:
            if "stiffness" not in table:
                rank = int(np.linalg.matrix_rank(self._drives)) if self._drives else 0
                if np.linalg.matrix_rank([*self._drives, row]) == rank:
                    self.note("actuators that move only what others do are left out", table["name"])
                    continue
                self._drives.append(row)
                note = "actuators without position control are taken as rigid, over their whole stroke"
                self.note(note, table["name"])
            kept.append(table)
        return kept

    def _servo(self, k: int) -> tuple[float, Array | None] | None:
        """Stiffness, and the range of goals as lengths if there is one; None: no position control."""
        model, mj = self.model, self._mj
        gain, (start, slope) = model.actuator_gainprm[k, 0], model.actuator_biasprm[k, :2]
        linear = model.actuator_gaintype[k] == mj.mjtGain.mjGAIN_FIXED
        if not linear or model.actuator_biastype[k] != mj.mjtBias.mjBIAS_AFFINE or not slope < 0 < gain:
            return None
        goals = "act" if model.actuator_dyntype[k] == mj.mjtDyn.mjDYN_INTEGRATOR else "ctrl"
        limited, ends = (getattr(model, f"actuator_{goals}{what}")[k] for what in ("limited", "range"))
        return -slope, (start + gain * ends) / -slope if limited else None

    def _actuator(self, k: int) -> tuple[dict[str, Any], Array] | None:
        """Its table and moment arms; None: it drives no joint of the hand."""
        model, name = self.model, element_name(self.model, "actuator", k)
        row, offset, gear, tendon = self._driven(k)
        way = None if tendon is None or self._is_fixed(tendon) else tendon
        if not row.any():
            if self.whole:
                self.note("actuators that drive no joint of the hand are left out", name)
            return None
        length = self._span(row) + offset if way is None else self._way_span(way, gear)
        table: dict[str, Any] = {"name": name}
        low, high = model.actuator_forcerange[k] if model.actuator_forcelimited[k] else (-1.0, 1.0)
        pulls_back = high <= 0  # MuJoCo's tendons pull where they shorten; here where `a` grows
        if (servo := self._servo(k)) is not None:
            table["stiffness"] = float(servo[0])
            length = length if servo[1] is None else servo[1]
        if tendon is not None and model.tendon_limited[tendon]:
            ends = np.clip(length, *np.sort(gear * model.tendon_range[tendon]))
            if ends[0] != ends[1] and not np.allclose(ends, length, rtol=1e-3):
                length = ends
                self.note("ranges of motors end at the limits of their tendons", name)
        sign = -1.0 if pulls_back else 1.0
        table["range"] = sorted((sign * length).tolist()) if np.isfinite(length).all() else [TODO, TODO]
        if way is None:
            table |= {"offset": sign * offset, "moment_arms": self._named(sign * row)}
        else:
            table["mjcf_tendons"] = {self._tendon_name(way): sign * gear}
        table["tendon"] = bool(pulls_back or low >= 0)
        if tendon is not None and np.abs(row).max() < 0.1:
            counted = "plants and models count in its largest arm"
            self.note(f"these count in the length of their tendon, not in rad; {counted}", name)
        return table, row

    def _driven(self, k: int) -> tuple[Array, float, float, int | None]:
        """Moment arms ``(n_q,)`` and length at zero angles of an actuator, its gear and its tendon.

        No arms: it drives nothing of the hand, or is of another kind.
        """
        model, kinds = self.model, self._mj.mjtTrn
        gear, target = float(model.actuator_gear[k, 0]), int(model.actuator_trnid[k, 0])
        kind = int(model.actuator_trntype[k])
        if kind == kinds.mjTRN_TENDON:
            self._used.add(target)
            row, offset = self._tendon(target)
            return gear * row, gear * offset, gear, target
        if kind in (kinds.mjTRN_JOINT, kinds.mjTRN_JOINTINPARENT):
            return gear * self._unit(target), 0.0, gear, None
        return np.zeros(len(self.hinges)), 0.0, gear, None

    def _unit(self, joint: int) -> Array:
        """1 at a joint, ``(n_q,)``; zeros: it is not of the hand."""
        return np.array([float(joint == j) for j in self.hinges])

    def _start(self, joint: int) -> float:
        """Where MuJoCo counts a joint from, and holds one that is not of the hand."""
        return float(self.model.qpos0[self.model.jnt_qposadr[joint]])

    # -- tendons ------------------------------------------------------------------------------------

    def _tendon_name(self, t: int) -> str:
        return element_name(self.model, "tendon", t)

    def _is_fixed(self, t: int) -> bool:
        parts = slice(self.model.tendon_adr[t], self.model.tendon_adr[t] + self.model.tendon_num[t])
        return bool((self.model.wrap_type[parts] == int(self._mj.mjtWrap.mjWRAP_JOINT)).all())

    def _tendon(self, t: int) -> tuple[Array, float]:
        """Moment arms ``(n_q,)`` and length at zero angles of a fixed tendon; of others typical arms, 0."""
        routed = RoutedTendons(self.model, [{t: 1.0}], self.hinges)
        if not self._is_fixed(t):
            return typical_arms(routed, self.lower, self.upper, self._rest)[0], 0.0
        length, arms = routed(np.zeros(len(self.hinges)))
        return arms[0], float(length[0])

    def _way_span(self, t: int, gear: float) -> Array:
        """Least and largest length of a tendon within the joints' limits ``(2,)``, as far as seen."""
        low, high = np.maximum(self.lower, -np.pi), np.minimum(self.upper, np.pi)
        draw, routed = np.random.default_rng(0), RoutedTendons(self.model, [{t: gear}], self.hinges)
        lengths = [routed(q)[0][0] for q in (low, high, *draw.uniform(low, high, (_DRAWN, len(low))))]
        return np.array([min(lengths), max(lengths)])

    def _springs(self) -> Iterator[dict[str, Any]]:
        """Springs over tendons."""
        for t in np.flatnonzero(self.model.tendon_stiffness > 0).tolist():
            row, offset = self._tendon(t)
            if not row.any():
                continue
            table: dict[str, Any] = {"name": self._tendon_name(t)}
            ends = self.model.tendon_lengthspring[t]
            if self._is_fixed(t):
                table["moment_arms"], ends = self._named(row), ends - offset
            else:
                table["mjcf_tendons"] = {self._tendon_name(t): 1.0}
            yield table | {"stiffness": float(self.model.tendon_stiffness[t]), "slack": ends.tolist()}

    def _note_unread(self) -> None:
        """What has no counterpart."""
        model = self.model
        bent = [self.names[j] for j in self.hinges if model.jnt_stiffnesspoly[j].any()]
        for t in range(model.ntendon):
            if model.tendon_stiffnesspoly[t].any() and self._tendon(t)[0].any():
                bent.append(self._tendon_name(t))
            if model.tendon_frictionloss[t] > 0 and self._tendon(t)[0].any():
                self.note("friction of tendons is left out", self._tendon_name(t))
        for name in bent:
            self.note("of springs that are not linear the linear part counts", name)

    def _tendon_couplings(self) -> Iterator[tuple[int, str, _Tie]]:
        """Tendons that nobody pulls: those that can hardly move tie their joints; with notes."""
        model = self.model
        for t in range(model.ntendon):
            if t in self._used or not model.tendon_limited[t]:
                continue
            row, offset = self._tendon(t)
            if not row.any():
                continue
            shortest, longest = self._span(row) if self._is_fixed(t) else self._way_span(t, 1.0)
            low, high = model.tendon_range[t].tolist()
            if high - low < _NARROW * (longest - shortest) and (row != 0).sum() > 1:
                tie = self._tendon_name(t), row, (low + high) / 2 - offset
                yield t, "tendons that can hardly move tie their joints", tie
            else:
                self.note("limits of tendons are left out", self._tendon_name(t))

    # -- equalities ---------------------------------------------------------------------------------

    def _equalities(self) -> Iterator[_Tie]:
        """``C q = c``, one row for each equality that is linear; the others are loops."""
        model, kinds = self.model, self._mj.mjtEq
        for e in np.flatnonzero(model.eq_active0).tolist():
            kind, name = int(model.eq_type[e]), element_name(model, "equality", e)
            first, second = int(model.eq_obj1id[e]), int(model.eq_obj2id[e])
            if kind != kinds.mjEQ_JOINT and kind != kinds.mjEQ_TENDON:
                self._pinned(e, kind, name)
                continue
            follows = second >= 0 and (kind == kinds.mjEQ_TENDON or second in self.hinges)
            if follows and np.any(model.eq_data[e, 2:5]):
                self._curve(e, kind, name)
                continue
            constant, slope = model.eq_data[e, :2].tolist()
            tied = {first: 1.0} | ({second: -slope} if second >= 0 else {})
            if kind == kinds.mjEQ_TENDON:
                self._used |= set(tied)
                if not all(map(self._is_fixed, tied)):
                    self._tie_tendons(name, tied, constant)
                    continue
            row, value = np.zeros(len(self.hinges)), constant
            for which, weight in tied.items():
                one, start = self._tied(kind, which)
                row, value = row + weight * one, value + weight * start
            if row.any():
                yield name, row, value

    def _tied(self, kind: int, which: int) -> tuple[Array, float]:
        """The row of a joint or tendon under an equality, and its value where MuJoCo counts from."""
        if kind == self._mj.mjtEq.mjEQ_JOINT:
            return self._unit(which), self._start(which) if which in self.hinges else 0.0
        row, offset = self._tendon(which)
        return row, float(self.model.tendon_length0[which]) - offset

    def _tie_tendons(self, name: str, tied: dict[int, float], constant: float) -> None:
        """Tendons on their own ways."""
        if not any(self._tendon(t)[0].any() for t in tied):
            return
        value = constant + sum(weight * self.model.tendon_length0[t] for t, weight in tied.items())
        weights = {self._tendon_name(t): weight for t, weight in tied.items()}
        self._loops.append({"name": name, "mjcf_tendons": weights, "value": float(value)})

    def _pinned(self, e: int, kind: int, name: str) -> None:
        """Points of two links, where MuJoCo pins them; what the hand does not move is left out."""
        model, links, points = self.model, [], []
        of_sites = int(model.eq_objtype[e]) == self._mj.mjtObj.mjOBJ_SITE
        for k, which in enumerate((int(model.eq_obj1id[e]), int(model.eq_obj2id[e]))):
            body = int(model.site_bodyid[which]) if of_sites else which
            point = model.site_pos[which] if of_sites else model.eq_data[e, 3 * k : 3 * k + 3]
            link, frame = self.frames.get(body, ("", np.eye(4)))
            links.append(link)
            points.append((frame[:3, :3] @ point + frame[:3, 3]).tolist())
        first, second = ({joint.child: joint.kind for joint in self.urdf.joints_to(link)} for link in links)
        between = first.keys() ^ second.keys()
        if all((first | second)[link] == "fixed" for link in between):
            return  # what carries the hand, or the rest of the robot
        if kind != self._mj.mjtEq.mjEQ_CONNECT:
            problem = f"equality '{name}' welds bodies: only joints, tendons and points are tied"
            raise DescriptionError(self.urdf.path, problem)
        if not set(links) <= {link.name for link in self.urdf.links}:
            self.note("points that are pinned to what is not of the hand are free", name)
            return
        if self.held & between:
            self.note("loops that close through joints that are held are left out", name)
            return
        self._loops.append({"name": name, "links": links, "points": points})

    def _curve(self, e: int, kind: int, name: str) -> None:
        """A joint that follows another along a polynomial of up to the fourth power."""
        model = self.model
        first, second = int(model.eq_obj1id[e]), int(model.eq_obj2id[e])
        if kind != self._mj.mjtEq.mjEQ_JOINT:
            raise DescriptionError(self.urdf.path, f"equality '{name}' of tendons is not linear")
        start, other = self._start(first), self._start(second)
        curve = np.polynomial.Polynomial(model.eq_data[e, :5])(np.polynomial.Polynomial([-other, 1.0]))
        arms = {self.names[second]: (-curve.deriv().coef).tolist()}
        if first in self.hinges:
            arms, value = {self.names[first]: 1.0} | arms, start + float(curve(0.0))
        else:  # it is held where it starts
            value = float(curve(0.0))
        self._loops.append({"name": name, "moment_arms": arms, "value": value})

    # -- rows ---------------------------------------------------------------------------------------

    def _span(self, row: Array) -> Array:
        """Least and largest ``row q`` within the joints' limits ``(2,)``."""
        pulled = row != 0
        ends = row[pulled] * np.array([self.lower, self.upper])[:, pulled]
        return np.array([ends.min(axis=0).sum(), ends.max(axis=0).sum()])

    def _named(self, row: Array) -> dict[str, float]:
        return {self.names[j]: float(row[k]) for k, j in enumerate(self.hinges) if row[k] != 0}
