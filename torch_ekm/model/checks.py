"""What goes into a linearization must fit the hand and make sense."""

from __future__ import annotations

import math
from typing import Any

import torch

from .._arrays import like, namespace
from .._checks import check_kind
from ..contact.contact_set import ContactSet
from ..description.hand import HandDescription
from ..exceptions import NoContactError, ParameterError, PenetrationError, ShapeError, UnknownNameError
from ..kinematics.grasp_state import GraspState
from ..kinematics.tensors import as_tensors
from ..typing import AnyArray, Float, Tensor

_LOWEST = -0.9
"""Readings below this [N] are no noise about zero: three standard deviations of a fingertip sensor."""


def check_described(hand: Any, obj: Any) -> None:
    """A hand and an object, not their names, and in this order."""
    for name, value, needs in (("hand", hand, "joint_names"), ("obj", obj, "mass")):
        if not hasattr(value, needs):
            raise ParameterError(
                name, value, f"a description: load_{'hand' if name == 'hand' else 'object'}(name)"
            )


def check_inertia(obj) -> None:
    """Of anything with a mass [kg], which may be 0, and a centre of mass [m]."""
    mass, com = float(obj.mass), [float(x) for x in obj.com]
    if not 0 <= mass < math.inf:
        raise ParameterError("mass of the object", mass, "finite and not negative [kg]")
    if len(com) != 3 or not all(map(math.isfinite, com)):
        raise ParameterError("com of the object", com, "three finite numbers [m]")


def check_state(
    hand: HandDescription, state: GraspState, contacts: ContactSet | None, dtype: torch.dtype
) -> None:
    """One entry for each joint, contacts with a batch of states, everything in the model's precision."""
    if contacts is not None:
        check_kind("contacts", contacts, ContactSet, "a ContactSet, e.g. model.contacts(state)")
    if state.q.shape[-1] != hand.n_q:
        names = ", ".join(hand.joint_names)
        raise ShapeError("q", f"(*batch, {hand.n_q})", state.q.shape, f"the joints are: {names}")
    if contacts is None and state.q.dim() > 1:
        raise ShapeError("q", f"({hand.n_q},)", state.q.shape, "for a batch give the contacts too")
    for name, given in (("state", state.q), ("contacts", None if contacts is None else contacts.gap)):
        if given is not None and given.dtype != dtype:
            valid = f"{dtype}, that of the model (KinematicModel(..., dtype=), or its .to())"
            raise ParameterError(f"dtype of the {name}", given.dtype, valid)


def check_contacts(
    state: GraspState, contacts: ContactSet, link_names: tuple[str, ...], max_overlap: float, detected: bool
) -> None:
    """Some contact, finite (unless ``detected`` by the package's own detector), on links that exist, the
    bodies overlapping by at most ``max_overlap`` [m]."""
    if contacts.n_c == 0:
        raise NoContactError("no finger touches the object, so no actuator can move it")
    if contacts.batch_shape != state.q.shape[:-1]:
        raise ShapeError("contacts.gap", f"{(*state.q.shape[:-1], contacts.n_c)}", contacts.gap.shape)
    if not detected:
        contacts.check()
    for name in contacts.link:
        if name not in link_names:
            raise UnknownNameError("link", name, link_names)
    gap = contacts.gap.detach()
    deepest = float(gap.min())
    if deepest < -max_overlap:
        which = contacts.finger[int(gap.reshape(-1, contacts.n_c).amin(0).argmin())]
        raise PenetrationError(which, -deepest, max_overlap)


def at_pads(
    hand: HandDescription, contacts: ContactSet, fingertip_force: Float[Tensor, "*batch n_pads"], q: AnyArray
) -> dict[str, Any]:
    """What the pads measure, by name ``(*batch)`` [N], tensors or arrays as ``q`` is; NaN of links that touch
    and are no pads."""
    (given,) = as_tensors(fingertip_force=fingertip_force)
    fingertip_force, xp = like(given, q), namespace(q)
    if bool(((fingertip_force < _LOWEST) | xp.isinf(fingertip_force)).any()):
        valid = f"finite or NaN, and above {_LOWEST} N: a pad cannot pull (is its zero or its sign wrong?)"
        raise ParameterError("fingertip_force", fingertip_force.tolist(), valid)
    pads = [pad.name for pad in hand.pads]
    if fingertip_force.shape[-1:] != (len(pads),):
        raise ShapeError(
            "fingertip_force", f"(*batch, {len(pads)})", fingertip_force.shape, f"pads: {', '.join(pads)}"
        )
    measured = {name: fingertip_force[..., i] for i, name in enumerate(pads)}
    for name, link in zip(contacts.finger, contacts.link, strict=True):
        if name not in pads and name != link:
            raise UnknownNameError("pad", name, pads)
        measured.setdefault(name, xp.full_like(fingertip_force[..., 0], xp.nan))
    return measured
