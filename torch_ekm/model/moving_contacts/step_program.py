"""The program of one step: a hand's laws, put together with a grasp's contacts."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from ...contact.forces import ForceStatus, friction_cones, margins
from ...exceptions import NoContactError
from ...typing import Array
from ..grasp_forces import pack_forces
from ..linearization import Linearization, sensitivities
from ..reduction import Drives
from ..validity import find_doubts
from .contact_laws import Response, StepProblem, StepSolution
from .placed_grasp import ContactLoads, GraspModel, L, PlacedGrasp

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

    def actuator_response(self, here: PlacedGrasp, rates: Response, n_c: int) -> Array:
        """dlam/da of the actuators, ``(n_a, n_a)`` [N m/rad]; ``n_c``: number of the program's contacts."""
        change = np.zeros((self.hand.n_a, self.hand.n_a))
        own = np.eye(len(change))[self.springs]
        B = self.arms(here)[self.springs]
        change[self.springs] = self.K[self.springs, None] * (B @ rates.z - own)
        change[self.cables] = -rates.lam[n_c : n_c + len(self.cables)]
        return change


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
        actuator_force_sensitivity=torch.from_numpy(laws.actuator_response(grasp, rates, n_c)),
        held_joints=torch.from_numpy(stop != 0),
        stability=stability,
        options=o,
        doubts=find_doubts(o, hand.joint_names, contacts, forces, stability, reused=False, measured={}),
    )
