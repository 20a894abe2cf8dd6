"""Weights and forms of the force problem."""

from __future__ import annotations

import math
from dataclasses import dataclass

from ...exceptions import ParameterError

FRICTION = ("cuts", "cone", "pyramid_inner", "pyramid_outer")
BALANCE = ("relaxed", "equality")


@dataclass(frozen=True)
class ForceOptions:
    """Weights and forms of the force problem.

    Raises:
        ParameterError: a value outside its range.
    """

    force_weight: float = 1e-7
    """eps: weight of |mu|^2 against the squared, whitened joint residual [1/N^2]."""
    actuator_weight: float = 1.0
    """k: weight of |lam r/L|^2 relative to |mu|^2, r the norm of the actuator's moment arms."""
    torque_std: float = 0.02
    """Standard deviation of unmodelled joint torque, Sigma_tau^(1/2) [N m]."""
    length: float = 0.03
    """L: moments are divided by it [m]."""
    min_normal: float = 0.0
    """Lower bound of every normal force [N]."""
    max_force: float = 1e3
    """Upper bound of every normal force [N]."""
    max_actuator: float = math.inf
    """Bound of every actuator force [N or N m]."""
    friction: str = "cuts"
    """"cuts": exact, cutting planes on QPs; "cone": exact, one conic program (Clarabel); "pyramid_inner",
    "pyramid_outer": polyhedra with ``faces`` faces."""
    faces: int = 16
    balance: str = "relaxed"
    """"relaxed": joint balance soft; "equality": both balances hard (the paper's form)."""
    tolerance: float = 2e-7
    """Largest friction violation left by cutting planes [N]."""
    max_cuts: int = 30
    solver: str = "piqp"
    """QP solver, one of qpsolvers' names."""

    def __post_init__(self) -> None:
        if self.friction not in FRICTION:
            raise ParameterError("friction", self.friction, f"one of {', '.join(FRICTION)}")
        if self.balance not in BALANCE:
            raise ParameterError("balance", self.balance, f"one of {', '.join(BALANCE)}")
        for name in ("force_weight", "torque_std", "length", "tolerance"):
            if not getattr(self, name) > 0:
                raise ParameterError(name, getattr(self, name), "positive")
        if self.faces < 4:
            raise ParameterError("faces", self.faces, "at least 4 (16 or more advised)")
