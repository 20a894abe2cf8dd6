"""A hand that does what the model predicts: the plant on which a turn is tried before anything moves."""

from __future__ import annotations

import contextlib
import copy
import math

import torch

from ..enhanced import EnhancedModel
from ..enhanced.enhanced_model import kinematic_and_enhanced
from ..estimation.filters import ForceSensitivity
from ..exceptions import GraspEndsError, GraspError
from ..kinematics import GraspState
from ..model import ContactMotion, ContactStep, KinematicModel, Linearization
from ..plant import Observation, PlantStatus
from ..typing import Float, Tensor
from .program import of_pads

_NEAR_END = math.radians(0.1)


class ModelHand:
    """``s <- step(s, w) (+) g(s, w)``, contacts sticking, sliding, opening and closing; implements
    :class:`~torch_ekm.plant.Plant`.

    The motion is that of a :class:`~torch_ekm.model.ContactMotion`; links and joint stops bear. What a
    learner adds is taken for an equilibrium under the same forces. Fingertips report normal forces, encoders
    go where they are commanded to.

    Args:
        model: predicts the motions.
        state, a, fingertip_force: where it begins, as measured [rad, m, N].
        forces: how the pads' forces answer, as learned; None: as the model says.
    """

    failure: GraspError | None
    """Why the grasp ends, after which the object counts as lost; None: it holds."""

    def __init__(
        self,
        model: KinematicModel | EnhancedModel,
        state: GraspState,
        a: Float[Tensor, " n_a"],
        fingertip_force: Float[Tensor, " n_pads"] | None = None,
        forces: ForceSensitivity | None = None,
    ) -> None:
        self._forces = forces
        self.kinematic, self._enhanced = kinematic_and_enhanced(model)
        self.hand = hand = self.kinematic.hand
        self._start = state, a, fingertip_force
        limits = hand.actuator_lower, hand.actuator_upper
        self._a_min, self._a_max = (torch.from_numpy(x).to(a) for x in limits)
        self.reset(0)

    def reset(self, seed: int) -> Observation:
        """Back to where it began; there is no noise to be seeded."""
        self.state, self.a, force = self._start
        self.time, self.failure = 0.0, None
        self._motion: ContactMotion | None = None
        self._linearization: Linearization | None = None
        self._tried: tuple[ContactMotion, Tensor, ContactMotion, ContactStep] | None = None
        self._way = self.a.new_zeros(self.hand.n_a)
        self.increment = self.correction = self.a.new_zeros(self.state.n_s)
        """Of the last motion, and g's part of it [rad, m, rad]."""
        self.said = self.a.new_zeros(len(self.hand.pads))
        """Change of the normal forces in it, by the model alone [N]."""
        self._spare, self._is_stale = self.said, False
        self._bears = self.said  # what the model thinks that the pads bear: other than they measure
        self._measured, self._stands = force is not None, False
        self.force = self.a.new_zeros(len(self.hand.pads)) if force is None else force
        self._stand()
        return self.observe()

    def observe(self) -> Observation:
        """The predicted state [rad, m], encoders [rad] and normal forces [N]; LOST after a failure."""
        s = self.state
        status = PlantStatus.LOST if self.failure else PlantStatus.HELD
        return Observation(s.q, self.a, s.position, s.rotation, self.force, self.time, status)

    def command(self, delta_a: Float[Tensor, " n_a"]) -> Observation:
        """Move the encoders by ``delta_a`` [rad], as far as their ranges allow."""
        self._stand()
        if self._motion is not None and not self.failure:
            self._move(self._within(delta_a), self._motion)
        self.time += 1.0
        return self.observe()

    @property
    def linearization(self) -> Linearization | None:
        """At the present state, contacts doing what they do in another motion like the last one; None where
        the model refuses."""
        self._stand()
        if self._linearization is None and self._motion is not None:
            with contextlib.suppress(GraspError):
                self._linearization = self._motion.linearize(self._way)
        return self._linearization

    @property
    def margin(self) -> Float[Tensor, " n_pads"]:
        """``mu_s f_n - |f_t|`` of each pad here, as a reading would give it [N]."""
        self._stand()
        if self._is_stale:
            with contextlib.suppress(GraspError):
                self._see()
        return self._spare

    def tangent(self, w: Float[Tensor, " n_a"]) -> tuple[Tensor, Tensor] | None:
        """``f(s, u) ~ J u + c`` about u = w: J with contacts that do what they do at the end of it. Nothing
        moves. None: the model has no such motion."""
        self._stand()
        if self._motion is None or self.failure:
            return None
        way = self._within(w)
        try:
            _, step = self._moved(way, self._motion)
        except GraspError:
            return None
        return step.jacobian, step.increment - step.jacobian @ way

    def close(self) -> None:
        """Does nothing: the model holds no device."""

    def at_stops(self, push: float = 0.0) -> list[str]:
        """Joints of the fingers that touch, at a stop that bears more than ``push`` [N m]."""
        lin = self.linearization
        if self._motion is None or lin is None:
            return []
        bears = torch.from_numpy(self._motion.loads.stop).abs() > max(push, 1e-6)
        bears &= self.kinematic.moving(lin.contacts)
        return [self.hand.joint_names[j] for j in torch.nonzero(bears).flatten().tolist()]

    def at_limits(self) -> list[str]:
        """Actuators at an end of their range."""
        ends = (self.a <= self._a_min + _NEAR_END) | (self.a >= self._a_max - _NEAR_END)
        return [self.hand.actuator_names[i] for i in torch.nonzero(ends).flatten().tolist()]

    def _stand(self) -> None:
        """Go on from the state as from a reading with these normal forces [N], if that is to be done yet."""
        if self._stands:
            return
        self._stands = True
        try:
            lin = self._see()
            if not lin.forces.solved:
                self.failure = GraspEndsError(str(lin.doubts[0]))
            self._motion = ContactMotion(self.kinematic, lin)
            self._linearization = self._motion.answered(lin)
            self._bears = of_pads(self.hand, lin.contacts.finger, lin.forces.normal).to(self.a)
        except GraspError as error:
            self.failure = error

    def _see(self) -> Linearization:
        """The grasp as a reading here would give it, and the margins in it."""
        force = self.force if self._measured else None
        contacts = self.kinematic.touching(self.state, force)
        lin = self.kinematic.linearize(self.state, contacts, fingertip_force=force, on_unstable="flag")
        self._spare = of_pads(self.hand, lin.contacts.finger, lin.forces.margin).to(self.a)
        self._is_stale = False
        return lin

    def _move(self, w: Tensor, motion: ContactMotion) -> None:
        correction = None
        if self._enhanced is not None:
            correction, _ = self._enhanced.correction(self.state, w, self.state.n_s)
        try:
            motion, step = self._moved(w, motion)
            if correction is not None:
                motion.shift(correction)
        except GraspError as error:
            self.failure = error
            return
        self._motion, self._linearization, self._way = motion, None, w
        self.increment = motion.state.minus(self.state)
        self.correction = torch.zeros_like(self.increment) if correction is None else correction
        self.state, self.a = motion.state, self.a + w
        bears = of_pads(self.hand, tuple(step.normal), self.a.new_tensor(list(step.normal.values())))
        before, self.said, self._bears = self.force, bears - self._bears, bears
        self._is_stale = True
        self.force = bears
        if self._measured:
            least = self.kinematic.options.forces.normal_std
            change = self.said
            if self._forces is not None:
                turn = self.increment[-3:].norm()
                change = (
                    self._forces.scale * change + self._forces.correction @ w + self._forces.by_way * turn
                )
                self._stands = False
            bear = (before > least) & (bears > least)
            self.force = bears.where(~bear, (before + change).clamp(min=least))

    def _within(self, w: Tensor) -> Tensor:
        """As far as the ranges of the actuators allow."""
        return (self.a + w).clamp(self._a_min, self._a_max) - self.a

    def _moved(self, w: Tensor, motion: ContactMotion) -> tuple[ContactMotion, ContactStep]:
        """A copy of the motion after w, for a copy of this hand stays where it is, and what it did."""
        if self._tried is None or self._tried[0] is not motion or not torch.equal(self._tried[1], w):
            after = copy.copy(motion)
            self._tried = motion, w, after, after.move(w)
        _, _, after, step = self._tried
        return copy.copy(after), step
