"""Movements through waypoints, and the rest after a motion, in both engines."""

import math

import numpy as np
import pytest
import torch
from simulation_helpers import DEG, motion

from torch_ekm.exceptions import ShapeError
from torch_ekm.plant import Path, can_follow
from torch_ekm.simulation import DisturbedPlant, PlantChange, SimulatedHand, preset
from torch_ekm.simulation.mechanism.servo import Servo
from torch_ekm.simulation.sensors import Sensors, TimedState
from torch_ekm.testing import check_following_plant

WAY = DEG * torch.tensor([[3.0, -3.0], [6.0, -6.0], [5.0, -5.0]], dtype=torch.float64)


def hand(preset: str = "nominal", engine: str = "mujoco", **changes) -> SimulatedHand:
    plant = SimulatedHand("planar_two_finger", "can", preset=preset, engine=engine)
    if changes:
        plant.change(**changes)
    plant.reset(0)
    return plant


@pytest.mark.parametrize("engine", ["mujoco", "sapien"])
def test_a_simulated_hand_keeps_the_contract(engine: str) -> None:
    check_following_plant(hand(engine=engine), Path.through(WAY, 20 * DEG), tolerance=2 * DEG)


def test_readings_come_with_the_frames_of_the_camera_and_a_late_one_says_so() -> None:
    plant, passed = hand("worn", frame_loss=0.0), []
    plant.follow(Path.through(WAY, 20 * DEG), lambda seen: passed.append(seen) or True)
    times = np.array([seen.time for seen in passed])
    assert np.diff(times) == pytest.approx([0.05] * (len(times) - 1))
    assert len(passed) == pytest.approx(0.35 / 0.05, abs=1)
    late = [seen.time - seen.taken.pose for seen in passed]
    assert late == pytest.approx([0.05] * len(late))
    assert len({float(seen.q[0]) for seen in passed}) == len(passed)  # noise of its own


def test_two_movements_from_one_seed_are_alike() -> None:
    ends = [hand("worn").follow(Path.through(WAY, 1.0), lambda seen: True) for _ in range(2)]
    assert torch.equal(ends[0].q, ends[1].q)
    assert torch.equal(ends[0].position, ends[1].position)


def test_motors_go_straight_between_waypoints_and_no_faster_than_they_can() -> None:
    """At 20 deg/s by the clock; where 1000 deg/s are asked for, at 100 deg/s."""
    for asked, speed in ((20, 20), (1000, 100)):
        plant, passed = hand("none", frame_rate=100.0), []
        start = plant.observe()
        way = -2 * WAY[:2]
        after = plant.follow(
            Path.through(way, asked * DEG), lambda seen, passed=passed: passed.append(seen) or True
        )
        a = torch.stack([seen.a for seen in passed])[:, 0] - start.a[0]
        rate = -(a.diff() / DEG / 0.01)[2:-2]
        assert float(rate.max()) == pytest.approx(speed, rel=1e-6)
        assert float(rate.min()) > 0.7 * speed  # it spins up in 0.02 s
        torch.testing.assert_close(after.a - start.a, way[-1], atol=1e-9, rtol=0)


def test_where_watch_answers_false_the_motors_stand_and_the_set_point_with_them() -> None:
    plant, passed = hand("none"), []
    start = plant.observe()
    stopped = plant.follow(Path.through(WAY, 20 * DEG), lambda seen: passed.append(seen) or len(passed) < 2)
    assert torch.equal(stopped.a, passed[-1].a)
    assert 0 < float(stopped.a[0] - start.a[0]) < 3 * DEG
    assert np.array_equal(plant._rig.servo.setpoint, plant._rig.servo.encoder)


@pytest.mark.usefixtures("unchecked")
def test_a_path_of_another_hand_moves_nothing() -> None:
    plant = hand()
    before = plant.observe().truth.q
    with pytest.raises(ShapeError):
        plant.follow(Path(torch.zeros(1, 3), torch.ones(1)), lambda seen: True)
    assert torch.equal(before, plant.observe().truth.q)


def test_a_dead_zone_holds_a_motor_back_once_in_each_direction() -> None:
    dead = preset("none").replace(dead_zone=1 * DEG)
    servo = Servo(np.array([-1.0]), np.array([1.0]), dead)
    stops = servo.plan(DEG * np.array([[3.0], [6.0], [5.0], [2.0]]), np.random.default_rng(0))
    assert stops[:, 0] / DEG == pytest.approx([2, 5, 5, 3])
    one = servo.plan(DEG * np.array([3.0]), np.random.default_rng(0))
    assert one == pytest.approx(stops[0])


def test_what_is_due_happens_before_a_movement() -> None:
    plant = DisturbedPlant(hand(), [PlantChange(0, {"friction": 0.7})])
    assert can_follow(plant)
    assert plant.follow(Path.through(WAY, 1.0), lambda seen: True).info["events"]
    assert plant.plant.parameters.friction == 0.7
    assert plant.count == 1


# -- rest ---------------------------------------------------------------------------------------------------


def test_two_frames_that_differ_by_their_noise_agree_and_a_shift_does_not() -> None:
    sensors = Sensors(preset("nominal"), 4, 2, ("a", "b", "c", "d"))
    draw, at = np.random.default_rng(0), TimedState(0.0, np.zeros(4), np.zeros(3), np.eye(3))
    moved = at._replace(position=np.array([0.0, 1e-3, 0.0]))  # five standard deviations
    bent = at._replace(q=np.full(4, 1.5 * DEG))

    def share(one: TimedState, other: TimedState) -> float:
        pairs = [(sensors.frame(one, draw)[0], sensors.frame(other, draw)[0]) for _ in range(200)]
        return float(np.mean([sensors.agree(*pair) for pair in pairs]))

    assert share(at, at) > 0.6
    assert share(at, moved) < 0.1
    assert share(at, bent) < 0.1


@pytest.mark.parametrize("engine", ["mujoco", "sapien"])
@pytest.mark.parametrize("size", [0.5, 3.0])
def test_after_the_rest_the_object_stands(engine: str, size: float) -> None:
    """To three standard deviations of the camera: what it cannot see it does not wait for."""
    plant = hand("worn", engine=engine)
    for sign in (1, -1, 1):
        way = sign * DEG * torch.tensor([size + 1.6, -size - 1.6], dtype=torch.float64)
        before = plant.observe()
        after = plant.command(way)
        plant.wait(1.0)
        shift, turn = motion(after, plant.observe())
        assert float(turn.norm()) < 3 * plant.parameters.rotation_noise
        assert float(shift.norm()) < 3 * plant.parameters.position_noise
        assert after.taken.pose > before.time + size * DEG / (100 * DEG)  # newer than the motion
        assert after.time - before.time < 0.02 + (size + 2) / 100 + 0.8 + 1e-6


def test_without_noise_it_waits_until_the_object_stands() -> None:
    """A soft hand, 10 deg: 1 deg is left when the motors stand."""
    plant = hand("none")
    after = plant.command(10 * DEG * torch.tensor([1.0, -1.0], dtype=torch.float64))
    plant.wait(1.0)
    assert float(motion(after, plant.observe())[1].norm()) < 0.05 * DEG


def test_a_camera_that_loses_every_frame_is_waited_for_so_long_and_no_longer() -> None:
    plant = hand("nominal", frame_loss=1.0)
    before = plant.observe()
    after = plant.command(torch.zeros(2))
    assert math.isclose(after.time - before.time, 0.02 + 0.8, abs_tol=0.051)
