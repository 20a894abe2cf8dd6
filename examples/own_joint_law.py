"""A law of one's own in the simulated plant: phalanges whose rubber cushions meet before the joints' stops.

A law is a function, or an object that remembers, of the joints' angles [rad] and the actuators' torques
[N m]; it gives torques at the joints [N m].
"""

import math
from dataclasses import dataclass

import numpy as np
import torch

from torch_ekm.description import load_hand
from torch_ekm.simulation import PlantParameters, SimulatedHand


@dataclass(frozen=True)
class Cushions:
    """``tau = -k max(q - q_c, 0)^2`` at the joints beyond q_c [rad]."""

    begin: float
    stiffness: np.ndarray
    """k of each joint ``(n_q,)`` [N m/rad^2]."""

    def __call__(self, q, actuator_torque):
        return -self.stiffness * np.maximum(q - self.begin, 0.0) ** 2


hand = load_hand("icub_right")
fingers = np.array([name.startswith(("index", "middle")) for name in hand.joint_names])
forces = []
for name, law in (("described", None), ("cushions", Cushions(math.radians(20), 1.0 * fingers))):
    plant = SimulatedHand(hand, "box", parameters=PlantParameters(joint_law=law))
    plant.reset(seed=0)
    push = torch.zeros(plant.hand.n_a, dtype=torch.float64)
    push[[plant.hand.actuator_names.index(finger) for finger in ("index_distal", "middle_distal")]] = 0.05
    seen = plant.command(push)
    forces.append(seen.fingertip_force)
    print(f"{name}: fingertip forces {', '.join(f'{force:.2f}' for force in seen.fingertip_force)} N")
print(f"the law changes the thumb's force by {float(forces[1][0] - forces[0][0]):.1f} N")
