"""Exact quasi-static configurations: Newton on the equilibrium equations, with continuation."""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch

from torch_ekm.contact.contacts import (
    CHARACTERISTIC_LENGTH,
    FLAT,
    ContactKinematics,
    ContactSet,
    constraint_matrix,
    contact_frames,
)
from torch_ekm.contact.forces import ForceStatus, friction_cones, margins
from torch_ekm.exceptions import EquilibriumError
from torch_ekm.kinematics.poses import GraspState
from torch_ekm.model.grasp_forces import ForceBalance, GraspForces, pack_forces
from torch_ekm.model.kinematic_model import KinematicModel
from torch_ekm.model.stiffness import geometric_stiffness
from torch_ekm.typing import Float, Tensor


@dataclass(frozen=True)
class Core:
    """A rounded body: all points within ``radius`` of a point, a line or a plane."""

    point: Float[Tensor, " 3"]
    outward: Float[Tensor, " 3"]
    """Where it is touched at first: always so of a plane, and of a pinned contact."""
    directions: Float[Tensor, "3 k"]
    """That the line or the plane extends in; none of a point."""
    radius: float

    def moved(self, rotation: Tensor, position: Tensor) -> "Core":
        point = position + rotation @ self.point
        return Core(point, rotation @ self.outward, rotation @ self.directions, self.radius)

    def curvature(self, normal: Tensor) -> Tensor:
        if self.radius == 0:
            return normal.new_zeros(3, 3)
        across = torch.eye(3, dtype=normal.dtype) - torch.outer(normal, normal)
        return (across - self.directions @ self.directions.mT) / self.radius


class TrackedContacts:
    """Follows each contact of a :class:`ContactSet` on the surfaces that its curvatures describe.

    A body whose curvature is isotropic is a ball there, one with a flat direction a cylinder, one
    without curvature a plane; for spheres, capsules, cylinders and boxes that is exact as long as the
    contact stays on the same feature. Contact points, normals and gaps are then smooth functions of the
    state, without the tolerance of a collision detector.

    ``contacts`` are those of one state, and ``link_pose(q)`` the poses of the links that carry them.
    """

    def __init__(
        self,
        contacts: ContactSet,
        link_pose: Callable[[Tensor], Tensor],
        q: Tensor,
        position: Tensor,
        rotation: Tensor,
    ) -> None:
        self.contacts, self.link_pose = contacts, link_pose
        self.finger: list[Core] = []
        self.object: list[Core] = []
        for i, pose in enumerate(link_pose(q)):
            x, n = contacts.point[i], contacts.normal[i]
            touch = x + contacts.gap[i] * n  # on the finger
            if contacts.pinned[i]:
                finger, obj = (Core(point, n, n.new_zeros(3, 0), 0.0) for point in (touch, x))
            else:
                finger = _core(contacts.finger_curvature[i], touch, -n)
                obj = _core(contacts.object_curvature[i], x, n)
                # a line contact has no contact point
                assert finger.directions.shape[1] + obj.directions.shape[1] <= 2
            R, o = pose[:3, :3].mT, pose[:3, 3]
            self.finger.append(finger.moved(R, -R @ o))
            self.object.append(obj.moved(rotation.mT, -rotation.mT @ position))

    def __call__(
        self, q: Float[Tensor, " n_q"], position: Float[Tensor, " 3"], rotation: Float[Tensor, "3 3"]
    ) -> ContactSet:
        """The same contacts at another state."""
        rows = []
        for i, pose in enumerate(self.link_pose(q)):
            finger, obj = (
                self.finger[i].moved(pose[:3, :3], pose[:3, 3]),
                self.object[i].moved(rotation, position),
            )
            if self.contacts.pinned[i]:
                # the finger's point carries the contact; the normal is fixed to the object
                curvatures = self.contacts.finger_curvature[i], self.contacts.object_curvature[i]
                rows.append(
                    (finger.point, obj.outward, obj.outward @ (finger.point - obj.point), *curvatures)
                )
                continue
            at_f, at_o = _closest(finger, obj)
            if obj.directions.shape[1] == 2:
                n = obj.outward
                distance = n @ (at_f - at_o)
            else:
                distance = torch.linalg.vector_norm(at_f - at_o)
                n = (at_f - at_o) / distance
            gap = distance - finger.radius - obj.radius
            rows.append((at_o + obj.radius * n, n, gap, finger.curvature(n), obj.curvature(n)))
        names = ("point", "normal", "gap", "finger_curvature", "object_curvature")
        parts = zip(names, zip(*rows, strict=True), strict=True)
        return self.contacts.replace(**{name: torch.stack(part) for name, part in parts})

    def pinned_offset(self, q: Tensor, position: Tensor, rotation: Tensor) -> Float[Tensor, "n_c 3"]:
        """``x_f(q) - x_o(p)`` of pinned contacts' material points, object axes [m]; 0 for the others."""
        offset = torch.zeros_like(self.contacts.point)
        for i, pose in enumerate(self.link_pose(q)):
            if self.contacts.pinned[i]:
                finger = self.finger[i].moved(pose[:3, :3], pose[:3, 3])
                offset[i] = rotation.mT @ (finger.point - position) - self.object[i].point
        return offset


def _core(K: Tensor, surface_point: Tensor, outward: Tensor) -> Core:
    """Ball, cylinder or plane with the given curvature tensor at a surface point."""
    tangent = contact_frames(outward[None])[0, :, 1:]
    values, vectors = torch.linalg.eigh(tangent.mT @ K @ tangent)
    curved = values[values > FLAT]
    assert float(values.min()) >= -FLAT
    assert len(curved) < 2 or float(curved[1] - curved[0]) <= 1e-6 * float(curved[1])
    radius = 1 / float(curved[0]) if len(curved) else 0.0
    return Core(surface_point - radius * outward, outward, tangent @ vectors[:, values <= FLAT], radius)


def _closest(finger: Core, obj: Core) -> tuple[Tensor, Tensor]:
    """Closest points of two cores."""
    k = finger.directions.shape[1]
    both = torch.cat([finger.directions, -obj.directions], dim=1)
    along = torch.linalg.pinv(both) @ (obj.point - finger.point)
    return finger.point + finger.directions @ along[:k], obj.point + obj.directions @ along[k:]


@dataclass(frozen=True)
class Equilibrium:
    """A configuration at rest."""

    state: GraspState
    a: Float[Tensor, " n_a"]
    """Actuator positions (of compliant actuators: what is commanded) [rad]."""
    mu: Float[Tensor, " n_h"]
    lam: Float[Tensor, " n_a"]
    stop: Float[Tensor, " n_k"]
    """Torques on held joints [N m]."""
    contacts: ContactSet


class EquilibriumSolver:
    """Solves the nonlinear equations of rest for given actuator positions.

    ```
    V_s(s) + A(s)^T mu + B^T lam - E_h^T tau = 0       balance (couplings reduced out)
    gap_i(s) = 0                                        contacts close
    [t; spin rows of A]((s_k + s)/2) (s - s_k) = 0      and roll from the previous configuration s_k
    a(s) - lam/K_a = a                                  actuators, with their series stiffness
    q_j = const                                         held joints
    ```

    The contact points are exact functions of the state (:class:`TrackedContacts`). Rolling in space is not
    holonomic, so the answer depends on the path from the first configuration: large moves are cut into steps
    of at most ``max_step`` [rad of an actuator], whose midpoint rule leaves an error of third order. Newton's
    matrix is the model's stiffness D; only the speed of convergence depends on it, not the answer. ``held``
    joints, by index, do not move: they are at a stop.
    """

    def __init__(
        self,
        model: KinematicModel,
        state: GraspState,
        contacts: ContactSet,
        *,
        held: tuple[int, ...] = (),
        max_step: float = 0.02,
    ) -> None:
        self.model, self.held, self.max_step = model, list(held), max_step
        links = [model.link_names.index(name) for name in contacts.link]

        def link_pose(q: Tensor) -> Tensor:
            return model.kinematics(q).transforms[links]

        self.surfaces = TrackedContacts(contacts, link_pose, state.q, state.position, state.rotation)
        self.start = state
        self._moved: dict[tuple[int, tuple[float, ...]], tuple[Equilibrium, Equilibrium]] = {}
        reduction = model.reduction
        self.Z = reduction.scaled_basis
        self.B = reduction.actuation @ self.Z[: model.hand.n_q]
        self.compliance = 1 / reduction.stiffness  # 0 for rigid actuators
        self.offset = torch.as_tensor(model.hand.actuator_offset, dtype=self.Z.dtype)

    def actuators(self, state: GraspState) -> Float[Tensor, " n_a"]:
        """``a(q) = offset + J_a q`` [rad]."""
        return self.offset + self.model.reduction.actuation @ state.q

    @torch.no_grad()
    def find(self, normal_force: Float[Tensor, " n_c"]) -> Equilibrium:
        """An equilibrium near the first configuration, with normal forces near those wished for [N].

        Starts from the relaxed forces there; the joint torques that they leave unexplained are then faded
        out, the actuators staying where they are.
        """
        model = self.model
        _, kin = self._geometry(self.start)
        options = dataclasses.replace(model.options.forces, normal_std=0.05)
        balance = _NoStops(model.hand, model.reduction, options, model.options.slack_tension)
        at = self.start.q, kin, constraint_matrix(kin), model.potential(self.start)[0]
        forces = balance(*at, normal=normal_force)
        assert forces.solved
        stop = forces.stop_torque[self.held]
        a = self.actuators(self.start) - self.compliance * forces.lam
        at = Equilibrium(self.start, a, forces.mu, forces.lam, stop, kin.contacts)
        unexplained = self._balance(at.state, kin, at.mu, at.lam, at.stop)
        gap = kin.contacts.gap

        def faded(at: Equilibrium, done: float) -> Equilibrium:
            return self._newton(at, a, (1 - done) * unexplained, (1 - done) * gap)

        return _follow(at, faded, 8)

    @torch.no_grad()
    def move(self, start: Equilibrium, a: Float[Tensor, " n_a"]) -> Equilibrium:
        """The equilibrium reached from ``start`` when the actuators go straight to ``a`` [rad].

        Raises:
            EquilibriumError: the path ends before (a fold: the grasp buckles, or a contact is lost).
        """
        total = a - start.a
        steps = max(1, int(torch.ceil(total.abs().amax() / self.max_step - 1e-9)))
        return _follow(start, lambda at, done: self._newton(at, start.a + done * total), steps)

    def moved(self, start: Equilibrium, a: Float[Tensor, " n_a"]) -> Equilibrium:
        """As :meth:`move`, found once: several quantities are compared at the same equilibria."""
        key = id(start), tuple(a.tolist())
        if key not in self._moved:
            self._moved[key] = start, self.move(start, a)  # with the start, whose id must not come again
        return self._moved[key][1]

    @torch.no_grad()
    def grip(self, start: Equilibrium, normal_force: Float[Tensor, " n_c"]) -> Equilibrium:
        """Move the actuators, as little as possible, until the normal forces are those wished for [N].

        Newton with ``d f_n/da`` of the model; the object moves along. A NaN leaves that contact free.
        """
        at, known = start, torch.isfinite(normal_force)
        for _ in range(40):
            forces = self.forces(at)
            miss = (normal_force - forces.normal)[known]
            if float(miss.abs().max()) <= 1e-6:
                return at
            lin = self.model.linearize(at.state, at.contacts, forces=forces)
            da = torch.linalg.pinv(lin.normal_force_sensitivity[known], rtol=1e-4) @ miss
            at = self.move(at, at.a + da * min(1.0, 0.1 / float(da.abs().max())))
        raise EquilibriumError("grip", f"normal forces missed by {float(miss.abs().max()):.2g} N")

    def forces(self, at: Equilibrium) -> GraspForces:
        """The exact forces of an equilibrium, in the form that :meth:`KinematicModel.linearize` takes."""
        kin = self.model.contact_kinematics(at.state, at.contacts, rolling=True)
        return known_forces(kin, at.mu, at.lam)

    def _geometry(self, state: GraspState) -> tuple[ContactSet, ContactKinematics]:
        contacts = self.surfaces(state.q, state.position, state.rotation)
        return contacts, self.model.contact_kinematics(state, contacts, rolling=True)

    def _balance(
        self, state: GraspState, kin: ContactKinematics, mu: Tensor, lam: Tensor, stop: Tensor
    ) -> Tensor:
        A = constraint_matrix(kin) @ self.Z
        n_q = self.model.hand.n_q
        F = self.Z.mT @ self.model.potential(state)[0] + A.mT @ mu + self.B.mT @ lam
        return F - self.Z[:n_q][self.held].mT @ stop

    def _newton(
        self, at: Equilibrium, a: Tensor, unexplained: Tensor | None = None, gap: Tensor | None = None
    ) -> Equilibrium:
        """One continuation step from ``at``."""
        model, Z = self.model, self.Z
        n_q, n_z, L = model.hand.n_q, Z.shape[1], CHARACTERISTIC_LENGTH
        state, mu, lam, stop = at.state, at.mu, at.lam, at.stop
        E_h = Z[:n_q][self.held]
        before = self.surfaces.pinned_offset(at.state.q, at.state.position, at.state.rotation)
        best, stalled = float("inf"), 0
        for _ in range(60):
            contacts, kin = self._geometry(state)
            A_s = constraint_matrix(kin)
            closing = self._closing(kin, at.state, state, before, gap)
            row_scale = torch.tensor([1 / L if row % 6 < 3 else 1.0 for row in kin.rows], dtype=Z.dtype)
            F = self._balance(state, kin, mu, lam, stop)
            if unexplained is not None:
                F = F - unexplained
            G = [
                F,
                row_scale * closing,
                self.actuators(state) - self.compliance * lam - a,
                (state.q - self.start.q)[self.held],
            ]
            error = torch.cat(G)
            size = float(error.abs().max())
            if not size < 1e6:
                break
            if size < 1e-12 or (size < 1e-10 and size >= 0.5 * best):
                return Equilibrium(state, a, mu, lam, stop, contacts)
            stalled = stalled + 1 if size > 0.9 * best else 0
            best = min(best, size)
            if stalled > 12:
                break
            forces = known_forces(kin, mu, lam)
            D = geometric_stiffness(kin, forces.force, forces.spin_moment, model.precedes)
            D = D + model.potential(state)[1]
            A = row_scale[:, None] * (A_s @ Z)
            E = torch.cat([A, self.B, E_h])
            corner = torch.diag(torch.cat([A.new_zeros(len(A)), self.compliance, A.new_zeros(len(E_h))]))
            matrix = torch.cat([torch.cat([Z.mT @ D @ Z, E.mT], 1), torch.cat([E, -corner], 1)])
            try:
                step = torch.linalg.solve(matrix, -error)
            except torch.linalg.LinAlgError:
                break
            dz, dmu, dlam, dstop = step.split([n_z, len(A), len(self.B), len(E_h)])
            ds = Z @ dz
            damping = min(1.0, 0.3 / max(float(dz.abs().max()), 1e-300))
            state = state.plus(damping * ds)
            mu, lam, stop = mu + damping * row_scale * dmu, lam + damping * dlam, stop - damping * dstop
        raise EquilibriumError("newton", f"stopped at a residual of {best:.1e}")

    def _closing(
        self,
        kin: ContactKinematics,
        before: GraspState,
        state: GraspState,
        offset: Tensor,
        gap: Tensor | None,
    ) -> Tensor:
        """Violation of the contact equations, one per row of A [m, rad]."""
        ds = state.minus(before)
        middle = before.plus(0.5 * ds)
        _, kin_m = self._geometry(middle)
        value = constraint_matrix(kin_m) @ ds
        now = kin.contacts.gap if gap is None else kin.contacts.gap - gap
        value[kin.normal_rows] = -now
        pinned = [i for i, p in enumerate(kin.contacts.pinned) if p]
        if pinned:
            moved = self.surfaces.pinned_offset(state.q, state.position, state.rotation) - offset
            rows = (kin.frame.mT @ (state.rotation @ moved[..., None]))[..., 0]
            full = torch.zeros(kin.contacts.n_c, 6, dtype=value.dtype)
            full[:, :3] = rows
            translations = full.flatten()[kin.rows]
            mask = torch.tensor([row // 6 in pinned and row % 6 < 3 for row in kin.rows])
            value = torch.where(mask, translations, value)
        return value


def _follow(at: Equilibrium, step: Callable[[Equilibrium, float], Equilibrium], steps: int) -> Equilibrium:
    """The end of a path from 0 to 1, in steps that are halved where Newton fails."""
    done, size = 0.0, 1.0 / steps
    while done < 1 - 1e-12:
        target = min(1.0, done + size)
        try:
            at = step(at, target)
            done = target
        except EquilibriumError as error:
            size /= 2
            if size * steps < 1 / 64:
                raise EquilibriumError("newton", f"{100 * done:.0f} % of the way: {error.status}") from error
    return at


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


class _NoStops(ForceBalance):
    def _bounded(self, q):
        return [], np.zeros(0), np.zeros(0)
