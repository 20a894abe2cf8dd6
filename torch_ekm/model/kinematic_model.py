"""The kinematic model: from actuator increments to the motion of hand and object."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import nn

from ..contact.contact_kinematics import ContactKinematics, constraint_matrix, contact_kinematics
from ..contact.contact_set import ContactSet
from ..description.hand import HandDescription
from ..exceptions import NoContactError, NonFiniteError, PenetrationError, ShapeError, UnknownNameError
from ..kinematics.grasp_state import GraspState
from ..typing import Float, Tensor
from .force_balance import ForceBalance
from .linearization import GraspForces, Linearization, ModelStatus
from .link_weights import LinkWeights
from .manipulation import Step
from .options import ModelOptions
from .potential import gravity_gradient, gravity_hessian, spring_torque
from .reduction import Reduction
from .sensitivity import force_change, margin_sensitivity, normal_motion, normal_sensitivity
from .stiffness import geometric_stiffness, precedence


class KinematicModel(nn.Module):
    """``ds = J_m(s) da``: quasi-static manipulation by an elastic, underactuated hand.

    ```
    [ D  A^T  B^T ] [ ds   ]   [ 0  ]      A ds = 0      contacts stick or roll
    [ A   0    0  ] [ dmu  ] = [ 0  ]      B ds = da     actuators (plus their compliance)
    [ B   0    0  ] [ dlam ]   [ da ]      D = dF/ds     springs, gravity, load-dependent geometry
    ```

    Solved in the two-stage form (:func:`~torch_ekm.model.manipulation.two_stage`). Rigid couplings are
    reduced out, joints at a stop are held, contacts come from the detector, forces from
    :func:`~torch_ekm.contact.forces.problem.contact_forces`. Derived from the Lagrange multipliers of the
    quasi-static equilibrium; ``docs/kinematic_model.md`` has the whole of it.

    Args:
        hand: the hand.
        obj: the object: its mass, centre of mass and surfaces.
        options: what to take into account.
        kinematics: in place of :class:`~torch_ekm.kinematics.HandKinematics`.
        detector: ``(q, position, rotation) -> ContactSet`` in place of the collision detector.
        dtype: float64 (default) or float32.
    """

    def __init__(
        self,
        hand: HandDescription,
        obj,
        options: ModelOptions | None = None,
        *,
        kinematics: nn.Module | None = None,
        detector: Callable[[Tensor, Tensor, Tensor], ContactSet] | None = None,
        dtype: torch.dtype = torch.float64,
    ) -> None:
        super().__init__()
        self._detector_takes_poses = False
        self.hand, self.obj, self.options = hand, obj, options or ModelOptions()
        if kinematics is None:
            from ..kinematics import HandKinematics

            kinematics = HandKinematics(hand, dtype=dtype)
        if detector is None:
            from ..contact.detector import ContactDetector

            margin = self.options.contact_margin
            detector = ContactDetector(hand, obj, margin, kinematics=kinematics)  # type: ignore[arg-type]
            self._detector_takes_poses = True
        self.kinematics, self.detector = kinematics, detector
        self.link_names: tuple[str, ...] = tuple(kinematics.link_names)  # type: ignore[arg-type]
        self.reduction = Reduction(hand, self.options, dtype)
        self.balance = ForceBalance(hand, self.options, self.reduction)

        def buffer(name: str, value: object) -> None:
            self.register_buffer(name, torch.as_tensor(value).to(dtype), persistent=False)

        buffer("spring_stiffness", hand.spring_stiffness)
        buffer("spring_rest", hand.spring_rest)
        buffer("weight", float(obj.mass) * torch.tensor(self.options.gravity, dtype=torch.float64))
        buffer("com", obj.com)
        self.plane: Tensor | None
        normal = hand.planar_normal
        self.register_buffer(
            "plane", None if normal is None else torch.tensor(normal, dtype=dtype), persistent=False
        )
        upstream: Tensor = kinematics.upstream  # type: ignore[assignment]
        self.register_buffer("precedes", precedence(upstream), persistent=False)
        self.link_weights: LinkWeights | None = None
        if self.options.link_weights:
            self.link_weights = LinkWeights(hand, kinematics, self.options.gravity, dtype)
        self._last: tuple[tuple[str, ...], Tensor, Tensor] | None = None

    def extra_repr(self) -> str:
        return f"hand={self.hand.name}, n_q={self.hand.n_q}, n_a={self.hand.n_a}"

    def reset(self) -> None:
        """Forget the forces of the previous step."""
        self._last = None

    def forward(
        self, state: GraspState, delta_a: Float[Tensor, "*batch n_a"], contacts: ContactSet | None = None
    ) -> Float[Tensor, "*batch n_s"]:
        """``ds = J_m(s) da``: predicted increment ``[dq; do; dphi]`` [rad, m, rad].

        Raises:
            ShapeError: ``delta_a`` does not fit the hand.
            GraspError: see :meth:`linearize`.
        """
        return self.linearize(state, contacts).step(delta_a)

    @torch.no_grad()
    def contacts(self, state: GraspState) -> ContactSet:
        """Contacts of one state, from the detector.

        Raises:
            NoContactError: nothing touches the object.
        """
        return self._detect(state, None)

    def _detect(self, state: GraspState, poses: object | None) -> ContactSet:
        posture = poses if self._detector_takes_poses and poses is not None else state.q
        contacts = self.detector(posture, state.position, state.rotation)  # type: ignore[arg-type]
        if contacts.n_c == 0:
            raise NoContactError("no finger touches the object, so no actuator can move it")
        return contacts

    @torch.no_grad()
    def contact_kinematics(
        self,
        state: GraspState,
        contacts: ContactSet,
        *,
        rolling: bool | None = None,
        poses: object | None = None,
    ) -> ContactKinematics:
        """Motion of the contact points, frames and lever arms at a state (``poses``: if known already)."""
        poses = self.kinematics(state.q) if poses is None else poses
        axis, origin = self.kinematics.joint_axes(poses)  # type: ignore[operator]
        links = [self.link_names.index(name) for name in contacts.link]
        upstream = self.kinematics.upstream[links]  # type: ignore[index]
        model = self.options.contact_model
        models = None if model is None else (model,) * contacts.n_c
        rolling = self.options.rolling if rolling is None else rolling
        return contact_kinematics(
            contacts, state.position, axis, origin, upstream, models=models, plane=self.plane, rolling=rolling
        )

    @torch.no_grad()
    def linearize(
        self,
        state: GraspState,
        contacts: ContactSet | None = None,
        *,
        forces: GraspForces | None = None,
        fingertip_force: Float[Tensor, "*batch n_pads"] | None = None,
        locked: Sequence[str] = (),
    ) -> Linearization:
        """Contacts, forces, ``J_m`` and the force sensitivities at a state.

        Args:
            state: one state, or a batch together with batched ``contacts``.
            contacts: by default from the detector (single state).
            forces: known forces; by default from the relaxed minimal-force problem.
            fingertip_force: measured normal forces [N] in the order of ``hand.pads``, NaN where unknown, to
                be respected in that problem. Worth giving where joints are at their stops.
            locked: joints that stick, by name.

        Raises:
            NoContactError: nothing touches the object.
            PenetrationError: a finger lies deep inside the object.
            SingularGraspError: a motion meets no stiffness, or rigid actuators contradict each other.
            UnstableGraspError: the grasp buckles (unless ``on_unstable="flag"``).
            NonFiniteError, ShapeError, UnknownNameError: bad input.
        """
        self._check_state(state, contacts)
        poses = self.kinematics(state.q)
        contacts = self._detect(state, poses) if contacts is None else contacts
        self._check_contacts(state, contacts)
        kin = self.contact_kinematics(state, contacts, poses=poses)
        n_q = self.hand.n_q
        A = constraint_matrix(kin)
        V_s, V_ss = self.potential(state, poses)
        V_q, V_p = V_s[..., :n_q], V_s[..., n_q:]
        lock = [self._joint(name) for name in locked]
        status = ModelStatus.OK
        if forces is None:
            last = self._last if self._last is not None and self._last[0] == contacts.finger else None
            measured = None if fingertip_force is None else self._of_contacts(contacts, fingertip_force)
            forces = self.balance(
                state.q, kin, A, V_q, V_p, lock, measured, None if last is None else last[1:]
            )
            if forces.solved:
                if state.q.dim() == 1:
                    self._last = (contacts.finger, forces.mu, forces.lam)
            else:
                status = ModelStatus.NO_FORCES if last is None else ModelStatus.REUSED_FORCES

        o = self.options
        D = geometric_stiffness(
            kin,
            forces.force,
            forces.spin_moment,
            self.precedes,  # type: ignore[arg-type]
            hand=o.hand_stiffness,
            obj=o.object_stiffness,
            rolling=o.rolling,
        )
        D = D + V_ss
        if o.stiffness_floor:
            joints = torch.arange(n_q, device=D.device)
            D[..., joints, joints] += o.stiffness_floor

        held = self.balance.held_by_stops(state.q, forces.stop_torque)
        held[..., lock] = True
        slack = torch.zeros_like(forces.lam).bool()
        if o.slack_tension is not None:
            slack = self.balance.tendon & (-forces.lam <= o.slack_tension)
        step, dmu, dlam = self._step(D, A, kin, held, slack)
        if o.on_unstable == "flag" and bool((step.stability <= 0).any()):
            status = ModelStatus.UNSTABLE
        J = step.motion
        df, dn = force_change(kin, dmu), normal_motion(kin, J)
        normal = normal_sensitivity(kin, forces, df, dn)
        return Linearization(
            state=state,
            contacts=contacts,
            forces=forces,
            manipulation_jacobian=J,
            contact_force_sensitivity=dmu,
            actuator_force_sensitivity=dlam,
            normal_force_sensitivity=normal,
            margin_sensitivity=margin_sensitivity(kin, forces, dmu, df, dn, normal),
            normal_rows=tuple(kin.normal_rows),
            held_joints=held,
            stability=step.stability,
            status=status,
        )

    def potential(
        self, state: GraspState, poses: object | None = None
    ) -> tuple[Float[Tensor, "*batch n_s"], Float[Tensor, "*batch n_s n_s"]]:
        """``V_s`` [N m, N] and ``V_ss`` of springs, the object's weight and (as an option) the links'."""
        n_q = self.hand.n_q
        com_lever = (state.rotation @ self.com[:, None])[..., 0]  # type: ignore[index]
        V_q = spring_torque(state.q, self.spring_stiffness, self.spring_rest)  # type: ignore[arg-type]
        V_ss = state.q.new_zeros(*state.q.shape[:-1], n_q + 6, n_q + 6)
        V_ss[..., :n_q, :n_q] = torch.diag(self.spring_stiffness)  # type: ignore[arg-type]
        V_ss[..., n_q:, n_q:] = gravity_hessian(self.weight, com_lever)  # type: ignore[arg-type]
        if self.link_weights is not None:
            poses = self.kinematics(state.q) if poses is None else poses
            gradient, hessian = self.link_weights(poses)
            V_q = V_q + gradient
            V_ss[..., :n_q, :n_q] += hessian
        V_p = gravity_gradient(self.weight, com_lever)  # type: ignore[arg-type]
        return torch.cat([V_q, V_p], dim=-1), V_ss

    def _step(
        self, D: Tensor, A: Tensor, kin: ContactKinematics, held: Tensor, slack: Tensor
    ) -> tuple[Step, Tensor, Tensor]:
        """Reduce, scale and solve; states of a batch that differ in what is held are grouped."""
        pattern = torch.cat([held, slack], dim=-1).reshape(-1, held.shape[-1] + slack.shape[-1])
        if len(pattern) == 1 or bool((pattern == pattern[0]).all()):
            n_q = held.shape[-1]
            return self.reduction.solve(D, A, kin.rows, pattern[0, :n_q], pattern[0, n_q:])
        batch = held.shape[:-1]
        flat_D, flat_A = D.reshape(-1, *D.shape[-2:]), A.reshape(-1, *A.shape[-2:])
        n_q, n_a = held.shape[-1], slack.shape[-1]
        J = D.new_empty(len(pattern), D.shape[-1], n_a)
        dmu = D.new_empty(len(pattern), A.shape[-2], n_a)
        dlam, stability = D.new_empty(len(pattern), n_a, n_a), D.new_empty(len(pattern))
        for unique in torch.unique(pattern, dim=0):
            at = (pattern == unique).all(-1)
            step, part_mu, part_lam = self.reduction.solve(
                flat_D[at], flat_A[at], kin.rows, unique[:n_q], unique[n_q:]
            )
            J[at], stability[at], dmu[at], dlam[at] = step.motion, step.stability, part_mu, part_lam
        whole = Step(J.reshape(*batch, *J.shape[1:]), dmu[:0], stability.reshape(batch))
        return whole, dmu.reshape(*batch, *dmu.shape[1:]), dlam.reshape(*batch, n_a, n_a)

    def _check_state(self, state: GraspState, contacts: ContactSet | None) -> None:
        if state.q.shape[-1] != self.hand.n_q:
            names = ", ".join(self.hand.joint_names)
            raise ShapeError("q", f"(*batch, {self.hand.n_q})", state.q.shape, f"the joints are: {names}")
        if contacts is None and state.q.dim() > 1:
            raise ShapeError("q", f"({self.hand.n_q},)", state.q.shape, "for a batch give the contacts too")

    def _check_contacts(self, state: GraspState, contacts: ContactSet) -> None:
        if contacts.n_c == 0:
            raise NoContactError("no finger touches the object, so no actuator can move it")
        if contacts.batch_shape != state.q.shape[:-1]:
            raise ShapeError("contacts.gap", f"{(*state.q.shape[:-1], contacts.n_c)}", contacts.gap.shape)
        for name in ("point", "normal", "gap"):
            if not bool(torch.isfinite(getattr(contacts, name)).all()):
                raise NonFiniteError(f"contacts.{name}")
        for name in contacts.link:
            if name not in self.link_names:
                raise UnknownNameError("link", name, self.link_names)
        deepest = float(contacts.gap.amin())
        if deepest < -self.options.max_overlap:
            which = contacts.finger[int(contacts.gap.reshape(-1, contacts.n_c).amin(0).argmin())]
            raise PenetrationError(which, -deepest, self.options.max_overlap)

    def _of_contacts(self, contacts: ContactSet, fingertip_force: Tensor) -> Tensor:
        pads = [pad.name for pad in self.hand.pads]
        if fingertip_force.shape[-1] != len(pads):
            raise ShapeError(
                "fingertip_force", f"(*batch, {len(pads)})", fingertip_force.shape, f"pads: {', '.join(pads)}"
            )
        for name in contacts.finger:
            if name not in pads:
                raise UnknownNameError("pad", name, pads)
        return fingertip_force[..., [pads.index(name) for name in contacts.finger]]

    def _joint(self, name: str) -> int:
        if name not in self.hand.joint_names:
            raise UnknownNameError("joint", name, self.hand.joint_names)
        return self.hand.joint_names.index(name)
