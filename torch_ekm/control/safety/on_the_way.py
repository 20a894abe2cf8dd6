"""Readings during a movement, held against what was planned."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import torch

from ..._noise import NOISE
from ...plant import Observation, PlantStatus
from ...typing import Array, Tensor
from ..bands import DEVIATIONS
from .guards import Guards

if TYPE_CHECKING:
    from ..decision import Decision

_RUNNING = 2  # frames that leave the band: one may be a wrong picture
_SWINGS = math.radians(1.0)  # [rad] by which a moving object lags behind its equilibrium
_FADES = 0.5  # of the force that was planned, below which a finger is about to let go


class OnTheWay:
    """Whether a movement goes on: no finger presses too hard or fades, the object is held, and near its path.

    The object's rotation in a picture is held against that of the path where the encoders were when it was
    taken, and against the band there, which grows with the way; forces against those of the path, of which a
    finger keeps half and more.
    """

    why = ""
    """What stopped the movement; empty: nothing."""

    def __init__(self, guards: Guards, seen: Observation, decision: Decision) -> None:
        self._guards, self._seen, self._band, pieces = guards, seen, decision.band, decision.pieces
        ends = torch.stack([one.action for one in pieces]).cumsum(0)
        self._whole = ends[-1] / (ends[-1] @ ends[-1]).clamp(min=1e-12)
        self._way = np.maximum.accumulate([0.0, *(ends @ self._whole).tolist()])  # of each waypoint
        self._twists = np.cumsum([np.zeros(6), *(one.increment[-6:].numpy() for one in pieces)], axis=0)
        forces = seen.fingertip_force, *(one.force for one in pieces)
        known = [force.numpy() for force in forces if force is not None]
        self._forces = np.array(known) if len(known) == len(forces) else None
        self._times, self._encoders = [seen.taken.encoders], [seen.a.numpy()]
        self._off = 0

    def __call__(self, seen: Observation) -> bool:
        """A reading on the way; True: the movement goes on."""
        self._times.append(seen.taken.encoders)
        self._encoders.append(seen.a.numpy())
        force = None if seen.fingertip_force is None else seen.fingertip_force.numpy()
        if seen.status is PlantStatus.LOST:
            self.why = "the object is lost"
        elif force is not None and (force > self._guards.force_ceiling).any():
            self.why = f"a finger presses with {force.max():.1f} N"
        elif force is not None and self._forces is not None:
            planned = self._planned(self._forces, seen.a)
            fades = (self._forces[0] > NOISE.pressing) & (force < _FADES * planned)
            missing = np.where(fades, planned - force, 0.0)
            i = int(missing.argmax())
            if missing[i] > 3 * NOISE.force:
                self.why = f"a finger keeps {force[i]:.1f} N of {planned[i]:.1f} N"
        if not self.why and self._band is not None and seen.status is PlantStatus.HELD:
            done, twist = self._off_path(seen)
            off, band = float(twist[-3:].norm()), self._band
            std = max(band.off_std, float(band.twist_std[-3:].max()))
            self._off = self._off + 1 if off > DEVIATIONS * done * std + _SWINGS else 0
            if self._off >= _RUNNING:
                self.why = f"the object is {math.degrees(off):.1f} deg off its path"
        return not self.why

    def _off_path(self, seen: Observation) -> tuple[float, Tensor]:
        """Share of the way where the picture was taken, and the twist of the object there that the path does
        not have [m, rad]."""
        a = torch.from_numpy(_between(seen.taken.pose, self._times, np.array(self._encoders)))
        done = min(max(float((a - self._seen.a) @ self._whole), 0.0), 1.0)
        twist = seen.state.minus(self._seen.state)[-6:]
        return done, twist - torch.from_numpy(self._planned(self._twists, a))

    def _planned(self, values: Array, a: Tensor) -> Array:
        """Between those of the waypoints, where the encoders are [rad]."""
        return _between(float((a - self._seen.a) @ self._whole), self._way, values)


def _between(at: float, knots: list[float] | Array, values: Array) -> Array:
    """Linear from knot to knot, and the nearest value beyond them."""
    return np.array([np.interp(at, knots, column) for column in values.T])
