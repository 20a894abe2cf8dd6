"""Weights and bounds of the force problem."""

from __future__ import annotations

from dataclasses import dataclass

from ...exceptions import ParameterError


@dataclass(frozen=True)
class ForceOptions:
    """Weights and bounds of the force problem.

    Raises:
        ParameterError: a value outside its range.
    """

    force_weight: float = 1e-7
    """``eps``: weight of ``|mu|^2`` against the squared, whitened joint residual [1/N^2]."""
    actuator_weight: float = 1.0
    """``k``: weight of ``|lam r/L|^2`` relative to ``|mu|^2``, r the norm of the actuator's moment arms."""
    torque_std: float = 0.01
    """Standard deviation of unmodelled joint torque, Sigma_tau^(1/2) [N m]."""
    normal_std: float = 0.3
    """Standard deviation of a measured normal force [N]."""
    actuator_std: float = 0.05
    """Standard deviation of a measured actuator torque [N m] or tension [N]."""
    start_std: float = 1.5
    """Standard deviation of a contact force of which nothing is known yet, per axis [N]."""
    drift_std: float = 0.15
    """Standard deviation of a contact force's drift from its prediction at every motion, per axis [N]."""
    change_std: float = 0.3
    """The same as a share of the predicted change; both add up."""
    friction_std: float = 0.05
    """Relative standard deviation of the friction coefficients, for the margins' standard deviation."""
    min_normal: float = 0.0
    """Lower bound of every normal force [N]."""
    max_normal: float = 1e3
    """Upper bound of every normal force [N]."""

    def __post_init__(self) -> None:
        for name in ("force_weight", "torque_std", "normal_std", "actuator_std", "start_std", "drift_std"):
            if not getattr(self, name) > 0:
                raise ParameterError(name, getattr(self, name), "positive")
