from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import torch

from ..description import HandDescription
from ..exceptions import ObjectLostError
from ..plant import Observation, Plant, PlantStatus, PlantWrapper
from ..sensing.joint_estimator import CHORDS, COUPLING_STD, ENCODER_STD
from ..sensing.tracker import MarkerTracker
from ..typing import Float, Tensor

_SENSOR_STD = 0.005  # s_h [rad]
_SPRING_STD = 1.0  # s_0 [rad]: springs decide only what nothing measures
_POLL = 0.005  # [s]


class Posture:
    r"""``min_q |(S q - h) / s_h|^2 + |(J_a q + a_0 - a) / s_a|^2 + |C x / s_c|^2 + x^T K x / s_0^2``,
    ``x = q - q0``, K the springs over their mean.

    Sensors say what single joints do, encoders what sums of them do, couplings what differences do; where
    all is silent, springs decide as in a hand that touches nothing: **not** true of a finger that holds an
    object. With a sensor on every joint q is what they read.

    Args:
        hand: joints, actuators, couplings, springs.
        sensed: joints that have a sensor.
    """

    def __init__(self, hand: HandDescription, sensed: Sequence[str]) -> None:
        self._hand, self._all = hand, tuple(sensed) == hand.joint_names
        self._rest, K = torch.from_numpy(hand.spring_rest), torch.from_numpy(hand.spring_stiffness)
        n, n_s = hand.n_q, len(sensed)
        S = torch.eye(n, dtype=torch.float64)[[hand.joint_names.index(name) for name in sensed]]
        measured = torch.cat([S, torch.from_numpy(hand.actuation_jacobian)])
        std = torch.tensor([_SENSOR_STD] * n_s + [ENCODER_STD] * hand.n_a, dtype=torch.float64)
        ties = torch.from_numpy(hand.coupling.reshape(-1, n)) / COUPLING_STD
        springs = torch.diag((K / K.mean()).clamp(min=1e-3).sqrt()) / _SPRING_STD
        A = torch.cat([measured / std[:, None], ties, springs])
        self._gain = torch.linalg.pinv(A)[:, : len(measured)] * (1 / std)
        self._middle = measured @ self._rest
        self._middle[n_s:] += torch.from_numpy(hand.actuator_offset)

    def __call__(self, h: Float[Tensor, " n"], a: Float[Tensor, " n_a"]) -> Float[Tensor, " n_q"]:
        """q [rad] from the sensed joints' angles h and the encoders a [rad]."""
        if self._all:
            return h.clone()
        q = self._rest + self._gain @ (torch.cat([h, a]) - self._middle)
        for _ in range(0 if self._hand.lengths.constant else CHORDS):
            bent = torch.from_numpy(self._hand.bent(q.numpy()))
            q = self._rest + self._gain @ (torch.cat([h, a - bent]) - self._middle)
        return q


class Sighting(NamedTuple):
    """The object as something saw it."""

    position: Float[Tensor, " 3"]
    """Object point o in the frame of the source [m]."""
    rotation: Float[Tensor, "3 3"]
    """Object frame to the source's frame."""
    taken: float
    """When the picture was taken, of ``time.monotonic()`` [s]."""
    q: Float[Tensor, " n_q"] | None = None
    """Joint angles, where they are seen, too: markers on the links [rad]."""
    covariance: Float[Tensor, "6 6"] | None = None
    """Of the error twist (v; w), hand axes [m, rad]."""


class WithPose(PlantWrapper):
    """A hand, and a source of the object's pose: what a control loop needs.

    After each motion the source is asked until its sighting is newer than the encoders' reading. One that
    sees nothing in time gives the last pose again, with its old stamp and the status NOT_SEEN.

    Args:
        plant: a driver.
        source: gives the newest :class:`Sighting`, or None: not seen.
        frame: pose of the source's frame in the hand frame ``(4, 4)`` [m]; None: the source uses the hand
            frame.
        patience: how long a new sighting is waited for [s].
        lost: (sighting) -> True: the object is out of the hand. None: the source never says so.
    """

    def __init__(
        self,
        plant: Plant,
        source: Callable[[], Sighting | None],
        *,
        frame: Float[Tensor, "4 4"] | None = None,
        patience: float = 0.5,
        lost: Callable[[Sighting], bool] | None = None,
    ) -> None:
        super().__init__(plant)
        self.source, self.patience, self.lost = source, patience, lost
        self.frame = torch.eye(4, dtype=torch.float64) if frame is None else frame.double()
        self._last: Sighting | None = None

    def reset(self, seed: int) -> Observation:
        """Grasp, and see the object.

        Raises:
            ObjectLostError: the source does not see it.
        """
        self._last = None
        return super().reset(seed)

    def observation(self, seen: Observation) -> Observation:
        """``seen`` with the object's pose, and joint angles if the source has them.

        Raises:
            ObjectLostError: it was never seen.
        """
        return self._with(self._look(seen.taken.encoders), seen)

    def passing(self, seen: Observation) -> Observation:
        """``seen`` with the newest pose that there is: a hand that moves waits for none."""
        return self._with(self.source(), seen)

    def _with(self, sighting: Sighting | None, seen: Observation) -> Observation:
        status = PlantStatus.HELD
        if sighting is None:
            sighting, status = self._last, PlantStatus.NOT_SEEN
        if sighting is None:
            raise ObjectLostError(
                f"the object is not seen within {self.patience:g} s: check camera, light, markers"
            )
        self._last = sighting
        if self.lost is not None and self.lost(sighting):
            status = PlantStatus.LOST
        R, o = self.frame[:3, :3], self.frame[:3, 3]
        info, now = dict(seen.info), max(seen.time, time.monotonic())
        if sighting.covariance is not None:
            info["estimate"] = {"pose_covariance": sighting.covariance}
        q, stamps = seen.q, seen.taken._replace(pose=min(sighting.taken, now))
        if sighting.q is not None:
            q, stamps = sighting.q, stamps._replace(joints=stamps.pose)
            info.pop("sensed", None)
        return dataclasses.replace(
            seen,
            q=q,
            position=R @ sighting.position.double() + o,
            rotation=R @ sighting.rotation.double(),
            status=status,
            info=info,
            time=now,
            stamps=stamps,
        )

    def _look(self, after: float) -> Sighting | None:
        """One that is newer than ``after``; None: there was none in time."""
        end = time.monotonic() + self.patience
        while True:
            sighting = self.source()
            if sighting is not None and sighting.taken >= after:
                return sighting
            if time.monotonic() > end:
                return None
            time.sleep(_POLL)


class MarkerPose:
    """The object's pose by the marker boards on palm and object; a source for :class:`WithPose`.

    Args:
        grab: takes a picture ``(h, w)`` or ``(h, w, 3)``, uint8; None: the camera gave none.
        tracker: has lens and boards; its poses are in the hand frame.
    """

    def __init__(self, grab: Callable[[], np.ndarray | None], tracker: MarkerTracker) -> None:
        self.grab, self.tracker = grab, tracker

    def __call__(self) -> Sighting | None:
        """The pose in a new picture; None: it does not show both boards."""
        taken, image = time.monotonic(), self.grab()
        track = self.tracker.track(image)
        if not track.ok:
            return None
        return Sighting(*track.pose(), taken=taken, covariance=track.covariance)
