"""Buses with something behind them: which there are, the other end as a process, a wiring file for it."""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import torch

from torch_ekm.drivers import DynamixelPlant, HandDriver, Ros2Plant, Sighting, YarpPlant
from torch_ekm.simulation import SimulatedHand, preset

HAND, OBJECT = "planar_two_finger", "can"
DEG = math.pi / 180
SIGNS, START = (1, -1), 0.8  # START: where motors alone stand [rad]
UNITS = {"dynamixel": 4096 / (2 * math.pi), "ros2": 1.0, "yarp": 180 / math.pi}  # per rad
ZEROS = {"dynamixel": (900, 3100), "ros2": (0, 0), "yarp": (0, 0)}
PORT_NAME = "/hand"  # of the part, in YARP
SPEED = 30 * DEG  # of motors alone [rad/s]
_YARP_PYTHON = os.environ.get("TORCH_EKM_YARP_PYTHON", sys.executable)  # that has YARP's bindings


def simulated() -> SimulatedHand:
    """A used hand; noise and what is drawn at each motion are off, so that two runs can be compared."""
    still = {name: 0.0 for name in ("actuator_error", "joint_noise", "position_noise", "rotation_noise")}
    parameters = preset("nominal").replace(**still, force_noise=0.0, force_sensors=False)
    return SimulatedHand(HAND, OBJECT, parameters=parameters)


class Bus(NamedTuple):
    """A driver, and what its other end needs."""

    kind: str
    driver: Callable[..., HandDriver]
    needs: str
    end: str
    digits: Callable[[float], float] = float
    """Of a position on the bus."""
    python: str = sys.executable
    """That has the other end's package."""

    @property
    def installed(self) -> bool:
        if self.python == sys.executable:
            return find_spec(self.needs) is not None
        words = [self.python, "-c", f"import {self.needs}"]
        return subprocess.run(words, stderr=subprocess.DEVNULL, check=False).returncode == 0


BUSES = (
    Bus(
        "dynamixel",
        DynamixelPlant,
        "dynamixel_sdk",
        "emulated servos, genuine SDK",
        lambda x: float(round(x)),
    ),
    Bus("ros2", Ros2Plant, "rclpy", "a node of genuine rclpy"),
    Bus("yarp", YarpPlant, "yarp", "genuine yarpserver and rpc port", python=_YARP_PYTHON),
)


class End:
    """The other end, a process of its own with a hand or motors; lines in, lines out: ``buses/ends.py``."""

    def __init__(self, bus: Bus, hand: str) -> None:
        script = str(Path(__file__).with_name("ends.py"))
        command = [sys.executable, script, bus.kind, hand, bus.python]
        self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        self._lock = threading.Lock()
        self.place = self._line().split()[-1]

    def _line(self) -> str:
        assert self.process.stdout is not None
        return self.process.stdout.readline()

    def ask(self, word: str) -> Any:
        assert self.process.stdin is not None
        with self._lock:
            self.process.stdin.write(word + "\n")
            self.process.stdin.flush()
            return json.loads(self._line())

    def resume(self) -> None:
        """Ask again, after a process that shares this pipe was killed, perhaps before its answer came."""
        token = time.monotonic_ns()
        self._lock = threading.Lock()
        assert self.process.stdin is not None
        self.process.stdin.write(f"\nmark {token}\n")
        self.process.stdin.flush()
        while f'"mark": {token}' not in self._line():
            pass
        self.rest()

    def rest(self) -> dict[str, Any]:
        """What it says once nothing moves."""
        while (said := self.ask("pose"))["moving"]:
            time.sleep(0.005)
        return said

    def __call__(self) -> Sighting:
        """The object and the joints, as the hand's own camera sees them."""
        seen = self.ask("pose")
        q, position, rotation = (
            torch.tensor(seen[n], dtype=torch.float64) for n in ("q", "position", "rotation")
        )
        return Sighting(position, rotation, time.monotonic(), q)

    def lost(self, _: Sighting) -> bool:
        return self.ask("pose")["lost"]

    def close(self) -> None:
        assert self.process.stdin is not None
        self.process.stdin.close()
        self.process.wait()


def wiring(bus: Bus, folder: Path, place: str, **limits: float) -> Path:
    """A wiring file; ``limits`` beside those of a rate of 100 deg/s."""
    places = {
        "dynamixel": f'port = "{place}"\nbaud = 1000000\n',
        "ros2": 'command = "/hand/joint_trajectory"\n',
        "yarp": f'name_server = "{place}"\npart = "{PORT_NAME}"\n',
    }
    text = f'[hand]\ndriver = "{bus.kind}"\ndescription = "{HAND}"\n[bus]\n{places[bus.kind]}[limits]\n'
    text += "".join(
        f"{key} = {value}\n" for key, value in {"rate_deg": 100.0, "still_for": 0.05, **limits}.items()
    )
    for k, name in enumerate(SimulatedHand(HAND, OBJECT).hand.actuator_names):
        number = {"dynamixel": str(k + 1), "ros2": f'"{name}"', "yarp": str(k)}[bus.kind]
        text += f'[[motors]]\nname = "{name}"\nid = {number}\n'
        text += f"sign = {SIGNS[k]}\nzero = {ZEROS[bus.kind][k]}\n"
    path = folder / "hand.toml"
    path.write_text(text)
    return path


@contextmanager
def opened(bus: Bus, folder: Path, hand: str, **limits: float) -> Iterator[tuple[End, Path]]:
    end = End(bus, hand)
    try:
        yield end, wiring(bus, folder, end.place, **limits)
    finally:
        end.close()
