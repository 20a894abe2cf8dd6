"""What a grasp can do: ranks, and the classes that follow from them."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from ..typing import Float, Tensor
from .contact_kinematics import ContactKinematics, ContactModel, constraint_matrix
from .contact_set import CHARACTERISTIC_LENGTH

_TOLERANCE = 1e-8  # of the rank decisions


@dataclass(frozen=True)
class GraspAnalysis:
    """Ranks of one grasp; every rank is decided on matrices scaled by the object's size.

    Names after Prattichizzo and Trinkle, Grasping, Springer Handbook of Robotics, 2008.
    """

    mobility: int
    """dim null A: degrees of freedom of hand and object that the contacts leave."""
    internal_forces: int
    """dim null G: contact force combinations that cancel on the object."""
    undetermined_forces: int
    """n_h + n_a - rank [A; B]: combinations of contact and actuator forces that equilibrium leaves open."""
    indeterminate: bool
    """null G^T: some object motion does not show at the contacts."""


def analyse(kin: ContactKinematics, actuation: Float[Tensor, "n_a n_q"]) -> GraspAnalysis:
    """Ranks and classes of one grasp (no batch); of a planar hand: of forces and motions in the plane.

    Args:
        kin: its contacts.
        actuation: J_a.
    """
    A, n_q, L = constraint_matrix(kin), actuation.shape[-1], CHARACTERISTIC_LENGTH
    scale = A.new_ones(n_q + 6)
    scale[n_q : n_q + 3] = L
    row = torch.tensor([1 / L if r % 6 < 3 else 1.0 for r in kin.rows], dtype=A.dtype, device=A.device)
    A_s = row[:, None] * A * scale
    # the plane's normal is each contact's second tangent
    if {*kin.models} == {ContactModel.PLANAR_POINT_WITH_FRICTION}:
        n, t, normal = kin.frame[0].unbind(-1)
        plane = A.new_zeros(6, 3)
        plane[:3, 0], plane[:3, 1], plane[3:, 2] = n, t, normal
        A_s = torch.cat([A_s[:, :n_q], A_s[:, n_q:] @ plane], dim=-1)
    arm = torch.linalg.vector_norm(actuation, dim=-1, keepdim=True).clamp_min(1e-12)
    B_s = torch.cat([actuation / arm, actuation.new_zeros(len(actuation), A_s.shape[1] - n_q)], dim=-1)

    def rank(matrix: Tensor) -> int:
        return int(torch.linalg.matrix_rank(matrix, rtol=_TOLERANCE)) if matrix.numel() else 0

    G_s = A_s[:, n_q:].mT
    n_h, n_p = G_s.shape[1], G_s.shape[0]
    rank_G = rank(G_s)
    return GraspAnalysis(
        mobility=A_s.shape[1] - rank(A_s),
        internal_forces=n_h - rank_G,
        undetermined_forces=n_h + len(actuation) - rank(torch.cat([A_s, B_s])),
        indeterminate=rank_G < n_p,
    )
