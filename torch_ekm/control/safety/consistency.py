"""Sensors that lie: each reading may be true alone, and together they cannot be."""

from __future__ import annotations

import contextlib
import math
from collections import Counter
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch

from ...exceptions import GraspError
from ...kinematics import ServoModel
from ...kinematics.servo_model import IdealServos
from ...plant import Observation
from ...typing import Array, Tensor
from ..decision import Expectation, StopReason
from .readings import ReadingTests, deg
from .safety import Objection

if TYPE_CHECKING:
    from ...model import KinematicModel, Linearization

_DEG = math.pi / 180
_NOWHERE = 0.5 * _DEG  # an encoder moves less in a motion in which its motor is sent nowhere
# e = alpha w + beta + noise of what the joints leave of an encoder's motion w: beta is its drift
_ARM_STD, _DRIFT_STD, _REST_STD = 0.3, 2.0 * _DEG, 0.4 * _DEG  # of alpha, beta; noise, a first guess
_GUESS, _FEWEST = 4, 6  # that is worth so many motions; and with fewer nothing is said
_DRIFTS, _SURE = 0.4 * _DEG, 6.0  # [rad] a motion, and standard deviations, from which it is called one
_BIAS, _BOTH = 0.6 * _DEG, 1.5  # a servo's bias of this size that says the same makes it as much surer
_AGAINST = -0.3  # share of a predicted motion that is none of it; healthy hands make .4 of it and more
_SHARP = 4.0  # standard deviations of a motion that is large enough to be judged
_STRETCH = 12 * _DEG  # tendons stretch by less
_ARMS = 0.35  # and moment arms that are not as described change it by this share of the way
_OFFSETS = torch.arange(-8.0, 8.1, 0.5, dtype=torch.float64) * _DEG  # of all joints, that are tried
_LEAST = 1.5 * _DEG  # of them that is worth a word
_GAP = 2e-3  # [m] rms of the pads' distances from the object, from which they are suspicious
_CLOSES = 0.4  # share of it that an offset leaves, if it is to blame


class Row(NamedTuple):
    """Of the table: a figure beyond its limit is told and not learned from; ``ends`` motions running
    end the manipulation."""

    figure: float
    limit: float
    ends: int
    reason: StopReason
    message: str
    encoders: bool
    """Nothing is learned of the servos either."""


class Consistency:
    """Encoders against commands, joints and object against encoders, joints against the object's surface.

    Args:
        readings: tests and limits of single readings.
        model: f, with the hand.
        servo: what is known of the servos.
    """

    def __init__(
        self, readings: ReadingTests, model: KinematicModel, servo: ServoModel | IdealServos
    ) -> None:
        self.readings, self.hand, self.model, self.servo = readings, model.hand, model, servo
        self._running: Counter[str] = Counter()
        self._begun: Observation | None = None
        self._sums = np.zeros((6, model.hand.n_a))  # n, w, w^2, e, w e, e^2 of each actuator

    def begin(self, seen: Observation) -> None:
        """The reading before the first motion."""
        self._begun = seen

    def motion(
        self,
        before: Observation,
        sent: Tensor,
        seen: Observation,
        expected: Expectation | None,
    ) -> tuple[Row | None, Objection | None]:
        """The row that objects to a motion, if any; and why the manipulation ends by it, if it does."""
        found, halt = None, None
        for name, test in self._tests(before, sent, seen, expected).items():
            self._running[name] = self._running[name] + 1 if test.figure > test.limit else 0
            if self._running[name]:
                found = test
            if self._running[name] >= test.ends:
                halt = Objection(test.reason, f"{test.message} (motions running: {self._running[name]})")
        return found, halt

    def _tests(
        self,
        before: Observation,
        sent: Tensor,
        seen: Observation,
        expected: Expectation | None,
    ) -> dict[str, Row]:
        moved = (seen.a - before.a).where(sent == 0, 0.0)
        i = int(moved.abs().argmax())
        tests = {
            "drift": Row(
                float(moved.abs().max()), _NOWHERE, 3, StopReason.ENCODER_DRIFT,
                f"encoder '{self.hand.actuator_names[i]}' went {deg(moved[i])} though its motor was sent "
                f"nowhere (limit {deg(_NOWHERE)}): it drifts, or slips; check its magnet and cable",
                True,
            )
        }  # fmt: skip
        if expected is not None:
            share, sharp = self.readings.share(before, seen, expected.nominal)
            tests["sign"] = Row(
                -share * (sharp >= _SHARP), -_AGAINST, 2, StopReason.WRONG_WAY,
                f"joints and object made {share:.1f} of the motion that the encoders' motion predicts (limit "
                f"{_AGAINST:g}): a sign of the motors, of their encoders or of the joints is wrong; see "
                "'torch-ekm check --plant'",
                False,
            )  # fmt: skip
            rate, sure = self._drift(before, seen, expected)
            i = int(abs(sure).argmax())
            tests["driven"] = Row(
                float(abs(sure[i]) * (abs(rate[i]) > _DRIFTS)), _SURE, 1, StopReason.ENCODER_DRIFT,
                f"encoder '{self.hand.actuator_names[i]}' went {deg(rate[i])} more than its joints in each "
                f"motion, whichever way ({abs(sure[i]):.1f} standard deviations, more where its servo "
                f"agrees, limit {_SURE:g}): it drifts, or slips; check its magnet and cable",
                True,
            )  # fmt: skip
        return tests

    def _drift(self, before: Observation, seen: Observation, expected: Expectation) -> tuple[Array, Array]:
        """beta of each actuator [rad], and its size in standard deviations, by Bayesian least squares on what
        the hand as described predicts: what is learned of it changes meanwhile."""
        n_q, w = self.hand.n_q, expected.moved.numpy()
        came = seen.state.minus(before.state)
        J_a = self.hand.lengths.jacobian(before.q.numpy(), self.hand.actuation_jacobian)
        e = J_a @ (expected.described - came).numpy()[:n_q]
        # where links bear or pads are off the object, joints do not do what is described
        if self.on_surface(before) and not any(self._bears(one.linearization) for one in expected.pieces):
            self._sums += np.stack([np.ones_like(w), w, w * w, e, w * e, e * e])
        n, w, ww, e, we, ee = self._sums
        beta, std, variance = 0 * n, 0 * n, np.full_like(n, _REST_STD**2)
        for _ in range(2):  # the second time with the noise that the first one leaves
            a, b = ww + variance / _ARM_STD**2, n + variance / _DRIFT_STD**2
            det = a * b - w * w
            alpha, beta = (b * we - w * e) / det, (a * e - w * we) / det
            left = ee - 2 * alpha * we - 2 * beta * e + alpha**2 * ww + 2 * alpha * beta * w + beta**2 * n
            std = np.sqrt(variance * a / det)
            variance = (_GUESS * _REST_STD**2 + left) / (_GUESS + np.maximum(n - 2, 0))
        # joints may be bent by other motors where this one stands
        judged = (n >= _FEWEST) & (ww > n * _DRIFTS**2)
        bias = self.servo.bias.numpy()
        surer = np.where((abs(bias) > _BIAS) & (bias * beta > 0), _BOTH, 1.0)
        return beta, np.where(judged, surer * beta / std, 0.0)

    def _bears(self, lin: Linearization) -> bool:
        """A link without a pad, or a stop: the joints do not follow the encoders as described."""
        rows, _ = self.hand.pad_rows(lin.contacts.finger)
        return len(rows) < len(lin.contacts.finger) or bool(lin.held_joints.any())

    def suspects(self, seen: Observation) -> str:
        """Which sensors contradict each other where the model refuses a state."""
        hand, found = self.hand, self._offset(seen)
        off, way = self._stretch(seen), seen.a.numpy() - hand.actuator_offset
        if self._begun is not None and not torch.equal(self._begun.a, seen.a):  # since the beginning
            off, way = off - self._stretch(self._begun), (seen.a - self._begun.a).numpy()
        most = _STRETCH + _ARMS * abs(way)
        i = int((abs(off) - most).argmax())
        if abs(off[i]) > most[i]:
            joints = zip(hand.joint_names, hand.actuation_jacobian[i], strict=True)
            names = ", ".join(name for name, arm in joints if arm)
            found += f"; encoder '{hand.actuator_names[i]}' and its joints ({names}) differ by {deg(off[i])}"
        force = seen.fingertip_force
        with contextlib.suppress(GraspError):
            touching = self.model.touching(seen.state).finger
            pressed = (
                [] if force is None else [pad.name for pad, f in zip(hand.pads, force, strict=True) if f > 1]
            )
            away = ", ".join(name for name in pressed if name not in touching)
            if away:
                found += f"; fingertips press ({away}) where pose and joints have them off the object"
        return found and f"{found}: check these sensors, and the pose"

    def _stretch(self, seen: Observation) -> Array:
        """``a - a_0 - l(q)`` [rad]."""
        return seen.a.numpy() - self.hand.unloaded(seen.q.numpy())

    def _offset(self, seen: Observation) -> str:
        """All joints together are off by an angle that brings the pads back to the object's surface."""
        pressed = None if seen.fingertip_force is None else seen.fingertip_force > 1
        gaps = [self._distance(seen, float(c), pressed) for c in _OFFSETS]
        at, here = min(range(len(gaps)), key=gaps.__getitem__), self._distance(seen, 0.0, pressed)
        if not (here > _GAP and gaps[at] < _CLOSES * here and abs(_OFFSETS[at]) >= _LEAST):
            return ""
        far = "far from" if math.isinf(here) else f"{1e3 * here:.1f} mm off"
        return (
            f"; the pads that press are {far} the object's surface (limit {1e3 * _GAP:g} mm), and would be "
            f"{1e3 * gaps[at]:.1f} mm off it if all joints read {deg(-_OFFSETS[at])} too much: check the "
            "joints' zero"
        )

    def on_surface(self, seen: Observation) -> bool:
        """The pads that press lie on the object, as joints and pose have them."""
        pressed = None if seen.fingertip_force is None else seen.fingertip_force > 1
        return self._distance(seen, 0.0, pressed) <= _GAP

    def _distance(self, seen: Observation, offset: float, pressed: Tensor | None) -> float:
        """Of the pads from the object's surface, rms [m]; infinite: one that presses is far from it."""
        moves = torch.from_numpy(self.hand.joint_upper > self.hand.joint_lower)
        try:
            found = self.model.detector(seen.q + offset * moves, seen.position, seen.rotation)
        except GraspError:
            return math.inf
        gap = dict(zip(found.finger, found.gap.tolist(), strict=True))
        names = [pad.name for i, pad in enumerate(self.hand.pads) if pressed is None or pressed[i]]
        if pressed is None:
            names = list(gap)
        if len(names) < 2 or not gap.keys() >= set(names):
            return math.inf
        return math.sqrt(sum(gap[name] ** 2 for name in names) / len(names))
