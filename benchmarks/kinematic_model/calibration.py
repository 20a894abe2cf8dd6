"""Are the figures of a wrong hand found from 30 random motions?

    python benchmarks/kinematic_model/calibration.py --seeds 1000:1010

The simulated hand differs from its description: each pulley, spring and servo stiffness of the fingers that
grasp by a factor of its own, 0.7 to 0.9 or 1.1 to 1.3. It makes 30 motions in several grasps (each a random
increment of the motors that hold the object); from these the figures are found. Per seed: error of moment
arms, springs and stiffnesses before and after, and the error of a step that the kinematic model predicts in
grasps that the calibration has not seen, relative to that of the uncalibrated model.
"""

from __future__ import annotations

import argparse
import dataclasses
import time
from typing import NamedTuple

import numpy as np
import torch

from torch_ekm.contact.forces.options import ForceOptions
from torch_ekm.description import HandDescription, load_hand, load_object
from torch_ekm.exceptions import GraspError, SolverError
from torch_ekm.model import KinematicModel, ModelOptions, calibrate
from torch_ekm.model.calibration import Calibration
from torch_ekm.plant import PlantStatus, RecordingPlant, Trajectory
from torch_ekm.simulation import PlantConfig, PlantParameters, SimulatedHand

DEG = np.pi / 180
KINDS = ("moment_arms", "springs", "stiffness")
FINGERS = ("thumb", "index", "middle")
SENSORS = {
    "exact": PlantParameters(),
    "noisy": PlantParameters(
        joint_noise=0.1 * DEG, position_noise=0.0001, rotation_noise=0.05 * DEG, force_noise=0.1
    ),
}


#: the simulated joints have no friction here: what the model does not explain is 4 mN m at most
FRICTIONLESS = ModelOptions(forces=ForceOptions(torque_std=0.004))


class Outcome(NamedTuple):
    """Of one seed."""

    figures: dict[str, np.ndarray]
    """Relative errors of the identifiable figures, by kind."""
    sure: dict[str, np.ndarray]
    """Those with a standard error below 2.5 %."""
    before: float
    """rms error of a step in new grasps: rotation [deg]."""
    after: float
    ratio: float
    """Of rotation and position errors together (30 mm count as 1 rad)."""
    least: float
    """The same ratio of a model that knows the figures: what is left is not linear, or slips."""
    identifiable: int
    seconds: float


def wrong(hand: HandDescription, seed: int) -> HandDescription:
    """The hand that is simulated: each figure off by 10 to 30 %."""
    draw = np.random.default_rng([seed, 7])

    def factor(shape: tuple[int, ...]) -> np.ndarray:
        return 1 + draw.uniform(0.1, 0.3, shape) * draw.choice([-1, 1], shape)

    grasping = np.array([name.startswith(FINGERS) for name in hand.joint_names])
    J_a = np.where(grasping, factor(hand.actuation_jacobian.shape), 1.0) * hand.actuation_jacobian
    stiffness = factor((hand.n_a,))
    actuators = tuple(
        dataclasses.replace(actuator, stiffness=actuator.stiffness * k)
        for actuator, k in zip(hand.actuators, stiffness, strict=True)
    )
    springs = np.where(grasping, factor((hand.n_q,)), 1.0) * hand.spring_stiffness
    return dataclasses.replace(hand, actuators=actuators, actuation_jacobian=J_a, spring_stiffness=springs)


def motions(
    hand: HandDescription, seed: int, count: int, sensors: str, per_grasp: int = 5, reach: float = 1.5 * DEG
) -> list[Trajectory]:
    """Random positions of the motors that grasp, within +-``reach`` of the start of each grasp."""
    plant = RecordingPlant(
        SimulatedHand(hand, "box", PlantConfig(time_step=2e-3), parameters=SENSORS[sensors])
    )
    draw, recordings, done = np.random.default_rng([seed, 8]), [], 0
    moving = np.array([not actuator.posture for actuator in hand.actuators])
    grasp = 100 * seed
    while done < count:
        grasp += 1
        try:
            seen = plant.reset(grasp)
        except (GraspError, SolverError):
            continue
        start = seen.a
        for _ in range(min(per_grasp, count - done)):
            # around the grasp: a walk would end at the friction cone
            goal = start + torch.from_numpy(moving * draw.uniform(-reach, reach, hand.n_a))
            seen = plant.command(goal - seen.a)
            if seen.status is not PlantStatus.HELD:
                break
            done += 1
        recordings.append(plant.trajectory)
    plant.close()
    return recordings


def step_errors(model: KinematicModel, recordings: list[Trajectory]) -> np.ndarray:
    """True less predicted increment of the object ``(n, 6)`` [m, rad] of steps predicted from their start."""
    errors = []
    for recording in recordings:
        for before, after in zip(recording.observations, recording.observations[1:], strict=False):
            try:
                lin = model.linearize(before.state, fingertip_force=before.fingertip_force)
            except GraspError:
                continue
            errors.append((after.state.minus(before.state) - lin.step(after.a - before.a))[-6:].numpy())
    return np.array(errors)


def size(errors: np.ndarray) -> float:
    """rms, 30 mm as much as 1 rad."""
    return float(np.sqrt(np.mean(np.sum((errors / np.array([0.03] * 3 + [1.0] * 3)) ** 2, axis=1))))


def found(calibration: Calibration, truth: HandDescription, sure: float = np.inf) -> dict[str, np.ndarray]:
    """Relative errors of the figures that the calibration calls identifiable, by kind.

    ``sure``: only those with a relative standard error below.
    """
    errors: dict[str, list[float]] = {kind: [] for kind in KINDS}
    for parameter, row in zip(calibration.unknowns.parameters, calibration.parameters, strict=True):
        true = {
            "moment_arms": truth.actuation_jacobian,
            "springs": truth.spring_stiffness,
            "stiffness": np.array([actuator.stiffness for actuator in truth.actuators]),
            "offset": truth.actuator_offset,
        }[parameter.kind][parameter.index]
        known = row.identifiable and row.standard_error < sure * abs(row.value)
        if known and parameter.kind in KINDS:
            errors[parameter.kind].append(abs(row.value / true - 1))
    return {kind: np.array(values) for kind, values in errors.items()}


def trial(seed: int, sensors: str = "exact", count: int = 30) -> tuple[Outcome, Calibration]:
    """One wrong hand, calibrated and tested on grasps of its own."""
    described = load_hand("icub_right")
    truth = wrong(described, seed)
    box = load_object("box")
    recordings = motions(truth, seed, count, sensors)
    began = time.perf_counter()
    calibration = calibrate(KinematicModel(described, box, FRICTIONLESS), recordings, (*KINDS, "offset"))
    seconds = time.perf_counter() - began
    unseen = motions(truth, seed + 10**6, max(6, count // 2), "exact", reach=0.75 * DEG)
    before = step_errors(KinematicModel(described, box), unseen)
    after = step_errors(KinematicModel(calibration.hand, box), unseen)
    known = step_errors(KinematicModel(truth, box), unseen)
    rotations = [float(np.sqrt(np.mean(np.sum(e[:, 3:] ** 2, axis=1)))) / DEG for e in (before, after)]
    identifiable = sum(row.identifiable for row in calibration.parameters)
    ratios = size(after) / size(before), size(known) / size(before)
    figures = found(calibration, truth), found(calibration, truth, 0.025)
    return Outcome(*figures, *rotations, *ratios, identifiable, seconds), calibration


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", default="1000:1010", help="FIRST:END")
    parser.add_argument("--sensors", choices=SENSORS, default="exact")
    parser.add_argument("--motions", type=int, default=30)
    parser.add_argument("--quick", action="store_true", help="one seed, 10 motions")
    options = parser.parse_args()
    torch.set_num_threads(1)
    first, end = (0, 1) if options.quick else map(int, options.seeds.split(":"))
    count = 10 if options.quick else options.motions
    outcomes = []
    print(
        f"{'seed':>6}"
        + "".join(f"{kind:>18}" for kind in KINDS)
        + "   step [deg]         ratio  least ident    s"
    )
    for seed in range(first, end):
        outcome, _ = trial(seed, options.sensors, count)
        outcomes.append(outcome)
        medians = (
            f"{100 * np.median(e):8.1f} {100 * e.max():6.1f} %" if e.size else f"{'-':>17}"
            for e in outcome.figures.values()
        )
        steps = f"{outcome.before:6.3f} {outcome.after:6.3f} {outcome.ratio:10.2f} {outcome.least:6.2f}"
        print(
            f"{seed:6d} {' '.join(medians)} {steps} {outcome.identifiable:5d} {outcome.seconds:5.1f}",
            flush=True,
        )
    for kind in KINDS:
        for name, of in (("all identifiable", "figures"), ("standard error below 2.5 %", "sure")):
            every = np.concatenate([getattr(outcome, of)[kind] for outcome in outcomes])
            if every.size:
                within = f"{100 * np.mean(every <= 0.05):.0f} % of {every.size} within 5 %"
                print(f"{kind}, {name}: median {100 * np.median(every):.1f} %, {within}")
    ratios = [outcome.ratio for outcome in outcomes]
    print(f"step error, after / before: median {np.median(ratios):.2f}, worst {max(ratios):.2f}")


if __name__ == "__main__":
    main()
