"""Movements through waypoints: what passes the gate, the inverse of the servos, wrappers, recordings."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from test_plant_gate import DEG, HAND, Hand

from torch_ekm.exceptions import CommandRefusedError, EKMError, NonFiniteError, ParameterError, ShapeError
from torch_ekm.plant import (
    FramesAtRest,
    Gate,
    Path,
    PlantWrapper,
    RecordingPlant,
    ReplayedPlant,
    ServoInverse,
    TrialLog,
    can_follow,
)


def degrees(*rows: tuple[float, ...]) -> torch.Tensor:
    return torch.tensor(rows, dtype=torch.float64) * DEG


WAY = degrees((10, 0, -5), (20, 10, -10), (15, 10, -20))


class Follower(Hand):
    """Motors with a dead zone that go through waypoints; a reading at each."""

    def __init__(self, dead: float = 0.0) -> None:
        super().__init__()
        self.dead = dead
        self.path: Path | None = None

    def follow(self, path: Path, watch) -> object:
        self.path, start, began = path, self.a, self.time
        for w, t in zip(path.waypoints, path.times, strict=True):
            error = start + w - self.a
            self.a = self.a + error - error.clamp(-self.dead, self.dead)
            self.time = began + float(t)
            if not watch(self.observe()):
                break
        return self.observe()


def always(seen) -> bool:
    return True


def test_a_path_is_straight_between_its_waypoints_at_a_speed() -> None:
    path = Path.through(WAY, 50 * DEG)
    torch.testing.assert_close(path.times, torch.tensor([0.2, 0.4, 0.6], dtype=torch.float64))
    torch.testing.assert_close(path.pieces, degrees((10, 0, -5), (10, 10, -5), (-5, 0, -10)))
    assert float(Path.through(degrees((0, 0, 0)), 1.0).times[0]) == 0.01  # no piece takes no time


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("waypoints", "times", "error"),
    [
        (WAY[0], torch.ones(3), ShapeError),
        (WAY[:0], torch.ones(0), ShapeError),
        (WAY, torch.ones(2), ShapeError),
        (WAY * math.nan, torch.arange(1.0, 4), NonFiniteError),
        (WAY, torch.ones(3), ParameterError),
        (WAY, torch.arange(3.0), ParameterError),
    ],
)
def test_what_is_no_path_is_refused(waypoints, times, error) -> None:
    with pytest.raises(error):
        Path(waypoints, times)


def test_a_path_within_all_limits_passes_the_gate_as_it_is() -> None:
    plant, passed = Follower(), []
    path = Path.through(WAY, 50 * DEG)
    after = Gate(plant, HAND).follow(path, lambda seen: passed.append(seen) or True)
    assert plant.path is path
    torch.testing.assert_close(after.a, WAY[-1])
    assert [seen.time for seen in passed] == pytest.approx([1.2, 1.4, 1.6])


REFUSED = {
    "a long piece": (degrees((10, 0, 0), (-11, 0, 0)), 1.0, "an increment of -21 deg", "up to 20 deg"),
    "too far": (degrees((20, 0, 0), (40, 0, 0), (60, 0, 0), (61, 0, 0)), 1.0, "a set-point of 61", "-60 to"),
    "too fast": (degrees((10, 0, 0), (0, 0, 0)), 4.0, "an increment of 10 deg", "171.9 deg/s"),
    "another hand": (degrees((1, 0)), 1.0, "waypoints of 2 numbers", "3 numbers"),
}


@pytest.mark.parametrize("name", REFUSED)
@pytest.mark.parametrize("plant", [Follower(), Hand()])
def test_a_path_that_is_refused_says_why_and_nothing_is_sent(name, plant) -> None:
    waypoints, speed, asked, allowed = REFUSED[name]
    with pytest.raises(CommandRefusedError) as refusal:
        Gate(plant, HAND).follow(Path.through(waypoints, speed), always, by="turn")
    assert refusal.value.by == "turn"
    assert asked in refusal.value.asked
    assert allowed in refusal.value.allowed
    assert plant.given == []
    assert getattr(plant, "path", None) is None


def test_a_plant_that_takes_less_time_than_a_path_states_is_slowed_down() -> None:
    plant, path = Follower(), Path.through(degrees((20, 0, 0), (0, 0, 0), (20, 0, 0)), 3.0)
    gate = Gate(plant, HAND)
    plant.change = lambda seen: dataclasses.replace(seen, time=1.0)
    gate.follow(path, always)
    with pytest.raises(CommandRefusedError, match="wait for the end of a motion"):
        gate.command(degrees((1, 0, 0))[0])


@pytest.mark.parametrize("plant", [Follower(), Hand()])
def test_where_watch_answers_false_the_movement_ends(plant) -> None:
    after = Gate(plant, HAND).follow(Path.through(WAY, 50 * DEG), lambda seen: False)
    torch.testing.assert_close(after.a, WAY[0] if can_follow(plant) else WAY[1])


@pytest.mark.parametrize("fault", ["reading", "watcher"])
@pytest.mark.parametrize("plant", [Follower, Hand])
def test_a_reading_that_is_none_and_a_watcher_that_fails_end_the_movement(fault, plant) -> None:
    plant = plant()
    gate = Gate(plant, HAND)
    gate.observe()
    if fault == "reading":
        plant.change = lambda seen: dataclasses.replace(seen, time=math.nan) if seen.a[0] > 0 else seen

    def watch(seen) -> bool:
        raise EKMError("no picture")

    with pytest.raises(EKMError, match=r"Observation\.time|no picture"):
        gate.follow(Path.through(WAY, 50 * DEG), always if fault == "reading" else watch)
    assert isinstance(gate.failure, EKMError)
    assert float(plant.a[0]) < 20.1 * DEG
    assert float(plant.a[2]) > -19.9 * DEG


def test_a_plant_that_cannot_follow_gets_few_single_commands() -> None:
    plant, passed = Hand(), []
    waypoints = degrees((5, 0, 0), (10, 5, 0), (15, 10, 0), (24, 10, 0), (20, 10, 0), (10, 0, 0))
    after = Gate(plant, HAND).follow(Path.through(waypoints, 1.0), lambda seen: passed.append(seen) or True)
    wanted = degrees((15, 10, 0), (9, 0, 0), (-14, -10, 0))  # as large as allowed, and no turn is cut off
    torch.testing.assert_close(torch.stack(plant.given), wanted)
    torch.testing.assert_close(after.a, waypoints[-1])
    assert len(passed) == 2


def test_motors_that_go_another_way_get_no_further_commands() -> None:
    plant = Hand()
    plant.move = lambda delta_a: Hand.move(plant, -delta_a)
    after = Gate(plant, HAND).follow(Path.through(degrees((15, 0, 0), (30, 0, 0), (45, 0, 0)), 1.0), always)
    torch.testing.assert_close(after.a, degrees((-15, 0, 0))[0])


@pytest.mark.parametrize("plant", [Follower(1 * DEG), Hand()])
def test_dead_zones_are_made_up_for_in_the_direction_of_each_motor(plant) -> None:
    """There and back: the set-point jumps by two dead zones where a motor turns round."""
    inverse = ServoInverse(plant, HAND)
    inverse.servo.estimate[:, 0] = 1 * DEG
    way, seen = degrees((10, 0, -5), (15, 0, -5), (9, 0, -10)), []
    after = inverse.follow(Path.through(way, 50 * DEG), lambda one: seen.append(one.a) or True)
    torch.testing.assert_close(inverse.sent[-1], degrees((8, 0, -11))[0])
    if can_follow(plant):
        torch.testing.assert_close(plant.path.waypoints, degrees((11, 0, -6), (16, 0, -6), (8, 0, -11)))
        torch.testing.assert_close(torch.stack(seen), way)
        torch.testing.assert_close(after.a, way[-1])
    assert float(plant.a[1]) == 0.0


def test_the_inverse_learns_of_motors_that_went_one_way_to_the_end() -> None:
    learned = []
    for way, last in (
        (degrees((5, 5, 5), (10, 2, 10)), True),  # the second one turns round
        (degrees((5, 5, 5), (10, 10, 10)), False),  # ended on the way
    ):
        inverse = ServoInverse(Follower(1 * DEG), HAND)
        before = inverse.servo.estimate.clone()
        inverse.follow(Path.through(way, 50 * DEG), lambda seen, last=last: last)
        learned.append((inverse.servo.estimate != before).any(1).tolist())
    assert learned == [[True, False, True], [False, False, False]]


def test_a_piece_that_its_compensation_makes_longer_takes_longer() -> None:
    plant = Follower()
    inverse = ServoInverse(plant, HAND)
    inverse.servo.estimate[:, 0] = 5 * DEG
    inverse.follow(Path.through(degrees((1, 0, 0), (19, 0, 0)), 3.0), always)
    torch.testing.assert_close(plant.path.waypoints, degrees((6, 0, 0), (24, 0, 0)))
    assert plant.path.durations[0] == pytest.approx(6 * DEG / 3.0)
    inverse.servo.estimate[:, 0] = 5 * DEG
    inverse.follow(Path.through(degrees((-18, 0, 0)), 3.0), always)
    assert float(plant.path.waypoints[0, 0]) == pytest.approx(-20 * DEG)  # no estimate makes a piece large


def test_a_wrapper_follows_where_what_it_wraps_does() -> None:
    class Shifted(PlantWrapper):
        def observation(self, seen):
            return dataclasses.replace(seen, q=seen.q + 1)

    class Reversed(PlantWrapper):
        def command(self, delta_a):
            return self.plant.command(-delta_a)

    for kind in (PlantWrapper, Shifted, RecordingPlant, FramesAtRest):
        assert can_follow(kind(kind(Follower())))
        assert not can_follow(kind(Hand()))
    assert not can_follow(Reversed(Follower()))  # or its motions would not be reversed
    passed = []
    after = Shifted(Follower()).follow(Path.through(WAY, 1.0), lambda seen: passed.append(seen) or True)
    torch.testing.assert_close(after.q, WAY[-1] + 1)
    torch.testing.assert_close(passed[0].q, WAY[0] + 1)


def test_a_reading_on_the_way_is_one_frame() -> None:
    plant = Follower()
    looks, observe = [], plant.observe
    plant.observe = lambda: looks.append(1) or observe()
    FramesAtRest(plant, 6).follow(Path.through(WAY, 1.0), always)
    assert len(looks) == len(WAY) + 6


def test_a_movement_is_recorded_and_replayed(tmp_path) -> None:
    plant = RecordingPlant(Follower())
    plant.reset(0)
    plant.command(degrees((1, 0, 0))[0])
    plant.follow(Path.through(WAY, 1.0), always)
    plant.follow(Path.through(-WAY[:2], 1.0), lambda seen: False)
    with TrialLog(tmp_path / "log", {}) as log:
        log.write(0, plant.trajectory)
        kept = log.read(0)
    assert sorted(kept.movements) == [1, 2]
    assert [len(one.passed) for one in kept.movements.values()] == [3, 1]
    torch.testing.assert_close(kept.movements[1].path.waypoints, WAY)
    torch.testing.assert_close(kept.movements[2].path.times, Path.through(-WAY[:2], 1.0).times)
    torch.testing.assert_close(torch.stack(kept.commands), torch.stack(plant.trajectory.commands))
    again, passed = ReplayedPlant(kept), []
    again.command(WAY[0])
    after = again.follow(Path.through(WAY, 1.0), lambda seen: passed.append(seen) or True)
    torch.testing.assert_close(torch.stack([seen.a for seen in passed]), WAY + degrees((1, 0, 0)))
    torch.testing.assert_close(after.a, passed[-1].a)
    assert np.isfinite(after.time)
    assert not {place for place in kept.arrays() if place.startswith(("paths", "passed"))}  # rows of exports
