"""The kinematic model against SAPIEN with the model's own parameters.

    python benchmarks/kinematic_model/sapien_agreement.py --object box --seeds 1000:1010

How exact is it, until when, and is the end announced? A least-squares controller that ignores friction
cones and joint stops turns the object in steps of 1.5 deg. Per grasp: rms error of a predicted step
about the axis until the first contact reaches its friction cone, the first step that is wrong by more
than 0.3 deg, and whether a margin of at most 10 % was reported at that step or before it.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))

from turning_step import true_state, turning_step

from torch_ekm.exceptions import GraspError
from torch_ekm.model import KinematicModel, ModelOptions
from torch_ekm.plant import PlantStatus
from torch_ekm.simulation import SimulatedHand

DEG = np.pi / 180


def turn(name: str, seed: int, degrees: float) -> tuple[float, float, float, bool]:
    """``(rms, cone, failure, announced)``: [deg] of error, and of rotation at the two events (NaN: never)."""
    plant = SimulatedHand("icub_right", name)
    observation = plant.reset(seed)
    model = KinematicModel(plant.hand, plant.object, ModelOptions(on_unstable="flag"))
    axis, start = plant.rotation_axis, true_state(observation)
    lower, upper = (torch.as_tensor(x) for x in (plant.hand.actuator_lower, plant.hand.actuator_upper))
    state, errors, grip, cone, failure, least = start, [], None, np.nan, np.nan, np.inf
    known = None
    while (turned := float(state.minus(start)[-3:] @ axis) / DEG) < degrees and len(errors) < 60:
        try:
            lin = model.linearize(state, previous=known)
        except GraspError:
            break
        known = lin if lin.forces.solved else known
        least = min(least, float(lin.forces.relative_margin.min()))
        if np.isnan(cone) and least <= 0.01:
            cone = turned
        grip = lin.forces.normal if grip is None or len(grip) != lin.contacts.n_c else grip
        da = turning_step(lin, axis, 1.5 * DEG, grip)
        da = torch.clamp(observation.a + da, lower, upper) - observation.a
        observation = plant.command(da)
        after = true_state(observation)
        error = float((after.minus(state) - lin.step(da))[-3:] @ axis) / DEG
        if abs(error) > 0.3 or observation.status is not PlantStatus.HELD:
            failure = turned
            break
        if np.isnan(cone):
            errors.append(error)
        else:
            errors.append(np.nan)
        state = after
    plant.close()
    return float(np.sqrt(np.nanmean(np.square(errors)))), cone, failure, bool(least <= 0.1)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--object", default="box")
    parser.add_argument("--seeds", default="1000:1010", help="FIRST:END")
    parser.add_argument("--degrees", type=float, default=35.0)
    options = parser.parse_args()
    torch.set_num_threads(1)
    first, end = (int(part) for part in options.seeds.split(":"))
    rows = []
    print(f"{'seed':>6} {'rms':>8} {'cone at':>8} {'failure':>8} announced   [deg]")
    for seed in range(first, end):
        rms, cone, failure, announced = turn(options.object, seed, options.degrees)
        rows.append((rms, cone, failure, announced))
        print(f"{seed:6d} {rms:8.4f} {cone:8.1f} {failure:8.1f} {announced!s:>9}", flush=True)
    failed = [row for row in rows if np.isfinite(row[2])]
    print(f"rms: median {np.median([r[0] for r in rows]):.4f}, worst {max(r[0] for r in rows):.4f} deg")
    print(f"failures announced: {sum(r[3] for r in failed)} of {len(failed)}")


if __name__ == "__main__":
    main()
