"""A simulated hand whose every figure is off is calibrated from its motions."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

pytest.importorskip("sapien")
pytest.importorskip("coal")

from torch_ekm.contact.forces.options import ForceOptions
from torch_ekm.description import HandDescription, load_hand, load_object
from torch_ekm.exceptions import GraspError, SolverError
from torch_ekm.model import KinematicModel, ModelOptions, calibrate
from torch_ekm.plant import RecordingPlant, Trajectory
from torch_ekm.simulation import PlantConfig, PlantParameters, SimulatedHand

KINDS = ("moment_arms", "springs", "stiffness")
DEG = np.pi / 180


def wrong(hand: HandDescription) -> HandDescription:
    """The hand that is simulated: each figure of the fingers that grasp is off by 10 to 30 %."""
    draw = np.random.default_rng([0, 7])

    def factor(shape: tuple[int, ...]) -> np.ndarray:
        return 1 + draw.uniform(0.1, 0.3, shape) * draw.choice([-1, 1], shape)

    grasping = np.array([name.startswith(("thumb", "index", "middle")) for name in hand.joint_names])
    J_a = np.where(grasping, factor(hand.actuation_jacobian.shape), 1.0) * hand.actuation_jacobian
    actuators = tuple(
        dataclasses.replace(actuator, stiffness=actuator.stiffness * k)
        for actuator, k in zip(hand.actuators, factor((hand.n_a,)), strict=True)
    )
    springs = np.where(grasping, factor((hand.n_q,)), 1.0) * hand.spring_stiffness
    return dataclasses.replace(hand, actuators=actuators, actuation_jacobian=J_a, spring_stiffness=springs)


def motions(hand: HandDescription, count: int) -> Trajectory:
    """Random positions of the motors that grasp, within 1.5 deg of the start of a grasp."""
    plant = RecordingPlant(SimulatedHand(hand, "box", PlantConfig(time_step=2e-3), PlantParameters()))
    draw, grasp, seen = np.random.default_rng([0, 8]), 0, None
    while seen is None:
        grasp += 1
        try:
            seen = plant.reset(grasp)
        except (GraspError, SolverError):
            continue
    start, moving = seen.a, np.array([not actuator.posture for actuator in hand.actuators])
    for _ in range(count):
        goal = start + torch.from_numpy(moving * draw.uniform(-1.5 * DEG, 1.5 * DEG, hand.n_a))
        seen = plant.command(goal - seen.a)
    plant.close()
    return plant.trajectory


@pytest.mark.slow
def test_four_motions_find_the_figures_of_a_wrong_hand():
    described = load_hand("icub_right")
    truth = wrong(described)
    # the simulated joints have no friction here: what the model does not explain is 4 mN m at most
    options = ModelOptions(forces=ForceOptions(torque_std=0.004))
    calibration = calibrate(
        KinematicModel(described, load_object("box"), options), [motions(truth, 4)], (*KINDS, "offset")
    )
    true = {"moment_arms": truth.actuation_jacobian, "springs": truth.spring_stiffness}
    errors: dict[str, list[float]] = {kind: [] for kind in true}
    for parameter, row in zip(calibration.unknowns.parameters, calibration.parameters, strict=True):
        if parameter.kind in true and row.identifiable and row.standard_error < 0.025 * abs(row.value):
            errors[parameter.kind].append(abs(row.value / true[parameter.kind][parameter.index] - 1))
    assert len(errors["moment_arms"]) >= 8  # of 10
    assert np.median(errors["moment_arms"]) < 0.02  # measured 0.0006
    assert np.median(errors["springs"]) < 0.05
    before, after = (np.linalg.norm(e) for e in (calibration.errors_before, calibration.errors_after))
    assert after < 0.3 * before
    (row,) = (row for row in calibration.parameters if row.label == "spring of ring_1")
    assert not row.identifiable  # a finger that touches nothing
