"""Contact forces after an increment, and how sure they are: what the next measurement is weighed against.

Contact forces are stacked as ``[f_1; m_1; f_2; m_2; ..]``, f_i in hand axes [N], m_i the spin moment [N m]:
``4 n_c`` entries, which do not depend on contact frames.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from ..contact.contact_set import CHARACTERISTIC_LENGTH, ContactSet
from ..contact.forces.options import ForceOptions
from ..typing import Float, Tensor

_ANY_FORCE = 10.0  # [N] standard deviation of a normal force of which nothing is known


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
    covariance: Float[Tensor, "*batch m m"]
    """Of the stacked contact forces, m = 4 n_c: that before the increment and what the increment adds."""
    margin_std: Float[Tensor, "*batch n_c"]
    """Standard deviation of ``margin`` [N]."""


def friction_use(
    contacts: ContactSet, force: Tensor, spin: Tensor, normal: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """``f_n``, ``mu_s f_n - |u|`` [N] and the margin's gradient ``(*batch, n_c, 4)`` in ``[f; m]``.

    Args:
        normal: outward normals of the object.
    """
    n_in, mu_s = -normal, contacts.friction
    f_n = (force * n_in).sum(-1)
    f_t = force - f_n[..., None] * n_in
    scale = mu_s / contacts.torsional_friction.clamp_min(1e-9) * (contacts.torsional_friction > 0)
    u = torch.cat([f_t, (scale * spin)[..., None]], dim=-1)
    size = torch.linalg.vector_norm(u, dim=-1)
    direction = u / size.clamp_min(1e-9)[..., None]
    gradient = torch.cat(
        [mu_s[:, None] * n_in - direction[..., :3], -(scale * direction[..., 3])[..., None]], dim=-1
    )
    return f_n, mu_s * f_n - size, gradient


def margin_std(
    contacts: ContactSet, normal_force: Tensor, gradient: Tensor, covariance: Tensor, options: ForceOptions
) -> Float[Tensor, "*batch n_c"]:
    """``sqrt(g^T Sigma g + (s mu_s f_n)^2)``, g the margin's gradient, s of the friction coefficient [N]."""
    blocks = covariance.unflatten(-1, (-1, 4)).unflatten(-3, (-1, 4))
    own = torch.einsum("...ijik->...ijk", blocks)
    variance = (gradient[..., None, :] @ own @ gradient[..., None])[..., 0, 0]
    return (variance.clamp_min(0.0) + (options.friction_std * contacts.friction * normal_force) ** 2).sqrt()


def start_covariance(
    normal: Float[Tensor, "*batch n_c 3"], options: ForceOptions
) -> Float[Tensor, "*batch m m"]:
    """``start_std^2`` across the normals, any force along them; ``(start_std L)^2`` for spin moments."""
    eye = torch.eye(3, dtype=normal.dtype, device=normal.device)
    along = normal[..., None] * normal[..., None, :]
    blocks = normal.new_zeros(*normal.shape[:-1], 4, 4)
    blocks[..., :3, :3] = options.start_std**2 * (eye - along) + _ANY_FORCE**2 * along
    blocks[..., 3, 3] = (options.start_std * CHARACTERISTIC_LENGTH) ** 2
    m = 4 * normal.shape[-2]
    spread = torch.eye(normal.shape[-2], dtype=normal.dtype, device=normal.device)
    return torch.einsum("...iab,ij->...iajb", blocks, spread).reshape(*normal.shape[:-2], m, m)


def drift(
    df: Float[Tensor, "*batch n_c 3"], dspin: Tensor, options: ForceOptions
) -> Float[Tensor, "*batch m"]:
    """Variance that an increment adds: ``drift_std^2 + (change_std |df_i|)^2``, moments likewise."""
    change = torch.cat([df.norm(dim=-1, keepdim=True).expand_as(df), dspin[..., None]], dim=-1)
    one = torch.tensor([1.0, 1.0, 1.0, CHARACTERISTIC_LENGTH], dtype=df.dtype, device=df.device)
    least = (options.drift_std * one).expand(*df.shape[:-1], 4).flatten(-2)
    return least.square() + (options.change_std * change.flatten(-2)).square()
