"""The simulated hand as a Gymnasium environment, driven by the kinematic model.

    python examples/gymnasium_environment.py

A policy of yours takes the place of the two lines that solve for the action.
"""

import gymnasium
import numpy as np

from torch_ekm.model import KinematicModel

env = gymnasium.make("torch_ekm.simulation.env:torch_ekm/InHandRotation-v0", object="can", parameters="none")
observation, info = env.reset(seed=0, options={"angle": np.radians(8)})
hand = env.unwrapped  # its plant gives the model what is held, and the axis of the pinch
model = KinematicModel(hand.plant.hand, hand.plant.object)
total = 0.0
while True:
    seen = hand.plant.observe()
    jacobian = model.linearize(seen.state, fingertip_force=seen.fingertip_force).object_jacobian
    to_go = float(observation[-1])  # angle still to turn [rad]
    step = np.clip(to_go, -np.radians(2), np.radians(2)) * hand.plant.rotation_axis.numpy()
    twist = np.concatenate([np.zeros(3), step])
    weight = np.array([30.0] * 3 + [1.0] * 3)  # 1 rad counts as much as 1/30 m
    delta_a = np.linalg.lstsq(weight[:, None] * jacobian.numpy(), weight * twist, rcond=1e-2)[0]
    observation, reward, terminated, truncated, info = env.step(
        (delta_a / hand.step_limit).astype(np.float32)
    )
    total += float(reward)
    if terminated or truncated:
        break
print(f"success {info['is_success']}, {np.degrees(observation[-1]):.2f} deg to go, return {total:.2f}")
env.close()
