"""Contact forces at a state and after an increment, how sure they are, and how they enter the next problem.

Contact forces are stacked as ``[f_1; m_1; f_2; m_2; ..]``, f_i in hand axes [N], m_i the spin moment [N m]:
``4 n_c`` entries, which do not depend on contact frames.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch

from .._arrays import eye, namespace, norm, zeros
from .._noise import NOISE
from ..contact.contacts import CHARACTERISTIC_LENGTH, ContactKinematics, ContactSet
from ..contact.forces import ForceOptions, ForceStatus
from ..exceptions import ShapeError
from ..typing import AnyArray, Array, Float, Tensor


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
    """Torque of joint stops on the joint [N m]."""
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
    loop: Float[Tensor, "*batch n_l"] = field(default_factory=lambda: torch.zeros(0, dtype=torch.float64))
    """nu, forces of the loops, ``-(dc/dq)^T nu`` on the joints."""

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
    contacts: ContactSet, force: AnyArray, spin: AnyArray, normal: AnyArray
) -> tuple[Any, Any, Any]:
    """``f_n``, ``mu_s f_n - |u|`` [N] and the margin's gradient ``(*batch, n_c, 4)`` in ``[f; m]``.

    Args:
        normal: outward normals of the object.
    """
    n_in, mu_s, gamma, xp = -normal, contacts.friction, contacts.torsional_friction, namespace(force)
    f_n = (force * n_in).sum(-1)
    f_t = force - f_n[..., None] * n_in
    scale = mu_s / gamma.clip(1e-9) * (gamma > 0)
    u = xp.concat([f_t, (scale * spin)[..., None]], -1)
    size = norm(u)
    direction = u / size.clip(1e-9)[..., None]
    across = -(scale * direction[..., 3])[..., None]
    gradient = xp.concat([mu_s[:, None] * n_in - direction[..., :3], across], -1)
    return f_n, mu_s * f_n - size, gradient


def margin_std(
    contacts: ContactSet, normal_force: AnyArray, gradient: AnyArray, covariance: AnyArray
) -> Float[Any, "*batch n_c"]:
    """``sqrt(g^T Sigma g + (s mu_s f_n)^2)``, g the margin's gradient, s of the friction coefficient [N]."""
    xp, n_c = namespace(covariance), contacts.n_c
    blocks = covariance.reshape(*covariance.shape[:-2], n_c, 4, n_c, 4)
    own = xp.moveaxis(xp.diagonal(blocks, 0, -4, -2), -1, -3)
    variance = (gradient[..., None, :] @ own @ gradient[..., None])[..., 0, 0]
    return xp.sqrt(variance.clip(0.0) + (NOISE.friction * contacts.friction * normal_force) ** 2)


def start_covariance(
    normal: Float[AnyArray, "*batch n_c 3"], options: ForceOptions
) -> Float[Any, "*batch m m"]:
    """``start_std^2`` across the normals, any force along them; ``(start_std L)^2`` for spin moments."""
    *batch, n_c, _ = normal.shape
    along = normal[..., None] * normal[..., None, :]
    blocks = zeros(normal, *batch, n_c, 4, 4)
    across = eye(normal, 3) - along
    blocks[..., :3, :3] = options.start_std**2 * across + NOISE.any_normal_force**2 * along
    blocks[..., 3, 3] = (options.start_std * CHARACTERISTIC_LENGTH) ** 2
    spread = blocks[..., :, :, None, :] * eye(normal, n_c)[:, None, :, None]
    return spread.reshape(*batch, 4 * n_c, 4 * n_c)


def drift(df: Float[AnyArray, "*batch n_c 3"], dspin: AnyArray) -> Float[Any, "*batch m"]:
    """Variance that an increment adds: ``sigma_d^2 + (sigma_c |df_i|)^2``, moments likewise."""
    xp = namespace(df)
    one = xp.asarray([1.0, 1.0, 1.0, CHARACTERISTIC_LENGTH], dtype=df.dtype, device=df.device)
    of_force = (df * df).sum(-1)[..., None]
    change2 = xp.concat([of_force, of_force, of_force, dspin[..., None] ** 2], -1)
    variance = (NOISE.force_drift * one) ** 2 + NOISE.force_share**2 * change2
    return variance.reshape(*df.shape[:-2], -1)


class ForcePrior:
    """``N(x^, Sigma)`` of the stacked contact forces, read in the contact frames of the present state.

    Contacts that were not expected begin at 0, with ``start_std`` across the normal and any force along it.
    All in numpy, a list of states.

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
        batch, n_c = contacts.gap.shape[:-1], contacts.n_c
        frame, normal = as_states(kin.frame, 3), as_states(contacts.normal, 2)
        n = len(frame)
        mean, covariance = np.zeros((n, n_c, 4)), start_covariance(normal, options)
        if expected is not None:
            if expected.force.shape[:-2] not in (batch, ()):
                raise ShapeError("expected.force", f"{(*batch, n_c, 3)}", expected.force.shape)
            both = [name for name in contacts.finger if name in expected.finger]
            now, then = ([names.index(f) for f in both] for names in (contacts.finger, expected.finger))
            mean[:, now, :3] = as_states(expected.force, 2)[:, then]
            mean[:, now, 3] = as_states(expected.spin_moment, 1)[:, then]
            row, column = _stacked(now), _stacked(then)
            covariance[:, row[:, None], row] = as_states(expected.covariance, 2)[:, column[:, None], column]
        # T with mu = T x, orthonormal rows
        contact, component = np.divmod(np.array(kin.rows), 6)
        self._T = np.zeros((n, len(contact), n_c, 4))
        force = np.flatnonzero(component < 3)
        self._T[:, force, contact[force], :3] = frame[:, contact[force], :, component[force]].swapaxes(0, 1)
        spin = np.flatnonzero(component >= 3)
        self._T[:, spin, contact[spin], 3] = 1.0
        self._T = self._T.reshape(n, len(contact), -1)
        self.mean: Array = (self._T @ mean.reshape(n, -1, 1))[..., 0]
        """Of ``mu``, state by state."""
        self.covariance: Array = self._T @ covariance @ self._T.mT
        """Of ``mu``, state by state."""

    def stacked(self, covariance: Array) -> Array:
        """Covariances of ``mu``, state by state, as those of the stack."""
        return self._T.mT @ covariance @ self._T


def as_states(x: AnyArray, dims: int) -> Array:
    """A list of states in numpy: the batch of ``x`` flattened, ``dims`` axes of each state left."""
    x = x.detach().double().cpu().numpy() if isinstance(x, Tensor) else x
    return x.reshape(-1, *x.shape[x.ndim - dims :])


def _stacked(contacts: list[int]) -> np.ndarray:
    return (4 * np.array(contacts, dtype=int)[:, None] + np.arange(4)).ravel()
