"""Play of the drive against the simulator's servo, from known and unknown starts."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from torch_ekm.description import load_hand
from torch_ekm.exceptions import ParameterError, ShapeError
from torch_ekm.kinematics import Play
from torch_ekm.simulation import PlantParameters
from torch_ekm.simulation.mechanism.servo import Servo

F64 = torch.float64
WIDTH = torch.tensor([0.02, 0.05, 0.0], dtype=F64)


def walk(seed, steps=40):
    return 0.03 * torch.randn(steps, 3, generator=torch.Generator().manual_seed(seed), dtype=F64)


def servo():
    mechanism = Servo(
        np.full(3, -10.0), np.full(3, 10.0), PlantParameters(), described_backlash=WIDTH.numpy()
    )
    mechanism.place(np.zeros(3))
    return mechanism


@pytest.mark.parametrize("seed", range(5))
def test_it_is_the_play_of_the_simulated_servo(seed):
    mechanism, play = servo(), Play(WIDTH)
    state = play.at(torch.zeros(3, dtype=F64))
    for delta in walk(seed):
        before = mechanism.output
        output = mechanism.move_to(mechanism.encoder + delta.numpy())
        transmitted, state = play.advance(state, delta)
        np.testing.assert_allclose(transmitted, output - before, atol=1e-14)
        np.testing.assert_allclose(state.position, output - mechanism.encoder, atol=1e-14)


@pytest.mark.parametrize("seed", range(5))
def test_an_unknown_start_is_bounded_and_found_out(seed):
    play, truth = Play(WIDTH), 0.5 * WIDTH * torch.tensor([-1.0, 0.7, 0.0], dtype=F64)
    known, unknown = play.at(truth), play.unknown()
    for delta in walk(seed):
        exact, known = play.advance(known, delta)
        before = unknown.high - unknown.low
        guess, unknown = play.advance(unknown, delta)
        assert (unknown.low - 1e-12 <= known.low).all()
        assert (known.low <= unknown.high + 1e-12).all()
        assert ((unknown.high - unknown.low) <= before + 1e-12).all()
        assert ((guess - exact).abs() <= 0.5 * before + 1e-12).all()
    assert (unknown.high - unknown.low).max() < 1e-12


@pytest.mark.parametrize("batch", [(), (1,), (5,), (2, 3)])
def test_batches(batch):
    play = Play(WIDTH)
    delta = torch.full((*batch, 3), 0.04, dtype=F64)
    transmitted, state = play.advance(play.unknown(), delta)
    assert transmitted.shape == state.low.shape == (*batch, 3)
    torch.testing.assert_close(transmitted, torch.tensor([0.03, 0.02, 0.04], dtype=F64).expand(*batch, 3))


def test_the_derivative_by_the_width_survives_a_walk():
    steps = walk(3)

    def final(width):
        play = Play(width)
        state, total = play.unknown(), torch.zeros(3, dtype=F64)
        for k, delta in enumerate(steps):
            transmitted, state = play.advance(state, delta)
            total = total + (k + 1) * transmitted
        return total

    width = WIDTH + 0.001
    assert torch.autograd.gradcheck(final, (width.requires_grad_(True),), eps=1e-7, atol=1e-6)


def test_it_comes_from_the_description_and_refuses_nonsense():
    hand = load_hand("planar_two_finger")
    assert (Play.of(hand).width == 0).all()
    actuators = tuple(dataclasses.replace(actuator, backlash=0.02) for actuator in hand.actuators)
    play = Play.of(dataclasses.replace(hand, actuators=actuators))
    torch.testing.assert_close(play.width, torch.full((2,), 0.02, dtype=F64))
    with pytest.raises(ShapeError):
        play.advance(play.unknown(), torch.zeros(3, dtype=F64))
    for width in (-0.1, float("nan")):
        with pytest.raises(ParameterError):
            Play(torch.tensor([width]))
