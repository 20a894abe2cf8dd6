"""Tendons, couplings, springs and joint friction as one implicit drive per joint."""

from __future__ import annotations

import copy
import functools
from dataclasses import dataclass

import numpy as np

from ...description.hand import HandDescription, Lengths
from ...typing import Array
from ..parameters import PlantParameters

_COUPLING_STIFFNESS = 8.0  # [N m/rad] at least, of a coupling between fingers: twice that of the motors
_LOOP_STIFFNESS = 100.0  # [N m/rad] of loops, and couplings within a finger: as rigid as an actuator may be
_BRISTLE_STIFFNESS = 3.0  # k_f [N m/rad]
_LEANS = 5e-3  # [N m] from which a joint with play is at its end; smooth, as a planner needs it
_STIFF = 20.0  # [N m/rad] at a joint; up to here the late part damps little


@dataclass(frozen=True)
class JointShape:
    """How far pulleys are from round, and springs from linear::

        h_j(q) = q - (v/2) (cos(2 q + phase_j) - cos phase_j)      excursion J_a h(q), arms J_a h'(q)
        k x (1 + s x^2)                                            x from the spring's rest

    Source: the arm of a tendon is the derivative of its excursion, An et al., J. Biomech. 16 (1983); the
    cubic spring is that of Duffing (1918).
    """

    variation: Array
    """v of each joint ``(n_q,)``."""
    phase: Array
    """Of each joint ``(n_q,)`` [rad]."""
    stiffening: float
    """s [1/rad^2]."""

    @functools.cached_property
    def _round(self) -> bool:
        return not self.variation.any()

    def excursion(self, q: Array) -> Array:
        """h(q) ``(*batch, n_q)`` [rad]; with round pulleys q itself."""
        if self._round:  # asked at every time step
            return q
        return q - 0.5 * self.variation * (np.cos(2 * q + self.phase) - np.cos(self.phase))

    def arm(self, q: Array) -> Array:
        """h'(q) ``(*batch, n_q)``."""
        if self._round:
            return np.ones_like(q)
        return 1 + self.variation * np.sin(2 * q + self.phase)

    def spring(self, x: Array) -> Array:
        """``x (1 + s x^2)`` ``(*batch, n_q)`` [rad]; of a linear spring x itself."""
        return x if self.stiffening == 0 else x * (1 + self.stiffening * x**2)


class Transmission:
    """The torque on the joints of a hand whose motors stand at ``m``::

        tau = -K_s (q - q0) + J_a^T k_a (m - a0 - J_a q) - C^T k_c C (q - q0) - tau_f

    A rigid coupling (index, ring and little spread alike) is a spring ``k_c`` from the joints that follow
    to those that lead, and the actuators act on the joints that lead alone: ``J_a`` above stands for
    ``J_a S``, with ``q0 + S (q - q0)`` the posture whose followers obey the couplings. So a coupled joint
    that leads is as stiff as if the coupling were rigid, for any ``k_c``.

    PhysX integrates a joint drive implicitly and an external torque explicitly, which is unstable
    for tendons as stiff as these. So each joint gets one drive, whose stiffness is the diagonal of
    the matrix above, and whose target is recomputed at every step from the other joints of its
    tendon: the equilibrium is the exact one, and only the off-diagonal part acts one step late.

    A late part damps joint motions that leave the tendon's length as it is by ``k dt``: at 100 N m/rad and
    1 ms they settle in a second. So a ``stiff`` transmission is given ``q + dt v``, and its drives have the
    sums of the rows of ``|K|``, which no eigenvalue exceeds: stable for every stiffness and number of joints.

    ``tau_f`` is Coulomb friction with presliding (Dahl 1968): a bristle of stiffness ``k_f`` from the
    joint to an anchor that slips when the bristle carries the friction torque. It belongs to the
    same drive. PhysX's own joint friction is a fraction of the momentum, not a torque: not used.

    Moment arms may change with the posture: ``J_a q`` is then ``l(q)``. Springs over tendons pull along
    ``dl/dq``; loops are held by springs of 100 N m/rad at their joints.

    Pulleys that are not round and springs that are not linear (``shape``) put ``h(q)`` in the place of q at
    the tendons, ``h'(q)`` on their arms, and ``x (1 + s x^2)`` in the place of ``q - q0``. What the cables
    lose is among the ``parameters``::

        |tau_f| <= friction + cable_friction |arm^T T|      Coulomb friction of the joint and of its cables
        T  = K s + z,  |z| <= (hysteresis/2) k |s|,  dz = k ds while it may grow
        K^-1 = D (I + tendon_coupling (1 1^T - I)) D,  D = diag(k)^(-1/2)
        no torque goes through a joint while it is within its play

    Source: a cable round a pulley over the angle w loses the share ``1 - exp(-mu w)`` of its tension (Euler
    and Eytelwein): cable friction; the elastic hysteresis is that of Masing (1926) with one element;
    actuators on one frame that gives way are springs in series with a common one: coupling.

    Args:
        hand: as it really is; the model's may be another.
        parameters: losses of the cables, ``tendon_creep``, and ``joint_law``, of which this has a copy.
        shape: of pulleys and springs.
        play: full width of each joint's ``(n_q,)`` [rad].
    """

    def __init__(
        self, hand: HandDescription, parameters: PlantParameters, shape: JointShape, play: Array
    ) -> None:
        self.stiffness = stiffness = np.array([actuator.stiffness for actuator in hand.actuators])
        """Series stiffness k_a of each actuator, ``(n_a,)`` [N m/rad]."""
        limits = hand.joint_lower, hand.joint_upper
        self.n_a, self.n_q = hand.n_a, hand.n_q
        self.J_a = hand.actuation_jacobian
        self.offset = hand.actuator_offset
        """a0, which grows as a tendon lengthens ``(n_a,)`` [rad]."""
        coupling = hand.coupling.reshape(-1, hand.n_q)
        S = coupled_posture(coupling)
        away = np.eye(hand.n_q) - S  # how far each follower is from where it should be
        self._lead, self._S = self.J_a @ S, S
        self._lengths = None if hand.lengths.constant else hand.lengths
        self._springs, self._loops = hand.tendon_springs, hand.loops
        self._M = np.vstack([self._lead, away[np.abs(away).max(axis=1) > 0]])
        self._k = np.concatenate([stiffness, self._coupling_stiffness(hand, coupling)])
        self._pulls_only = np.concatenate(
            [[actuator.tendon for actuator in hand.actuators], np.zeros(len(coupling), bool)]
        ).astype(bool)
        self._any_tendon, self._any_play = bool(self._pulls_only.any()), bool(play.any())
        self.spring_stiffness, self.spring_rest = hand.spring_stiffness, hand.spring_rest
        self.friction = hand.joint_friction
        self.shape, self.play, self._p = shape, play, parameters
        self.law = copy.deepcopy(parameters.joint_law)
        self._followed = (self.J_a - self._lead) @ shape.excursion(self.spring_rest)
        self._apart = self._M[self.n_a :] @ self.spring_rest
        rubs = (self.friction > 0) | ((parameters.cable_friction > 0) & self._lead.any(axis=0))
        self._k_f = np.where(rubs, _BRISTLE_STIFFNESS, 0.0)
        self._bends = self._reach(self.friction)
        varied = 1.0 if self._lengths is None else hand.lengths.largest(*limits)
        tied = []
        if (springs := hand.tendon_springs) is not None:
            tied.append((springs.stiffness, springs.lengths.typical * springs.lengths.largest(*limits)))
        if (loops := hand.loops) is not None:
            arms = loops.lengths.typical * loops.lengths.largest(*limits)
            self._k_l = _LOOP_STIFFNESS / (arms**2).max(axis=1)
            tied.append((self._k_l, arms))
        strong = [(stiffness, self.J_a * varied), (self._k[self.n_a :], self._M[self.n_a :]), *tied]
        self.stiff = bool(max((k[:, None] * arms**2).max(initial=0.0) for k, arms in strong) > _STIFF)
        """Some actuator is: :meth:`drive_targets` takes the joints as they will be after the step."""
        root, shared = 1 / np.sqrt(stiffness), parameters.tendon_coupling
        self._compliance = root[:, None] * (shared + (1 - shared) * np.eye(self.n_a)) * root
        """``K^-1`` ``(n_a, n_a)`` [rad/(N m)]."""
        steep = self._k.copy()
        steep[: self.n_a] *= 1 / (1 - shared) + (parameters.hysteresis > 0)  # bound of dT/ds
        size = np.abs(np.concatenate([self._lead * varied, self._M[self.n_a :], *(arms for _, arms in tied)]))
        steep = np.concatenate([steep, *(k for k, _ in tied)])
        carried = (steep * size.sum(axis=1)) @ size if self.stiff else steep @ size**2
        farthest = np.maximum(hand.joint_upper - self.spring_rest, self.spring_rest - hand.joint_lower)
        springs = self.spring_stiffness * np.maximum(1.0, 1 + 3 * shape.stiffening * farthest**2)
        self._turned = springs + carried * (1 + np.abs(shape.variation)) ** 2
        self.drive_stiffness = self._turned + self._k_f
        """Stiffness of each joint's drive ``(n_q,)`` [N m/rad], while all tendons are taut."""
        self.relax(self.spring_rest)

    @staticmethod
    def _coupling_stiffness(hand: HandDescription, coupling: Array) -> Array:
        """``k_c`` of each coupling [N m/rad]: what bears in the linkage of a finger is rigid."""
        series = [one.stiffness for one in hand.actuators if one.stiffness < _LOOP_STIFFNESS]  # not rigid
        between = max(_COUPLING_STIFFNESS, 2 * max(series, default=0.0))
        fingers = [{joint.name for joint in hand.urdf.joints_to(pad.link)} for pad in hand.pads]
        tied = [{hand.joint_names[joint] for joint in np.flatnonzero(row)} for row in coupling]
        linkage = [len(tie) > 1 and any(tie <= finger for finger in fingers) for tie in tied]
        return np.where(linkage, _LOOP_STIFFNESS, between)

    def length(self, q: Array) -> Array:
        """``l(q)`` of the actuators, ``(*batch, n_a)``, with followers where they are."""
        excursion = self.shape.excursion(q)
        return excursion @ self.J_a.T if self._lengths is None else self._lengths.length(excursion, self.J_a)

    def arms(self, q: Array) -> Array:
        """dl/dq of the actuators over the excursion, ``(*batch, n_a, n_q)`` or ``(n_a, n_q)``."""
        if self._lengths is None:
            return self.J_a
        return self._lengths.jacobian(self.shape.excursion(q), self.J_a)

    def _leading(self, q: Array) -> Array:
        """The excursion at which followers obey the couplings."""
        rest = self.shape.excursion(self.spring_rest)
        return rest + self._S @ (self.shape.excursion(q) - rest)

    def relax(self, q: Array) -> None:
        """Put the friction's anchors at ``q``: no friction torque, no hysteresis, joints amid their play."""
        self._anchor = np.array(q, dtype=np.float64)
        self._lean = np.zeros(self.n_q)
        self._bent: tuple[Array, Array] | None = None

    def stretch(self, q: Array, motor: Array) -> Array:
        """``m - a0 - J_a q``: elastic stretch of each transmission [rad]; negative: a tendon is slack."""
        if self._lengths is None:
            return motor - self.offset - self._followed - self._lead @ self.shape.excursion(q)
        return motor - self.offset - self._lengths.length(self._leading(q), self.J_a)

    def actuator_torque(self, q: Array, motor: Array) -> Array:
        """``-lam``: torque of each actuator along ``+a`` [N m]; never negative for a tendon."""
        torque = self._pull(self.stretch(q, motor))
        return np.where(self._pulls_only[: self.n_a], np.maximum(torque, 0.0), torque)

    def _pull(self, stretch: Array) -> Array:
        """Torque of each actuator; of coupled ones, of those that are taut."""
        if self._p.tendon_coupling == 0:
            return self.stiffness * stretch
        taut = np.ones(self.n_a, dtype=bool)
        while True:
            torque = np.zeros(self.n_a)
            torque[taut] = np.linalg.solve(self._compliance[np.ix_(taut, taut)], stretch[taut])
            slack = taut & self._pulls_only[: self.n_a] & (torque < 0)
            if not slack.any():
                return torque
            taut &= ~slack

    def stretched(self, torque: Array) -> Array:
        """Stretch at which the actuators give such torques ``(*batch, n_a)`` [rad], without hysteresis."""
        return torque @ self._compliance

    def lean(self, load: Array) -> Array:
        """How far transmissions at rest are ahead of joints under ``load`` [N m], ``(*batch, n_q)`` [rad]."""
        return self.play / 2 * np.clip(load / _LEANS, -1.0, 1.0)

    def spring_torque(self, q: Array) -> Array:
        """``k x (1 + s x^2)``, ``x = q - q0``: what the springs oppose ``(*batch, n_q)`` [N m]."""
        torque = self.spring_stiffness * self.shape.spring(q - self.spring_rest)
        if self._springs is not None:
            torque = torque + self.shape.arm(q) * self._springs.torque(self.shape.excursion(q))
        return torque

    def drive_targets(self, q: Array, motor: Array) -> Array:
        """Targets that make the drives give the torque above at ``q`` ``(n_q,)`` [rad].

        A slack tendon takes its stiffness with it: the target then undoes the drive's share.
        """
        inner = q + self._lean
        stretch = self.stretch(inner, motor)
        pull = self._pull(stretch)
        if self._p.hysteresis > 0:
            pull = pull + self._hysteresis(stretch)
        apart = self._M[self.n_a :] @ inner - self._apart
        force = np.concatenate([pull, -self._k[self.n_a :] * apart])
        if self._any_tendon:
            force[self._pulls_only & (force < 0)] = 0.0
        along = force @ self._M if self._lengths is None else self._along(self._lengths, inner, force)
        cables = self.shape.arm(inner) * along
        torque = cables - self.spring_torque(inner)
        if self.law is not None:
            torque = torque + self.law(inner, force[: self.n_a])
        if self._loops is not None:
            excursion = self.shape.excursion(inner)
            away = self._k_l * self._loops.gap(excursion)
            torque = torque - self.shape.arm(inner) * (away @ self._loops.lengths.jacobian(excursion))
        if self._any_play:
            whole = torque + self._turned * self._lean
            half = self.play / 2
            self._lean = np.clip(whole / self._turned, -half, half)
            torque = whole - self._turned * self._lean
        # the anchor follows where the bristle would carry more than friction
        capstan = self._p.cable_friction
        reach = self._reach(self.friction + capstan * np.abs(cables)) if capstan > 0 else self._bends
        slip = np.minimum(np.maximum(q - self._anchor, -reach), reach)  # np.clip takes twice as long
        self._anchor = q - slip
        return q + (torque - self._k_f * slip) / self.drive_stiffness

    def _along(self, lengths: Lengths, q: Array, force: Array) -> Array:
        """What forces of actuators and couplings do along the excursion ``(n_q,)``."""
        J_a = lengths.jacobian(self._leading(q), self.J_a) @ self._S
        return force[: self.n_a] @ J_a + force[self.n_a :] @ self._M[self.n_a :]

    def _reach(self, friction: Array) -> Array:
        """How far a bristle bends until it carries the friction torque ``(n_q,)`` [rad]."""
        return np.divide(friction, self._k_f, out=np.zeros_like(friction), where=self._k_f > 0)

    def _hysteresis(self, stretch: Array) -> Array:
        """What the transmissions hold against their motion ``(n_a,)`` [N m]."""
        last, held = (stretch, np.zeros(self.n_a)) if self._bent is None else self._bent
        most = 0.5 * self._p.hysteresis * np.abs(self.stiffness * stretch)
        held = np.clip(held + self.stiffness * (stretch - last), -most, most)
        self._bent = stretch, held
        return held

    def lengthen(self, amount: float) -> None:
        """Make every tendon longer for good [rad at the actuator]; looped cables keep their length."""
        self.offset = self.offset + amount * self._pulls_only[: self.n_a]

    def age(self, q: Array, motor: Array, duration: float) -> None:
        """Creep: ``da0/dt = creep * torque`` for every tendon."""
        if (creep := self._p.tendon_creep) > 0:
            torque = self.actuator_torque(q, motor)
            self.offset = self.offset + creep * duration * torque * self._pulls_only[: self.n_a]

    def take_over(self, other: Transmission, q: Array, motor: Array) -> None:
        """Go on from another transmission without a jolt: each actuator turns its joints as hard as
        before, ``J^T k s = J_o^T k_o s_o``, which says how much the new tendon is stretched."""
        along = np.einsum("aq,aq->a", self._lead, other._lead) / np.einsum("aq,aq->a", self._lead, self._lead)
        stretch = self.stretched(along * other._pull(other.stretch(q, motor)))
        self.offset = self.offset + self.stretch(q, motor) - stretch
        half = self.play / 2
        self._anchor, self._lean, self._bent = other._anchor, np.clip(other._lean, -half, half), None


def coupled_posture(coupling: Array) -> Array:
    """``S`` with ``C S = 0``: the last joint of each coupling follows, the others lead ``(n_q, n_q)``."""
    rows, following = np.array(coupling, dtype=np.float64), []
    for k, row in enumerate(rows):
        joint = int(np.flatnonzero(np.abs(row) > 1e-12)[-1])
        row /= row[joint]
        share = np.where(np.arange(len(rows)) == k, 0.0, rows[:, joint])
        rows -= np.outer(share, row)
        following.append(joint)
    posture = np.eye(rows.shape[1])
    posture[following] = -rows
    posture[following, following] = 0.0
    return posture
