"""The main job: a grasped object turned through the paper's angles, with the KM and with the E-KM."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from ...control import ControllerOptions, FocusedPose, LookAndMoveController, PoseTarget, StoppingRule
from ...description import HandDescription, load_hand, load_object
from ...enhanced import EnhancedModel
from ...exceptions import ParameterError, UnknownNameError
from ...model import KinematicModel, ModelOptions
from ...simulation import PlantConfig, PlantParameters, SimulatedHand
from ..learners import make_enhanced
from ..manipulation import Manipulation, run_manipulation, state_of

#: Rotations of the paper's Table I [deg].
TABLE_I: dict[str, tuple[float, ...]] = {
    "box": (9, 14, 19, 24, 29),
    "weighted_box": (6, 11, 16, 21, 26),
    "can": (9, 13, 23, 31, 38),
    "bottle": (7, 13, 18, 23, 28),
    "applier": (3, 8, 13, 18, 23),
}
CONTROLLERS = ("KM", "E-KM")
_DEG = math.pi / 180


@dataclass(frozen=True)
class DemoConfig:
    """What the demo does. Reported seeds start at 1000; figures were chosen on seeds below 100.

    Raises:
        UnknownNameError: no such hand or object; the message lists them.
        DescriptionError: a file of theirs is missing or wrong.
        ParameterError: nothing to do, or an angle that is no rotation.
    """

    hand: str = "icub_right"
    object: str = "box"
    seeds: tuple[int, ...] = tuple(range(1000, 1008))
    angles_deg: tuple[float, ...] = TABLE_I["box"]
    capacity: int = 60
    tolerance_deg: float = 0.25
    max_steps: int = 60

    def __post_init__(self) -> None:
        load_hand(self.hand)
        load_object(self.object)
        if not self.seeds:
            raise ParameterError("seeds", self.seeds, "at least one seed")
        if not self.angles_deg or not all(0 < abs(angle) < 180 for angle in self.angles_deg):
            raise ParameterError("angles_deg", self.angles_deg, "angles between 0 and 180 deg")


def stopping_rule(config: DemoConfig) -> StoppingRule:
    """The same rule for every controller."""
    return StoppingRule(
        tolerance=config.tolerance_deg * _DEG, stall_progress=0.1 * _DEG, max_steps=config.max_steps
    )


def run_session(
    config: DemoConfig, controller: str, seed: int, on_trial: Callable[[], None] | None = None
) -> list[dict[str, Any]]:
    """All angles from the grasp of one seed; the E-KM starts empty and learns from angle to angle.

    Returns:
        One record of plain figures for each angle (angles [deg]).
    """
    if controller not in CONTROLLERS:
        raise UnknownNameError("controller", controller, CONTROLLERS)
    torch.set_num_threads(1)  # small matrices: more threads only wait for each other
    plant_config = PlantConfig()
    plant = SimulatedHand(config.hand, config.object, plant_config, PlantParameters.nominal_mismatch())
    # a noisy pose may show a gap of some millimetres where there is contact
    options = ModelOptions(contact_margin=0.004)
    model = KinematicModel(plant.hand, plant.object, options)
    enhanced: EnhancedModel | None = None
    records = []
    for angle in config.angles_deg:
        start = state_of(plant.reset(seed))
        if enhanced is None and controller == "E-KM":
            enhanced = make_enhanced(model, start, config.capacity)
        axis = plant.rotation_axis
        frames: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
        loop = LookAndMoveController(
            enhanced if enhanced is not None else model,
            FocusedPose.rotation_about(axis),
            ControllerOptions(fixed_actuators=fixed_actuators(plant.hand)),
        )
        done = run_manipulation(
            plant,
            loop,
            PoseTarget.turned(start, axis, angle * _DEG),
            stopping_rule(config),
            learn=enhanced is not None,
            on_step=lambda *_: frames.append(plant.hand_state()),  # noqa: B023 - used before the next turn
        )
        frames.append(plant.hand_state())
        records.append(_record(controller, seed, angle, done, frames))
        if on_trial is not None:
            on_trial()
    plant.close()
    return records


def fixed_actuators(hand: HandDescription) -> tuple[str, ...]:
    """Actuators that a pinch leaves alone: on the iCub abduction, ring and little finger."""
    return tuple(name for name in ("hand_finger", "pinky") if name in hand.actuator_names)


def _record(controller: str, seed: int, angle: float, done: Manipulation, frames: list) -> dict[str, Any]:
    steps = done.steps
    return {
        "controller": controller,
        "seed": seed,
        "angle_deg": angle,
        "reason": done.reason.value,
        "message": done.message,
        "lost": done.lost,
        "steady_state_error_deg": done.steady_state_error / _DEG,
        "true_error_deg": None if done.true_error is None else done.true_error / _DEG,
        "steps": len(steps),
        "errors_deg": [step.error / _DEG for step in steps] + [done.steady_state_error / _DEG],
        "prediction_km_deg": [step.prediction_error_km / _DEG for step in steps],
        "prediction_ekm_deg": [
            None if step.prediction_error_ekm is None else step.prediction_error_ekm / _DEG for step in steps
        ],
        "off_rotation_deg": steps[-1].off_rotation / _DEG if steps else 0.0,
        "seconds": [step.seconds for step in steps],
        "frames": [[np.asarray(part).tolist() for part in frame] for frame in frames],
    }
