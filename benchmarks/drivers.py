"""Drivers against the genuine other ends that are installed: python benchmarks/drivers.py.

The same simulated hand is turned in process and behind each bus; then motors alone are sent spoilt messages,
lose their cable, and their driver's process is killed. TORCH_EKM_YARP_PYTHON names another Python that has
YARP's bindings. Last line: turns that agree within 0.05 deg and have the same reason, wrong wirings refused,
kills after which the motors stood within 100 ms.
"""

from __future__ import annotations

import argparse
import math
import os
import random
import re
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).parent / "buses"))

from far_end import BUSES, OBJECT, SPEED, UNITS, Bus, opened, simulated, wiring
from no_bus import FakeDriver

from torch_ekm.control import ClosedLoop, LookAndMoveController, Manipulation, PoseTarget, StopReason
from torch_ekm.description import HandDescription, load_object
from torch_ekm.drivers import Channel, HandDriver, WithPose, dynamixel_port, yarp
from torch_ekm.drivers import driver as driving
from torch_ekm.enhanced import EnhancedModel
from torch_ekm.exceptions import DeviceError
from torch_ekm.experiments.jobs import run_jobs
from torch_ekm.model import KinematicModel
from torch_ekm.plant import Observation, Plant, PlantWrapper
from torch_ekm.plant import Path as Waypoints

DEGREES = 8.0
DEG = math.pi / 180


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

    def _followed(self, path: Waypoints, watch: Callable[[Observation], bool]) -> Observation:
        """Each waypoint as a command, as the hand behind the bus does."""
        start = seen = self.observation(self.plant.observe())
        for waypoint in path.waypoints:
            seen = self.command(start.a + waypoint - seen.a)
        return seen

    def _edge(self, name: str) -> torch.Tensor:
        return torch.tensor([getattr(one, name) for one in self.channels], dtype=torch.float64)


def turn(plant: Plant, hand: HandDescription, seen: Observation, degrees: float) -> Manipulation:
    axis = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    ekm = EnhancedModel.for_grasp(KinematicModel(hand, load_object(OBJECT)), seen.state)
    loop = ClosedLoop(plant, LookAndMoveController(ekm, focus=axis))
    return loop.run(PoseTarget.turned(seen.state, axis, degrees=degrees))


def turns(bus: Bus, folder: Path, n: int) -> tuple[int, float]:
    """How many agree, and by how much those that agree differ at most [deg]."""
    agree, most, inner = 0, 0.0, simulated()
    with (
        patch.object(driving, "_REACH", 60.0),  # [s]: each waypoint is one goal
        opened(bus, folder, "hand") as (end, path),
        bus.driver(path) as driver,
    ):
        plant = WithPose(driver, end, lost=end.lost)
        for seed in range(1000, 1000 + n):
            degrees = DEGREES if seed % 2 else -DEGREES
            first = inner.reset(seed)
            here = Rounded(inner, list(driver.wiring.motors), bus.digits)
            one = turn(here, driver.hand, here.observation(first), degrees)
            end.ask(f"reset {seed}")
            other = turn(plant, driver.hand, plant.reset(seed), degrees)
            apart = one.stop.final.state.minus(other.stop.final.state)[-3:]
            off = float(torch.linalg.vector_norm(apart)) / DEG
            same = off <= 0.05 and one.reason is other.reason
            agree, most = agree + same, max(most, off) if same else most
            tell(
                f"{bus.kind} {seed}: {one.reason.value}, {other.reason.value}, {len(one.steps)} and "
                f"{len(other.steps)} motions, {off:.4f} deg apart"
                f"{'' if same else '  <-- ' + other.stop.message}"
            )
    return agree, most


def spoilt(bus: Bus, folder: Path, n: int) -> tuple[int, int, int, int]:
    """Spoilt messages, motions, typed errors, and commands beyond the limits.

    How many of the messages are spoilt is drawn before each motion, 0.3 to 60 %.
    """
    draw, motions, errors, beyond, count = random.Random(1000), 0, 0, 0, 0
    with (
        patch.object(dynamixel_port, "_PATIENCE_MS", 50.0),  # what is cut is waited for
        patch.object(yarp, "_TIMEOUT", 0.05),
        opened(bus, folder, str(SPEED), rate_deg=30.0, timeout=0.5) as (end, path),
        bus.driver(path) as driver,
    ):
        channels = driver.wiring.motors
        # where the motors are is known to within the motion that counts as rest, and a tick of the bus
        slack = driver.limits.still + (1.5 / UNITS["dynamixel"] if bus.kind == "dynamixel" else 1e-6)
        end.ask("goals")
        while count < n:
            at = [one.value(x) for one, x in zip(channels, end.rest()["motors"], strict=True)]
            delta = torch.tensor([draw.uniform(-0.03, 0.03) for _ in channels], dtype=torch.float64)
            end.ask(f"spoil {10 ** draw.uniform(-2.5, -0.2):.4f}")
            try:
                driver.command(delta)
                motions += 1
            except DeviceError:
                errors += 1
            for goal in end.ask("goals"):
                a = [one.value(x) for one, x in zip(channels, goal, strict=True)]
                beyond += not all(
                    abs(x - here) <= 0.03 + slack and one.lower - slack <= x <= one.upper + slack
                    for x, here, one in zip(a, at, channels, strict=True)
                )
            count = end.ask("now")["spoilt"]
        end.ask("spoil 0")
    return count, motions, errors, beyond


class Pulled(PlantWrapper):
    """The cable is pulled so many seconds after the begin of a motion."""

    def __init__(self, plant: Plant, pull: Callable[[], object], motion: int, after: float) -> None:
        super().__init__(plant)
        self._pull, self._left, self._after = pull, motion, after

    def command(self, delta_a: torch.Tensor) -> Observation:
        if self._left == 0:
            threading.Timer(self._after, self._pull).start()
        self._left -= 1
        return super().command(delta_a)


def pulls(bus: Bus, folder: Path, n: int) -> int:
    """After how many the turn ends with a typed error as its cause, and the object is held."""
    typed, draw = 0, random.Random(1000)
    with opened(bus, folder, "hand") as (end, path):
        for seed in range(1000, 1000 + n):
            end.ask(f"reset {seed}")
            way = ("closed", "silent")[seed % 2]
            with bus.driver(path) as driver:
                pull = partial(end.ask, f"pull {way}")
                pulled = Pulled(driver, pull, motion=draw.randrange(3), after=draw.uniform(0, 0.1))
                plant = WithPose(pulled, end, lost=end.lost)
                stop = turn(plant, driver.hand, plant.reset(seed), DEGREES).stop
            good = stop.reason is StopReason.PLANT_FAILED and isinstance(stop.cause, DeviceError)
            good = good and not end.rest()["lost"]
            typed += good
            tell(f"{bus.kind} {seed}, {way}: {stop.reason.value}: {stop.message}{'' if good else '  <--'}")
            path = wiring(bus, folder, end.ask("plug"))
    return typed


def added(bus: Bus, folder: Path, n: int) -> tuple[float, float]:
    """What a motion of 3 deg takes beyond its distance and the time it must be at rest: median, 90 % [ms]."""
    with opened(bus, folder, str(SPEED), rate_deg=30.0) as (_, path), bus.driver(path) as driver:
        return beyond_way(driver, n)


def alone(bus: Bus, folder: Path, n: int) -> tuple[float, float]:
    """The same of a driver without a bus."""
    path = wiring(BUSES[0], folder, "none", rate_deg=30.0)
    return beyond_way(bus.driver(path, speed=600 * SPEED), n)


def beyond_way(driver: HandDriver, n: int) -> tuple[float, float]:
    took, way = [], 3 * DEG
    for k in range(n):
        delta = torch.full((driver.hand.n_a,), way if k % 2 else -way, dtype=torch.float64)
        began = time.monotonic()
        driver.command(delta)
        took.append(1e3 * (time.monotonic() - began - way / SPEED - driver.limits.still_for))
    return float(np.median(took)), float(np.quantile(took, 0.9))


_MOVES = """
import importlib, os, signal, sys, torch
from torch_ekm.drivers import open_driver
torch.set_num_threads(1)
for name in sys.argv[2:]:
    importlib.import_module(name)
signal.signal(signal.SIGCHLD, signal.SIG_IGN)
print("ready", flush=True)
for _ in sys.stdin:
    child = os.fork()
    if child:
        print(child, flush=True)
        continue
    plant = open_driver(sys.argv[1])
    while True:
        for sign in (1.0, -1.0):
            plant.command(sign * torch.full((plant.hand.n_a,), 0.3, dtype=torch.float64))
"""


def kills(bus: Bus, folder: Path, n: int) -> tuple[int, float]:
    """How often the motors stood 100 ms after the driver's process was killed, and the longest [ms]."""
    stood, longest = 0, 0.0
    imported = [bus.needs] if bus.python == sys.executable and bus.kind != "yarp" else []
    with opened(bus, folder, str(SPEED), rate_deg=30.0) as (end, path):
        words = [sys.executable, "-c", _MOVES, str(path), *imported]
        parent = subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        assert parent.stdin is not None
        assert parent.stdout is not None
        parent.stdout.readline()
        for k in range(n):
            parent.stdin.write("\n")
            parent.stdin.flush()
            child = int(parent.stdout.readline())
            while not end.ask("now")["moving"]:
                time.sleep(0.002)
            time.sleep(0.02 + 0.013 * (k % 20))
            killed = time.monotonic()
            os.kill(child, signal.SIGKILL)
            time.sleep(0.4)
            said = end.ask("now")
            late = 1e3 * (said["stands_at"] - killed)
            stood, longest = stood + (late <= 100 and not said["moving"]), max(longest, late)
        parent.kill()
        parent.communicate()
    return stood, longest


def wrong_wirings() -> tuple[int, int]:
    """Of the tests that hold it: each wiring once."""
    test = Path(__file__).parents[1] / "tests" / "inspection" / "test_inspection_check_plant.py"
    chosen = "is_refused_with_the_line or dead_joint or undated or another_frame"
    command = [sys.executable, "-m", "pytest", "-q", "-k", chosen, "-o", "addopts=", "--no-header", str(test)]
    said = subprocess.run(command, capture_output=True, text=True, check=False, cwd=test.parents[2]).stdout
    passed, failed = (
        sum(map(int, re.findall(rf"(\d+) (?:{how})", said))) for how in ("passed", "failed|error")
    )
    return passed, passed + failed


def kept(out: Path, folder: Path, bus: Bus, measure: Callable[..., Any], n: int) -> Any:
    """What ``measure(bus, folder, n)`` gives, from ``out`` if it is there."""
    name = f"{bus.kind}_{measure.__name__}_{n}"
    found = run_jobs(measure, {name: (bus, folder, n)}, out)[name]
    tell(f"{bus.kind} {measure.__name__}: {found}")
    return found


def tell(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    options.add_argument("--quick", action="store_true", help="a fiftieth of it: to see that it works")
    options.add_argument("--out", type=Path, default=Path("drivers_output"), help="keeps what is finished")
    given = options.parse_args()
    n_turns, n_spoilt, n = (1, 200, 2) if given.quick else (20, 10_000, 50)
    rows, parts, killed, of = [], [], 0, 0
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for bus in BUSES:
            if not bus.installed:
                parts.append(f"{bus.kind} not installed")
                continue
            done = partial(kept, given.out, folder, bus)
            median, tenth = done(added, n)
            stood, longest = done(kills, n)
            count, motions, errors, beyond = done(spoilt, n_spoilt)
            pulled, (agree, most) = done(pulls, n), done(turns, n_turns)
            rows.append(
                f"|{bus.kind}: {bus.end}|{agree}/{n_turns}, {most:.4f} deg"
                f"|{count}: {motions} motions, {errors} typed errors|{beyond}"
                f"|{stood}/{n}, {longest:.0f} ms|{pulled}/{n}|{median:.1f}, {tenth:.1f}|"
            )
            parts.append(f"{bus.kind} {agree}/{n_turns}")
            killed, of = killed + stood, of + n
        nothing = Bus("none", FakeDriver, "torch", "motors of the same process")
        median, tenth = kept(given.out, folder, nothing, alone, n)
        rows.append(f"|{nothing.kind}: {nothing.end}||||||{median:.1f}, {tenth:.1f}|")
    print(
        "|bus|turns as in process, at most apart|corrupted messages|commands beyond limits"
        "|process killed: stood within 100 ms, longest|cable pulled: typed stop, object held"
        "|added to a motion, median and 90 % [ms]|"
    )
    print("|---|---|---|---|---|---|---|")
    print(*rows, "", sep="\n")
    refused, wirings = wrong_wirings()
    print(f"{', '.join(parts)}, wrong wirings {refused}/{wirings}, kills {killed}/{of}")


if __name__ == "__main__":
    main()
