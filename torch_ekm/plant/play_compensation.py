from __future__ import annotations

import dataclasses

from ..kinematics import Play
from ..typing import Float, Tensor
from .observation import Observation
from .plant import Plant
from .wrapper import PlantWrapper


class PlayCompensation(PlantWrapper):
    """``command(dx)`` moves the motors so far that the *tendons* move by ``dx``.

    ``Observation.a`` becomes the position after the play, ``m + z``. So a model, a learner and a controller
    around this plant deal with what moves the joints. What the motors really did is read from the encoders.
    At a reset the play is unknown: the first motions may miss by half of it.

    Args:
        plant: to be driven.
        play: of its actuators.
    """

    def __init__(self, plant: Plant, play: Play) -> None:
        super().__init__(plant)
        self.play, self.state = play, play.unknown()
        self._motor: Tensor | None = None

    def reset(self, seed: int) -> Observation:
        """Grasp the object again; the play is unknown again."""
        self._motor = None
        return super().reset(seed)

    def command(self, delta_a: Float[Tensor, " n_a"]) -> Observation:
        """Move the tendons by ``delta_a`` [rad], wait, read the sensors."""
        return self.observation(self.plant.command(self.play.command(self.state, delta_a)))

    def observation(self, seen: Observation) -> Observation:
        """With the position of the tendons in ``a``."""
        if self._motor is None:
            self.state = self.play.unknown()
        else:
            _, self.state = self.play.advance(self.state, seen.a - self._motor)
        self._motor = seen.a
        return dataclasses.replace(seen, a=seen.a + self.state.position)
