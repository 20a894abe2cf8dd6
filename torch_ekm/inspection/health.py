"""Which actuator of a hand changed, by how much and since when: from the motions in its logs."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np

from .._noise import NOISE
from .._warnings import warn
from ..description import HandDescription
from ..estimation.filters import update
from ..exceptions import StateError
from ..kinematics import ServoModel
from ..plant import PlantStatus, Trajectory
from ..typing import Array

_DEG = math.pi / 180
BASELINE = 12  # motions before an actuator is judged
_DRIFT, _ALARM = 1.5, 18.0  # of the sum of z^2 / 2: taken off at each motion; what is a change
_GAVE = 5.0  # [deg] a tendon that gives more in one motion does not hold
_WORTH = 5.0  # motions: the first guess of the noise
_PRIORS = {  # before the first motion: figures, their standard deviations, that of the noise [rad]
    "tendon": ((0.7,), (0.4,), NOISE.tendon),
    "servo": ((0.0, 0.0), (NOISE.dead_zone, NOISE.bias), NOISE.servo),
}


class HealthChange(NamedTuple):
    """An actuator that is not what it was."""

    actuator: str
    part: str
    """"tendon" or "servo"."""
    trial: int
    motion: int
    """The first with the change, counted in its trial from 0."""
    found: str
    """By how much."""


def hand_health(hand: HandDescription, trials: Iterable[tuple[int, Trajectory]]) -> list[HealthChange]:
    """``J_a dq = g da`` of each tendon, ``|v| - |w| = d - sign(v) b`` of each servo: learned, and watched.

    Any motions will do, with the joints measured. What does not fit is summed up (CUSUM: Page, Continuous
    Inspection Schemes, 1954); the actuator with the largest sum has changed when that is too large. One
    motion is not enough: the next takes it back where a sensor was once read wrongly. What the last motion of
    the logs alone says is named as unconfirmed. When the object is lost all tendons give way: of this motion
    only what exceeds twice any other's counts. The first 12 motions of an actuator, and those after a change,
    are its baseline.

    A tendon whose joints were never measured is named in a warning.

    Args:
        hand: its description.
        trials: number and log, in order.

    Raises:
        StateError: a log is of another hand.
    """
    names = hand.actuator_names
    watches = {(name, part): _Watch(part) for name in names for part in _PRIORS}
    changes: list[tuple[str, _Watch, _Watch]] = []
    off, read = [], set()  # errors of the tendons, and those whose joints were measured
    for at, lost, motion in _motions(hand, trials):
        off = [abs(watches[name, "tendon"].error(*motion[name, "tendon"][:2])) for name in names]
        read |= {name for name, one in zip(names, off, strict=True) if math.isfinite(one)}
        for (name, part), (x, y, stood) in motion.items():
            others = [one for one, other in zip(off, names, strict=True) if other != name]
            excused = 2 * max(others, default=0.0) if lost and part == "tendon" else 0.0
            watches[name, part].see(at, x, y, stood, excused)
        (name, part), worst = max(watches.items(), key=lambda one: one[1].sum)
        if worst.sum > _ALARM and len(worst.misfits) > 1:
            watches[name, part] = after = _Watch(part)
            for _, x, y in worst.misfits[part == "tendon" :]:  # the first motion is that of the break
                after.learn(x, y)
            changes.append((name, worst, after))
            for watch in watches.values():  # what one gives way to shows at others
                watch.sum, watch.misfits = 0.0, []
    changes += [(name, one, _Watch(part)) for (name, part), one in watches.items() if one.sum > _ALARM]
    if off and (unread := [name for name in names if name not in read]):
        warn(f"joints of {', '.join(unread)} were never read: nothing is known of what they pass on")
    return [HealthChange(name, old.part, *old.misfits[0][0], old.against(new)) for name, old, new in changes]


def _motions(
    hand: HandDescription, trials: Iterable[tuple[int, Trajectory]]
) -> Iterator[tuple[tuple[int, int], bool, dict[tuple[str, str], tuple[Array, float, bool]]]]:
    """(trial, motion); whether the object was lost; of tendons and servos x, y, whether the motor stood."""
    low, high = hand.actuator_lower + _DEG, hand.actuator_upper - _DEG
    for trial, log in trials:
        if not log.commands:
            continue
        a, q = (np.stack([getattr(one, name).numpy() for one in log.observations]) for name in "aq")
        if (q.shape[1], a.shape[1]) != (hand.n_q, hand.n_a):
            ours = f"'{hand.name}' has {hand.n_q} and {hand.n_a}"
            raise StateError(f"trial {trial} is of {q.shape[1]} joints and {a.shape[1]} actuators, {ours}")
        v, w = np.stack([one.numpy() for one in log.commands]), np.diff(a, axis=0)
        silent, s = ~np.isfinite(q), np.sign(v)  # a joint that is not read says nothing of its own tendons
        away = hand.unloaded(np.where(silent, 0.0, q))
        away[silent @ (hand.actuation_jacobian != 0).T] = np.nan
        pulled = np.diff(away, axis=0)
        moved = (np.abs(v) > ServoModel.resolution) & (a[1:] > low) & (a[1:] < high)
        held = [one.status is not PlantStatus.LOST for one in log.observations]
        for k in range(len(v)):
            motion = {}
            for i, name in enumerate(hand.actuator_names):
                stood = bool(abs(w[k, i]) <= ServoModel.moved_from)
                motion[name, "tendon"] = w[k, [i]], float(pulled[k, i]), stood
                if moved[k, i]:
                    x = np.array([1.0, -s[k, i]])
                    motion[name, "servo"] = x, float(s[k, i] * (v[k, i] - w[k, i])), stood
            yield (trial, k), held[k] and not held[k + 1], motion


class _Watch:
    """``y = theta.x + noise`` by recursive least squares, and the sum of what does not fit."""

    def __init__(self, part: str) -> None:
        theta, std, noise = _PRIORS[part]
        self.part, self.theta, self.P = part, np.array(theta), np.diag(np.square(std)) / noise**2
        self.count, self.weight, self.squares = 0, _WORTH, _WORTH * noise**2
        self.sum = 0.0
        self.misfits: list[tuple[tuple[int, int], Array, float]] = []
        """Motions since the sum was 0."""

    def error(self, x: Array, y: float) -> float:
        return y - float(self.theta @ x)

    def learn(self, x: Array, y: float) -> None:
        error, spread, noise = self.error(x, y), 1 + float(x @ self.P @ x), self.squares / self.weight
        self.theta, self.P = update(self.theta, self.P, np.array([error]), x[None], np.ones(1))
        self.squares += min(error**2 / spread, NOISE.outlier**2 * noise)
        self.weight, self.count = self.weight + 1, self.count + 1

    def see(self, at: tuple[int, int], x: Array, y: float, stood: bool, excused: float) -> None:
        """Judge a motion and learn from it; errors up to ``excused`` are none."""
        error = self.error(x, y)
        bound = self.part == "servo" and stood and (error < 0 or self.count < BASELINE)
        if not math.isfinite(error * error) or bound:
            return  # nothing was read; a motor that stands within its dead zone does not show how wide it is
        z2 = self._z2(x, y, excused)
        if self.count >= BASELINE:
            self._sum_up(at, x, y, z2)
        # figures of a servo may be far from usual, what a tendon passes on may not
        usual = z2 < NOISE.outlier**2 or (self.count < BASELINE and self.part == "servo")
        if not excused and usual:
            self.learn(x, y)

    def _z2(self, x: Array, y: float, excused: float = 0.0) -> float:
        spread = 1 + float(x @ self.P @ x)
        return max(0.0, abs(self.error(x, y)) - excused) ** 2 / (self.squares / self.weight * spread)

    def _sum_up(self, at: tuple[int, int], x: Array, y: float, z2: float) -> None:
        trial, motion = at
        if self.misfits:
            before, x_before, y_before = self.misfits[-1]
            if before == (trial, motion - 1) and self._taken_back((x_before, y_before), (x, y)):
                self.sum = min(self.sum, _ALARM / 2)
                return
            if before[0] != trial and len(self.misfits) == 1:  # nobody saw whether it stayed
                self.sum = min(self.sum, _ALARM / 2)
        added = z2 / 2 - _DRIFT
        if added > _ALARM and self.sum < _ALARM / 2:
            self.sum, self.misfits = (added if motion else _ALARM / 2), [(at, x, y)]
        else:
            self.sum = max(0.0, self.sum + added)
            self.misfits = [*self.misfits, (at, x, y)] if self.sum else []

    def _taken_back(self, *motions: tuple[Array, float]) -> bool:
        """Two outliers that one wrong reading in between explains, and no figures that any hand has."""
        x, error = np.stack([one[0] for one in motions]), np.array([self.error(*one) for one in motions])
        other = error @ np.linalg.solve(np.eye(2) + x @ _Watch(self.part).P @ x.T, error)
        unexplained = min(*(self._z2(*one) for one in motions), other * self.weight / self.squares)
        return self._z2(x.sum(0), sum(y for _, y in motions)) < NOISE.outlier**2 < unexplained

    def against(self, new: _Watch) -> str:
        """What changed, in words."""
        was, now = self.theta, new.theta
        std = np.sqrt(new.squares / new.weight * np.diag(new.P))
        if len(self.misfits) == 1:
            off = self.error(*self.misfits[0][1:]) / _DEG
            return f"{off:.1f} deg off in the last motion: another must confirm it"
        if self.part == "servo":
            both = zip(("dead zone", "bias"), now / _DEG, std / _DEG, was / _DEG, strict=True)
            return "; ".join(f"{name} {x:.2f} +-{s:.2f} deg, was {y:.2f}" for name, x, s, y in both)
        gave = self.error(*self.misfits[0][1:]) / _DEG
        gone = abs(gave) > _GAVE or now[0] < was[0] / 2
        word = ": broken, slipped, or off its pulley" if gone else ""
        share = f"{now[0]:.2f} +-{std[0]:.2f} of its motor's motions, was {was[0]:.2f}"
        return f"its joints went {gave:.1f} deg by themselves; it passes on {share}{word}"
