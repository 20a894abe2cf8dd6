"""From a measured state, in which fingers float or sink in, to one in which they touch."""

from __future__ import annotations

import copy
import math
from collections.abc import Iterable
from dataclasses import dataclass

import torch

from torch_ekm.contact.contact_kinematics import constraint_matrix
from torch_ekm.contact.contact_set import ContactSet
from torch_ekm.contact.detector import ContactDetector
from torch_ekm.exceptions import NoContactError, ParameterError, ShapeError, SolverError, UnknownNameError
from torch_ekm.kinematics.grasp_state import GraspState
from torch_ekm.kinematics.tensors import as_tensors
from torch_ekm.model.kinematic_model import KinematicModel
from torch_ekm.typing import Float, Tensor

_CLOSED = 1e-7
"""Largest gap that is left [m]."""
_STEPS = 30


@dataclass(frozen=True)
class Projection:
    """A measured state and the most likely one near it in which the pads touch."""

    state: GraspState
    contacts: ContactSet
    """Those that touch, at ``state``: what :meth:`KinematicModel.linearize` takes."""
    change: Float[Tensor, " n_s"]
    """``ds`` from the measured state: [rad, m, rad]."""
    gap: Float[Tensor, " n_c"]
    """What the gaps of ``contacts`` were in the measured state [m]."""
    chi2: float
    """``|Sigma^-1/2 ds|^2``: about ``n_c`` where the standard deviations are right; far more: they are
    not, or a pad that was said to touch does not."""


@torch.no_grad()
def project_onto_contacts(
    model: KinematicModel,
    state: GraspState,
    *,
    q_std: float | Float[Tensor, " n_q"],
    position_std: float | Float[Tensor, " 3"],
    rotation_std: float | Float[Tensor, " 3"],
    touching: Iterable[str] | None = None,
    fingertip_force: Float[Tensor, " n_pads"] | None = None,
    least_force: float = 0.2,
) -> Projection:
    """``min_ds |Sigma^-1/2 ds|^2  s.t.  gap_i(s + ds) = 0``, i the pads that touch, ``gap_j >= 0``, j others.

    Gauss-Newton on the signed distances, whose derivative is minus the normal row of the constraint matrix
    A: ``ds = Sigma A_n^T (A_n Sigma A_n^T)^+ (gap + A_n ds)``, among the motions that rigid couplings and the
    plane of a planar hand allow. It is the step of a Kalman filter that sees all gaps to be 0, iterated.

    Args:
        model: hand, object and detector; a detector of one's own must report all pads that may touch.
        state: the measurement, one state.
        q_std, position_std, rotation_std: its standard deviations [rad, m, rad], hand axes; all positive.
        touching: the pads that touch, by name. By default those that bear at least ``least_force``, or
            without ``fingertip_force`` those whose gap is within four of its standard deviations.
        fingertip_force: normal force at each pad [N], NaN where nothing is measured.
        least_force: what counts as touching [N].

    Raises:
        NoContactError: no pad touches.
        UnknownNameError: ``touching`` names what is no pad near the object.
        SolverError: the gaps cannot all be closed.
        ParameterError: a standard deviation is not positive.
    """
    sigma = _deviations(model, state, q_std, position_std, rotation_std)
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
    first = contacts.gap
    if touching is None and fingertip_force is not None:
        (force,) = as_tensors(fingertip_force=fingertip_force)
        measured = zip(model.hand.pads, force.tolist(), strict=True)
        touching = [pad.name for pad, newtons in measured if newtons >= least_force]
    if touching is None:
        near = first <= 4 * (A_n @ Sigma * A_n).sum(-1).sqrt()
        touching = [name for name, close in zip(contacts.finger, near.tolist(), strict=True) if close]
    touching = set(touching)
    for name in touching - set(contacts.finger):
        raise UnknownNameError("pad near the object", name, contacts.finger)
    if not touching:
        raise NoContactError("no pad touches the object, so there is nothing to project onto")

    at, change = state, torch.zeros_like(sigma)
    for _ in range(_STEPS):
        touching |= {
            name for name, gap in zip(contacts.finger, contacts.gap.tolist(), strict=True) if gap < -_CLOSED
        }
        rows = [i for i, name in enumerate(contacts.finger) if name in touching]
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
    chi2 = float((change / sigma).square().sum())
    return Projection(at, contacts.select(rows), change, first[rows], chi2)


def _deviations(
    model: KinematicModel, state: GraspState, q: object, position: object, rotation: object
) -> Tensor:
    parts = []
    for name, value, size in (
        ("q_std", q, model.hand.n_q),
        ("position_std", position, 3),
        ("rotation_std", rotation, 3),
    ):
        (std,) = as_tensors(**{name: value})
        if std.shape not in ((), (size,)):
            raise ShapeError(name, f"() or ({size},)", std.shape)
        if not bool(((std > 0) & torch.isfinite(std)).all()):
            raise ParameterError(name, std.tolist(), "positive and finite; small where something is known")
        parts.append(std.to(state.q).expand(size))
    return torch.cat(parts)
