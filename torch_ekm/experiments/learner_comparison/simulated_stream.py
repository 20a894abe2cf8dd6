"""The residual of the kinematic model while the simulated hand turns an object, with new tendons half-way."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import torch

from ...control import (
    ControllerOptions,
    Decision,
    FocusedPose,
    LookAndMoveController,
    PoseTarget,
    StoppingRule,
)
from ...kinematics import GraspState
from ...model import KinematicModel
from ...plant import Observation
from ...simulation import Change, DisturbedPlant, PlantParameters, SimulatedHand
from ...typing import Tensor
from ..learners import make_enhanced
from ..manipulation import run_manipulation, state_of
from ..protocols.demo import fixed_actuators
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
    rule = StoppingRule(tolerance=0.25 * _DEG, stall_progress=0.1 * _DEG, max_steps=10)
    enhanced, x, y, segments = None, [], [], []
    while len(x) < n:
        start = state_of(disturbed.reset(seed + len(segments)))
        enhanced = make_enhanced(model, start, 1) if enhanced is None else enhanced
        controller = LookAndMoveController(
            model,
            FocusedPose.rotation_about(plant.rotation_axis),
            ControllerOptions(fixed_actuators=fixed_actuators(plant.hand)),
        )
        before: list[tuple[GraspState, Tensor, Tensor]] = []

        def remember(seen: Observation, decision: Decision, log: list = before) -> None:
            log.append((state_of(seen), decision.delta_a, decision.nominal))
            if on_sample is not None:
                on_sample()

        target = PoseTarget.turned(start, plant.rotation_axis, draw.uniform(5, 20) * _DEG)
        done = run_manipulation(disturbed, controller, target, rule, learn=False, on_step=remember)
        for (state, action, nominal), step in zip(before, done.steps, strict=False):
            x.append(enhanced.features(state, action))
            y.append((step.increment - nominal)[enhanced.outputs] * torch.as_tensor(enhanced.output_scale))
        segments.append(len(done.steps))
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
