from __future__ import annotations

import contextlib
import math
import os
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import torch

from .._extras import require
from ..description import HandDescription
from ..exceptions import BusError
from .driver import HandDriver
from .gathered import BusReading, Gathered, Value
from .one_master import OneMaster
from .pose import Sighting
from .wiring import Channel

_TIMEOUT = 5.0  # [s] for the first message and the first subscriber: discovery takes a while
_DISCOVERED = 0.4  # [s] by then a node that runs is known
_POSE = ("x", "y", "z", "orientation.x", "orientation.y", "orientation.z", "orientation.w")
_SYNCHRONOUS = 0.02  # [s] of clocks: less is not worth a note


class Ros2Plant(HandDriver):
    """A hand behind ROS 2: anything with ros2_control, the nodes of LEAP and Allegro.

    Reads sensor_msgs/JointState by name, whoever sends it: a reading is complete when all wired names are new
    enough. Commands positions: a trajectory of one point, an array of numbers, or a JointState. Readings are
    dated by their headers; a sender's clock that is off ours is measured from arrivals, and stated in
    ``notes``. A controller that follows one point holds it: if this process dies, the hand stands after the
    piece under way.

    Args:
        wiring: the TOML file; ids are names in the messages. ``[bus]``: ``joint_states`` ("/joint_states"),
            ``command`` (topic), ``kind`` ("trajectory": trajectory_msgs/JointTrajectory; "array":
            std_msgs/Float64MultiArray, in the description's order; "joint_state"), ``fingertips`` (a
            std_msgs/Float64MultiArray, ids are places), ``use_sim_time``.
        hand: its description; None: the one that the file names.
        options: see :class:`HandDriver`.

    Raises:
        MissingExtraError: rclpy is not there (a ROS 2 that is sourced, or extra ``ros2``).
        DescriptionError: the file is wrong; the message names the line.
        BusError: nothing is received, nobody listens to commands, or another node commands this hand.
    """

    driver, unit, named = "ros2", "rad", True
    keys = ("joint_states", "command", "kind", "fingertips", "use_sim_time")

    def __init__(self, wiring: str | Path, hand: HandDescription | None = None, **options: Any) -> None:
        super().__init__(self.wired(wiring, hand), **options)
        bus, rclpy = self.wiring.bus, require("rclpy")
        states, array = require("sensor_msgs.msg").JointState, require("std_msgs.msg").Float64MultiArray
        self._trajectories = require("trajectory_msgs.msg")
        kinds = {"trajectory": self._trajectories.JointTrajectory, "array": array, "joint_state": states}
        self._kind, topic = bus.text("kind", "trajectory"), bus.text("command")
        if self._kind not in kinds:
            raise bus.error(f"'kind' must be one of {', '.join(kinds)}, got '{self._kind}'")
        self._command = kinds[self._kind]
        qos, executors = require("rclpy.qos"), require("rclpy.executors")
        self._master: OneMaster | None = None
        # by shared memory a process may hear nothing after one before it was killed; users may set another
        os.environ.setdefault("FASTDDS_BUILTIN_TRANSPORTS", "UDPv4")
        self._context = rclpy.Context()
        self._context.init(args=[])
        parameters = []
        if bus.flag("use_sim_time", False):
            parameters.append(require("rclpy.parameter").Parameter("use_sim_time", value=True))
        self.node = rclpy.create_node("torch_ekm", context=self._context, parameter_overrides=parameters)
        """For further subscriptions, such as :class:`RosPose`."""
        # best effort hears all publishers; a depth of 1 would drop what two nodes send at once
        self._quality = qos.QoSProfile(depth=50, reliability=qos.ReliabilityPolicy.BEST_EFFORT)
        self._ids = [str(one.id) for one in (*self.wiring.motors, *self.wiring.joints)]
        self._states = self.gathered(bus.text("joint_states", "/joint_states"), self._ids)
        self.subscribe(states, self._states.topic, self._take)
        self._taxels = [self._places(one) for one in self.wiring.fingertips]
        all_taxels = [k for taxels in self._taxels for k in taxels]
        if all_taxels:
            self._forces = self.gathered(bus.text("fingertips"), all_taxels)
            self.subscribe(array, self._forces.topic, self._take_force)
        with _told(topic):
            self._publisher = self.node.create_publisher(self._command, topic, 1)
        self._executor = executors.SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self._thread = threading.Thread(target=self._spin, daemon=True)
        self._thread.start()
        try:
            if not self.dry_run:
                self._master = OneMaster(f"{topic} of domain {os.environ.get('ROS_DOMAIN_ID', 0)}")
            self._first(
                lambda: None not in self._newest("position", self._ids),
                lambda: self._absent(self._states, "position", self._ids, states),
                self._states.topic,
            )
            if all_taxels:
                self._first(
                    lambda: None not in self._pressed(all_taxels),
                    lambda: self._absent(self._forces, "force", all_taxels, array),
                    self._forces.topic,
                )
            self._first(
                lambda: self.dry_run or self._publisher.get_subscription_count() > 0,
                lambda: self.lacks(topic, self._command, "subscriptions"),
                topic,
            )
            # a node of our own name may be one that was killed: it stays in the graph for some seconds
            own = f"{self.node.get_namespace().rstrip('/')}/{self.node.get_name()}"
            others = {name for name, _ in self.publishers(topic)} - {own}
            if others and not self.dry_run:
                problem = f"node {', '.join(sorted(others))} commands there, too: one hand has one master"
                raise BusError(topic, problem)
            for sender, clock in self._states.clocks.items():
                if abs(clock.behind) > _SYNCHRONOUS:
                    way = "behind" if clock.behind > 0 else "ahead of"
                    off = f"{abs(clock.behind):.3g} s {way} this machine's"
                    self.notes.append(
                        f"the clock of {self._states.called(sender)} is {off}, as measured from arrivals"
                    )
        except BaseException:
            self._release()
            raise

    def _spin(self) -> None:
        with contextlib.suppress(Exception):  # the context was shut down
            self._executor.spin()

    # -- what arrives -------------------------------------------------------------------------------

    def subscribe(self, kind: Any, topic: str, take: Callable[[Any, Any], None]) -> None:
        """``take`` gets each message and its sender as the middleware states it, of any publisher."""
        informs = hasattr(require("rclpy.subscription").Subscription, "CallbackType")  # since ROS 2 Iron
        back = take if informs else lambda message: take(message, {})
        with _told(topic):
            self.node.create_subscription(kind, topic, back, self._quality)

    def lacks(self, topic: str, kind: Any, what: str = "publishers") -> str:
        """Why messages of a kind do not pass on a topic; "": it has publishers or subscriptions for them."""
        own = f"{kind.__module__.partition('.')[0]}/msg/{kind.__name__}"
        types = {one.topic_type for one in getattr(self.node, f"get_{what}_info_by_topic")(topic)}
        if not types:
            verb = "publishes" if what == "publishers" else "subscribes to"
            return f"no node {verb} it: is there one running?"
        return "" if own in types else f"its {what} are of {', '.join(sorted(types))}, not of {own}"

    def _absent(self, gathered: Gathered, part: str, names: Sequence[str], kind: Any) -> str:
        said = gathered.absent(part, names)
        if not gathered.heard and (problem := self.lacks(gathered.topic, kind)):
            said += f": {problem}"
        return said

    def publishers(self, topic: str) -> list[tuple[str, bytes]]:
        """Nodes that publish a topic, and by which id; names come a little later than messages."""
        end = time.monotonic() + _DISCOVERED
        while True:
            found = self.node.get_publishers_info_by_topic(topic)
            if time.monotonic() > end or not any("UNKNOWN" in one.node_name for one in found):
                return [
                    (f"{one.node_namespace.rstrip('/')}/{one.node_name}", bytes(one.endpoint_gid))
                    for one in found
                ]
            time.sleep(0.01)

    def lateness(self, header: Any, info: Any) -> tuple[float | None, float]:
        """What a message took from its stamp on, None without a stamp, and when it arrived [s]."""
        now, received = time.monotonic(), info.get("received_timestamp", 0)
        waited = 1e-9 * (time.time_ns() - received) if received else 0.0  # in the queue
        waited = waited if 0 <= waited < _TIMEOUT else 0.0
        stamp = 0 if header is None else header.stamp.sec * 1_000_000_000 + header.stamp.nanosec
        late = 1e-9 * (self.node.get_clock().now().nanoseconds - stamp) - waited if stamp else None
        return late, now - waited

    def gathered(self, topic: str, wanted: Sequence[str]) -> Gathered:
        """For what comes by a topic; its publishers are called by their nodes."""

        def called(sender: Any) -> str:
            name = {gid: name for name, gid in self.publishers(topic)}.get(sender, "UNKNOWN")
            return "a node without a name yet" if "UNKNOWN" in name else f"node {name}"

        return Gathered(topic, wanted, called)

    def _take(self, message: Any, info: Any) -> None:
        parts = {"position": message.position, "velocity": message.velocity, "effort": message.effort}
        sender = sender_of(info) or tuple(message.name)  # where the middleware names none, what it sends
        self._states.take(message.name, parts, sender, *self.lateness(message.header, info))

    def _take_force(self, message: Any, info: Any) -> None:
        names = [str(k) for k in range(len(message.data))]
        self._forces.take(names, {"force": message.data}, sender_of(info), *self.lateness(None, info))

    def _places(self, one: Channel) -> list[str]:
        """Of a fingertip's taxels in the array."""
        if not str(one.id).isdecimal():
            raise self.wiring.error(
                "fingertips", one, f"'id' must be a place in the array, got '{one.id}'", "id"
            )
        return [str(int(one.id) + k) for k in range(one.count)]

    def _pressed(self, taxels: Sequence[str]) -> list[Value | None]:
        return self._forces.newest("force", taxels, time.monotonic())

    @staticmethod
    def _first(came: Callable[[], bool], problem: Callable[[], str], topic: str) -> None:
        end = time.monotonic() + _TIMEOUT
        while not came():
            if time.monotonic() > end:
                raise BusError(topic, problem())
            time.sleep(0.005)

    def _newest(self, part: str, ids: Sequence[str]) -> list[Value | None]:
        return self._states.newest(part, ids, time.monotonic())

    def _read(self) -> BusReading:
        n = len(self.wiring.motors)
        positions = [
            one for one in self._newest("position", self._ids) if one is not None
        ]  # all came at first
        motors, joints = positions[:n], positions[n:]
        oldest = min(range(n), key=lambda k: motors[k].taken)
        taken = motors[oldest].taken

        def beside(part: str) -> list[float]:
            """Of each motor, if it comes with the positions."""
            found = self._newest(part, self._ids[:n])
            return [
                math.nan if one is None or one.taken < at.taken - 2 * self.limits.period else one.number
                for one, at in zip(found, motors, strict=True)
            ]

        still = self.limits.still / self.limits.still_for
        speeds = [
            abs(x) / one.per_unit for x, one in zip(beside("velocity"), self.wiring.motors, strict=True)
        ]
        load = beside("effort")
        pressed = [[one for one in self._pressed(k) if one is not None] for k in self._taxels]
        return BusReading(
            motors=[one.number for one in motors],
            taken=taken,
            moving=any(x > still for x in speeds),
            joints=[one.number for one in joints],
            joints_taken=min((one.taken for one in joints), default=math.inf),
            fingertips=[sum(one.number for one in tip) for tip in pressed],
            fingertips_taken=min((one.taken for tip in pressed for one in tip), default=math.inf),
            load=load if all(map(math.isfinite, load)) else (),
            oldest=f"'{self._ids[oldest]}'",
        )

    def _write(self, goal: Sequence[float], seconds: float) -> None:
        goal, names = [float(x) for x in goal], self._ids[: len(goal)]
        if self._kind == "trajectory":
            point = self._trajectories.JointTrajectoryPoint(positions=goal)
            point.time_from_start.nanosec = int(1e9 * min(max(seconds, 0.01), 0.9))
            message = self._command(joint_names=names, points=[point])
        elif self._kind == "array":
            message = self._command(data=goal)
        else:
            message = self._command(name=names, position=goal)
            message.header.stamp = self.node.get_clock().now().to_msg()
        if self._publisher.get_subscription_count() == 0:
            raise BusError(self._publisher.topic_name, "no node subscribes to it any more")
        self._publisher.publish(message)

    def _release(self) -> None:
        with contextlib.suppress(Exception):
            self._executor.shutdown(timeout_sec=1.0)
            self.node.destroy_node()
            self._context.shutdown()
        if self._master is not None:
            self._master.release()


def sender_of(info: Any) -> Any:
    """Which publisher a message is of, as far as the middleware states it."""
    return (info.get("publisher_gid") or {}).get("data")


@contextlib.contextmanager
def _told(topic: str) -> Iterator[None]:
    """What rclpy says of a topic's name or type is a BusError."""
    try:
        yield
    except Exception as error:
        raise BusError(topic, str(error).partition("\n")[0]) from error


class RosPose:
    """The object's pose from a topic of geometry_msgs/PoseStamped; a source for :class:`WithPose`.

    Args:
        plant: gives node and clock.
        topic: of the pose.
        frame: ``header.frame_id`` that it must have; its pose in the hand frame is ``WithPose(frame=...)``.
    """

    def __init__(self, plant: Ros2Plant, topic: str, frame: str) -> None:
        self._plant, self._topic, self._frame, self._other = plant, topic, frame, ""
        self._poses, self._began = plant.gathered(topic, _POSE), time.monotonic()
        self._kind = require("geometry_msgs.msg").PoseStamped
        plant.subscribe(self._kind, topic, self._take)

    def _take(self, message: Any, info: Any) -> None:
        there = message.header.frame_id
        self._other = "" if there == self._frame else there or "(none)"
        if self._other:
            return
        o, r = message.pose.position, message.pose.orientation
        numbers = {"pose": (o.x, o.y, o.z, r.x, r.y, r.z, r.w)}
        self._poses.take(_POSE, numbers, sender_of(info), *self._plant.lateness(message.header, info))

    def __call__(self) -> Sighting | None:
        """The newest pose, dated by its stamp, or by its arrival without one; None: there was none yet.

        Raises:
            BusError: nobody publishes the topic, or two nodes do; it is in another frame, not finite, or its
                orientation is no rotation.
        """
        if self._other:
            problem = f"the pose is in the frame '{self._other}', it should be in '{self._frame}'"
            raise BusError(self._topic, problem)
        newest = [one for one in self._poses.newest("pose", _POSE, time.monotonic()) if one is not None]
        if not newest:
            waited = time.monotonic() - self._began > _DISCOVERED
            if waited and (problem := self._plant.lacks(self._topic, self._kind)):
                raise BusError(self._topic, problem)
            return None
        numbers = [one.number for one in newest]
        if not abs(sum(x**2 for x in numbers[3:]) - 1) < 1e-3:
            raise BusError(self._topic, "the orientation is no unit quaternion")
        rotation = require("scipy.spatial.transform").Rotation.from_quat(numbers[3:])
        position = torch.tensor(numbers[:3], dtype=torch.float64)
        return Sighting(position, torch.from_numpy(rotation.as_matrix()), newest[0].taken)
