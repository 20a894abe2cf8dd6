"""Time of the kinematic model for the iCub hand: contacts, forces, D, J_m, a batch of 1024 states.

    python benchmarks/kinematic_model.py

One thread. The grasp is a pinch of the box between thumb, index and middle finger: 20 joints, 9 actuators, 3
contacts. The last line is the time of one state of the batch.
"""

from __future__ import annotations

import argparse
import dataclasses
import time
from typing import Any

import numpy as np
import torch

from torch_ekm import warm_up
from torch_ekm.contact import constraint_matrix
from torch_ekm.contact.contact_set import VARYING
from torch_ekm.experiments.reporting.report import Column, Report, Table
from torch_ekm.kinematics import GraspState
from torch_ekm.model import KinematicModel
from torch_ekm.model.stiffness import geometric_stiffness
from torch_ekm.simulation import SimulatedHand

BATCH = 1024


def many(x: Any) -> Any:
    """``BATCH`` copies of a tensor."""
    return x.expand(BATCH, *x.shape).contiguous()


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true", help="each once: to see that it works")
    quick = parser.parse_args().quick
    torch.set_num_threads(1)
    warm_up()
    plant = SimulatedHand("icub_right", "box", engine="mujoco")
    state, model = plant.reset(0).state, KinematicModel(plant.hand, plant.object)
    plant.close()
    contacts, forces = model.contacts(state), model.linearize(state).forces
    kin = model.contact_kinematics(state, contacts)
    A, (V_s, _) = constraint_matrix(kin), model.potential(state)
    states = GraspState(*map(many, (state.q, state.position, state.rotation)))
    many_contacts = contacts.replace(**{name: many(getattr(contacts, name)) for name in VARYING})
    known = {name: many(x) for name, x in vars(forces).items() if isinstance(x, torch.Tensor)}
    many_forces = dataclasses.replace(forces, status=forces.status * BATCH, **known)
    cases = {
        "linearize, contacts and forces included": lambda: model.linearize(state),
        "contacts": lambda: model.contacts(state),
        "forces": lambda: model.balance(state.q, kin, A, V_s),
        "stiffness": lambda: geometric_stiffness(kin, forces.force, forces.spin_moment, model.precedes),
        "linearize, contacts and forces known": lambda: model.linearize(state, contacts, forces=forces),
        f"the same, {BATCH} at once, each": lambda: model.linearize(
            states, many_contacts, forces=many_forces
        ),
    }
    rows = []
    for name, case in cases.items():
        n, took = (1 if quick else 5 if "each" in name else 200), []
        for _ in range(n + 1):
            begun = time.perf_counter()
            case()
            took.append(1e6 * (time.perf_counter() - begun) / (BATCH if "each" in name else 1))
        rows.append([name, float(np.min(took[1:])), float(np.median(took[1:])), n])
    columns = ["", Column("least [µs]", ".0f"), Column("median [µs]", ".0f"), "rounds"]
    print(Report("", "", [Table("kinematic_model", "Kinematic model", columns, rows)]).markdown(level=2))


if __name__ == "__main__":
    main()
