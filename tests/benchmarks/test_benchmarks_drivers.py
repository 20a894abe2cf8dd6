"""A turn over a bus is the turn of the same hand in process; motors stand when their driver is killed."""

import os

import drivers as module  # of benchmarks/
import pytest
from far_end import BUSES, Bus


@pytest.fixture(params=BUSES, ids=lambda bus: bus.kind)
def bus(request, monkeypatch) -> Bus:
    found = request.param
    if not found.installed:
        pytest.skip(f"{found.needs} is not installed")
    monkeypatch.setenv("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    return found


# on a busy machine the other end keeps its own bus waiting: then it is tried once more


def test_the_same_hand_behind_a_bus_makes_the_same_turn(bus, tmp_path) -> None:
    assert module.turns(bus, tmp_path, 1)[0] or module.turns(bus, tmp_path, 3)[0]


def test_motors_stand_within_100_ms_after_their_driver_is_killed(bus, tmp_path) -> None:
    assert module.kills(bus, tmp_path, 1)[0] or module.kills(bus, tmp_path, 3)[0]


def test_spoilt_messages_send_no_motor_beyond_its_limits(bus, tmp_path) -> None:
    count, motions, errors, beyond = module.spoilt(bus, tmp_path, 100)
    assert count >= 100
    assert motions
    assert errors
    assert beyond == 0


def test_a_cable_that_is_pulled_ends_the_turn_with_its_cause(bus, tmp_path) -> None:
    assert module.pulls(bus, tmp_path, 2) == 2
