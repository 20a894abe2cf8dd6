"""The force problem of one state, from the model's matrices, and its answer as tensors."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from ..contact.contact_kinematics import ContactKinematics
from ..contact.forces.balance import BalanceEquations, ForceStatus
from ..contact.forces.friction import friction_cones, margins
from ..contact.forces.solve import contact_forces
from ..description.hand import HandDescription
from ..typing import Bool, Float, Tensor
from .linearization import GraspForces
from .options import ModelOptions
from .reduction import Reduction

Mask = NDArray[np.bool_]


class ForceBalance:
    """Builds :class:`BalanceEquations` for each state of a batch and solves them one by one.

    Joints near a limit get a one-sided stop torque and locked joints a free one, beside the soft joint
    residual.
    """

    def __init__(self, hand: HandDescription, options: ModelOptions, reduction: Reduction) -> None:
        self.options = options
        self.joint_basis = reduction.joint_basis.double().numpy()
        self.pose_basis = reduction.pose_basis.double().numpy()
        self.actuation = (reduction.actuation.double().numpy() @ self.joint_basis).T
        self.tendon = torch.tensor([actuator.tendon for actuator in hand.actuators])
        # a joint beyond one of these touches its stop
        stops = (np.abs(self.joint_basis) > 1e-9).any(1)
        self.low = np.where(stops, hand.joint_lower + options.stop_tolerance, -np.inf)
        self.high = np.where(stops, hand.joint_upper - options.stop_tolerance, np.inf)
        gram = self.joint_basis.T @ self.joint_basis
        self.weight = None if np.allclose(gram, np.eye(len(gram))) else np.linalg.inv(gram)
        # smallest joint torques that make up a generalised residual
        self.lift = self.joint_basis @ np.linalg.inv(gram)
        # in a plane the third row of the pose basis is the rotation
        self.moment_rows: Mask = np.any(np.abs(self.pose_basis[3:]) > 1e-9, axis=0)

    def held_by_stops(
        self, q: Float[Tensor, "*batch n_q"], torque: Float[Tensor, "*batch n_q"]
    ) -> Bool[Tensor, "*batch n_q"]:
        """Joints near a stop that bears more than the threshold."""
        low, high = (torch.as_tensor(stop, device=q.device) for stop in (self.low, self.high))
        return (torque.abs() > self.options.stop_torque) & ((q <= low) | (q >= high))

    def __call__(
        self,
        q: Tensor,
        kin: ContactKinematics,
        A: Tensor,
        V_q: Tensor,
        V_p: Tensor,
        locked: list[int],
        measured_normal: Tensor | None,
        last: GraspForces | None,
        normal_std: float | None = None,
    ) -> GraspForces:
        """Solve every state; where there is no answer use the forces of ``last`` or zeros."""
        batch, n_q = q.shape[:-1], q.shape[-1]
        flat = [
            x.detach().reshape(-1, *x.shape[len(batch) :]).double().cpu().numpy() for x in (q, A, V_q, V_p)
        ]
        measured = None
        if measured_normal is not None:
            measured = measured_normal.detach().reshape(-1, kin.contacts.n_c).double().cpu().numpy()
        cones = friction_cones(
            kin.models, kin.contacts.friction.tolist(), kin.contacts.torsional_friction.tolist()
        )
        spins = tuple(at for at, row in enumerate(kin.rows) if row % 6 >= 3)
        results = []
        for k in range(len(flat[0])):
            q_k, A_k, V_q_k, V_p_k = (x[k] for x in flat)
            joints, lower, upper = self._bounded(q_k, locked)
            eq = BalanceEquations(
                object_matrix=-self.pose_basis.T @ A_k[:, n_q:].T,
                object_load=self.pose_basis.T @ V_p_k,
                hand_matrix=self.joint_basis.T @ A_k[:, :n_q].T,
                actuator_matrix=self.actuation,
                hand_load=self.joint_basis.T @ V_q_k,
                cones=cones,
                length=self.options.length,
                moment_rows=self.moment_rows,
                tendon=self.tendon.numpy(),
                spin_columns=spins,
                bound_matrix=-self.joint_basis[joints].T,
                bound_lower=lower,
                bound_upper=upper,
                weight=self.weight,
                measured_normal=None if measured is None else measured[k],
                normal_std=self.options.forces.normal_std if normal_std is None else normal_std,
            )
            solution = contact_forces(eq, self.options.forces)
            mu, lam = solution.mu, solution.lam
            residual, torque = np.zeros(n_q), np.zeros(n_q)
            if solution.status is ForceStatus.SOLVED:
                residual = self.lift @ solution.residual
                np.add.at(torque, joints, solution.bound)
            elif last is not None:
                mu, lam = (x.expand(*batch, -1).reshape(-1, x.shape[-1])[k] for x in (last.mu, last.lam))
                mu, lam = (x.detach().double().cpu().numpy() for x in (mu, lam))
            else:
                mu, lam = np.zeros_like(mu), np.zeros_like(lam)
            slack, relative = margins(cones, mu)
            results.append((mu, lam, residual, torque, slack, relative, solution))

        def stack(i: int) -> Tensor:
            value = torch.from_numpy(np.stack([r[i] for r in results])).to(q)
            return value.reshape(*batch, *value.shape[1:])

        violation = torch.tensor([r[6].violation for r in results], dtype=q.dtype, device=q.device)
        return pack_forces(
            kin,
            stack(0),
            stack(1),
            residual=stack(2),
            stop_torque=stack(3),
            margin=stack(4),
            relative_margin=stack(5),
            status=tuple(r[6].status for r in results),
            violation=violation.reshape(batch),
        )

    def _bounded(self, q: np.ndarray, locked: list[int]) -> tuple[list[int], np.ndarray, np.ndarray]:
        """Joints with a torque of their own, and its bounds: stops push inwards, locks both ways."""
        lower, upper = np.zeros(len(q)), np.zeros(len(q))
        upper[q <= self.low], lower[q >= self.high] = np.inf, -np.inf
        lower[locked], upper[locked] = -np.inf, np.inf
        joints = [int(j) for j in np.flatnonzero((lower < 0) | (upper > 0))]
        return joints, lower[joints], upper[joints]


def pack_forces(kin: ContactKinematics, mu: Tensor, lam: Tensor, **rest) -> GraspForces:
    """Forces in hand axes from components in contact frames."""
    n_c = kin.contacts.n_c
    full = mu.new_zeros(*mu.shape[:-1], 6 * n_c)
    full[..., kin.rows] = mu
    full = full.unflatten(-1, (n_c, 6))
    spin = full[..., 3]
    force = (kin.frame @ full[..., :3, None])[..., 0]
    return GraspForces(mu=mu, lam=lam, force=force, spin_moment=spin, normal=full[..., 0], **rest)


def known_forces(kin: ContactKinematics, mu: Tensor, lam: Tensor) -> GraspForces:
    """Forces that are given, e.g. those of an exact equilibrium, with their margins."""
    cones = friction_cones(
        kin.models, kin.contacts.friction.tolist(), kin.contacts.torsional_friction.tolist()
    )
    pairs = [margins(cones, row) for row in mu.detach().reshape(-1, mu.shape[-1]).double().cpu().numpy()]
    batch = mu.shape[:-1]
    slack, relative = (
        torch.from_numpy(np.stack([pair[k] for pair in pairs])).to(mu).reshape(*batch, -1) for k in (0, 1)
    )
    n_q = kin.axis.shape[-2]
    zero = mu.new_zeros(*batch, n_q)
    return pack_forces(
        kin,
        mu,
        lam,
        residual=zero,
        stop_torque=zero,
        margin=slack,
        relative_margin=relative,
        status=(ForceStatus.SOLVED,) * len(pairs),
        violation=mu.new_zeros(batch),
    )
