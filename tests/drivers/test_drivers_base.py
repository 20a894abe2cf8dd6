"""What every driver does: units, limits, pieces, rest, stale readings, dry run, poses."""

import dataclasses
import math
import time

import numpy as np
import pytest
import torch
from no_bus import FakeDriver
from wirings import DEG, T42, radians, write

from torch_ekm.drivers import MarkerPose, Sighting, WithPose
from torch_ekm.exceptions import (
    BusError,
    CommandRefusedError,
    NeverAtRestError,
    NonFiniteError,
    ObjectLostError,
    ParameterError,
    ShapeError,
    StaleReadingError,
)
from torch_ekm.kinematics import ActuationMap
from torch_ekm.plant import Plant, PlantStatus


@pytest.fixture
def driver(tmp_path) -> FakeDriver:
    return FakeDriver(write(tmp_path))


def test_units_signs_zeros_and_the_clock(driver) -> None:
    assert isinstance(driver, Plant)
    before = time.monotonic()
    seen = driver.reset(seed=0)
    torch.testing.assert_close(seen.a, radians(1.0, 1.0))  # (1600 - 1000) / 600, (2400 - 3000) / -600
    assert before <= seen.taken.encoders <= seen.time <= time.monotonic()
    assert seen.dated
    after = driver.command(radians(0.05, -0.02).float())
    torch.testing.assert_close(after.a, radians(1.05, 0.98), atol=1e-6, rtol=0)
    assert after.a.dtype == torch.float64
    assert after.taken.encoders > seen.time
    assert driver.written[-1][0] == pytest.approx([1630.0, 2412.0])


def test_joints_without_a_sensor_rest_where_the_springs_have_them(driver) -> None:
    seen = driver.observe()
    drives = tuple(dataclasses.replace(one, stiffness=math.inf) for one in driver.hand.actuators)
    free = ActuationMap(dataclasses.replace(driver.hand, actuators=drives)).joints(seen.a)
    torch.testing.assert_close(seen.q, free, atol=0.01, rtol=0)
    sensed = "\n".join(
        f'[[joints]]\nname = "{name}"\nid = {k}\nper_rad = 100'
        for k, name in enumerate(driver.hand.joint_names)
    )
    path = write(driver.wiring.path.parent, T42.replace("[limits]", f"{sensed}\n[limits]"))
    other = FakeDriver(path)
    other.spoil = lambda reading: dataclasses.replace(
        reading, joints=(10, 20, 30, 40), joints_taken=time.monotonic()
    )
    torch.testing.assert_close(other.observe().q, radians(0.1, 0.2, 0.3, 0.4))  # as they read


@pytest.mark.usefixtures("unchecked")
def test_a_command_beyond_the_limits_is_refused_and_nothing_is_sent(driver) -> None:
    with pytest.raises(NonFiniteError):
        driver.command(radians(0.0, math.nan))
    with pytest.raises(ShapeError, match="left, right"):
        driver.command(radians(0.1))
    for wrong in (None, "open", radians(0.1, 0.1).to(torch.complex128), radians(0.1, 0.1).to_sparse()):
        with pytest.raises(ParameterError, match="delta_a"):
            driver.command(wrong)
    with pytest.raises(ParameterError, match="path"):
        driver.follow(None, lambda seen: True)
    with pytest.raises(CommandRefusedError, match=r"motor 'right': a command of 30 deg.*increment.* 20 deg"):
        driver.command(radians(0.0, 30 * DEG))
    driver.motors = driver.motors.__class__([1000 + 600 * 220 * DEG, 2400.0], 1.0)
    with pytest.raises(CommandRefusedError, match=r"reads 220 deg, its range is -68.6 to 191 deg.*:15\)"):
        driver.command(radians(0.01, 0.0))
    assert not driver.written


def test_goals_stay_in_the_range_and_are_never_turned_round(driver) -> None:
    driver.motors = driver.motors.__class__([1000 + 600 * 190 * DEG, 3000 + 600 * 70 * DEG], 4000.0)
    after = driver.command(radians(3 * DEG, -3 * DEG))
    torch.testing.assert_close(after.a, radians(191 * DEG, -70 * DEG), atol=1e-6, rtol=0)
    after = driver.command(radians(-3 * DEG, 3 * DEG))  # the way back is open
    torch.testing.assert_close(after.a, radians(188 * DEG, -67 * DEG), atol=1e-6, rtol=0)


def test_a_long_motion_goes_out_in_pieces_of_80_ms_at_the_rate(tmp_path) -> None:
    """The next one comes before the motors stand."""
    driver, stood = FakeDriver(write(tmp_path, change="rate_deg = 200|rate_deg = 50")), []
    driver.motors.speed, send = 600 * 50 * DEG, driver.motors.send
    driver.motors.send = lambda goal: stood.append(not driver.motors.moving) or send(goal)
    began = time.monotonic()
    driver.command(radians(-10 * DEG, 10 * DEG))
    assert stood == [True, False, False]
    assert time.monotonic() - began > 0.19  # at 50 deg/s
    steps = np.diff([1600.0, *(goal[0] for goal, _ in driver.written)]) / 600 / DEG
    assert len(steps) == 3
    assert steps == pytest.approx([-10 / 3] * 3)
    assert all(seconds <= 0.086 for _, seconds in driver.written)


def test_a_motion_that_does_not_end_is_a_typed_error_and_the_hand_holds(driver) -> None:
    def swing(reading):
        return dataclasses.replace(reading, motors=[1600.0, 2400 + 50 * math.sin(30 * reading.taken)])

    driver.spoil = swing
    with pytest.raises(NeverAtRestError, match="motor 'right': does not come to rest"):
        driver.command(radians(0.05, 0.0))
    assert driver.written[-1][0][0] == 1600.0  # where it stands


def test_a_bus_that_falls_silent_in_a_motion_is_not_at_rest(driver) -> None:
    """One reading that grows old is no hand that stands still."""
    kept = []

    def silent(reading):
        if driver.written and time.monotonic() - driver.motors._at > 0.005:
            kept.append(reading)
            return dataclasses.replace(kept[0], moving=False)
        return reading

    driver.spoil = silent
    with pytest.raises(NeverAtRestError, match="sends nothing new"):
        driver.command(radians(0.05, 0.0))


def test_a_stale_sensor_is_named(driver) -> None:
    old = time.monotonic() - 1.0
    driver.spoil = lambda reading: dataclasses.replace(reading, taken=old)
    with pytest.raises(
        StaleReadingError, match=r"motors of my_hand.toml: the newest reading is [\d.]+ s old"
    ):
        driver.observe()


class Published:
    """The newest of messages 10 ms apart, whose every fourth is wrong: looks may see one message twice."""

    def __init__(self) -> None:
        self.came = time.monotonic()

    def __call__(self, reading):
        number = int((time.monotonic() - self.came) / 0.01)
        taken = self.came + 0.01 * number
        return dataclasses.replace(
            reading, motors=[900.0, 2900.0] if number % 4 == 0 else reading.motors, taken=taken
        )


def test_a_message_that_is_wrong_is_not_confirmed_by_itself(driver) -> None:
    """It is the newest one at the first look, and at the second."""
    driver.spoil = Published()
    driver._write(driver._bus(driver._stands()), 0.0)
    assert driver.written[-1][0] == pytest.approx([1600.0, 2400.0])


def test_an_old_message_is_not_confirmed_by_a_reading_of_before_the_motion(driver) -> None:
    """The motion before was broken off by the bus: the motors stand elsewhere than at the last look."""
    driver.command(radians(0.05, 0.0))

    def breaks(reading):
        if driver.motors.goal[0] > 1630.0:
            raise BusError("bus", "noise")
        return reading

    driver.spoil = breaks
    with pytest.raises(BusError, match="noise"):
        driver.command(radians(0.05, 0.0))
    old = iter([[1630.0, 2400.0]])
    driver.spoil = lambda reading: dataclasses.replace(reading, motors=next(old, reading.motors))
    time.sleep(0.02)
    driver.command(radians(-0.01, 0.0))
    assert driver.written[-1][0] == pytest.approx([1654.0, 2400.0])


def test_holding_takes_the_middle_of_three_readings(driver) -> None:
    driver.spoil = Published()
    driver.hold()
    assert driver.written[-1][0] == pytest.approx([1600.0, 2400.0])


def test_a_hand_that_holds_is_read_once_it_has_yielded(driver) -> None:
    """A servo under load stands short of its goal: as its goal becomes where it stands, it yields."""
    send, driver.motors.speed = driver.motors.send, 100.0
    driver.motors.send = lambda goal: send([at - 6.0 for at in goal])
    held = driver.command(radians(0.0, 0.0))
    torch.testing.assert_close(held.a, radians(0.99, 1.01), atol=1e-6, rtol=0)
    torch.testing.assert_close(driver.observe().a, held.a)


def test_a_dry_run_prints_and_sends_nothing(tmp_path) -> None:
    said: list[str] = []
    driver = FakeDriver(write(tmp_path), dry_run=True, say=said.append)
    driver.command(radians(0.05, 0.0))
    driver.hold()
    assert said == [
        "dry run: left (id 1) to 1630 units of the bus = 60.16 deg, "
        "right (id 2) to 2400 units of the bus = 57.3 deg"
    ]
    assert not driver.written


def test_close_holds_and_releases_even_where_the_bus_is_dead(driver) -> None:
    with driver:
        driver.command(radians(0.05, 0.0))
    assert driver.released
    assert driver.written[-1][0] == pytest.approx([1630.0, 2400.0])
    driver.released = False
    driver.motors = None
    driver.close()
    assert driver.released


def test_a_watchdog_that_runs_out_begins_the_motion_again(driver, monkeypatch) -> None:
    goes, send = [False, True], driver.motors.send
    driver.motors.send = lambda goal: goes.pop(0) and send(goal)
    monkeypatch.setattr(driver, "_cut_short", lambda: True)
    torch.testing.assert_close(driver.command(radians(0.05, 0.0)).a, radians(1.05, 1.0), atol=1e-6, rtol=0)
    assert len(driver.written) == 2
    goes += [False] * 5
    with pytest.raises(BusError, match="watchdog has stopped a motion 5 times"):
        driver.command(radians(0.05, 0.0))


# -- poses -------------------------------------------------------------------------------------------------


def sighting(**changes) -> Sighting:
    eye = torch.eye(3, dtype=torch.float64)
    return Sighting(radians(0.0, 0.1, 0.0), eye, time.monotonic())._replace(**changes)


def test_a_pose_is_newer_than_the_motion_and_in_the_hand_frame(driver) -> None:
    frame = torch.eye(4, dtype=torch.float64)
    frame[:3, :3] = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    frame[:3, 3] = radians(0.0, 0.0, 0.5)
    first = sighting()
    looks = []

    def late():  # the first pictures are those of before
        looks.append(1)
        return first if len(looks) < 4 else sighting()

    plant = WithPose(driver, late, frame=frame)
    seen = plant.reset(seed=0)
    torch.testing.assert_close(seen.position, radians(-0.1, 0.0, 0.5))
    torch.testing.assert_close(seen.rotation, frame[:3, :3])
    assert seen.status is PlantStatus.HELD
    assert seen.taken.encoders <= seen.taken.pose <= seen.time
    assert len(looks) == 4


def test_an_object_that_is_not_seen_keeps_its_old_pose_and_stamp(driver) -> None:
    views = [sighting, lambda: None, lambda: None]
    plant = WithPose(driver, lambda: views[0](), patience=0.02)
    first = plant.reset(seed=0)
    views.pop(0)
    again = plant.observe()
    assert again.status is PlantStatus.NOT_SEEN
    assert again.taken.pose == first.taken.pose
    torch.testing.assert_close(again.position, first.position)
    with pytest.raises(ObjectLostError, match="camera, light, markers"):
        plant.reset(seed=0)


def test_joints_by_markers_and_a_loss(driver) -> None:
    q = radians(0.1, 0.2, 0.3, 0.4)
    plant = WithPose(driver, lambda: sighting(q=q), lost=lambda one: float(one.position[1]) > 0.05)
    seen = plant.reset(seed=0)
    torch.testing.assert_close(seen.q, q)
    assert seen.taken.joints == seen.taken.pose
    assert seen.status is PlantStatus.LOST


def test_marker_boards_on_a_camera_give_the_pose() -> None:
    from torch_ekm.sensing import MarkerBoard, MarkerTracker
    from torch_ekm.simulation import SimulatedCamera
    from torch_ekm.simulation.imaging.card_scene import CardScene, PlacedCard

    camera, boards, poses = SimulatedCamera(), (MarkerBoard(0), MarkerBoard(4)), []
    for x in (-0.05, 0.05):  # side by side, facing the camera
        poses.append(np.diag([1.0, -1.0, -1.0, 1.0]))
        poses[-1][:3, 3] = x, 0.0, 0.35
    scene = CardScene(tuple(PlacedCard(*pair) for pair in zip(boards, poses, strict=True)))
    pictures = [camera.render(scene, np.random.default_rng(0)), None]
    source = MarkerPose(lambda: pictures.pop(0), MarkerTracker(camera.camera, *boards))
    found = source()
    torch.testing.assert_close(found.position, radians(0.1, 0.0, 0.0), atol=1e-3, rtol=0)
    assert found.covariance.shape == (6, 6)
    assert found.taken <= time.monotonic()
    assert source() is None
