"""The pace, the grip by the object, the bound of a step, and the way back."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch
from fakes import HoldingPlant

from torch_ekm.control import (
    Caution,
    ClosedLoop,
    Direction,
    FocusedPose,
    GripForceTask,
    LookAndMoveController,
    Pace,
    PaceOptions,
    PoseTarget,
    Safety,
    Situation,
    StepBound,
    StoppingRule,
    TrustRegion,
)
from torch_ekm.control import StopReason as Reason
from torch_ekm.control.pace import ForceSurprise
from torch_ekm.control.safety.progress import Progress
from torch_ekm.exceptions import ParameterError
from torch_ekm.kinematics.se3 import exp
from torch_ekm.model import KinematicModel
from torch_ekm.plant import Observation
from torch_ekm.simulation import SimulatedHand

DEG = math.pi / 180
RULE = StoppingRule(max_steps=20)


class Sliding(HoldingPlant):
    """The object stays, but for what ``off`` says of each observation after a motion."""

    def __init__(self, seen: Observation, across: torch.Tensor, off: list[float]) -> None:
        super().__init__(seen)
        self.across, self.off = across, off

    def observe(self) -> Observation:
        angle = self.off[min(len(self.commands), len(self.off) - 1)] * DEG
        return self.reading(rotation=exp(angle * self.across) @ self.seen.rotation)


@pytest.fixture(scope="module")
def held():
    plant = SimulatedHand("icub_right", "box")
    seen = plant.reset(seed=4)
    return plant, KinematicModel(plant.hand, plant.object), seen


def slide(held, off: list[float], caution: Caution):
    plant, model, seen = held
    axis = plant.rotation_axis
    across = torch.linalg.cross(axis, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))
    sliding = Sliding(seen, across / torch.linalg.vector_norm(across), off)
    loop = ClosedLoop(sliding, LookAndMoveController(model, axis), safety=Safety(RULE, caution))
    return loop.run(PoseTarget.turned(seen.state, axis, degrees=20.0)), sliding, loop


CAREFUL = Caution(off_rotation=1.0 * DEG, retreats=1, tighten=0.5)


def test_a_sign_of_a_loss_sends_the_hand_back_and_a_second_one_ends_the_turn(held) -> None:
    # motions: 1 and 2 go forth, 3 goes back and helps, 4 goes forth, 5 goes back: enough
    done, sliding, loop = slide(held, [0.0, 0.0, 1.2, 0.5, 2.0, 0.6], CAREFUL)
    assert done.reason is Reason.GIVEN_UP
    assert not done.lost
    assert "off the focus" in done.stop.message
    assert [step.retreat for step in done.steps] == [False, False, True, False, True]
    torch.testing.assert_close(sliding.commands[2], -sliding.commands[1])
    torch.testing.assert_close(sliding.commands[4], -sliding.commands[3])
    assert loop.controller.tighter == CAREFUL.tighten


def test_the_way_back_is_gone_as_far_as_it_helps(held) -> None:
    done, sliding, _ = slide(held, [0.0, 0.0, 0.0, 1.8, 1.2, 0.9, 0.0], CAREFUL)
    assert [step.retreat for step in done.steps][:5] == [False, False, False, True, True]
    torch.testing.assert_close(sliding.commands[3], -sliding.commands[2])
    torch.testing.assert_close(sliding.commands[4], -sliding.commands[1])


def test_an_object_that_is_lost_on_the_way_back_is_not_called_given_up(held) -> None:
    done, _, _ = slide(held, [0.0, 0.0, 1.8, 1.2, 31.0, 31.0], CAREFUL)
    assert done.lost
    assert "off the focus" in done.stop.message


def test_where_going_back_does_not_help_the_turn_is_given_up_at_once(held) -> None:
    done, _, _ = slide(held, [0.0, 0.0, 1.9, 1.8, 1.7, 1.7], CAREFUL)
    assert done.reason is Reason.GIVEN_UP
    assert [step.retreat for step in done.steps] == [False, False, True, True]


def test_an_object_that_slid_is_not_turned_on(held) -> None:
    done, _, _ = slide(held, [0.0, 0.0, 1.2, 1.3, 0.0, 0.0], CAREFUL)
    assert done.reason is Reason.GIVEN_UP
    assert [step.retreat for step in done.steps] == [False, False, True]


@pytest.mark.parametrize(
    ("off", "unit", "rehearsed", "far"),
    [(1.4, "mm", False, False), (1.6, "mm", False, True), (1.4, "mm", True, True), (1.4, "deg", False, True)],
)
def test_shifts_may_turn_the_object_further(held, off: float, unit: str, rehearsed: bool, far: bool) -> None:
    plant, _, seen = held
    axis, target = plant.rotation_axis, PoseTarget(seen.state.position, seen.state.rotation)
    across = torch.linalg.cross(axis, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))
    progress = Progress(Safety(RULE, CAREFUL), target, FocusedPose([Direction(axis, unit)]), seen, rehearsed)
    after = dataclasses.replace(seen, rotation=PoseTarget.turned(seen.state, across, degrees=off).rotation)
    assert progress.stays_off(seen, after) is far


def test_a_refused_state_is_looked_at_again(held) -> None:
    plant, model, seen = held
    away = dataclasses.replace(seen, position=seen.position + 0.2)

    class Glimpse(Sliding):
        def observe(self) -> Observation:
            good = super().observe()
            return away if self.looks in (2, 3) else good  # the first motion's reading and the next look

    sliding = Glimpse(seen, plant.rotation_axis, [0.0])
    loop = ClosedLoop(sliding, LookAndMoveController(model, plant.rotation_axis), safety=Safety(RULE))
    target = PoseTarget.turned(seen.state, plant.rotation_axis, degrees=20.0)
    steps = loop.steps(target)
    next(steps)
    assert not next(steps).retreat
    assert sliding.looks == 5


def test_the_grip_follows_from_weight_friction_and_lever(held) -> None:
    """``f = 2.5/mu (m g/2 + 95 r)``: 80 g, mu = 0.9, contacts about 15 mm from the axis."""
    plant, model, seen = held
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


def test_a_step_is_cut_in_proportion_to_what_is_predicted_to_go_wrong(held) -> None:
    plant, model, seen = held
    controller = LookAndMoveController(model, plant.rotation_axis)
    lin, focus = model.linearize(seen.state), controller.focus
    on = torch.zeros(6, dtype=torch.float64)
    at = Situation(plant.hand, focus, seen.state, seen.a, None, on, torch.zeros(1), weight=0.8)
    still, bound = torch.zeros(plant.hand.n_a, dtype=torch.float64), StepBound()
    predicted = torch.zeros(plant.hand.n_q + 6, dtype=torch.float64)
    assert bound.share(lin, still, predicted, at) == 1.0
    off = focus.off_matrix[~focus.off_translation][0]
    turned = predicted.clone()
    turned[-6:] = 3 * DEG * off
    assert bound.share(lin, still, turned, at) == pytest.approx(0.5)
    carried = predicted.clone()
    carried[-6:] = 10e-3 * focus.off_matrix[focus.off_translation][0]
    assert bound.share(lin, still, carried, at) == pytest.approx(0.25)
    slides = -lin.margin_sensitivity[0]
    slides *= 40.0 / float(slides.square().sum())  # [N] that the margin falls by
    at_once = [bound.share(lin, slides, predicted, at, asked) for asked in (0.5, 1.0, 2.0)]
    assert at_once[0] == at_once[1] < at_once[2] < 1.0  # what was predicted well may slide by more
    for turned, room in ((1.0, 1.0), (2.0, 0.5), (3.0, 0.0)):
        away = dataclasses.replace(at, error=turned * DEG * off)
        share = at_once[0] + room * (at_once[2] - at_once[0])
        assert bound.share(lin, slides, predicted, away, 2.0) == pytest.approx(share, rel=1e-3)
    force = float(at.normal_force(lin).max())  # type: ignore[union-attr]
    grips = [dataclasses.replace(at, grip=force / part) for part in (1.2, 0.75, 0.65, 0.55, 0.3)]
    assert [bound.grip_share(lin, one) for one in grips] == pytest.approx([1.0, 1.0, 0.5, 0.0, 0.0])
    assert bound.grip_share(lin, at) == 1.0  # nothing is asked of it
    at = dataclasses.replace(at, grip=6.0)
    # the sum of three fingers is right, but one of the two that share a side bears half of its part
    felt = torch.tensor([6.0, 4.5, 1.5], dtype=torch.float64)
    uneven = dataclasses.replace(at, fingertip_force=torch.cat([felt, torch.full((2,), torch.nan)]))
    part = (1.5 / (bound.even * 3.0)) ** 2
    shares = [bound.share(lin, still, predicted, uneven, asked) for asked in (0.3, 1.0, 2.0, 4.0)]
    assert shares == pytest.approx([1.0, 1.0, 0.5, part])  # steps of pace 1 are not cut
    assert StepBound(even=0.5).share(lin, still, predicted, uneven, 4.0) == 1.0
    felt = torch.tensor([6.0, 4.5, -1.5, torch.nan, torch.nan], dtype=torch.float64)  # of a pad that drifts
    off = dataclasses.replace(at, fingertip_force=felt)
    assert bound.share(lin, still, predicted, off, 4.0) == pytest.approx(0.25)
    felt = torch.tensor([6.0, -0.5, -0.5, torch.nan, torch.nan], dtype=torch.float64)  # nobody opposes
    alone = dataclasses.replace(at, fingertip_force=felt)
    assert bound.share(lin, still, predicted, alone, 4.0) == pytest.approx(0.25)
    # a motion that takes the margins away: the heavier the object, the less of it is made
    delta = 4 * DEG * torch.from_numpy(np.sign(lin.margin_sensitivity.sum(0).numpy())) * -1.0
    heavier = [dataclasses.replace(at, grip=None, weight=weight) for weight in (0.3, 3.0)]
    shares = [bound.share(lin, delta, predicted, one) for one in heavier]
    assert 0 < shares[1] < shares[0] < 1


def test_a_grip_that_is_too_weak_is_tightened_and_not_turned(held) -> None:
    plant, model, seen = held
    target = PoseTarget.turned(seen.state, plant.rotation_axis, degrees=20.0)
    felt = torch.tensor([2.9, 1.4, 1.4, 0.0, 0.0], dtype=torch.float64)
    decision = LookAndMoveController(model, plant.rotation_axis).decide(seen.state, seen.a, target, felt)
    assert 0.0 < decision.share < 0.1
    change = decision.linearization.normal_force_sensitivity @ decision.delta_a
    assert float(change[0]) > 0.3  # [N]


def test_the_bound_shortens_the_step_that_is_made(held) -> None:
    plant, model, seen = held
    target = PoseTarget.turned(seen.state, plant.rotation_axis, degrees=20.0)
    whole, cut = (
        LookAndMoveController(
            model, plant.rotation_axis, pace=Pace(PaceOptions(bound=StepBound(off_travel=x)), adapts=False)
        ).decide(seen.state, seen.a, target, seen.fingertip_force)
        for x in (1.0, 1e-5)
    )
    assert whole.share > 0.9
    assert cut.share == pytest.approx(StepBound().least)
    torch.testing.assert_close(cut.desired, cut.share / whole.share * whole.desired)


def test_the_pace_grows_where_the_model_is_right_and_shrinks_where_it_is_not() -> None:
    grow, shrink = 1.2, 0.7
    pace, trust = Pace(), TrustRegion()
    predicted = torch.tensor([0.0, 0.0, 0.0, 2.5 * DEG, 0.0, 0.0], dtype=torch.float64)
    wrong = predicted + torch.tensor([0.0, 0.0, 0.0, 0.0, 3 * DEG, 0.0], dtype=torch.float64)
    assert trust.disagreement(predicted, predicted, 0.015) == 0.0
    pace.judge(0.0)
    assert pace.factor == pytest.approx(trust.start * grow)
    # one direction of six is wrong by 3 deg: rho^2 = 9 / 6 / (0.3^2 + (0.12 * 2.5)^2)
    rho = trust.disagreement(predicted, wrong, 0.015)
    assert rho == pytest.approx(math.sqrt(9 / 6 / 0.18), rel=1e-6)
    pace.judge(rho)
    assert pace.factor == pytest.approx(trust.start * grow * shrink)
    before = pace.factor
    pace.judge(0.0, share=0.5)  # half a step says nothing for a larger one
    assert pace.factor == before
    # the worst finger counts, for the share of its own force: 2 N of 1.5 N are wrong, 2 N of 8 N are not
    for bears, rho in ((1.5, 2 / math.hypot(0.5, 0.25 * 1.5)), (8.0, 2 / math.hypot(0.5, 2.0))):
        forces = torch.tensor([6.0, bears, 4.0], dtype=torch.float64)
        off = torch.tensor([0.0, -2.0, torch.nan], dtype=torch.float64)
        felt = ForceSurprise((0, 1, 2), forces, forces + off, off, off.isnan())
        assert trust.disagreement(predicted, predicted, 0.015, felt) == pytest.approx(rho)
    pace.judge(2.0)
    assert pace.factor < before
    for _ in range(50):
        pace.judge(0.0)
    assert pace.factor == trust.largest
    error = torch.tensor([0.5], dtype=torch.float64)  # forces that nobody feels drift: no step beyond pace 1
    assert float(pace.ask(error)[0]) == pytest.approx(trust.largest * pace.options.limiting.step)
    assert float(pace.ask(error, measures=False)[0]) == pytest.approx(pace.options.limiting.step)
    assert pace.factor == 1.0  # it grows again only where a pad measures
    for _ in range(50):
        pace.judge(0.0)
    other = Pace()
    other.load_state_dict(pace.state_dict())
    other.begin(1.0)  # not new
    assert other.factor == trust.largest
    for last, first in ((0.0, trust.start), (0.5, trust.start), (1.2, 1.2), (trust.largest, 1.4)):
        other = Pace()
        other.begin(last)
        assert other.factor == first
    slow = Pace(PaceOptions(trust=TrustRegion(start=0.7, largest=1.0)))
    for last in (2.0, math.nan):
        slow.begin(last)
        assert slow.factor == 1.0
    slow.restart()
    slow.begin(2.0)  # something went wrong: no new object
    assert slow.factor == trust.smallest / 2
    pace.restart()
    assert pace.factor == trust.smallest / 2
    pace.judge(9.0)
    assert pace.factor == trust.smallest / 2


def test_the_pace_of_a_model_that_does_not_learn_stays_1() -> None:
    pace = Pace(adapts=False)
    pace.judge(9.0)
    pace.judge(0.0)
    pace.restart()
    assert pace.factor == 1.0


@pytest.mark.parametrize(
    ("kind", "figures"),
    [
        (TrustRegion, {"start": 0.1}),
        (TrustRegion, {"start": 3.0}),
        (Caution, {"retreats": -1}),
        (StepBound, {"creep": 0.0}),
    ],
)
def test_figures_outside_their_range_are_refused(kind, figures) -> None:
    with pytest.raises(ParameterError, match=next(iter(figures))):
        kind(**figures)


def test_a_pace_outside_its_range_is_named() -> None:
    with pytest.raises(ParameterError, match=r"smallest = -1.0 .* above 0"):
        TrustRegion(smallest=-1.0)
    with pytest.raises(ParameterError, match=r"start = 3.0 .* between 0.5 and 2"):
        TrustRegion(start=3.0)
