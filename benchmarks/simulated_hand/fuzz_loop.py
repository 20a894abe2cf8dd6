"""Spoilt observations through the closed loop: commands out of limits, and what the learner is worth after.

    python benchmarks/simulated_hand/fuzz_loop.py --observations 10000

A session is one hardware instance with one learner. Turns of a box, whose readings `FuzzedPlant` spoils,
follow each other until the session has had its observations; where a guard ends a turn, the fault is repaired
and the turn goes on. The error that counts is that of clean turns afterwards, one step ahead, by the
simulation's truth, without learning; its reference is that of the same turns after the same turns unfaulted.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections import Counter
from dataclasses import dataclass, field

import torch
from fuzzed_plant import FuzzedPlant
from joblib import Parallel, delayed

from torch_ekm.control import (
    ClosedLoop,
    Guards,
    HandKnowledge,
    LookAndMoveController,
    PoseTarget,
    StopReason,
)
from torch_ekm.enhanced import EnhancedModel
from torch_ekm.exceptions import EKMError, GraspError
from torch_ekm.model import KinematicModel
from torch_ekm.plant import Observation, PlantStatus, PlantWrapper
from torch_ekm.simulation import PlantConfig, SimulatedHand, preset

DEG = math.pi / 180
ALLOWED = Guards().increment + 1e-9  # [rad] of a motor, rounding included
REPAIRS = 8  # of one turn
CLEAN = (701, 702, 703)  # grasps of the clean turns


class Checked(PlantWrapper):
    """Looks at what reaches the motors, with the true encoders."""

    def __init__(self, plant: SimulatedHand) -> None:
        super().__init__(plant)
        self.largest, self.beyond, self.force, self.commands = 0.0, 0.0, 0.0, 0
        self._a: torch.Tensor | None = None

    def command(self, delta_a: torch.Tensor) -> Observation:
        assert self._a is not None
        hand, goal = self.plant.hand, (self._a + delta_a).numpy()
        self.commands += 1
        self.largest = max(self.largest, float(delta_a.abs().max()))
        over = max(float((goal - hand.actuator_upper).max()), float((hand.actuator_lower - goal).max()))
        self.beyond = max(self.beyond, over)
        return super().command(delta_a)

    def observation(self, seen: Observation) -> Observation:
        self._a = seen.a
        if seen.truth is not None and seen.truth.fingertip_force is not None:
            self.force = max(self.force, float(seen.truth.fingertip_force.max()))
        return seen


@dataclass
class Session:
    """What came of one hardware instance."""

    seed: int
    observations: int = 0
    faults: Counter[str] = field(default_factory=Counter)
    reasons: Counter[str] = field(default_factory=Counter)
    commands: int = 0
    largest: float = 0.0
    """Command to a motor [rad]."""
    beyond: float = 0.0
    """Farthest set-point outside the actuators' range [rad]."""
    force: float = 0.0
    """Largest true normal force [N]."""
    dropped: int = 0
    """Turns after which the object was truly out of the hand."""
    dropped_unfaulted: int = 0
    """The same without faults, on the same grasps."""
    error: float = math.nan
    """Of the clean turns [deg], rms over motions."""
    unfaulted: float = math.nan
    """[deg]"""


def error_of_clean_turns(
    plant: SimulatedHand, ekm: EnhancedModel, knowledge: HandKnowledge, grasps: tuple[int, ...] = CLEAN
) -> float:
    """Rotation that f + g did not predict, by the truth, rms over the motions [deg]."""
    squares = []
    for grasp in grasps:
        seen = plant.reset(grasp)
        ekm.model = KinematicModel(plant.hand, plant.object)
        controller = LookAndMoveController(ekm, plant.rotation_axis)
        loop = ClosedLoop(plant, controller, knowledge=knowledge, learn=False)
        for step in loop.run(PoseTarget.turned(seen.state, plant.rotation_axis, degrees=18)).steps:
            true = step.after.truth.state.minus(step.before.truth.state)
            off = controller.expect(step.decision.pieces, step.pull).increment - true
            squares.append(float(off[-3:].square().sum()))
    return math.sqrt(sum(squares) / len(squares)) / DEG


def turn(
    plant, sight, ekm: EnhancedModel, knowledge: HandKnowledge, grasp: int, session: Session | None
) -> bool:
    """One turn, gone on with after each repair; whether the object was dropped."""
    try:
        seen = plant.reset(grasp)
    except GraspError:
        return False
    ekm.model = KinematicModel(plant.hand, plant.object)
    target = PoseTarget.turned(seen.state, plant.rotation_axis, degrees=(18, 12)[grasp % 2])
    controller = LookAndMoveController(ekm, plant.rotation_axis)
    for _ in range(REPAIRS):
        try:
            done = ClosedLoop(sight, controller, knowledge=knowledge).run(target)
        except EKMError as error:
            reason = type(error).__name__
        else:
            reason = done.reason.value
        if session is not None:
            sight.repair()
            session.reasons[reason] += 1
        if reason in (StopReason.REACHED.value, StopReason.OBJECT_LOST.value, StopReason.GIVEN_UP.value):
            break
    return plant.observe().status is PlantStatus.LOST


def fuzz(seed: int, observations: int, chance: float = 0.15, clean: tuple[int, ...] = CLEAN) -> Session:
    """One session; without ``clean`` turns nothing is compared."""
    torch.set_num_threads(1)
    parameters = preset("nominal").replace(hardware_seed=seed)
    plant = Checked(SimulatedHand("icub_right", "box", PlantConfig(time_step=2e-3), parameters))
    sight, session, turns = FuzzedPlant(plant, chance, seed=seed), Session(seed), 0
    first = plant.reset(0)
    model = KinematicModel(plant.hand, plant.object)
    ekm, untaught = (EnhancedModel.for_grasp(model, first.state) for _ in range(2))
    knowledge, unfaulted = (HandKnowledge.of(plant.hand) for _ in range(2))
    while sight.observations < observations:
        session.dropped += turn(plant, sight, ekm, knowledge, 1000 * seed + turns, session)
        turns += 1
    session.observations, session.faults = sight.observations, sight.faults
    session.commands, session.largest, session.beyond = plant.commands, plant.largest, plant.beyond
    session.force = plant.force
    if not clean:
        return session
    for k in range(turns):
        session.dropped_unfaulted += turn(plant, plant, untaught, unfaulted, 1000 * seed + k, None)
    session.error = error_of_clean_turns(plant.plant, ekm, knowledge, clean)
    session.unfaulted = error_of_clean_turns(plant.plant, untaught, unfaulted, clean)
    return session


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    arguments.add_argument("--observations", type=int, default=10_000)
    arguments.add_argument("--each", type=int, default=250, help="observations of a session")
    arguments.add_argument("--compare", type=int, default=1, help="clean turns after each so many sessions")
    arguments.add_argument("--seed", type=int, default=1000, help="of the first session")
    arguments.add_argument("--jobs", type=int, default=-1, help="processes; -1: one for each core")
    options = arguments.parse_args()
    first, n = options.seed, math.ceil(options.observations / options.each)
    grasps = [() if k % options.compare else CLEAN for k in range(n)]
    call, run = delayed(fuzz), Parallel(options.jobs, return_as="generator")
    sessions: list[Session] = []
    for s in run(call(first + k, options.each, clean=clean) for k, clean in enumerate(grasps)):
        sessions.append(s)
        print(
            f"seed {s.seed}: {s.observations} observations, {s.commands} commands up to "
            f"{s.largest / DEG:.1f} of {ALLOWED / DEG:.1f} deg, {s.beyond / DEG:.1f} deg beyond the range, "
            f"{s.force:.1f} N; clean turn {s.error:.3f} deg, unfaulted {s.unfaulted:.3f} deg",
            file=sys.stderr,
        )
    total = Counter[str]()
    for s in sessions:
        total += s.reasons
    faults = sum((s.faults for s in sessions), Counter[str]())
    compared = [s for s in sessions if math.isfinite(s.error)]
    error, unfaulted = (
        math.sqrt(sum(getattr(s, name) ** 2 for s in compared) / len(compared))
        for name in ("error", "unfaulted")
    )
    spoilt = ", ".join(f"{n} {kind}" for kind, n in faults.most_common())
    print(f"{sum(s.observations for s in sessions)} observations, {sum(faults.values())} spoilt: {spoilt}")
    print(f"turns ended {', '.join(f'{n} {reason}' for reason, n in total.most_common())}")
    dropped, else_dropped = (sum(getattr(s, k) for s in sessions) for k in ("dropped", "dropped_unfaulted"))
    print(f"objects out of the hand: {dropped}; in the same turns without faults: {else_dropped}")
    commands, largest = sum(s.commands for s in sessions), max(s.largest for s in sessions) / DEG
    above = sum(s.largest > ALLOWED for s in sessions)
    print(f"{commands} commands up to {largest:.1f} deg; sessions with one above what is allowed: {above}")
    print(f"allowed: {ALLOWED / DEG:.1f} deg")
    print(f"farthest set-point out of an actuator's range: {max(s.beyond for s in sessions) / DEG:.1f} deg")
    print(f"largest normal force: {max(s.force for s in sessions):.1f} N")
    print(f"one-step error of clean turns afterwards: {error:.3f} deg; had there been no faults: ", end="")
    print(f"{unfaulted:.3f} deg, ratio {error / unfaulted:.3f}")


if __name__ == "__main__":
    main()
