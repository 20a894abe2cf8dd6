"""Movements through waypoints over the buses: to the end, stopped in mid-way, and where the bus dies."""

import dataclasses
import time

import numpy as np
import pytest
import torch
from motors import Motors
from no_bus import FakeDriver
from test_drivers_yarp import increment
from test_drivers_yarp import wiring as yarp_wiring
from wirings import DEG, write
from yarp_golden import GoldenYarp

from torch_ekm.drivers import Sighting, WithPose, YarpPlant
from torch_ekm.exceptions import BusError, CommandRefusedError, EKMError, StaleReadingError
from torch_ekm.plant import Path, can_follow
from torch_ekm.testing import check_following_plant

SLOW = 60 * DEG


@pytest.fixture
def driver(tmp_path) -> FakeDriver:
    return FakeDriver(write(tmp_path))


def way(*degrees: tuple[float, float], speed: float = SLOW) -> Path:
    return Path.through(DEG * torch.tensor(degrees, dtype=torch.float64), speed)


THERE_AND_BACK = (12.0, -12.0), (12.0, 0.0), (0.0, 4.0)


def test_the_contract_holds(driver) -> None:
    assert can_follow(driver)
    check_following_plant(driver, way((12, -12), (18, 0)), tolerance=0.5 * DEG)


def test_positions_are_streamed_along_the_waypoints(driver) -> None:
    """In pieces of 0.08 s at most, each waypoint among them, at the path's speed."""
    passed, began = [], time.monotonic()
    driver.follow(way(*THERE_AND_BACK), lambda seen: passed.append(seen) or True)
    goals = np.array([goal for goal, _ in driver.written])
    goals = (goals - [1600, 2400]) / [600, -600] / DEG
    corners = [np.abs(goals - w).max(1).argmin() for w in np.array(THERE_AND_BACK)]
    assert corners == [2, 5, 8]
    assert len(goals) == 9
    assert goals[corners] == pytest.approx(np.array(THERE_AND_BACK))
    assert np.abs(np.diff(goals, axis=0, prepend=0)).max() == pytest.approx(4.0)
    assert time.monotonic() - began > 0.59
    dates = np.diff([seen.taken.encoders for seen in passed])
    assert len(passed) > 5
    assert dates.min() >= driver.limits.period


def test_a_servo_that_is_slower_than_the_path_takes_longer(tmp_path) -> None:
    driver = FakeDriver(write(tmp_path, change="rate_deg = 200|rate_deg = 50"))
    began = time.monotonic()
    driver.follow(way((10, -10), speed=1000 * DEG), lambda seen: True)
    assert time.monotonic() - began > 0.19


def test_where_watch_answers_false_the_motors_hold_at_once(driver) -> None:
    asked = []
    start = driver.observe()
    after = driver.follow(way((20, -20), (40, -40)), lambda seen: asked.append(seen) or len(asked) < 4)
    assert len(asked) == 4
    went = (after.a - start.a) / DEG
    seen = (asked[-1].a - start.a) / DEG
    assert 0 < float(went[0]) < 35
    assert float((went - seen).abs().max()) < 8  # a busy machine: 0.1 s of motion
    assert driver.written[-1][0] == pytest.approx(driver.motors.now(), abs=600 * 0.5 * DEG)


def test_a_watcher_that_fails_leaves_a_hand_that_holds(driver) -> None:
    def watch(seen) -> bool:
        raise EKMError("no")

    with pytest.raises(EKMError, match="no"):
        driver.follow(way((20, -20), (40, -40)), watch)
    time.sleep(0.1)
    assert not driver.motors.moving
    assert driver.motors.now()[0] < 1600 + 600 * 30 * DEG


def test_a_bus_that_dies_on_the_way_gets_no_further_goals(driver) -> None:
    def dies(reading):
        if len(driver.written) > 3:
            raise BusError("bus", "unplugged")
        return reading

    driver.spoil = dies
    with pytest.raises(BusError, match="unplugged"):
        driver.follow(way((20, -20), (40, -40)), lambda seen: True)
    assert len(driver.written) == 4


def test_motors_that_send_nothing_new_end_the_movement(driver) -> None:
    kept = []

    def silent(reading):
        if len(driver.written) < 2:
            return reading
        kept.append(reading)
        return dataclasses.replace(kept[0], moving=False)

    driver.spoil = silent
    path = way(*((20.0 * (k % 2), -20.0 * (k % 2)) for k in range(1, 9)))
    with pytest.raises(StaleReadingError, match="motors"):
        driver.follow(path, lambda seen: True)
    assert len(driver.written) < 12  # of 40: 0.3 s


def test_each_piece_is_within_the_largest_increment(driver) -> None:
    with pytest.raises(CommandRefusedError, match=r"motor 'right': a command of -23 deg"):
        driver.follow(way((10, 11), (10, -12)), lambda seen: True)
    assert not driver.written


def test_a_watchdog_that_runs_out_on_the_way_begins_with_the_piece_under_way(driver, monkeypatch) -> None:
    """The motors stop in the second piece: the first waypoint is not gone to again."""
    calls, send, noticed = [], driver.motors.send, []

    def cut(goal) -> None:
        calls.append(goal)
        if len(calls) <= 2 or noticed:  # of three
            send(goal)

    driver.motors.send = cut
    monkeypatch.setattr(driver, "_cut_short", lambda: noticed.append(1) or True)
    after = driver.follow(way((8, -8), (8, 8), speed=100 * DEG), lambda seen: True)
    goals = (np.array(calls)[:, 1] - 2400) / -600 / DEG
    assert noticed
    assert goals.min() == pytest.approx(-8)
    assert list(goals).count(goals.min()) == 1
    torch.testing.assert_close(
        after.a, torch.tensor([1 + 8 * DEG, 1 + 8 * DEG], dtype=torch.float64), atol=1e-3, rtol=0
    )


def test_a_pose_on_the_way_is_the_newest_and_is_not_waited_for(driver) -> None:
    first = Sighting(torch.zeros(3).double(), torch.eye(3).double(), time.monotonic())
    views = [lambda: first._replace(taken=time.monotonic())]
    plant, passed = WithPose(driver, lambda: views[0](), patience=5.0), []
    plant.reset(seed=0)

    def watch(seen) -> bool:
        passed.append(seen)  # the camera sees nothing new until the last reading
        views[0] = lambda: first if len(passed) < 4 else first._replace(taken=time.monotonic())
        return len(passed) < 4

    began = time.monotonic()
    plant.follow(way((12, -12), (18, 0)), watch)
    assert time.monotonic() - began < 4.0
    assert passed[-1].taken.pose == first.taken < passed[-1].taken.encoders


# -- buses --------------------------------------------------------------------------------------------------


@pytest.fixture
def servos(tmp_path):
    from dynamixel_bus import DynamixelBus

    from torch_ekm.drivers import DynamixelPlant

    with (
        DynamixelBus([1, 2], Motors([1600.0, 2400.0], 4000.0)) as bus,
        DynamixelPlant(write(tmp_path, port=bus.port)) as plant,
    ):
        yield bus, plant


def test_dynamixel_completes_and_stops(servos) -> None:
    bus, plant = servos
    check_following_plant(plant, way((12, -12), (18, 0)), tolerance=0.5 * DEG)
    plant.observe()  # a sync write has no answer: what comes after it has
    assert bus.tables[1][98] == 0  # at rest no watchdog


@pytest.fixture
def icub(tmp_path):
    network = GoldenYarp()
    with YarpPlant(yarp_wiring(tmp_path, network.server)) as plant:
        yield network, plant
    network.close()


def proximal(*degrees: float) -> Path:
    return Path.through(torch.stack([increment(index_proximal=x * DEG) for x in degrees]), SLOW)


def test_yarp_completes_and_stops(icub) -> None:
    _, plant = icub
    check_following_plant(plant, proximal(12, 20), tolerance=0.5 * DEG)
