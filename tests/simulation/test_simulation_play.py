"""The play that a transmission file states: the simulated hand has it, and `Play` follows it."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

pytest.importorskip("sapien")

from torch_ekm.description import load_hand
from torch_ekm.kinematics import Play
from torch_ekm.simulation import SimulatedHand

F64 = torch.float64


def hand_with_play(width):
    hand = load_hand("icub_right")
    actuators = tuple(dataclasses.replace(actuator, backlash=width) for actuator in hand.actuators)
    return dataclasses.replace(hand, actuators=actuators)


def wanted(steps):
    """To and fro, the motors that turn the object."""
    delta = torch.zeros(9, dtype=F64)
    delta[[2, 3, 5, 7]] = 0.02
    return [delta * sign for sign in ([1, -1] * steps)[:steps]]


def test_the_state_follows_the_tendons_of_the_simulation():
    plant = SimulatedHand(hand_with_play(0.02), "box")
    try:
        seen = plant.reset(0)
        play = Play.of(plant.hand)
        state = play.at(torch.zeros(9, dtype=F64))
        for delta in wanted(4):
            after = plant.command(0.7 * delta)
            _, state = play.advance(state, after.a - seen.a)
            seen = after
            np.testing.assert_allclose(seen.a + state.position, plant._rig.servo.output, atol=1e-12)
    finally:
        plant.close()
