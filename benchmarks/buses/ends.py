"""The other end of a bus, a process of its own: python ends.py dynamixel|ros2|yarp HAND [YARP_PYTHON].

HAND is "hand", a simulated one that holds its object, or the speed of motors alone [rad/s]. Prints "ready"
and what a driver needs to find it; then a line of JSON for each line:

    reset SEED        another grasp
    now               motors [bus units], whether one moves, spoilt messages
    pose              object and joints, whether the object is lost, and now
    goals             all since the last time [bus units]
    spoil CHANCE      messages to the driver are garbled, cut, doubled and late; 0: no longer
    fault KIND        of ROS 2's messages: nan, name, short, old; nothing: none
    pull closed|silent    the cable: connections close, or nothing comes through any more
    plug              back again, and where
    mark NUMBER       the number: what comes after it answers no earlier question
"""

from __future__ import annotations

import contextlib
import json
import os
import select
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

from dynamixel_bus import DynamixelBus
from far_end import HAND, OBJECT, PORT_NAME, SIGNS, START, UNITS, ZEROS, simulated
from motors import HandMotors, Motors
from spoiling import Spoiler
from yarp_text import answer

from torch_ekm.plant import PlantStatus
from torch_ekm.simulation import SimulatedHand


class Wire:
    """A cable that can be spoilt and pulled, where nothing is known of what is still under way."""

    silent = False

    def spoil(self, spoiler: Spoiler) -> None:
        self.spoiler = spoiler

    def catch_up(self) -> None:
        time.sleep(0.2)

    def pull(self, silent: bool) -> None:
        if silent:
            self.silent = True
        else:
            self.cut()

    def cut(self) -> None:
        raise NotImplementedError


class Dynamixel:
    """Servos behind a pseudo terminal; the genuine SDK is the client."""

    def __init__(self, motors: Any) -> None:
        self.motors, self.goals = motors, []
        self.bus = self._new()

    def _new(self) -> DynamixelBus:
        bus = DynamixelBus([1, 2], self.motors)
        bus.goals = self.goals
        return bus

    @property
    def place(self) -> str:
        return self.bus.port

    def spoil(self, spoiler: Spoiler) -> None:
        self.bus.spoil = spoiler

    def catch_up(self) -> None:
        self.bus.catch_up()

    def pull(self, silent: bool) -> None:
        if silent:
            self.bus.silent = set(self.bus.ids)
        else:
            self.bus.close()

    def plug(self) -> None:
        self.bus.close()
        self.bus = self._new()

    def close(self) -> None:
        self.bus.close()


class Ros2(Wire):
    """A node of genuine rclpy: joint states every ``period`` [s], trajectories of one point, as
    ros2_control's controllers; the pose of an object at (0, 0.1, 0) m."""

    place = "ros2"

    def __init__(self, motors: Any, names: tuple[str, ...], period: float) -> None:
        self.motors, self.names, self.goals, self.period = motors, names, [], period
        self.spoiler, self.fault = Spoiler(0.0, 0), ""
        self.plug()

    def plug(self) -> None:
        import rclpy
        from geometry_msgs.msg import PoseStamped
        from rclpy.executors import SingleThreadedExecutor
        from sensor_msgs.msg import JointState
        from trajectory_msgs.msg import JointTrajectory

        self.close()
        self.silent, self._context = False, rclpy.Context()
        self._context.init(args=[])
        node = rclpy.create_node("hand", context=self._context)
        states = node.create_publisher(JointState, "/joint_states", 1)
        poses = node.create_publisher(PoseStamped, "/object", 1)

        def follow(message: JointTrajectory) -> None:
            at = dict(zip(message.joint_names, message.points[0].positions, strict=True))
            if not self.silent:
                self.goals.append([at[name] for name in self.names])
                self.motors.send(self.goals[-1])

        def show() -> None:
            if self.silent:
                return
            moving, packed = self.motors.moving, struct.pack(f"<{len(self.names)}d", *self.motors.now())
            packed = self.spoiler(packed)
            position = [x for (x,) in struct.iter_unpack("<d", packed[: len(packed) // 8 * 8])]
            message = JointState(name=list(self.names), position=position)
            message.velocity = [1.0 if moving else 0.0] * len(self.names)
            message.header.stamp = node.get_clock().now().to_msg()
            if self.fault == "old":
                message.header.stamp.sec -= 5
            if self.fault == "name":
                message.name[0] = "other"
            if self.fault == "nan":
                message.position[0] = float("nan")
            if self.fault == "short":
                message.position = message.position[:-1]
            states.publish(message)
            pose = PoseStamped()
            pose.header.stamp, pose.header.frame_id = message.header.stamp, "camera"
            pose.pose.position.y, pose.pose.orientation.w = 0.1, 1.0
            poses.publish(pose)

        node.create_subscription(JointTrajectory, "/hand/joint_trajectory", follow, 10)
        node.create_timer(self.period, show)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(node)
        self._thread = threading.Thread(target=self._spin, daemon=True)
        self._thread.start()

    def _spin(self) -> None:
        with contextlib.suppress(Exception):  # the context was shut down
            self._executor.spin()

    def cut(self) -> None:
        self.close()

    def close(self) -> None:
        if (context := getattr(self, "_context", None)) is not None and context.ok():
            context.shutdown()
            self._thread.join(2.0)


class Yarp(Wire):
    """A genuine name server, and a genuine rpc port; the driver reaches it by a cable that can be spoilt."""

    def __init__(self, motors: Any, python: str) -> None:
        self.motors, self.goals, self.modes, self.spoiler = motors, [], {}, Spoiler(0.0, 0)
        with socket.create_server(("127.0.0.1", 0)) as free:
            self._server = free.getsockname()[1]
        self._folder = tempfile.TemporaryDirectory()
        environment = {**os.environ, "YARP_CONFIG_HOME": self._folder.name}
        server = [str(Path(python).parent / "yarpserver"), "--socket", str(self._server)]
        quiet: dict[str, Any] = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        self._processes = [subprocess.Popen(server, env=environment, start_new_session=True, **quiet)]
        self.place = f"127.0.0.1:{self._server}"
        end = time.monotonic() + 30
        while not self._ask("query /root").startswith("Welcome"):
            if time.monotonic() > end:
                raise SystemExit(f"{server[0]} does not start")
            time.sleep(0.05)
        script = str(Path(__file__).with_name("yarp_board.py"))
        self._board = subprocess.Popen(
            [python, script, str(self._server), "/board/rpc:i"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
            env=environment,
            start_new_session=True,
        )
        self._processes.append(self._board)
        assert self._board.stdout is not None
        self._board.stdout.readline()
        found = self._ask("query /board/rpc:i").split()
        self._far = int(found[found.index("port") + 1])
        threading.Thread(target=self._talk, daemon=True).start()
        self.plug()

    def _ask(self, command: str) -> str:
        """Of the name server; "": there is none yet."""
        try:
            with socket.create_connection(("127.0.0.1", self._server), 5) as one:
                one.sendall(f"CONNECT ends\r\nd\r\n{command}\r\n".encode())
                data = b""
                while b"*** end of message" not in data and (more := one.recv(4096)):
                    data += more
                return data.decode()
        except ConnectionError:
            return ""

    def _talk(self) -> None:
        assert self._board.stdin is not None
        assert self._board.stdout is not None
        for line in self._board.stdout:
            told, text = self.motors.goal, answer(line.strip(), self.motors, modes=self.modes)
            if self.motors.goal is not told:
                self.goals.append(list(self.motors.goal))
            self._board.stdin.write(text + "\n")
            self._board.stdin.flush()

    # -- the cable ----------------------------------------------------------------------------------

    def plug(self) -> None:
        self.cut()
        self.silent, self._listening = False, socket.create_server(("127.0.0.1", 0))
        port = self._listening.getsockname()[1]
        self._ask(f"unregister {PORT_NAME}/rpc:i")
        self._ask(f"register {PORT_NAME}/rpc:i tcp 127.0.0.1 {port}")
        self._open: list[socket.socket] = []
        threading.Thread(target=self._accept, args=(self._listening, self._open), daemon=True).start()

    def _accept(self, listening: socket.socket, open_: list[socket.socket]) -> None:
        with contextlib.suppress(OSError):
            while True:
                near, far = listening.accept()[0], socket.create_connection(("127.0.0.1", self._far))
                for one in (near, far):
                    one.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                open_ += [near, far]
                threading.Thread(target=self._pass_on, args=(near, far), daemon=True).start()

    def _pass_on(self, near: socket.socket, far: socket.socket) -> None:
        with contextlib.suppress(OSError, ValueError):
            while True:
                for one in select.select([near, far], [], [])[0]:
                    data = one.recv(4096)
                    if not data:
                        raise ConnectionError
                    if self.silent:
                        continue
                    if one is near:
                        far.sendall(data)
                    else:
                        near.sendall(data if b"Welcome" in data else self.spoiler(data))
        for one in (near, far):
            one.close()

    def cut(self) -> None:
        if (listening := getattr(self, "_listening", None)) is not None:
            for one in (listening, *self._open):
                with contextlib.suppress(OSError):
                    one.shutdown(socket.SHUT_RDWR)
                one.close()

    def close(self) -> None:
        for one in self._processes:
            os.killpg(one.pid, signal.SIGKILL)  # yarpserver is started by a script
            one.wait()
        self._folder.cleanup()


class End:
    """A hand or motors on a bus, and what is said of them."""

    def __init__(self, kind: str, hand: str, python: str) -> None:
        per, zeros = UNITS[kind], ZEROS[kind]

        def bus(a: Any) -> list[float]:
            return [z + s * per * x for z, s, x in zip(zeros, SIGNS, a, strict=True)]

        def value(b: Any) -> list[float]:
            return [s * (x - z) / per for z, s, x in zip(zeros, SIGNS, b, strict=True)]

        self.hand: HandMotors | None = None
        self.motors: Any = None
        if hand == "hand":
            plant = simulated()
            plant.reset(0)
            self.motors = self.hand = HandMotors(plant, bus, value)
        else:
            self.motors = Motors(bus([START] * len(SIGNS)), float(hand) * per)
        self.spoiler = Spoiler(0.0, seed=1000)
        self.wire: Any
        if kind == "dynamixel":
            self.wire = Dynamixel(self.motors)
        elif kind == "ros2":
            names = SimulatedHand(HAND, OBJECT).hand.actuator_names
            self.wire = Ros2(self.motors, names, 0.002 if self.hand is None else 0.01)
        else:
            self.wire = Yarp(self.motors, python)

    def answer(self, line: str) -> Any:
        word, _, rest = line.partition(" ")
        if word in ("reset", "mark"):
            self.wire.catch_up()  # what was sent before is obeyed before
        if word == "reset" and self.hand is not None:
            self.hand.reset(int(rest))
        elif word == "goals":
            goals = list(self.wire.goals)
            del self.wire.goals[: len(goals)]
            return goals
        elif word == "spoil":
            self.spoiler.chance = float(rest)
            self.wire.spoil(self.spoiler)
        elif word == "fault":
            self.wire.fault = rest
        elif word == "pull":
            self.wire.pull(rest == "silent")
        elif word == "mark":
            return {"mark": int(rest)}
        elif word == "plug":
            self.wire.plug()
            return self.wire.place
        seen = {"motors": self.motors.now(), "moving": self.motors.moving, "spoilt": self.spoiler.count}
        if self.hand is None:
            seen["stands_at"] = self.motors.stands_at
        elif word == "pose":
            at = self.hand.seen
            seen |= {name: getattr(at, name).tolist() for name in ("q", "position", "rotation")}
            seen["lost"] = at.status is PlantStatus.LOST
        return seen


def main() -> None:
    sys.setswitchinterval(5e-4)  # the simulation must not keep the bus from answering
    kind, hand, *python = sys.argv[1:]
    end = End(kind, hand, python[0] if python else sys.executable)
    print("ready", end.wire.place, flush=True)
    try:
        for line in sys.stdin:
            print(json.dumps(end.answer(line.strip())), flush=True)
    finally:
        end.wire.close()
        os._exit(0)  # threads of rclpy may keep the process


if __name__ == "__main__":
    main()
