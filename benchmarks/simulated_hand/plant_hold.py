"""Does a grasp stay where it is, and how fast is the physics? ``plant_hold.py --seeds 10``

Each object is pinched at random at preset "none" and held for 10 s of simulated time: drift of its true
pose, and simulated time per CPU time of one core while it is held. The target is 0.1 mm and 0.1 deg for at
least 9 of 10 grasps, at 8 times real time.
"""

from __future__ import annotations

import argparse
import math
import time

import torch

from torch_ekm.description import list_objects
from torch_ekm.exceptions import EquilibriumError, GraspError
from torch_ekm.kinematics.se3 import log
from torch_ekm.plant import PlantStatus
from torch_ekm.simulation import SimulatedHand

_LIMITS = 0.1, 0.1  # [mm], [deg]


def hold(plant: SimulatedHand, seed: int, duration: float) -> tuple[float, float, float] | None:
    """Drift [mm], [deg] and times real time; None if there was no grasp, or the object was lost."""
    try:
        before = plant.reset(seed).truth
    except (EquilibriumError, GraspError):
        return None
    began = time.process_time()
    plant.wait(duration)
    speed = duration / (time.process_time() - began)
    seen = plant.observe()
    after = seen.truth
    drift = 1e3 * float((after.position - before.position).norm())
    turned = math.degrees(float(log(after.rotation @ before.rotation.mT).norm()))
    return None if seen.status is PlantStatus.LOST else (drift, turned, speed)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=10, help="how many, from --first on")
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--objects", nargs="+", default=list(list_objects()), choices=list_objects())
    options = parser.parse_args()
    torch.set_num_threads(1)
    print("| object | held | worst drift [mm] | worst drift [deg] | times real time |\n|---|---|---|---|---|")
    for name in options.objects:
        plant = SimulatedHand("icub_right", name)
        held = [hold(plant, options.first + k, options.seconds) for k in range(options.seeds)]
        good = [one for one in held if one is not None]
        still = sum(one[0] < _LIMITS[0] and one[1] < _LIMITS[1] for one in good)
        drift, turned = (max((one[k] for one in good), default=math.nan) for k in (0, 1))
        speeds = [one[2] for one in good] or [math.nan]
        print(
            f"| {name} | {still}/{len(held)} | {drift:.1e} | {turned:.1e} | "
            f"{min(speeds):.1f} to {max(speeds):.1f} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
