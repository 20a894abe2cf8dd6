"""What a motion shows of the sensors: each reading may be true alone, and together they cannot be."""

from __future__ import annotations

import contextlib
import math
from typing import TYPE_CHECKING

import numpy as np
import torch

from ..._noise import DEGREE, NOISE
from ...exceptions import GraspError
from ...model import ModelStatus
from ...plant import Observation
from ...typing import Array, Tensor
from ..decision import Decision, Expectation
from .guards import Objection, check, deg
from .readings import AGAINST, ReadingTests

if TYPE_CHECKING:
    from ...model import KinematicModel, Linearization
    from ..knowledge import HandKnowledge

_SURPRISE = 3.0  # [N] above the model: joints and springs are asked; a pad that reads none of it is dead
_JOINT_STD = 0.75  # [N] of a normal force by joints and springs alone, beside its share
_SCALE = 1.75  # between all fingertips and joints and springs: used hands come to 1.5
_NOTHING = 5.0  # so many times more: joints without springs behind rigid motors say nothing of forces
_WEAK = 0.75  # of what it should bear, that a finger lacks with which nothing is turned
_NOWHERE = 0.5 * DEGREE  # an encoder moves less in a motion in which its motor is sent nowhere
# e = alpha w + beta + noise of what the joints leave of an encoder's motion w: beta is its drift
_DRIFT_STD, _REST_STD = 2.0 * DEGREE, 0.4 * DEGREE  # of beta; noise, a first guess
_GUESS, _FEWEST = 4, 6  # that is worth so many motions; and with fewer nothing is said
_SURE = 6.0  # standard deviations from which it is called one, if it is as large as the noise in each motion
_BOTH = 1.5  # a servo's bias of twice what servos have that says the same makes it as much surer
_OFFSETS = torch.arange(-8.0, 8.1, 0.5, dtype=torch.float64) * DEGREE  # of all joints, that are tried
_GAP = 2e-3  # [m] rms of the pads' distances from the object, from which they are suspicious
_CLOSES = 0.4  # share of it that an offset leaves, if it is to blame


class MotionTests:
    """Fingertips against joints and springs, encoders against commands, joints and object against encoders,
    joints against the object's surface.

    Args:
        readings: tests and limits of single readings.
        model: f, with the hand.
        knowledge: of the hand.
    """

    def __init__(
        self,
        readings: ReadingTests,
        model: KinematicModel,
        knowledge: HandKnowledge,
    ) -> None:
        self.guards, self.readings, self.hand, self.model = readings.guards, readings, model.hand, model
        self.servo, self.pads = knowledge.servo, [pad.name for pad in model.hand.pads]
        self._least = model.options.forces.normal_std
        held = np.vstack([model.hand.actuation_jacobian, model.hand.coupling.reshape(-1, model.hand.n_q)])
        self._springs = bool(np.linalg.matrix_rank(held) < model.hand.n_q)
        self._usual = knowledge.forces.usual
        self.times: float | None = None
        """The same in this grasp, before its grip has changed; None: joints and springs say nothing."""
        self._begun: Observation | None = None
        self._sums = np.zeros((6, model.hand.n_a))  # n, w, w^2, e, w e, e^2 of each actuator
        self._force: Tensor | None = None  # before the first motion
        self._repeats, self._way = np.zeros(len(self.pads), int), np.zeros(len(self.pads))

    def begin(self, seen: Observation) -> None:
        """The reading before the first motion."""
        self._begun = seen

    # -- fingertips ------------------------------------------------------------------------------------------

    def high(self, seen: Observation) -> bool:
        """A fingertip reads more than the ceiling."""
        force = seen.fingertip_force
        return force is not None and bool((force > self.guards.force_ceiling).any())

    def before(self, decision: Decision, seen: Observation, first: bool) -> list[Objection]:
        """Pads that do not measure press too hard, by the model's estimate; fingers bear less than the object
        needs before it turns for the first time, as measured."""
        lin, force, said = decision.linearization, seen.fingertip_force, []
        if first and lin is not None and force is not None and decision.grip is not None:
            rows, _ = self.hand.pad_rows(lin.contacts.finger)
            grip = zip(rows, decision.grip.force.tolist(), decision.grip.least.tolist(), strict=True)
            weak = [
                f"finger '{lin.contacts.finger[i]}' bears {bears:.1f} N of {least:.1f} N"
                for i, bears, least in grip
                if bears < _WEAK * least
            ]
            said += check("weak", len(weak), 0, fingers=", ".join(weak))
        for pad, estimate in ({} if lin is None else self._normal(lin)).items():
            if force is None or float(force[pad]) < self._least:
                said += self._ceiling(pad, estimate, "by the model's estimate")
        return said

    def fingertips(
        self, before: Observation, decision: Decision, seen: Observation
    ) -> tuple[Tensor | None, list[Objection]]:
        """Forces that are believed after a motion [N], 0 of a pad at fault; and what is found."""
        force, taken, most = seen.fingertip_force, seen.taken.fingertips, self.guards.max_age.fingertips
        if force is None:
            return None, []
        if seen.dated and before.dated and not (taken > before.time and abs(seen.time - taken) <= most):
            return None, check("late", 1, 0, taken=taken)
        lin, ceiling = decision.linearization, self.guards.force_ceiling
        said, read = [], force.tolist()
        # before the first motion: then no grip by wrong pads has changed the forces
        doubts = () if lin is None else lin.doubts
        if self._force is None or any(doubt.kind is ModelStatus.UNEXPLAINED_TORQUE for doubt in doubts):
            said += self._scale(seen, force)
        expected = {} if lin is None else self._normal(lin)
        repeats = self._frozen(force, float((seen.a - before.a).abs().max()))
        faults = {i: f"reads {read[i]:.2f} N again and again" for i in repeats if i in expected}
        # above the ceiling, or far above what the model had before the motion
        usual = [min(ceiling, expected.get(i, math.inf) + _SURPRISE) for i in range(len(read))]
        high = [i for i, most in enumerate(usual) if i not in faults and read[i] > most]
        alone = self._by_joints(seen) if high else {}
        for i in high:
            other = alone.get(i)
            if other is not None and self._contradicts(read[i], other):
                faults[i] = f"reads {read[i]:.2f} N, joints and springs give {other:.2f} N"
            else:
                said += self._ceiling(i, read[i], "as measured")
        wrong = [f"fingertip '{self.pads[i]}' {problem}" for i, problem in sorted(faults.items())]
        several = self.guards.faulty_pads
        said += check("several at fault", len(faults), several, said="; ".join(wrong))
        wrong += [
            f"fingertip '{self.pads[i]}' reads {read[i]:.2f} N, the model predicts {other:.2f} N"
            for i, other in expected.items()
            if other > _SURPRISE and read[i] < self._least
        ]
        said += check("at fault", len(wrong), 0, said="; ".join(wrong))
        if faults:
            force = force.clone()
            force[list(faults)] = 0.0
        return force, said

    def _ceiling(self, pad: int, force: float, how: str) -> list[Objection]:
        return check("ceiling", force, self.guards.force_ceiling, name=self.pads[pad], how=how)

    def _scale(self, seen: Observation, force: Tensor) -> list[Objection]:
        """All fingertips together read much more or less than joints and springs give: than they do on this
        hand, or, where none of its grasps is known, than described."""
        alone = {i: other for i, other in self._by_joints(seen).items() if force[i] > self._least}
        measured, other = float(force[list(alone)].sum()), sum(alone.values())
        if len(alone) < 2 or other < measured / _NOTHING:
            return []
        self.times = measured / other if self.times is None else self.times
        usual = 1.0 if self._usual is None else self._usual
        plain = measured / _SCALE < usual * other < measured * _SCALE
        test = "first scale" if self._usual is None else "scale"
        words = {"measured": measured, "other": other, "scale": _SCALE, "times": usual}
        return check(test, not plain, 0, **words)

    def _frozen(self, force: Tensor, moved: float) -> list[int]:
        """Pads that read the same again and again while the encoders move."""
        read, last = force.numpy(), 0.0 if self._force is None else self._force.numpy()
        same = (read >= self._least) & (read == last)
        self._repeats, self._way = (self._repeats + 1) * same, (self._way + moved) * same
        self._force = force
        found = (self._repeats >= self.guards.fingertip_repeats) & (self._way > self.guards.unchanged)
        return np.flatnonzero(found).tolist()

    def _by_joints(self, seen: Observation) -> dict[int, float]:
        """Normal force of each pad in contact by joints and springs alone [N]; empty: unknown, as where
        motors and couplings hold every joint."""
        if not self._springs:
            return {}
        try:
            return self._normal(self.model.linearize(seen.state))
        except GraspError:
            return {}

    def _normal(self, lin: Linearization) -> dict[int, float]:
        rows, pads = self.hand.pad_rows(lin.contacts.finger)
        return dict(zip(pads, lin.forces.normal[rows].tolist(), strict=True)) if lin.forces.solved else {}

    def _contradicts(self, force: float, expected: float) -> bool:
        variance = self._least**2 + _JOINT_STD**2 + (NOISE.force_share * expected) ** 2
        return (force - expected) ** 2 > self.guards.gate**2 * variance

    # -- encoders, joints and object -------------------------------------------------------------------------

    def motion(
        self, before: Observation, sent: Tensor, seen: Observation, expected: Expectation | None
    ) -> list[Objection]:
        """Encoders that drift, and joints and object that go another way than the encoders."""
        names, moved = self.hand.actuator_names, (seen.a - before.a).where(sent == 0, 0.0)
        i = int(moved.abs().argmax())
        words = {"went": float(moved[i]), "most": _NOWHERE}
        said = check("drifts", abs(float(moved[i])), _NOWHERE, words, name=names[i])
        if expected is not None:
            share, sharp = self.readings.share(before, seen, expected.nominal)
            said += check("joints against", -share * (sharp >= self.guards.gate), AGAINST, share=share)
            rate, sure = self._drift(before, seen, expected)
            i = int(abs(sure).argmax())
            large = abs(rate[i]) > _REST_STD
            said += check("drifts as driven", abs(sure[i]) * large, _SURE, {"rate": rate[i]}, name=names[i])
        return said

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
            a, b = ww + variance / NOISE.arm**2, n + variance / _DRIFT_STD**2
            det = a * b - w * w
            alpha, beta = (b * we - w * e) / det, (a * e - w * we) / det
            left = ee - 2 * alpha * we - 2 * beta * e + alpha**2 * ww + 2 * alpha * beta * w + beta**2 * n
            std = np.sqrt(variance * a / det)
            variance = (_GUESS * _REST_STD**2 + left) / (_GUESS + np.maximum(n - 2, 0))
        # joints may be bent by other motors where this one stands
        judged = (n >= _FEWEST) & (ww > n * _REST_STD**2)
        bias = self.servo.bias.numpy()
        surer = np.where((abs(bias) > 2 * NOISE.bias) & (bias * beta > 0), _BOTH, 1.0)
        return beta, np.where(judged, surer * beta / std, 0.0)

    def _bears(self, lin: Linearization) -> bool:
        """A link without a pad, or a stop: the joints do not follow the encoders as described."""
        rows, _ = self.hand.pad_rows(lin.contacts.finger)
        return len(rows) < len(lin.contacts.finger) or bool(lin.held_joints.any())

    # -- which sensors contradict each other -----------------------------------------------------------------

    @property
    def agreed(self) -> bool:
        """Joints, pads and object did, before the first motion."""
        return self._begun is not None and self.on_surface(self._begun)

    def suspects(self, seen: Observation) -> str:
        """Which sensors contradict each other where the model refuses a state."""
        hand, said = self.hand, self._offset(seen)
        off, way = self._stretch(seen), seen.a.numpy() - hand.actuator_offset
        if self._begun is not None and not torch.equal(self._begun.a, seen.a):  # since the beginning
            off, way = off - self._stretch(self._begun), (seen.a - self._begun.a).numpy()
        # tendons stretch by less, and moment arms that are not as described change it by a share of the way
        most = NOISE.outlier * NOISE.encoder + NOISE.arm * abs(way)
        i = int((abs(off) - most).argmax())
        if abs(off[i]) > most[i]:
            joints = zip(hand.joint_names, hand.actuation_jacobian[i], strict=True)
            names = ", ".join(name for name, arm in joints if arm)
            said += f"; encoder '{hand.actuator_names[i]}' and its joints ({names}) differ by {deg(off[i])}"
        with contextlib.suppress(GraspError):
            touching = self.model.touching(seen.state).finger
            away = ", ".join(name for name in self._pressed(seen) or [] if name not in touching)
            if away:
                said += f"; fingertips press ({away}) where pose and joints have them off the object"
        return said and f"{said}: check these sensors, and the pose"

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
            f"; the pads that press are {far} the object's surface (limit {1e3 * _GAP:g} mm), and would be "
            f"{1e3 * gaps[at]:.1f} mm off it if all joints read {deg(-_OFFSETS[at])} too much: check the "
            "joints' zero"
        )

    def on_surface(self, seen: Observation) -> bool:
        """The pads that press lie on the object, as joints and pose have them."""
        return self._distance(seen) <= _GAP

    def _pressed(self, seen: Observation) -> list[str] | None:
        """Pads that hold the object, as measured."""
        if seen.fingertip_force is None:
            return None
        return [name for name, f in zip(self.pads, seen.fingertip_force, strict=True) if f > NOISE.pressing]

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
