"""Records of trials: typed figures, kept as JSON."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Self

import numpy as np
import torch

from ..control import Manipulation, StoppingRule, StopReason
from ..exceptions import StateError
from ..kinematics import GraspState
from ..plant import Observation
from ..typing import Float, Tensor

_DEG = np.pi / 180
_DISLOCATED = math.degrees(StoppingRule().off_limit)


#: Why a trial ended in which no pinch held the object: nothing was measured.
NOT_GRASPED = "not grasped"


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


@dataclass(frozen=True)
class TrialRecord(Trial):
    """A manipulation of an object; angles [deg]. Predictions are made before the learner trains on
    the motion; those of the E-KM are empty where nothing learns. Without a grasp there are no figures."""

    reason: str
    """Why it ended, a value of :class:`~torch_ekm.control.StopReason` or :data:`NOT_GRASPED`."""
    message: str
    true_error_deg: float | None = None
    """At the end, by the simulation's truth."""
    errors_deg: tuple[float, ...] = ()
    """Before each motion and at the end, as measured."""
    first_step_deg: float | None = None
    """How far the first motion changed the error by more or less than it was to; None: no motion."""
    prediction_km_deg: tuple[float, ...] = ()
    """One-step prediction error of the kinematic model for each motion, as measured."""
    prediction_ekm_deg: tuple[float, ...] = ()
    """The same of the E-KM."""
    true_prediction_km_deg: tuple[float, ...] = ()
    """Against the plant's truth, free of the camera's noise."""
    true_prediction_ekm_deg: tuple[float, ...] = ()
    off_rotation_deg: float = 0.0
    """Rotation off the focused axis at the end, as measured."""
    seconds: tuple[float, ...] = ()
    """Decision and training of each motion, without the plant [s]."""
    poses: tuple[Any, ...] = ()
    """True joint angles [rad], position [m] and rotation before each motion and at the end, for pictures;
    empty unless they were asked for."""
    turning: int = 0
    """Movements that turn; the others only grip."""
    simulated_s: float = 0.0
    """From the first reading to the last, by the plant's clock [s]."""
    more: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """Figures of a study; each is a column of the frame."""

    @property
    def grasped(self) -> bool:
        """A pinch held the object."""
        return self.reason != NOT_GRASPED

    @property
    def lost(self) -> bool:
        """The object was dropped, or turned off the axis beyond help.

        Whatever stopped the loop: to the guards, an object that flips between two looks is a jumping pose.
        """
        return self.reason == StopReason.OBJECT_LOST.value or self.off_rotation_deg > _DISLOCATED

    @property
    def not_reached(self) -> bool:
        """The object is in the hand, but not where it was to be."""
        return self.grasped and not self.lost and self.reason != StopReason.REACHED.value

    @property
    def steps(self) -> int:
        """Number of movements."""
        return len(self.seconds)

    @classmethod
    def from_json(cls, figures: Mapping[str, Any]) -> Self:
        """The record whose fields were kept as JSON.

        Raises:
            StateError: a figure is missing, or there is one that the record does not have.
        """
        if wrong := {field.name for field in dataclasses.fields(cls)} ^ set(figures):
            wrong_names = f"missing or unknown: {', '.join(sorted(wrong))}; remove results of another version"
            raise StateError(f"the record has not the figures of {cls.__name__}: {wrong_names}")
        given: dict[str, Any] = {key: tuple(x) if isinstance(x, list) else x for key, x in figures.items()}
        return cls(**given)

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
        short = [
            abs(after - (before - float(torch.linalg.vector_norm(step.decision.desired)))) / _DEG
            for step, (before, after) in zip(steps, pairwise(measured), strict=True)
            if step.decision.turns
        ]
        truth = [true_state(seen) for seen in (*(step.before for step in steps), done.stop.final)]
        turned = [axis @ after.minus(before)[-3:] for before, after in pairwise(truth)]

        def errors(name: str) -> tuple[float, ...]:
            # M_c E_p (ds - predicted); the paper swaps e_ekm and e_km and leaves out M_c: see its figures
            missed = (step.increment - getattr(step.decision, name) for step in steps)
            return tuple(float((focus.matrix @ ds[-6:]).norm()) / _DEG for ds in missed)

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
            first_step_deg=short[0] if short else None,
            prediction_km_deg=errors("nominal"),
            prediction_ekm_deg=errors("predicted") if learns else (),
            true_prediction_km_deg=true_errors("nominal"),
            true_prediction_ekm_deg=true_errors("predicted") if learns else (),
            off_rotation_deg=off / _DEG,
            seconds=tuple(step.seconds for step in steps),
            turning=len(short),
            simulated_s=done.stop.final.time - steps[0].before.time if steps else 0.0,
            poses=tuple([s.q.tolist(), s.position.tolist(), s.rotation.tolist()] for s in truth if poses),
        )


def true_state(seen: Observation) -> GraspState:
    """Joint angles and pose as they are; for reports only."""
    assert seen.truth is not None  # of a simulated hand
    return seen.truth.state
