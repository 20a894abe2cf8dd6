"""Tables of a transmission file that say how long something is: arms over angles, an MJCF's tendons, pins."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..exceptions import JointMismatchError
from ..typing import Array
from ._toml import TomlTable
from .connected import PinnedPoints
from .lengths import ArmFunction, Lengths, Loops, Routed, TendonSprings, typical_arms
from .mjcf_hand import MjcfHand
from .mjcf_tendons import RoutedTendons, element_name
from .urdf import UrdfModel

SPRING = ("name", "moment_arms", "mjcf_tendons", "stiffness", "slack")
LOOP = ("name", "moment_arms", "mjcf_tendons", "value", "links", "points")
_TABLE = ("angle", "angle_deg", "arm")
_MOST = 6  # powers of a polynomial
_POSTURES = 8  # at which the directions of a loop are looked for


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
            ends.append((self._end(table, low, -np.inf), self._end(table, high, np.inf)))
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

    def _arms(self, table: TomlTable, row: Array) -> Iterable[tuple[int, ArmFunction]]:
        """Fills in the constant or typical arms of a row; those that are functions."""
        data = table.data["moment_arms"]
        constant = isinstance(data, dict) and {
            k: v for k, v in data.items() if not isinstance(v, dict | list)
        }
        if not isinstance(data, dict) or len(constant or ()) == len(data):
            constant = table.weights("moment_arms")
        unexpected = [name for name in (data if isinstance(data, dict) else ()) if name not in self.names]
        if unexpected:
            raise JointMismatchError(table.path, (), unexpected, self.names)
        low, high = self._limits
        found = []
        for name, value in data.items():
            joint = self.names.index(name)
            if not isinstance(value, dict | list):
                row[joint] = TomlTable(table.path, table.place, {name: value}, (name,)).number(name)
                continue
            function = self._function(table, name, value)
            row[joint] = function.typical(low[joint], high[joint])
            if row[joint] == 0:
                raise table.error(f"the moment arm of '{name}' is 0 all over its range")
            found.append((joint, function))
        return found

    def _function(self, table: TomlTable, name: str, value: Any) -> ArmFunction:
        place = f"{table.place}: moment arm of '{name}'"
        if isinstance(value, list):
            one = TomlTable(table.path, place, {"polynomial": value}, ("polynomial",))
            if not 1 <= len(value) <= _MOST:
                raise one.error(f"a polynomial has 1 to {_MOST} coefficients, got {len(value)}")
            return ArmFunction.polynomial(one.vector("polynomial", len(value)))
        one = TomlTable(table.path, place, value, _TABLE)
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
        at = [
            TomlTable(table.path, table.place, {"points": p}, ("points",)).vector("points", 3) for p in points
        ]
        low, high = self._limits
        postures = np.random.default_rng(0).uniform(low, high, size=(_POSTURES, len(low)))
        pins = PinnedPoints(self.urdf, links, at, self.names, postures)
        if not pins.count:
            raise table.error("no joint moves these points apart")
        return pins

    @staticmethod
    def _end(table: TomlTable, value: Any, none: float) -> float:
        if value == none:  # TOML's inf: no end on this side
            return none
        return TomlTable(table.path, table.place, {"slack": value}, ("slack",)).number("slack")
