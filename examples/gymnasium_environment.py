"""The simulated hand as a Gymnasium environment: copy the class, and give it the reward of your task.

    python examples/gymnasium_environment.py

The kinematic model drives it here; a policy of yours takes the place of the lines that solve for the action.
"""

import gymnasium
import numpy as np
import torch

from torch_ekm.kinematics.se3 import log
from torch_ekm.model import KinematicModel
from torch_ekm.plant import PlantStatus
from torch_ekm.simulation import SimulatedHand

STEP_LIMIT = np.radians(3)  # largest increment of an actuator [rad]
TOLERANCE = np.radians(0.5)  # the goal is reached within this [rad]


class InHandRotation(gymnasium.Env):
    """Turn a pinched object about the axis of its grasp, by increments of the actuators.

    Action, in [-1, 1]: increment of each actuator in units of STEP_LIMIT. Observation, as the sensors say and
    never the truth: joint angles, encoders [rad], position [m] and rotation vector [rad] of the object since
    the reset, forces of the fingertips [N], angle turned and still to turn about the grasp's axis [rad].
    """

    def __init__(self, angles=(0.09, 0.44), **options):
        self.plant, self.angles = SimulatedHand(**options), angles  # least and largest target [rad]
        hand = self.plant.hand
        entries = hand.n_q + hand.n_a + 6 + len(hand.pads) + 2
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (entries,), dtype=np.float64)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (hand.n_a,), dtype=np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.target = (options or {}).get("angle", self.np_random.uniform(*self.angles))
        self.start = self.plant.reset(int(self.np_random.integers(2**31)))
        return self.observed(self.start)[0], {}

    def step(self, action):
        seen = self.plant.command(torch.from_numpy(STEP_LIMIT * np.clip(action, -1.0, 1.0)))
        observation, off = self.observed(seen)
        lost, to_go = seen.status is PlantStatus.LOST, abs(observation[-1])
        reached = bool(not lost and to_go < TOLERANCE)
        reward = -(to_go + 0.1 * off) / np.radians(10) + reached - 10.0 * lost
        return observation, float(reward), lost or reached, False, {"is_success": reached}

    def observed(self, seen):
        """The observation, and what turned about other axes since the reset [rad]."""
        rotation, axis = log(seen.rotation @ self.start.rotation.mT), self.plant.rotation_axis
        turned = rotation @ axis
        angles = torch.stack([turned, self.target - turned])
        moved = seen.position - self.start.position
        parts = torch.cat([seen.q, seen.a, moved, rotation, seen.fingertip_force, angles])
        return parts.numpy(), float((rotation - turned * axis).norm())


gymnasium.register("InHandRotation-v0", InHandRotation, max_episode_steps=40)

if __name__ == "__main__":
    env = gymnasium.make("InHandRotation-v0", object="can", preset="none")
    observation, info = env.reset(seed=0, options={"angle": np.radians(8)})
    plant = env.unwrapped.plant
    model = KinematicModel(plant.hand, plant.object)
    total, ended = 0.0, False
    while not ended:
        seen = plant.observe()
        jacobian = model.linearize(seen.state, fingertip_force=seen.fingertip_force).object_jacobian
        step = np.clip(observation[-1], -np.radians(2), np.radians(2)) * plant.rotation_axis.numpy()
        twist = np.concatenate([np.zeros(3), step])
        weight = np.array([30.0] * 3 + [1.0] * 3)  # 1 rad counts as much as 1/30 m
        delta_a = np.linalg.lstsq(weight[:, None] * jacobian.numpy(), weight * twist, rcond=1e-2)[0]
        observation, reward, terminated, truncated, info = env.step((delta_a / STEP_LIMIT).astype(np.float32))
        total, ended = total + reward, terminated or truncated
    print(f"success {info['is_success']}, {np.degrees(observation[-1]):.2f} deg to go, return {total:.2f}")
