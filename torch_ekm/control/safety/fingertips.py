"""Fingertips against joints and springs, the model, and what a finger may bear."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from ..._noise import NOISE
from ...exceptions import GraspError
from ...model import ModelStatus
from ...plant import Observation
from ...typing import Tensor
from ..decision import Decision, StopReason
from .guards import Effect, Guards, Objection, against

if TYPE_CHECKING:
    from ...model import KinematicModel, Linearization

_SURPRISE = 3.0  # [N] above the model: joints and springs are asked; a pad that reads none of it is dead
_JOINT_STD = 0.75  # [N] of a normal force by joints and springs alone, beside its share
_SCALE = 1.75  # between all fingertips and joints and springs: used hands come to 1.5
_NOTHING = 5.0  # so many times more: joints without springs behind rigid motors say nothing of forces
_WEAK = 0.75  # of what it should bear, that a finger lacks with which nothing is turned
_REPEATS = 8  # motions running in which a pad reads the same bit by bit: it is frozen, or saturated
_STANDS_IN = "the model's estimate stands in"
_R, _E = StopReason, Effect


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
        lin, force, said = decision.linearization, seen.fingertip_force, []
        if first and lin is not None and force is not None and decision.grip is not None:
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
        lin, read = decision.linearization, force.tolist()
        # before the first motion: then no grip by wrong pads has changed the forces
        torque = lin is not None and any(d.kind is ModelStatus.UNEXPLAINED_TORQUE for d in lin.doubts)
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
            other = alone.get(i)
            if other is not None and self._contradicts(read[i], other):
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

    def _normal(self, lin: Linearization | None) -> dict[int, float]:
        if lin is None or not lin.forces.solved:
            return {}
        rows, pads = self.hand.pad_rows(lin.contacts.finger)
        return dict(zip(pads, lin.forces.normal[rows].tolist(), strict=True))

    def _contradicts(self, force: float, expected: float) -> bool:
        variance = self._least**2 + _JOINT_STD**2 + (NOISE.force_share * expected) ** 2
        return (force - expected) ** 2 > self.guards.gate**2 * variance
