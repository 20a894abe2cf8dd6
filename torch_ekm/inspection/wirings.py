"""Which mistakes of a wiring explain what a hand's sensors say."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import combinations, islice

import numpy as np
from numpy.typing import NDArray

from ..description import HandDescription
from ..drivers import Channel
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
        channels: (kind, index) -> channel, where a wiring file says how raw readings were converted.
    """

    def __init__(
        self, hand: HandDescription, sensed: NDArray[np.bool_], channels: Callable[[str, int], Channel | None]
    ) -> None:
        self.hand, self.sensed, self.channels = hand, sensed, channels
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
        for kind, names, field in (
            ("motors", self.hand.actuator_names, "a"),
            ("joints", self.hand.joint_names, "q"),
        ):
            at = range(len(names)) if kind == "motors" else np.flatnonzero(self.sensed)
            for i in map(int, at):
                one = (names[i],)
                yield Mistake(kind, one, "sign", "sign reversed", _scaled(readings, field, i, -1.0))
                for factor in (180 / math.pi, math.pi / 180):
                    what = "unit is degrees, not rad" if factor < 1 else "unit is rad, not degrees"
                    yield Mistake(kind, one, "per_rad", what, _scaled(readings, field, i, factor))
                for turn in (math.pi, -math.pi):
                    yield Mistake(kind, one, "zero", _HALF_TURN, _shifted(readings, field, i, turn))
            for i, k in combinations(map(int, at), 2):
                both = (names[i], names[k])
                yield Mistake(
                    kind, both, "id", "swapped", self._swapped(readings, kind, field, i, k), _TWO_ENTRIES
                )

    def pairs(self, readings: Readings) -> Iterator[tuple[Mistake, Mistake]]:
        """Any two of these; the second has the readings without both."""
        for number, first in enumerate(self.mistakes(readings), start=1):
            for second in islice(self.mistakes(first.readings), number, None):
                yield first, second

    def _swapped(self, readings: Readings, kind: str, field: str, i: int, k: int) -> Readings:
        """Each channel reads what the other one has read."""
        one, other = self.channels(kind, i), self.channels(kind, k)

        def swap(x: Array, steps: bool) -> Array:
            y = x.copy()
            if one is None or other is None:
                y[[i, k]] = x[[k, i]]
                return y
            for to, at, channel, source in ((i, k, one, other), (k, i, other, one)):
                raw = source.bus(float(x[at])) - (source.bus(0.0) if steps else 0.0)
                y[to] = channel.value(raw + (channel.zero if steps else 0.0))
            return y

        motions = tuple(replace(m, **{field: swap(getattr(m, field), True)}) for m in readings.motions)
        return replace(readings, **{field: swap(getattr(readings, field), False)}, motions=motions)


def _off(measured: Array, moved: Array, noise: Array) -> Array:
    return np.abs(measured - _SHARE * moved) / (_LEAST + 2 * noise + _SPREAD * np.abs(moved))


def _scaled(readings: Readings, field: str, i: int, factor: float) -> Readings:
    def scale(x: Array) -> Array:
        y = x.copy()
        y[i] *= factor
        return y

    motions = tuple(replace(m, **{field: scale(getattr(m, field))}) for m in readings.motions)
    return replace(readings, **{field: scale(getattr(readings, field))}, motions=motions)


def _shifted(readings: Readings, field: str, i: int, by: float) -> Readings:
    value = getattr(readings, field).copy()
    value[i] += by
    return replace(readings, **{field: value})
