"""A grasp between two motions: state, contacts and forces, and how a motion changes the three."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch

from ..contact.contact_kinematics import ContactKinematics, contact_frames
from ..contact.contact_set import ContactSet
from ..contact.forces.balance import ForceStatus
from ..kinematics.grasp_state import GraspState
from ..kinematics.se3 import exp
from ..model.grasp_forces import GraspForces, friction_use
from ..typing import Float, Tensor

if TYPE_CHECKING:
    from ..model import KinematicModel, Linearization

_VARYING = ("point", "normal", "gap", "finger_curvature", "object_curvature")
_FORCES = (
    "mu", "lam", "force", "spin_moment", "normal", "residual", "stop_torque", "margin", "relative_margin",
    "violation",
)  # fmt: skip


@dataclass(frozen=True)
class Configuration:
    """``z = (s, contacts, forces)``, one or a batch."""

    state: GraspState
    contacts: ContactSet
    forces: GraspForces

    @classmethod
    def of(cls, lin: Linearization) -> Configuration:
        """Where a linearization stands."""
        return cls(lin.state, lin.contacts, lin.forces)

    def expand(self, *batch: int) -> Configuration:
        """The same for each of a batch; contacts and forces may lack it."""
        return self._each(lambda x, tail: x.expand((*batch, *x.shape[x.dim() - tail :])))

    def select(self, k: int) -> Configuration:
        """Number k of the last batch dimension."""
        return self._each(lambda x, tail: x.select(x.dim() - tail - 1, k))

    def _each(self, change: Callable[[Tensor, int], Tensor]) -> Configuration:
        s = self.state
        state = GraspState(change(s.q, 1), change(s.position, 1), change(s.rotation, 2))
        tails = {"point": 2, "normal": 2, "gap": 1, "finger_curvature": 3, "object_curvature": 3}
        contacts = self.contacts.replace(
            **{name: change(getattr(self.contacts, name), tail) for name, tail in tails.items()}
        )
        tail = {"force": 2, "violation": 0}
        parts = {name: change(getattr(self.forces, name), tail.get(name, 1)) for name in _FORCES}
        return Configuration(state, contacts, _with(self.forces, state.q.shape[:-1], parts))


def stack(parts: Sequence[Configuration]) -> Configuration:
    """Configurations of one batch one after the other: ``(*batch, len(parts), ...)``."""
    first = parts[0]
    batch = first.state.q.dim() - 1

    def join(pick) -> Tensor:
        return torch.stack([pick(part) for part in parts], dim=batch)

    state = GraspState(*(join(lambda z, n=n: getattr(z.state, n)) for n in ("q", "position", "rotation")))
    varying = {n: join(lambda z, n=n: getattr(z.contacts, n)) for n in _VARYING}
    forces = {n: join(lambda z, n=n: getattr(z.forces, n)) for n in _FORCES}
    return Configuration(
        state, first.contacts.replace(**varying), _with(first.forces, state.q.shape[:-1], forces)
    )


def moved(
    model: KinematicModel,
    at: Configuration,
    rates: Linearization,
    kin: ContactKinematics,
    action: Float[Tensor, "*batch n_a"],
    correction: Float[Tensor, "*batch n_s"] | None = None,
) -> Configuration:
    """``z+ = z (+) dz/da da``, with rates taken at z or half a motion later.

    ```
    s+    = s (+) (J_m da + g)
    x_i+  = x_i + (v_f + v_o)/2 + sdot_i           sdot_i = M_i (w_rel x n_i), w_rel = w_f - w_o
    n_i+  = exp(w_o + n_i x K_o sdot_i) n_i         K_o+, K_f+ turn with the surface that they belong to
    f_i+  = f_i + (df_i/da) da,   lam+ = lam + (dlam/da) da
    ```

    v_f and v_o are the ways of finger and object at the contact point: the same where contacts stick, and not
    where a learner corrects the object's way alone. Gaps stay as they are: contacts that touch stay closed.

    Args:
        at: z.
        rates: of the model.
        kin: the contacts where the rates were taken.
        action: da [rad].
        correction: g(s, da).
    """
    ds = rates.step(action)
    if correction is not None:
        ds = ds + correction
    n_q = model.hand.n_q
    dq, do, w_o = ds.split([n_q, 3, 3], dim=-1)
    dq = dq[..., None, :, None]
    v_f, w_f = (kin.point_jacobian @ dq)[..., 0], (kin.spin_jacobian @ dq)[..., 0]
    w_o = w_o[..., None, :].expand_as(w_f)
    v_o = do[..., None, :] + torch.linalg.cross(w_o, kin.lever)
    run = -(kin.roll @ (w_f - w_o)[..., None])
    n = kin.contacts.normal
    along_o = torch.linalg.cross(n, (kin.contacts.object_curvature @ run)[..., 0])
    along_f = -torch.linalg.cross(n, (kin.contacts.finger_curvature @ run)[..., 0])
    R_o, R_f = exp(w_o + along_o), exp(w_f + along_f)
    before = at.contacts
    contacts = before.replace(
        point=before.point + 0.5 * (v_f + v_o) + run[..., 0],
        normal=(R_o @ before.normal[..., None])[..., 0],
        object_curvature=R_o @ before.object_curvature @ R_o.mT,
        finger_curvature=R_f @ before.finger_curvature @ R_f.mT,
    )
    return Configuration(at.state.plus(ds), contacts, _loaded(model, at.forces, rates, kin, contacts, action))


def _loaded(
    model: KinematicModel,
    forces: GraspForces,
    rates: Linearization,
    kin: ContactKinematics,
    contacts: ContactSet,
    action: Tensor,
) -> GraspForces:
    """The forces after a motion, at the contacts after it."""
    force = forces.force + (rates.force_vector_sensitivity @ action[..., None, :, None])[..., 0]
    lam = forces.lam + (rates.actuator_force_sensitivity @ action[..., None])[..., 0]
    spin = forces.spin_moment
    soft = [i for i, one in enumerate(kin.models) if len(one.rows) == 4]
    if soft:
        dmu = (rates.contact_force_sensitivity @ action[..., None])[..., 0]
        change = torch.zeros_like(spin)
        change[..., soft] = dmu[..., [kin.normal_rows[i] + 3 for i in soft]]
        spin = spin + change
    normal, margin, _ = friction_use(contacts, force, spin, contacts.normal)
    frame = contact_frames(contacts.normal, model.plane)
    local = (frame.mT @ force[..., None])[..., 0]
    full = torch.cat([local, spin[..., None], torch.zeros_like(local)[..., :2]], dim=-1).flatten(-2)
    return dataclasses.replace(
        forces,
        mu=full.index_select(-1, kin.row_index),
        lam=lam,
        force=force,
        spin_moment=spin,
        normal=normal,
        margin=margin,
        relative_margin=margin / (contacts.friction * normal).clamp_min(1e-9),
    )


def _with(forces: GraspForces, batch: torch.Size | tuple[int, ...], parts: dict[str, Tensor]) -> GraspForces:
    """Forces of a batch; what is known of their covariance is left out."""
    unsolved = [status for status in forces.status if status is not ForceStatus.SOLVED]
    status = unsolved[0] if unsolved else ForceStatus.SOLVED
    count = int(torch.Size(batch).numel())
    return dataclasses.replace(forces, status=(status,) * count, covariance=None, margin_std=None, **parts)
