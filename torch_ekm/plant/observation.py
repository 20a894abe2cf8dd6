"""What a plant reports: readings for whoever controls, the truth of a simulation for reports."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum
from functools import cached_property
from typing import Any, NamedTuple

import torch

from .._checks import check_finite, check_kind
from ..kinematics import GraspState
from ..typing import Float, Tensor


class PlantStatus(Enum):
    """Whether a plant holds its object, and sees it."""

    HELD = "held"
    LOST = "lost"  # dropped, thrown, or out of the fingers
    NOT_SEEN = "not_seen"  # the camera did not find it in this frame


@dataclass(frozen=True)
class Truth:
    """The true state of a simulation, hand frame.

    For reports and for sensors that are simulated; a :class:`Trajectory` stores it. Nothing that controls,
    senses or learns may read it (held by a test).
    """

    q: Float[Tensor, " n_q"]
    """Joint angles [rad]."""
    position: Float[Tensor, " 3"]
    """Object point o [m]."""
    rotation: Float[Tensor, "3 3"]
    """Object orientation R, object frame to hand frame."""
    fingertip_force: Float[Tensor, " n_pads"] | None = None
    """Normal force of each contact pad [N]."""
    actuator_torque: Float[Tensor, " n_a"] | None = None
    """Torque of each actuator along ``+a`` [N m]."""
    pictured: GraspState | None = None
    """The state when the newest picture was taken; None: the present one."""

    @property
    def state(self) -> GraspState:
        """True joint angles [rad] and object pose in the hand frame [m]."""
        return GraspState(self.q, self.position, self.rotation)

    def arrays(self) -> dict[str, Tensor]:
        """What is known of this moment, by name."""
        return {name: value for name, value in vars(self).items() if isinstance(value, Tensor)}


class Stamps(NamedTuple):
    """When each sensor took its reading [s], by the clock of ``Observation.time``."""

    encoders: float
    joints: float
    pose: float
    """When the picture was taken; a pose that is repeated keeps its old stamp."""
    fingertips: float


@dataclass(frozen=True)
class Observation:
    """What the sensors say, in SI units and the hand frame.

    A driver that gives neither ``time`` nor ``stamps`` is undated: nobody can see that it repeats itself
    but by equal readings.

    Raises:
        NonFiniteError: any entry is NaN or infinite.
        ParameterError: one that is no tensor.
    """

    q: Float[Tensor, " n_q"]
    """Estimated joint angles [rad] (Hall sensors)."""
    a: Float[Tensor, " n_a"]
    """Actuator encoders [rad]."""
    position: Float[Tensor, " 3"]
    """Object point o [m] (markers)."""
    rotation: Float[Tensor, "3 3"]
    """Object orientation R, object frame to hand frame."""
    fingertip_force: Float[Tensor, " n_pads"] | None = None
    """Normal force of each contact pad [N], in the order of ``HandDescription.pads``; None: no sensors."""
    time: float = 0.0
    """When this was put together [s], by a clock that does not go back."""
    status: PlantStatus = PlantStatus.HELD
    info: dict[str, Any] = field(default_factory=dict)
    """Anything else, such as raw readings for a log."""
    truth: Truth | None = None
    """Of a simulation: for reports only."""
    stamps: Stamps | None = None
    """When each sensor took its reading; None: all at ``time``."""

    def __post_init__(self) -> None:
        for name in ("q", "a", "position", "rotation", "fingertip_force"):
            value = getattr(self, name)
            if value is None and name == "fingertip_force":
                continue
            name = f"Observation.{name}"
            check_finite(name, check_kind(name, value, torch.Tensor, "a torch tensor"))

    @property
    def taken(self) -> Stamps:
        """When each sensor took its reading [s]."""
        return Stamps(*(self.time,) * 4) if self.stamps is None else self.stamps

    @property
    def dated(self) -> bool:
        """Whether the driver gave ``time`` or ``stamps``."""
        return self.time != 0.0 or self.stamps is not None

    @cached_property
    def state(self) -> GraspState:
        """Joint angles and object pose, as measured."""
        return GraspState(self.q, self.position, self.rotation)
