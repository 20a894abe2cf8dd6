"""What a grasp can do: ranks, null spaces, classes, force closure, quality. Pure functions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from .._extras import require
from ..exceptions import ParameterError
from ..typing import Float, Tensor
from .contact_kinematics import ContactKinematics, constraint_matrix, grasp_matrix
from .forces.friction import directions, friction_cones


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


def state_scale(
    n_q: int, length: float, dtype: torch.dtype = torch.float64, device: torch.device | None = None
) -> Float[Tensor, " n_s"]:
    """``ds = scale * ds'`` makes translations as large as rotations: 1, L, 1."""
    if not length > 0:
        raise ParameterError("length", length, "positive [m]")
    scale = torch.ones(n_q + 6, dtype=dtype, device=device)
    scale[n_q : n_q + 3] = length
    return scale


def null_space(
    A: Float[Tensor, "n_h n_s"], n_q: int, length: float = 0.03, tolerance: float = 1e-8
) -> Float[Tensor, "n_s n_s-r"]:
    """Basis R of ``A R = 0``, orthonormal in scaled coordinates (SVD).

    The rank is decided with translations in units of ``length`` [m] and rows of equal norm, at
    ``tolerance`` relative to the largest singular value.
    """
    scale = state_scale(n_q, length, A.dtype, A.device)
    scaled = A * scale
    norm = torch.linalg.vector_norm(scaled, dim=-1, keepdim=True)
    scaled = scaled / torch.where(norm > 0, norm, torch.ones_like(norm))
    _, sigma, Vh = torch.linalg.svd(scaled, full_matrices=True)
    rank = int((sigma > tolerance * sigma.amax()).sum()) if sigma.numel() else 0
    return scale[:, None] * Vh[rank:].mT


def scaled_grasp_matrix(kin: ContactKinematics, length: float = 0.03) -> Float[Tensor, "6 n_h"]:
    """G with moments of the wrench and of the contacts divided by ``length``: all entries of order 1."""
    G = grasp_matrix(kin)
    rows = torch.ones(6, dtype=G.dtype, device=G.device)
    rows[3:] = 1 / length
    columns = torch.tensor(
        [length if row % 6 >= 3 else 1.0 for row in kin.rows], dtype=G.dtype, device=G.device
    )
    return rows[:, None] * G * columns


def analyse(
    kin: ContactKinematics,
    actuation: Float[Tensor, "n_a n_q"],
    *,
    length: float = 0.03,
    tolerance: float = 1e-8,
    planar: bool = False,
) -> GraspAnalysis:
    """Ranks and classes of one grasp (no batch).

    Args:
        kin: its contacts.
        actuation: J_a.
        length: size of the object [m].
        tolerance: of the rank decisions.
        planar: count only motions in the plane of the contacts' ``n`` and ``t1`` (translations in it and
            the rotation about its normal), as in a planar hand.
    """
    A, n_q = constraint_matrix(kin), actuation.shape[-1]
    pose = torch.eye(6, dtype=A.dtype, device=A.device)
    if planar:
        plane = torch.linalg.cross(kin.frame[0, :, 0], kin.frame[0, :, 1])
        tangents = torch.linalg.svd(plane[None])[2][1:].mT
        pose = A.new_zeros(6, 3)
        pose[:3, :2], pose[3:, 2] = tangents, plane
    pose_scaled = pose.clone()
    pose_scaled[:3] *= length
    basis = torch.block_diag(torch.eye(n_q, dtype=A.dtype, device=A.device), pose_scaled)
    row = torch.tensor([1 / length if r % 6 < 3 else 1.0 for r in kin.rows], dtype=A.dtype, device=A.device)
    A_s = row[:, None] * (A @ basis)
    arm = torch.linalg.vector_norm(actuation, dim=-1, keepdim=True).clamp_min(1e-12)
    B_s = torch.cat([actuation / arm, actuation.new_zeros(len(actuation), pose.shape[1])], dim=-1)

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


def primitive_wrenches(
    kin: ContactKinematics, *, length: float = 0.03, faces: int = 16
) -> Float[Tensor, "k 6"]:
    """Wrenches ``(f; m/L)`` about o of the edges of every friction cone, unit normal force."""
    G = scaled_grasp_matrix(kin, length).detach().double().cpu().numpy()
    cones = friction_cones(
        kin.models, kin.contacts.friction.tolist(), kin.contacts.torsional_friction.tolist()
    )
    edges = []
    for cone in cones:
        d, _ = directions(cone.dim, faces)
        for u in d if cone.dim else [np.zeros(0)]:
            mu = np.zeros(G.shape[1])
            mu[cone.start] = 1.0
            mu[cone.start + 1 : cone.start + 1 + cone.dim] = cone.mu_s * u / cone.scale
            if cone.dim == 3:
                mu[cone.start + 3] /= length  # the column of G is scaled by L
            edges.append(G @ mu)
    return torch.from_numpy(np.stack(edges))


def ferrari_canny(
    kin: ContactKinematics, *, length: float = 0.03, faces: int = 16, planar: bool = False
) -> float:
    """epsilon: the smallest wrench, in any direction, that unit normal forces in all cannot resist.

    Radius of the largest ball about 0 inside the convex hull of the primitive wrenches (Ferrari and
    Canny, Planning optimal grasps, ICRA 1992, L1 version; moments divided by ``length``). 0 where the
    hull has no interior or 0 lies outside: no force closure.
    """
    wrenches = primitive_wrenches(kin, length=length, faces=faces).numpy()
    if planar:
        plane = torch.linalg.cross(kin.frame[0, :, 0], kin.frame[0, :, 1])
        tangents = torch.linalg.svd(plane[None])[2][1:].numpy()
        wrenches = np.hstack([wrenches[:, :3] @ tangents.T, wrenches[:, 3:] @ plane.numpy()[:, None]])
    spatial = require("scipy.spatial")
    if len(wrenches) <= wrenches.shape[1] or np.linalg.matrix_rank(wrenches, 1e-9) < wrenches.shape[1]:
        return 0.0
    try:
        hull = spatial.ConvexHull(wrenches)
    except spatial.QhullError:
        return 0.0
    return max(0.0, float((-hull.equations[:, -1]).min()))


def has_force_closure(kin: ContactKinematics, *, length: float = 0.03, planar: bool = False) -> bool:
    """Any wrench can be balanced by forces inside the friction cones (16-sided, inscribed)."""
    return ferrari_canny(kin, length=length, planar=planar) > 1e-6
