"""What a control loop drives: the plant contract."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol, TypeGuard, runtime_checkable

from ..typing import Float, Tensor
from .observation import Observation
from .path import Path


@runtime_checkable
class Plant(Protocol):
    """A hand holding an object: simulated, recorded, or real."""

    def reset(self, seed: int) -> Observation:
        """Grasp the object; the same seed gives the same grasp and the same noise."""
        ...

    def observe(self) -> Observation:
        """Read the sensors: SI units, hand frame; nothing moves."""
        ...

    def command(self, delta_a: Float[Tensor, " n_a"]) -> Observation:
        """Move the actuators by ``delta_a`` [rad] **relative to their encoders**, wait, read the sensors."""
        ...

    def close(self) -> None:
        """Release devices, windows and files; the plant is not used afterwards."""


class FollowingPlant(Plant, Protocol):
    """A plant whose motors go through waypoints, and that can be watched on the way.

    ``command(delta_a)`` is the movement with one waypoint.
    """

    def follow(self, path: Path, watch: Callable[[Observation], bool]) -> Observation:
        """Move through the waypoints, wait until the hand rests, read the sensors.

        Args:
            watch: is given the readings that come on the way, in order, at the plant's own rate; where it
                answers False, or raises, the motors are commanded to stay where they are.
        """
        ...


def can_follow(plant: Plant) -> TypeGuard[FollowingPlant]:
    """Whether a plant has :meth:`FollowingPlant.follow`; a wrapper has it where what it wraps has."""
    return hasattr(plant, "follow")
