"""How normal forces and friction margins answer to the actuators: rows for a controller."""

from __future__ import annotations

import torch

from ..contact.contact_kinematics import ContactKinematics
from ..contact.contact_model import ContactModel
from ..typing import Float, Tensor
from .grasp_forces import GraspForces


def normal_motion(
    kin: ContactKinematics, J: Float[Tensor, "*batch n_s n_a"]
) -> Float[Tensor, "*batch n_c 3 n_a"]:
    """``d n_i/da = w_o x n_i + K_o sdot_i``, ``sdot_i = M_i (w_rel x n_i)``: turning of the normals."""
    w_o = J[..., None, -3:, :]
    w_rel = kin.relative_spin @ J[..., None, :, :]
    return -(kin.normal_hat @ w_o) - (kin.contacts.object_curvature @ kin.roll) @ w_rel


def force_change(
    kin: ContactKinematics, dmu: Float[Tensor, "*batch n_h n_a"]
) -> Float[Tensor, "*batch n_c 3 n_a"]:
    """``C_i dmu_i``: change of the force vectors in hand axes."""
    full = dmu.new_zeros(*dmu.shape[:-2], 6 * kin.contacts.n_c, dmu.shape[-1])
    full = full.index_copy(-2, kin.row_index, dmu)
    return kin.frame @ full.unflatten(-2, (kin.contacts.n_c, 6))[..., :3, :]


def normal_sensitivity(
    kin: ContactKinematics, forces: GraspForces, df: Tensor, dn: Tensor
) -> Float[Tensor, "*batch n_c n_a"]:
    """``d f_n/da = n_in . df + f . d n_in`` [N/rad]; ``dn`` from :func:`normal_motion`."""
    normal, force = kin.contacts.normal[..., None, :], forces.force[..., None, :]
    return -(normal @ df + force @ dn)[..., 0, :]


def margin_sensitivity(
    kin: ContactKinematics, forces: GraspForces, dmu: Tensor, df: Tensor, dn: Tensor, normal: Tensor
) -> Float[Tensor, "*batch n_c n_a"]:
    """``d (mu_s f_n - |u|)/da``, ``u = [f_t; m_n mu_s/gamma]`` [N/rad]; ``d|u|`` counts as 0 at u = 0."""
    mu_s, gamma = kin.contacts.friction, kin.contacts.torsional_friction
    n_in = -kin.contacts.normal
    f_t = forces.force - forces.normal[..., None] * n_in
    df_t = df + forces.normal[..., None, None] * dn
    square, product = (f_t * f_t).sum(-1), (f_t[..., None, :] @ df_t)[..., 0, :]
    soft = [i for i, model in enumerate(kin.models) if model is ContactModel.SOFT_FINGER]
    if soft:
        at = [kin.normal_rows[i] + 3 for i in soft]
        scale2 = (mu_s[soft] / gamma[soft].clamp_min(1e-9)) ** 2
        moment = forces.spin_moment[..., soft]
        square[..., soft] += scale2 * moment**2
        product[..., soft, :] += (scale2 * moment)[..., None] * dmu[..., at, :]
    size = square.sqrt()
    slope = torch.where(
        size[..., None] > 1e-9, product / size.clamp_min(1e-9)[..., None], torch.zeros_like(product)
    )
    return mu_s[:, None] * normal - slope
