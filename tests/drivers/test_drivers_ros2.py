"""Ros2Plant: genuine rclpy on both ends, the hand in a process of its own."""

import contextlib
import os
import threading
import time
from pathlib import Path
from typing import Any

import pytest
import torch

pytest.importorskip("rclpy", reason="rclpy is not here: source a ROS 2, or install the extra 'ros2'")

from far_end import BUSES, End
from wirings import of_page, radians, write

from torch_ekm.drivers import Ros2Plant, RosPose, WithPose
from torch_ekm.exceptions import BusError, DescriptionError, StaleReadingError
from torch_ekm.plant import Path as Waypoints
from torch_ekm.testing import check_following_plant

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
            ("nan", BusError, "NaN"), ("name", StaleReadingError, r"motors \('left'\) of hand.toml"),
            ("short", BusError, "2 names and 1 positions"), ("old", StaleReadingError, "motors .* or clock"),
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
        with pytest.raises(StaleReadingError, match=r"motors .* of hand.toml"):
            driver.command(radians(0.05, 0.0))
        assert hand.ask("goals") == [], "nothing is sent on an old reading"
        with pytest.raises(StaleReadingError, match=r"motors .* of hand.toml"):
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
    with pytest.raises(BusError, match=r"/none: nothing is received: no node publishes it"):
        Ros2Plant(path)
    path.write_text(TEXT.replace("[limits]", 'kind = "velocity"\n[limits]'))
    with pytest.raises(DescriptionError, match=r"hand.toml:6: .*'kind' must be one of trajectory, array"):
        Ros2Plant(path)


class Robot:
    """Nodes of a robot in this process; each says what it is told to every 5 ms."""

    def __init__(self) -> None:
        import rclpy
        from rclpy.executors import SingleThreadedExecutor
        from trajectory_msgs.msg import JointTrajectory

        self._context = rclpy.Context()
        self._context.init(args=[])
        self._executor, self._rclpy = SingleThreadedExecutor(context=self._context), rclpy
        self.goals: list[list[float]] = []
        node = self.node("robot")
        kind, topic = JointTrajectory, "/hand/joint_trajectory"
        node.create_subscription(kind, topic, lambda m: self.goals.append(list(m.points[0].positions)), 10)
        threading.Thread(target=self._spin, daemon=True).start()

    def _spin(self) -> None:
        with contextlib.suppress(Exception):  # the context was shut down
            self._executor.spin()

    def node(self, name: str) -> Any:
        node = self._rclpy.create_node(name, context=self._context)
        self._executor.add_node(node)
        return node

    def says(self, node: Any, behind: float = 0.0, stamped: bool = True, **parts: Any) -> None:
        """A JointState, by a clock that is so much behind."""
        from rclpy.duration import Duration
        from rclpy.qos import qos_profile_sensor_data
        from sensor_msgs.msg import JointState

        publisher = node.create_publisher(JointState, "/joint_states", qos_profile_sensor_data)

        def say() -> None:
            message = JointState(**{name: list(values) for name, values in parts.items()})
            if stamped:
                message.header.stamp = (node.get_clock().now() - Duration(seconds=behind)).to_msg()
            publisher.publish(message)

        node.create_timer(0.005, say)

    def shows(self, node: Any, stamped: bool) -> None:
        """The pose of an object as camera nodes do, by best effort."""
        from geometry_msgs.msg import PoseStamped
        from rclpy.qos import qos_profile_sensor_data

        publisher = node.create_publisher(PoseStamped, "/seen", qos_profile_sensor_data)

        def show() -> None:
            message = PoseStamped()
            message.header.frame_id, message.pose.position.y = "camera", 0.1
            if stamped:
                message.header.stamp = node.get_clock().now().to_msg()
            publisher.publish(message)

        node.create_timer(0.005, show)

    def presses(self, node: Any, *forces: float) -> None:
        """An array of taxels."""
        from std_msgs.msg import Float64MultiArray

        publisher = node.create_publisher(Float64MultiArray, "/taxels", 1)
        node.create_timer(0.005, lambda: publisher.publish(Float64MultiArray(data=list(forces))))

    def close(self) -> None:
        self._context.shutdown()


@pytest.fixture
def robot(_alone, monkeypatch):
    monkeypatch.setenv("ROS_DOMAIN_ID", str(101 + os.getpid() % 100))
    robot = Robot()
    yield robot
    robot.close()


BOTH = {"name": ["left", "right"], "position": [0.8, -0.7]}
SPLIT = {  # who sends what, each from a node of its own
    "an arm beside it": [BOTH, {"name": ["elbow", "wrist"], "position": [1.0, float("nan")]}],
    "a node for each motor": [{"name": ["left"], "position": [0.8]}, {"name": ["right"], "position": [-0.7]}],
    "messages without positions": [BOTH, {"name": ["left", "right"], "effort": [0.1, 0.2]}],
    "no stamps": [{**BOTH, "stamped": False}],
    "other order, NaN efforts": [
        {"name": ["right", "x", "left"], "position": [-0.7, 9.0, 0.8], "effort": [float("nan")] * 3}
    ],
}


@pytest.mark.parametrize("name", SPLIT)
def test_a_reading_is_complete_whoever_sends_it(name, robot, path) -> None:
    for k, message in enumerate(SPLIT[name]):
        robot.says(robot.node(f"node_{k}"), **message)
    with Ros2Plant(path) as driver:
        time.sleep(0.1)
        for _ in range(5):
            seen = driver.observe()
            torch.testing.assert_close(seen.a, radians(0.8, 0.7))
        assert seen.info["load"] == ((0.1, 0.2) if name == "messages without positions" else ())
        assert driver.notes == []
        driver.hold()
    assert robot.goals[-1] == [0.8, -0.7]


WRONG = {
    "a name twice": ([{"name": ["left", "right", "left"], "position": [0.8, -0.7, 0.0]}],
                     "node /node_0 sends the name 'left' twice in one message"),
    "two publishers": ([BOTH, {"name": ["left"], "position": [0.3]}],
                       "node /node_[01] and node /node_[01] send the position of 'left'"),
    "uneven": ([{"name": ["left", "right"], "position": [0.8]}], "/node_0 sends 2 names and 1 positions"),
    "no position": ([{"name": ["left", "right"], "velocity": [0.0, 0.0]}],
                    "has no position of 'left', 'right'; it has: left, right"),
}  # fmt: skip


def look(path: Path) -> None:
    with Ros2Plant(path) as driver:
        for _ in range(20):
            driver.observe()
            time.sleep(0.01)


@pytest.mark.parametrize("name", WRONG)
def test_messages_that_contradict_each_other_are_named_with_their_node(name, robot, path, monkeypatch):
    monkeypatch.setattr("torch_ekm.drivers.ros2._TIMEOUT", 3.0)
    messages, words = WRONG[name]
    for k, message in enumerate(messages):
        robot.says(robot.node(f"node_{k}"), **message)
    time.sleep(0.3)
    with pytest.raises(BusError, match=words):
        look(path)
    assert robot.goals == []


@pytest.mark.parametrize("behind", [2.0, -3.0])
def test_a_robots_clock_is_measured_and_stated(behind, robot, path) -> None:
    robot.says(robot.node("node_0"), behind=behind, **BOTH)
    with Ros2Plant(path) as driver:
        seen = driver.reset(seed=0)
        assert 0 <= seen.time - seen.taken.encoders < 0.1
        (note,) = driver.notes
        way = "2 s behind" if behind > 0 else "3 s ahead of"
        assert f"the clock of node /node_0 is {way} this machine's" in note


@pytest.mark.parametrize("stamped", [True, False])
def test_a_pose_by_best_effort_is_heard(stamped, robot, path) -> None:
    robot.says(robot.node("node_0"), **BOTH)
    robot.shows(robot.node("camera"), stamped)
    with Ros2Plant(path) as driver:
        seen = WithPose(driver, RosPose(driver, "/seen", "camera"), patience=2.0).reset(seed=0)
        torch.testing.assert_close(seen.position, radians(0.0, 0.1, 0.0))
        pose = WithPose(driver, RosPose(driver, "/other", "camera"), patience=2.0)
        with pytest.raises(BusError, match="/other: no node publishes it"):
            pose.reset(seed=0)
        with pytest.raises(BusError, match=r"/two words: Invalid topic name"):
            RosPose(driver, "/two words", "camera")


def test_what_is_sent_as_another_type_is_named_by_it(robot, path, monkeypatch) -> None:
    """The controller takes an array, and the camera's node sends a pose alone."""
    from geometry_msgs.msg import Pose
    from std_msgs.msg import Float64MultiArray

    monkeypatch.setattr("torch_ekm.drivers.ros2._TIMEOUT", 2.0)
    node = robot.node("node_0")
    robot.says(node, **BOTH)
    node.create_publisher(Pose, "/other", 1)
    node.create_subscription(Float64MultiArray, "/array", lambda _: None, 1)
    path.write_text(path.read_text().replace("/hand/joint_trajectory", "/array"))
    with pytest.raises(
        BusError, match="/array: its subscriptions are of std_msgs/msg/Float64MultiArray, not"
    ):
        Ros2Plant(path)
    path.write_text(path.read_text().replace("[limits]", 'kind = "array"\n[limits]'))
    with Ros2Plant(path) as driver:
        pose = WithPose(driver, RosPose(driver, "/other", "camera"), patience=2.0)
        with pytest.raises(BusError, match="/other: its publishers are of geometry_msgs/msg/Pose, not of"):
            pose.reset(seed=0)


def test_two_cameras_on_one_topic_are_named(robot, path) -> None:
    robot.says(robot.node("node_0"), **BOTH)
    for name in ("camera", "tracker"):
        robot.shows(robot.node(name), stamped=True)
    with Ros2Plant(path) as driver:
        pose = RosPose(driver, "/seen", "camera")
        time.sleep(0.5)
        with pytest.raises(
            BusError, match=r"node /(camera|tracker) and node /(camera|tracker) send the pose"
        ):
            pose()


PRESSED = {
    "two nodes": (
        [(1.0, 2.0, 3.0), (9.0, 9.0, 9.0)],
        "node /tips_[01] and node /tips_[01] send the force of '0'",
    ),
    "short": ([(1.0, 2.0)], "/taxels: has no force of '2'; it has: 0, 1"),
    "not finite": ([(1.0, float("nan"), 3.0)], "node /tips_0 sends a force of '1' that is NaN"),
}


@pytest.mark.parametrize("name", ["", *PRESSED])
def test_a_fingertip_is_the_sum_of_its_taxels_by_one_node(name, robot, path) -> None:
    robot.says(robot.node("node_0"), **BOTH)
    tips = '[[fingertips]]\nname = "{}"\nid = "{}"\ncount = {}\nper_newton = 10\n'
    path.write_text(
        TEXT.replace("[limits]", 'fingertips = "/taxels"\n[limits]')
        + tips.format("left", 0, 2) + tips.format("right", 2, 1)
    )  # fmt: skip
    nodes, words = PRESSED.get(name, ([(1.0, 2.0, 5.0)], ""))
    for k, forces in enumerate(nodes):
        robot.presses(robot.node(f"tips_{k}"), *forces)
    time.sleep(0.3)
    if words:
        with pytest.raises(BusError, match=words):
            look(path)
    else:
        with Ros2Plant(path) as driver:
            torch.testing.assert_close(driver.observe().fingertip_force, radians(0.3, 0.5))


def test_one_hand_has_one_master(robot, path) -> None:
    robot.says(robot.node("node_0"), **BOTH)
    with Ros2Plant(path), pytest.raises(BusError, match=r"/hand/joint_trajectory.* one hand has one master"):
        Ros2Plant(path)
    from trajectory_msgs.msg import JointTrajectory

    robot.node("rqt").create_publisher(JointTrajectory, "/hand/joint_trajectory", 1)
    time.sleep(0.3)
    with pytest.raises(BusError, match="node /rqt commands there, too"):
        Ros2Plant(path)


def test_a_movement_over_ros_completes_stops_and_ends_where_nothing_new_comes(hand, path) -> None:
    waypoints = torch.tensor([[0.2, -0.2], [0.3, 0.0]], dtype=torch.float64)
    with Ros2Plant(path) as plant:
        check_following_plant(plant, Waypoints.through(waypoints, 1.0), tolerance=0.01)
        asked = []

        def watch(seen) -> bool:
            asked.append(seen)
            if len(asked) == 3:
                hand.ask("pull silent")
            return True

        long = torch.cat([waypoints, 0 * waypoints, waypoints, 0 * waypoints])
        with pytest.raises(StaleReadingError, match="motors"):
            plant.follow(Waypoints.through(long, 1.0), watch)
        hand.ask("plug")
