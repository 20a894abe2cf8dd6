"""What a hand is, as data: joints, actuators, springs, pads, sensors."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from ..exceptions import DescriptionError
from ..typing import Array
from .lengths import Lengths, Loops, TendonSprings
from .urdf import UrdfModel

_ANGLES = (0.1, 10.0)  # a largest moment arm of a motor between these is a ratio of angles


@dataclass(frozen=True)
class Actuator:
    """One motor, as its position controller shows it.

    ``a = offset + l(q)``, with constant moment arms ``J_a[row] q``, and ``lower <= a <= upper``, all [rad].
    """

    name: str
    lower: float
    upper: float
    offset: float = 0.0
    tendon: bool = False
    """True: it can only pull (tension ``-lam >= 0``); False: a looped cable, both directions."""
    stiffness: float = np.inf
    """Series stiffness of tendon and servo [N m/rad]; infinite: rigid."""
    backlash: float = 0.0
    """Play of the drive, from one end to the other [rad]: a reversal of the motor smaller than that moves
    nothing (:class:`~torch_ekm.kinematics.Play`)."""
    unit: float = 1.0
    """What 1 is in the units of the files; see :meth:`HandDescription.counted`."""
    posture: bool = False
    """True: it shapes the hand before a grasp; a controller leaves it alone while something is held."""


@dataclass(frozen=True)
class ContactPad:
    """The part of a link that is meant to touch objects: a capsule (or ball, if both ends coincide).

    ``start`` and ``end`` are the ends of the capsule's axis in the link's frame [m].
    """

    name: str
    link: str
    start: tuple[float, float, float]
    end: tuple[float, float, float]
    radius: float
    """Radius of the capsule [m]; the surface's curvature there is 1/radius."""
    direction: tuple[float, float, float] = (0.0, 1.0, 0.0)
    """Outward direction of the middle of the pad, in the link's frame (palmar side)."""
    torsional_friction: float = 0.0
    """Soft-finger coefficient gamma [m]: spin moment at most gamma times the normal force."""


@dataclass(frozen=True)
class HallSensor:
    """One Hall channel: reading ``open`` at ``lower`` and ``closed`` at ``upper`` of its joint, 8 bit."""

    joint: str
    channel: int
    open: float = 255.0
    closed: float = 0.0


@dataclass(frozen=True)
class HandDescription:
    """A hand: its URDF and everything that a URDF cannot say, as ``load_hand`` reads it.

    Shapes: ``n_q`` joints, ``n_a`` actuators, ``n_k`` rigid couplings. Angles [rad],
    lengths [m], torques [N m]. Vectors over joints are in the order of ``joint_names``.

    Raises:
        DescriptionError: ``planar_normal`` is zero, or not along the axes of all joints.
    """

    name: str
    urdf: UrdfModel = field(repr=False)
    """The tree of links and joints as it was read, with inertias and collision shapes."""
    transmission_path: Path
    base_link: str
    """The hand frame: every pose and Jacobian in torch_ekm is expressed in it."""
    link_names: tuple[str, ...]
    joint_names: tuple[str, ...]
    joint_lower: Array
    joint_upper: Array
    actuators: tuple[Actuator, ...]
    actuation_jacobian: Array
    """J_a = da/dq, ``(n_a, n_q)``: constant moment arms, and typical ones of arms that are functions."""
    coupling: Array
    """C with ``C dq = 0``, ``(n_k, n_q)``: rigid couplings and locked joints; ``C q = C q0`` at all times."""
    spring_stiffness: Array
    """Diagonal of K_s, ``(n_q,)`` [N m/rad]."""
    spring_rest: Array
    """q0, angles at which the springs are slack, ``(n_q,)`` [rad]."""
    joint_friction: Array
    """Coulomb friction torque of each joint, ``(n_q,)`` [N m]."""
    pads: tuple[ContactPad, ...]
    hall_sensors: tuple[HallSensor, ...] = ()
    planar_normal: tuple[float, float, float] | None = None
    """Normal of the plane in which a planar hand moves (hand frame); None: a spatial hand."""
    gravity: tuple[float, float, float] = (0.0, 0.0, 9.81)
    """Nominal gravity in the hand frame [m/s^2], that of plant and model unless one is set otherwise. The
    iCub's palm faces down: its fingers hang, and the line of a pinch is level."""
    pinch_force: float = 5.0
    """Normal force with which the thumb pinches an object in simulation [N]; 3 N where this is more than the
    springs bear."""

    notes: tuple[str, ...] = ()
    """What an MJCF says that is left out or approximated here."""
    arm_functions: Lengths | None = None
    """How moment arms change with the posture, as factors of ``actuation_jacobian``; None: they do not."""
    tendon_springs: TendonSprings | None = None
    """Springs over tendons."""
    loops: Loops | None = None
    """What closes chains, and joints that follow others along a curve."""

    def __post_init__(self) -> None:
        if self.planar_normal is None:
            return
        size = float(np.linalg.norm(self.planar_normal))
        if not 1e-9 < size < np.inf:
            problem = f"planar_normal must not be zero, and finite, got {self.planar_normal}"
            raise DescriptionError(self.transmission_path, problem)
        normal = self.urdf.pose(self.base_link)[:3, :3] @ np.array(self.planar_normal, dtype=float) / size
        for joint in self.urdf.moving_joints:  # which turn no axis away from it: one posture is enough
            axis = self.urdf.pose(joint.child)[:3, :3] @ joint.axis
            lean = float(np.linalg.norm(np.cross(axis, normal)))
            if lean > 1e-3:
                degrees = np.degrees(np.arcsin(min(lean, 1.0)))
                problem = f"the axis of joint '{joint.name}' is {degrees:.3g} deg off planar_normal"
                problem += "; a planar hand turns about it alone"
                raise DescriptionError(self.transmission_path, problem)

    @property
    def lengths(self) -> Lengths:
        """``a = offset + l(q)``, with the arms of ``actuation_jacobian``."""
        return self.arm_functions or Lengths(self.actuation_jacobian)

    def counted(self) -> HandDescription:
        """The same hand with each motor in a unit of its own, as plants, models and controllers count.

        A motor whose largest moment arm is below 0.1 or above 10 counts in lengths of its tendon, or in turns
        before a gear: 1 is then the largest arm of it, so that its position is an angle. Others stay in rad.
        """
        largest = np.abs(self.actuation_jacobian).max(axis=1)
        unit = np.where((largest < _ANGLES[0]) | (largest > _ANGLES[1]), largest, 1.0)
        if (unit == 1.0).all():
            return self
        actuators = [
            replace(
                one,
                **{name: getattr(one, name) / u for name in ("lower", "upper", "offset", "backlash")},
                stiffness=one.stiffness * u**2,
                unit=one.unit * u,
            )
            for one, u in zip(self.actuators, unit.tolist(), strict=True)
        ]
        J_a = self.actuation_jacobian / unit[:, None]
        return replace(self, actuators=tuple(actuators), actuation_jacobian=J_a)

    def unloaded(self, q: Array) -> Array:
        """``offset + l(q)``: where the motors are whose transmissions are not stretched ``(*batch, n_a)``."""
        return self.actuator_offset + self.lengths.length(q, self.actuation_jacobian)

    def bent(self, q: Array) -> Array:
        """``l(q) - J_a q``: what typical moment arms do not say of the lengths ``(*batch, n_a)``."""
        if self.lengths.constant:
            return np.zeros((*q.shape[:-1], self.n_a))
        return self.lengths.length(q, self.actuation_jacobian) - q @ self.actuation_jacobian.T

    @property
    def urdf_path(self) -> Path:
        return self.urdf.path

    @property
    def n_q(self) -> int:
        return len(self.joint_names)

    @property
    def n_a(self) -> int:
        return len(self.actuators)

    def pad_indices(self, names: Iterable[str]) -> list[int]:
        """Places of the pads of these names among :attr:`pads`.

        Raises:
            ValueError: there is no such pad.
        """
        pads = [pad.name for pad in self.pads]
        return [pads.index(name) for name in names]

    def pad_rows(self, names: Sequence[str]) -> tuple[list[int], list[int]]:
        """Which of the names are pads' and not links', and their places among :attr:`pads`."""
        pads = [pad.name for pad in self.pads]
        rows = [i for i, name in enumerate(names) if name in pads]
        return rows, [pads.index(names[i]) for i in rows]

    @property
    def actuator_names(self) -> tuple[str, ...]:
        return tuple(actuator.name for actuator in self.actuators)

    @property
    def actuator_lower(self) -> Array:
        return np.array([actuator.lower for actuator in self.actuators])

    @property
    def actuator_upper(self) -> Array:
        return np.array([actuator.upper for actuator in self.actuators])

    @property
    def actuator_offset(self) -> Array:
        return np.array([actuator.offset for actuator in self.actuators])

    @property
    def actuator_backlash(self) -> Array:
        return np.array([actuator.backlash for actuator in self.actuators])
