"""Contact forces at a state and after an increment, how sure they are, and how they enter the next problem.

Contact forces are stacked as ``[f_1; m_1; f_2; m_2; ..]``, f_i in hand axes [N], m_i the spin moment [N m]:
``4 n_c`` entries, which do not depend on contact frames.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
import torch

from ..contact.contact_kinematics import ContactKinematics
from ..contact.contact_set import CHARACTERISTIC_LENGTH, ContactSet
from ..contact.forces.balance import BalanceEquations, ForceStatus
from ..contact.forces.options import ForceOptions
from ..exceptions import ShapeError
from ..typing import Array, Float, Tensor

_ANY_FORCE = 10.0  # [N] standard deviation of a normal force of which nothing is known
_DRIFT_STD = 0.15  # [N] of a contact force's drift from its prediction at every motion, per axis
_CHANGE_STD = 0.3  # the same as a share of the predicted change; both add up
_FRICTION_STD = 0.05  # of the friction coefficients, relative


@dataclass(frozen=True)
class GraspForces:
    """Forces at one state, hand frame. Where ``status`` is not SOLVED: those used in their stead."""

    mu: Float[Tensor, "*batch n_h"]
    """Finger on object, contact frames ``[n_in, t1, t2]`` [N], spin moments [N m]."""
    lam: Float[Tensor, "*batch n_a"]
    """Minus the actuator force along +a [N m]; a tendon's tension is ``-lam``."""
    force: Float[Tensor, "*batch n_c 3"]
    """f_i in hand axes [N]."""
    spin_moment: Float[Tensor, "*batch n_c"]
    """About the inward normal [N m]."""
    normal: Float[Tensor, "*batch n_c"]
    """f_n [N]."""
    residual: Float[Tensor, "*batch n_q"]
    """e, unexplained joint torque [N m]: large means a wrong spring, a wrong rest angle, or slipping."""
    stop_torque: Float[Tensor, "*batch n_q"]
    """Torque of joint stops and locks on the joint [N m]."""
    margin: Float[Tensor, "*batch n_c"]
    """``mu_s f_n - |f_t|`` [N] (soft fingers: with the scaled spin moment): 0 at the friction cone."""
    relative_margin: Float[Tensor, "*batch n_c"]
    """``margin / (mu_s f_n)``: 1 without tangential load, 0 at the friction cone."""
    status: tuple[ForceStatus, ...]
    """One per state of the batch."""
    violation: Float[Tensor, "*batch"]
    """Smallest norm of the unbalanced object wrench, moments divided by L [N]."""
    covariance: Float[Tensor, "*batch m m"] | None = None
    """Of the contact forces ``[f_1; m_1; ..]``, hand axes, m = 4 n_c. None where nothing was measured or
    expected: the smallest forces are a choice, not an estimate."""
    margin_std: Float[Tensor, "*batch n_c"] | None = None
    """Standard deviation of ``margin`` [N]; None likewise."""

    @property
    def solved(self) -> bool:
        """Every state of the batch was solved."""
        return all(status is ForceStatus.SOLVED for status in self.status)


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
    contacts: ContactSet, normal_force: Tensor, gradient: Tensor, covariance: Tensor
) -> Float[Tensor, "*batch n_c"]:
    """``sqrt(g^T Sigma g + (s mu_s f_n)^2)``, g the margin's gradient, s of the friction coefficient [N]."""
    blocks = covariance.unflatten(-1, (-1, 4)).unflatten(-3, (-1, 4))
    own = torch.einsum("...ijik->...ijk", blocks)
    variance = (gradient[..., None, :] @ own @ gradient[..., None])[..., 0, 0]
    return (variance.clamp_min(0.0) + (_FRICTION_STD * contacts.friction * normal_force) ** 2).sqrt()


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


def drift(df: Float[Tensor, "*batch n_c 3"], dspin: Tensor) -> Float[Tensor, "*batch m"]:
    """Variance that an increment adds: ``sigma_d^2 + (sigma_c |df_i|)^2``, moments likewise."""
    change = torch.cat([df.norm(dim=-1, keepdim=True).expand_as(df), dspin[..., None]], dim=-1)
    one = torch.tensor([1.0, 1.0, 1.0, CHARACTERISTIC_LENGTH], dtype=df.dtype, device=df.device)
    least = (_DRIFT_STD * one).expand(*df.shape[:-1], 4).flatten(-2)
    return least.square() + (_CHANGE_STD * change.flatten(-2)).square()


class ForcePrior:
    """``N(x^, Sigma)`` of the stacked contact forces, read in the contact frames of the present state.

    Contacts that were not expected begin at 0, with ``start_std`` across the normal and any force along it.

    Args:
        kin: the contacts.
        expected: forces predicted from the state before, of one state or of as many as ``kin`` has.
        options: standard deviations.

    Raises:
        ShapeError: ``expected`` has another batch.
    """

    def __init__(
        self, kin: ContactKinematics, expected: ExpectedForces | None, options: ForceOptions
    ) -> None:
        contacts = kin.contacts
        batch, n_c = contacts.batch_shape, contacts.n_c
        mean = contacts.point.new_zeros(*batch, n_c, 4)
        covariance = start_covariance(contacts.normal, options)
        if expected is not None:
            if expected.force.shape[:-2] not in (batch, ()):
                raise ShapeError("expected.force", f"{(*batch, n_c, 3)}", expected.force.shape)
            both = [name for name in contacts.finger if name in expected.finger]
            now, then = ([names.index(f) for f in both] for names in (contacts.finger, expected.finger))
            mean[..., now, :3] = expected.force[..., then, :]
            mean[..., now, 3] = expected.spin_moment[..., then]
            row, column = _stacked(now), _stacked(then)
            covariance[..., row[:, None], row] = expected.covariance[..., column[:, None], column]
        self._rows = np.array(kin.rows)
        m = 4 * n_c
        self._mean, self._covariance, self._frame = (
            x.detach().reshape(-1, *shape).double().cpu().numpy()
            for x, shape in ((mean, (m,)), (covariance, (m, m)), (kin.frame, (n_c, 3, 3)))
        )

    def into(self, eq: BalanceEquations, k: int) -> BalanceEquations:
        """The balance of state k with its expected forces."""
        T = self._selection(k)
        return dataclasses.replace(
            eq,
            expected=T @ self._mean[k],
            expected_covariance=T @ self._covariance[k] @ T.T,
        )

    def stacked(self, covariance: Array, k: int) -> Array:
        """A covariance of ``mu`` as one of the stack."""
        T = self._selection(k)
        return T.T @ covariance @ T

    def _selection(self, k: int) -> Array:
        """T with ``mu = T x``, orthonormal rows."""
        contact, component = np.divmod(self._rows, 6)
        T = np.zeros((len(contact), self._frame.shape[1], 4))
        force = component < 3
        T[force, contact[force], :3] = self._frame[k, contact[force], :, component[force]]
        T[~force, contact[~force], 3] = 1.0
        return T.reshape(len(contact), -1)


def _stacked(contacts: list[int]) -> np.ndarray:
    return (4 * np.array(contacts, dtype=int)[:, None] + np.arange(4)).ravel()
