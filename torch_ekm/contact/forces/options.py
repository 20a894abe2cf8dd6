from __future__ import annotations

from dataclasses import dataclass, fields

from ..._checks import check_positive
from ..._noise import NOISE


@dataclass(frozen=True)
class ForceOptions:
    """Standard deviations of the force problem, all of them positive.

    Raises:
        ParameterError: a value outside its range.
    """

    torque_std: float = 0.01
    """Standard deviation of unmodelled joint torque, Sigma_tau^(1/2) [N m]."""
    normal_std: float = NOISE.force
    """Standard deviation of a measured normal force [N]."""
    start_std: float = 1.5
    """Standard deviation of a contact force of which nothing is known yet, per axis [N]."""

    def __post_init__(self) -> None:
        for field in fields(self):
            check_positive(field.name, getattr(self, field.name))
