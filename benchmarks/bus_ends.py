"""The other end of a bus, a process of its own: python bus_ends.py dynamixel|ros2 [motors].

Prints "ready PORT"; then answers lines: "reset SEED", "pose", "now". With "motors" there is no hand, but
motors that turn at 30 deg/s.
"""

from __future__ import annotations

import json
import math
import sys
import threading
from collections.abc import Callable, Sequence
from typing import Any

import torch
from drivers import HAND, OBJECT, SIGNS, TICKS, ZEROS, simulated

from torch_ekm.plant import Observation, Plant, PlantStatus
from torch_ekm.simulation import SimulatedHand
from torch_ekm.testing import DynamixelBus, Motors


class HandMotors:
    """The motors of a plant, such as a simulated hand, in the units of a bus.

    A goal is carried out by a thread of its own, as one command; while it runs, ``moving`` is True and the
    old positions are shown. A goal that comes meanwhile is carried out next.

    Args:
        plant: with a grasped object.
        bus: (a [rad]) -> positions of the motors.
        value: the inverse of it.
    """

    def __init__(
        self,
        plant: Plant,
        bus: Callable[[Sequence[float]], list[float]],
        value: Callable[[Sequence[float]], list[float]],
    ) -> None:
        self.plant, self._bus, self._value = plant, bus, value
        self.seen: Observation = plant.observe()
        """The newest reading of the plant."""
        self._next: list[float] | None = None
        self._lock = threading.Lock()
        self._worker: Any = None

    def now(self) -> list[float]:
        """What the encoders read."""
        return self._bus(self.seen.a.tolist())

    @property
    def moving(self) -> bool:
        """Whether a goal is being carried out."""
        return self._worker is not None

    def send(self, goal: Sequence[float]) -> None:
        """Off to other goals."""
        with self._lock:
            self._next = list(goal)
            if self._worker is None:
                self._worker = threading.Thread(target=self._work, daemon=True)
                self._worker.start()

    def stop(self) -> None:
        """Carry out nothing more."""
        with self._lock:
            self._next = None

    def _work(self) -> None:
        while True:
            with self._lock:
                goal, self._next = self._next, None
                if goal is None:
                    self._worker = None
                    return
            delta = torch.tensor(self._value(goal), dtype=torch.float64) - self.seen.a
            self.seen = self.plant.command(delta)


class End:
    def __init__(self, kind: str, alone: bool) -> None:
        per = TICKS if kind == "dynamixel" else 1.0
        zeros = ZEROS if kind == "dynamixel" else (0.0, 0.0)
        self.hand: HandMotors | None = None
        self.motors: Any = Motors(
            [z + s * per * 0.8 for z, s in zip(zeros, SIGNS, strict=True)], per * math.pi / 6
        )
        if not alone:
            plant = simulated()
            plant.reset(0)
            self.motors = self.hand = HandMotors(
                plant,
                lambda a: [z + s * per * x for z, s, x in zip(zeros, SIGNS, a, strict=True)],
                lambda b: [s * (x - z) / per for z, s, x in zip(zeros, SIGNS, b, strict=True)],
            )
        self.names = SimulatedHand(HAND, OBJECT).hand.actuator_names

    def answer(self, line: str) -> Any:
        if line.startswith("reset") and self.hand is not None:
            self.hand.seen = self.hand.plant.reset(int(line.split()[1]))
        if line == "now" or self.hand is None:
            return {"motors": self.motors.now(), "moving": self.motors.moving}
        seen = self.hand.seen
        known = {name: getattr(seen, name).tolist() for name in ("q", "position", "rotation")}
        return {**known, "lost": seen.status is PlantStatus.LOST}


def publish(end: End) -> None:
    """Joint states at 100 Hz, trajectories of one point: as ros2_control's controllers."""
    import rclpy
    from rclpy.executors import SingleThreadedExecutor
    from sensor_msgs.msg import JointState
    from trajectory_msgs.msg import JointTrajectory

    context = rclpy.Context()
    context.init(args=[])
    node = rclpy.create_node("hand", context=context)
    states = node.create_publisher(JointState, "/joint_states", 1)

    def follow(message: JointTrajectory) -> None:
        at = dict(zip(message.joint_names, message.points[0].positions, strict=True))
        end.motors.send([at[name] for name in end.names])

    def show() -> None:
        moving = end.motors.moving
        message = JointState(name=list(end.names), position=[float(x) for x in end.motors.now()])
        message.velocity = [1.0 if moving else 0.0] * len(end.names)
        message.header.stamp = node.get_clock().now().to_msg()
        states.publish(message)

    node.create_subscription(JointTrajectory, "/hand/joint_trajectory", follow, 10)
    node.create_timer(0.01, show)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    threading.Thread(target=executor.spin, daemon=True).start()


def main() -> None:
    sys.setswitchinterval(5e-4)  # the simulation must not keep the bus from answering
    end = End(sys.argv[1], "motors" in sys.argv)
    if sys.argv[1] == "ros2":
        publish(end)
        print("ready ros2", flush=True)
    else:
        bus = DynamixelBus([1, 2], end.motors)
        print("ready", bus.port, flush=True)
    for line in sys.stdin:
        print(json.dumps(end.answer(line.strip())), flush=True)


if __name__ == "__main__":
    main()
