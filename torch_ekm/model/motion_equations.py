"""The equations of motion of one state, which can be solved again with other figures of the hand."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch

from .._arrays import is_plain, like
from ..typing import Bool, Float, Tensor
from .arms import SAME, Arms
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
    arms: Arms = SAME
    """Moment arms and loops at the posture."""

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
        D.diagonal()[:n_q] += springs
        return Motion(self, D, drives)


class Motion:
    """``ds = J_m w`` of one state and one set of figures, and its derivative by the figures."""

    def __init__(self, of: MotionEquations, D: Tensor, drives: Drives) -> None:
        reduction, self._n_h, self._arms = of.reduction, len(of.rows), of.arms
        plain = is_plain(D, of.constraints, *drives)
        given = (D, of.constraints, of.held, of.slack, *drives)
        stiffness, A, held, slack, J_a, K_a = (x.numpy() if plain else x for x in given)
        self._S, self._drives = like(reduction.scaled_basis, stiffness), Drives(J_a, K_a)
        self._system = system = reduction.reduced(
            stiffness, A, list(of.rows), held, slack, self._drives, of.arms
        )
        self._step = two_stage(system.D, system.E, system.R, system.F, actuators=reduction.actuators)
        self.jacobian: Float[Tensor, "n_s n_a"] = torch.as_tensor(self._S @ self._step.motion)
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
        motion, reaction = self._step.adjoint(system.D, S[rows].mT)
        (J_a, K_a), arms_at = self._drives, self._arms
        J_a = arms_at.of(J_a)
        n_q = J_a.shape[1]
        w = like(moved, S)
        ds = (S @ (self._step.motion @ w))[:n_q]
        dlam = system.actuator_force(self._step, n_h) @ w
        y = (S[:n_q] @ motion).mT  # (n_r, n_q)
        along = y @ J_a.mT
        pull = 0 * along  # what a row answers to a change of each tendon's length
        stiffness = 0 * along
        soft, rigid = system.soft, system.rigid
        pull[:, soft] = along[:, soft] * K_a[soft]
        pull[:, rigid] = (reaction[n_h : n_h + len(rigid)] / system.arm).mT
        stiffness[:, soft] = -along[:, soft] * (dlam[soft] / K_a[soft])
        arms = -(dlam[:, None] * y[:, None, :] + pull[..., None] * ds)
        arms = arms_at.of(arms)
        return FigureDerivative(*map(torch.as_tensor, (-y * ds, arms, stiffness)))
