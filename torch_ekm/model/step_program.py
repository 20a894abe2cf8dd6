"""The program of one step: a grasp at one state, put together with the laws of its hand."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
import torch
from numpy.typing import NDArray

from .._arrays import in_numpy
from ..contact.contacts import (
    CHARACTERISTIC_LENGTH,
    ContactKinematics,
    ContactModel,
    ContactSet,
    Detector,
    full_grasp_matrix,
    full_hand_jacobian,
)
from ..contact.forces import ForceStatus, friction_cones, margins
from ..description.hand import HandDescription
from ..exceptions import NoContactError
from ..kinematics.poses import GraspState, Kinematics, LinkPoses
from ..kinematics.se3 import hat
from ..typing import AnyArray, Array, Tensor
from .contact_laws import Response, StepProblem, StepSolution
from .grasp_forces import pack_forces
from .linearization import FollowedFigures, Linearization, normal_motion, sensitivities
from .reduction import Drives, Reduction
from .stiffness import arms_at, bends
from .validity import ModelOptions, find_doubts

L = CHARACTERISTIC_LENGTH
_LENGTHS = np.array([L, L, L, 1.0, 1.0, 1.0])[:, None]
_NONE = np.zeros(3)


@runtime_checkable
class GraspModel(Protocol):
    """What is asked of a model of hand and object: :class:`~torch_ekm.model.KinematicModel`."""

    hand: HandDescription
    options: ModelOptions
    kinematics: Kinematics
    reduction: Reduction
    spring_rest: Tensor
    figures: FollowedFigures | None

    @property
    def touch_detector(self) -> Detector: ...

    def contact_kinematics(
        self, state: GraspState, contacts: ContactSet, *, poses: LinkPoses | None = None
    ) -> ContactKinematics: ...

    def potential(self, state: GraspState) -> tuple[Any, Any]: ...

    def load_stiffness(self, kin: ContactKinematics, force: AnyArray, spin_moment: AnyArray) -> Any: ...


@dataclass(frozen=True)
class ContactLoads:
    """Forces that finger and object exchange, by contact; what is not named bears nothing."""

    force: dict[str, Array]
    """f_i of the finger on the object, hand axes [N]."""
    spin: dict[str, float]
    """About the inward normal [N m]."""
    pull: Array
    """Force of each actuator along +a, ``(n_a,)`` [N m]; of a tendon below 0 where it is slack, by what it
    would have to be shortened times its stiffness."""
    stop: Array
    """Torque of joint stops on the joints, ``(n_q,)`` [N m]."""
    loop: Array
    """Forces of the loops, ``(n_l,)``."""


class PlacedGrasp:
    """Matrices of one state and its contacts in permitted, scaled coordinates z: ``ds = S z``.

    Args:
        model: its detector finds pads and links.
        state: where.
        contacts: there.
        poses: of the links there.
        springs: change of their stiffness against the description, ``(n_q,)`` [N m/rad].
    """

    def __init__(
        self, model: GraspModel, state: GraspState, contacts: ContactSet, poses: LinkPoses, springs: Array
    ) -> None:
        self.state, self.contacts = state, contacts
        at, near = in_numpy(state), in_numpy(contacts)
        self.kin: ContactKinematics = model.contact_kinematics(at, near, poses=poses)
        self._model = model
        kin, S = self.kin, model.reduction.scaled_basis.numpy()
        A = np.concatenate([full_hand_jacobian(kin), -full_grasp_matrix(kin).mT], axis=-1) @ S
        A = A.reshape(contacts.n_c, 6, S.shape[1]) / _LENGTHS
        self.normal_rate = A[:, 0]  # how fast the finger nears the object
        mu_s, gamma, self.frame = (np.asarray(x) for x in (near.friction, near.torsional_friction, kin.frame))
        # where a contact slides, its point moves over the object by M K_f v and over the finger by -M K_o v
        slide = L * self.frame[:, :, 1:] @ A[:, 1:3]  # v of hand axes, (n_c, 3, n_z)
        mobility, K_o = kin.mobility, near.object_curvature
        self._object_run = mobility @ near.finger_curvature @ slide
        self._finger_run = -mobility @ K_o @ slide
        turn = normal_motion(kin, S) + K_o @ self._object_run  # (n_c, 3, n_z)
        d = max([len(one.rows) - 1 for one in kin.models], default=0)
        n_c, n_z = contacts.n_c, S.shape[1]
        self.mu_s, self.T, self.turn = mu_s, np.zeros((n_c, d, n_z)), np.zeros((n_c, d, n_z))
        self.spin_scale = np.zeros(n_c)  # [N m] of spin for a force of 1 N times L
        for i, one in enumerate(kin.models):
            n = len(one.rows) - 1
            self.T[i, :n] = A[i, 1 : n + 1]
            if one is ContactModel.SOFT_FINGER:
                self.spin_scale[i] = gamma[i] / (mu_s[i] * L)
                self.T[i, 2] *= self.spin_scale[i]
            self.turn[i, : min(n, 2)] = self.frame[i, :, 1 : 1 + min(n, 2)].T @ turn[i]
        V_s, self._V_ss = model.potential(at)
        n_q = len(springs)
        V_s[:n_q] += springs * (at.q - model.spring_rest.numpy())
        self._V_ss[:n_q, :n_q] += np.diag(springs)
        self.torque = V_s @ S
        self._arms, self._S_q, loops = arms_at(model.hand, at.q), S[:n_q], model.hand.loops
        self.closed = np.zeros((0, S.shape[1])) if loops is None else self._arms.closed @ self._S_q
        """dc/dz of the loops ``(n_l, n_z)``."""
        self.gap = np.zeros(0) if loops is None else loops.gap(state.q.numpy())
        """c(q)."""

    def along(self, J_a: Array) -> Array:
        """dl/dz of the actuators ``(n_a, n_z)``; J_a: of the description, or as it is known."""
        return np.asarray(self._arms.of(J_a) @ self._S_q)

    def stiffness(self, loads: ContactLoads) -> Array:
        """``Z^T D Z`` at these forces, which turn with the normals."""
        contacts, model = self.contacts, self._model
        force = np.array([loads.force.get(name, _NONE) for name in contacts.finger])
        spin = np.array([loads.spin.get(name, 0.0) for name in contacts.finger])
        S = model.reduction.scaled_basis.numpy()
        D = model.load_stiffness(self.kin, force, spin) + self._V_ss
        if self._arms.varies:
            n_q, J_a = model.hand.n_q, model.reduction.actuation.detach().numpy()
            D[:n_q, :n_q] += bends(model.hand, self.state.q.numpy(), J_a, -loads.pull, loads.loop)
        D = S.T @ D @ S
        f_hat = hat(force)
        spin_f = (self.kin.spin_jacobian @ S[: model.hand.n_q]).swapaxes(1, 2)
        D -= (spin_f @ f_hat @ self._finger_run).sum(0)
        D += S[-3:].T @ (f_hat @ self._object_run).sum(0)
        lam, t = self.components(loads)
        inward = (t[:, :, None] * self.turn).sum(1)
        D += self.normal_rate.T @ inward
        D -= self.T.reshape(-1, len(D)).T @ (lam[:, None, None] * self.turn).reshape(-1, len(D))
        return D

    def components(self, loads: ContactLoads) -> tuple[Array, Array]:
        """Normal forces ``(n_c,)`` and tangential ones ``(n_c, d)``, in contact frames [scaled]."""
        n_c, d = self.T.shape[:2]
        lam, t = np.zeros(n_c), np.zeros((n_c, d))
        for i, name in enumerate(self.contacts.finger):
            if name in loads.force:
                local = L * (self.frame[i].T @ loads.force[name])
                lam[i] = local[0]
                t[i, :2] = local[1 : 1 + min(d, 2)]
                if d == 3 and self.spin_scale[i] > 0:
                    t[i, 2] = loads.spin[name] / self.spin_scale[i]
        return lam, t

    def loads(self, lam: Array, t: Array, pull: Array, stop: Array, loop: Array) -> ContactLoads:
        """The inverse of :meth:`components`."""
        n_c, d = t.shape
        local = np.zeros((n_c, 3))
        local[:, 0] = lam
        local[:, 1 : 1 + min(d, 2)] = t[:, :2]
        names = self.contacts.finger
        force = (self.frame @ local[:, :, None])[..., 0] / L
        spin = t[:, 2] * self.spin_scale if d == 3 else np.zeros(n_c)
        return ContactLoads(
            dict(zip(names, force, strict=True)),
            dict(zip(names, spin.tolist(), strict=True)),
            pull,
            stop,
            loop,
        )

    def follow(self, increment: Array, loads: ContactLoads) -> Array:
        """The least motion of the joints after which contacts that bear are where they were, ``(n_s,)``."""
        S, n_y = self._model.reduction.scaled_basis.numpy(), self._model.reduction.joint_basis.shape[1]
        bears = self.components(loads)[0] > 0
        rows = np.concatenate([self.normal_rate[:, None], self.T], axis=1)[bears].reshape(-1, S.shape[1])
        away = rows @ np.linalg.lstsq(S, increment, rcond=None)[0]
        back = np.linalg.lstsq(rows[:, :n_y], away, rcond=1e-3)[0]
        return np.asarray(-S[:, :n_y] @ back, dtype=np.float64)

    def turned(self, lam: Array, t: Array, lam_0: Array, t_0: Array, z: Array) -> tuple[Array, Array]:
        """Components in the frames of this state, from those in frames that turned with the normals by z."""
        turn = self.turn @ z
        return lam + (t_0 * turn).sum(1), t - lam_0[:, None] * turn


COMPLIANCE = 1e-6
"""Of contacts and stops [rad/(N m)]."""
_STOP_RANGE = 0.15  # [rad] from a joint's stop where the stop is in the program


class StepProgram(NamedTuple):
    """What is to be solved, and the forces to begin with."""

    problem: StepProblem
    lam: Array
    t: Array
    low: NDArray[np.int64]
    """Joints whose lower stop is in it."""
    high: NDArray[np.int64]
    rod: Array
    """Norms of the rows of the loops, by which they are divided."""


class Way(NamedTuple):
    """How far a step has come."""

    first: PlacedGrasp
    """Where it began."""
    pull: Array
    """Of the actuators there, ``(n_a,)`` [N m]."""
    da: Array
    """All of the step [rad]."""
    total: Array
    """z so far."""


class HandLaws:
    """Actuators and joint stops of a hand in permitted, scaled coordinates z: ``p = K_a (a - a_0 - J_a q)``,
    ``p >= 0`` of tendons, ``q_min <= q <= q_max``.

    Args:
        model: of the hand.
        drives: moment arms and stiffnesses of the actuators.
    """

    def __init__(self, model: GraspModel, drives: Drives) -> None:
        self.model, self.hand = model, (hand := model.hand)
        self.joints, self.S = model.reduction.joint_basis.numpy(), model.reduction.scaled_basis.numpy()
        self.J_a, self.K = (x.detach().double().numpy() for x in drives)
        self._B = np.zeros((hand.n_a, self.S.shape[1]))
        self._B[:, : self.joints.shape[1]] = self.J_a @ self.joints
        tendon = np.array([actuator.tendon for actuator in hand.actuators], dtype=bool)
        self.tendon = tendon & (model.options.slack_tension is not None)
        self.soft = np.isfinite(self.K)
        self.springs = np.flatnonzero(self.soft & ~self.tendon)
        """Actuators whose compliance stands in the stiffness: rods."""
        self.cables = np.flatnonzero(self.tendon | ~self.soft)
        """The others: tendons, and what is rigid."""
        moves = np.abs(self.joints).sum(1) > 1e-9
        self._stops = np.flatnonzero(moves & np.isfinite(hand.joint_lower + hand.joint_upper))

    def arms(self, at: PlacedGrasp) -> Array:
        """B: dl/dz of the actuators ``(n_a, n_z)``."""
        return self._B if self.hand.lengths.constant else at.along(self.J_a)

    def length(self, q: Array) -> Array:
        """l(q) ``(n_a,)``."""
        return self.hand.lengths.length(q, self.J_a)

    def _lengthened(self, here: PlacedGrasp, way: Way) -> Array:
        """By how much l(q) has grown in the step so far ``(n_a,)``."""
        if self.hand.lengths.constant:
            return self._B @ way.total
        return self.length(here.state.q.numpy()) - self.length(way.first.state.q.numpy())

    def program(
        self, here: PlacedGrasp, loads: ContactLoads, way: Way, gap: Array, load: Array, damping: float
    ) -> StepProgram:
        """Of what is left of a step.

        Args:
            here: where it has come to, with the forces ``loads``.
            gap: of the contacts [m].
            load: constant, of all equilibria [scaled].
            damping: added to the stiffness [N m/rad].
        """
        hand, cables, springs, total = self.hand, self.cables, self.springs, way.total
        q, at = here.state.q.numpy(), self._stops
        lam, t = here.components(loads)
        low = at[q[at] - hand.joint_lower[at] < _STOP_RANGE]
        high = at[hand.joint_upper[at] - q[at] < _STOP_RANGE]
        stops = np.zeros((len(low) + len(high), len(total)))
        stops[:, : self.joints.shape[1]] = np.concatenate([self.joints[low], -self.joints[high]])
        room = np.concatenate([q[low] - hand.joint_lower[low], hand.joint_upper[high] - q[high]])
        pressed = np.concatenate([loads.stop[low], -loads.stop[high]]).clip(min=0.0)
        n_c, n_stop = len(gap), len(room)
        arms, grown = self.arms(here), self._lengthened(here, way)
        B, K = arms[springs], self.K[springs]
        pull = way.pull[springs] + K * (way.da[springs] - grown[springs])
        n_l, rod = len(here.closed), np.maximum(np.sqrt((here.closed**2).sum(1)), 1e-12)
        problem = StepProblem(
            D=here.stiffness(loads) + B.T @ (K[:, None] * B) + damping * np.eye(len(total)),
            load=here.torque - load - B.T @ pull,
            E=np.concatenate([-here.normal_rate, arms[cables], stops, here.closed / rod[:, None]]),
            gap=np.concatenate(
                [gap / L, grown[cables] - way.da[cables], room, (here.gap - way.first.gap) / rod]
            ),
            compliance=np.concatenate(
                [np.full(n_c, COMPLIANCE), 1 / self.K[cables], np.full(n_stop, COMPLIANCE), np.zeros(n_l)]
            ),
            before=np.concatenate([lam.clip(min=0.0), way.pull[cables], pressed, -rod * loads.loop]),
            one_sided=np.concatenate(
                [np.ones(n_c, bool), self.tendon[cables], np.ones(n_stop, bool), np.zeros(n_l, bool)]
            ),
            T=here.T,
            way=_slid(here, way.first, total),
            tangential_compliance=COMPLIANCE,
            t_before=t,
            mu_s=here.mu_s,
        )
        now = loads.pull[cables]
        now = np.where(self.tendon[cables], now.clip(min=0.0), now)
        return StepProgram(problem, np.concatenate([lam, now, pressed, -rod * loads.loop]), t, low, high, rod)

    def loads(self, here: PlacedGrasp, program: StepProgram, answer: StepSolution, way: Way) -> ContactLoads:
        """Forces after a program's answer."""
        n_c, n_k = here.contacts.n_c, len(self.cables)
        lam, t = here.turned(answer.lam[:n_c], answer.t, program.lam[:n_c], program.t, answer.z)
        stretch = way.da - (self._lengthened(here, way) + self.arms(here) @ answer.z)
        pull = way.pull + np.where(self.soft, self.K, 0.0) * np.where(self.soft, stretch, 0.0)
        bearing = answer.lam[n_c : n_c + n_k]
        slack = self.tendon[self.cables] & (bearing <= 0)
        pull[self.cables] = np.where(slack, pull[self.cables].clip(max=0.0), bearing)
        n_l = len(program.rod)
        loop = -answer.lam[len(answer.lam) - n_l :] / program.rod
        return here.loads(lam, t, pull, self.stop_torque(program, answer), loop)

    def stop_torque(self, program: StepProgram, answer: StepSolution) -> Array:
        """Of the stops on the joints, ``(n_q,)`` [N m]."""
        n = len(program.problem.mu_s) + len(self.cables)
        stop, n_low = np.zeros(self.hand.n_q), n + len(program.low)
        np.add.at(stop, program.low, answer.lam[n:n_low])
        np.add.at(stop, program.high, -answer.lam[n_low : n_low + len(program.high)])
        return stop

    def unbalance(self, grasp: PlacedGrasp, loads: ContactLoads) -> Array:
        """``V_s + A^T mu + B^T lam`` less the torque of the stops [scaled]."""
        lam, t = grasp.components(loads)
        pull = np.where(self.tendon, loads.pull.clip(min=0.0), loads.pull)
        contact = grasp.normal_rate.T @ lam + np.einsum("idz,id->z", grasp.T, t)
        load = grasp.torque + contact - self.arms(grasp).T @ pull + grasp.closed.T @ loads.loop
        load[: self.joints.shape[1]] -= self.joints.T @ loads.stop
        return load

    def response(self, here: PlacedGrasp, problem: StepProblem, answer: StepSolution) -> Response:
        """How an answer changes with da."""
        n_a, B = self.hand.n_a, self.arms(here)
        load, gap = np.zeros((len(answer.z), n_a)), np.zeros((len(problem.gap), n_a))
        load[:, self.springs] = -B[self.springs].T * self.K[self.springs]
        gap[len(problem.mu_s) + np.arange(len(self.cables)), self.cables] = -1.0
        return answer.response(load, gap)


def _slid(here: PlacedGrasp, first: PlacedGrasp, total: Array) -> Array:
    """Slide of each contact in the step so far: the mean of what z means at both ends [scaled]. A contact
    that was not near at the beginning has slid half of it."""
    way = 0.5 * (here.T @ total)
    if not total.any():
        return way
    then = {name: i for i, name in enumerate(first.contacts.finger)}
    n = min(way.shape[1], 2)
    for i, name in enumerate(here.contacts.finger):
        if name in then:
            j = then[name]
            begun = 0.5 * (first.T[j] @ total)
            begun[:n] = here.frame[i][:, 1 : 1 + n].T @ first.frame[j][:, 1 : 1 + n] @ begun[:n]
            way[i] += begun
    return way


def mode_linearization(
    laws: HandLaws, grasp: PlacedGrasp, loads: ContactLoads, program: StepProgram, answer: StepSolution
) -> Linearization:
    """``J_m`` and the force sensitivities of the contacts that bear after a step that begins at a grasp with
    these loads.

    Raises:
        NoContactError: nothing bears.
    """
    model, o, hand, n_c = laws.model, laws.model.options, laws.hand, grasp.contacts.n_c
    bears = np.flatnonzero(answer.active[:n_c]).tolist()
    if not bears:
        raise NoContactError("no finger touches the object after this motion")
    rates = laws.response(grasp, program.problem, answer)
    turn = np.einsum("idz,za->ida", grasp.turn, rates.z)  # of the frames that the forces turned with
    normal = rates.lam[:n_c] + np.einsum("id,ida->ia", program.t, turn)
    tangential = rates.t - program.lam[:n_c, None, None] * turn
    stop = laws.stop_torque(program, answer)
    contacts = grasp.contacts.select(bears)
    kin = model.contact_kinematics(grasp.state, contacts)
    lam, t = grasp.components(loads)
    mu, dmu = [], []
    for i, one in zip(bears, kin.models, strict=True):
        scale = np.array([1.0, 1.0, grasp.spin_scale[i] * L])[: len(one.rows) - 1] / L
        mu += [lam[i] / L, *(t[i, : len(scale)] * scale)]
        dmu += [normal[i] / L, *(tangential[i, : len(scale)] * scale[:, None])]
    cones = friction_cones(kin.models, contacts.friction.tolist(), contacts.torsional_friction.tolist())
    margin, relative = (torch.from_numpy(x) for x in margins(cones, np.array(mu)))
    forces = pack_forces(
        kin,
        mu=torch.tensor(mu),
        lam=-torch.from_numpy(loads.pull),
        residual=torch.zeros(hand.n_q, dtype=torch.float64),
        stop_torque=torch.from_numpy(loads.stop),
        margin=margin,
        relative_margin=relative,
        violation=torch.zeros((), dtype=torch.float64),
        status=(ForceStatus.SOLVED,),
        loop=torch.from_numpy(loads.loop),
    )
    stability = torch.tensor(torch.inf, dtype=torch.float64)
    return Linearization(
        state=grasp.state,
        contacts=contacts,
        forces=forces,
        **sensitivities(kin, forces, torch.from_numpy(laws.S @ rates.z), torch.from_numpy(np.stack(dmu))),
        held_joints=torch.from_numpy(stop != 0),
        stability=stability,
        options=o,
        doubts=find_doubts(o, hand.joint_names, contacts, forces, stability, reused=False, measured={}),
    )
