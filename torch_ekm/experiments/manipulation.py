"""One manipulation: the closed loop of plant, model, learner and controller."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field

import torch

from ..control import Decision, LookAndMoveController, PoseTarget, StoppingRule, StopReason
from ..kinematics.grasp_state import GraspState
from ..plant.plant import Observation, Plant, PlantStatus
from ..typing import Tensor
from .reporting.metrics import prediction_error


@dataclass(frozen=True)
class Step:
    """One motion of the loop; errors in the unit of the focus (rad for a rotation)."""

    error: float
    """|e| before the motion, as measured."""
    delta_a: Tensor
    increment: Tensor
    """ds that was measured."""
    prediction_error_km: float
    """|M_c E_p (ds - f)|"""
    prediction_error_ekm: float | None
    """|M_c E_p (ds - f - g)| with g from before training on this step; None without a learner."""
    off_rotation: float
    """Rotation off the focused axis since the start [rad]."""
    seconds: float
    """Time of the decision and the training, without the plant [s]."""


@dataclass
class Manipulation:
    """A finished (or lost) manipulation."""

    reason: StopReason
    steady_state_error: float
    """|e| when the controller stopped, as measured."""
    true_error: float | None
    """|e| by the plant's truth, if it tells it."""
    steps: list[Step] = field(default_factory=list)
    final: Observation | None = None
    message: str = ""

    @property
    def lost(self) -> bool:
        return self.reason is StopReason.OBJECT_LOST


def run_manipulation(
    plant: Plant,
    controller: LookAndMoveController,
    target: PoseTarget,
    rule: StoppingRule,
    *,
    learn: bool,
    on_step: Callable[[Observation, Decision], None] | None = None,
) -> Manipulation:
    """Drive the object to ``target`` and, with ``learn``, train the learner after every motion.

    Args:
        plant: a grasped object (already reset).
        controller: with an enhanced model if ``learn``.
        learn: update the learner on each motion that was observed.
        on_step: called before each command, for progress and pictures.
    """
    focus = controller.focus.matrix
    observation = plant.observe()
    start = state = state_of(observation)
    errors = [_focus_error(focus, target, state)]
    done = Manipulation(StopReason.RUNNING, errors[0], None)
    limited, off_rotation = False, 0.0
    off_rows = controller.focus.off_matrix
    off_rows = off_rows[off_rows[:, 3:].abs().sum(-1) > 0]  # rotations
    while True:
        done.final = observation
        if observation.status is PlantStatus.LOST or off_rotation > rule.off_limit:
            done.reason = StopReason.OBJECT_LOST
            done.message = "" if observation.status is PlantStatus.LOST else "dislocated off the focused axis"
            break
        done.reason = rule.judge(errors, limited)
        if done.reason is not StopReason.RUNNING:
            break
        began = time.perf_counter()
        decision = controller.decide(state, observation.a, target, observation.fingertip_force)
        seconds = time.perf_counter() - began
        if decision.status is not StopReason.RUNNING:
            done.reason, done.message = decision.status, decision.message
            break
        if on_step is not None:
            on_step(observation, decision)
        observation = plant.command(decision.delta_a)
        after = state_of(observation)
        increment = after.minus(state)
        enhanced = controller.enhanced
        began = time.perf_counter()
        if learn and enhanced is not None and observation.status is PlantStatus.HELD:
            enhanced.update(state, decision.delta_a, increment, decision.nominal)
        seconds += time.perf_counter() - began
        e_km = prediction_error(increment, decision.nominal, focus)
        e_ekm = None
        if enhanced is not None:
            e_ekm = float(torch.linalg.vector_norm(prediction_error(increment, decision.predicted, focus)))
        off_rotation = float(torch.linalg.vector_norm(off_rows @ after.minus(start)[-6:]))
        done.steps.append(
            Step(
                errors[-1],
                decision.delta_a,
                increment,
                float(torch.linalg.vector_norm(e_km)),
                e_ekm,
                off_rotation,
                seconds,
            )
        )
        state, limited = after, decision.limited
        errors.append(_focus_error(focus, target, state))
    done.steady_state_error = errors[-1]
    truth = observation.info.get("truth")
    if truth is not None:
        true_state = GraspState(truth["q"], truth["position"], truth["rotation"])
        done.true_error = _focus_error(focus, target, true_state)
    return done


def state_of(observation: Observation) -> GraspState:
    """The measured state of an observation."""
    return GraspState(observation.q, observation.position, observation.rotation)


def _focus_error(focus: Tensor, target: PoseTarget, state: GraspState) -> float:
    return float(torch.linalg.vector_norm(focus @ target.error(state)))
