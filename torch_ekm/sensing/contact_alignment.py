from __future__ import annotations

import dataclasses
import math

import torch

from ..contact.detector import ContactDetector
from ..description import HandDescription, ObjectDescription
from ..kinematics import HandKinematics
from ..plant import Observation, Plant, PlantWrapper

_STEP = math.radians(2.0)
_LIMIT = math.radians(25.0)
_LEAST_SLOPE = 5e-3  # [m/rad]: joints that hardly change the gap are not to blame for it
_ITERATIONS = 4
_CLOSED = 5e-5  # [m]
_LEAST_FORCE = 0.5  # [N]: a pad that measures less says nothing


class ContactAligned(PlantWrapper):
    """``gap_i(q + delta_u e_u) = 0`` for each pad i that measures 0.5 N, u its joint without a Hall sensor.

    The angle of such a joint is known from the motor's encoder alone, through a tendon with another
    pulley radius than the model's that stretches under load: on the iCub the thumb's opposition is
    off by 10 deg, the thumb then seems to be millimetres away from the object that it presses, and no
    kinematic model can be made of the grasp. But where camera and fingertip agree that there is a
    contact, the gap is known, and with it the angle. Solved by the secant method, at every observation.

    Args:
        plant: gives estimates of joints, pose and fingertip forces.
        hand, obj: what it consists of.
    """

    def __init__(self, plant: Plant, hand: HandDescription, obj: ObjectDescription) -> None:
        super().__init__(plant)
        self.hand = hand
        self._detector = ContactDetector(hand, obj, margin=math.inf)
        kinematics = HandKinematics(hand)
        sensed = {sensor.joint for sensor in hand.hall_sensors}
        free = torch.tensor([name not in sensed for name in hand.joint_names])
        free &= torch.from_numpy(hand.joint_upper > hand.joint_lower)
        upstream = kinematics.upstream[[kinematics.link_index(pad.link) for pad in hand.pads]]
        self._joints: list[list[int]] = [torch.nonzero(row & free).flatten().tolist() for row in upstream]
        self._delta = torch.zeros(hand.n_q, dtype=torch.float64)

    def reset(self, seed: int) -> Observation:
        """Grasp again, with no correction of any joint known."""
        self._delta.zero_()
        return super().reset(seed)

    def observation(self, seen: Observation) -> Observation:
        """``seen`` with joints that agree with the contacts."""
        forces = [] if seen.fingertip_force is None else seen.fingertip_force.tolist()
        for i, force in enumerate(forces):
            if force >= _LEAST_FORCE:
                for j in self._joints[i]:
                    self._close_gap(seen, self.hand.pads[i].name, j)
        return dataclasses.replace(seen, q=seen.q + self._delta)

    def _close_gap(self, seen: Observation, pad: str, joint: int) -> None:
        """Secant steps on one joint's error, from its last known value."""

        def gap(delta: float) -> float:
            q = seen.q + self._delta
            q[joint] = seen.q[joint] + delta
            contacts = self._detector(q, seen.position, seen.rotation)
            return float(contacts.gap[contacts.finger.index(pad)])

        old = float(self._delta[joint])
        new = old + _STEP
        before, after = gap(old), gap(new)
        for _ in range(_ITERATIONS):
            slope = (after - before) / (new - old) if new != old else 0.0
            if abs(slope) < _LEAST_SLOPE:
                return
            old, before, new = new, after, new - after / slope
            if abs(new) > _LIMIT:
                return
            after = gap(new)
            if abs(after) < _CLOSED:
                break
        self._delta[joint] = new
