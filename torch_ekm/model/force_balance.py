"""The force problem of one state, from the model's matrices, and its answer as tensors."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from .._arrays import like, namespace, zeros
from ..contact.contacts import CHARACTERISTIC_LENGTH, ContactKinematics, ContactSet
from ..contact.forces import (
    BalanceEquations,
    ForceSolution,
    ForceStatus,
    contact_forces,
    friction_cones,
    margins,
)
from ..description.hand import HandDescription
from ..typing import AnyArray, Array, Bool, Float, Tensor
from .arms import SAME, Arms
from .gradients import differentiable_forces
from .grasp_forces import ExpectedForces, ForcePrior, GraspForces, as_states, friction_use, margin_std
from .options import ModelOptions
from .reduction import Reduction

Mask = NDArray[np.bool_]
STOP_TOLERANCE = math.radians(0.1)
"""How near to a limit a joint counts as touching its stop [rad]. Joint angles alone do not determine how much
torque a stop takes from the contact forces; fingertip sensors can."""
_STOP_TORQUE = 0.01  # [N m] above which a stop holds its joint; below, the joint may leave


class ForceBalance:
    """Builds :class:`BalanceEquations` for each state of a batch and solves them one by one.

    Joints near a limit get a one-sided stop torque, next to the soft joint residual.
    """

    def __init__(self, hand: HandDescription, options: ModelOptions, reduction: Reduction) -> None:
        self.options, self.reduction = options, reduction
        self.joint_basis = reduction.joint_basis.double().numpy()
        self.pose_basis = reduction.pose_basis.double().numpy()
        self.tendon = np.array([actuator.tendon for actuator in hand.actuators])
        # joint torque [N m] that the weight of the forces may leave where a tendon pulls nothing
        arm, limit = np.linalg.norm(self._arms(), axis=0), options.slack_tension
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
        """``(J_a Z)^T`` as it is now: calibration changes the moment arms."""
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
        options, batch, n_q = self.options.forces, q.shape[:-1], q.shape[-1]
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
        problems: list[tuple[BalanceEquations, ForceSolution]] = []
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
            problems.append((eq, solution))

        names = ("mu", "lam", "residual", "stop_torque", "margin", "relative_margin", "violation", "loop")
        ends = np.cumsum([len(part) for part in table[0]])[:-1]
        stacked = np.stack([np.concatenate(row) for row in table]).reshape(*batch, -1)
        parts: dict[str, Any] = dict(zip(names, np.split(stacked, ends, axis=-1), strict=True))
        if isinstance(q, Tensor):
            parts = {name: torch.from_numpy(value).to(q) for name, value in parts.items()}
        parts["violation"] = parts["violation"][..., 0]
        inputs = A, V_s, self.reduction.actuation
        if isinstance(q, Tensor) and torch.is_grad_enabled() and any(x.requires_grad for x in inputs):
            moving = self._with_graph(problems, arms, A, V_s, *(parts[name] for name in names[:3]))
            parts.update(zip(names, moving, strict=False))
        status = tuple(solution.status for _, solution in problems)
        forces = pack_forces(kin, **parts, status=status)
        if prior is None or not forces.solved:
            return forces
        sure = prior.stacked(np.array([solution.covariance for _, solution in problems]))
        sure = sure.reshape(*batch, *sure.shape[-2:])
        sure = torch.from_numpy(sure).to(q) if isinstance(q, Tensor) else sure
        return with_covariance(kin.contacts, forces, sure)

    def _reduced(self, A: AnyArray, V_s: AnyArray) -> tuple[Any, Any, Any, Any]:
        """``-(A_p Z_p)^T``, ``Z_p^T V_p``, ``(A_q Z)^T``, ``Z^T V_q``: both in permitted motions."""
        Z_p, Z, n_q = self.pose_basis, self.joint_basis, len(self.joint_basis)
        if isinstance(A, Tensor):
            Z_p, Z = (torch.from_numpy(basis).to(A) for basis in (Z_p, Z))
        return -Z_p.mT @ A[..., n_q:].mT, V_s[..., n_q:] @ Z_p, Z.mT @ A[..., :n_q].mT, V_s[..., :n_q] @ Z

    def _with_graph(
        self,
        problems: list[tuple[BalanceEquations, ForceSolution]],
        arms: Arms,
        A: Tensor,
        V_s: Tensor,
        *found: Tensor,
    ) -> tuple[Tensor, ...]:
        """``mu``, ``lam`` and e with their derivative; those of an unsolved problem are constants."""
        Z, lift = (torch.from_numpy(x).to(A) for x in (self.joint_basis, self.lift))
        batch = V_s.dim() - 1
        parts = [x.reshape(-1, *x.shape[batch:]) for x in (*found, *self._reduced(A, V_s))]
        rows = []
        for k, (eq, solution) in enumerate(problems):
            mu, lam, e, *given = (part[k] for part in parts)
            if solution.status is ForceStatus.SOLVED:
                at = arms.one(k)
                mu, lam, e = differentiable_forces(
                    eq,
                    self.options.forces,
                    solution,
                    *given,
                    actuator_matrix=(at.of(self.reduction.actuation) @ Z).mT,
                    closed=None if at.closed is None else (at.closed @ Z).mT,
                )
                e = lift @ e
            rows.append((mu, lam, e))
        stacked = zip(zip(*rows, strict=True), found, strict=True)
        return tuple(torch.stack(part).reshape(old.shape) for part, old in stacked)

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


def with_covariance(contacts: ContactSet, forces: GraspForces, covariance: AnyArray) -> GraspForces:
    """The forces with how sure they are; ``covariance`` of the stack."""
    force, spin = like(forces.force, covariance), like(forces.spin_moment, covariance)
    normal, _, gradient = friction_use(contacts, force, spin, contacts.normal)
    std = margin_std(contacts, normal, gradient, covariance)
    known = {"covariance": torch.as_tensor(covariance), "margin_std": torch.as_tensor(std)}
    return dataclasses.replace(forces, **known)
