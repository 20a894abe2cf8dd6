"""A plant whose camera goes dark before the goal: the model alone says where the object is."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable

from ..control import PoseTarget
from ..exceptions import GraspError
from ..kinematics import GraspState
from ..plant import Observation, Plant, PlantStatus, PlantWrapper
from ..typing import Float, Tensor


class CameraOff(PlantWrapper):
    """``p(t+1) = p(t) (+) E_p (f + g)(s, da)`` once the error is below ``switch_off``.

    Joint angles, encoders and fingertip forces go on being measured. The test that the paper leaves
    for the future (section VI): does the prediction hold without visual input?

    Args:
        plant: sees until then.
        predict: ``(f + g)(s, da)``, increments of the whole state.
        target: where the object is being taken.
        axis: unit vector about which it turns there, hand frame. Rotation off this axis does not keep
            the camera on: a model that tilts the object is not to be helped for it.
        switch_off: error about the axis below which the camera is off [rad].
        by_commands: predict from what was commanded, for a model that has learned from commands.
    """

    def __init__(
        self,
        plant: Plant,
        predict: Callable[[GraspState, Tensor], Tensor],
        target: PoseTarget,
        axis: Float[Tensor, " 3"],
        switch_off: float,
        by_commands: bool = False,
    ) -> None:
        super().__init__(plant)
        self.predict, self.target, self.axis, self.switch_off = predict, target, axis, switch_off
        self.by_commands, self.dark = by_commands, False
        self._state: GraspState | None = None
        """Last passed on."""
        self._a: Tensor | None = None
        """Last encoders."""

    def reset(self, seed: int) -> Observation:
        """Grasp anew, camera on."""
        self.dark, self._state = False, None
        return super().reset(seed)

    def command(self, delta_a: Float[Tensor, " n_a"]) -> Observation:
        """Move the actuators by ``delta_a`` [rad], wait, read the sensors that are on."""
        before, after = self._a, self.plant.command(delta_a)
        if self.dark and self._state is not None and before is not None:
            moved = delta_a if self.by_commands else after.a - before
            with contextlib.suppress(GraspError):  # a state that the model refuses: the pose stays
                self._state = self._state.plus(self.predict(self._state, moved))
        return self.observation(after)

    def observation(self, seen: Observation) -> Observation:
        """``seen``, in the dark with the predicted pose."""
        self._a = seen.a
        if not self.dark or self._state is None:
            self._state = seen.state
            error = self.target.error(seen.state)
            self.dark = abs(float(self.axis @ error[3:])) <= self.switch_off
            return seen
        position, rotation = self._state.position, self._state.rotation
        self._state = GraspState(seen.q, position, rotation)
        # a dark camera cannot say that it does not see the object
        status = PlantStatus.HELD if seen.status is PlantStatus.NOT_SEEN else seen.status
        stamps = seen.taken._replace(pose=seen.time)  # foretold for now
        return dataclasses.replace(seen, position=position, rotation=rotation, status=status, stamps=stamps)
