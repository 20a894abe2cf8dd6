"""Turns with the camera off: the object's pose by the model, corrected by joints and touch."""

from __future__ import annotations

import contextlib
import copy
import dataclasses
import math
from collections.abc import Callable
from typing import Any

import torch

from .._noise import NOISE
from ..contact import ContactSet, constraint_matrix
from ..contact.contacts import CHARACTERISTIC_LENGTH
from ..contact.detector import ContactDetector
from ..control.guards import Guards, ReadingTests, stated
from ..enhanced import EnhancedModel
from ..enhanced.enhanced_model import kinematic_and_enhanced
from ..estimation.filters import update
from ..exceptions import GraspError, NoContactError, ParameterError
from ..kinematics import GraspState
from ..model import KinematicModel, Linearization
from ..plant import Observation, Plant, PlantStatus, PlantWrapper
from ..typing import Float, Tensor

_ITERATIONS = 3  # of an update: gaps are not linear in the state
Measured = tuple[Tensor, Tensor, Callable[[GraspState], Tensor]]  # H, covariance of the noise, miss


class PoseFilter:
    """Extended Kalman filter of ``s = (q, o, R)`` with the covariance P of its error ``[dq; do; dphi]``::

        motion    s <- s (+) ds,  P <- P + Q         ds = (f + g)(s, w),  w what the encoders did
        rolling   A ds = 0 +- 5 % of the way         at the middle of the motion; conditions ds and Q
        joints    q_measured = q +- 0.5 deg
        touch     gap_i(s) = 0 +- 0.1 mm             pads i that measure a force
        camera    (o, R) as seen                     when it is asked

    Q is diagonal: of joints 50 % of the largest motion of an actuator, of the pose 8 % of its motion (30 %
    where nothing is learned), and the variance that the learner states. Contacts that roll tie the object's
    motion to that of the fingers, so measured joints and closed gaps correct the pose, too. The update is
    iterated, since gaps are not linear (Bell and Cathey, IEEE TAC 38(2), 1993).

    Args:
        model: predicts the motions; of an enhanced model the learner states its variance.
        touch: False leaves the pose to the prediction alone, without rolling and gaps.
    """

    state: GraspState
    """The most likely one."""
    covariance: Float[Tensor, "n_s n_s"]
    """P [rad, m, rad], hand axes."""

    def __init__(self, model: KinematicModel | EnhancedModel, *, touch: bool = True) -> None:
        self.kinematic, self.enhanced = kinematic_and_enhanced(model)
        self.touch = touch
        self._detector = copy.copy(self.kinematic.detector)
        if isinstance(self._detector, ContactDetector):  # a pad that presses touches, however far off
            self._detector.margin = math.inf
        self._last: tuple[Linearization, Tensor] | None = None

    @property
    def pose_covariance(self) -> Float[Tensor, "6 6"]:
        """Of the object's error twist ``(v; w)``, hand axes [m, rad]."""
        return self.covariance[-6:, -6:]

    def start(self, seen: GraspState, force: Tensor | None, pose_covariance: Tensor | None) -> None:
        """Begin with what camera, joints and fingertips say: without forces ``(n_pads,)`` [N] the pads near
        the object touch it, without a covariance of the pose's error twist it is 0.3 mm and 0.3 deg."""
        joints = NOISE.joint**2 * torch.eye(seen.q.shape[-1], dtype=seen.q.dtype)
        P = torch.block_diag(joints, _seen_covariance(pose_covariance, seen.q))
        self.state, self.covariance, self._last = seen, self._permitted(P), None
        self._update(None, force)

    def move(self, moved: Float[Tensor, " n_a"], force: Tensor | None) -> None:
        """Carry the state along with a motion of the encoders [rad]; ``force`` of each pad before it [N]."""
        if self.kinematic.figures is not None:
            moved = self.kinematic.figures.pulled(moved)
        ds, Q = self._predicted(moved, force)
        middle = self.state.plus(0.5 * ds)
        with contextlib.suppress(NoContactError):
            kin = self.kinematic.contact_kinematics(middle, self._touching(middle, force))
            A, v, w = constraint_matrix(kin), *ds[-6:].split(3)
            way = torch.linalg.vector_norm(v + torch.linalg.cross(w.expand_as(kin.lever), kin.lever), dim=-1)
            slide = (NOISE.slip * way + 1e-5)[[row // 6 for row in kin.rows]]
            ds, Q = map(torch.from_numpy, update(ds, Q, -A @ ds, A, slide.square()))
        self.state = self.state.plus(ds)
        self.covariance = self.covariance + Q

    def measure(self, q: Float[Tensor, " n_q"], force: Tensor | None) -> None:
        """What measured joints [rad] and fingertips ``(n_pads,)`` [N] say at rest."""
        joints = torch.eye(len(q), len(self.covariance), dtype=q.dtype)
        noise = NOISE.joint**2 * torch.eye(len(q), dtype=q.dtype)
        self._update((joints, noise, lambda at: q - at.q), force)

    def look(self, seen: GraspState, pose_covariance: Tensor | None) -> None:
        """What the camera says; the joints of ``seen`` are not used. See :meth:`start`."""
        pose = torch.eye(len(self.covariance), dtype=self.covariance.dtype)[-6:]
        noise = _seen_covariance(pose_covariance, pose)
        self._update((pose, noise, lambda at: seen.minus(at)[-6:]), None, gaps=False)

    def _predicted(self, moved: Tensor, force: Tensor | None) -> tuple[Tensor, Tensor]:
        """ds and Q before the contacts have their say; forces are carried along from motion to motion.

        A state that the model refuses has no predicted motion, but one as large as the actuators' may be.
        """
        known: dict[str, Any] = {"fingertip_force": force}
        if self._last is not None:
            known |= {"previous": self._last[0], "expected": self._last[0].forces_after(self._last[1])}
        n_q, largest = self.state.q.shape[-1], moved.abs().max()
        unit = moved.new_tensor([CHARACTERISTIC_LENGTH] * 3 + [1.0] * 3)
        ds = unsure = torch.zeros_like(self.covariance[0])
        try:
            lin = self.kinematic.linearize(self.state, **known)
        except GraspError:
            pose = largest * unit
        else:
            self._last, share = (lin, moved) if lin.forces.solved else None, NOISE.described
            ds = lin.step(moved)
            if self.enhanced is not None:
                g, unsure = self.enhanced.correction(self.state, moved, len(ds))
                ds, share = ds + g, NOISE.share
            pose = share * torch.linalg.vector_norm(ds[n_q:] / unit) * unit
        std = torch.cat([NOISE.joint_motion * largest.expand(n_q), pose])
        return ds, self._permitted(torch.diag(std.square() + 1e-14 + unsure))

    def _permitted(self, covariance: Tensor) -> Tensor:
        """Conditioned on couplings, joints that do not move, and the plane of a planar hand:
        ``Z (Z^T P^-1 Z)^-1 Z^T``, increments ``Z dz``."""
        Z = self.kinematic.reduction.basis.to(covariance)
        return Z @ torch.linalg.inv(Z.mT @ torch.linalg.solve(covariance, Z)) @ Z.mT

    def _touching(self, state: GraspState, force: Tensor | None) -> ContactSet:
        """Contacts of the pads that press.

        Raises:
            NoContactError: none does, or touch does not count.
        """
        if not self.touch:
            raise NoContactError("touch does not count")
        contacts: ContactSet = self._detector(state.q, state.position, state.rotation)
        pressing = contacts.gap <= self.kinematic.options.contact_margin
        if force is not None:
            pressing = force[self.kinematic.hand.pad_indices(contacts.finger)] >= NOISE.pressing
        rows = torch.nonzero(pressing).flatten().tolist()
        if not rows:
            raise NoContactError("no pad measures a force")
        return contacts.select(rows)

    def _update(self, measured: Measured | None, force: Tensor | None, *, gaps: bool = True) -> None:
        """Condition on ``H ds = miss(s) +- noise``, and on the gaps of pads that press."""
        prior, P = self.state, self.covariance
        ds = torch.zeros_like(P[0])
        for _ in range(_ITERATIONS):
            at = prior.plus(ds)
            H, noise, miss = P[:0], P[:0, :0], P[0, :0]
            if measured is not None:
                H, noise, miss = *measured[:2], measured[2](at)
            if gaps:
                with contextlib.suppress(NoContactError):
                    contacts = self._touching(at, force)
                    kin = self.kinematic.contact_kinematics(at, contacts)
                    closing = constraint_matrix(kin)[kin.normal_rows]  # gap(s + ds) = gap - closing ds
                    H, miss = torch.cat([H, closing]), torch.cat([miss, contacts.gap])
                    gap = P.new_full((len(closing),), NOISE.gap).square()
                    noise = torch.block_diag(noise, torch.diag(gap))
            ds, self.covariance = map(torch.from_numpy, update(0 * ds, P, miss, H, noise, at=ds))
        self.state = prior.plus(ds)


def _seen_covariance(stated: Tensor | None, like: Tensor) -> Tensor:
    if stated is not None and bool(torch.isfinite(stated).all()):
        return stated.to(like)
    return torch.diag(like.new_tensor(NOISE.pose).square())


class BlindPose(PlantWrapper):
    """``(q, o, R)`` of a :class:`PoseFilter` in place of the camera's pose, after the first observation.

    Joint angles, encoders and fingertip forces go on being measured. The camera is asked again where the
    standard deviation of the rotation about the axis exceeds ``look_again``; what it then sees is one more
    measurement. ``info["estimate"]`` without a picture has ``pose_covariance`` of the error twist
    ``(v; w)`` [m, rad], ``axis_std`` [rad] and ``looked``. Train nothing meanwhile
    (``ClosedLoop(..., learn=False)``): increments are estimates, too. ::

        plant = BlindPose(plant, ekm, axis, look_again=math.radians(1))
        ClosedLoop(plant, controller, learn=False).run(target)

    Args:
        plant: sees until then.
        model: predicts the motions.
        axis: about which the object turns, hand frame.
        look_again: [rad]; infinite: never.
        touch: False leaves the pose to the prediction alone (the test that the paper leaves for the future,
            section VI).

    Raises:
        ParameterError: ``axis`` has no direction, or ``look_again`` is not positive.
    """

    def __init__(
        self,
        plant: Plant,
        model: KinematicModel | EnhancedModel,
        axis: Float[Tensor, " 3"],
        *,
        look_again: float = math.inf,
        touch: bool = True,
    ) -> None:
        if not float(torch.linalg.vector_norm(axis)) > 1e-9:
            raise ParameterError("axis", axis.tolist(), "a vector of non-zero length")
        if not look_again > 0:
            raise ParameterError("look_again", look_again, "greater than 0 [rad]; infinite: never")
        super().__init__(plant)
        self.filter = PoseFilter(model, touch=touch)
        self.axis = axis / torch.linalg.vector_norm(axis)
        self.look_again = look_again
        self.looks = 0
        """How often the camera was asked since it is off."""
        self._tests = ReadingTests(Guards(), self.filter.kinematic.hand)
        self._sent: Tensor | None = None  # waypoints of motions from which no reading was accepted yet
        self._before: Observation | None = None  # as measured, the last reading that was accepted

    @property
    def axis_std(self) -> float:
        """Standard deviation of the rotation about the axis [rad]."""
        return math.sqrt(max(float(self.axis @ self.filter.pose_covariance[3:, 3:] @ self.axis), 0.0))

    def reset(self, seed: int) -> Observation:
        """Grasp again with the camera on; the observation after it is that of the plant."""
        self.looks, self._before, self._sent = 0, None, None
        return super().reset(seed)

    def command(self, delta_a: Float[Tensor, " n_a"]) -> Observation:
        """Move the actuators by ``delta_a`` [rad], wait, read the sensors that are on."""
        after = self.plant.command(delta_a)
        last = self._sent if self._sent is not None else delta_a.new_zeros(1, len(delta_a))
        self._sent = torch.cat([last, last[-1:] + delta_a])
        return self.observation(after)

    def observation(self, seen: Observation) -> Observation:
        """``seen``, with the estimated state while the camera is off; a reading that :class:`Guards` refuse
        changes nothing of the estimate."""
        before, guards = self._before, self._tests.guards
        if before is None:
            self._before, self._sent = seen, None
            self.filter.start(seen.state, seen.fingertip_force, stated(seen))
            return seen
        accepted = not self._tests.motors(before, self._sent, seen)
        if accepted:
            if self._sent is not None:
                self.filter.move(seen.a - before.a, before.fingertip_force)
            self._before, self._sent = seen, None
            if float((seen.q - self.filter.state.q).abs().max()) <= guards.joint_jump:
                self.filter.measure(seen.q, seen.fingertip_force)
        looked = accepted and self.axis_std > self.look_again and seen.status is PlantStatus.HELD
        if looked:
            self.looks += 1
            self.filter.look(seen.state, stated(seen))
        at, P = self.filter.state, self.filter.pose_covariance
        estimate = {"pose_covariance": P, "axis_std": self.axis_std, "looked": looked}
        estimate = seen.info.get("estimate", {}) | estimate
        # a dark camera cannot say that it does not see the object
        status = PlantStatus.HELD if seen.status is PlantStatus.NOT_SEEN else seen.status
        # estimated for now: it is no stale picture
        stamps = None if seen.stamps is None else seen.stamps._replace(pose=seen.time, joints=seen.time)
        return dataclasses.replace(
            seen,
            q=at.q,
            position=at.position,
            rotation=at.rotation,
            status=status,
            stamps=stamps,
            info={**seen.info, "estimate": estimate},
        )
