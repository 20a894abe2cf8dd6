"""A test bench: one object in the simulated hand, one controller, trial after trial."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import torch

from ..control import ClosedLoop, LookAndMoveController, Manipulation, PoseTarget
from ..description import ObjectDescription
from ..enhanced import EnhancedModel, GraspEncoding
from ..exceptions import EquilibriumError, GraspError
from ..kinematics import GraspState
from ..model import KinematicModel
from ..plant import Observation, Plant, PlantStatus
from ..residual import ResidualLearner
from ..simulation import Change, DisturbedPlant, SimulatedHand, Tug
from .camera_off import CameraOff
from .config import Setting
from .learners import make_learner
from .reporting.metrics import prediction_error

Record = dict[str, Any]
_DEG = math.pi / 180
_TRIES = 4  # grasps drawn for one trial before it is given up
_HOPELESS = 2  # trials without any grasp, after which the object is given up
_MOVING = 0.5 * _DEG  # commands that ask for less tell nothing about the shortfall of a step


class Bench:
    """Grasp, turn, release, again; the learner stays from trial to trial.

    Args:
        setting: hand, plant, model, learner, rule.
        object: name, path or description.
        controller: one of ``CONTROLLERS``.
        learner: used instead of a fresh one of the setting's kind (e.g. one that knows other objects).
        encoding: what the learner sees of a state; by default made at the first grasp.
        keep_images: with sensing, the camera's last image stays in ``info["raw"]["image"]``.
    """

    def __init__(
        self,
        setting: Setting,
        object: str | ObjectDescription,
        controller: str,
        learner: ResidualLearner | None = None,
        encoding: GraspEncoding | None = None,
        *,
        keep_images: bool = False,
    ) -> None:
        torch.set_num_threads(1)  # small matrices: more threads only wait for each other
        self.setting, self.controller = setting, controller
        config = setting.plant_config(controller)
        self.hand = SimulatedHand(setting.hand, object, config, setting.parameters())
        self.disturbed = DisturbedPlant(self.hand)
        self.plant: Plant = self.disturbed
        if setting.sensing:
            stuck = setting.parameters().stuck_joints
            self.plant = _sensed(self.disturbed, self.hand, stuck, keep_images)
        self.model = KinematicModel(self.hand.hand, self.hand.object, setting.model_options())
        self.learner, self.encoding = learner, encoding
        self.enhanced: EnhancedModel | None = None
        self.no_grasp = ""
        """Why the last grasp that failed did."""
        self._ever_held, self._failed = False, 0  # trials without a grasp
        self.on_grasp: Callable[[torch.Tensor], object] | None = None
        """Hears of the axis of each new grasp."""

    @property
    def learns(self) -> bool:
        return self.controller.startswith("E-KM")

    def grasp(self, seed: int, trial: int) -> GraspState | None:
        """A random grasp point, decided by ``(seed, trial)`` alone; None if no pinch holds.

        An object that no pinch held in the first two trials is given up: planning in vain takes longest.
        """
        if not self._ever_held and self._failed >= _HOPELESS:
            return None
        for attempt in range(_TRIES):
            drawn = int(np.random.SeedSequence([seed, trial, attempt]).generate_state(1)[0])
            try:
                start = self.plant.reset(drawn).state
            except (EquilibriumError, GraspError) as error:
                self.no_grasp = str(error)
                continue
            self._ever_held = True
            if self.learns and self.enhanced is None:
                self._prepare_learner(start)
            if self.on_grasp is not None:
                self.on_grasp(self.hand.rotation_axis)
            return start
        self._failed += 1
        return None

    def adopt(self, learner: ResidualLearner, encoding: GraspEncoding) -> None:
        """Use this learner from now on, with this encoding."""
        self.learner, self.encoding, self.enhanced = learner, encoding, None

    def trial(
        self,
        seed: int,
        trial: int,
        angle_deg: float,
        *,
        learn: bool = True,
        events: Sequence[Tug | Change] = (),
        blind_deg: float = 0.0,
    ) -> Record:
        """Turn the object by ``angle_deg`` from a fresh grasp.

        Args:
            learn: train after every motion (an E-KM only).
            events: what happens on the way; ``at`` counts this trial's commands from 0.
            blind_deg: the camera is off for this last part of the turn [deg].

        Returns:
            A record of plain figures; angles [deg].
        """
        about = {"controller": self.controller, "seed": seed, "trial": trial, "angle_deg": angle_deg}
        start = self.grasp(seed, trial)
        if start is None:
            return {
                **about,
                "reason": "not grasped",
                "message": self.no_grasp,
                "grasped": False,
                "lost": False,
            }
        self.disturbed.events = tuple(
            dataclasses.replace(event, at=event.at + self.disturbed.count) for event in events
        )
        axis = self.hand.rotation_axis
        target = PoseTarget.turned(start, axis, angle_deg * _DEG)
        controller, plant = self._controller(axis), self.plant
        if blind_deg:
            model = self.model if self.enhanced is None else self.enhanced
            plant = CameraOff(plant, model, target, axis, blind_deg * _DEG)
        done = ClosedLoop(plant, controller, self.setting.stopping_rule(), learn=learn).run(target)
        return {**about, **record_of(done, axis, self.learns)}

    def long_step(self, seed: int, trial: int, step_deg: float = 5.0) -> Record:
        """One step of ``step_deg`` from a fresh grasp: how far from it does the object come to rest?

        Feedback has no say in it. The error is against the plant's truth, the learner stays as it is.
        """
        about = {"controller": self.controller, "seed": seed, "trial": trial, "angle_deg": step_deg}
        start = self.grasp(seed, trial)
        if start is None:
            return {**about, "grasped": False, "lost": False}
        axis = self.hand.rotation_axis
        loop = self._controller(axis, focus_step=step_deg * _DEG, contact_step=None, actuator_step=20 * _DEG)
        seen = self.plant.observe()
        before = _true_state(seen)
        target = PoseTarget.turned(start, axis, step_deg * _DEG)
        decision = loop.decide(seen.state, seen.a, target, seen.fingertip_force)
        seen = self.plant.command(decision.delta_a)
        turned = _true_state(seen).minus(before)[-3:] @ axis
        lost = seen.status is PlantStatus.LOST
        error = abs(float(turned) / _DEG - step_deg)
        return {**about, "grasped": True, "lost": lost, "error_deg": error}

    def close(self) -> None:
        """Give back what the plant holds."""
        self.plant.close()

    def _controller(self, axis: torch.Tensor, **changes: Any) -> LookAndMoveController:
        options = dataclasses.replace(self.setting.controller_options(), **changes)
        model = self.enhanced if self.enhanced is not None else self.model
        return LookAndMoveController(model, axis, options)

    def _prepare_learner(self, start: GraspState) -> None:
        setting = self.setting
        if self.encoding is None:
            self.encoding = GraspEncoding.of(self.model, start)
        if self.learner is None:
            self.learner = make_learner(
                setting.learner,
                self.encoding.n_features,
                self.model.hand.n_a,
                setting.capacity,
                **setting.learner_options,
            )
        self.enhanced = EnhancedModel.for_grasp(self.model, start, self.learner, self.encoding)


def _sensed(
    plant: DisturbedPlant, simulated: SimulatedHand, stuck: tuple[str, ...], keep_images: bool
) -> Plant:
    from ..sensing import ContactAligned  # OpenCV is needed only here
    from ..simulation import HallSensors, SensedPlant, Stuck

    hand = simulated.hand
    hall = HallSensors(hand) if hand.hall_sensors else None
    sensed = SensedPlant(plant, hand, simulated.object, hall=hall, keep_images=keep_images)
    if hall is not None:  # after the calibration: a channel that was dead by then would not be believed
        hall.stuck = [Stuck.FROZEN if joint in stuck else Stuck.NO for joint in hall.joints]
    return sensed if hall is None else ContactAligned(sensed, hand, simulated.object)


def _true_state(observation: Observation) -> GraspState:
    assert observation.truth is not None  # a simulated hand tells
    return observation.truth.state


def record_of(done: Manipulation, axis: torch.Tensor, learns: bool) -> Record:
    """Plain figures of one manipulation in a simulated hand; angles [deg]."""
    steps, focus, measured = done.steps, done.focus, done.errors
    asked = [float(torch.linalg.vector_norm(step.decision.desired)) for step in steps]
    # how much of a step was missing: |e| should have fallen by what was asked for
    short = [abs(measured[k + 1] - (measured[k] - asked[k])) for k in range(len(steps))]
    moving = [s for s, a in zip(short, asked, strict=False) if a >= _MOVING]
    truth = [_true_state(seen) for seen in (*(step.before for step in steps), done.stop.final)]
    turned = [axis @ after.minus(before)[-3:] for before, after in pairwise(truth)]

    def errors_of(predictions: list[torch.Tensor]) -> list[float]:
        pairs = zip(steps, predictions, strict=True)
        errors = [prediction_error(step.increment, predicted, focus.matrix) for step, predicted in pairs]
        return [float(torch.linalg.vector_norm(error)) / _DEG for error in errors]

    def true_errors(predictions: list[torch.Tensor]) -> list[float]:
        pairs = zip(turned, predictions, strict=True)
        return [abs(float(real - axis @ predicted[-3:])) / _DEG for real, predicted in pairs]

    return {
        "grasped": True,
        "reason": done.reason.value,
        "message": done.stop.message,
        "lost": done.lost,
        "steady_state_error_deg": measured[-1] / _DEG,
        "true_error_deg": focus.error(done.target, truth[-1]) / _DEG,
        "steps": len(steps),
        "errors_deg": [error / _DEG for error in measured],
        "first_step_deg": short[0] / _DEG if short else None,
        "step_error_deg": float(np.mean(moving)) / _DEG if moving else None,
        "prediction_km_deg": errors_of([step.decision.nominal for step in steps]),
        "prediction_ekm_deg": (
            errors_of([step.decision.predicted for step in steps]) if learns else [None] * len(steps)
        ),
        # the same against the plant's truth, free of the camera's noise
        "true_prediction_km_deg": true_errors([step.decision.nominal for step in steps]),
        "true_prediction_ekm_deg": true_errors([step.decision.predicted for step in steps]) if learns else [],
        "off_rotation_deg": (
            focus.off_rotation(done.stop.final.state.minus(steps[0].before.state)) / _DEG if steps else 0.0
        ),
        "seconds": [step.seconds for step in steps],
    }
