from __future__ import annotations

import math

import numpy as np
import torch

from ...control import ClosedLoop, LookAndMoveController, PoseTarget, Safety, StoppingRule
from ...enhanced import EnhancedModel
from ...model import KinematicModel
from ...simulation import DisturbedPlant, PlantChange, SimulatedHand
from .stream import Stream

_DEG = math.pi / 180


def record_simulated_hand(n: int = 400, seed: int = 1000) -> Stream:
    """``y = ds - J_m da`` [mm, deg] of ``n`` motions with the nominal mismatch of the plant.

    The kinematic model turns the object towards targets drawn from 5 to 20 deg, at most ten motions each,
    then grasps again. Before motion ``n // 2`` all tendons are replaced, with pulleys of 0.85 instead of 1.3
    times their nominal radius.

    Args:
        seed: of grasps and targets; the recording repeats bit by bit.

    Raises:
        GraspError, EquilibriumError: the object could not be grasped.
    """
    draw = np.random.default_rng(seed)
    plant = SimulatedHand("icub_right", "box", preset="nominal")
    disturbed = DisturbedPlant(plant, [PlantChange(n // 2, {"moment_arm": 0.85, "tendon_elongation": 0.0})])
    model = KinematicModel(plant.hand, plant.object)
    safety = Safety(rule=StoppingRule(max_steps=10))
    enhanced, x, y, segments = None, [], [], []
    while len(x) < n:
        start = disturbed.reset(seed + len(segments)).state
        enhanced = EnhancedModel.for_grasp(model, start) if enhanced is None else enhanced
        controller = LookAndMoveController(model, plant.rotation_axis)
        target = PoseTarget.turned(start, plant.rotation_axis, draw.uniform(5, 20) * _DEG)
        before = len(x)
        for step in ClosedLoop(disturbed, controller, safety=safety).steps(target):
            x.append(enhanced.features(step.before.state, step.decision.delta_a))
            y.append((step.increment - step.decision.nominal)[enhanced.outputs] * enhanced.output_scale)
        segments.append(len(x) - before)
    plant.close()
    segments[-1] -= len(x) - n
    about = f"simulated icub_right turning the box, new tendons at {n // 2}; alone: the kinematic model"
    parts = tuple(length for length in segments if length)
    return Stream("simulated_hand", torch.stack(x[:n]), torch.stack(y[:n]), segments=parts, about=about)
