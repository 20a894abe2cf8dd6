"""How exact is a foreseen turn?

    python benchmarks/kinematic_model/foreseen_turn.py --objects box,can --seeds 1000:1010

A turn of 20 deg is foreseen in 12 motions before anything moves, with the own parameters of the plant, and
then made in SAPIEN without feedback. Per grasp: rms error about the axis over the whole turn; rms and largest
error of the normal forces of the pads until the first foreseen slip; at which motion that is; and how far the
rolled contacts are from those that the detector finds at the end.
"""

from __future__ import annotations

import argparse
import statistics
import sys
from pathlib import Path

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).parents[2] / "tests" / "foresight"))

from turning import turning

from torch_ekm.foresight import Rollout
from torch_ekm.model import KinematicModel
from torch_ekm.simulation import SimulatedHand

DEG = np.pi / 180


def turn(name: str, seed: int) -> tuple[float, float, float, int | None, float]:
    """``(rms [deg], rms [N], largest [N], first slip, contacts off [mm])``."""
    plant = SimulatedHand("icub_right", name)
    seen = plant.reset(seed)
    model = KinematicModel(plant.hand, plant.object)
    rollout, axis, start = Rollout(model), plant.rotation_axis, seen.truth.state
    lin = now = model.linearize(start, fingertip_force=seen.truth.fingertip_force)
    lower, upper = (torch.as_tensor(x) for x in (plant.hand.actuator_lower, plant.hand.actuator_upper))
    a, actions = seen.a, []
    for _ in range(12):
        actions.append(torch.clamp(a + turning(now, axis, 20 / 12 * DEG), lower, upper) - a)
        a = a + actions[-1]
        end = rollout.predict(start, torch.stack(actions), start=lin).at(-1)
        now = model.linearize(end.state, end.contacts, forces=end.forces, on_unstable="flag")
    truth, moved = [seen.truth], []
    for w in actions:
        after = plant.command(w)
        moved.append(after.a - seen.a)
        seen = after
        truth.append(seen.truth)
    plant.close()
    foreseen = rollout.predict(start, torch.stack(moved), start=lin)
    off = torch.stack([foreseen.at(k).state.minus(t.state)[-3:] @ axis for k, t in enumerate(truth)])
    pads = plant.hand.pad_indices(foreseen.contacts.finger)
    measured = torch.stack([t.fingertip_force[pads] for t in truth])
    wrong = (foreseen.normal_force - measured)[: foreseen.first_slip]
    rms = [float(x.square().mean().sqrt()) for x in (off / DEG, wrong)]
    end = foreseen.at(-1)
    found = model.contacts(end.state)
    off = end.contacts.point - found.point[[found.finger.index(pad) for pad in end.contacts.finger]]
    gap = 1e3 * float(torch.linalg.vector_norm(off, dim=-1).max())
    return *rms, float(wrong.abs().max()), foreseen.first_slip, gap


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--objects", default="box,can")
    parser.add_argument("--seeds", default="1000:1010", help="FIRST:END")
    options = parser.parse_args()
    torch.set_num_threads(1)
    first, end = (int(part) for part in options.seeds.split(":"))
    print("object seed  axis [deg]  forces rms, largest [N]  slip at  contacts [mm]")
    rows = []
    for name in options.objects.split(","):
        for seed in range(first, end):
            rms, force, largest, slip, gap = turn(name, seed)
            rows.append((rms, force))
            print(
                f"{name:6s} {seed:4d} {rms:10.3f} {force:10.3f} {largest:8.3f} {slip!s:>14} {gap:12.4f}",
                flush=True,
            )
    axis, force = (sorted(row[i] for row in rows) for i in (0, 1))
    print(f"axis: median {statistics.median(axis):.3f}, worst {axis[-1]:.3f} deg")
    print(f"forces: median {statistics.median(force):.3f}, worst {force[-1]:.3f} N")


if __name__ == "__main__":
    main()
