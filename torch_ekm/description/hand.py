"""What a hand is, as data: joints, actuators, the lengths of their tendons, springs, pads, sensors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from .._extras import require
from ..exceptions import DescriptionError
from ..typing import Array
from .urdf import UrdfModel

_STEP = 1e-5  # [rad] of differences between moment arms
_LEAST = 0.1  # of the largest arm of a joint's range: a mean arm below it is no measure of the others
_SAMPLES = 33  # angles of a joint's range at which arms are compared


class ArmFunction:
    """A moment arm over its joint's angle, with its integral from 0 and its slope: ``scipy`` polynomials.

    Args:
        arm: the arm [rad/rad] or [m].
        ends: between which it holds; it is straight beyond them.
    """

    def __init__(self, arm: Any, ends: tuple[float, float] = (-np.inf, np.inf)) -> None:
        self._ends, self._parts = ends, (arm.antiderivative(), arm, arm.derivative())
        self._start = 0.0
        self._start = float(self(np.zeros(()))[0])

    @classmethod
    def polynomial(cls, coefficients: Sequence[float]) -> ArmFunction:
        """``arm(q) = sum_k c_k q^k``."""
        made = require("scipy.interpolate").PPoly(np.array(coefficients)[::-1, None], [0.0, 1.0])
        return cls(made)

    @classmethod
    def table(cls, angle: Sequence[float], arm: Sequence[float]) -> ArmFunction:
        """The natural cubic spline through a table, twice differentiable, straight beyond its ends.

        Args:
            angle: two or more, increasing [rad].
            arm: there.
        """
        made = require("scipy.interpolate").CubicSpline(angle, arm, bc_type="natural")
        return cls(made, (angle[0], angle[-1]))

    def __call__(self, q: Array) -> tuple[Array, Array, Array]:
        """Integral from 0, arm and slope at these angles [rad]."""
        at = np.clip(q, *self._ends)
        (whole, arm, slope), beyond = (part(at) for part in self._parts), q - at
        return whole + beyond * (arm + 0.5 * beyond * slope) - self._start, arm + beyond * slope, slope

    def typical(self, lower: float, upper: float) -> float:
        """The mean arm over a joint's range, which makes its stroke right; where it is next to nothing, the
        largest."""
        return float(_typical(self(np.linspace(max(lower, -np.pi), min(upper, np.pi), _SAMPLES))[1]))


class Routed(Protocol):
    """Lengths that depend on several joints at a time: tendons on their ways, points that meet."""

    def __call__(self, q: Array) -> tuple[Array, Array]:
        """Lengths ``(n,)`` and their arms ``(n, n_q)`` at one posture ``(n_q,)``."""
        ...


@dataclass(frozen=True)
class Lengths:
    """``l(q)`` of n tendons, ``J = dl/dq = arms * ratio(q)`` and ``sum_i w_i d2l_i/dq2``.

    The arms that are given count: factors of the ``typical`` ones, of which the functions keep their shapes.
    """

    typical: Array
    """Typical arms ``(n, n_q)``; all that there is of constant ones."""
    functions: tuple[tuple[int, int, ArmFunction], ...] = ()
    """Row, joint and arm of those that change with their joint's angle alone."""
    routed: tuple[tuple[tuple[int, ...], Routed], ...] = ()
    """Rows of others."""

    @cached_property
    def constant(self) -> bool:
        """No arm changes."""
        return not (self.functions or self.routed)

    @cached_property
    def _at(self) -> tuple[list[int], list[int]]:
        return [row for row, *_ in self.functions], [joint for _, joint, _ in self.functions]

    def length(self, q: Array, arms: Array | None = None) -> Array:
        """``l(q)`` ``(*batch, n)``, 0 at zero angles where no tendon has a way of its own."""
        arms = self.typical if arms is None else arms
        found = q @ arms.T
        if self.functions:
            rows, joints = self._at
            share = arms[rows, joints] / self.typical[rows, joints]
            more = share * self._evaluated(q[..., joints])[0] - arms[rows, joints] * q[..., joints]
            for k, row in enumerate(rows):
                found[..., row] += more[..., k]
        for rows, routed in self.routed:
            length, _ = _each(routed, q)
            found[..., list(rows)] = length * self._shares(arms)[list(rows)]
        return found

    def ratio(self, q: Array) -> Array:
        """``J / arms`` ``(*batch, n, n_q)``; 1 where an arm is constant."""
        found = np.ones((*q.shape[:-1], *self.typical.shape))
        if self.functions:
            rows, joints = self._at
            arm = self._evaluated(q[..., joints])[1]
            found[..., rows, joints] = arm / self.typical[rows, joints]
        for rows, routed in self.routed:
            at = list(rows)
            whole = self.typical[at]
            J = _each(routed, q)[1]
            found[..., at, :] = np.divide(J, whole, out=np.ones_like(J), where=whole != 0)
        return found

    def jacobian(self, q: Array, arms: Array | None = None) -> Array:
        """``dl/dq`` ``(*batch, n, n_q)``."""
        return (self.typical if arms is None else arms) * self.ratio(q)

    def slope(self, q: Array) -> Array:
        """``d ratio_ij/dq_k`` ``(*batch, n, n_q, n_q)``."""
        n_q = q.shape[-1]
        found = np.zeros((*q.shape[:-1], *self.typical.shape, n_q))
        if self.functions:
            rows, joints = self._at
            bend = self._evaluated(q[..., joints])[2]
            found[..., rows, joints, joints] = bend / self.typical[rows, joints]
        for rows, routed in self.routed:
            at, shift = list(rows), _STEP * np.eye(n_q)
            ahead, back = (_each(routed, q[..., None, :] + way)[1] for way in (shift, -shift))
            change = np.moveaxis(ahead - back, -3, -1) / (2 * _STEP)
            whole = self.typical[at][..., None]
            found[..., at, :, :] = np.divide(change, whole, out=np.zeros_like(change), where=whole != 0)
        return found

    def curvature(self, q: Array, weight: Array, arms: Array | None = None) -> Array:
        """``sum_i w_i d2l_i/dq2`` ``(*batch, n_q, n_q)``, symmetric.

        Args:
            weight: ``(*batch, n)``.
        """
        arms = self.typical if arms is None else arms
        found = np.einsum("...i,ij,...ijk->...jk", weight, arms, self.slope(q))
        return (found + found.swapaxes(-1, -2)) / 2

    def largest(self, lower: Array, upper: Array) -> Array:
        """Sizes of the arms, at most, within the joints' limits: factors of the given ones ``(n, n_q)``."""
        if self.constant:
            return np.ones_like(self.typical)
        low, high = np.maximum(lower, -np.pi), np.minimum(upper, np.pi)
        part = np.linspace(0.0, 1.0, _SAMPLES)[:, None]
        straight = low + part * (high - low)
        mixed = low + np.random.default_rng(0).uniform(size=(_SAMPLES, len(low))) * (high - low)
        return np.abs(self.ratio(np.concatenate([straight, mixed]))).max(axis=0)

    def _evaluated(self, q: Array) -> Array:
        """Integrals, arms and slopes of the functions at their joints' angles, ``(3, *batch, n)``."""
        each = [function(q[..., k]) for k, (*_, function) in enumerate(self.functions)]
        return np.moveaxis(np.array(each), 0, -1)

    def _shares(self, arms: Array) -> Array:
        """How long each tendon is against the typical one ``(n,)``."""
        square = (self.typical**2).sum(axis=1)
        return np.divide(
            (arms * self.typical).sum(axis=1), square, out=np.ones_like(square), where=square > 0
        )


def _each(routed: Routed, q: Array) -> tuple[Array, Array]:
    """Of every posture of a batch."""
    flat = q.reshape(-1, q.shape[-1])
    lengths, arms = zip(*map(routed, flat), strict=True)
    length, J = np.stack(lengths), np.stack(arms)
    return length.reshape(*q.shape[:-1], -1), J.reshape(*q.shape[:-1], *J.shape[1:])


@dataclass(frozen=True)
class TendonSprings:
    """Springs over tendons: ``V = sum_t k_t/2 (l_t - clip(l_t, low_t, high_t))^2``; no force in between."""

    names: tuple[str, ...]
    lengths: Lengths
    stiffness: Array
    """``(n,)`` [N/m], [N m/rad] where a length is an angle."""
    low: Array
    """Shorter ones push, ``(n,)``; -inf where the tendon only pulls."""
    high: Array
    """Longer ones pull, ``(n,)``."""

    def tension(self, q: Array) -> Array:
        """Pull of each tendon ``(*batch, n)`` [N]; negative: it pushes."""
        length = self.lengths.length(q)
        return self.stiffness * (length - np.clip(length, self.low, self.high))

    def torque(self, q: Array) -> Array:
        """``dV/dq`` ``(*batch, n_q)`` [N m]."""
        return (self.tension(q)[..., None, :] @ self.lengths.jacobian(q))[..., 0, :]

    def stiffness_matrix(self, q: Array) -> Array:
        """``d2V/dq2 = J^T k J + sum_t tension_t d2l_t/dq2`` ``(*batch, n_q, n_q)`` [N m/rad]."""
        tension, J = self.tension(q), self.lengths.jacobian(q)
        k = np.where(tension != 0, self.stiffness, np.where(self.low == self.high, self.stiffness, 0.0))
        return J.swapaxes(-1, -2) @ (k[..., None] * J) + self.lengths.curvature(q, tension)


@dataclass(frozen=True)
class Loops:
    """``c(q) = l(q) - value = 0``: chains that close, joints that follow others along a curve."""

    names: tuple[str, ...]
    lengths: Lengths
    value: Array

    def gap(self, q: Array) -> Array:
        """``c(q)`` ``(*batch, n)``."""
        return self.lengths.length(q) - self.value


def typical_arms(routed: Routed, lower: Array, upper: Array, rest: Array) -> Array:
    """Mean arms ``(n, n_q)`` of lengths on ways of their own; never 0 where they have any."""
    low, high = np.maximum(lower, rest - np.pi), np.minimum(upper, rest + np.pi)
    draw = np.random.default_rng(0).uniform(size=(_SAMPLES, len(low)))
    found = _typical(np.stack([routed(q)[1] for q in [rest, *(low + draw * (high - low))]]))
    return np.where(np.abs(found) > 1e-12, found, 0.0)


def _typical(arms: Array) -> Array:
    """The mean of arms at several postures ``(n, ...)``; where it is next to nothing, the largest."""
    mean, largest = arms.mean(axis=0), np.take_along_axis(arms, np.abs(arms).argmax(axis=0)[None], axis=0)[0]
    return np.where(np.abs(mean) > _LEAST * np.abs(largest), mean, largest)


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
