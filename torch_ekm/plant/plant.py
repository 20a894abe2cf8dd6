"""What a control loop drives: the plant contract, and what a plant reports."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum
from typing import Any, Protocol, runtime_checkable

import torch

from ..exceptions import NonFiniteError
from ..typing import Float, Tensor


class PlantStatus(Enum):
    """What a plant knows about its object."""

    HELD = "held"
    LOST = "lost"  # dropped, thrown, or out of the fingers
    NOT_SEEN = "not_seen"  # the camera did not find it in this frame


@dataclass(frozen=True)
class Observation:
    """What the sensors say, in SI units and the hand frame; never the simulator's truth.

    Raises:
        NonFiniteError: any entry is NaN or infinite.
    """

    q: Float[Tensor, " n_q"]
    """Estimated joint angles [rad] (Hall sensors)."""
    a: Float[Tensor, " n_a"]
    """Actuator encoders [rad]."""
    position: Float[Tensor, " 3"]
    """Object point o [m] (markers)."""
    rotation: Float[Tensor, "3 3"]
    """Object orientation R."""
    fingertip_force: Float[Tensor, " n_pads"]
    """Normal force of each contact pad [N], in the order of ``HandDescription.pads``."""
    time: float = 0.0
    """[s]"""
    status: PlantStatus = PlantStatus.HELD
    info: dict[str, Any] = field(default_factory=dict)
    """Anything else, e.g. ``info["truth"]`` of a simulation: for reports only."""

    def __post_init__(self) -> None:
        for name in ("q", "a", "position", "rotation", "fingertip_force"):
            finite = torch.isfinite(getattr(self, name))
            if not bool(finite.all()):
                raise NonFiniteError(f"Observation.{name}", torch.nonzero(~finite)[:3].tolist())


@runtime_checkable
class Plant(Protocol):
    """A hand holding an object: simulated, recorded, or real."""

    def reset(self, seed: int) -> Observation:
        """Grasp the object anew; the same seed gives the same grasp and the same noise."""
        ...

    def observe(self) -> Observation:
        """Read the sensors."""
        ...

    def command(self, delta_a: Float[Tensor, " n_a"]) -> Observation:
        """Move the actuators by ``delta_a`` [rad] **relative to their encoders**, wait, read the sensors."""
        ...

    def close(self) -> None:
        """Give back what the plant holds."""
        ...
