"""Tables of a transmission file that say how long something is: arms over angles, an MJCF's tendons, pins."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from .._extras import require
from ..exceptions import JointMismatchError
from ..typing import Array
from ._reading import TomlTable
from .hand import ArmFunction, Lengths, Loops, Routed, TendonSprings, typical_arms
from .mjcf import MjcfHand
from .mjcf_transmission import RoutedTendons, element_name
from .urdf import UrdfModel

SPRING = ("name", "moment_arms", "mjcf_tendons", "stiffness", "slack")
LOOP = ("name", "moment_arms", "mjcf_tendons", "value", "links", "points")
_TABLE = ("angle", "angle_deg", "arm")
_MOST = 6  # powers of a polynomial
_POSTURES = 8  # at which the directions of a loop are looked for
_LEAST = 1e-9  # [m/rad] of an arm of pinned points: a smaller one is rounding


@dataclass(frozen=True)
class LengthReader:
    """Reads lengths of the hand with these joints."""

    urdf: UrdfModel
    names: tuple[str, ...]
    rest: Array
    """Of the springs ``(n_q,)`` [rad]."""
    mjcf: MjcfHand | None

    @property
    def _limits(self) -> tuple[Array, Array]:
        joints = self.urdf.moving_joints
        low, high = np.array([joint.lower for joint in joints]), np.array([joint.upper for joint in joints])
        return np.maximum(low, self.rest - np.pi), np.minimum(high, self.rest + np.pi)

    def lengths(self, tables: Iterable[TomlTable]) -> Lengths:
        """One row for each table: ``moment_arms``, ``mjcf_tendons``, or ``links`` and ``points`` with as many
        rows as there are conditions.

        Raises:
            DescriptionError: a table says none of them or several, or what is no length.
            JointMismatchError: an unknown joint.
        """
        rows: list[Array] = []
        functions: list[tuple[int, int, ArmFunction]] = []
        routed: list[tuple[tuple[int, ...], Routed]] = []
        tendons: dict[int, dict[int, float]] = {}
        for table in tables:
            kinds = [key for key in ("moment_arms", "mjcf_tendons", "links") if key in table.data]
            if not kinds:
                raise table.error("the key 'moment_arms' is missing")
            if len(kinds) != 1:
                raise table.error(f"give one of {', '.join(kinds)}")
            if kinds == ["moment_arms"]:
                rows.append(np.zeros(len(self.names)))
                functions += [(len(rows) - 1, *one) for one in self._arms(table, rows[-1])]
            elif kinds == ["mjcf_tendons"]:
                tendons[len(rows)] = self._tendons(table)
                rows.append(np.zeros(len(self.names)))
            else:
                pins = self._pins(table)
                routed.append((tuple(range(len(rows), len(rows) + pins.count)), pins))
                rows += [np.zeros(len(self.names))] * pins.count
        typical = np.array(rows).reshape(-1, len(self.names))
        if tendons and self.mjcf is not None:
            ways = RoutedTendons(self.mjcf.model, list(tendons.values()), self.mjcf.hinges)
            routed.append((tuple(tendons), ways))
        for at, one in routed:
            typical[list(at)] = typical_arms(one, *self._limits, self.rest)
        return Lengths(typical, tuple(functions), tuple(routed))

    def springs(self, tables: list[TomlTable]) -> TendonSprings | None:
        """``[[tendon_springs]]``; ``slack``: one length, or the two between which there is no force.

        Raises:
            DescriptionError, JointMismatchError: as :meth:`lengths`.
        """
        ends = []
        for table in tables:
            slack = table.data.get("slack", 0.0)
            low, high = slack if isinstance(slack, list) and len(slack) == 2 else (slack, slack)
            # TOML's inf: no end on this side
            ends.append(
                [x if x == none else table.finite("slack", x) for x, none in ((low, -np.inf), (high, np.inf))]
            )
            if not ends[-1][0] <= ends[-1][1]:
                raise table.error(f"'slack' reversed: {slack}")
        low, high = np.array(ends).reshape(-1, 2).T
        stiffness = np.array([table.number("stiffness", positive=True) for table in tables])
        names = tuple(table.text("name") for table in tables)
        return TendonSprings(names, self.lengths(tables), stiffness, low, high) if tables else None

    def loops(self, tables: list[TomlTable]) -> Loops | None:
        """``[[loops]]``.

        Raises:
            DescriptionError, JointMismatchError: as :meth:`lengths`.
        """
        if not tables:
            return None
        names, values = [], []
        for table in tables:
            count = len(self.lengths([table]).typical)
            names += [table.text("name")] * count
            values += [table.number("value", 0.0)] * count
        return Loops(tuple(names), self.lengths(tables), np.array(values))

    def _arms(self, table: TomlTable, row: Array) -> Iterator[tuple[int, ArmFunction]]:
        """Fills in the constant or typical arms of a row; those that are functions."""
        arms = table.weights("moment_arms", (dict, list))
        if unexpected := [name for name in arms if name not in self.names]:
            raise JointMismatchError(table.path, (), unexpected, self.names)
        low, high = self._limits
        for name, value in arms.items():
            joint = self.names.index(name)
            if isinstance(value, float):
                row[joint] = value
                continue
            function = self._function(table, name, value)
            row[joint] = function.typical(low[joint], high[joint])
            if row[joint] == 0:
                raise table.error(f"the moment arm of '{name}' is 0 all over its range")
            yield joint, function

    def _function(self, table: TomlTable, name: str, value: Any) -> ArmFunction:
        if isinstance(value, list):
            if not 1 <= len(value) <= _MOST:
                raise table.error(f"{name}: a polynomial has 1 to {_MOST} coefficients, got {len(value)}")
            return ArmFunction.polynomial(table.numbers(f"moment_arms.{name}", value, len(value)))
        one = TomlTable(table.path, f"{table.place}: moment arm of '{name}'", value, _TABLE)
        arms = one.data.get("arm")
        n = len(arms) if isinstance(arms, list) else 2
        angle, arm = one.angles("angle", n), one.vector("arm", n)
        if n < 2 or (np.diff(angle) <= 0).any():
            raise one.error("two angles or more are needed, in increasing order, and as many arms")
        return ArmFunction.table(angle, arm)

    def _tendons(self, table: TomlTable) -> dict[int, float]:
        """Weights of MuJoCo's tendons by their indices."""
        if self.mjcf is None:
            raise table.error("'mjcf_tendons' are those of an MJCF, and this hand is none")
        model = self.mjcf.model
        known = {element_name(model, "tendon", t): t for t in range(model.ntendon)}
        weights = table.weights("mjcf_tendons")
        for name in weights:
            if name not in known:
                raise table.error(f"no tendon '{name}'; those of the file are: {', '.join(known)}")
        return {known[name]: weight for name, weight in weights.items()}

    def _pins(self, table: TomlTable) -> PinnedPoints:
        links, points = table.data["links"], table.data.get("points")
        known = [link.name for link in self.urdf.links]
        if not isinstance(links, list) or len(links) != 2 or not all(link in known for link in links):
            raise table.error(f"'links' must be two of {', '.join(known)}")
        if not isinstance(points, list) or len(points) != 2:
            raise table.error("'points' must be two points, one in the frame of each link")
        at = [table.numbers("points", point, 3) for point in points]
        low, high = self._limits
        postures = np.random.default_rng(0).uniform(low, high, size=(_POSTURES, len(low)))
        pins = PinnedPoints(self.urdf, links, at, self.names, postures)
        if not pins.count:
            raise table.error("no joint moves these points apart")
        return pins


class PinnedPoints:
    """``c(q) = U^T (p_1(q) - p_2(q))`` [m], U the directions in which the points can part at all.

    Args:
        urdf: the tree.
        links: the two.
        points: of each in its own frame [m].
        names: of all joints, in the order of q.
        postures: at which directions are looked for ``(n, n_q)`` [rad].
    """

    def __init__(
        self,
        urdf: UrdfModel,
        links: Sequence[str],
        points: Sequence[Sequence[float]],
        names: Sequence[str],
        postures: Array,
    ) -> None:
        self._chains = []
        for link, point in zip(links, points, strict=True):
            parts = [
                (joint.transform, None if joint.name not in names else names.index(joint.name), joint.axis)
                for joint in urdf.joints_to(link)
            ]
            self._chains.append((parts, np.array(point, dtype=np.float64)))
        self._n_q, self._rotation = len(names), require("scipy.spatial.transform").Rotation
        self._directions = np.eye(3)
        rows = np.concatenate([self(q)[1].T for q in postures])
        _, size, directions = np.linalg.svd(rows, full_matrices=False)
        self._directions = directions[size > _LEAST * np.sqrt(len(postures))]

    @property
    def count(self) -> int:
        """How many conditions there are."""
        return len(self._directions)

    def __call__(self, q: Array) -> tuple[Array, Array]:
        (first, J), (second, K) = (self._point(parts, point, q) for parts, point in self._chains)
        return self._directions @ (first - second), self._directions @ (J - K)

    def _point(
        self, chain: list[tuple[Array, int | None, Array]], point: Array, q: Array
    ) -> tuple[Array, Array]:
        """Where a point is [m], and its Jacobian ``(3, n_q)``, in the root's frame."""
        R, o, joints = np.eye(3), np.zeros(3), []
        for transform, joint, axis in chain:
            o, R = o + R @ transform[:3, 3], R @ transform[:3, :3]
            if joint is not None:
                joints.append((joint, R @ axis, o))
                R = R @ self._rotation.from_rotvec(q[joint] * axis).as_matrix()
        at, J = o + R @ point, np.zeros((3, self._n_q))
        for joint, axis, origin in joints:
            J[:, joint] += np.cross(axis, at - origin)
        return at, J
