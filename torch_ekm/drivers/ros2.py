from __future__ import annotations

import contextlib
import math
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from .._extras import require
from ..description import HandDescription
from ..exceptions import BusError
from .driver import BusReading, HandDriver
from .pose import Sighting
from .wiring import Wiring

_BUS = ("joint_states", "command", "kind", "fingertips", "reliable", "use_sim_time", "node")
_KINDS = ("trajectory", "array", "joint_state")
_TIMEOUT = 3.0  # [s] for the first message and the first subscriber


class Ros2Plant(HandDriver):
    """A hand behind ROS 2: anything with ros2_control, the nodes of LEAP and Allegro.

    Reads sensor_msgs/JointState by name; commands positions: a trajectory of one point, an array of numbers,
    or a JointState. Readings are dated by their headers, on the node's clock. A controller that follows one
    point holds it: if this process dies, the hand stands after the piece under way.

    Args:
        wiring: the TOML file; ids are names in the messages. ``[bus]``: ``joint_states`` ("/joint_states"),
            ``command`` (topic), ``kind`` ("trajectory": trajectory_msgs/JointTrajectory; "array":
            std_msgs/Float64MultiArray, in the description's order; "joint_state"), ``fingertips`` (a
            std_msgs/Float64MultiArray, ids are places), ``reliable`` (true; false: best effort),
            ``use_sim_time``, ``node``.
        hand: its description; None: the one that the file names.
        options: see :class:`HandDriver`.

    Raises:
        MissingExtraError: rclpy is not there (a ROS 2 that is sourced, or extra ``ros2``).
        DescriptionError: the file is wrong; the message names the line.
        BusError: nothing is received, or nobody listens to commands.
    """

    def __init__(self, wiring: str | Path, hand: HandDescription | None = None, **options: Any) -> None:
        super().__init__(Wiring.read(wiring, "ros2", 1.0, _BUS, named=True, hand=hand), **options)
        bus, rclpy = self.wiring.bus, require("rclpy")
        self._kind = bus.text("kind", "trajectory")
        if self._kind not in _KINDS:
            raise bus.error(f"'kind' must be one of {', '.join(_KINDS)}, got '{self._kind}'")
        topic, self._states_topic = bus.text("command"), bus.text("joint_states", "/joint_states")
        qos, executors = require("rclpy.qos"), require("rclpy.executors")
        self._messages = {
            "sensor": require("sensor_msgs.msg"),
            "trajectory": require("trajectory_msgs.msg"),
            "std": require("std_msgs.msg"),
        }
        self._context = rclpy.Context()
        self._context.init(args=[])
        parameters = []
        if bus.flag("use_sim_time", False):
            parameters.append(require("rclpy.parameter").Parameter("use_sim_time", value=True))
        self.node = rclpy.create_node(
            bus.text("node", "torch_ekm"), context=self._context, parameter_overrides=parameters
        )
        """For further subscriptions, such as :class:`RosPose`."""
        policy = qos.ReliabilityPolicy
        reliable = bus.flag("reliable", True)
        quality = qos.QoSProfile(depth=1, reliability=policy.RELIABLE if reliable else policy.BEST_EFFORT)
        self._newest: dict[str, tuple[Any, float]] = {}
        self.node.create_subscription(
            self._messages["sensor"].JointState,
            self._states_topic,
            lambda m: self._take("states", m),
            quality,
        )
        if self.wiring.fingertips:
            self.node.create_subscription(
                self._messages["std"].Float64MultiArray, bus.text("fingertips"),
                lambda m: self._take("fingertips", m), quality,
            )  # fmt: skip
        kind = {"trajectory": self._messages["trajectory"].JointTrajectory,
                "array": self._messages["std"].Float64MultiArray,
                "joint_state": self._messages["sensor"].JointState}[self._kind]  # fmt: skip
        self._publisher = self.node.create_publisher(kind, topic, 1)
        self._executor = executors.SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self._thread = threading.Thread(target=self._spin, daemon=True)
        self._thread.start()
        try:
            offered = f"is [bus] reliable = {str(reliable).lower()} what it offers?"
            nothing = f"nothing is received on {self._states_topic}: is its publisher running, and {offered}"
            self._first("states", nothing)
            end = time.monotonic() + _TIMEOUT
            while not self.dry_run and self._publisher.get_subscription_count() == 0:
                if time.monotonic() > end:
                    raise BusError(topic, "no node subscribes to it: is the controller running?")
                time.sleep(0.01)
        except BaseException:
            self._release()
            raise

    def _spin(self) -> None:
        with contextlib.suppress(Exception):  # the context was shut down
            self._executor.spin()

    def taken(self, stamp: Any) -> float:
        """A header's stamp, by the node's clock, as a time of ``time.monotonic()`` [s]."""
        now = self.node.get_clock().now().nanoseconds
        return time.monotonic() - 1e-9 * (now - stamp.sec * 1_000_000_000 - stamp.nanosec)

    def _take(self, kind: str, message: Any) -> None:
        dated = kind == "states" and (message.header.stamp.sec or message.header.stamp.nanosec)
        taken = self.taken(message.header.stamp) if dated else time.monotonic()
        self._newest[kind] = message, min(taken, time.monotonic())

    def _first(self, kind: str, problem: str) -> tuple[Any, float]:
        end = time.monotonic() + _TIMEOUT
        while kind not in self._newest:
            if time.monotonic() > end:
                raise BusError(f"ROS 2 node '{self.node.get_name()}'", problem)
            time.sleep(0.005)
        return self._newest[kind]

    def _read(self) -> BusReading:
        message, taken = self._first("states", f"nothing is received on {self._states_topic}")
        at = {name: k for k, name in enumerate(message.name)}
        absent = [c.id for c in (*self.wiring.motors, *self.wiring.joints) if c.id not in at]
        if len(message.position) != len(message.name):
            problem = f"{len(message.name)} names and {len(message.position)} positions"
            raise BusError(self._states_topic, problem)
        if absent:
            problem = f"has no '{', '.join(map(str, absent))}'; it has: {', '.join(message.name)}"
            raise BusError(self._states_topic, problem)
        motors, joints = (
            [float(message.position[at[one.id]]) for one in channels]
            for channels in (self.wiring.motors, self.wiring.joints)
        )
        if not all(map(math.isfinite, [*motors, *joints])):
            raise BusError(self._states_topic, "a position is NaN or infinite")
        still = self.limits.still / self.limits.still_for
        moving = len(message.velocity) == len(message.name) and any(
            abs(message.velocity[at[one.id]]) / one.per_unit > still for one in self.wiring.motors
        )
        force, force_taken = [], math.inf
        if self.wiring.fingertips:
            array, force_taken = self._first("fingertips", "no fingertips are received")
            force = self._forces(array.data)
        has_load = len(message.effort) == len(message.name)
        load = [float(message.effort[at[one.id]]) for one in self.wiring.motors] if has_load else []
        joints_taken = taken if joints else math.inf
        return BusReading(motors, taken, moving, joints, joints_taken, force, force_taken, load)

    def _forces(self, data: Sequence[float]) -> list[float]:
        found = []
        for one in self.wiring.fingertips:
            place = str(one.id)
            if not place.isdigit() or int(place) + one.count > len(data):
                problem = f"{len(data)} numbers, [[fingertips]] '{one.name}' has id '{place}'"
                raise BusError("fingertips", problem)
            found.append(float(sum(data[int(place) : int(place) + one.count])))
        return found

    def _write(self, goal: Sequence[float], seconds: float) -> None:
        goal = [float(x) for x in goal]
        names = [str(one.id) for one in self.wiring.motors]
        if self._kind == "trajectory":
            kind = self._messages["trajectory"]
            point = kind.JointTrajectoryPoint(positions=goal)
            point.time_from_start.nanosec = int(1e9 * min(max(seconds, 0.01), 0.9))
            message = kind.JointTrajectory(joint_names=names, points=[point])
        elif self._kind == "array":
            message = self._messages["std"].Float64MultiArray(data=goal)
        else:
            message = self._messages["sensor"].JointState(name=names, position=goal)
            message.header.stamp = self.node.get_clock().now().to_msg()
        if self._publisher.get_subscription_count() == 0:
            raise BusError(self._publisher.topic_name, "no node subscribes to it any more")
        self._publisher.publish(message)

    def _release(self) -> None:
        with contextlib.suppress(Exception):
            self._executor.shutdown(timeout_sec=1.0)
            self.node.destroy_node()
            self._context.shutdown()


class RosPose:
    """The object's pose from a topic of geometry_msgs/PoseStamped; a source for :class:`WithPose`.

    Args:
        plant: gives node and clock.
        topic: of the pose.
        frame: ``header.frame_id`` that it must have; its pose in the hand frame is ``WithPose(frame=...)``.
    """

    def __init__(self, plant: Ros2Plant, topic: str, frame: str) -> None:
        self._plant, self._topic, self._frame = plant, topic, frame
        self._newest: Any = None
        message = require("geometry_msgs.msg").PoseStamped
        plant.node.create_subscription(message, topic, self._take, 1)

    def _take(self, message: Any) -> None:
        self._newest = message

    def __call__(self) -> Sighting | None:
        """The newest pose; None: there was none yet.

        Raises:
            BusError: it is in another frame, or its orientation is no rotation.
        """
        message = self._newest
        if message is None:
            return None
        if message.header.frame_id != self._frame:
            there = message.header.frame_id
            raise BusError(
                self._topic, f"the pose is in the frame '{there}', it should be in '{self._frame}'"
            )
        o, r = message.pose.position, message.pose.orientation
        if not abs(r.w**2 + r.x**2 + r.y**2 + r.z**2 - 1) < 1e-3:
            raise BusError(self._topic, "the orientation is no unit quaternion")
        rotation = require("scipy.spatial.transform").Rotation.from_quat([r.x, r.y, r.z, r.w])
        position = torch.tensor([o.x, o.y, o.z], dtype=torch.float64)
        taken = self._plant.taken(message.header.stamp)
        return Sighting(position, torch.from_numpy(rotation.as_matrix()), taken)
