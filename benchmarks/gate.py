"""The last gate under searched faults: what reaches the motors, and what is learned from readings it refuses.

    python benchmarks/gate.py --readings 100000

Turns of held objects on a light plant follow each other, with an E-KM and with a KM on a servo inverse; what
is known of the hand is kept from turn to turn. In each turn one sensor is spoilt in one way, from one moment
on: drawn at random, or a variation of the fault that has brought the largest command so far. In every fourth
session what is known of the hand is nonsense to begin with. No command may exceed ``Guards.increment``, none
may be anything but finite and within the range by the reading it starts from, and nothing may be learned from
a reading that the guards refuse.
"""

from __future__ import annotations

import argparse
import concurrent.futures
import functools
import itertools
import math
import os
import sys
import warnings
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from unittest.mock import patch

import numpy as np
import torch
from light_plant import Obedient

from torch_ekm.control import (
    ClosedLoop,
    Guards,
    HandKnowledge,
    LookAndMoveController,
    OneStep,
    PoseTarget,
    Safety,
)
from torch_ekm.control.guards import Effect, ReadingTests
from torch_ekm.enhanced import EnhancedModel
from torch_ekm.kinematics.se3 import exp
from torch_ekm.model import KinematicModel
from torch_ekm.plant import Observation, PlantStatus
from torch_ekm.simulation import SimulatedHand

DEG = math.pi / 180
GRASPS = (
    ("planar_two_finger", "cylinder_35mm"),  # two motors: twice as many readings in the same time
    ("icub_right", "box"),
    ("planar_two_finger", "cylinder_45mm"),
    ("icub_right", "can"),
)
SENSORS = ("a", "q", "pose", "fingertip_force", "all")
KINDS = ("offset", "scale", "drift", "frozen", "old", "unseen", "not finite", "lost")
_LARGEST = {"a": 2.0, "q": 2.0, "pose": 2.0, "fingertip_force": 20.0, "all": 2.0}  # [rad], [rad, .1 m], [N]
_BEYOND = 1e-9  # [rad]: rounding


@dataclass(frozen=True)
class Fault:
    """What one sensor reads wrongly, and when."""

    sensor: str
    kind: str
    place: int
    size: float
    command: int
    """Since how many commands."""
    look: int
    """Which look after a command is spoilt; 0: all."""
    lasts: int
    """Commands."""
    slips: bool
    """The object truly turns 9 deg off the focus before: further looks are taken."""

    @classmethod
    def drawn(cls, draw: np.random.Generator) -> Fault:
        sensor = str(draw.choice(SENSORS))
        size = float(draw.choice([-1, 1])) * math.exp(
            draw.uniform(math.log(0.02), math.log(_LARGEST[sensor]))
        )
        return cls(
            sensor, str(draw.choice(KINDS, p=(0.4, 0.1, 0.15, 0.1, 0.1, 0.05, 0.05, 0.05))),
            int(draw.integers(20)), size, int(draw.integers(6)), int(draw.integers(7)),
            int(draw.choice([1, 2, 4, 30])), bool(draw.random() < 0.4),
        )  # fmt: skip

    def varied(self, draw: np.random.Generator) -> Fault:
        """The same with another size, place or moment."""
        size = self.size * math.exp(draw.normal(0.0, 0.3))
        other = Fault.drawn(draw)
        names = draw.choice(["place", "command", "look", "lasts", "slips"], size=1)
        return replace(self, size=size, **{str(name): getattr(other, str(name)) for name in names})

    def __call__(self, plant: Obedient, seen: Observation) -> Observation:
        since = len(plant.given) - self.command
        if not 0 <= since < self.lasts or (self.look and plant.looks != self.look):
            return seen
        old = plant.last[max(len(plant.last) - 3, 0)] if plant.last else seen
        names = {"pose": ("position", "rotation"), "all": ("a", "q", "position", "rotation")}
        fields = names.get(self.sensor, (self.sensor,))
        match self.kind:
            case "lost":
                return replace(seen, status=PlantStatus.LOST)
            case "unseen":
                return replace(seen, status=PlantStatus.NOT_SEEN)
            case "not finite":
                seen = replace(seen, a=seen.a.clone())
                seen.a[self.place % len(seen.a)] = math.nan  # behind the back of the reading's own check
                return seen
            case "old":
                return replace(old, q=old.q.clone())
            case "frozen":
                return replace(seen, **{name: getattr(old, name).clone() for name in fields})
        size = self.size * (since + 1 if self.kind == "drift" else 1)
        return replace(seen, **{name: self._spoilt(getattr(seen, name), size) for name in fields})

    def _spoilt(self, value: torch.Tensor, size: float) -> torch.Tensor:
        if value.dim() == 2:
            return exp(size * torch.eye(3, dtype=value.dtype)[self.place % 3]) @ value
        at = torch.arange(len(value)) == self.place % len(value)
        if self.sensor == "all":
            at = torch.ones_like(at)
        if self.kind == "scale":
            return torch.where(at, value * size, value)
        return value + at * size * (0.1 if self.sensor == "pose" else 1.0)


@dataclass
class Count:
    """What came of all turns."""

    readings: int = 0
    commands: int = 0
    above: int = 0
    not_finite: int = 0
    learned: int = 0
    outside: int = 0
    """Set-points beyond the range, where the encoders read truly."""
    largest: float = 0.0
    reasons: Counter[str] = field(default_factory=Counter)

    def __add__(self, other: Count) -> Count:
        largest = max(self.largest, other.largest)
        sums = {name: value + getattr(other, name) for name, value in vars(self).items()}
        return Count(**sums | {"largest": largest})

    def __str__(self) -> str:
        return (
            f"readings {self.readings}, commands {self.commands}, above the increment {self.above}, "
            f"not finite {self.not_finite}, learned from refused readings {self.learned}"
        )


@contextmanager
def refusals() -> Iterator[dict[int, torch.Tensor]]:
    """Joint angles of the readings that a guard refuses, by identity; encoders may be the plant's own."""
    refused: dict[int, torch.Tensor] = {}

    def told(name: str, place: int):
        judge = getattr(ReadingTests, name)

        def judged(self, *args):
            doubt, seen = judge(self, *args), args[place]
            if doubt is not None and doubt.effect is Effect.STOP:
                refused[id(seen.q)] = seen.q  # kept, so that no other tensor gets this identity
            return doubt

        return patch.object(ReadingTests, name, judged)

    with told("at_rest", 0), told("after_motion", 2):
        yield refused


class WatchedLoop(ClosedLoop):
    """A loop that counts motions whose refused readings have changed what is known."""

    refused: dict[int, torch.Tensor]
    misled = 0

    def _move(self, seen, decision, *args, **options):
        before = self._known()
        step, halt = super()._move(seen, decision, *args, **options)
        taught = step.report is not None or any(map(differs, before, self._known()))
        if "the object has slid" in step.note:  # refused as a jump, and believed in the end
            self.refused.pop(id(step.after.q), None)
        self.misled += taught and not self.refused.keys().isdisjoint((id(seen.q), id(step.after.q)))
        return step, halt

    def _known(self) -> list[torch.Tensor]:
        return [value.clone() for value in self.knowledge.state_dict().values()]


def differs(one: torch.Tensor, other: torch.Tensor) -> bool:
    return not torch.equal(one.nan_to_num(), other.nan_to_num())


def nonsense(knowledge: HandKnowledge, draw: np.random.Generator) -> None:
    """What a damaged or a foreign file may hold."""
    servo, figures = knowledge.servo, knowledge.figures
    i = int(draw.integers(len(servo.names)))
    match int(draw.integers(6)):
        case 0:
            servo.estimate[i] = torch.tensor([0.0, draw.choice([-3.0, 0.4, 3.0])])
        case 1:
            servo.estimate[i, 0] = 1.0
        case 2:
            servo.estimate[i, 0], servo.covariance[i] = -0.1, 0.0
        case 3:
            knowledge.error.square.fill_(1e9)
        case 4:
            figures.mean.fill_(50.0)
        case 5:
            servo.estimate[i], servo.covariance[i] = 0.5, 1e-9 * torch.eye(2).double()


@functools.cache
def grasp(hand: str, item: str) -> tuple[Observation, torch.Tensor, KinematicModel]:
    plant = SimulatedHand(hand, item)
    seen = replace(plant.reset(seed=4), truth=None)
    plant.close()
    return seen, plant.rotation_axis, KinematicModel(plant.hand, plant.object)


class Sliding(Obedient):
    """The object truly turns 9 deg off the focus before the fault, where it says so."""

    off: torch.Tensor

    def command(self, delta_a: torch.Tensor) -> Observation:
        if self.fault.slips and len(self.given) + 1 == self.fault.command:
            self.state = self.state.plus(self.off)
        return super().command(delta_a)

    def leaves(self, a: torch.Tensor, v: torch.Tensor) -> bool:
        """Whether a set-point lies beyond the range, and farther out than the motor stands."""
        lower, upper = torch.minimum(self.range[0], a), torch.maximum(self.range[1], a)
        return bool((torch.maximum(lower - a - v, a + v - upper) > _BEYOND).any())


def session(held, seed: int, readings: int, learns: bool, count: Count, refused: dict) -> None:
    """Turns with one knowledge of the hand, until so many readings were passed on."""
    seen, axis, model = held
    draw, guards, passed = np.random.default_rng(seed), Guards(), 0
    knowledge = HandKnowledge.of(model.hand)
    if seed % 4 == 3:
        nonsense(knowledge, draw)
    worst, worst_command = Fault.drawn(draw), 0.0
    enhanced = EnhancedModel.for_grasp(model, seen.state) if learns else model
    while passed < readings:
        fault = worst.varied(draw) if draw.random() < 0.5 else Fault.drawn(draw)
        plant = Sliding(model, seen, fault, since=0, dead_zone=draw.choice([0.0, 1.3]) * DEG)
        other = torch.linalg.cross(axis, torch.eye(3, dtype=axis.dtype)[int(axis.abs().argmin())])
        plant.off = torch.cat([axis.new_zeros(model.hand.n_q + 3), 9 * DEG * other / other.norm()])
        known = {"knowledge": knowledge, "safety": Safety(guards=guards)}
        planner = OneStep() if seed % 4 else None  # an E-KM plans in every other session
        loop = WatchedLoop(plant, LookAndMoveController(enhanced, axis), **known, planner=planner)
        loop.refused = refused
        angle = float(draw.choice([-15.0, 12.0, 25.0]))
        try:
            reason = loop.run(PoseTarget.turned(seen.state, axis, degrees=angle)).reason.value
        except Exception as error:
            reason = type(error).__name__
        refused.clear()
        count.reasons[reason] += 1
        count.learned += loop.misled
        passed += len(plant.last)
        sizes = [float(v.abs().max()) for v in plant.given]
        largest = max((size for size in sizes if math.isfinite(size)), default=0.0)
        if largest > worst_command:
            worst, worst_command = fault, largest
        count.commands += len(sizes)
        count.above += sum(size > guards.increment + _BEYOND for size in sizes)
        count.not_finite += sum(not math.isfinite(size) for size in sizes)
        if fault.sensor not in ("a", "all") and fault.kind not in ("old", "not finite"):  # true encoders
            count.outside += sum(map(plant.leaves, plant.true, plant.given))
        count.largest = max(count.largest, largest)
    count.readings += passed


def part(seed: int, readings: int) -> Count:
    """One session, in a process of its own."""
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    count = Count()
    with refusals() as refused:
        held = grasp(*GRASPS[seed // 2 % len(GRASPS)])
        session(held, seed, readings, seed % 2 == 0, count, refused)
    return count


def search(readings: int, each: int = 500, seed: int = 1000) -> Count:
    """Sessions of ``each`` readings until there were so many; E-KM and KM+S in turn."""
    seeds, count = range(seed, seed + -(-readings // each)), Count()
    with concurrent.futures.ProcessPoolExecutor(min(os.cpu_count() or 1, len(seeds))) as pool:
        for one in pool.map(part, seeds, itertools.repeat(each)):
            count = count + one
            print(count, file=sys.stderr, flush=True)
    return count


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    arguments.add_argument("--readings", type=int, default=100_000)
    options = arguments.parse_args()
    count = search(options.readings)
    print(f"turns ended {', '.join(f'{n} {reason}' for reason, n in count.reasons.most_common())}")
    print(f"largest command {count.largest / DEG:.2f} deg, set-points beyond the range {count.outside}")
    print(count)


if __name__ == "__main__":
    main()
