"""Drivers against the genuine other ends that are installed: python benchmarks/drivers.py [--turns N].

The same simulated hand is turned in process and behind each bus. Last line: turns that agree within 0.05 deg
and have the same reason, wrong wirings refused, kills after which the hand stood within 100 ms.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import torch

from torch_ekm.control import ClosedLoop, LookAndMoveController, Manipulation, PoseTarget
from torch_ekm.description import HandDescription, load_object
from torch_ekm.drivers import Channel, DynamixelPlant, HandDriver, Ros2Plant, Sighting, WithPose
from torch_ekm.enhanced import EnhancedModel
from torch_ekm.model import KinematicModel
from torch_ekm.plant import Observation, Plant, PlantWrapper
from torch_ekm.simulation import SimulatedHand, preset

HAND, OBJECT, DEGREES = "planar_two_finger", "can", 8.0
TICKS = 4096 / (2 * math.pi)
DEG = math.pi / 180
ZEROS, SIGNS = (900, 3100), (1, -1)


def simulated() -> SimulatedHand:
    """A used hand; noise and what is drawn at each motion are off, so that two runs can be compared."""
    still = {name: 0.0 for name in ("actuator_error", "joint_noise", "position_noise", "rotation_noise")}
    parameters = preset("nominal").replace(**still, force_noise=0.0, force_sensors=False)
    return SimulatedHand(HAND, OBJECT, parameters=parameters)


class Rounded(PlantWrapper):
    """In process, with the encoders' and the commands' resolution of the bus."""

    def __init__(self, plant: Plant, channels: list[Channel], digits: Callable[[float], float]) -> None:
        super().__init__(plant)
        self.channels, self.digits = channels, digits

    def _round(self, a: torch.Tensor) -> torch.Tensor:
        pairs = zip(self.channels, a.tolist(), strict=True)
        return torch.tensor([c.value(self.digits(c.bus(x))) for c, x in pairs], dtype=torch.float64)

    def observation(self, seen: Observation) -> Observation:
        return Observation(
            seen.q, self._round(seen.a), seen.position, seen.rotation, time=seen.time, status=seen.status
        )

    def command(self, delta_a: torch.Tensor) -> Observation:
        here = self.plant.observe().a
        goal = torch.minimum(
            torch.maximum(self._round(here) + delta_a, self._edge("lower")), self._edge("upper")
        )
        return self.observation(self.plant.command(self._round(goal) - here))

    def _edge(self, name: str) -> torch.Tensor:
        return torch.tensor([getattr(one, name) for one in self.channels], dtype=torch.float64)


def turn(plant: Plant, hand: HandDescription, seen: Observation, degrees: float) -> Manipulation:
    axis = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    ekm = EnhancedModel.for_grasp(KinematicModel(hand, load_object(OBJECT)), seen.state)
    loop = ClosedLoop(plant, LookAndMoveController(ekm, focus=axis))
    return loop.run(PoseTarget.turned(seen.state, axis, degrees=degrees))


class Bus(NamedTuple):
    """A driver, and what its other end is called."""

    kind: str
    driver: Callable[..., HandDriver]
    needs: str
    per_rad: float
    digits: Callable[[float], float]


BUSES = (
    Bus("dynamixel", DynamixelPlant, "dynamixel_sdk", TICKS, lambda x: float(round(x))),
    Bus("ros2", Ros2Plant, "rclpy", 1.0, float),
)


class End:
    """The other end, a process of its own with the hand; lines in, lines out."""

    def __init__(self, kind: str, *arguments: str) -> None:
        command = [sys.executable, str(Path(__file__).with_name("bus_ends.py")), kind, *arguments]
        self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        self.port = self._line().split()[-1]

    def _line(self) -> str:
        assert self.process.stdout is not None
        return self.process.stdout.readline()

    def ask(self, word: str) -> Any:
        assert self.process.stdin is not None
        self.process.stdin.write(word + "\n")
        self.process.stdin.flush()
        return json.loads(self._line())

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
        self.process.kill()
        self.process.wait()


def wiring(bus: Bus, folder: Path, port: str, hand: HandDescription, rate: float = 100.0) -> Path:
    place = (
        f'port = "{port}"\nbaud = 1000000\n'
        if bus.kind == "dynamixel"
        else 'command = "/hand/joint_trajectory"\n'
    )
    text = f'[hand]\ndriver = "{bus.kind}"\ndescription = "{HAND}"\n[bus]\n{place}'
    text += f"[limits]\nrate_deg = {rate}\nstill_for = 0.05\n"
    for k, name in enumerate(hand.actuator_names):
        number, zero = (str(k + 1), ZEROS[k]) if bus.kind == "dynamixel" else (f'"{name}"', 0)
        text += f'[[motors]]\nname = "{name}"\nid = {number}\nsign = {SIGNS[k]}\nzero = {zero}\n'
    path = folder / "hand.toml"
    path.write_text(text)
    return path


@contextmanager
def opened(bus: Bus, folder: Path, *arguments: str, rate: float = 100.0) -> Iterator[tuple[End, Path]]:
    end = End(bus.kind, *arguments)
    try:
        yield end, wiring(bus, folder, end.port, SimulatedHand(HAND, OBJECT).hand, rate)
    finally:
        end.close()


def turns(bus: Bus, folder: Path, n: int) -> tuple[int, float]:
    """How many agree, and the largest time that the driver adds to a motion [ms]."""
    agree, inner = 0, simulated()
    with opened(bus, folder) as (end, path), bus.driver(path) as driver:
        plant = WithPose(driver, end, lost=end.lost)
        for seed in range(1000, 1000 + n):
            degrees = DEGREES if seed % 2 else -DEGREES
            first = inner.reset(seed)
            here = Rounded(inner, list(driver.wiring.motors), bus.digits)
            one = turn(here, driver.hand, here.observation(first), degrees)
            end.ask(f"reset {seed}")
            other = turn(plant, driver.hand, plant.reset(seed), degrees)
            off = (
                float(torch.linalg.vector_norm(one.stop.final.state.minus(other.stop.final.state)[-3:])) / DEG
            )
            same = off <= 0.05 and one.reason is other.reason
            agree += same
            print(
                f"{bus.kind} {seed}: {one.reason.value}, {other.reason.value}, {len(one.steps)} and "
                f"{len(other.steps)} motions, {off:.4f} deg apart{'' if same else '  <--'}",
                flush=True,
            )
        began = time.monotonic()
        for _ in range(200):
            driver._read()
        reading = 1e3 * (time.monotonic() - began) / 200
    return agree, reading


_MOVES = """
import sys, torch
from torch_ekm.drivers import open_driver
plant = open_driver(sys.argv[1])
print("moving", flush=True)
while True:
    for sign in (1.0, -1.0):
        plant.command(sign * torch.full((plant.hand.n_a,), 0.3, dtype=torch.float64))
"""


def kills(bus: Bus, folder: Path, n: int) -> int:
    """How often the motors stood 100 ms after the driver's process was killed in a motion."""
    stood = 0
    with opened(bus, folder, "motors", rate=30.0) as (end, path):
        for k in range(n):
            child = subprocess.Popen(
                [sys.executable, "-c", _MOVES, str(path)], stdout=subprocess.PIPE, text=True
            )
            assert child.stdout is not None
            child.stdout.readline()
            while not end.ask("now")["moving"]:
                time.sleep(0.002)
            time.sleep(0.02 + 0.013 * (k % 20))
            os.kill(child.pid, signal.SIGKILL)
            time.sleep(0.1)
            stands = end.ask("now")["motors"]
            time.sleep(0.15)
            stood += end.ask("now")["motors"] == stands
            child.wait()
    return stood


def wrong_wirings() -> tuple[int, int]:
    """Of the tests that hold it: each wiring once."""
    test = Path(__file__).parents[1] / "tests" / "inspection" / "test_inspection_check_plant.py"
    chosen = "is_refused_with_the_line or dead_joint or undated or another_frame"
    command = [sys.executable, "-m", "pytest", "-q", "-k", chosen, "-o", "addopts=", "--no-header", str(test)]
    said = subprocess.run(command, capture_output=True, text=True, check=False, cwd=test.parents[2]).stdout
    found = re.search(r"(\d+) passed", said)
    return int(found[1]) if found else 0, 12


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--turns", type=int, default=20)
    options.add_argument("--kills", type=int, default=50)
    given = options.parse_args()
    parts, killed, of = [], 0, 0
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    with tempfile.TemporaryDirectory() as folder:
        for bus in BUSES:
            if find_spec(bus.needs) is None:
                parts.append(f"{bus.kind} not installed")
                continue
            agree, reading = turns(bus, Path(folder), given.turns)
            print(f"{bus.kind}: a reading of the bus takes {reading:.2f} ms", flush=True)
            parts.append(f"{bus.kind} {agree}/{given.turns}")
            killed, of = killed + kills(bus, Path(folder), given.kills), of + given.kills
    refused, wirings = wrong_wirings()
    print(f"{', '.join(parts)}, wrong wirings {refused}/{wirings}, kills {killed}/{of}")


if __name__ == "__main__":
    main()
