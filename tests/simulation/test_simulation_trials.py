"""The smallest changes with which a pinch holds, put into the hand or the object."""

import dataclasses
import re

import numpy as np
import pytest

from torch_ekm.description import load_hand, load_object
from torch_ekm.exceptions import EquilibriumError
from torch_ekm.simulation import PlantConfig, PlantParameters
from torch_ekm.simulation.grasp_planning import pinch
from torch_ekm.simulation.grasp_planning.pinch import pinch_problem, plan_pinch
from torch_ekm.simulation.grasp_planning.pinch_problem import PinchRequest
from torch_ekm.simulation.grasp_planning.trials import smallest_changes

HAND = load_hand("planar_two_finger")
SOFT = dataclasses.replace(HAND, spring_stiffness=HAND.spring_stiffness / 4)
CAN = load_object("can")


def plan(hand, obj, force=5.0):
    return plan_pinch(pinch_problem(hand, obj, PlantConfig(), PlantParameters()), PinchRequest(force))


def test_a_change_holds_and_half_of_it_does_not(monkeypatch):
    monkeypatch.setattr(pinch, "_GUESSES", 1)
    force, _, springs = smallest_changes(SOFT, CAN, PlantConfig(), PlantParameters())
    force, stiffer = float(re.search(r"[\d.]+", force)[0]), float(re.search(r"[\d.]+", springs)[0])
    plan(SOFT, CAN, 0.97 * force)
    with pytest.raises(EquilibriumError, match=r"the fingertips reach it; torque is to blame: joint '\w+_1'"):
        plan(SOFT, CAN, (5.0 * force) ** 0.5)
    plan(dataclasses.replace(SOFT, spring_stiffness=1.03 * stiffer * SOFT.spring_stiffness), CAN)


def test_the_error_says_which_spring_or_arm_the_joint_needs(monkeypatch):
    monkeypatch.setattr(pinch, "_GUESSES", 1)
    with pytest.raises(EquilibriumError) as failed:
        plan(SOFT, CAN)
    told = r"'left_1' .* spring of ([\d.]+) N m/rad, not 0.025, or an arm of 'left' below ([\d.]+), not 0.8"
    spring, arm = map(float, re.search(told, str(failed.value)).groups())

    def changed(figure, by):
        springs, arms = SOFT.spring_stiffness.copy(), SOFT.actuation_jacobian.copy()
        last = [name.endswith("_1") for name in SOFT.joint_names]
        if figure == "spring":
            springs[last] = spring * by
        else:
            arms[:, last] = np.where(arms[:, last], arm / by, 0.0)
        return dataclasses.replace(SOFT, spring_stiffness=springs, actuation_jacobian=arms)

    for figure in ("spring", "arm"):
        plan(changed(figure, 1.1), CAN)
        with pytest.raises(EquilibriumError):
            plan(changed(figure, 0.8), CAN)


def test_an_object_that_is_too_wide_is_told_how_wide_it_may_be(monkeypatch):
    monkeypatch.setattr(pinch, "_GUESSES", 1)  # the others fail too
    shapes, width = tuple(one.scaled(3.0) for one in CAN.shapes), 3 * CAN.grasp_width
    wide = dataclasses.replace(CAN, shapes=shapes, grasp_width=width)
    with pytest.raises(EquilibriumError, match=r"geometry is to blame: link '\w+' would be \d+ mm inside it"):
        plan(HAND, wide)
    (change,) = smallest_changes(HAND, wide, PlantConfig(), PlantParameters())
    told = re.match(r"an object ([\d.]+) mm wide, not 120.0", change)
    assert 40 < float(told[1]) < 118


def test_a_pinch_that_holds_in_the_middle_needs_no_other_figure(monkeypatch):
    monkeypatch.setattr(pinch, "_GUESSES", 1)
    (change,) = smallest_changes(HAND, CAN, PlantConfig(), PlantParameters())
    assert "spread = 0" in change


def test_the_joint_in_the_way_is_the_one_that_was_narrowed(monkeypatch):
    monkeypatch.setattr(pinch, "_GUESSES", 1)
    upper = HAND.joint_upper.copy()
    upper[-1] = 0.02
    narrow = dataclasses.replace(HAND, joint_upper=upper)
    (change,) = smallest_changes(narrow, CAN, PlantConfig(), PlantParameters())
    limit = re.fullmatch(rf"limits of '{HAND.joint_names[-1]}' at (\d+) deg, not 1", change)
    upper[-1] = np.radians(float(limit[1]) + 5.0)  # the planner keeps off stops
    plan(dataclasses.replace(HAND, joint_upper=upper), CAN)
