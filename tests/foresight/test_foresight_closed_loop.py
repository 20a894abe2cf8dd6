"""A turn in SAPIEN with foresight: as exact as step by step, and with more friction to spare."""

from __future__ import annotations

import math

import pytest

pytest.importorskip("sapien")
pytest.importorskip("coal")

from torch_ekm.control import ClosedLoop, LookAndMoveController, PoseTarget, StopReason
from torch_ekm.foresight import HorizonController
from torch_ekm.model import KinematicModel
from torch_ekm.simulation import SimulatedHand

DEG = math.pi / 180


def test_contacts_have_more_to_spare_where_the_turn_is_planned():
    least = {}
    for kind in (LookAndMoveController, HorizonController):
        plant = SimulatedHand("icub_right", "box")
        try:
            seen = plant.reset(2)
            controller = kind(KinematicModel(plant.hand, plant.object), plant.rotation_axis)
            done = ClosedLoop(plant, controller).run(
                PoseTarget.turned(seen.state, plant.rotation_axis, degrees=20)
            )
        finally:
            plant.close()
        assert done.reason is StopReason.REACHED
        assert done.errors[-1] < 0.25 * DEG
        assert len(done.steps) <= 14
        margins = [float(step.decision.linearization.margins.min()) for step in done.steps]
        least[kind] = sorted(margins)[len(margins) // 2]
        print(kind.__name__, len(done.steps), margins)
    assert least[HorizonController] > least[LookAndMoveController] + 0.2  # [N], the median motion's
