"""What passes the gate before a plant, and what does not."""

import dataclasses
import math
import threading
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from fakes import FakePlant

from torch_ekm.exceptions import CommandRefusedError, EKMError, PlantInUseError
from torch_ekm.plant import Gate, Observation, PlantStatus, PlantWrapper, ServoInverse, Stamps

DEG = math.pi / 180
EYE, ORIGIN = torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64)
REACH = 60 * DEG * np.ones(3)
HAND = SimpleNamespace(
    name="three", actuator_names=("thumb", "index", "middle"), n_q=3, n_a=3, pads=range(3),
    actuator_lower=-REACH, actuator_upper=REACH,
)  # fmt: skip
WISH = torch.tensor([1.0, -2.0, 0.0], dtype=torch.float64) * DEG


class Hand(FakePlant):
    """A driver of eighteen lines: motors obey, whatever they are told."""

    def __init__(self, takes: float = 1.0) -> None:
        super().__init__()
        self.a, self.time, self.takes = ORIGIN.clone(), 1.0, takes
        self.given: list[torch.Tensor] = []
        self.change = lambda seen: seen

    def observe(self) -> Observation:
        return self.change(Observation(self.a, self.a, ORIGIN, EYE, self.a.abs(), self.time))

    def move(self, delta_a: torch.Tensor) -> None:
        self.given.append(delta_a)
        self.time += self.takes
        self.a = self.a + delta_a


def test_what_is_within_all_limits_passes_as_it_is() -> None:
    plant = Hand()
    after = Gate(plant, HAND).command(WISH)
    assert torch.equal(plant.given[0], WISH)
    assert torch.equal(after.a, WISH)


REFUSED = {
    "not finite": ([math.nan, 0.0, 0.0], "an increment of nan deg", "finite ones"),
    "infinite": ([0.0, math.inf, 0.0], "an increment of inf deg", "finite ones"),
    "too large": ([0.0, 21 * DEG, 0.0], "an increment of 21 deg", "up to 20 deg"),
    "too far": ([0.0, 0.0, -11 * DEG], "a set-point of -61 deg", "-60 to 60 deg"),
    "too few": ([0.1, 0.1], "(2,) numbers", "3 numbers [rad]: thumb, index, middle"),
    "a text": ("open", "a str", "3 numbers [rad]"),
    "complex": (torch.zeros(3, dtype=torch.complex64), "a Tensor", "3 numbers [rad]"),
    "sparse": (torch.zeros(3).to_sparse(), "a Tensor", "3 numbers [rad]"),
    "no 64 bits": (10**400, "a int", "3 numbers [rad]"),
}


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("name", REFUSED)
def test_what_is_refused_says_what_was_asked_by_whom_and_what_is_allowed(name: str) -> None:
    wish, asked, allowed = REFUSED[name]
    plant = Hand()
    plant.a = torch.tensor([0.0, 0.0, -50.0], dtype=torch.float64) * DEG
    gate = Gate(plant, HAND)
    with pytest.raises(CommandRefusedError, match="nothing was sent") as refusal:
        gate.command(torch.tensor(wish, dtype=torch.float64) if isinstance(wish, list) else wish, by="turn")
    assert refusal.value.by == "turn"
    assert refusal.value.asked == asked
    assert allowed in refusal.value.allowed
    assert plant.given == []


def test_out_of_the_range_only_the_way_back_is_open() -> None:
    plant = Hand()
    plant.a = torch.tensor([70.0, 0.0, 0.0], dtype=torch.float64) * DEG
    gate = Gate(plant, HAND)
    with pytest.raises(CommandRefusedError, match="set-point"):
        gate.command(torch.tensor([1.0, 0.0, 0.0]) * DEG)
    gate.command(torch.zeros(3))  # to hold passes always
    gate.command(torch.tensor([-4.0, 0.0, 0.0]).double() * DEG)
    assert len(plant.given) == 2


def test_the_range_is_that_of_the_reading_that_was_accepted() -> None:
    """A reading in between, which nobody accepted, decides nothing."""
    plant = Hand()
    gate = Gate(plant, HAND)
    start = gate.observe()
    plant.change = lambda seen: dataclasses.replace(seen, a=seen.a + 59 * DEG)
    gate.observe()
    gate.command(torch.tensor([5.0, 0.0, 0.0]).double() * DEG, start)
    assert len(plant.given) == 1


@pytest.mark.parametrize(("takes", "passed"), [(1.0, 8), (0.03, 3), (0.0, 2)])
def test_a_plant_that_does_not_wait_for_its_motions_is_slowed_down(takes: float, passed: int) -> None:
    """At 3 rad/s 0.03 s are worth 5.2 deg, on top of the 20 deg that may go at once."""
    plant = Hand(takes)
    gate = Gate(plant, HAND)
    to_and_fro = [sign * torch.full((3,), 10 * DEG).double() for sign in (1, -1) * 4]
    for k, wish in enumerate(to_and_fro):
        if k < passed:
            gate.command(wish)
        else:
            with pytest.raises(CommandRefusedError, match="wait for the end of a motion"):
                gate.command(wish)
    assert len(plant.given) == passed


def test_a_plant_without_a_clock_has_no_rate() -> None:
    plant = Hand()
    plant.change = lambda seen: dataclasses.replace(seen, time=0.0)
    gate = Gate(plant, HAND)
    for sign in (1, -1) * 4:
        gate.command(sign * torch.full((3,), 10 * DEG).double())
    assert len(plant.given) == 8


def test_one_hand_has_one_master_whatever_is_put_around_it() -> None:
    plant = Hand()
    one, other = Gate(plant, HAND), Gate(PlantWrapper(plant), HAND)
    with one.owned():
        one.command(WISH)
        for refused in (lambda: other.command(WISH), lambda: one.owned().__enter__()):
            with pytest.raises(PlantInUseError, match="Hand is commanded by another loop"):
                refused()
    other.command(WISH)
    assert len(plant.given) == 2


def test_commands_of_two_threads_follow_each_other() -> None:
    class Slow(Hand):
        busy = False

        def command(self, delta_a):
            assert not self.busy
            self.busy = True
            threading.Event().wait(0.02)
            self.busy = False
            return super().command(delta_a)

    gate, failed = Gate(Slow(), HAND), []

    def hold() -> None:
        try:
            gate.command(torch.zeros(3), by="hold")
        except AssertionError as error:
            failed.append(error)

    with gate.owned():
        threads = [threading.Thread(target=hold) for _ in range(4)]
        [one.start() for one in threads]
        [one.join() for one in threads]
    assert failed == []


@pytest.mark.parametrize("bias", [-3.0, 0.4, 3.0])
def test_no_estimate_of_the_servos_makes_a_command_large(bias: float) -> None:
    """And one that is wrong is found to be so: after some motions the encoders do what is wanted."""
    plant = Hand()
    inverse = ServoInverse(plant, HAND)
    inverse.servo.estimate[1, 1] = bias
    inverse.servo.covariance[1] *= 1e-3
    for k in range(12):
        before = inverse.observe().a
        after = inverse.command(WISH if k % 2 else -WISH)
    assert max(float(v.abs().max()) for v in plant.given) <= WISH.abs().max() + inverse.servo.largest + 1e-9
    assert float((after.a - before - WISH).abs().max()) < 0.3 * DEG


def test_a_correction_that_is_no_number_moves_nothing() -> None:
    plant = Hand()
    inverse = ServoInverse(plant, HAND)
    inverse.servo.covariance.zero_()
    inverse.servo.estimate[0, 0] = -0.1
    with pytest.raises(CommandRefusedError, match="finite"):
        inverse.command(WISH)
    assert plant.given == []


def test_a_wish_near_the_largest_increment_is_not_refused_for_its_correction() -> None:
    plant = Hand()
    inverse = ServoInverse(plant, HAND)
    inverse.servo.estimate[:, 0] = 3 * DEG
    inverse.command(torch.full((3,), 19 * DEG).double())
    assert float(plant.given[0].abs().max()) == pytest.approx(20 * DEG)


def covariance(entry: float) -> torch.Tensor:
    made = torch.eye(6).double()
    made[0, 1] = entry
    return made


UNREADABLE = {
    "a status as text": {"status": "lost"},
    "a time as text": {"time": "now"},
    "no number of seconds": {"time": math.nan},
    "a time of nothing": {"time": None},
    "stamps of three sensors": {"stamps": (1.0, 1.0, 1.0)},
    "a stamp that is none": {"stamps": Stamps(1.0, 1.0, math.nan, 1.0)},
    "no info": {"info": None},
    "an estimate as text": {"info": {"estimate": "good"}},
    "a covariance of a point": {"info": {"estimate": {"pose_covariance": torch.zeros(3, 3)}}},
    "a covariance as text": {"info": {"estimate": {"pose_covariance": "small"}}},
    "one that is not symmetric": {"info": {"estimate": {"pose_covariance": covariance(0.5)}}},
    "a negative variance": {"info": {"estimate": {"pose_covariance": -torch.eye(6)}}},
    "an infinite variance": {"info": {"estimate": {"pose_covariance": covariance(math.inf)}}},
    "gradients": {"q": ORIGIN.clone().requires_grad_()},
    "complex numbers": {"a": ORIGIN.to(torch.complex128)},
    "a sparse tensor": {"q": ORIGIN.to_sparse()},
    "a complex covariance": {"info": {"estimate": {"pose_covariance": torch.eye(6, dtype=torch.complex64)}}},
    "four joints": {"q": torch.zeros(4)},
    "a stretched object": {"rotation": 2 * EYE},
}


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("name", UNREADABLE)
def test_what_is_no_reading_is_refused_with_its_name(name: str) -> None:
    plant = Hand()
    gate = Gate(plant, HAND)
    plant.change = lambda seen: dataclasses.replace(seen, **UNREADABLE[name])
    field = next(iter(UNREADABLE[name]))
    with pytest.raises(EKMError, match=f"Observation.{field}|rotation"):
        gate.observe()
    assert gate.last is None


@pytest.mark.usefixtures("unchecked")
def test_a_reading_that_has_become_nan_behind_its_back_is_refused() -> None:
    plant = Hand()

    def spoilt(seen: Observation) -> Observation:
        seen = dataclasses.replace(seen, a=seen.a.clone())
        seen.a[1] = math.nan
        return seen

    plant.change = spoilt
    with pytest.raises(EKMError, match=r"Observation\.a"):
        Gate(plant, HAND).observe()


@pytest.mark.usefixtures("unchecked")
def test_other_kinds_of_numbers_are_taken() -> None:
    plant = Hand()
    unknown = {"estimate": {"pose_covariance": np.full((6, 6), math.nan)}}
    plant.change = lambda seen: dataclasses.replace(
        seen, q=torch.zeros(3), a=torch.tensor([1, 2, 3]), position=torch.zeros(3), rotation=torch.eye(3),
        fingertip_force=torch.ones(3), time=np.float32(2.0), info=unknown,
    )  # fmt: skip
    seen = Gate(plant, HAND).observe()
    parts = seen.q, seen.a, seen.position, seen.rotation, seen.fingertip_force
    assert {one.dtype for one in parts} == {torch.float64}
    assert seen.time == 2.0
    assert seen.status is PlantStatus.HELD
    assert seen.info["estimate"]["pose_covariance"].shape == (6, 6)
    plant.change = lambda seen: seen
    assert Gate(plant, HAND).observe().a is plant.a  # nothing is copied where nothing is to be changed
