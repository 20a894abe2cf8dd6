"""A plant whose camera goes dark before the goal: the model alone says where the object is."""

from __future__ import annotations

import dataclasses

from ..control import Decision, PoseTarget
from ..kinematics.grasp_state import GraspState
from ..plant import Observation, Plant, PlantStatus
from ..typing import Float, Tensor


class CameraOff:
    """``p(t+1) = p(t) (+) E_p (f + g)(s, da)`` once the error is below ``switch_off``.

    Joint angles, encoders and fingertip forces go on being measured. The test that the paper leaves
    for the future (section VI): does the prediction hold without visual input?

    Args:
        plant: sees until then.
        target: where the object is being taken.
        axis: unit vector about which it turns there, hand frame. Rotation off this axis does not keep
            the camera on: a model that tilts the object is not to be helped for it.
        switch_off: error about the axis below which the camera is off [rad].
    """

    def __init__(
        self, plant: Plant, target: PoseTarget, axis: Float[Tensor, " 3"], switch_off: float
    ) -> None:
        self.plant, self.target, self.axis, self.switch_off = plant, target, axis, switch_off
        self.dark = False
        self._pose: tuple[Tensor, Tensor] | None = None
        self._predicted: Tensor | None = None

    def expect(self, decision: Decision) -> None:
        """Hear what the controller expects of the command that comes next."""
        self._predicted = decision.predicted

    def reset(self, seed: int) -> Observation:
        """Grasp anew, camera on."""
        self.dark, self._pose = False, None
        return self._through(self.plant.reset(seed))

    def observe(self) -> Observation:
        """Read the sensors."""
        return self._through(self.plant.observe())

    def command(self, delta_a: Float[Tensor, " n_a"]) -> Observation:
        """Move the actuators by ``delta_a`` [rad], wait, read the sensors that are on."""
        observation = self.plant.command(delta_a)
        if self.dark and self._pose is not None and self._predicted is not None:
            before = GraspState(observation.q, *self._pose)
            after = before.plus(self._predicted)
            self._pose = after.position, after.rotation
        return self._through(observation)

    def close(self) -> None:
        """Give back what the plant holds."""
        self.plant.close()

    def _through(self, observation: Observation) -> Observation:
        if not self.dark:
            self._pose = observation.position, observation.rotation
            error = self.target.error(GraspState(observation.q, *self._pose))
            self.dark = abs(float(self.axis @ error[3:])) <= self.switch_off
            return observation
        assert self._pose is not None
        # a dark camera cannot say that it does not see the object
        status = PlantStatus.HELD if observation.status is PlantStatus.NOT_SEEN else observation.status
        return dataclasses.replace(observation, position=self._pose[0], rotation=self._pose[1], status=status)
