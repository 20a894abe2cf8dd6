"""Contact forces after an increment: what the next measurement is held against."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch

from ..contact.contact_set import ContactSet
from ..typing import Float, Tensor

if TYPE_CHECKING:
    from .linearization import GraspForces


@dataclass(frozen=True)
class ExpectedForces:
    """Forces ``f + (df/da) da`` of sticking contacts, hand axes, to first order in da."""

    finger: tuple[str, ...]
    """The pad of each contact."""
    force: Float[Tensor, "*batch n_c 3"]
    """f_i' of the finger on the object [N]."""
    spin_moment: Float[Tensor, "*batch n_c"]
    """About the inward normal [N m]."""
    normal: Float[Tensor, "*batch n_c"]
    """``f_n' = f' . n_in'``, n_in' the turned inward normal [N]; below 0 the contact opens."""
    margin: Float[Tensor, "*batch n_c"]
    """``mu_s f_n' - |u'|``, u' = f_t' (soft fingers: with the scaled spin moment) [N]."""
    actuator: Float[Tensor, "*batch n_a"]
    """``-(lam + dlam)``, force of each actuator along +a [N m]."""


def expected_forces(
    contacts: ContactSet, forces: GraspForces, dspin: Tensor, df: Tensor, dn: Tensor, dlam: Tensor
) -> ExpectedForces:
    """Add first-order changes to the forces and read them against the turned normals."""
    force, spin = forces.force + df, forces.spin_moment + dspin
    n_in = -(contacts.normal + dn)
    n_in = n_in / torch.linalg.vector_norm(n_in, dim=-1, keepdim=True)
    normal = (force * n_in).sum(-1)
    f_t = force - normal[..., None] * n_in
    scale = contacts.friction / contacts.torsional_friction.clamp_min(1e-9)
    used = (f_t.square().sum(-1) + (scale * spin).square()).sqrt()
    margin = contacts.friction * normal - used
    return ExpectedForces(contacts.finger, force, spin, normal, margin, -(forces.lam + dlam))
