"""Values by name, whoever sends them, and clocks that are off: without ROS."""

import math

import pytest

from torch_ekm.drivers.gathered import Gathered, SenderClock
from torch_ekm.exceptions import BusError


def joints(gathered: Gathered, sender: str, at: float, late: float | None = None, **position: float) -> None:
    gathered.take(list(position), {"position": list(position.values())}, sender, late, at)


def test_each_value_has_its_own_time_and_sender() -> None:
    gathered = Gathered("/joint_states", ["a", "b"])
    joints(gathered, "one", 10.0, late=0.003, a=1.0, other=math.nan)
    joints(gathered, "two", 10.01, b=2.0)
    a, b = gathered.newest("position", ["a", "b"], 10.02)
    assert (a.number, a.taken, a.publisher) == (1.0, pytest.approx(9.997), "one")
    assert (b.number, b.taken, b.publisher) == (2.0, 10.01, "two")
    assert gathered.newest("effort", ["a"], 10.02) == [None]
    assert gathered.absent("position", ["a", "c"]) == "has no position of 'c'; it has: a, other, b"


def test_a_message_that_was_overtaken_changes_nothing_and_one_without_names_is_told() -> None:
    gathered = Gathered("/joint_states", ["a"])
    joints(gathered, "one", 9.99, late=0.001)
    assert gathered.absent("position", ["a"]) == "has no position of 'a'; it has: messages without names"
    joints(gathered, "one", 10.0, late=0.001, a=2.0)
    joints(gathered, "one", 10.001, late=0.2, a=1.0)
    (a,) = gathered.newest("position", ["a"], 10.01)
    assert (a.number, a.taken) == (2.0, pytest.approx(9.999))


def test_a_sender_that_takes_over_is_no_second_one() -> None:
    gathered = Gathered("/joint_states", ["a"])
    joints(gathered, "one", 10.0, a=1.0)
    joints(gathered, "two", 10.3, a=2.0)
    with pytest.raises(BusError, match="one and two send the position of 'a'"):
        gathered.newest("position", ["a"], 10.4)
    (a,) = gathered.newest("position", ["a"], 10.6)
    assert a.number == 2.0


def test_a_contradiction_ends_with_the_next_good_message() -> None:
    gathered = Gathered("/joint_states", ["a"])
    joints(gathered, "one", 10.0, a=1.0)
    joints(gathered, "one", 10.1, a=math.inf)
    with pytest.raises(BusError, match="one sends a position of 'a' that is NaN or infinite"):
        gathered.newest("position", ["a"], 10.2)
    joints(gathered, "one", 10.2, other=1.0)  # says nothing of it
    with pytest.raises(BusError):
        gathered.newest("position", ["a"], 10.2)
    joints(gathered, "one", 10.3, a=3.0)
    assert gathered.newest("position", ["a"], 10.3)[0].number == 3.0


def test_latency_counts_and_clocks_that_differ_do_not() -> None:
    clock = SenderClock()
    for k, late in enumerate((0.010, 0.030, 0.012)):
        assert clock.taken(late, 10.0 + k) == pytest.approx(10.0 + k - late)
    assert clock.behind == 0.0
    for off in (2.0, -3.0):
        clock = SenderClock()
        for k, late in enumerate((0.02, 0.05, 0.021, 5.02)):  # the last one is 5 s late
            expected = max(0.0, late - 0.02) if k else 0.0
            assert clock.taken(late + off, 10.0 + k) == pytest.approx(10.0 + k - expected, abs=1e-3)
        assert clock.behind == pytest.approx(off + 0.02, abs=1e-3)


def test_a_clock_that_runs_slow_is_followed() -> None:
    """By 50 ppm, for an hour: readings stay 10 ms old."""
    clock = SenderClock()
    ages = [100.0 * k - clock.taken(2.01 + 5e-5 * 100.0 * k, 100.0 * k) for k in range(36)]
    assert max(ages) < 0.01
