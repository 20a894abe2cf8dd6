"""How hard the hand grips: without fingertip sensors, with dead ones, and never above a limit."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from torch_ekm.contact.forces import ForceStatus
from torch_ekm.control import (
    ClosedLoop,
    GripForceTask,
    HandKnowledge,
    LinearizedModel,
    LookAndMoveController,
    NormalForceLimit,
    PoseTarget,
    Situation,
    StopReason,
)
from torch_ekm.exceptions import ParameterError
from torch_ekm.model import KinematicModel
from torch_ekm.plant import Observation, PlantWrapper
from torch_ekm.simulation import SimulatedHand


class Felt(PlantWrapper):
    """Fingertips read ``share`` of the force, or there are none; the true forces are noted."""

    def __init__(self, plant: SimulatedHand, share: list[float] | float | None) -> None:
        super().__init__(plant)
        self.share, self.forces = share, []

    def observation(self, seen: Observation) -> Observation:
        self.forces.append(seen.truth.fingertip_force[:3])
        share, force = self.share, seen.fingertip_force
        return dataclasses.replace(
            seen, fingertip_force=None if share is None else force * torch.tensor(share, dtype=force.dtype)
        )


@pytest.fixture(scope="module")
def plant() -> SimulatedHand:
    return SimulatedHand("icub_right", "box", preset="nominal")


@pytest.mark.parametrize(
    ("share", "seed", "most", "reason"),
    [
        (None, 0, 8.0, StopReason.REACHED),
        (0.0, 3, 8.0, StopReason.REACHED),
        ([1.0, 0, 1, 1, 1], 2, 6.0, StopReason.REACHED),
        (0.3, 2, 10.5, StopReason.STALLED),  # it waits for a grip that it never feels
    ],
    ids=["no sensors", "dead", "one dead", "a third"],
)
def test_hand_that_feels_nothing_or_wrong_neither_squeezes_nor_drops(
    plant, share, seed, most, reason
) -> None:
    felt = Felt(plant, share)
    start = felt.reset(seed)
    model = KinematicModel(plant.hand, plant.object)
    controller = LookAndMoveController(model, plant.rotation_axis)
    loop = ClosedLoop(felt, controller, knowledge=HandKnowledge.of(plant.hand))
    done = loop.run(PoseTarget.turned(start.state, plant.rotation_axis, degrees=15))
    assert done.reason is reason
    assert ("turning waits for a grip of" in done.stop.message) == (reason is StopReason.STALLED)
    forces = torch.stack(felt.forces)
    assert float(forces.max()) < most
    assert float(forces.min()) > 1.0  # no contact is lost


@pytest.fixture(scope="module")
def situation(plant):
    """A grasp at rest: its linearized model and what was seen."""
    seen = plant.reset(0)
    model = KinematicModel(plant.hand, plant.object)
    controller = LookAndMoveController(model, plant.rotation_axis)
    lin = model.linearize(seen.state)
    error = torch.zeros(6, dtype=torch.float64)
    at = Situation(plant.hand, controller.focus, seen.state, seen.a, None, error, error[:1])
    return controller, LinearizedModel.about(seen.a * 0, lin), at, seen


def test_model_stands_in_where_no_pad_measures(situation) -> None:
    _, model, at, seen = situation
    estimated = model.kinematic.forces.normal.numpy()
    np.testing.assert_array_equal(at.normal_force(model.kinematic), estimated)
    force = seen.fingertip_force.clone()
    force[1] = torch.nan
    mixed = dataclasses.replace(at, fingertip_force=force).normal_force(model.kinematic)
    np.testing.assert_array_equal(mixed, [force[0], estimated[1], force[2]])
    felt = dataclasses.replace(at, fingertip_force=seen.fingertip_force)
    measured, blind = (GripForceTask().wanted(model.kinematic, each) for each in (felt, at))
    assert blind == pytest.approx(measured + 2.0), "an estimate of a finger is wrong by 1 N"
    failed = dataclasses.replace(model.kinematic.forces, status=(ForceStatus.FAILED,))
    lost = dataclasses.replace(model, kinematic=dataclasses.replace(model.kinematic, forces=failed))
    assert GripForceTask().rows(lost, at) is NormalForceLimit().rows(lost, at) is None


def test_pads_loosen_what_is_too_much_and_an_estimate_only_stops_the_squeezing(situation) -> None:
    _, model, at, _ = situation
    f_n, n = model.kinematic.forces.normal.numpy(), model.kinematic.contacts.n_c
    for reading, most in ((None, -0.2), (torch.full((len(at.hand.pads),), 0.5), 0.0)):
        seen = dataclasses.replace(at, fingertip_force=reading)
        rows = NormalForceLimit(maximum=f_n.max() - 0.2).rows(model, seen)
        S, h = model.kinematic.normal_force_sensitivity.numpy(), np.asarray(rows.h)
        np.testing.assert_allclose(rows.C, np.concatenate([-S, S]))
        thumb = f_n.argmax()
        assert h[n + thumb] == pytest.approx(most)
        assert -h[thumb] <= h[n + thumb]  # the lower limit gives way
    strict = NormalForceLimit(maximum=1.0).rows(model, at)
    assert strict.h[n:].min() == -0.7  # no more than a step at a time


def test_limits_that_cross_are_refused() -> None:
    with pytest.raises(ParameterError, match="maximum"):
        NormalForceLimit(minimum=5.0, maximum=4.0)


def test_dead_sensors_are_none(situation) -> None:
    controller, _, at, seen = situation
    target = PoseTarget.turned(seen.state, torch.tensor([0.0, 1, 0]).double(), degrees=5)
    controller.reset()
    dead = controller.decide(at.state, at.a, target, 0.1 + 0 * seen.fingertip_force)
    controller.reset()
    without = controller.decide(at.state, at.a, target)
    assert torch.equal(dead.delta_a, without.delta_a)
