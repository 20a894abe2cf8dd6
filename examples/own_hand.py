"""From a URDF and its transmission file to a turn: python examples/own_hand.py [HAND [OBJECT [DEGREES]]]

HAND is a name or a path to a URDF next to which its transmission file lies; by default the planar hand.
"""

import math
import sys

import numpy as np

from torch_ekm.control import ClosedLoop, LookAndMoveController, PoseTarget
from torch_ekm.description import load_hand
from torch_ekm.enhanced import EnhancedModel
from torch_ekm.inspection.check import check_hand
from torch_ekm.model import KinematicModel
from torch_ekm.simulation import SimulatedHand

name, thing, degrees = [*sys.argv[1:], *("planar_two_finger", "can", "8")[len(sys.argv) - 1 :]]
hand = load_hand(name)
print(f"{hand.name}: joints {', '.join(hand.joint_names)}; actuators {', '.join(hand.actuator_names)}")
print("J_a:\n" + np.array2string(hand.actuation_jacobian, precision=2))
for row in check_hand(name, thing):  # what "torch-ekm check" prints
    if row.state != "ok":
        print(f"{row.state}: {row.name}: {row.found}; {row.remedy}")

plant = SimulatedHand(hand, thing, preset="nominal")
seen = plant.reset(seed=0)
model = KinematicModel(plant.hand, plant.object)
linear = model.linearize(seen.state, fingertip_force=seen.fingertip_force)
turn = plant.rotation_axis @ linear.object_jacobian[3:]
print("turn of the object [deg] for 1 deg of each actuator:", turn.numpy().round(2))
print(
    "normal forces [N]:",
    linear.forces.normal.numpy().round(2),
    "stability:",
    f"{float(linear.stability):.3f} N m/rad",
)

for label in ("KM", "E-KM"):
    seen = plant.reset(seed=0)
    chosen = model if label == "KM" else EnhancedModel.for_grasp(model, seen.state)
    controller = LookAndMoveController(chosen, focus=plant.rotation_axis)
    result = ClosedLoop(plant, controller).run(
        PoseTarget.turned(seen.state, plant.rotation_axis, degrees=float(degrees))
    )
    end = f"{math.degrees(result.errors[-1]):.2f} deg off"
    print(f"{label}: {result.reason.value} after {len(result.steps)} motions, {end}")
plant.close()
