"""Tendons that break in simulated hands, and what torch_ekm.inspection.health says of the logs.

    python benchmarks/hand_health.py [--seeds 1000:1100] [--quick]

Each seed is another used hand (preset "nominal", MuJoCo). It turns its object by 8 deg to and fro until, at a
motion drawn from the seed, the tendon of a motor drawn from the seed breaks; five motions later the log
ends. Where the loop ends sooner, motions of 1.5 deg follow. Changes named before the break are false alarms.
"""

from __future__ import annotations

import argparse
import math
import sys
from typing import NamedTuple

import numpy as np
import torch

from torch_ekm.control import ClosedLoop, HandKnowledge, LookAndMoveController, PoseTarget
from torch_ekm.description import load_hand
from torch_ekm.exceptions import EKMError
from torch_ekm.inspection.health import hand_health
from torch_ekm.model import KinematicModel
from torch_ekm.plant import Observation, PlantWrapper, RecordingPlant, ServoInverse, Trajectory
from torch_ekm.simulation import SimulatedHand, preset

HANDS = {"icub_right": "box", "yale_t42": "cylinder_35mm"}
FIRST, LAST, AFTER = 15, 40, 5  # motions before the break, and after it
DEG = math.pi / 180


class OverError(Exception):
    """The last motion of the log was made."""


class Breaking(PlantWrapper):
    """Before command ``at`` the tendon of motor ``motor`` breaks; ``AFTER`` motions later it is over."""

    plant: SimulatedHand

    def __init__(self, plant: SimulatedHand, at: int, motor: int) -> None:
        super().__init__(plant)
        self.at, self.motor, self.count = at, motor, 0

    def command(self, delta_a: torch.Tensor) -> Observation:
        if self.count == self.at + AFTER:
            raise OverError
        if self.count == self.at:
            rig = self.plant._rig
            assert rig is not None
            rig.transmission.stiffness[self.motor] = 1e-9
        self.count += 1
        return self.plant.command(delta_a)


class Case(NamedTuple):
    """A log, and what happened in it."""

    log: Trajectory
    at: int
    motor: str


def case(hand: str, seed: int) -> Case | None:
    """None: no grasp was found."""
    draw = np.random.default_rng(seed)
    plant = SimulatedHand(
        hand, HANDS[hand], parameters=preset("nominal").replace(hardware_seed=seed), engine="mujoco"
    )
    motors = [i for i, one in enumerate(plant.hand.actuators) if not one.posture]
    breaking = Breaking(plant, int(draw.integers(FIRST, LAST)), int(draw.choice(motors)))
    recording = RecordingPlant(breaking)
    try:
        recording.reset(seed)
        model, known = KinematicModel(plant.hand, plant.object), HandKnowledge.of(plant.hand, adapts=False)
        for k in range(LAST):
            seen = recording.observe()
            loop = ClosedLoop(
                recording, LookAndMoveController(model, focus=plant.rotation_axis), knowledge=known
            )
            degrees = 8.0 if (k + 1) // 2 % 2 else -8.0
            if loop.run(PoseTarget.turned(seen.state, plant.rotation_axis, degrees=degrees)).steps == []:
                break
            if breaking.count >= breaking.at:
                break
    except EKMError:
        if breaking.count == 0:
            return None
    inverse = ServoInverse(recording, plant.hand, known.servo)
    free = torch.tensor([not one.posture for one in plant.hand.actuators])
    while len(recording.trajectory.commands) < breaking.at + AFTER:
        delta = 1.5 * DEG * torch.from_numpy(draw.standard_normal(plant.hand.n_a)) * free
        inverse.command(delta)
    return Case(recording.trajectory, breaking.at, plant.hand.actuator_names[breaking.motor])


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    options.add_argument("--seeds", default="1000:1100")
    options.add_argument("--quick", action="store_true", help="three seeds for development of the T42")
    given = options.parse_args()
    first, end = (0, 3) if given.quick else map(int, given.seeds.split(":"))
    print(
        f"|hand|tendons that broke|found within {AFTER} motions|right actuator|motions before|false alarms|"
    )
    print("|---|---|---|---|---|---|")
    for hand in ["yale_t42"] if given.quick else HANDS:
        description, cases, found, right, false, healthy = load_hand(hand), 0, 0, 0, 0, 0
        for seed in range(first, end):
            one = case(hand, seed)
            if one is None:
                print(f"{hand} {seed}: no grasp", file=sys.stderr, flush=True)
                continue
            changes = hand_health(description, [(0, one.log)])
            early = [change for change in changes if change.motion < one.at]
            late = [change for change in changes if change.motion >= one.at]
            cases, healthy, false = cases + 1, healthy + one.at, false + len(early)
            found, right = found + bool(late), right + (bool(late) and late[0].actuator == one.motor)
            said = "; ".join(f"{change.actuator} {change.motion}: {change.found}" for change in changes)
            text = f"{hand} {seed}: {one.motor} breaks at {one.at}: {said or 'not found'}"
            print(text, file=sys.stderr, flush=True)
        print(f"|{hand}|{cases}|{found}|{right}|{healthy}|{false}|", flush=True)


if __name__ == "__main__":
    main()
