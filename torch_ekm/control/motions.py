"""What a motion shows of the sensors: each reading may be true alone, and together they cannot be."""

from __future__ import annotations

import contextlib
import math

import numpy as np
import torch

from .._noise import DEGREE, NOISE
from ..exceptions import GraspError
from ..model import KinematicModel, Linearization, ModelStatus
from ..plant import Observation
from ..typing import Array, Tensor
from .decision import Decision, Expectation, StopReason
from .guards import CHECK_PLANT, Effect, Guards, Objection, ReadingTests, against, deg

_NOWHERE = 0.5 * DEGREE  # an encoder moves less in a motion in which its motor is sent nowhere
_AGAINST = 0.3  # share of a motion that is made the other way; healthy hands make .4 of it and more
_OFFSETS = torch.arange(-8.0, 8.1, 0.5, dtype=torch.float64) * DEGREE  # of all joints, that are tried
_GAP = 2e-3  # [m] of a pad from the object, from which it is suspicious
_MAGNET = "it drifts, or slips; check its magnet and cable"
_SURPRISE = 3.0  # [N] above the model: joints and springs are asked; a pad that reads none of it is dead
_JOINT_STD = 0.75  # [N] of a normal force by joints and springs alone, beside its share
_SCALE = 1.75  # between all fingertips and joints and springs: used hands come to 1.5
_NOTHING = 5.0  # so many times more: joints without springs behind rigid motors say nothing of forces
_WEAK = 0.75  # of what it should bear, that a finger lacks with which nothing is turned
_REPEATS = 8  # motions running in which a pad reads the same bit by bit: it is frozen, or saturated
_STANDS_IN = "the model's estimate stands in"
_R, _E = StopReason, Effect


class MotionTests:
    """Encoders against commands and joints, joints and object against encoders, joints against the object's
    surface."""

    def __init__(self, readings: ReadingTests, model: KinematicModel) -> None:
        self.guards, self.readings, self.hand, self.model = readings.guards, readings, model.hand, model
        self._moves = torch.from_numpy(self.hand.joint_upper > self.hand.joint_lower)

    def after(
        self, before: Observation, sent: Tensor, seen: Observation, expected: Expectation
    ) -> list[Objection]:
        """Encoders that drift, and joints and object that go another way than the encoders."""
        names, moved = self.hand.actuator_names, (seen.a - before.a).where((sent == 0).all(0), 0.0)
        i = int(moved.abs().argmax())
        drifts = f"encoder '{names[i]}' went {deg(moved[i])} though its motor was sent nowhere (limit "
        drifts += f"{deg(_NOWHERE)}): {_MAGNET}"
        reason, wrong = StopReason.ENCODER_DRIFT, float(moved[i].abs()) > _NOWHERE
        said = against(wrong, reason, drifts, Effect.LIES, running=3)
        share, sharp = self.readings.share(before, seen, expected.nominal)
        back = f"joints and object made {share:.1f} of the motion that the encoders' motion predicts (limit "
        back += f"-{_AGAINST:g}): a sign of motors, encoders or joints is wrong, or the pose's frame; "
        back += CHECK_PLANT
        wrong = -share > _AGAINST and sharp >= self.guards.gate
        return said + against(wrong, StopReason.WRONG_WAY, back, Effect.UNLEARNED, running=2)

    def suspects(self, seen: Observation, begun: Observation) -> str:
        """Which sensors contradict each other where the model refuses a state; a manipulation has begun with
        another reading."""
        away = ", ".join(name for name, gap in self._gaps(seen).items() if gap > _GAP)
        off = f"fingertips press ({away}) where pose and joints have them off its surface (limit "
        found = "; ".join(filter(None, (self._differs(seen, begun), away and f"{off}{1e3 * _GAP:g} mm)")))
        return found and f"{found}: check these sensors, the joints' zero, and the pose"

    def _differs(self, seen: Observation, begun: Observation) -> str:
        """Which encoder and its joints have come apart since the beginning, farther than tendons stretch and
        moment arms that are not as described explain; empty: none."""
        hand = self.hand
        off, way = self._stretch(seen), seen.a.numpy() - hand.actuator_offset
        if not torch.equal(begun.a, seen.a):
            off, way = off - self._stretch(begun), (seen.a - begun.a).numpy()
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

    def closest(self, seen: Observation) -> float:
        """How far the pads that press are from the surface, rms, if all joints are off by what brings them
        closest [m]; infinite: fewer than two press."""
        tried = [list(self._gaps(seen, float(c)).values()) for c in _OFFSETS]
        return min(math.hypot(*gaps) / math.sqrt(len(gaps)) if len(gaps) > 1 else math.inf for gaps in tried)

    def on_surface(self, seen: Observation) -> bool:
        """The pads that press lie on the object, as joints and pose have them."""
        gaps = self._gaps(seen)
        return len(gaps) > 1 and max(gaps.values()) <= _GAP

    def _gaps(self, seen: Observation, offset: float = 0.0) -> dict[str, float]:
        """Distance of each pad that presses, or else is near, from the object [m], if all joints were off by
        an angle [rad]; infinite: far."""
        gaps: dict[str, float] = {}
        with contextlib.suppress(GraspError):
            near = self.model.detector(seen.q + offset * self._moves, seen.position, seen.rotation)
            gaps = dict(zip(near.finger, near.gap.abs().tolist(), strict=True))
        if seen.fingertip_force is None:
            return gaps
        return {name: gaps.get(name, math.inf) for name in self.model.pressing(seen.fingertip_force)}


class FingertipTests:
    """Of one manipulation. The fingertips of this hand are ``usual`` to read so many times what joints and
    springs give; None: that is unknown."""

    def __init__(self, guards: Guards, model: KinematicModel, usual: float | None) -> None:
        self.guards, self.hand, self.model, self._usual = guards, model.hand, model, usual
        self.pads, self._least = [pad.name for pad in model.hand.pads], model.options.forces.normal_std
        held = np.vstack([model.hand.actuation_jacobian, model.hand.coupling.reshape(-1, model.hand.n_q)])
        self._springs = bool(np.linalg.matrix_rank(held) < model.hand.n_q)
        self.times: float | None = None
        """The same in this grasp, before its grip has changed; None: joints and springs say nothing."""
        self._force: Tensor | None = None  # after the last motion
        self._repeats, self._way = np.zeros(len(self.pads), int), np.zeros(len(self.pads))

    def high(self, seen: Observation) -> bool:
        """A fingertip reads more than the ceiling."""
        force = seen.fingertip_force
        return force is not None and bool((force > self.guards.force_ceiling).any())

    def before(self, decision: Decision, seen: Observation, first: bool) -> list[Objection]:
        """Pads that do not measure press too hard, by the model's estimate; fingers bear less than the object
        needs before it turns for the first time, as measured."""
        lin, force, said = decision.pieces[0].linearization, seen.fingertip_force, []
        if first and force is not None and decision.grip is not None:
            rows, _ = self.hand.pad_rows(lin.contacts.finger)
            grip = zip(rows, decision.grip.force.tolist(), decision.grip.least.tolist(), strict=True)
            weak = ", ".join(
                f"finger '{lin.contacts.finger[i]}' bears {bears:.1f} N of {least:.1f} N"
                for i, bears, least in grip
                if bears < _WEAK * least
            )
            said += against(weak, _R.WEAK_GRASP, weak)
        for pad, estimate in self._normal(lin).items():
            if force is None or float(force[pad]) < self._least:
                said += self._ceiling(pad, estimate, "by the model's estimate")
        return said

    def after(
        self, before: Observation, decision: Decision, seen: Observation
    ) -> tuple[Tensor | None, list[Objection]]:
        """Forces that are used after a motion [N], 0 of a pad at fault; and what is found."""
        force, taken, most = seen.fingertip_force, seen.taken.fingertips, self.guards.max_age.fingertips
        if force is None:
            return None, []
        if seen.dated and before.dated and not (taken > before.time and abs(seen.time - taken) <= most):
            late = f"the fingertips were read at {taken:.3f} s: {_STANDS_IN}"
            return None, [Objection(_R.STALE_SENSOR, late, _E.TOLD)]
        lin, read = decision.pieces[0].linearization, force.tolist()
        # before the first motion: then no grip by wrong pads has changed the forces
        torque = any(d.kind is ModelStatus.UNEXPLAINED_TORQUE for d in lin.doubts)
        said = self._scale(seen, force) if self._force is None or torque else []
        expected = self._normal(lin)
        frozen = self._frozen(force, float((seen.a - before.a).abs().max()))
        faults = {i: f"reads {read[i]:.2f} N again and again" for i in frozen if i in expected}
        # above the ceiling, or far above what the model had before the motion
        usual = [
            min(self.guards.force_ceiling, expected.get(i, math.inf) + _SURPRISE) for i in range(len(read))
        ]
        high = [i for i, most in enumerate(usual) if i not in faults and read[i] > most]
        alone = self._by_joints(seen) if high else {}
        for i in high:
            other = alone.get(i, math.nan)  # which contradicts nothing
            variance = self._least**2 + _JOINT_STD**2 + (NOISE.force_share * other) ** 2
            if (read[i] - other) ** 2 > self.guards.gate**2 * variance:
                faults[i] = f"reads {read[i]:.2f} N, joints and springs give {other:.2f} N"
            else:
                said += self._ceiling(i, read[i], "as measured")
        wrong = "; ".join(f"fingertip '{self.pads[i]}' {problem}" for i, problem in sorted(faults.items()))
        cure = "check range and cable of the fingertips, or those of the joint sensors if several disagree"
        said += against(len(faults) > 1, _R.FINGERTIP_FAULT, f"{wrong} (limit: one): {cure}")
        dead = "; ".join(
            f"fingertip '{self.pads[i]}' reads {read[i]:.2f} N, the model predicts {other:.2f} N"
            for i, other in expected.items()
            if other > _SURPRISE and read[i] < self._least
        )
        told = "; ".join(filter(None, (wrong, dead)))
        said += against(told, _R.FINGERTIP_FAULT, f"{told}: {_STANDS_IN}", _E.TOLD)
        if faults:
            force = force.clone()
            force[list(faults)] = 0.0
        return force, said

    def _ceiling(self, pad: int, force: float, how: str) -> list[Objection]:
        most = self.guards.force_ceiling
        hard = (
            f"fingertip '{self.pads[pad]}' presses with {force:.1f} N {how}, Guards.force_ceiling is {most:g}"
        )
        cure = "free the object, lower GripForceTask.force, or choose a nearer target (ClosedLoop.reach)"
        return against(force > most, _R.FORCE_CEILING, f"{hard} N: {cure}")

    def _scale(self, seen: Observation, force: Tensor) -> list[Objection]:
        """All fingertips together read much more or less than joints and springs give: than they do on this
        hand, or, where none of its grasps is known, than described. That is reported, and learned."""
        alone = {i: other for i, other in self._by_joints(seen).items() if force[i] > self._least}
        measured, other = float(force[list(alone)].sum()), sum(alone.values())
        if len(alone) < 2 or other < measured / _NOTHING:
            return []
        self.times = measured / other if self.times is None else self.times
        usual = 1.0 if self._usual is None else self._usual
        plain = measured / _SCALE < usual * other < measured * _SCALE
        off = f"the fingertips read {measured:.1f} N, joints and springs give {other:.1f} N, expected are "
        off += f"{usual * other:.1f} N ({_SCALE:g} times are allowed): check their scale, and the "
        off += "description's springs"
        return against(not plain, _R.FINGERTIP_FAULT, off, _E.TOLD if self._usual is None else _E.LIES)

    def _frozen(self, force: Tensor, moved: float) -> list[int]:
        """Pads that read the same again and again while the encoders move."""
        read, last = force.numpy(), 0.0 if self._force is None else self._force.numpy()
        same = (read >= self._least) & (read == last)
        self._repeats, self._way = (self._repeats + 1) * same, (self._way + moved) * same
        self._force = force
        return np.flatnonzero((self._repeats >= _REPEATS) & (self._way > self.guards.unchanged)).tolist()

    def _by_joints(self, seen: Observation) -> dict[int, float]:
        """Normal force of each pad in contact by joints and springs alone [N]; empty: unknown, as where
        motors and couplings hold every joint."""
        try:
            return self._normal(self.model.linearize(seen.state)) if self._springs else {}
        except GraspError:
            return {}

    def _normal(self, lin: Linearization) -> dict[int, float]:
        if not lin.forces.solved:
            return {}
        rows, pads = self.hand.pad_rows(lin.contacts.finger)
        return dict(zip(pads, lin.forces.normal[rows].tolist(), strict=True))
