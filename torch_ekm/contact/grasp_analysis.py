"""What a grasp can do: ranks and the classes that follow from them."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from ..typing import Float, Tensor
from .contact_kinematics import ContactKinematics, constraint_matrix
from .contact_set import CHARACTERISTIC_LENGTH


@dataclass(frozen=True)
class GraspAnalysis:
    """Ranks of one grasp; every rank is decided on matrices scaled by the object's size.

    Names after Prattichizzo and Trinkle, Grasping, Springer Handbook of Robotics, 2008.
    """

    mobility: int
    """dim null A: freedoms of hand and object that the contacts leave."""
    internal_forces: int
    """dim null G: contact force combinations that cancel on the object."""
    undetermined_forces: int
    """n_h + n_a - rank [A; B]: combinations of contact and actuator forces that equilibrium leaves open."""
    indeterminate: bool
    """null G^T: some object motion is not felt by the contacts."""
    graspable: bool
    """null G: there are internal forces."""
    redundant: bool
    """null J_h: joint motions that the contacts do not feel."""
    defective: bool
    """null J_h^T: contact forces that the structure bears without joint torque."""
    smallest_singular_value: float
    """Of the scaled G: how far the grasp is from losing a direction."""


def analyse(
    kin: ContactKinematics,
    actuation: Float[Tensor, "n_a n_q"],
    *,
    length: float = CHARACTERISTIC_LENGTH,
    tolerance: float = 1e-8,
) -> GraspAnalysis:
    """Ranks and classes of one grasp (no batch).

    Args:
        kin: its contacts.
        actuation: J_a.
        length: size of the object [m].
        tolerance: of the rank decisions.
    """
    A, n_q = constraint_matrix(kin), actuation.shape[-1]
    scale = A.new_ones(n_q + 6)
    scale[n_q : n_q + 3] = length
    row = torch.tensor([1 / length if r % 6 < 3 else 1.0 for r in kin.rows], dtype=A.dtype, device=A.device)
    A_s = row[:, None] * A * scale
    arm = torch.linalg.vector_norm(actuation, dim=-1, keepdim=True).clamp_min(1e-12)
    B_s = torch.cat([actuation / arm, actuation.new_zeros(len(actuation), 6)], dim=-1)

    def rank(matrix: Tensor) -> int:
        return int(torch.linalg.matrix_rank(matrix, rtol=tolerance)) if matrix.numel() else 0

    G_s, J_s = A_s[:, n_q:].mT, A_s[:, :n_q]
    n_h, n_p = G_s.shape[1], G_s.shape[0]
    rank_G, rank_J = rank(G_s), rank(J_s)
    return GraspAnalysis(
        mobility=A_s.shape[1] - rank(A_s),
        internal_forces=n_h - rank_G,
        undetermined_forces=n_h + len(actuation) - rank(torch.cat([A_s, B_s])),
        indeterminate=rank_G < n_p,
        graspable=rank_G < n_h,
        redundant=rank_J < n_q,
        defective=rank_J < n_h,
        smallest_singular_value=float(torch.linalg.svdvals(G_s)[n_p - 1]) if n_h >= n_p else 0.0,
    )
