"""What a grasp can do: ranks, the classes that follow from them, and how much wrench it resists."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from .._extras import require
from ..typing import Float, Tensor
from .contact_kinematics import ContactKinematics, constraint_matrix, grasp_matrix
from .contact_model import ContactModel
from .contact_set import CHARACTERISTIC_LENGTH
from .forces.friction import friction_cones, outer_directions


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
    graspable: bool
    """null G: there are internal forces."""
    redundant: bool
    """null J_h: joint motions that do not show at the contacts."""
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
    """Ranks and classes of one grasp (no batch); of a planar hand: of forces and motions in the plane.

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
    if _planar(kin):  # the plane's normal is each contact's second tangent
        n, t, normal = kin.frame[0].unbind(-1)
        plane = A.new_zeros(6, 3)
        plane[:3, 0], plane[:3, 1], plane[3:, 2] = n, t, normal
        A_s = torch.cat([A_s[:, :n_q], A_s[:, n_q:] @ plane], dim=-1)
    arm = torch.linalg.vector_norm(actuation, dim=-1, keepdim=True).clamp_min(1e-12)
    B_s = torch.cat([actuation / arm, actuation.new_zeros(len(actuation), A_s.shape[1] - n_q)], dim=-1)

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


def _planar(kin: ContactKinematics) -> bool:
    return bool(kin.models) and all(m is ContactModel.PLANAR_POINT_WITH_FRICTION for m in kin.models)


def ferrari_canny(kin: ContactKinematics, *, length: float = CHARACTERISTIC_LENGTH, faces: int = 64) -> float:
    """epsilon [N]: the smallest wrench, in any direction, that 1 N of normal forces in all cannot resist.

    Radius of the largest ball about 0 in the convex hull of the wrenches ``(f; m/L)`` of a unit normal force
    with friction at its limit (Ferrari and Canny, Planning optimal grasps, ICRA 1992, L1 version). 0: no
    force closure, as of nothing. In a planar hand: of wrenches in the plane.

    Args:
        kin: the contacts of one grasp.
        length: L, by which moments are divided [m].
        faces: of the polyhedron inside a friction cone (a soft finger's has 26).
    """
    scale = np.array([1.0, 1.0, 1.0, *[1 / length] * 3])
    G = scale[:, None] * grasp_matrix(kin).detach().double().cpu().numpy()
    contacts = kin.contacts
    cones = friction_cones(kin.models, contacts.friction.tolist(), contacts.torsional_friction.tolist())
    angle = 2 * np.pi * np.arange(faces) / faces
    wrenches = [np.zeros((0, 6))]
    for cone in cones:
        u = np.stack([np.cos(angle), np.sin(angle)], -1) if cone.dim == 2 else outer_directions(cone.dim)
        u = u if cone.dim else np.zeros((1, 0))
        tangential = G[:, cone.start + 1 : cone.start + 1 + cone.dim]
        wrenches.append(G[:, cone.start] + cone.mu_s * (u / cone.scale) @ tangential.T)
    points = np.concatenate(wrenches)
    if _planar(kin):
        points = points @ np.linalg.svd(points)[2][:3].T
    if len(points) <= points.shape[1] or np.linalg.matrix_rank(points, 1e-9) < points.shape[1]:
        return 0.0
    return max(0.0, float((-require("scipy.spatial").ConvexHull(points).equations[:, -1]).min()))
