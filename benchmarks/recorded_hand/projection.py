"""From a measured state, in which fingers float or sink in, to one in which they touch."""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from typing import NamedTuple

import torch

from torch_ekm.contact.contacts import ContactSet, constraint_matrix
from torch_ekm.contact.detector import ContactDetector
from torch_ekm.exceptions import SolverError, UnknownNameError
from torch_ekm.kinematics.poses import GraspState
from torch_ekm.model.kinematic_model import KinematicModel
from torch_ekm.typing import Tensor

_CLOSED = 1e-7
"""Largest gap that is left [m]."""
_STEPS = 30


class Projection(NamedTuple):
    """A measured state and the most likely one near it in which the pads touch."""

    state: GraspState
    contacts: ContactSet
    """Those that touch, at ``state``: what :meth:`KinematicModel.linearize` takes."""
    chi2: float
    """``|Sigma^-1/2 ds|^2``: about ``n_c`` where the standard deviations are right; far more: they are
    not, or a pad that was said to touch does not."""


@torch.no_grad()
def project_onto_contacts(
    model: KinematicModel,
    state: GraspState,
    *,
    q_std: float | Tensor,
    position_std: float,
    rotation_std: float,
    touching: Sequence[str],
) -> Projection:
    """``min_ds |Sigma^-1/2 ds|^2  s.t.  gap_i(s + ds) = 0``, i the pads that touch, ``gap_j >= 0``, j others.

    Gauss-Newton on the signed distances, whose derivative is minus the normal row of the constraint matrix
    A: ``ds = Sigma A_n^T (A_n Sigma A_n^T)^+ (gap + A_n ds)``, among the motions that rigid couplings and the
    plane of a planar hand allow. It is the step of a Kalman filter that sees all gaps to be 0, iterated.

    Args:
        state: the measurement, one state.
        q_std, position_std, rotation_std: its standard deviations [rad, m, rad], hand axes; all positive.
        touching: the pads that touch, by name.

    Raises:
        UnknownNameError: ``touching`` names what is no pad near the object.
        SolverError: the gaps cannot all be closed.
    """
    q = torch.as_tensor(q_std, dtype=state.q.dtype).expand(model.hand.n_q)
    others = torch.tensor([position_std] * 3 + [rotation_std] * 3, dtype=state.q.dtype)
    sigma = torch.cat([q, others])
    Z = model.reduction.basis.to(sigma)
    Sigma = Z @ torch.linalg.inv((Z / sigma[:, None] ** 2).mT @ Z) @ Z.mT
    detector = copy.copy(model.detector)
    if isinstance(detector, ContactDetector):  # pads that float belong to it
        detector.margin = math.inf

    def look(at: GraspState) -> tuple[ContactSet, Tensor]:
        contacts = detector(at.q, at.position, at.rotation)
        kin = model.contact_kinematics(at, contacts)
        return contacts, constraint_matrix(kin)[kin.normal_rows]

    contacts, A_n = look(state)
    touch = set(touching)
    for name in touch - set(contacts.finger):
        raise UnknownNameError("pad near the object", name, contacts.finger)
    at, change = state, torch.zeros_like(sigma)
    for _ in range(_STEPS):
        gaps = zip(contacts.finger, contacts.gap.tolist(), strict=True)
        touch |= {name for name, gap in gaps if gap < -_CLOSED}
        rows = [i for i, name in enumerate(contacts.finger) if name in touch]
        gap, G = contacts.gap[rows], A_n[rows]
        if float(gap.abs().max()) <= _CLOSED:
            break
        S = G @ Sigma @ G.mT
        target = Sigma @ G.mT @ torch.linalg.pinv(S, rtol=1e-9, hermitian=True) @ (gap + G @ change)
        at = at.plus(target - change)
        change = at.minus(state)
        contacts, A_n = look(at)
    else:
        worst = contacts.finger[rows[int(gap.abs().argmax())]]
        raise SolverError("projection", f"gaps are left, the largest at '{worst}'", "do these pads touch?")
    return Projection(at, contacts.select(rows), float((change / sigma).square().sum()))
