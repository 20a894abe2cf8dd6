"""What the kinematic model takes into account, what it may be given, and why what it says may be wrong."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from enum import Enum
from typing import Any

import numpy as np
import torch

from .._arrays import as_states, as_tensors, like, namespace, norm
from .._checks import check_kind, check_last
from ..contact.contacts import LINK_MARGIN, ContactSet
from ..contact.forces import ForceOptions
from ..description.hand import HandDescription
from ..exceptions import NoContactError, ParameterError, PenetrationError, ShapeError, UnknownNameError
from ..kinematics.poses import GraspState
from ..typing import AnyArray, Float, Tensor
from .grasp_forces import GraspForces


@dataclass(frozen=True)
class ModelOptions:
    """Options of :class:`~torch_ekm.model.KinematicModel`.

    Raises:
        ParameterError: a value outside its range.
    """

    rolling: bool = True
    """Contact points run over the surfaces. False treats them as pinned."""
    actuator_compliance: bool = True
    """Use the actuators' series stiffness K_a where it is finite. False: all rigid."""
    slack_tension: float | None = 0.0
    """A tendon that pulls with at most this much [N, or N m for a in rad] is slack: it moves nothing. None:
    all stay taut, as rods do, at any force."""
    contact_margin: float = 0.002
    """Gap up to which the detector takes a pad for touching [m]; more for noisy poses."""
    max_overlap: float = 0.005
    """Deepest penetration of finger and object that is still modelled [m]."""
    on_unstable: str = "raise"
    """"raise" UnstableGraspError, or "flag": return the formal Jacobian with status "unstable"."""
    forces: ForceOptions = field(default_factory=ForceOptions)

    def __post_init__(self) -> None:
        if self.on_unstable not in ("raise", "flag"):
            raise ParameterError("on_unstable", self.on_unstable, "'raise' or 'flag'")
        if not self.max_overlap > 0:
            raise ParameterError("max_overlap", self.max_overlap, "positive")
        if not self.contact_margin >= 0:
            raise ParameterError("contact_margin", self.contact_margin, "not negative")
        if self.slack_tension is not None and not self.slack_tension >= 0:
            raise ParameterError("slack_tension", self.slack_tension, "not negative, or None")


_LOWEST = -0.9
"""Readings below this [N] are no noise about zero: three standard deviations of a fingertip sensor."""


def check_described(hand: Any, obj: Any) -> None:
    """A hand and an object, not their names, and in this order; the object with a mass [kg], which may be 0,
    and a centre of mass [m]."""
    for name, value, needs, kind in (("hand", hand, "joint_names", "hand"), ("obj", obj, "mass", "object")):
        if not hasattr(value, needs):
            raise ParameterError(name, value, f"a description: load_{kind}(name)")
    mass, com = float(obj.mass), [float(x) for x in obj.com]
    if not 0 <= mass < math.inf:
        raise ParameterError("mass of the object", mass, "finite and not negative [kg]")
    if len(com) != 3 or not all(map(math.isfinite, com)):
        raise ParameterError("com of the object", com, "three finite numbers [m]")


def check_state(
    hand: HandDescription, state: GraspState, contacts: ContactSet | None, dtype: torch.dtype
) -> None:
    """One entry for each joint, contacts with a batch of states, everything in the model's precision, and no
    graph, in which J_m would be a constant."""
    if contacts is not None:
        check_kind("contacts", contacts, ContactSet, "a ContactSet, e.g. model.contacts(state)")
    check_last("q", state.q, hand.n_q, f"the joints are: {', '.join(hand.joint_names)}")
    if contacts is None and state.q.dim() > 1:
        raise ShapeError("q", f"({hand.n_q},)", state.q.shape, "for a batch give the contacts too")
    if state.q.requires_grad or state.position.requires_grad or state.rotation.requires_grad:
        raise ParameterError("state", "one with a gradient", "detached: autograd does not differentiate J_m")
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
    check_last("fingertip_force", fingertip_force, len(pads), f"pads: {', '.join(pads)}")
    measured = {name: fingertip_force[..., i] for i, name in enumerate(pads)}
    for name, link in zip(contacts.finger, contacts.link, strict=True):
        if name not in pads and name != link:
            raise UnknownNameError("pad", name, pads)
        measured.setdefault(name, xp.full_like(fingertip_force[..., 0], xp.nan))
    return measured


SIGMA = 3.0
"""Standard deviations of joint torque and fingertip force above which they count as unexplained."""
AT_LIMIT = 0.01
"""Relative margin below which a contact counts as at its friction limit."""


class ModelStatus(Enum):
    """How far a linearization can be trusted; from UNSTABLE on: kinds of :class:`Doubt`, worst first."""

    OK = "ok"
    UNSTABLE = "unstable"
    """The grasp buckles; the Jacobian is formal (only with ``on_unstable="flag"``)."""
    NO_FORCES = "no_forces"
    """The force problem had no answer; D leaves out S, T and rolling."""
    REUSED_FORCES = "reused_forces"
    """The force problem had no answer; D uses the forces of the previous step."""
    LINK_TOUCHES = "link_touches"
    """A link that is no pad touches the object: the model leaves its force out."""
    UNEXPLAINED_TORQUE = "unexplained_torque"
    """Springs, weight and contacts do not explain the torques at the joints."""
    CONTACT_DROPPED = "contact_dropped"
    """A pad that touched, presses or nearly touches is farther away than the contact margin."""
    SENSORS_DISAGREE = "sensors_disagree"
    """A fingertip measures another force than the balance allows."""
    FRICTION_LIMIT = "friction_limit"
    """A contact has no friction to spare: sticking, which J_m assumes, is about to end."""


@dataclass(frozen=True)
class Doubt:
    """One finding; over a batch the worst state counts."""

    kind: ModelStatus
    what: str
    """Name of the actuator, joint, pad or link; "grasp" for the whole."""
    value: float
    limit: float
    """What ``value`` is held against."""
    unit: str
    message: str
    """The finding and its remedy in a sentence."""

    def __str__(self) -> str:
        return self.message


def find_doubts(
    options: ModelOptions,
    joint_names: Sequence[str],
    contacts: ContactSet,
    forces: GraspForces,
    stability: Float[Tensor, "*batch"],
    reused: bool,
    measured: dict[str, Any],
    before: tuple[str, ...] = (),
) -> tuple[Doubt, ...]:
    """All that can be said against a state, worst kind first.

    Args:
        reused: the forces are those of the step before.
        measured: normal forces that the pads measure, by pad [N].
        before: the pads that touched a step before.
    """
    doubts = [*_of_stability(stability, options), *_of_near_misses(contacts, measured, before, options)]
    if forces.solved:
        doubts += _of_torque(joint_names, forces, options)
        doubts += _of_friction(contacts, forces)
        doubts += _of_sensors(contacts, forces, measured, options)
    else:
        doubts.append(_of_missing_forces(forces, reused))
    return tuple(sorted(doubts, key=lambda doubt: _ORDER[doubt.kind]))


_ORDER = {kind: place for place, kind in enumerate(ModelStatus)}


def _of_stability(stability: Tensor, options: ModelOptions) -> Iterator[Doubt]:
    least = float(stability.min())
    if least <= 0 and options.on_unstable == "flag":
        message = (
            f"the stiffness with locked actuators has the eigenvalue {least:.3g} N m/rad: the grasp buckles "
            "and J_m is formal; grip less hard or place the fingers wider"
        )
        yield Doubt(ModelStatus.UNSTABLE, "grasp", least, 0.0, "N m/rad", message)


def _of_missing_forces(forces: GraspForces, reused: bool) -> Doubt:
    missing = float(forces.violation.max())
    kind = ModelStatus.REUSED_FORCES if reused else ModelStatus.NO_FORCES
    stand_in = "those of the step before stand in" if reused else "the step leaves out their stiffness"
    if math.isnan(missing):
        message = (
            f"the solver of the force problem failed, so the contact forces are unknown: {stand_in}; check "
            "mass and pose of the object"
        )
    else:
        message = (
            f"no forces inside the friction cones balance the object, {missing:.2g} N are missing: "
            f"{stand_in}; check mass, friction and pose of the object, and contact_margin if a pad is missing"
        )
    return Doubt(kind, "grasp", missing, 0.0, "N", message)


def _of_torque(joint_names: Sequence[str], forces: GraspForces, options: ModelOptions) -> Iterator[Doubt]:
    std = options.forces.torque_std
    residual = as_states(forces.residual, 1)
    size = norm(residual)
    value = float(size.max())
    if value > SIGMA * std:
        joint = joint_names[int(abs(residual[int(size.argmax())]).argmax())]
        message = (
            f"springs, weight and contacts leave joint torques of {value:.3f} N m unexplained "
            f"({value / std:.0f} standard deviations), most at '{joint}': the object's mass, a spring, its "
            "rest angle or the contacts are not as described"
        )
        yield Doubt(ModelStatus.UNEXPLAINED_TORQUE, joint, value, SIGMA * std, "N m", message)


def _of_friction(contacts: ContactSet, forces: GraspForces) -> Iterator[Doubt]:
    least = as_states(forces.relative_margin, 1).min(0).tolist()
    for i, (pad, value) in enumerate(zip(contacts.finger, least, strict=True)):
        if value <= AT_LIMIT and float(contacts.friction[i]) > 0:
            left = float(as_states(forces.margin, 1)[:, i].min())
            message = (
                f"pad '{pad}' is at its friction limit ({left:.2f} N to spare) and may slip; "
                "grip harder or turn less"
            )
            yield Doubt(ModelStatus.FRICTION_LIMIT, pad, value, AT_LIMIT, "mu_s f_n", message)


def _of_sensors(
    contacts: ContactSet, forces: GraspForces, measured: dict[str, Any], options: ModelOptions
) -> Iterator[Doubt]:
    limit, normal = SIGMA * options.forces.normal_std, as_states(forces.normal, 1)
    for i, pad in enumerate(contacts.finger):
        if pad not in measured:
            continue
        miss = abs(as_states(measured[pad], 0) - normal[:, i])
        value = float(np.nan_to_num(miss).max())
        if value > limit:
            message = (
                f"pad '{pad}' measures a normal force {value:.2f} N off the one that balances object and "
                "joints; check its calibration, the object's mass and whether something else touches"
            )
            yield Doubt(ModelStatus.SENSORS_DISAGREE, pad, value, limit, "N", message)


def _of_near_misses(
    contacts: ContactSet, measured: dict[str, Any], before: tuple[str, ...], options: ModelOptions
) -> Iterator[Doubt]:
    margin = options.contact_margin
    for near in contacts.near_misses:
        if near.pad is None:
            message = (
                f"link '{near.link}' carries no pad and touches the object (gap {1e3 * near.gap:.1f} mm): "
                "its force is left out; grasp elsewhere, or give the link a pad in the transmission file"
            )
            yield Doubt(ModelStatus.LINK_TOUCHES, near.link, near.gap, LINK_MARGIN, "m", message)
            continue
        pressed = near.pad in measured and float(measured[near.pad].max()) > SIGMA * options.forces.normal_std
        if not (near.gap <= 1.5 * margin or near.pad in before or pressed):
            continue
        earlier = "touched a step before" if near.pad in before else "nearly touches"
        why = "measures a force" if pressed else earlier
        message = (
            f"pad '{near.pad}' {why} but is {1e3 * near.gap:.1f} mm from the object and left out; "
            f"ModelOptions(contact_margin={near.gap + 1e-4:.4f}) takes it in, if the poses are that inexact"
        )
        yield Doubt(ModelStatus.CONTACT_DROPPED, near.pad, near.gap, margin, "m", message)
