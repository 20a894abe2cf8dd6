"""Which mistakes of a wiring explain what a hand's sensors say."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import combinations, islice

import numpy as np
from numpy.typing import NDArray

from ..description import HandDescription
from ..drivers import Wiring
from ..typing import Array

_DEG = math.pi / 180
_RANGE, _STATIC = 10 * _DEG, 15 * _DEG  # [rad] tolerances: beyond a range; a - (a_0 + J_a q), tendons stretch
_SHARE = 0.75  # of a motor's motion that a tendon under load passes on
_LEAST, _SPREAD = 0.05 * _DEG, 0.3  # of a motion [rad], and as a share of it; twice the noise comes on top
_TWO_ENTRIES = 4.0  # a swap must explain so much more (sum of squares) than a single wrong entry
_HALF_TURN = "zero, off by half a turn"


@dataclass(frozen=True)
class Motion:
    """What one small command did [rad]."""

    a: Array
    """Change of the encoders ``(n_a,)``."""
    q: Array
    """Change of the joints ``(n_q,)``."""
    gain: Array | None
    """dq/da as predicted ``(n_q, n_a)``; None: unknown, since the hand holds an object."""
    noise: Array
    """Standard deviation of ``q`` [rad]."""


@dataclass(frozen=True)
class Readings:
    """What was read at rest, and in some small motions; angles [rad]."""

    a: Array
    q: Array
    motions: tuple[Motion, ...] = ()


@dataclass(frozen=True)
class Mistake:
    """A single wrong entry, and the readings as they would be without it."""

    kind: str
    """"motors" or "joints"."""
    names: tuple[str, ...]
    key: str
    """Of the wiring file: sign, per_rad, zero, id."""
    what: str
    readings: Readings
    penalty: float = 0.0

    @property
    def where(self) -> str:
        """Motor or joint, by name."""
        return f"{self.kind[:-1]} " + " and ".join(f"'{name}'" for name in self.names)


class WiringTest:
    r"""``a = a_0 + J_a q`` at rest, ``J_a dq ~ da`` and ``dq ~ dq_f`` in motions, ranges of a and q.

    Args:
        hand: its description.
        sensed: which joints are measured.
        wiring: how raw readings were converted; None: not known.
    """

    def __init__(self, hand: HandDescription, sensed: NDArray[np.bool_], wiring: Wiring | None) -> None:
        self.hand, self.sensed = hand, sensed
        kinds = {} if wiring is None else {"motors": wiring.motors, "joints": wiring.joints}
        self._channels = {(kind, one.name): one for kind, channels in kinds.items() for one in channels}
        self.rows = ~((hand.actuation_jacobian != 0) & ~sensed).any(axis=1)
        """Motors all of whose joints are measured."""

    def misfit(self, readings: Readings) -> Array:
        """Each quantity over its tolerance; about 1 and less where all is well."""
        hand, rows, a, q = self.hand, self.rows, readings.a, readings.q
        J_a = hand.lengths.jacobian(q, hand.actuation_jacobian)
        beyond = np.maximum(hand.actuator_lower - a, a - hand.actuator_upper)
        joints = np.maximum(hand.joint_lower - q, q - hand.joint_upper)[self.sensed]
        parts = [np.maximum(np.concatenate([beyond, joints]), 0) / _RANGE]
        parts.append(np.abs(a - hand.unloaded(q))[rows] / _STATIC)
        for motion in readings.motions:
            noise = np.sqrt(J_a**2 @ motion.noise**2)
            parts.append(_off(J_a @ motion.q, motion.a, noise)[rows])
            if motion.gain is not None:
                parts.append(_off(motion.q, motion.gain @ motion.a, motion.noise)[self.sensed])
        return np.concatenate(parts)

    def mistakes(self, readings: Readings) -> Iterator[Mistake]:
        """Everything that a single wrong entry could be, with the readings put right."""
        for kind, names, field, at in (
            ("motors", self.hand.actuator_names, "a", range(self.hand.n_a)),
            ("joints", self.hand.joint_names, "q", np.flatnonzero(self.sensed).tolist()),
        ):
            for i in at:
                only, one = np.arange(len(names)) == i, (names[i],)
                scales = {
                    -1.0: ("sign", "sign reversed"),
                    180 / math.pi: ("per_rad", "unit is rad, not degrees"),
                    math.pi / 180: ("per_rad", "unit is degrees, not rad"),
                }
                for factor, (key, what) in scales.items():
                    by = np.where(only, factor, 1.0)
                    yield Mistake(kind, one, key, what, _changed(readings, field, by.__mul__, by.__mul__))
                for turn in (math.pi, -math.pi):
                    shifted = _changed(readings, field, (turn * only).__add__, np.copy)
                    yield Mistake(kind, one, "zero", _HALF_TURN, shifted)
            for i, k in combinations(at, 2):
                swapped = self._swapped(readings, kind, field, names, i, k)
                yield Mistake(kind, (names[i], names[k]), "id", "swapped", swapped, _TWO_ENTRIES)

    def pairs(self, readings: Readings) -> Iterator[tuple[Mistake, Mistake]]:
        """Any two of these; the second has the readings without both."""
        for number, first in enumerate(self.mistakes(readings), start=1):
            for second in islice(self.mistakes(first.readings), number, None):
                yield first, second

    def _swapped(
        self, readings: Readings, kind: str, field: str, names: tuple[str, ...], i: int, k: int
    ) -> Readings:
        """Each channel reads what the other one has read."""

        def swap(x: Array, steps: bool) -> Array:
            y = x.copy()
            y[[i, k]] = x[[k, i]]
            one, other = (self._channels.get((kind, names[at])) for at in (i, k))
            if one is not None and other is not None:
                for to, at, channel, source in ((i, k, one, other), (k, i, other, one)):
                    raw = source.bus(float(x[at])) - (source.bus(0.0) if steps else 0.0)
                    y[to] = channel.value(raw + (channel.zero if steps else 0.0))
            return y

        return _changed(readings, field, lambda x: swap(x, False), lambda x: swap(x, True))


def _off(measured: Array, moved: Array, noise: Array) -> Array:
    return np.abs(measured - _SHARE * moved) / (_LEAST + 2 * noise + _SPREAD * np.abs(moved))


def _changed(
    readings: Readings, field: str, rest: Callable[[Array], Array], motion: Callable[[Array], Array]
) -> Readings:
    """With one field of the readings at rest, and of each motion, put right."""
    motions = tuple(replace(one, **{field: motion(getattr(one, field))}) for one in readings.motions)
    return replace(readings, **{field: rest(getattr(readings, field))}, motions=motions)
