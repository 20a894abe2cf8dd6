"""Joints without a sensor are found by touch."""

from __future__ import annotations

import contextlib
import dataclasses
import math

import pytest
import torch
from torch import Tensor

from torch_ekm.plant import Observation, PlantWrapper
from torch_ekm.sensing import ContactAligned
from torch_ekm.simulation import SimulatedHand


class Blurred(PlantWrapper):
    """A simulated hand whose encoder-known joint is read wrong."""

    def __init__(
        self,
        plant: SimulatedHand,
        joint: int,
        error: float,
        numb: bool = False,
        covariance: Tensor | None = None,
    ) -> None:
        super().__init__(plant)
        self.joint, self.error, self.numb, self.covariance = joint, error, numb, covariance

    def observation(self, seen: Observation) -> Observation:
        q = seen.q.clone()
        q[self.joint] += self.error
        force = None if self.numb else seen.fingertip_force
        info = dict(seen.info)
        if self.covariance is not None:
            info["estimate"] = {"joint_covariance": self.covariance}
        return dataclasses.replace(seen, q=q, fingertip_force=force, info=info)


@pytest.fixture(scope="module")
def hand() -> SimulatedHand:
    return SimulatedHand("icub_right", "box")


@pytest.mark.parametrize("error_deg", [-9.0, 4.0, 11.0])
def test_touch_corrects_the_joint_that_no_sensor_reads(hand: SimulatedHand, error_deg: float) -> None:
    thumb = hand.hand.joint_names.index("thumb_0")
    plant = ContactAligned(Blurred(hand, thumb, math.radians(error_deg)), hand.hand, hand.object)
    seen = plant.reset(0)
    off = torch.rad2deg(seen.q - seen.truth.q).abs()
    assert float(off[thumb]) < 1.0
    assert float(off[[i for i in range(len(off)) if i != thumb]].max()) < 0.5  # the others are let alone


def test_the_joint_that_is_least_certain_is_corrected(hand: SimulatedHand) -> None:
    """Not the abduction, which hardly moves the fingertip towards the object, though no sensor reads it."""
    names = hand.hand.joint_names
    index_0, index_2 = names.index("index_0"), names.index("index_2")
    std = torch.full((len(names),), math.radians(0.3), dtype=torch.float64)
    std[index_0], std[index_2] = math.radians(2.0), math.radians(8.0)
    blurred = Blurred(hand, index_2, math.radians(-6.0), covariance=torch.diag(std**2))
    seen = ContactAligned(blurred, hand.hand, hand.object).reset(0)
    off = torch.rad2deg(seen.q - seen.truth.q).abs()
    assert float(off[index_2]) < 0.5
    assert float(off[index_0]) < 0.5


def test_without_fingertip_sensors_pads_touch_whose_gaps_the_joints_explain(hand: SimulatedHand) -> None:
    """The thumb, which is known to 10 deg; neither fingers that are lifted, nor one known to be elsewhere."""
    names = hand.hand.joint_names
    thumb, index_2 = names.index("thumb_0"), names.index("index_2")
    plant = ContactAligned(Blurred(hand, thumb, 0.1, numb=True), hand.hand, hand.object)
    off = torch.rad2deg((seen := plant.reset(0)).q - seen.truth.q).abs()
    assert float(off[thumb]) < 1.0
    assert float(off[[i for i in range(len(off)) if i != thumb]].max()) < 0.5
    lifted = ContactAligned(Blurred(hand, index_2, -0.15, numb=True), hand.hand, hand.object).reset(0)
    assert float(lifted.q[index_2] - lifted.truth.q[index_2]) == pytest.approx(-0.15, abs=2e-3)


def test_the_error_of_a_cable_lasts() -> None:
    """On a narrow object the thumb has two angles without a gap; and no angle where it does not touch."""
    with contextlib.closing(SimulatedHand("icub_right", "flashlight")) as hand:
        thumb = hand.hand.joint_names.index("thumb_0")
        blurred = Blurred(hand, thumb, -0.17)
        plant = ContactAligned(blurred, hand.hand, hand.object)
        plant.reset(0)
        blurred.error = -0.36  # past the angle at which the gap is smallest
        near = pytest.approx(0.0, abs=math.radians(2.0))
        assert float((seen := plant.observe()).q[thumb] - seen.truth.q[thumb]) == near
        read = blurred.observe()
        fresh = ContactAligned(blurred, hand.hand, hand.object).observation(read)
        assert float(fresh.q[thumb] - fresh.truth.q[thumb]) < -math.radians(20.0)
        free = plant.observation(dataclasses.replace(read, fingertip_force=torch.zeros(len(hand.hand.pads))))
        assert float(free.q[thumb] - free.truth.q[thumb]) == near
        blurred.error = 0.0
        assert float((seen := plant.reset(0)).q[thumb] - seen.truth.q[thumb]) == near  # a new grasp


def test_an_error_that_no_contact_shows_stays_uncertain(hand: SimulatedHand) -> None:
    """A reading in which nothing touches leaves the next one as free as a first."""
    thumb = hand.hand.joint_names.index("thumb_0")
    blurred = Blurred(hand, thumb, 0.0)
    blurred.reset(0)
    blurred.error = math.radians(9.0)
    read = blurred.observe()
    plant = ContactAligned(blurred, hand.hand, hand.object)
    plant.observation(dataclasses.replace(read, fingertip_force=torch.zeros(len(hand.hand.pads))))
    q = plant.observation(read).q
    fresh = ContactAligned(blurred, hand.hand, hand.object).observation(read).q
    assert torch.allclose(q, fresh, rtol=0, atol=1e-9)
    assert abs(float(q[thumb] - read.truth.q[thumb])) < math.radians(1.0)
