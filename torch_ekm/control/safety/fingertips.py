"""Which fingertips are believed, and whether the hand presses too hard."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch

from ...exceptions import GraspError
from ...model import ModelStatus
from ...plant import Observation
from ...typing import Float, Tensor
from ..decision import Decision, StopReason
from .safety import Guards, Objection

if TYPE_CHECKING:
    from ...model import KinematicModel, Linearization

_HOLDS = 1.0  # [N] by two pads: an object is between them
_PRESSED = 3.0  # [N] by the model: a pad that reads nothing then is dead
_SURPRISE = 3.0  # [N] above the model: joints and springs are asked
_JOINT_STD = 0.75  # [N] of a normal force by joints and springs alone
_SCALE = 1.75  # between all fingertips and joints and springs: used hands come to 1.5
_NOTHING = 5.0  # so many times more: joints without springs behind rigid motors say nothing of forces
_JOINT_SHARE = 0.25  # and as a share of it: springs are not as described


class Fingertips(NamedTuple):
    """What is believed of the fingertips."""

    force: Float[Tensor, " n_pads"] | None
    """[N]; 0 where a pad is not believed, and the model's estimate stands in."""
    note: str = ""
    halt: Objection | None = None
    true: bool = True
    """Their scale is that of joints and springs; else nothing is learned from the motion."""


def hold(seen: Observation) -> bool:
    """Two fingertips at least measure a force: an object is between them."""
    return seen.fingertip_force is not None and int((seen.fingertip_force > _HOLDS).sum()) > 1


class FingertipWatch:
    """Dead, frozen, saturated and stale fingertips, and forces above the ceiling."""

    def __init__(self, guards: Guards, model: KinematicModel) -> None:
        self.guards, self.model = guards, model
        self.pads = [pad.name for pad in model.hand.pads]
        self.least = model.options.forces.normal_std
        held = np.vstack([model.hand.actuation_jacobian, model.hand.coupling.reshape(-1, model.hand.n_q)])
        self._springs = bool(np.linalg.matrix_rank(held) < model.hand.n_q)
        self._last: Tensor | None = None  # before the first motion
        self._repeats = torch.zeros(len(self.pads), dtype=torch.long)
        self._way = torch.zeros(len(self.pads), dtype=torch.float64)

    def high(self, seen: Observation) -> bool:
        """A reading above the ceiling."""
        force = seen.fingertip_force
        return force is not None and bool((force > self.guards.force_ceiling).any())

    def before(self, decision: Decision, seen: Observation) -> Objection | None:
        """Pads that do not measure press too hard, by the model's estimate."""
        lin = decision.linearization
        if lin is None or not lin.forces.solved:
            return None
        for pad, estimate in self._normal(lin).items():
            silent = seen.fingertip_force is None or float(seen.fingertip_force[pad]) < self.least
            if silent and estimate > self.guards.force_ceiling:
                return self._too_hard(self.pads[pad], estimate, "by the model's estimate")
        return None

    def judge(self, before: Observation, decision: Decision, seen: Observation) -> Fingertips:
        """What is believed after a motion."""
        force, dated = seen.fingertip_force, seen.dated and before.dated
        if force is None:
            return Fingertips(None)
        taken = seen.taken.fingertips
        if dated and not (taken > before.time and abs(seen.time - taken) <= self.guards.max_age.fingertips):
            note = f"the fingertips were read at {taken:.3f} s: the model's estimate stands in"
            return Fingertips(None, note)
        lin = decision.linearization
        doubts = () if lin is None else lin.doubts
        first = self._last is None  # before a grip by wrong pads has changed the forces
        asked = first or any(doubt.kind is ModelStatus.UNEXPLAINED_TORQUE for doubt in doubts)
        notes = self._scale(seen, force) if asked else []
        true = not notes
        repeats = self._frozen(force, float((seen.a - before.a).abs().max()))
        expected = {} if lin is None else self._normal(lin)
        faults = {i: f"reads {float(force[i]):.2f} N again and again" for i in repeats if i in expected}
        # above the ceiling, or far above what the model had before the motion
        ceiling = self.guards.force_ceiling
        usual = [min(ceiling, expected.get(i, math.inf) + _SURPRISE) for i in range(len(force))]
        high = [i for i, most in enumerate(usual) if i not in faults and force[i] > most]
        alone = self._by_joints(seen) if high else {}
        for i in high:
            other = alone.get(i)
            if other is not None and self._contradicts(float(force[i]), other):
                faults[i] = f"reads {float(force[i]):.2f} N, joints and springs give {other:.2f} N"
            elif force[i] > ceiling:
                return Fingertips(force, halt=self._too_hard(self.pads[i], float(force[i]), "as measured"))
        faulty = [f"fingertip '{self.pads[i]}' {problem}" for i, problem in sorted(faults.items())]
        if len(faults) > self.guards.faulty_pads:
            said = "; ".join(faulty)
            message = (
                f"{said} (Guards.faulty_pads is {self.guards.faulty_pads}): check range "
                "and cable of the fingertips, or those of the joint sensors if several fingertips disagree"
            )
            return Fingertips(force, halt=Objection(StopReason.FINGERTIP_FAULT, message))
        faulty += [
            f"fingertip '{self.pads[i]}' reads {float(force[i]):.2f} N, the model predicts {other:.2f} N"
            for i, other in expected.items()
            if other > _PRESSED and force[i] < self.least
        ]
        if faults:
            force = force.clone()
            force[list(faults)] = 0.0
        notes += [f"{'; '.join(faulty)}: the model's estimate stands in"] if faulty else []
        return Fingertips(force, "; ".join(notes), true=true)

    def _scale(self, seen: Observation, force: Tensor) -> list[str]:
        """All fingertips together read much more or less than joints and springs give."""
        alone = {i: other for i, other in self._by_joints(seen).items() if force[i] > self.least}
        measured, other = float(force[list(alone)].sum()), sum(alone.values())
        plain = measured / _SCALE < other < measured * _SCALE or other < measured / _NOTHING
        if len(alone) < 2 or plain:
            return []
        return [
            f"the fingertips read {measured:.1f} N, joints and springs give {other:.1f} N ({_SCALE:g} times "
            "are allowed): check their scale, and the description's springs; nothing is learned"
        ]

    def _frozen(self, force: Tensor, moved: float) -> list[int]:
        """Pads that read the same again and again while the encoders move."""
        same = (force >= self.least) & (force == (0 * force if self._last is None else self._last))
        self._repeats = torch.where(same, self._repeats + 1, 0 * self._repeats)
        self._way = torch.where(same, self._way + moved, 0 * self._way)
        self._last = force
        found = (self._repeats >= self.guards.fingertip_repeats) & (self._way > self.guards.unchanged)
        return found.nonzero().flatten().tolist()

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
        rows, pads = self.model.hand.pad_rows(lin.contacts.finger)
        return dict(zip(pads, lin.forces.normal[rows].tolist(), strict=True)) if lin.forces.solved else {}

    def _contradicts(self, force: float, expected: float) -> bool:
        variance = self.least**2 + _JOINT_STD**2 + (_JOINT_SHARE * expected) ** 2
        return (force - expected) ** 2 > self.guards.gate**2 * variance

    def _too_hard(self, pad: str, force: float, how: str) -> Objection:
        message = (
            f"fingertip '{pad}' presses with {force:.1f} N {how}, Guards.force_ceiling is "
            f"{self.guards.force_ceiling:g} N: free the object, lower GripForceTask.force, or choose a "
            "nearer target (ClosedLoop.reach)"
        )
        return Objection(StopReason.FORCE_CEILING, message)
