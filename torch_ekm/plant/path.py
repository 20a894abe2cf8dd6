"""A movement of the motors through waypoints."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from .._checks import check_finite, check_positive
from ..exceptions import ParameterError, ShapeError
from ..typing import Float, Tensor

_LEAST = 0.01  # [s] of a piece: no bus takes goals faster


@dataclass(frozen=True, eq=False)
class Path:
    """``a(t) = a_0 + w_k + (t - t_k) / (t_k+1 - t_k) (w_k+1 - w_k)``: straight from one waypoint to the next.

    Raises:
        ShapeError: waypoints are not ``(n, n_a)`` with n of 1 or more, or times not ``(n,)``.
        NonFiniteError: an entry is NaN or infinite.
        ParameterError: times do not increase from above 0 on.
    """

    waypoints: Float[Tensor, "n n_a"]
    """Set-points w relative to the encoders before the movement [rad]; the last is its end."""
    times: Float[Tensor, " n"]
    """When each is passed, after the start [s]. A plant whose servos are slower takes longer."""

    def __post_init__(self) -> None:
        for name in ("waypoints", "times"):
            value = torch.as_tensor(getattr(self, name)).detach().to("cpu", torch.float64)
            check_finite(name, value)
            object.__setattr__(self, name, value)
        if self.waypoints.ndim != 2 or not len(self.waypoints):
            raise ShapeError("waypoints", "(n, n_a), n of 1 or more", tuple(self.waypoints.shape))
        if self.times.shape != self.waypoints.shape[:1]:
            raise ShapeError("times", f"({len(self.waypoints)},)", tuple(self.times.shape))
        if not bool((self.durations > 0).all()):
            raise ParameterError("times", self.times.tolist(), "increasing, the first above 0 [s]")

    @classmethod
    def through(cls, waypoints: Float[Tensor, "n n_a"], speed: float) -> Path:
        """The motor that goes farthest in a piece goes at ``speed`` [rad/s]; no piece is below 0.01 s.

        Raises:
            ShapeError, NonFiniteError, ParameterError: see :class:`Path`, or the speed is not positive.
        """
        path = cls(waypoints, torch.arange(1.0, len(waypoints) + 1))
        seconds = path.pieces.abs().amax(1) / check_positive("speed", speed)
        object.__setattr__(path, "times", seconds.clamp(min=_LEAST).cumsum(0))  # looked at already
        return path

    @property
    def pieces(self) -> Float[Tensor, "n n_a"]:
        """From waypoint to waypoint, the first from where the motors are [rad]."""
        return self.waypoints.diff(dim=0, prepend=torch.zeros_like(self.waypoints[:1]))

    @property
    def durations(self) -> Float[Tensor, " n"]:
        """Of the pieces [s]."""
        return self.times.diff(prepend=self.times.new_zeros(1))
