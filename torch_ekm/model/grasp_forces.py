"""Contact forces at a state and after an increment, how sure they are, and the balance they are found by.

Contact forces are stacked as ``[f_1; m_1; f_2; m_2; ..]``, f_i in hand axes [N], m_i the spin moment [N m]:
``4 n_c`` entries, which do not depend on contact frames.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from .._arrays import as_states, eye, namespace, norm, zeros
from .._noise import NOISE
from ..contact.contacts import CHARACTERISTIC_LENGTH, ContactKinematics, ContactSet
from ..contact.forces import (
    BalanceEquations,
    ForceOptions,
    ForceSolution,
    ForceStatus,
    contact_forces,
    friction_cones,
    margins,
)
from ..description.hand import HandDescription
from ..exceptions import ShapeError
from ..typing import AnyArray, Array, Bool, Float, Tensor
from .reduction import Reduction
from .stiffness import SAME, Arms


@dataclass(frozen=True)
class GraspForces:
    """Forces at one state, hand frame. Where ``status`` is not SOLVED: those used in their stead."""

    mu: Float[Tensor, "*batch n_h"]
    """Finger on object, contact frames ``[n_in, t1, t2]`` [N], spin moments [N m]."""
    lam: Float[Tensor, "*batch n_a"]
    """Minus the actuator force along +a [N m]; a tendon's tension is ``-lam``."""
    force: Float[Tensor, "*batch n_c 3"]
    """f_i in hand axes [N]."""
    spin_moment: Float[Tensor, "*batch n_c"]
    """About the inward normal [N m]."""
    normal: Float[Tensor, "*batch n_c"]
    """f_n [N]."""
    residual: Float[Tensor, "*batch n_q"]
    """e, unexplained joint torque [N m]: large means a wrong spring, a wrong rest angle, or slipping."""
    stop_torque: Float[Tensor, "*batch n_q"]
    """Torque of joint stops on the joint [N m]."""
    margin: Float[Tensor, "*batch n_c"]
    """``mu_s f_n - |f_t|`` [N] (soft fingers: with the scaled spin moment): 0 at the friction cone."""
    relative_margin: Float[Tensor, "*batch n_c"]
    """``margin / (mu_s f_n)``: 1 without tangential load, 0 at the friction cone."""
    status: tuple[ForceStatus, ...]
    """One per state of the batch."""
    violation: Float[Tensor, "*batch"]
    """Smallest norm of the unbalanced object wrench, moments divided by L [N]."""
    covariance: Float[Tensor, "*batch m m"] | None = None
    """Of the contact forces ``[f_1; m_1; ..]``, hand axes, m = 4 n_c. None where nothing was measured or
    expected: the smallest forces are a choice, not an estimate."""
    loop: Float[Tensor, "*batch n_l"] = field(default_factory=lambda: torch.zeros(0, dtype=torch.float64))
    """nu, forces of the loops, ``-(dc/dq)^T nu`` on the joints."""

    @property
    def solved(self) -> bool:
        """Every state of the batch was solved."""
        return all(status is ForceStatus.SOLVED for status in self.status)


@dataclass(frozen=True)
class ExpectedForces:
    """Forces ``f + (df/da) da`` of sticking contacts, hand axes, to first order in da."""

    finger: tuple[str, ...]
    """The pad of each contact."""
    force: Float[Tensor, "*batch n_c 3"]
    """f_i' of the finger on the object [N]."""
    spin_moment: Float[Tensor, "*batch n_c"]
    """About the inward normal [N m]."""
    normal: Float[Tensor, "*batch n_c"]
    """``f_n' = f' . n_in'``, n_in' the turned inward normal [N]; below 0 the contact opens."""
    margin: Float[Tensor, "*batch n_c"]
    """``mu_s f_n' - |u'|``, u' = f_t' (soft fingers: with the scaled spin moment) [N]."""
    covariance: Float[Tensor, "*batch m m"]
    """Of the stacked contact forces, m = 4 n_c: that before the increment and what the increment adds."""


def friction_use(contacts: ContactSet, force: AnyArray, spin: AnyArray, normal: AnyArray) -> tuple[Any, Any]:
    """``f_n`` and ``mu_s f_n - |u|`` [N].

    Args:
        normal: outward normals of the object.
    """
    n_in, mu_s, gamma, xp = -normal, contacts.friction, contacts.torsional_friction, namespace(force)
    f_n = (force * n_in).sum(-1)
    f_t = force - f_n[..., None] * n_in
    scale = mu_s / gamma.clip(1e-9) * (gamma > 0)
    u = xp.concat([f_t, (scale * spin)[..., None]], -1)
    return f_n, mu_s * f_n - norm(u)


def start_covariance(
    normal: Float[AnyArray, "*batch n_c 3"], options: ForceOptions
) -> Float[Any, "*batch m m"]:
    """``start_std^2`` across the normals, any force along them; ``(start_std L)^2`` for spin moments."""
    *batch, n_c, _ = normal.shape
    along = normal[..., None] * normal[..., None, :]
    blocks = zeros(normal, *batch, n_c, 4, 4)
    across = eye(normal, 3) - along
    blocks[..., :3, :3] = options.start_std**2 * across + NOISE.any_normal_force**2 * along
    blocks[..., 3, 3] = (options.start_std * CHARACTERISTIC_LENGTH) ** 2
    spread = blocks[..., :, :, None, :] * eye(normal, n_c)[:, None, :, None]
    return spread.reshape(*batch, 4 * n_c, 4 * n_c)


def drift(df: Float[AnyArray, "*batch n_c 3"], dspin: AnyArray) -> Float[Any, "*batch m"]:
    """Variance that an increment adds: ``sigma_d^2 + (sigma_c |df_i|)^2``, moments likewise."""
    xp = namespace(df)
    one = xp.asarray([1.0, 1.0, 1.0, CHARACTERISTIC_LENGTH], dtype=df.dtype, device=df.device)
    of_force = (df * df).sum(-1)[..., None]
    change2 = xp.concat([of_force, of_force, of_force, dspin[..., None] ** 2], -1)
    variance = (NOISE.force_drift * one) ** 2 + NOISE.force_share**2 * change2
    return variance.reshape(*df.shape[:-2], -1)


class ForcePrior:
    """``N(x^, Sigma)`` of the stacked contact forces, read in the contact frames of the present state.

    Contacts that were not expected begin at 0, with ``start_std`` across the normal and any force along it.
    All in numpy, a list of states.

    Args:
        kin: the contacts.
        expected: forces predicted from the state before, of one state or of as many as ``kin`` has.
        options: standard deviations.

    Raises:
        ShapeError: ``expected`` has another batch.
    """

    def __init__(
        self, kin: ContactKinematics, expected: ExpectedForces | None, options: ForceOptions
    ) -> None:
        contacts = kin.contacts
        batch, n_c = contacts.gap.shape[:-1], contacts.n_c
        frame, normal = as_states(kin.frame, 3), as_states(contacts.normal, 2)
        n = len(frame)
        mean, covariance = np.zeros((n, n_c, 4)), start_covariance(normal, options)
        if expected is not None:
            if expected.force.shape[:-2] not in (batch, ()):
                raise ShapeError("expected.force", f"{(*batch, n_c, 3)}", expected.force.shape)
            both = [name for name in contacts.finger if name in expected.finger]
            now, then = ([names.index(f) for f in both] for names in (contacts.finger, expected.finger))
            mean[:, now, :3] = as_states(expected.force, 2)[:, then]
            mean[:, now, 3] = as_states(expected.spin_moment, 1)[:, then]
            row, column = _stacked(now), _stacked(then)
            covariance[:, row[:, None], row] = as_states(expected.covariance, 2)[:, column[:, None], column]
        # T with mu = T x, orthonormal rows
        contact, component = np.divmod(np.array(kin.rows), 6)
        self._T = np.zeros((n, len(contact), n_c, 4))
        force = np.flatnonzero(component < 3)
        self._T[:, force, contact[force], :3] = frame[:, contact[force], :, component[force]].swapaxes(0, 1)
        spin = np.flatnonzero(component >= 3)
        self._T[:, spin, contact[spin], 3] = 1.0
        self._T = self._T.reshape(n, len(contact), -1)
        self.mean: Array = (self._T @ mean.reshape(n, -1, 1))[..., 0]
        """Of ``mu``, state by state."""
        self.covariance: Array = self._T @ covariance @ self._T.mT
        """Of ``mu``, state by state."""

    def stacked(self, covariance: Array) -> Array:
        """Covariances of ``mu``, state by state, as those of the stack."""
        return self._T.mT @ covariance @ self._T


def _stacked(contacts: list[int]) -> np.ndarray:
    return (4 * np.array(contacts, dtype=int)[:, None] + np.arange(4)).ravel()


Mask = NDArray[np.bool_]
STOP_TOLERANCE = math.radians(0.1)
"""How near to a limit a joint counts as touching its stop [rad]. Joint angles alone do not determine how much
torque a stop takes from the contact forces; fingertip sensors can."""
_STOP_TORQUE = 0.01  # [N m] above which a stop holds its joint; below, the joint may leave


class ForceBalance:
    """Builds :class:`BalanceEquations` for each state of a batch and solves them one by one.

    Joints near a limit get a one-sided stop torque, next to the soft joint residual.
    """

    def __init__(
        self, hand: HandDescription, reduction: Reduction, options: ForceOptions, slack_tension: float | None
    ) -> None:
        self.options, self.reduction = options, reduction
        self.joint_basis = reduction.joint_basis.double().numpy()
        self.pose_basis = reduction.pose_basis.double().numpy()
        self.tendon = np.array([actuator.tendon for actuator in hand.actuators])
        # joint torque [N m] that the weight of the forces may leave where a tendon pulls nothing
        arm, limit = np.linalg.norm(self._arms(), axis=0), slack_tension
        no_pull = 1e-3 * CHARACTERISTIC_LENGTH / np.where(arm > 0, arm, 1.0) + (
            0.0 if limit is None else limit
        )
        pulls = self.tendon & (limit is not None)
        self.slack_above = torch.from_numpy(np.where(pulls, -no_pull, np.inf))
        # a joint beyond one of these touches its stop
        stops = (np.abs(self.joint_basis) > 1e-9).any(1)
        self.low = np.where(stops, hand.joint_lower + STOP_TOLERANCE, -np.inf)
        self.high = np.where(stops, hand.joint_upper - STOP_TOLERANCE, np.inf)
        gram = self.joint_basis.T @ self.joint_basis
        # smallest joint torques that make up a generalised residual
        self.lift = self.joint_basis @ np.linalg.inv(gram)
        # in a plane the third row of the pose basis is the rotation
        self.moment_rows: Mask = np.any(np.abs(self.pose_basis[3:]) > 1e-9, axis=0)

    def _arms(self, arms: Arms = SAME) -> Array:
        """``(J_a Z)^T``."""
        J_a = arms.of(self.reduction.actuation).detach().double().cpu().numpy()
        return (J_a @ self.joint_basis).T

    def held_by_stops(
        self, q: Float[AnyArray, "*batch n_q"], torque: Float[AnyArray, "*batch n_q"]
    ) -> Bool[AnyArray, "*batch n_q"]:
        """Joints near a stop that bears more than the threshold."""
        low, high = (namespace(q).asarray(stop, device=q.device) for stop in (self.low, self.high))
        return (abs(torque) > _STOP_TORQUE) & ((q <= low) | (q >= high))

    def slack(self, forces: GraspForces) -> Bool[Tensor, "*batch n_a"]:
        """Tendons that pull with no more than ``slack_tension``, where forces were found."""
        lam = forces.lam.detach()
        slack = lam >= self.slack_above.to(lam)
        if not forces.solved:
            found = torch.tensor(
                [status is ForceStatus.SOLVED for status in forces.status], device=lam.device
            )
            slack = slack & found.reshape(*lam.shape[:-1], 1)
        return slack

    def __call__(
        self,
        q: Float[AnyArray, "*batch n_q"],
        kin: ContactKinematics,
        A: Float[AnyArray, "*batch n_h n_s"],
        V_s: Float[AnyArray, "*batch n_s"],
        *,
        arms: Arms = SAME,
        normal: Float[AnyArray, "*batch n_c"] | None = None,
        expected: ExpectedForces | None = None,
        last: GraspForces | None = None,
    ) -> GraspForces:
        """Forces in the equilibrium ``V_s + A^T mu + B^T lam = 0`` of every state.

        Args:
            V_s: gradient of the potential energy [N m, N].
            normal: measured normal forces [N], NaN where there is no sensor.
            expected: prediction from the state before.
            last: forces of the step before, which stand in where the problem has no answer; None: zeros.
        """
        options, batch, n_q = self.options, q.shape[:-1], q.shape[-1]
        states = zip(as_states(q, 1), *self._reduced(as_states(A, 2), as_states(V_s, 1)), strict=True)
        measured = None if normal is None else as_states(normal, 1)
        estimating = measured is not None or expected is not None
        prior = ForcePrior(kin, expected, options) if estimating else None
        cones = friction_cones(
            kin.models, kin.contacts.friction.tolist(), kin.contacts.torsional_friction.tolist()
        )
        spins = tuple(place for place, row in enumerate(kin.rows) if row % 6 >= 3)
        actuation, closed = self._arms(), None
        if arms.closed is not None:
            closed = as_states(torch.as_tensor(arms.closed).detach().double().cpu().numpy(), 2)
        table: list[tuple] = []
        solutions: list[ForceSolution] = []
        for k, (q_k, G, object_load, hand_matrix, hand_load) in enumerate(states):
            joints, lower, upper = self._bounded(q_k)
            bounded = -self.joint_basis[joints].T
            if arms.ratio is not None:
                actuation = self._arms(arms.one(k))
            if closed is not None:  # a loop is a rod whose force nothing bounds
                bounded = np.concatenate([bounded, self.joint_basis.T @ closed[k].T], axis=1)
                free = np.full(len(closed[k]), np.inf)
                lower, upper = np.append(lower, -free), np.append(upper, free)
            eq = BalanceEquations(
                object_matrix=G,
                object_load=object_load,
                hand_matrix=hand_matrix,
                actuator_matrix=actuation,
                hand_load=hand_load,
                cones=cones,
                moment_rows=self.moment_rows,
                tendon=self.tendon,
                spin_columns=spins,
                bound_matrix=bounded,
                bound_lower=lower,
                bound_upper=upper,
                measured_normal=None if measured is None else measured[k],
                expected=None if prior is None else prior.mean[k],
                expected_covariance=None if prior is None else prior.covariance[k],
            )
            solution = contact_forces(eq, options)
            mu, lam = solution.mu, solution.lam
            residual, torque = np.zeros(n_q), np.zeros(n_q)
            loop = np.zeros(0 if closed is None else closed.shape[1])
            if solution.status is ForceStatus.SOLVED:
                residual = self.lift @ solution.residual
                np.add.at(torque, joints, solution.bound[: len(joints)])
                loop = solution.bound[len(joints) :]
            elif last is not None:
                mu, lam = (as_states(x.expand(*batch, -1), 1)[k] for x in (last.mu, last.lam))
            else:
                mu, lam = np.zeros_like(mu), np.zeros_like(lam)
            table.append((mu, lam, residual, torque, *margins(cones, mu), [solution.violation], loop))
            solutions.append(solution)

        names = ("mu", "lam", "residual", "stop_torque", "margin", "relative_margin", "violation", "loop")
        ends = np.cumsum([len(part) for part in table[0]])[:-1]
        stacked = np.stack([np.concatenate(row) for row in table]).reshape(*batch, -1)
        parts: dict[str, Any] = dict(zip(names, np.split(stacked, ends, axis=-1), strict=True))
        if isinstance(q, Tensor):
            parts = {name: torch.from_numpy(value).to(q) for name, value in parts.items()}
        parts["violation"] = parts["violation"][..., 0]
        status = tuple(solution.status for solution in solutions)
        forces = pack_forces(kin, **parts, status=status)
        if prior is None or not forces.solved:
            return forces
        sure = prior.stacked(np.array([solution.covariance for solution in solutions]))
        sure = sure.reshape(*batch, *sure.shape[-2:])
        return dataclasses.replace(forces, covariance=torch.from_numpy(sure).to(forces.mu))

    def _reduced(self, A: AnyArray, V_s: AnyArray) -> tuple[Any, Any, Any, Any]:
        """``-(A_p Z_p)^T``, ``Z_p^T V_p``, ``(A_q Z)^T``, ``Z^T V_q``: both in permitted motions."""
        Z_p, Z, n_q = self.pose_basis, self.joint_basis, len(self.joint_basis)
        if isinstance(A, Tensor):
            Z_p, Z = (torch.from_numpy(basis).to(A) for basis in (Z_p, Z))
        return -Z_p.mT @ A[..., n_q:].mT, V_s[..., n_q:] @ Z_p, Z.mT @ A[..., :n_q].mT, V_s[..., :n_q] @ Z

    def _bounded(self, q: np.ndarray) -> tuple[list[int], np.ndarray, np.ndarray]:
        """Joints with a torque of their own, and its bounds: stops push inwards."""
        lower, upper = np.zeros(len(q)), np.zeros(len(q))
        upper[q <= self.low], lower[q >= self.high] = np.inf, -np.inf
        joints = [int(j) for j in np.flatnonzero((lower < 0) | (upper > 0))]
        return joints, lower[joints], upper[joints]


def pack_forces(kin: ContactKinematics, mu: AnyArray, lam: AnyArray, **rest) -> GraspForces:
    """Forces in hand axes from components in contact frames."""
    n_c, batch = kin.contacts.n_c, mu.shape[:-1]
    full = zeros(mu, *batch, 6 * n_c)
    full[..., kin.row_index] = mu
    full = full.reshape(*batch, n_c, 6)
    force = (kin.frame @ full[..., :3, None])[..., 0]
    parts = {"mu": mu, "lam": lam, "force": force, "spin_moment": full[..., 3], "normal": full[..., 0]}
    status, parts = rest.pop("status"), parts | rest
    return GraspForces(**{name: torch.as_tensor(part) for name, part in parts.items()}, status=status)
