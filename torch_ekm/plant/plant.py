"""What a control loop drives: the plant contract."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

from ..typing import Float, Tensor
from .observation import Observation


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
