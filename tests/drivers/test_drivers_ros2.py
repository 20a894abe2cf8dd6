"""Ros2Plant: genuine rclpy on both ends, the hand in a process of its own."""

from __future__ import annotations

import json
import math
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch

pytest.importorskip("rclpy", reason="rclpy is not here: source a ROS 2, or install the extra 'ros2'")

from torch_ekm.drivers import Ros2Plant, RosPose, WithPose
from torch_ekm.exceptions import BusError, DescriptionError, NeverAtRestError, StaleReadingError

DEG = math.pi / 180
TEXT = """\
[hand]
driver = "ros2"
description = "yale_t42"
[bus]
command = "/hand/joint_trajectory"
[limits]
still_for = 0.05
rate_deg = 200
timeout = 0.5
[[motors]]
name = "left"
id = "left_motor"
[[motors]]
name = "right"
id = "right_motor"
sign = -1
"""


class Hand:
    """The other end."""

    def __init__(self, speed: float = 4.0) -> None:
        script = Path(__file__).with_name("ros2_hand.py")
        self.process = subprocess.Popen(
            [sys.executable, str(script), str(speed)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        assert self.process.stdout is not None
        self.process.stdout.readline()

    def ask(self, word: str) -> str:
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.write(word + "\n")
        self.process.stdin.flush()
        return self.process.stdout.readline()

    def close(self) -> None:
        self.process.kill()
        self.process.wait()


@pytest.fixture(scope="module", autouse=True)
def _alone():
    """A domain of this test's own, on this machine alone."""
    old = {name: os.environ.get(name) for name in ("ROS_DOMAIN_ID", "ROS_AUTOMATIC_DISCOVERY_RANGE")}
    os.environ.update(ROS_DOMAIN_ID=str(1 + os.getpid() % 100), ROS_AUTOMATIC_DISCOVERY_RANGE="LOCALHOST")
    yield
    for name, value in old.items():
        os.environ.pop(name) if value is None else os.environ.update({name: value})


@pytest.fixture(scope="module")
def hand():
    hand = Hand()
    yield hand
    hand.close()


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
        assert float(seen.a[0]) == -float(seen.a[1])
        torch.testing.assert_close(seen.position, radians(0.0, 0.1, 0.0))
        assert seen.taken.pose >= seen.taken.encoders
        after = plant.command(radians(0.05, 0.02))
        torch.testing.assert_close(after.a - seen.a, radians(0.05, 0.02), atol=1e-6, rtol=0)
        assert after.taken.encoders > seen.time
        sent = hand.ask("goals")
        for word, error, words in (
            ("nan", BusError, "NaN"), ("name", BusError, "has no 'left_motor'; it has: other"),
            ("short", BusError, "2 names and 1 positions"), ("old", StaleReadingError, "motors of hand.toml"),
        ):  # fmt: skip
            hand.ask(f"spoil {word}")
            time.sleep(0.05)
            with pytest.raises(error, match=words):
                driver.observe()
        assert hand.ask("goals") == sent
        hand.ask("spoil")
        time.sleep(0.05)
        wrong = RosPose(driver, "/object", "hand")
        time.sleep(0.2)
        with pytest.raises(BusError, match="in the frame 'camera', it should be in 'hand'"):
            wrong()
        hand.ask("spoil nothing")
        time.sleep(0.1)
        with pytest.raises(NeverAtRestError, match="sends nothing new"):
            driver.command(radians(0.05, 0.0))
        hand.ask("spoil")


def test_what_is_not_there_is_named(path, monkeypatch) -> None:
    monkeypatch.setattr("torch_ekm.drivers.ros2._TIMEOUT", 0.3)
    path.write_text(TEXT.replace("[limits]", 'joint_states = "/none"\n[limits]'))
    with pytest.raises(BusError, match=r"nothing is received on /none: .*reliable = true"):
        Ros2Plant(path)
    path.write_text(TEXT.replace("[limits]", 'kind = "velocity"\n[limits]'))
    with pytest.raises(DescriptionError, match=r"hand.toml:6: .*'kind' must be one of trajectory, array"):
        Ros2Plant(path)


_MOVES = """
import sys, torch
from torch_ekm.drivers import Ros2Plant
plant = Ros2Plant(sys.argv[1])
print("moving", flush=True)
while True:
    for sign in (1.0, -1.0):
        plant.command(sign * torch.tensor([0.3, 0.3], dtype=torch.float64))
"""


def test_the_hand_stands_soon_after_its_process_is_killed(path) -> None:
    """One point of a trajectory is 80 ms of motion at most; then the controller holds."""
    path.write_text(TEXT.replace("rate_deg = 200", "rate_deg = 30"))
    hand = Hand(speed=30 * DEG)
    try:
        child = subprocess.Popen([sys.executable, "-c", _MOVES, str(path)], stdout=subprocess.PIPE, text=True)
        assert child.stdout is not None
        child.stdout.readline()
        while not json.loads(hand.ask("now"))[1]:
            time.sleep(0.005)
        os.kill(child.pid, signal.SIGKILL)
        child.wait()
        time.sleep(0.1 + 0.05)
        stands = json.loads(hand.ask("now"))
        time.sleep(0.2)
        assert json.loads(hand.ask("now")) == [stands[0], False]
    finally:
        hand.close()
