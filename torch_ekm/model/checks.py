"""What goes into a linearization must fit the hand and make sense."""

from __future__ import annotations

import torch

from ..contact.contact_set import ContactSet
from ..description.hand import HandDescription
from ..exceptions import NoContactError, NonFiniteError, PenetrationError, ShapeError, UnknownNameError
from ..kinematics.grasp_state import GraspState
from ..typing import Float, Tensor


def check_state(hand: HandDescription, state: GraspState, contacts: ContactSet | None) -> None:
    """One entry for each joint, and contacts with a batch of states."""
    if state.q.shape[-1] != hand.n_q:
        names = ", ".join(hand.joint_names)
        raise ShapeError("q", f"(*batch, {hand.n_q})", state.q.shape, f"the joints are: {names}")
    if contacts is None and state.q.dim() > 1:
        raise ShapeError("q", f"({hand.n_q},)", state.q.shape, "for a batch give the contacts too")


def check_contacts(
    state: GraspState, contacts: ContactSet, link_names: tuple[str, ...], max_overlap: float
) -> None:
    """Some contact, finite, on links that exist, the bodies overlapping by at most ``max_overlap`` [m]."""
    if contacts.n_c == 0:
        raise NoContactError("no finger touches the object, so no actuator can move it")
    if contacts.batch_shape != state.q.shape[:-1]:
        raise ShapeError("contacts.gap", f"{(*state.q.shape[:-1], contacts.n_c)}", contacts.gap.shape)
    for name in ("point", "normal", "gap"):
        if not bool(torch.isfinite(getattr(contacts, name)).all()):
            raise NonFiniteError(f"contacts.{name}")
    for name in contacts.link:
        if name not in link_names:
            raise UnknownNameError("link", name, link_names)
    deepest = float(contacts.gap.amin())
    if deepest < -max_overlap:
        which = contacts.finger[int(contacts.gap.reshape(-1, contacts.n_c).amin(0).argmin())]
        raise PenetrationError(which, -deepest, max_overlap)


def at_pads(
    hand: HandDescription, contacts: ContactSet, fingertip_force: Float[Tensor, "*batch n_pads"]
) -> dict[str, Float[Tensor, "*batch"]]:
    """What the pads measure, by name [N]."""
    pads = [pad.name for pad in hand.pads]
    if fingertip_force.shape[-1] != len(pads):
        raise ShapeError(
            "fingertip_force", f"(*batch, {len(pads)})", fingertip_force.shape, f"pads: {', '.join(pads)}"
        )
    for name in contacts.finger:
        if name not in pads:
            raise UnknownNameError("pad", name, pads)
    return dict(zip(pads, fingertip_force.unbind(-1), strict=True))


def joint_index(hand: HandDescription, name: str) -> int:
    """Where the joint of this name stands."""
    if name not in hand.joint_names:
        raise UnknownNameError("joint", name, hand.joint_names)
    return hand.joint_names.index(name)
