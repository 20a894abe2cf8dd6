"""A hand that does what the model predicts: the plant on which a turn is tried before anything moves."""

from __future__ import annotations

import math

import torch

from ..enhanced import EnhancedModel
from ..exceptions import GraspError
from ..kinematics import GraspState
from ..model import KinematicModel, Linearization
from ..model.force_balance import STOP_TOLERANCE
from ..plant import Observation, PlantStatus
from ..typing import Float, Tensor
from .pose_filter import PoseFilter

_STEP = 0.1  # [rad] largest motion of an actuator between two linearizations


class ModelHand:
    """``s <- s (+) (f + g)(s, w)`` with contacts that roll and stay closed and joints that keep their stops;
    implements :class:`~torch_ekm.plant.Plant`.

    The motion is that of a :class:`PoseFilter`. A joint that would pass its stop is brought to it, and is
    locked while it pushes against it. Forces change as the model says, and balance the object and the joints
    after each motion; fingertips report the normal ones. Encoders go where they are commanded to.

    Args:
        model: predicts the motions.
        state, a, fingertip_force: where it begins, as measured [rad, m, N].
    """

    failure: str
    """What the model says against going on, after which the object counts as lost; empty: nothing."""
    linearization: Linearization | None
    """At the present state; None where the model refused it."""

    def __init__(
        self,
        model: KinematicModel | EnhancedModel,
        state: GraspState,
        a: Float[Tensor, " n_a"],
        fingertip_force: Float[Tensor, " n_pads"] | None = None,
    ) -> None:
        self.filter = PoseFilter(model)
        self.hand = hand = self.filter.kinematic.hand
        self._start = state, a, fingertip_force
        limits = hand.joint_lower, hand.joint_upper, hand.actuator_lower, hand.actuator_upper
        self._q_min, self._q_max, self._a_min, self._a_max = (torch.from_numpy(x).to(a) for x in limits)
        self.reset(0)

    def reset(self, seed: int) -> Observation:
        """Back to where it began; there is no noise to be seeded."""
        state, self.a, force = self._start
        self.time, self.failure, self.linearization = 0.0, "", None
        self.force = self.a.new_zeros(len(self.hand.pads)) if force is None else force
        self.filter.start(state, force)
        self._balance({"fingertip_force": force})
        return self.observe()

    def observe(self) -> Observation:
        """The predicted state [rad, m], encoders [rad] and normal forces [N]; LOST after a failure."""
        s = self.filter.state
        status = PlantStatus.LOST if self.failure else PlantStatus.HELD
        return Observation(s.q, self.a, s.position, s.rotation, self.force, self.time, status)

    def command(self, delta_a: Float[Tensor, " n_a"]) -> Observation:
        """Move the encoders by ``delta_a`` [rad], as far as their ranges allow."""
        way = (self.a + delta_a).clamp(self._a_min, self._a_max) - self.a
        parts = math.ceil(float(way.abs().max()) / _STEP)
        for _ in range(parts):
            if self.linearization is not None and not self.failure:
                self._move(way / parts, self.linearization)
        self.time += 1.0
        return self.observe()

    def close(self) -> None:
        """Does nothing: the model holds no device."""

    def at_stops(self, push: float = 0.0) -> list[str]:
        """Joints of the fingers that touch, at a stop that bears more than ``push`` [N m]."""
        lin = self.linearization
        touching = (self._q_max > self._q_min) & ~self._inside(self.filter.state.q)
        if lin is not None:
            kinematics = self.filter.kinematic.kinematics
            links = [self.filter.kinematic.link_names.index(link) for link in lin.contacts.link]
            touching &= kinematics.upstream[links].any(0)  # type: ignore[index]
            touching &= lin.forces.stop_torque.abs() >= push
        return [self.hand.joint_names[j] for j in torch.nonzero(touching).flatten().tolist()]

    def at_limits(self) -> list[str]:
        """Actuators at an end of their range."""
        near = math.radians(0.1)
        ends = (self.a <= self._a_min + near) | (self.a >= self._a_max - near)
        return [self.hand.actuator_names[i] for i in torch.nonzero(ends).flatten().tolist()]

    def _move(self, w: Tensor, lin: Linearization) -> None:
        """One part of a motion, and the forces after it."""
        f, before = self.filter, (self.filter.state, self.filter.covariance)
        locked: set[int] = set(torch.nonzero(lin.held_joints).flatten().tolist())
        for _ in range(3):
            f.state, f.covariance = before
            f.move(w, lin=lin)
            f.close_gaps()
            beyond = self._beyond()
            inside = self._inside(before[0].q)
            again = {j for j in beyond if not inside[j]} - locked
            if not again:
                break
            locked |= again
            names = [self.hand.joint_names[j] for j in sorted(locked)]
            try:
                lin = f.kinematic.linearize(lin.state, lin.contacts, forces=lin.forces, locked=names)
            except GraspError as error:
                self.failure = str(error)
                return
        stopped: set[int] = set()
        while set(beyond) - stopped:  # one that is brought back may push another
            stopped |= set(beyond)
            joints = sorted(stopped)
            f.hold(joints, f.state.q.clamp(self._q_min, self._q_max)[joints])
            beyond = self._beyond()
        self.a = self.a + w
        self._balance({"expected": lin.forces_after(w), "previous": lin})

    def _beyond(self) -> list[int]:
        q = self.filter.state.q
        out = (self._q_max > self._q_min) & ((q < self._q_min) | (q > self._q_max))
        return torch.nonzero(out).flatten().tolist()

    def _inside(self, q: Tensor) -> Tensor:
        """Joints that stand at no stop."""
        return (self._q_min + STOP_TOLERANCE < q) & (q < self._q_max - STOP_TOLERANCE)

    def _balance(self, known: dict) -> None:
        """The model at the present state, with forces that balance it."""
        try:
            self.linearization = lin = self.filter.kinematic.linearize(self.filter.state, **known)
        except GraspError as error:
            self.linearization, self.failure = None, str(error)
            return
        if not lin.forces.solved:
            self.failure = str(lin.doubts[0])
            return
        self.force = self.force.new_zeros(len(self.hand.pads))
        self.force[self.hand.pad_indices(lin.contacts.finger)] = lin.forces.normal.to(self.force)
