"""Joints without a sensor are found by touch."""

import contextlib
import dataclasses
import math
import warnings

import pytest
import torch
from torch import Tensor

from torch_ekm.contact import ContactDetector
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


@pytest.mark.parametrize(("joint", "error_deg"), [("index_1", -6.0), ("index_2", -10.0)])
def test_a_dead_sensor_is_found_by_a_pad_that_presses(hand, joint, error_deg):
    """The abduction, known by a cable, moves to its stop, and the gap is open still. Joints of one tendon are
    not always told apart."""
    names = hand.hand.joint_names
    dead, index_0 = names.index(joint), names.index("index_0")
    std = torch.full((len(names),), math.radians(0.3), dtype=torch.float64)
    std[names.index("thumb_0")], std[index_0] = math.radians(14.0), math.radians(3.0)
    upper = hand.hand.joint_upper.copy()
    upper[index_0] = math.radians(6.0)
    stopped = dataclasses.replace(hand.hand, joint_upper=upper)
    read = hand.reset(0)

    def sensed(error_deg: float) -> Observation:
        q = read.q.clone()
        q[dead] += math.radians(error_deg)
        return dataclasses.replace(read, q=q, info={"estimate": {"joint_covariance": torch.diag(std**2)}})

    detector = ContactDetector(hand.hand, hand.object, margin=math.inf)

    def gap_of(seen: Observation) -> float:
        contacts = detector(seen.q, seen.position, seen.rotation)
        return abs(float(contacts.gap[contacts.finger.index("index")]))

    plant = ContactAligned(hand, stopped, hand.object)
    with pytest.warns(UserWarning, match=f"'{joint}'.* contradicts pad 'index'"):
        seen = plant.observation(sensed(error_deg))
    assert gap_of(seen) < 1e-4
    assert gap_of(sensed(error_deg)) > 4e-3
    if joint == "index_1":
        assert abs(float((seen.q - read.truth.q)[dead])) < math.radians(2.0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # it is named once
        assert gap_of(plant.observation(sensed(1.2 * error_deg))) < 1e-4
    plant.reset(0)
    believed = plant.observation(sensed(0.0))  # a new grasp begins without doubts
    assert abs(float((believed.q - read.truth.q)[dead])) < math.radians(0.5)


def test_a_finger_far_from_the_object_that_seems_to_press_has_no_dead_sensor(hand: SimulatedHand) -> None:
    """It is its force that is wrong."""
    read = hand.reset(0)
    force = read.fingertip_force.clone()
    force[[pad.name for pad in hand.hand.pads].index("ring")] = 2.0
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        ContactAligned(hand, hand.hand, hand.object).observation(
            dataclasses.replace(read, fingertip_force=force)
        )
