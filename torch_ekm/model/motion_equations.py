"""The equations of motion of one state, which can be solved again with other figures of the hand."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch

from ..typing import Bool, Float, Tensor
from .manipulation import two_stage
from .reduction import Drives, Reduction


class FigureDerivative(NamedTuple):
    """Derivative of some rows of ``ds = J_m w`` with respect to the figures of the hand, ``(n_r, ...)``."""

    springs: Float[Tensor, "n_r n_q"]
    """By the stiffness of each joint's spring [per N m/rad]."""
    moment_arms: Float[Tensor, "n_r n_a n_q"]
    """By each entry of J_a."""
    stiffness: Float[Tensor, "n_r n_a"]
    """By K_a of each actuator [per N m/rad]; 0 of rigid ones and of slack tendons."""


@dataclass(frozen=True)
class MotionEquations:
    """``D ds + A^T dmu + J_a^T dlam = 0``, ``A ds = 0``, ``dlam = K_a (J_a ds - w)`` of one state.

    Contact forces, held joints and slack tendons are those that were found with the described figures.
    """

    reduction: Reduction
    stiffness: Float[Tensor, "n_s n_s"]
    """D, with the described springs."""
    constraints: Float[Tensor, "n_h n_s"]
    """A."""
    rows: tuple[int, ...]
    """Which of the 6 n_c contact components are the rows of A."""
    held: Bool[Tensor, " n_q"]
    slack: Bool[Tensor, " n_a"]
    moving: Bool[Tensor, " n_q"]
    """Joints of the fingers that touch."""

    def solve(self, springs: Float[Tensor, " n_q"], drives: Drives) -> Motion:
        """J_m with other figures.

        Args:
            springs: their change against the described ones [N m/rad].
            drives: moment arms and stiffnesses of the actuators.

        Raises:
            SingularGraspError: a motion meets no stiffness.
            UnstableGraspError: the grasp buckles with these figures.
        """
        n_q = len(springs)
        D = self.stiffness.clone()
        D[:n_q, :n_q] += torch.diag(springs)
        return Motion(self, D, drives)


class Motion:
    """``ds = J_m w`` of one state and one set of figures, and its derivative by the figures."""

    def __init__(self, of: MotionEquations, D: Tensor, drives: Drives) -> None:
        reduction = of.reduction
        self.drives, self._S, self._n_h = drives, reduction.scaled_basis, len(of.rows)
        self._system = system = reduction.reduced(D, of.constraints, list(of.rows), of.held, of.slack, drives)
        self._step = two_stage(system.D, system.E, system.R, system.F, actuators=reduction.actuators)
        self.jacobian: Float[Tensor, "n_s n_a"] = self._S @ self._step.motion
        """J_m."""

    def derivative(self, moved: Float[Tensor, " n_a"], rows: list[int]) -> FigureDerivative:
        """Of the rows of ``J_m w``, in closed form.

        One adjoint solve for each row serves all figures::

            [ D^T  E^T ] [ y  ]   [ e_c ]
            [ E    0   ] [ nu ] = [ 0   ]        d ds_c = -(y, nu)^T (d of the equations at ds, dlam)

        Args:
            moved: w [rad].
            rows: c, indices into ds.
        """
        system, S, n_h = self._system, self._S, self._n_h
        R = system.R.new_zeros(len(system.E), len(rows))
        adjoint = two_stage(system.D.mT.contiguous(), system.E, R, S[rows].mT.contiguous())
        J_a, K_a = self.drives
        n_a, n_q = J_a.shape
        ds = (S @ (self._step.motion @ moved))[:n_q]
        dlam = system.actuator_force(self._step, n_h) @ moved
        y = (S[:n_q] @ adjoint.motion).mT  # (n_r, n_q)
        pull = y.new_zeros(len(rows), n_a)  # what a row answers to a change of each tendon's length
        stiffness = y.new_zeros(len(rows), n_a)
        soft, rigid = system.soft, system.rigid
        along = y @ J_a.mT
        pull[:, soft] = along[:, soft] * K_a[soft]
        pull[:, rigid] = (adjoint.reaction[n_h : n_h + len(rigid)] / system.arm).mT
        stiffness[:, soft] = -along[:, soft] * (dlam[soft] / K_a[soft])
        arms = -(dlam[:, None] * y[:, None, :] + pull[..., None] * ds)
        return FigureDerivative(-y * ds, arms, stiffness)
