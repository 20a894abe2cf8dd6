"""How normal forces and friction margins answer to the actuators: rows for a controller."""

from __future__ import annotations

from typing import Any

import torch

from .._arrays import namespace
from ..contact.contact_kinematics import ContactKinematics
from ..contact.contact_model import ContactModel
from ..typing import AnyArray, Float
from .grasp_forces import GraspForces


def sensitivities(
    kin: ContactKinematics,
    forces: GraspForces,
    J: Float[AnyArray, "*batch n_s n_a"],
    dmu: Float[AnyArray, "*batch n_h n_a"],
) -> dict[str, Any]:
    """Fields of a :class:`~torch_ekm.model.Linearization` that follow from J_m and dmu/da."""
    df, dn = force_change(kin, dmu), normal_motion(kin, J)
    normal = _of_normals(kin, forces, df, dn)
    found = {
        "manipulation_jacobian": J,
        "contact_force_sensitivity": dmu,
        "normal_force_sensitivity": normal,
        "margin_sensitivity": _of_margins(kin, forces, dmu, df, dn, normal),
        "force_vector_sensitivity": df,
        "normal_motion": dn,
    }
    tensors = {name: torch.as_tensor(part) for name, part in found.items()}
    return {**tensors, "normal_rows": tuple(kin.normal_rows)}


def normal_motion(
    kin: ContactKinematics, J: Float[AnyArray, "*batch n_s n_a"]
) -> Float[AnyArray, "*batch n_c 3 n_a"]:
    """``d n_i/da = w_o x n_i + K_o sdot_i``, ``sdot_i = M_i (w_rel x n_i)``: turning of the normals."""
    w_o = J[..., None, -3:, :]
    w_rel = kin.relative_spin @ J[..., None, :, :]
    return -(kin.normal_hat @ w_o) - (kin.contacts.object_curvature @ kin.roll) @ w_rel


def force_change(
    kin: ContactKinematics, dmu: Float[AnyArray, "*batch n_h n_a"]
) -> Float[AnyArray, "*batch n_c 3 n_a"]:
    """``C_i dmu_i``: change of the force vectors in hand axes."""
    n_c, (*batch, _, n_a) = kin.contacts.n_c, dmu.shape
    full = namespace(dmu).zeros((*batch, 6 * n_c, n_a), dtype=dmu.dtype, device=dmu.device)
    full[..., kin.row_index, :] = dmu
    return kin.frame @ full.reshape(*batch, n_c, 6, n_a)[..., :3, :]


def _of_normals(
    kin: ContactKinematics, forces: GraspForces, df: AnyArray, dn: AnyArray
) -> Float[AnyArray, "*batch n_c n_a"]:
    """``d f_n/da = n_in . df + f . d n_in`` [N/rad]; ``dn`` from :func:`normal_motion`."""
    normal, force = kin.contacts.normal[..., None, :], forces.force[..., None, :]
    return -(normal @ df + force @ dn)[..., 0, :]


def _of_margins(
    kin: ContactKinematics, forces: GraspForces, dmu: AnyArray, df: AnyArray, dn: AnyArray, normal: AnyArray
) -> Float[AnyArray, "*batch n_c n_a"]:
    """``d (mu_s f_n - |u|)/da``, ``u = [f_t; m_n mu_s/gamma]`` [N/rad]; ``d|u|`` counts as 0 at u = 0."""
    mu_s, gamma = kin.contacts.friction, kin.contacts.torsional_friction
    n_in = -kin.contacts.normal
    f_t = forces.force - forces.normal[..., None] * n_in
    df_t = df + forces.normal[..., None, None] * dn
    square, product = (f_t * f_t).sum(-1), (f_t[..., None, :] @ df_t)[..., 0, :]
    soft = [i for i, model in enumerate(kin.models) if model is ContactModel.SOFT_FINGER]
    if soft:
        at = [kin.normal_rows[i] + 3 for i in soft]
        scale2 = (mu_s[soft] / gamma[soft].clip(1e-9)) ** 2
        moment = forces.spin_moment[..., soft]
        square[..., soft] += scale2 * moment**2
        product[..., soft, :] += (scale2 * moment)[..., None] * dmu[..., at, :]
    xp = namespace(square)
    size = xp.sqrt(square)[..., None]
    slope = xp.where(size > 1e-9, product / size.clip(1e-9), 0.0)
    return mu_s[:, None] * normal - slope
