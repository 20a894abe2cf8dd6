"""What the terms S, T and rolling of the stiffness are worth in the grasps of the demo, at 5 N.

``python geometric_terms.py`` grasps with the simulated iCub hand (seeds 0 to 9, nominal
parameters, true states) and prints by how much ``J_m`` changes when a term is left out, translations
in units of 30 mm: of all rows, and of the object's alone. Median and range over the grasps.
"""

from __future__ import annotations

import argparse

import numpy as np
import torch
from missing_terms import without

from torch_ekm.contact.contact_set import CHARACTERISTIC_LENGTH
from torch_ekm.model import KinematicModel
from torch_ekm.simulation import SimulatedHand

TERMS = {"S and T": ("S", "T"), "rolling": ("rolling",), "all three": ("S", "T", "rolling")}


def scaled_jacobian(model: KinematicModel, state) -> torch.Tensor:
    """J_m [rad/rad], translations in units of L."""
    J = model.linearize(state).manipulation_jacobian.clone()
    J[model.hand.n_q : model.hand.n_q + 3] /= CHARACTERISTIC_LENGTH
    return J


def main(objects: list[str]) -> None:
    for name in objects:
        plant = SimulatedHand("icub_right", name, preset="nominal")
        errors: dict[str, list[tuple[float, float]]] = {term: [] for term in TERMS}
        grip = []
        for seed in range(10):
            state = plant.reset(seed=seed).truth.state
            model = KinematicModel(plant.hand, plant.object)
            grip.append(float(model.linearize(state).forces.normal.max()))
            whole = scaled_jacobian(model, state)
            for term, left_out in TERMS.items():
                off = scaled_jacobian(without(model, *left_out), state) - whole
                parts = (slice(None), slice(plant.hand.n_q, None))
                errors[term].append(tuple(float(off[p].norm() / whole[p].norm()) for p in parts))  # type: ignore
        plant.close()
        print(f"{name}: largest normal force {np.median(grip):.2f} N ({min(grip):.2f} to {max(grip):.2f})")
        for term, values in errors.items():
            figures = 100 * np.array(values)
            for rows, x in zip(("all rows", "object"), figures.T, strict=True):
                print(f"  without {term:9s} {rows:8s} {np.median(x):5.1f} % ({x.min():.1f} to {x.max():.1f})")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("objects", nargs="*", default=["box", "can"], help="names or paths (%(default)s)")
    main(parser.parse_args().objects)
