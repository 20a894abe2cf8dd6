"""A grasp between two motions: state, contacts and forces, and how a motion changes the three."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import torch

from ..contact.contact_kinematics import ContactKinematics, contact_frames
from ..contact.contact_model import contact_models, selected_rows
from ..contact.contact_set import VARYING, ContactSet
from ..contact.forces.balance import ForceStatus
from ..kinematics.grasp_state import GraspState
from ..kinematics.se3 import exp
from ..model.grasp_forces import GraspForces, friction_use
from ..typing import Float, Tensor

if TYPE_CHECKING:
    from ..model import KinematicModel, Linearization

#: What varies over a batch, with the number of its dimensions for one grasp.
_TAILS: dict[str, dict[str, int]] = {
    "state": {"q": 1, "position": 1, "rotation": 2},
    "contacts": VARYING,
    "forces": {
        "mu": 1, "lam": 1, "force": 2, "spin_moment": 1, "normal": 1, "residual": 1, "stop_torque": 1,
        "margin": 1, "relative_margin": 1, "violation": 0,
    },
}  # fmt: skip


@dataclass(frozen=True)
class Configuration:
    """``z = (s, contacts, forces)``, one or a batch."""

    state: GraspState
    contacts: ContactSet
    forces: GraspForces

    @classmethod
    def of(cls, lin: Linearization) -> Configuration:
        """State, contacts and forces at which the model was linearized, hand frame."""
        return cls(lin.state, lin.contacts, lin.forces)

    def expand(self, *batch: int) -> Configuration:
        """The same for each of a batch; contacts and forces may lack it."""
        return _combined([self], lambda x, tail: x[0].expand((*batch, *x[0].shape[x[0].dim() - tail :])))

    def select(self, k: int) -> Configuration:
        """Number k of the last batch dimension."""
        return _combined([self], lambda x, tail: x[0].select(-tail - 1, k))


def stack(parts: Sequence[Configuration]) -> Configuration:
    """Configurations of one batch one after the other: ``(*batch, len(parts), ...)``."""
    return _combined(parts, lambda x, tail: torch.stack(x, dim=-tail - 1))


def _combined(
    parts: Sequence[Configuration], combine: Callable[[list[Tensor], int], Tensor]
) -> Configuration:
    """``combine`` of all that varies over a batch."""
    pose, contacts, forces = (
        {name: combine([getattr(getattr(z, group), name) for z in parts], n) for name, n in tails.items()}
        for group, tails in _TAILS.items()
    )
    state, first = GraspState(**pose), parts[0]
    combined = _with(first.forces, state.q.shape[:-1], forces)
    return Configuration(state, first.contacts.replace(**contacts), combined)


class Change(NamedTuple):
    """What a motion does to a configuration; a batch of them, or one after the other."""

    ds: Float[Tensor, "*batch n_s"]
    """[dq; do; dphi] [rad, m, rad]"""
    point: Float[Tensor, "*batch n_c 3"]
    """Way of the contact points [m]."""
    object_turn: Float[Tensor, "*batch n_c 3 3"]
    """Of the object's surface, and of its normal, at the contact point."""
    finger_turn: Float[Tensor, "*batch n_c 3 3"]
    force: Float[Tensor, "*batch n_c 3"]
    """Change of each contact force, hand frame [N]."""
    spin_moment: Float[Tensor, "*batch n_c"]
    lam: Float[Tensor, "*batch n_a"]


def change(
    rates: Linearization,
    kin: ContactKinematics,
    action: Float[Tensor, "*batch n_a"],
    correction: Float[Tensor, "*batch n_s"],
) -> Change:
    """``dz = (dz/da) da``, contacts rolling along.

    ```
    ds    = J_m da + g
    dx_i  = (v_f + v_o)/2 + sdot_i                 sdot_i = M_i (w_rel x n_i), w_rel = w_f - w_o
    n_i+  = exp(w_o + n_i x K_o sdot_i) n_i         K_o, K_f turn with the surface that they belong to
    df_i  = (df_i/da) da,   dlam = (dlam/da) da
    ```

    v_f and v_o are the ways of finger and object at the contact point: the same where contacts stick, and not
    where a learner corrects the object's way alone.

    Args:
        rates: of the model.
        kin: the contacts where the rates were taken.
        action: da [rad].
        correction: g(s, da).
    """
    ds = rates.step(action) + correction
    dq, do, w_o = ds.split([ds.shape[-1] - 6, 3, 3], dim=-1)
    dq = dq[..., None, :, None]
    v_f, w_f = (kin.point_jacobian @ dq)[..., 0], (kin.spin_jacobian @ dq)[..., 0]
    w_o = w_o[..., None, :].expand_as(w_f)
    v_o = do[..., None, :] + torch.linalg.cross(w_o, kin.lever.expand_as(w_o))
    run = -(kin.roll @ (w_f - w_o)[..., None])
    n = kin.contacts.normal.expand_as(w_o)
    along_o = torch.linalg.cross(n, (kin.contacts.object_curvature @ run)[..., 0])
    along_f = -torch.linalg.cross(n, (kin.contacts.finger_curvature @ run)[..., 0])
    turns = exp(torch.stack([w_o + along_o, w_f + along_f]))
    force = _times(rates.force_vector_sensitivity, action[..., None, :])
    spin = force.new_zeros(force.shape[:-1])
    soft = [i for i, one in enumerate(kin.models) if len(one.rows) == 4]
    if soft:
        dmu = _times(rates.contact_force_sensitivity, action)
        spin[..., soft] = dmu[..., [kin.normal_rows[i] + 3 for i in soft]]
    lam = _times(rates.actuator_force_sensitivity, action)
    return Change(ds, 0.5 * (v_f + v_o) + run[..., 0], turns[0], turns[1], force, spin, lam)


def settled(z: Configuration) -> Configuration:
    """``f_n >= 0, |f_t| <= mu_s f_n``: with what is left of forces when contacts have slid or opened [N]."""
    n_in = -z.contacts.normal
    pressing = (z.forces.force * n_in).sum(-1, keepdim=True)
    f_n, f_t = pressing.clamp_min(0.0), z.forces.force - pressing * n_in
    size = torch.linalg.vector_norm(f_t, dim=-1, keepdim=True)
    share = (z.contacts.friction[:, None] * f_n / size.clamp_min(1e-9)).clamp(max=1.0)
    force = f_n * n_in + share * f_t
    normal, margin, _ = friction_use(z.contacts, force, z.forces.spin_moment, z.contacts.normal)
    forces = dataclasses.replace(z.forces, force=force, normal=normal, margin=margin)
    return dataclasses.replace(z, forces=forces)


def moved(model: KinematicModel, z: Configuration, dz: Change) -> Configuration:
    """``z (+) dz``. Gaps stay as they are: contacts that touch stay closed."""
    before = z.contacts
    contacts = before.replace(
        point=before.point + dz.point,
        normal=(dz.object_turn @ before.normal[..., None])[..., 0],
        gap=before.gap.expand(dz.point.shape[:-1]),
        object_curvature=dz.object_turn @ before.object_curvature @ dz.object_turn.mT,
        finger_curvature=dz.finger_turn @ before.finger_curvature @ dz.finger_turn.mT,
    )
    force, spin = z.forces.force + dz.force, z.forces.spin_moment + dz.spin_moment
    normal, margin, _ = friction_use(contacts, force, spin, contacts.normal)
    local = (contact_frames(contacts.normal, model.plane).mT @ force[..., None])[..., 0]
    full = torch.cat([local, spin[..., None], torch.zeros_like(local)[..., :2]], dim=-1).flatten(-2)
    rows = selected_rows(contact_models(contacts, planar=model.plane is not None))
    batch = margin.shape[:-1]
    parts = {
        "mu": full[..., rows],
        "lam": z.forces.lam + dz.lam,
        "force": force,
        "spin_moment": spin,
        "normal": normal,
        "residual": z.forces.residual.expand(*batch, -1),
        "stop_torque": z.forces.stop_torque.expand(*batch, -1),
        "margin": margin,
        "relative_margin": margin / (contacts.friction * normal).clamp_min(1e-9),
        "violation": z.forces.violation.expand(batch),
    }
    return Configuration(z.state.plus(dz.ds), contacts, _with(z.forces, batch, parts))


def _times(matrix: Tensor, vector: Tensor) -> Tensor:
    return (matrix @ vector[..., None])[..., 0]


def _with(forces: GraspForces, batch: torch.Size | tuple[int, ...], parts: dict[str, Tensor]) -> GraspForces:
    """Forces of a batch; what is known of their covariance is left out."""
    unsolved = [status for status in forces.status if status is not ForceStatus.SOLVED]
    status = unsolved[0] if unsolved else ForceStatus.SOLVED
    count = int(torch.Size(batch).numel())
    return dataclasses.replace(forces, status=(status,) * count, covariance=None, margin_std=None, **parts)
