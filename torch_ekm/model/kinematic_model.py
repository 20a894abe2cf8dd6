"""The kinematic model: from actuator increments to the motion of hand and object."""

from __future__ import annotations

import dataclasses

import torch
from torch import nn

from .._arrays import in_numpy, is_plain, like, namespace, zeros
from .._checks import check_kind
from .._noise import NOISE
from ..contact.contacts import ContactKinematics, ContactSet, Detector, constraint_matrix, contact_kinematics
from ..contact.detector import ContactDetector
from ..description.hand import HandDescription
from ..exceptions import NoContactError
from ..kinematics.poses import A_STATE, GraspState, HandKinematics, Kinematics, LinkPoses
from ..typing import AnyArray, Bool, Float, Tensor
from .contact_motion import ContactMotion, ContactStep
from .grasp_forces import ExpectedForces, ForceBalance, GraspForces
from .linearization import FollowedFigures, Linearization, MotionEquations, sensitivities
from .reduction import Reduction
from .stiffness import (
    Arms,
    arms_at,
    bends,
    geometric_stiffness,
    gravity_gradient,
    gravity_hessian,
    over_posture,
)
from .validity import ModelOptions, at_pads, check_contacts, check_described, check_state, find_doubts

TOUCHING = 0.2e-3
"""Gap of a link that counts as touching [m]."""
_SOFTENS = 0.85  # of the stiffness without forces, below which a grasp is gripped no harder
_FORCES = "mu", "force", "normal", "spin_moment"


class KinematicModel(nn.Module):
    """``ds = J_m(s) da``: quasi-static manipulation by an elastic, underactuated hand.

    ```
    [ D  A^T  B^T ] [ ds   ]   [ 0  ]      A ds = 0      contacts stick or roll
    [ A   0    0  ] [ dmu  ] = [ 0  ]      B ds = da     actuators (plus their compliance)
    [ B   0    0  ] [ dlam ]   [ da ]      D = dF/ds     springs, gravity, load-dependent geometry
    ```

    Solved in the two-stage form ``J_m = P - N (N^T D N)^-1 N^T D P``, ``N = null([A; B])``,
    ``P = [A; B]^+ [0; I]``: only the stiffness with the actuators locked is inverted. Rigid couplings are
    reduced out, joints at a stop are held, contacts come from the detector, forces from
    :func:`~torch_ekm.contact.contact_forces`. Derived from the Lagrange multipliers of the
    quasi-static equilibrium; ``docs/explanation/quasi_static_model.md`` has the derivation.

    Args:
        hand: the hand, whose motors count as :meth:`HandDescription.counted` has them; its gravity is the
            model's.
        obj: the object: its mass, centre of mass and surfaces.
        options: what to take into account.
        kinematics: in place of :class:`~torch_ekm.kinematics.HandKinematics`.
        detector: ``(q, position, rotation) -> ContactSet`` in place of the collision detector.
        dtype: float64 (default) or float32.

    Raises:
        ParameterError: no hand, no object, or its mass or centre of mass is no number, or the mass negative.
        DescriptionError: the hand has no pads for the detector.
    """

    spring_stiffness: Float[Tensor, " n_q"]
    """Diagonal of K_s [N m/rad]."""
    spring_rest: Float[Tensor, " n_q"]
    """q0 [rad]."""
    weight: Float[Tensor, " 3"]
    """Of the object, hand frame [N]."""
    com: Float[Tensor, " 3"]
    """Of the object, in its own frame [m]."""
    figures: FollowedFigures | None = None
    """What J_m follows in place of the description, see :meth:`with_figures`."""
    surface: float = 0.0
    """How much farther out the object's surface is than described [m]; a loop that learns sets it."""
    plane: Float[Tensor, " 3"] | None
    """Normal of a planar hand's plane; None: a spatial hand."""
    precedes: Bool[Tensor, "n_q n_q"]
    """Joint a is proximal to joint b or equal to it."""

    def __init__(
        self,
        hand: HandDescription,
        obj,
        options: ModelOptions | None = None,
        *,
        kinematics: Kinematics | None = None,
        detector: Detector | None = None,
        dtype: torch.dtype = torch.float64,
    ) -> None:
        super().__init__()
        check_described(hand, obj)
        hand = hand.counted()
        self.hand, self.obj, self.options = hand, obj, options or ModelOptions()
        self.kinematics = HandKinematics(hand, dtype=dtype) if kinematics is None else kinematics
        if detector is None:
            detector = ContactDetector(hand, obj, self.options.contact_margin, kinematics=self.kinematics)
        self.detector = detector
        self._grown: tuple[float, ContactDetector] | None = None
        self.link_names = tuple(self.kinematics.link_names)
        self.reduction = Reduction(hand, self.options.actuator_compliance, dtype)
        forces, slack_tension = self.options.forces, self.options.slack_tension
        self.balance = ForceBalance(hand, self.reduction, forces, slack_tension)
        figures = {
            "spring_stiffness": hand.spring_stiffness, "spring_rest": hand.spring_rest, "com": obj.com,
            "weight": float(obj.mass) * torch.tensor(hand.gravity, dtype=torch.float64),
            "plane": hand.planar_normal,
        }  # fmt: skip
        for name, value in figures.items():
            value = None if value is None else torch.as_tensor(value).to(dtype)
            self.register_buffer(name, value, persistent=False)
        moved = self.kinematics.upstream.mT  # a proximal joint moves every link that the other one moves
        precedes = (moved[:, None, :] | ~moved[None, :, :]).all(-1)
        self.register_buffer("precedes", precedes, persistent=False)

    def with_figures(self, figures: FollowedFigures) -> KinematicModel:
        """A model of the same hand and object whose J_m follows ``figures`` as they are learned.

        Forces, their sensitivities and stability stay those of the description. A batch of states, and a
        grasp that would buckle with these figures, get the description's J_m.
        """
        made = KinematicModel(
            self.hand, self.obj, self.options, kinematics=self.kinematics, detector=self.detector,
            dtype=self.weight.dtype,
        )  # fmt: skip
        object.__setattr__(made, "figures", figures)  # they belong to the hand, not to the model's state
        return made

    @property
    def touch_detector(self) -> Detector:
        """The detector, of an object whose surface is ``surface`` farther out."""
        if not self.surface or not isinstance(self.detector, ContactDetector):
            return self.detector
        if self._grown is None or self._grown[0] != self.surface:
            self._grown = self.surface, self.detector.grown(self.surface)
        return self._grown[1]

    def followed(self, lin: Linearization) -> Linearization:
        """The same state with J_m of the present figures."""
        found = None if self.figures is None or lin.equations is None else self.figures.solve(lin.equations)
        if found is None:
            return lin
        return dataclasses.replace(
            lin, manipulation_jacobian=found.jacobian, described=lin.described_jacobian
        )

    def adapt(
        self, state: GraspState, action: Float[Tensor, " n_a"], increment: Float[Tensor, " n_s"]
    ) -> object:
        """Let the figures learn from one motion; nothing without figures."""
        return None if self.figures is None else self.figures.learn(self.linearize(state), action, increment)

    def extra_repr(self) -> str:
        return f"hand={self.hand.name}, n_q={self.hand.n_q}, n_a={self.hand.n_a}"

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
    def contacts(
        self, state: GraspState, fingertip_force: Float[Tensor, " n_pads"] | None = None
    ) -> ContactSet:
        """Contacts of one state, from the detector.

        Args:
            fingertip_force: normal forces as measured [N]; a pad that measures more than 0.5 N touches, up to
                6 mm off, as far as pads and objects are described wrongly.

        Raises:
            NoContactError: nothing touches the object.
        """
        return self._detect(check_kind("state", state, GraspState, A_STATE), None, fingertip_force)

    def _detect(
        self, state: GraspState, poses: LinkPoses | None, fingertip_force: Tensor | None
    ) -> ContactSet:
        detector, place = self.touch_detector, (state.position, state.rotation)
        if isinstance(detector, ContactDetector):
            at = state.q if poses is None else poses
            contacts = detector(at, *place, self.pressing(fingertip_force))
        else:
            contacts = detector(state.q, *place)
        if contacts.n_c == 0:
            raise NoContactError("no finger touches the object, so no actuator can move it")
        return contacts

    def pressing(self, fingertip_force: Tensor | None) -> tuple[str, ...]:
        """Pads that measure a force."""
        if fingertip_force is None or fingertip_force.shape != (len(self.hand.pads),):
            return ()
        pads = zip(self.hand.pads, fingertip_force.tolist(), strict=True)
        return tuple(pad.name for pad, force in pads if force > NOISE.pressing)

    @torch.no_grad()
    def touching(
        self, state: GraspState, fingertip_force: Float[Tensor, " n_pads"] | None = None
    ) -> ContactSet:
        """:meth:`contacts`, and links without a pad within 0.2 mm of the object, by the links' names.

        Raises:
            NoContactError: nothing touches the object.
        """
        contacts, detector = self.contacts(state, fingertip_force), self.touch_detector
        if not isinstance(detector, ContactDetector):
            return contacts
        margin = max(detector.margin, TOUCHING)
        pressing = self.pressing(fingertip_force)
        near = detector.near(state.q, state.position, state.rotation, margin, pressing)
        pads = len(contacts.finger)  # they come first, in the same order
        links = [i for i in range(pads, near.n_c) if float(near.gap[i]) < TOUCHING]
        return near.select([*range(pads), *links])

    def step(
        self,
        state: GraspState,
        delta_a: Float[Tensor, " n_a"],
        *,
        fingertip_force: Float[Tensor, " n_pads"] | None = None,
        expected: ExpectedForces | None = None,
        a: Float[Tensor, " n_a"] | None = None,
    ) -> ContactStep:
        """The state after a motion in which contacts stick, slide, open and close, links and stops bear, and
        tendons go slack: the equilibrium of a :class:`~torch_ekm.model.ContactMotion` that begins here.

        :meth:`forward` is its derivative while nothing of that happens. Not differentiable by autograd:
        ``ContactStep.jacobian`` is its derivative.

        Args:
            state: one state.
            delta_a: increment of the encoders [rad].
            fingertip_force, expected: what is known of the forces, as in :meth:`linearize`.
            a: encoders [rad], of a hand that is as described.

        Raises:
            GraspEndsError: no equilibrium is near.
            GraspError: what :meth:`linearize` raises.
        """
        known = {"fingertip_force": fingertip_force, "expected": expected}
        touching = self.touching(state, fingertip_force)
        start = self.linearize(state, touching, **known, on_unstable="flag")
        return ContactMotion(self, start, a=a).move(delta_a)

    def moving(self, contacts: ContactSet) -> Bool[Tensor, " n_q"]:
        """Joints that move a contact."""
        links = [self.link_names.index(name) for name in contacts.link]
        return torch.from_numpy(self.kinematics.upstream.numpy()[links].any(0))

    def contact_kinematics(
        self,
        state: GraspState,
        contacts: ContactSet,
        *,
        rolling: bool | None = None,
        poses: LinkPoses | None = None,
    ) -> ContactKinematics:
        """Motion of the contact points, frames and lever arms at a state (``poses``: if known already)."""
        found = self.kinematics(state.q) if poses is None else poses
        axis, origin = self.kinematics.joint_axes(found)
        links = [self.link_names.index(name) for name in contacts.link]
        parts = axis, origin, self.kinematics.upstream
        axis, origin, upstream = (like(part, contacts.point) for part in parts)
        rolling = self.options.rolling if rolling is None else rolling
        return contact_kinematics(
            contacts, state.position, axis, origin, upstream[links], plane=self.plane, rolling=rolling
        )

    @torch.no_grad()
    def linearize(
        self,
        state: GraspState,
        contacts: ContactSet | None = None,
        *,
        forces: GraspForces | None = None,
        fingertip_force: Float[Tensor, "*batch n_pads"] | None = None,
        expected: ExpectedForces | None = None,
        previous: Linearization | None = None,
        on_unstable: str | None = None,
    ) -> Linearization:
        """Contacts, forces, ``J_m``, the force sensitivities and their doubts, at a state.

        J_m is no function of the state that autograd differentiates: a state that asks for it is refused.

        Args:
            state: one state, or a batch together with batched ``contacts``.
            contacts: by default from the detector (single state).
            forces: known forces; by default from the relaxed force problem, whose answer is the smallest
                where nothing more is known.
            fingertip_force: measured normal forces [N] in the order of ``hand.pads``, NaN where unknown, to
                be respected in that problem. Worth giving where joints are at their stops.
            expected: ``previous.forces_after(da)``, da what the encoders moved since: the forces then change
                least from these, as far as balance and measurements leave them open.
            previous: the last linearization of this grasp whose forces were found. Where that problem has
                no answer, its forces stand in, if the same fingers touch. A pad that touched then and is
                left out now is a doubt.
            on_unstable: in place of the option of this name.

        Raises:
            NoContactError: nothing touches the object.
            PenetrationError: a finger lies deep inside the object.
            SingularGraspError: a motion meets no stiffness, or rigid actuators contradict each other.
            UnstableGraspError: the grasp buckles (unless ``on_unstable="flag"``).
            NonFiniteError, ParameterError, ShapeError, UnknownNameError: bad input.
        """
        check_kind("state", state, GraspState, A_STATE)
        check_state(self.hand, state, contacts, self.weight.dtype)
        poses = self.kinematics(state.q)
        detected = contacts is None and isinstance(self.detector, ContactDetector)
        contacts = self._detect(state, poses, fingertip_force) if contacts is None else contacts
        check_contacts(state, contacts, self.link_names, self.options.max_overlap, detected)
        # the same equations, for one state in numpy
        plain = state.q.dim() == 1 and is_plain(state.q, contacts.gap)
        at = in_numpy(state) if plain else state
        kin = self.contact_kinematics(at, in_numpy(contacts) if plain else contacts, poses=poses)
        A = constraint_matrix(kin)
        V_s, V_ss = self.potential(at)
        arms = arms_at(self.hand, at.q)
        last, before, measured = None, () if previous is None else previous.contacts.finger, {}
        if fingertip_force is not None:
            measured = at_pads(self.hand, contacts, fingertip_force, at.q)
        if forces is None:
            if previous is not None and previous.forces.solved and before == contacts.finger:
                last = previous.forces
            touch = [measured[finger] for finger in contacts.finger] if measured else None
            normal = None if touch is None else namespace(at.q).stack(touch, -1)
            forces = self.balance(at.q, kin, A, V_s, arms=arms, normal=normal, expected=expected, last=last)

        o = self.options
        if on_unstable is not None and on_unstable != o.on_unstable:
            o = dataclasses.replace(o, on_unstable=on_unstable)
        f = in_numpy(forces) if plain else forces
        D = self.load_stiffness(kin, f.force, f.spin_moment) + V_ss
        if arms.varies:
            n_q, actuation = self.hand.n_q, like(self.reduction.actuation, at.q)
            D[..., :n_q, :n_q] += bends(self.hand, at.q, actuation, f.lam, f.loop)
        held = self.balance.held_by_stops(at.q, f.stop_torque)
        slack = like(self.balance.slack(forces), at.q)
        J, dmu, stability = self.reduction.solve(D, A, kin.rows, held, slack, o.on_unstable, arms)
        found = sensitivities(kin, f, J, dmu)
        held, stability, D, A, slack = map(torch.as_tensor, (held, stability, D, A, slack))
        equations = None
        if held.dim() == 1:
            moving = self.moving(contacts)
            known = Arms(*(None if part is None else torch.as_tensor(part) for part in arms))
            equations = MotionEquations(self.reduction, D, A, tuple(kin.rows), held, slack, moving, known)
        reused, names = last is not None, self.hand.joint_names
        doubts = find_doubts(o, names, contacts, forces, stability, reused, measured, before)
        lin = Linearization(
            state=state,
            contacts=contacts,
            forces=forces,
            **found,
            held_joints=held,
            stability=stability,
            options=o,
            equations=equations,
            doubts=doubts,
        )
        return self.followed(lin)

    def load_stiffness(
        self,
        kin: ContactKinematics,
        force: Float[AnyArray, "*batch n_c 3"],
        spin_moment: Float[AnyArray, "*batch n_c"],
    ) -> Float[AnyArray, "*batch n_s n_s"]:
        """``dF/ds`` at constant contact forces: lever arms of hand and object, rolling, soft-finger spin."""
        return geometric_stiffness(kin, force, spin_moment, self.precedes)

    def potential(
        self, state: GraspState
    ) -> tuple[Float[AnyArray, "*batch n_s"], Float[AnyArray, "*batch n_s n_s"]]:
        """``V_s`` [N m, N] and ``V_ss`` of springs and the object's weight."""
        n_q = self.hand.n_q
        q = state.q
        buffers = self.com, self.spring_stiffness, self.spring_rest, self.weight
        com, springs, rest, weight = (like(buffer, q) for buffer in buffers)
        com_lever = (state.rotation @ com[:, None])[..., 0]
        V_ss = zeros(q, *q.shape[:-1], n_q + 6, n_q + 6)
        V_ss[..., :n_q, :n_q] = namespace(q).diag(springs)
        V_ss[..., n_q:, n_q:] = gravity_hessian(weight, com_lever)
        torque, over = springs * (q - rest), self.hand.tendon_springs
        if over is not None:
            torque = torque + over_posture(q, over.torque)
            V_ss[..., :n_q, :n_q] += over_posture(q, over.stiffness_matrix)
        V_s = [torque, gravity_gradient(weight, com_lever)]
        return namespace(q).concat(V_s, -1), V_ss


def softened(model: KinematicModel, lin: Linearization) -> bool:
    """Whether contact forces have taken so much of a grasp's stiffness that it is near buckling."""
    forces = dataclasses.replace(lin.forces, **{name: 0 * getattr(lin.forces, name) for name in _FORCES})
    free = model.linearize(lin.state, lin.contacts, forces=forces, on_unstable="flag")
    return float(lin.stability) < _SOFTENS * float(free.stability)
