"""Ros2Plant: genuine rclpy on both ends, the hand in a process of its own."""

from __future__ import annotations

import os
import time
from pathlib import Path

import pytest
import torch

pytest.importorskip("rclpy", reason="rclpy is not here: source a ROS 2, or install the extra 'ros2'")

from far_end import BUSES, End
from wirings import of_page, write

from torch_ekm.drivers import Ros2Plant, RosPose, WithPose
from torch_ekm.exceptions import BusError, DescriptionError, NeverAtRestError, StaleReadingError

ROS2 = next(bus for bus in BUSES if bus.kind == "ros2")
TEXT = """\
[hand]
driver = "ros2"
description = "planar_two_finger"
[bus]
command = "/hand/joint_trajectory"
[limits]
still_for = 0.05
rate_deg = 200
timeout = 0.5
[[motors]]
name = "left"
[[motors]]
name = "right"
sign = -1
"""


@pytest.fixture(scope="module", autouse=True)
def _alone():
    """A domain of this test's own, on this machine alone."""
    old = {name: os.environ.get(name) for name in ("ROS_DOMAIN_ID", "ROS_AUTOMATIC_DISCOVERY_RANGE")}
    os.environ.update(ROS_DOMAIN_ID=str(1 + os.getpid() % 100), ROS_AUTOMATIC_DISCOVERY_RANGE="LOCALHOST")
    yield
    for name, value in old.items():
        os.environ.pop(name) if value is None else os.environ.update({name: value})


@pytest.fixture(scope="module")
def hand(_alone):
    end = End(ROS2, "4.0")  # rad/s
    yield end
    end.close()


@pytest.fixture
def path(tmp_path) -> Path:
    path = tmp_path / "hand.toml"
    path.write_text(TEXT)
    return path


def radians(*values: float) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)


def test_a_motion_a_pose_and_faults_over_ros(hand, path) -> None:
    with Ros2Plant(path) as driver:
        pose = RosPose(driver, "/object", "camera")
        plant = WithPose(driver, pose)
        seen = plant.reset(seed=0)
        torch.testing.assert_close(seen.a, radians(0.8, 0.8))  # the bus has -0.8 of the right one
        torch.testing.assert_close(seen.position, radians(0.0, 0.1, 0.0))
        assert seen.taken.pose >= seen.taken.encoders
        after = plant.command(radians(0.05, 0.02))
        torch.testing.assert_close(after.a - seen.a, radians(0.05, 0.02), atol=1e-6, rtol=0)
        assert after.taken.encoders > seen.time
        hand.ask("goals")
        for word, error, words in (
            ("nan", BusError, "NaN"), ("name", BusError, "has no 'left'; it has: other"),
            ("short", BusError, "2 names and 1 positions"), ("old", StaleReadingError, "motors of hand.toml"),
        ):  # fmt: skip
            hand.ask(f"fault {word}")
            time.sleep(0.05)
            with pytest.raises(error, match=words):
                driver.observe()
        assert hand.ask("goals") == []
        hand.ask("fault")
        time.sleep(0.05)
        wrong = RosPose(driver, "/object", "hand")
        time.sleep(0.2)
        with pytest.raises(BusError, match="in the frame 'camera', it should be in 'hand'"):
            wrong()
        hand.ask("pull silent")
        time.sleep(0.1)
        with pytest.raises(NeverAtRestError, match="sends nothing new"):
            driver.command(radians(0.05, 0.0))
        with pytest.raises(StaleReadingError, match=r"motors of hand.toml"):
            driver.hold()
        hand.ask("plug")


def test_the_file_of_the_how_to_moves_a_hand(hand, tmp_path) -> None:
    """Topic and names are those of the test's hand."""
    text = of_page("ros2").replace("/hand_controller/", "/hand/").replace("_motor", "")
    with Ros2Plant(write(tmp_path, text)) as driver:
        seen = driver.reset(seed=0)
        after = driver.command(radians(0.05, 0.02))
        torch.testing.assert_close(after.a - seen.a, radians(0.05, 0.02), atol=1e-6, rtol=0)


def test_what_is_not_there_is_named(path, monkeypatch) -> None:
    monkeypatch.setattr("torch_ekm.drivers.ros2._TIMEOUT", 0.3)
    path.write_text(TEXT.replace("[limits]", 'joint_states = "/none"\n[limits]'))
    with pytest.raises(BusError, match=r"nothing is received on /none: .*reliable = true"):
        Ros2Plant(path)
    path.write_text(TEXT.replace("[limits]", 'kind = "velocity"\n[limits]'))
    with pytest.raises(DescriptionError, match=r"hand.toml:6: .*'kind' must be one of trajectory, array"):
        Ros2Plant(path)
