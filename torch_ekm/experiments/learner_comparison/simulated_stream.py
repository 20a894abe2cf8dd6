"""The residual of the kinematic model while the simulated hand turns an object, with new tendons half-way."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import torch

from ...control import ClosedLoop, LookAndMoveController, PoseTarget, StoppingRule
from ...enhanced import EnhancedModel
from ...model import KinematicModel
from ...simulation import Change, DisturbedPlant, PlantParameters, SimulatedHand
from .recording import Recording

_DEG = math.pi / 180


def record_simulated_hand(
    n: int = 400,
    seed: int = 1000,
    *,
    hand: str = "icub_right",
    object: str = "box",
    new_moment_arm: float | None = 0.85,
    on_sample: Callable[[], None] | None = None,
) -> Recording:
    """``y = ds - J_m da`` [mm, deg] of ``n`` motions with the nominal mismatch of the plant.

    The kinematic model turns the object towards targets drawn from 5 to 20 deg, at most ten motions each,
    then grasps anew. Before motion ``n // 2`` all tendons are replaced.

    Args:
        seed: of grasps and targets; the recording repeats bit by bit.
        new_moment_arm: factor of the new tendons' pulleys (1.3 before); None: no change.
        on_sample: called after each motion, for progress.

    Raises:
        GraspError, EquilibriumError: the object could not be grasped.
    """
    draw = np.random.default_rng(seed)
    plant = SimulatedHand(hand, object, parameters=PlantParameters.nominal_mismatch())
    events = [] if new_moment_arm is None else [Change.new_tendons(n // 2, new_moment_arm)]
    disturbed = DisturbedPlant(plant, events)
    model = KinematicModel(plant.hand, plant.object)
    rule = StoppingRule(max_steps=10)
    enhanced, x, y, segments = None, [], [], []
    while len(x) < n:
        start = disturbed.reset(seed + len(segments)).state
        enhanced = EnhancedModel.for_grasp(model, start) if enhanced is None else enhanced
        controller = LookAndMoveController(model, plant.rotation_axis)
        target = PoseTarget.turned(start, plant.rotation_axis, draw.uniform(5, 20) * _DEG)
        before = len(x)
        for step in ClosedLoop(disturbed, controller, rule).steps(target):
            x.append(enhanced.features(step.before.state, step.decision.delta_a))
            y.append((step.increment - step.decision.nominal)[enhanced.outputs] * enhanced.output_scale)
            if on_sample is not None:
                on_sample()
        segments.append(len(x) - before)
    plant.close()
    segments[-1] -= len(x) - n
    about = f"simulated {hand} turning the {object}, new tendons at {n // 2}; alone: the kinematic model"
    return Recording(
        "simulated_hand",
        torch.stack(x[:n]),
        torch.stack(y[:n]),
        segments=tuple(length for length in segments if length),
        about=about,
    )
