"""What is watched during a movement, and the looks that decide whether a target is reached."""

import dataclasses
import math

import pytest
import torch
from fakes import HoldingPlant
from obedient_plant import turned

from torch_ekm.control import (
    Band,
    ClosedLoop,
    Decision,
    Guards,
    LookAndMoveController,
    Piece,
    PoseTarget,
    StopReason,
)
from torch_ekm.control.watch import OnTheWay
from torch_ekm.kinematics.se3 import exp
from torch_ekm.plant import Observation, PlantStatus, Stamps

DEG = math.pi / 180
X, Y, _ = torch.eye(3, dtype=torch.float64)
NONE = torch.zeros(0, dtype=torch.float64)


def seen_at(time: float, done: float, off: float = 0.0, pose: float | None = None, **more) -> Observation:
    """Encoders after a share ``done`` of the way, the object ``off`` [deg] about y; a picture of ``pose``."""
    stamps = Stamps(time, time, time if pose is None else pose, time)
    return Observation(
        NONE, 20 * DEG * done * X[:2], 0 * X, exp(Y * off * DEG), time=time, stamps=stamps, **more
    )


@pytest.fixture
def watch(unchecked) -> OnTheWay:
    """A path of two pieces; it turns the object by 10 deg about y in the first, which is off the focus."""
    twists = torch.stack([torch.cat([0 * X, 10 * DEG * Y]), torch.zeros(6, dtype=torch.float64)])
    pieces = tuple(Piece(None, 10 * DEG * X[:2], twist, twist, None, X) for twist in twists)
    nothing = 0 * X[:2]
    band = Band(0.0, 0.5 * DEG, torch.zeros(6, dtype=torch.float64), None, None)
    decision = Decision(nothing, StopReason.RUNNING, X[:1], twists[0], twists[0], pieces, band=band)
    return OnTheWay(Guards(), seen_at(0.0, 0.0), decision)


def test_a_movement_on_its_path_goes_on(watch) -> None:
    for k in range(1, 11):
        assert watch(seen_at(0.1 * k, 0.1 * k, min(2.0 * k, 10.0)))
    assert watch.why == ""


def test_force_and_loss_stop_it_at_once(watch) -> None:
    force = torch.tensor([3.0, 12.5], dtype=torch.float64)
    assert not watch(seen_at(0.1, 0.1, 2.0, fingertip_force=force))
    assert watch.why == "a finger presses with 12.5 N"
    watch.why = ""
    assert not watch(seen_at(0.2, 0.2, 4.0, status=PlantStatus.LOST))
    assert watch.why == "the object is lost"


def test_a_finger_that_keeps_less_than_half_of_what_was_planned_stops_it(unchecked) -> None:
    """From 4 N to 2 N in the first of two pieces, and back in the second."""
    start, low = (torch.tensor([x, 0.1], dtype=torch.float64) for x in (4.0, 2.0))
    twist = torch.zeros(6, dtype=torch.float64)
    pieces = tuple(Piece(None, 10 * DEG * X[:2], twist, twist, force, force) for force in (low, start))
    decision = Decision(0 * X[:2], StopReason.RUNNING, X[:1], twist, twist, pieces)
    watch = OnTheWay(Guards(), seen_at(0.0, 0.0, fingertip_force=start), decision)
    for done, force in ((0.25, 1.6), (0.5, 1.09), (0.75, 1.6), (1.0, 2.1)):
        found = torch.tensor([force, 0.0], dtype=torch.float64)  # the other pad does not touch
        assert watch(seen_at(done, done, fingertip_force=found)), done
    assert not watch(seen_at(1.1, 0.75, fingertip_force=torch.tensor([1.4, 0.0], dtype=torch.float64)))
    assert watch.why == "a finger keeps 1.4 N of 3.0 N"


def test_two_frames_running_off_the_path_stop_it_and_one_does_not(watch) -> None:
    """1.5 deg: two deviations of 0.5 deg at half the way, and 1 deg that an object swings."""
    assert watch(seen_at(0.1, 0.5, 10.0 + 1.4))
    assert watch(seen_at(0.2, 0.5, 10.0 + 1.4))
    assert watch(seen_at(0.3, 0.5, 10.0 - 1.6))
    assert watch(seen_at(0.4, 0.5, 10.0))
    assert watch(seen_at(0.5, 0.5, 10.0 - 1.6))
    assert not watch(seen_at(0.6, 0.5, 10.0 - 1.6))
    assert watch.why == "the object is 1.6 deg off its path"


def test_a_late_picture_is_held_against_the_encoders_of_its_time(watch) -> None:
    """Between two readings they are taken to have gone straight."""
    assert watch(seen_at(0.2, 0.0))
    for time, done, planned in ((0.4, 0.5, 5.0), (0.6, 1.0, 10.0)):
        late = seen_at(time, done, planned, pose=time - 0.1)
        assert watch(late)
        assert float(watch._off_path(late)[1].norm()) < 1e-9


def test_an_object_that_is_not_seen_stops_nothing(watch) -> None:
    for k in range(1, 5):
        assert watch(seen_at(0.1 * k, 0.0, 40.0, status=PlantStatus.NOT_SEEN))


# -- at rest -------------------------------------------------------------------------------------------------


class Noisy(HoldingPlant):
    """The object stays; looks are off by what ``noise`` says, over and over [deg]."""

    def __init__(self, seen: Observation, axis: torch.Tensor, noise: list[float]) -> None:
        super().__init__(seen)
        self.axis, self.noise = axis, noise

    def observe(self) -> Observation:
        return turned(self.reading(), self.axis, self.noise[self.looks % len(self.noise)] * DEG)


@pytest.mark.parametrize(
    ("looks", "reached"),
    [([-0.3, 0.3], True), ([0.3, -0.3], True), ([0.1, 0.9], False), ([0.9, 0.1, 0.5, 0.5], False)],
)
def test_the_mean_of_looks_decides_what_is_reached(held, looks, reached) -> None:
    """One look is nearer or farther than the tolerance of 0.25 deg by its noise alone."""
    seen, axis, model = held
    plant = Noisy(dataclasses.replace(seen), axis, looks)
    loop = ClosedLoop(plant, LookAndMoveController(model, axis))
    motions = loop.steps(PoseTarget(seen.position, seen.rotation))
    if reached:
        with pytest.raises(StopIteration) as end:
            next(motions)
        assert end.value.value.reason is StopReason.REACHED
        target = PoseTarget(seen.position, seen.rotation)
        assert abs(loop.controller.focus.error(target, end.value.value.final.state)) < 0.05 * DEG
    else:
        next(motions)
    assert bool(plant.commands) is not reached
