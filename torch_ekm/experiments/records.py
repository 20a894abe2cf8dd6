"""Records of trials: typed figures, kept as JSON."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, ClassVar, Self

import numpy as np
import torch

from ..control import Manipulation, StoppingRule, StopReason
from ..exceptions import StateError
from ..kinematics import GraspState
from ..plant import Observation
from ..typing import Float, Tensor

_DEG = np.pi / 180
_DISLOCATED = math.degrees(StoppingRule().off_limit)
_MOVING = 0.5 * _DEG  # commands that ask for less say nothing about the shortfall of a step


@dataclass(frozen=True)
class Trial:
    """A trial says what was to be done: object, controller, grasp and rotation."""

    object: str
    """Its name, or the stem of its file."""
    kind: str
    """"turn", or "warm-up", "first", "learning": those in which a learner or the hand is learned."""
    controller: str
    seed: int
    trial: int
    """Its number: together with the seed it decides the grasp."""
    angle_deg: float
    """Rotation that was asked for [deg]."""

    grasped: ClassVar[bool]

    def to_json(self) -> dict[str, Any]:
        """Plain figures, from which :meth:`TrialRecord.from_json` makes the record again."""
        return {"grasped": self.grasped, **dataclasses.asdict(self)}


@dataclass(frozen=True)
class NotGrasped(Trial):
    """No pinch held the object: nothing was measured."""

    message: str
    """Why the last grasp failed."""

    grasped: ClassVar[bool] = False
    reason: ClassVar[str] = "not grasped"


@dataclass(frozen=True)
class TrialRecord(Trial):
    """A manipulation of a grasped object; angles [deg]. Predictions are made before the learner trains on
    the motion; those of the E-KM are empty where nothing learns."""

    reason: str
    """Why it ended, a value of :class:`~torch_ekm.control.StopReason`."""
    message: str
    true_error_deg: float
    """At the end, by the simulation's truth."""
    errors_deg: tuple[float, ...]
    """Before each motion and at the end, as measured."""
    first_step_deg: float | None
    """How far the first motion changed the error by more or less than it was to; None: no motion."""
    step_error_deg: float | None
    """The same, mean over the motions that ask for at least 0.5 deg; None: there was none."""
    prediction_km_deg: tuple[float, ...]
    """One-step prediction error of the kinematic model for each motion, as measured."""
    prediction_ekm_deg: tuple[float, ...]
    """The same of the E-KM."""
    true_prediction_km_deg: tuple[float, ...]
    """Against the plant's truth, free of the camera's noise."""
    true_prediction_ekm_deg: tuple[float, ...]
    off_rotation_deg: float
    """Rotation off the focused axis at the end, as measured."""
    seconds: tuple[float, ...]
    """Decision and training of each motion, without the plant [s]."""
    poses: tuple[Any, ...] = ()
    """True joint angles [rad], position [m] and rotation before each motion and at the end, for pictures;
    empty unless they were asked for."""
    turning: int = 0
    """Movements that turn; the others only grip."""
    simulated_s: float = 0.0
    """From the first reading to the last, by the plant's clock [s]."""

    grasped: ClassVar[bool] = True

    @property
    def lost(self) -> bool:
        """The object was dropped, or turned off the axis beyond help.

        Whatever stopped the loop: to the guards, an object that flips between two looks is a jumping pose.
        """
        return self.reason == StopReason.OBJECT_LOST.value or self.off_rotation_deg > _DISLOCATED

    @property
    def not_reached(self) -> bool:
        """The object is in the hand, but not where it was to be."""
        return not self.lost and self.reason != StopReason.REACHED.value

    @property
    def steps(self) -> int:
        """Number of movements."""
        return len(self.seconds)

    @classmethod
    def from_json(cls, figures: Mapping[str, Any]) -> Self | NotGrasped:
        """The record that :meth:`to_json` wrote.

        Raises:
            StateError: a figure is missing, or there is one that the record does not have.
        """
        given: dict[str, Any] = {key: tuple(x) if isinstance(x, list) else x for key, x in figures.items()}
        kind = cls if given.pop("grasped", False) else NotGrasped
        known = {field.name for field in dataclasses.fields(kind)}
        if known != set(given):
            wrong = ", ".join(sorted(known ^ set(given)))
            told = f"missing or unknown: {wrong}; remove results of another version"
            raise StateError(f"the record has not the figures of {kind.__name__}: {told}")
        return kind(**given)

    @classmethod
    def of(
        cls, trial: Trial, done: Manipulation, axis: Float[Tensor, " 3"], *, learns: bool, poses: bool = False
    ) -> TrialRecord:
        """The figures of one manipulation in a simulated hand.

        Args:
            axis: about which the object was to turn, unit vector, hand frame.
            learns: the controller has predictions of its own.
        """
        steps, focus, measured = done.steps, done.focus, done.errors
        # how much of a step was missing: |e| should have fallen by what was asked for
        short, moving = [], []
        for step, (before, after) in zip(steps, pairwise(measured), strict=True):
            asked = float(torch.linalg.vector_norm(step.decision.desired))
            if step.decision.turns:
                short.append(abs(after - (before - asked)))
                moving += [short[-1]] if asked >= _MOVING else []
        truth = [true_state(seen) for seen in (*(step.before for step in steps), done.stop.final)]
        turned = [axis @ after.minus(before)[-3:] for before, after in pairwise(truth)]

        def errors(name: str) -> tuple[float, ...]:
            pairs = ((step.increment, getattr(step.decision, name)) for step in steps)
            wrong = (prediction_error(*pair, focus.matrix) for pair in pairs)
            return tuple(float(torch.linalg.vector_norm(error)) / _DEG for error in wrong)

        def true_errors(name: str) -> tuple[float, ...]:
            predicted = [axis @ getattr(step.decision, name)[-3:] for step in steps]
            return tuple(abs(float(a - b)) / _DEG for a, b in zip(turned, predicted, strict=True))

        off = focus.off_rotation(done.stop.final.state.minus(steps[0].before.state)) if steps else 0.0
        return cls(
            **vars(trial),
            reason=done.reason.value,
            message=done.stop.message,
            true_error_deg=focus.error(done.target, truth[-1]) / _DEG,
            errors_deg=tuple(error / _DEG for error in measured),
            first_step_deg=short[0] / _DEG if short else None,
            step_error_deg=float(np.mean(moving)) / _DEG if moving else None,
            prediction_km_deg=errors("nominal"),
            prediction_ekm_deg=errors("predicted") if learns else (),
            true_prediction_km_deg=true_errors("nominal"),
            true_prediction_ekm_deg=true_errors("predicted") if learns else (),
            off_rotation_deg=off / _DEG,
            seconds=tuple(step.seconds for step in steps),
            turning=sum(step.decision.turns for step in steps),
            simulated_s=done.stop.final.time - steps[0].before.time if steps else 0.0,
            poses=tuple([s.q.tolist(), s.position.tolist(), s.rotation.tolist()] for s in truth if poses),
        )


#: What a session leaves.
Record = TrialRecord | NotGrasped


def prediction_error(
    increment: Float[Tensor, " n_s"], predicted: Float[Tensor, " n_s"], focus: Float[Tensor, "n_x 6"]
) -> Float[Tensor, " n_x"]:
    """``e(t) = M_c E_p (ds(t) - predicted(t))``: one-step error of the focused pose.

    The paper prints ``e_ekm`` and ``e_km`` swapped and leaves out ``- x_f(t)`` and ``M_c``; this is
    what its figures show. ``predicted`` must be made *before* training on the sample.
    """
    return focus @ (increment - predicted)[-6:]


def true_state(seen: Observation) -> GraspState:
    """Joint angles and pose as they are; for reports only."""
    assert seen.truth is not None  # a simulated hand knows
    return seen.truth.state
