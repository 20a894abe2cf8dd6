"""The smallest changes with which a pinch holds, each put into the hand or the object."""

from __future__ import annotations

import dataclasses
import re

import pytest

from torch_ekm.description import load_hand, load_object
from torch_ekm.exceptions import EquilibriumError
from torch_ekm.simulation import PlantConfig, PlantParameters
from torch_ekm.simulation.grasp_planning.doctor import smallest_changes
from torch_ekm.simulation.grasp_planning.pinch import pinch_problem, plan_pinch
from torch_ekm.simulation.grasp_planning.pinch_problem import PinchRequest

HAND = load_hand("planar_two_finger")
SOFT = dataclasses.replace(HAND, spring_stiffness=HAND.spring_stiffness / 4)
CAN = load_object("can")


def plan(hand, obj, force=5.0):
    return plan_pinch(pinch_problem(hand, obj, PlantConfig(), PlantParameters()), PinchRequest(force))


def test_a_change_of_figures_holds_and_half_of_it_does_not():
    changes = " ".join(smallest_changes(SOFT, CAN, PlantConfig(), PlantParameters()).changes)
    force = re.search(r"pinch_force of ([\d.]+) N", changes)
    arm = re.search(r"an arm of ([\d.]+) of 'left' and 'right' at '(left_[01])' and '(right_[01])'", changes)
    assert force is not None
    assert arm is not None
    plan(SOFT, CAN, 0.97 * float(force[1]))
    with pytest.raises(EquilibriumError, match=r"the fingertips reach it; torque is to blame: joint '\w+_1'"):
        plan(SOFT, CAN, (5.0 * float(force[1])) ** 0.5)

    arms = SOFT.actuation_jacobian.copy()
    for row, joint in enumerate(arm.groups()[1:]):
        at = SOFT.joint_names.index(joint)
        arms[row, at] = float(arm[1]) * (float(arm[1]) / arms[row, at]) ** 0.05
    plan(dataclasses.replace(SOFT, actuation_jacobian=arms), CAN)


def test_an_object_that_is_too_wide_is_told_how_wide_it_may_be():
    hand, box = load_hand("icub_right"), load_object("box")
    wide = dataclasses.replace(
        box, shapes=tuple(one.scaled(3.0) for one in box.shapes), grasp_width=3 * box.grasp_width
    )
    with pytest.raises(EquilibriumError, match=r"geometry is to blame: link '\w+' would be \d+ mm inside it"):
        plan(hand, wide)
    (change,) = smallest_changes(hand, wide, PlantConfig(), PlantParameters()).changes
    width = re.match(r"an object ([\d.]+) mm wide, not 90.0 \(as far as geometry goes\)", change)
    assert width is not None
    assert 30 < float(width[1]) < 88


def test_a_pinch_that_holds_in_the_middle_needs_no_other_figure():
    (change,) = smallest_changes(HAND, CAN, PlantConfig(), PlantParameters()).changes
    assert "spread = 0" in change
