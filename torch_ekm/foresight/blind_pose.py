from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import torch

from ..control.guards import Guards, ReadingTests, stated
from ..enhanced import EnhancedModel
from ..exceptions import ParameterError
from ..model import KinematicModel
from ..plant import Observation, Plant, PlantStatus, PlantWrapper
from ..typing import Float, Tensor
from .pose_filter import PoseFilter


class BlindPose(PlantWrapper):
    """``(q, o, R)`` of a :class:`PoseFilter` in place of the camera's pose, from ``switch_off`` on.

    Joint angles, encoders and fingertip forces go on being measured. The camera is asked again where the
    standard deviation of the rotation about the axis exceeds ``look_again``; what it then sees is one more
    measurement. ``info["estimate"]`` without a picture has ``pose_covariance`` of the error twist
    ``(v; w)`` [m, rad], ``axis_std`` [rad] and ``looked``. Train nothing meanwhile
    (``ClosedLoop(..., learn=False)``): increments are estimates, too. ::

        plant = BlindPose(plant, ekm, axis, look_again=math.radians(1))
        ClosedLoop(plant, controller, learn=False).run(target)

    Args:
        plant: sees until then.
        model: predicts the motions.
        axis: about which the object turns, hand frame.
        look_again: [rad]; infinite: never.
        switch_off: the camera goes off with the first observation for which this is true; None: with the
            first one.
        touch: False leaves the pose to the prediction alone (the test that the paper leaves for the future,
            section VI).

    Raises:
        ParameterError: ``axis`` has no direction, or ``look_again`` is not positive.
    """

    def __init__(
        self,
        plant: Plant,
        model: KinematicModel | EnhancedModel,
        axis: Float[Tensor, " 3"],
        *,
        look_again: float = math.inf,
        switch_off: Callable[[Observation], bool] | None = None,
        touch: bool = True,
    ) -> None:
        if not float(torch.linalg.vector_norm(axis)) > 1e-9:
            raise ParameterError("axis", axis.tolist(), "a vector of non-zero length")
        if not look_again > 0:
            raise ParameterError("look_again", look_again, "greater than 0 [rad]; infinite: never")
        super().__init__(plant)
        self.filter = PoseFilter(model, touch=touch)
        self.axis = axis / torch.linalg.vector_norm(axis)
        self.look_again = look_again
        self._switch_off = switch_off
        self.dark, self.looks = False, 0
        """The camera is off; how often it was asked since."""
        self._tests = ReadingTests(Guards(), self.filter.kinematic.hand)
        self._sent: Tensor | None = None  # waypoints of motions from which no reading was accepted yet
        self._before: Observation | None = None
        """As measured, the last reading that was accepted."""

    @property
    def axis_std(self) -> float:
        """Standard deviation of the rotation about the axis [rad]."""
        return math.sqrt(max(float(self.axis @ self.filter.pose_covariance[3:, 3:] @ self.axis), 0.0))

    def reset(self, seed: int) -> Observation:
        """Grasp again with the camera on; the observation after it is that of the plant."""
        self.dark, self.looks, self._before, self._sent = False, 0, None, None
        return super().reset(seed)

    def command(self, delta_a: Float[Tensor, " n_a"]) -> Observation:
        """Move the actuators by ``delta_a`` [rad], wait, read the sensors that are on."""
        after = self.plant.command(delta_a)
        last = self._sent if self._sent is not None else delta_a.new_zeros(1, len(delta_a))
        self._sent = torch.cat([last, last[-1:] + delta_a])
        return self.observation(after)

    def observation(self, seen: Observation) -> Observation:
        """``seen``, with the estimated state while the camera is off; a reading that :class:`Guards` refuse
        changes nothing of the estimate."""
        before, guards = self._before, self._tests.guards
        accepted = not self._tests.motors(before, self._sent, seen)
        if not self.dark:
            self._before, self._sent = seen, None
            self.dark = self._switch_off is None or self._switch_off(seen)
            if self.dark:
                self.filter.start(seen.state, seen.fingertip_force, stated(seen))
            return seen
        if accepted:
            if self._sent is not None and before is not None:
                self.filter.move(seen.a - before.a, before.fingertip_force)
            self._before, self._sent = seen, None
            if float((seen.q - self.filter.state.q).abs().max()) <= guards.joint_jump:
                self.filter.measure(seen.q, seen.fingertip_force)
        looked = accepted and self.axis_std > self.look_again and seen.status is PlantStatus.HELD
        if looked:
            self.looks += 1
            self.filter.look(seen.state, stated(seen))
        at, P = self.filter.state, self.filter.pose_covariance
        estimate = {"pose_covariance": P, "axis_std": self.axis_std, "looked": looked}
        estimate = seen.info.get("estimate", {}) | estimate
        # a dark camera cannot say that it does not see the object
        status = PlantStatus.HELD if seen.status is PlantStatus.NOT_SEEN else seen.status
        # estimated for now: it is no stale picture
        stamps = None if seen.stamps is None else seen.stamps._replace(pose=seen.time, joints=seen.time)
        return dataclasses.replace(
            seen,
            q=at.q,
            position=at.position,
            rotation=at.rotation,
            status=status,
            stamps=stamps,
            info={**seen.info, "estimate": estimate},
        )
