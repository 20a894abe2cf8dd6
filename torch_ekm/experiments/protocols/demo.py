"""The main job: a grasped object turned through the paper's angles, with the KM and with the E-KM."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch

from ...control import ClosedLoop, LookAndMoveController, PoseTarget, StoppingRule
from ...description import load_hand, load_object
from ...enhanced import EnhancedModel, grasp_learner
from ...exceptions import ParameterError, UnknownNameError
from ...model import KinematicModel, ModelOptions
from ...plant import Observation
from ...simulation import PlantConfig, PlantParameters, SimulatedHand
from ..runner import record_of

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
    return StoppingRule(tolerance=config.tolerance_deg * _DEG, max_steps=config.max_steps)


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
        start = plant.reset(seed).state
        if enhanced is None and controller == "E-KM":
            enhanced = EnhancedModel.for_grasp(model, start, partial(grasp_learner, capacity=config.capacity))
        axis = plant.rotation_axis
        loop = LookAndMoveController(model if enhanced is None else enhanced, axis)
        target = PoseTarget.turned(start, axis, degrees=angle)
        done = ClosedLoop(plant, loop, stopping_rule(config)).run(target)
        about = {"controller": controller, "seed": seed, "angle_deg": angle}
        frames = [_frame(seen) for seen in (*(step.before for step in done.steps), done.stop.final)]
        records.append({**about, **record_of(done, axis, enhanced is not None), "frames": frames})
        if on_trial is not None:
            on_trial()
    plant.close()
    return records


def _frame(seen: Observation) -> list[list[float]]:
    """True joint angles, position and rotation, for a picture."""
    assert seen.truth is not None  # a simulated hand tells
    return [part.tolist() for part in (seen.truth.q, seen.truth.position, seen.truth.rotation)]
