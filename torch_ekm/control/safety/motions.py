"""What a motion shows of the sensors: each reading may be true alone, and together they cannot be."""

from __future__ import annotations

import contextlib
import math

import numpy as np
import torch

from ..._noise import DEGREE, NOISE
from ...exceptions import GraspError
from ...model import KinematicModel, Linearization
from ...plant import Observation
from ...typing import Array, Tensor
from ..decision import Expectation, StopReason
from .guards import Effect, Objection, against, deg
from .readings import AGAINST, CHECK_PLANT, ReadingTests

_NOWHERE = 0.5 * DEGREE  # an encoder moves less in a motion in which its motor is sent nowhere
# e = alpha w + beta + noise of what the joints leave of an encoder's motion w: beta is its drift
_DRIFT_STD, _REST_STD = 2.0 * DEGREE, 0.4 * DEGREE  # of beta; noise, a first guess
_GUESS, _FEWEST = 4, 6  # that is worth so many motions; and with fewer nothing is said
_SURE = 6.0  # standard deviations from which it is called one, if it is as large as the noise in each motion
_OFFSETS = torch.arange(-8.0, 8.1, 0.5, dtype=torch.float64) * DEGREE  # of all joints, that are tried
_GAP = 2e-3  # [m] rms of the pads' distances from the object, from which they are suspicious
_CLOSES = 0.4  # share of it that an offset leaves, if it is to blame
_MAGNET = "it drifts, or slips; check its magnet and cable"


class MotionTests:
    """Encoders against commands and joints, joints and object against encoders, joints against the object's
    surface; of one manipulation.

    Args:
        readings: tests of single readings.
        model: f, with the hand.
    """

    def __init__(self, readings: ReadingTests, model: KinematicModel) -> None:
        self.guards, self.readings, self.hand, self.model = readings.guards, readings, model.hand, model
        self._begun: Observation | None = None
        self._sums = np.zeros((6, model.hand.n_a))  # n, w, w^2, e, w e, e^2 of each actuator

    def begin(self, seen: Observation) -> None:
        """The reading before the first motion."""
        self._begun = seen

    def after(
        self, before: Observation, sent: Tensor, seen: Observation, expected: Expectation | None
    ) -> list[Objection]:
        """Encoders that drift, and joints and object that go another way than the encoders."""
        names, moved = self.hand.actuator_names, (seen.a - before.a).where(sent == 0, 0.0)
        i = int(moved.abs().argmax())
        drifts = f"encoder '{names[i]}' went {deg(moved[i])} though its motor was sent nowhere (limit "
        drifts += f"{deg(_NOWHERE)}): {_MAGNET}"
        reason, wrong = StopReason.ENCODER_DRIFT, float(moved[i].abs()) > _NOWHERE
        said = against(wrong, reason, drifts, Effect.LIES, running=3)
        if expected is None:
            return said
        rate, sure = self._drift(before, seen, expected)
        i = int(abs(sure).argmax())
        drifts = (
            f"encoder '{names[i]}' went {deg(rate[i])} more than its joints in each motion, whichever way "
        )
        drifts += f"({abs(sure[i]):.1f} standard deviations, limit {_SURE:g}): {_MAGNET}"
        said += against(abs(sure[i]) > _SURE, reason, drifts, Effect.LIES, running=1)
        share, sharp = self.readings.share(before, seen, expected.nominal)
        back = f"joints and object made {share:.1f} of the motion that the encoders' motion predicts (limit "
        back += (
            f"-{AGAINST:g}): a sign of motors, encoders or joints is wrong, or the pose is in another frame; "
        )
        back += CHECK_PLANT
        wrong = -share > AGAINST and sharp >= self.guards.gate
        return said + against(wrong, StopReason.WRONG_WAY, back, Effect.UNLEARNED, running=2)

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
        a, b = ww + (_REST_STD / NOISE.arm) ** 2, n + (_REST_STD / _DRIFT_STD) ** 2
        det = a * b - w * w
        alpha, beta = (b * we - w * e) / det, (a * e - w * we) / det
        left = ee - 2 * alpha * we - 2 * beta * e + alpha**2 * ww + 2 * alpha * beta * w + beta**2 * n
        variance = (_GUESS * _REST_STD**2 + left) / (_GUESS + np.maximum(n - 2, 0))
        # joints may be bent by other motors where this one stands
        judged = (n >= _FEWEST) & (ww > n * _REST_STD**2) & (abs(beta) > _REST_STD)
        return beta, np.where(judged, beta / np.sqrt(variance * a / det), 0.0)

    def _bears(self, lin: Linearization) -> bool:
        """A link without a pad, or a stop: the joints do not follow the encoders as described."""
        rows, _ = self.hand.pad_rows(lin.contacts.finger)
        return len(rows) < len(lin.contacts.finger) or bool(lin.held_joints.any())

    @property
    def agreed(self) -> bool:
        """Joints, pads and object did, before the first motion."""
        return self._begun is not None and self.on_surface(self._begun)

    def suspects(self, seen: Observation) -> str:
        """Which sensors contradict each other where the model refuses a state."""
        said = self._offset(seen), self._differs(seen), self._off_surface(seen)
        found = "; ".join(filter(None, said))
        return found and f"{found}: check these sensors, and the pose"

    def _differs(self, seen: Observation) -> str:
        """Which encoder and its joints have come apart since the beginning, farther than tendons stretch and
        moment arms that are not as described explain; empty: none."""
        hand = self.hand
        off, way = self._stretch(seen), seen.a.numpy() - hand.actuator_offset
        if self._begun is not None and not torch.equal(self._begun.a, seen.a):
            off, way = off - self._stretch(self._begun), (seen.a - self._begun.a).numpy()
        most = NOISE.outlier * NOISE.encoder + NOISE.arm * abs(way)
        i = int((abs(off) - most).argmax())
        if abs(off[i]) <= most[i]:
            return ""
        joints = zip(hand.joint_names, hand.actuation_jacobian[i], strict=True)
        names = ", ".join(name for name, arm in joints if arm)
        apart = f"encoder '{hand.actuator_names[i]}' and its joints ({names}) differ by {deg(off[i])}"
        return f"{apart} (limit {deg(most[i])})"

    def _stretch(self, seen: Observation) -> Array:
        """``a - a_0 - l(q)`` [rad]."""
        return seen.a.numpy() - self.hand.unloaded(seen.q.numpy())

    def _offset(self, seen: Observation) -> str:
        """All joints together are off by an angle that brings the pads back to the object's surface."""
        gaps, here = [self._distance(seen, float(c)) for c in _OFFSETS], self._distance(seen)
        at = min(range(len(gaps)), key=gaps.__getitem__)
        if not (here > _GAP and gaps[at] < _CLOSES * here and abs(_OFFSETS[at]) >= 3 * NOISE.joint):
            return ""
        far = "far from" if math.isinf(here) else f"{1e3 * here:.1f} mm off"
        return (
            f"the pads that press are {far} the object's surface (limit {1e3 * _GAP:g} mm), and would be "
            f"{1e3 * gaps[at]:.1f} mm off it if all joints read {deg(-_OFFSETS[at])} too much: check the "
            "joints' zero"
        )

    def _off_surface(self, seen: Observation) -> str:
        with contextlib.suppress(GraspError):
            touching = self.model.touching(seen.state).finger
            if away := [name for name in self._pressed(seen) or [] if name not in touching]:
                return f"fingertips press ({', '.join(away)}) where pose and joints have them off the object"
        return ""

    def closest(self, seen: Observation) -> float:
        """How far the pads that press are from the surface, rms, if all joints are off by what brings them
        closest [m]."""
        return min(self._distance(seen, float(c)) for c in _OFFSETS)

    def on_surface(self, seen: Observation) -> bool:
        """The pads that press lie on the object, as joints and pose have them."""
        return self._distance(seen) <= _GAP

    def _pressed(self, seen: Observation) -> list[str] | None:
        """Pads that hold the object, as measured."""
        if seen.fingertip_force is None:
            return None
        pads = zip(self.hand.pads, seen.fingertip_force, strict=True)
        return [pad.name for pad, f in pads if f > NOISE.pressing]

    def _distance(self, seen: Observation, offset: float = 0.0) -> float:
        """Of the pads that press from the object's surface, rms, if all joints were off by an offset [m];
        infinite: one of them is far from it."""
        moves = torch.from_numpy(self.hand.joint_upper > self.hand.joint_lower)
        try:
            near = self.model.detector(seen.q + offset * moves, seen.position, seen.rotation)
        except GraspError:
            return math.inf
        gap, names = dict(zip(near.finger, near.gap.tolist(), strict=True)), self._pressed(seen)
        names = list(gap) if names is None else names
        if len(names) < 2 or not gap.keys() >= set(names):
            return math.inf
        return math.sqrt(sum(gap[name] ** 2 for name in names) / len(names))
