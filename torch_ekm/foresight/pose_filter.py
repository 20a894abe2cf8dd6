"""Where the object is while nobody looks: predicted by the model, corrected by joints and touch."""

from __future__ import annotations

import contextlib
import copy
import math
from collections.abc import Callable
from typing import Any

import torch

from .._noise import NOISE
from ..contact import ContactSet, constraint_matrix
from ..contact.contact_set import CHARACTERISTIC_LENGTH
from ..contact.detector import ContactDetector
from ..enhanced import EnhancedModel
from ..enhanced.enhanced_model import kinematic_and_enhanced
from ..estimation.parameter_filter import update
from ..exceptions import GraspError, NoContactError
from ..kinematics import GraspState
from ..model import KinematicModel, Linearization
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
        """Begin with what camera, joints and fingertips say.

        Args:
            seen: joints and pose as measured.
            force: normal force of each pad ``(n_pads,)`` [N]; None: the pads near the object touch it.
            pose_covariance: of the pose's error twist [m, rad]; None or NaN: 0.3 mm and 0.3 deg.
        """
        joints = NOISE.joint**2 * torch.eye(seen.q.shape[-1], dtype=seen.q.dtype)
        P = torch.block_diag(joints, _seen_covariance(pose_covariance, seen.q))
        self.state, self.covariance, self._last = seen, self._permitted(P), None
        self._update(None, force)

    def move(self, moved: Float[Tensor, " n_a"], force: Tensor | None) -> None:
        """Carry the state along with a motion.

        Args:
            moved: w, of the encoders [rad].
            force: normal force of each pad before it ``(n_pads,)`` [N].
        """
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
