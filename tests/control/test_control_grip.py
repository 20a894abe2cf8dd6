"""How hard the hand grips: without fingertip sensors, with dead ones, and never above a limit."""

import dataclasses
import math

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
    StepBound,
    StopReason,
)
from torch_ekm.control.decision import Grip
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
def test_hand_that_feels_nothing_or_wrong_neither_squeezes_nor_drops(plant, share, seed, most, reason):
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


# -- the grip by the object, and how much of a step is made ----------------------------------------------

DEG = math.pi / 180


def test_the_grip_follows_from_weight_friction_and_lever(pinch) -> None:
    """``f = 2.5/mu (m g/2 + 95 r)``: 80 g, mu = 0.9, contacts about 15 mm from the axis."""
    plant, model, seen = pinch
    lin = model.linearize(seen.state)
    task, axis = GripForceTask(least=1.0), LookAndMoveController(model, plant.rotation_axis).focus
    force = seen.fingertip_force
    at = Situation(
        plant.hand, axis, seen.state, seen.a, force, torch.zeros(6), torch.zeros(1), weight=0.08 * 9.81
    )
    arm = torch.linalg.cross(plant.rotation_axis.expand(3, 3), lin.contacts.point - seen.position)
    lever = float(torch.linalg.vector_norm(arm, dim=-1).max())
    assert task.wanted(lin, at) == pytest.approx(2.5 / 0.9 * (0.04 * 9.81 + 95 * lever), rel=1e-3)
    heavy = dataclasses.replace(at, weight=4.0)
    assert task.wanted(lin, heavy) == task.most == 8.5
    assert GripForceTask().wanted(lin, dataclasses.replace(at, weight=0.0)) >= 5.0
    tighter = dataclasses.replace(at, tighter=0.5)
    assert task.wanted(lin, tighter) == pytest.approx(task.wanted(lin, at) + 0.5)
    assert GripForceTask(force=4.0).wanted(lin, tighter) == 4.5


def test_a_step_is_cut_in_proportion_to_what_is_predicted_to_go_wrong(pinch) -> None:
    plant, model, seen = pinch
    controller = LookAndMoveController(model, plant.rotation_axis, bound=None)
    focus, target = controller.focus, PoseTarget.turned(seen.state, plant.rotation_axis, degrees=5.0)
    step = controller.decide(seen.state, seen.a, target)
    lin = step.linearization
    on = torch.zeros(6, dtype=torch.float64)
    at = Situation(plant.hand, focus, seen.state, seen.a, None, on, torch.zeros(1), weight=0.8)
    firm = Grip(torch.ones(3), torch.ones(3), 1.0)

    def share(delta_a=None, off=on, asked: float = 1.0, seen: Situation = at, grip: Grip = firm) -> float:
        still = torch.zeros(plant.hand.n_a, dtype=torch.float64) if delta_a is None else delta_a
        predicted = torch.cat([torch.zeros(plant.hand.n_q, dtype=torch.float64), off])
        decided = dataclasses.replace(step, delta_a=still, predicted=predicted, grip=grip)
        return StepBound().share(decided, seen, asked)

    assert share() == 1.0
    assert share(off=3 * DEG * focus.off_matrix[~focus.off_translation][0]) == pytest.approx(0.5)
    carried = 10e-3 * focus.off_matrix[focus.off_translation][0]
    shares = [share(off=carried, asked=asked) for asked in (0.3, 0.5, 1.0, 2.0)]
    assert shares == pytest.approx([1.0, 0.7, 0.35, 0.25])  # none below 0.35 of the largest step
    still = torch.zeros(plant.hand.n_a, dtype=torch.float64)
    slopes = torch.autograd.functional.jacobian(lin.margins_after, still)  # [N/rad]
    slides = -slopes[0]
    slides *= 40.0 / float(slides.square().sum())  # [N] that the margin falls by
    assert share(slides, asked=2.0) < 1.0
    grips = [firm._replace(wanted=wanted) for wanted in (1 / 1.2, 1 / 0.75, 1 / 0.65, 1 / 0.55, 1 / 0.3, 0.0)]
    assert [grip.bears for grip in grips] == pytest.approx([1.0, 1.0, 0.5, 0.0, 0.0, 1.0])
    assert [bool(grip.waits) for grip in grips] == [False, False, True, True, True, False]
    felt = dataclasses.replace(at, fingertip_force=seen.fingertip_force)
    assert [share(seen=one, grip=grips[3]) for one in (at, felt)] == [0.35, 0.0]  # an estimate does not wait
    # a motion that takes the margins away: the heavier the object, the less of it is made
    delta = 4 * DEG * -torch.sign(slopes.sum(0))
    heavier = [dataclasses.replace(at, weight=weight) for weight in (0.3, 3.0)]
    shares = [share(delta, asked=10.0, seen=one) for one in heavier]
    assert 0 < shares[1] < shares[0] < 1


def test_a_measured_grip_that_is_too_weak_is_tightened_and_not_turned(pinch) -> None:
    plant, model, seen = pinch
    target = PoseTarget.turned(seen.state, plant.rotation_axis, degrees=20.0)
    felt = torch.tensor([2.9, 1.4, 1.4, 0.0, 0.0], dtype=torch.float64)
    decision = LookAndMoveController(model, plant.rotation_axis).decide(seen.state, seen.a, target, felt)
    assert 0.0 < float(decision.desired.norm()) < 0.3 * DEG
    change = decision.linearization.normal_force_sensitivity @ decision.delta_a
    assert float(change[0]) > 0.3  # [N]
