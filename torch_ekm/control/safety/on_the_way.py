"""Readings during a movement, held against what was planned."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch

from ..._noise import NOISE
from ...plant import Observation, PlantStatus
from ...typing import Tensor
from .safety import Guards

if TYPE_CHECKING:
    from ..decision import Decision

_DEVIATIONS = 2.0  # as far as the plan calls safe
_RUNNING = 2  # frames that leave the band: one may be a wrong picture
_SWINGS = math.radians(1.0)  # [rad] by which a moving object lags behind its equilibrium
_FADES = 0.5  # of the force that was planned, below which a finger is about to let go


class OnTheWay:
    """Whether a movement goes on: no finger presses too hard or fades, the object is held, and near its path.

    The object's rotation in a picture is held against that of the path where the encoders were when it was
    taken, and against the band there, which grows with the way; forces against those of the path, of which a
    finger keeps half and more.

    Args:
        guards: limits.
        seen: where the movement begins.
        decision: the movement.
    """

    def __init__(self, guards: Guards, seen: Observation, decision: Decision) -> None:
        self._guards, self._seen, self._band = guards, seen, decision.band
        self._ends = torch.stack([one.action for one in decision.pieces]).cumsum(0)
        end = self._ends[-1]
        self._whole = end / (end @ end).clamp(min=1e-12)
        self._way = self._ends @ self._whole  # of each waypoint along the whole
        self._twists = torch.stack([one.increment[-6:] for one in decision.pieces]).cumsum(0)
        self._forces = [one.force for one in decision.pieces]
        self._frames = [(seen.taken.encoders, seen.a)]
        self._off = 0
        self.why = ""
        """What stopped the movement; empty: nothing."""

    def __call__(self, seen: Observation) -> bool:
        """A reading on the way; True: the movement goes on."""
        self._frames.append((seen.taken.encoders, seen.a))
        force = seen.fingertip_force
        if seen.status is PlantStatus.LOST:
            self.why = "the object is lost"
        elif force is not None and bool((force > self._guards.force_ceiling).any()):
            self.why = f"a finger presses with {float(force.max()):.1f} N"
        elif force is not None and (fades := self._fades(seen, force)):
            self.why = fades
        elif self._band is not None and seen.status is PlantStatus.HELD:
            done, twist = self._off_path(seen)
            off, std = (
                float(twist[-3:].norm()),
                max(self._band.off_std, float(self._band.twist_std[-3:].max())),
            )
            most = _DEVIATIONS * done * std + _SWINGS
            self._off = self._off + 1 if off > most else 0
            if self._off >= _RUNNING:
                self.why = f"the object is {math.degrees(off):.1f} deg off its path"
        return not self.why

    def _fades(self, seen: Observation, force: Tensor) -> str:
        """Which finger keeps less than half of what was planned; empty: none."""
        start = self._seen.fingertip_force
        k, share = self._place(seen.a)
        before, after = self._forces[k - 1] if k else start, self._forces[k]
        if start is None or before is None or after is None:
            return ""
        planned = before + share * (after - before)
        fades = (start > NOISE.pressing) & (force < _FADES * planned) & (planned - force > 3 * NOISE.force)
        if not bool(fades.any()):
            return ""
        i = int((planned - force).where(fades, -math.inf).argmax())
        return f"a finger keeps {float(force[i]):.1f} N of {float(planned[i]):.1f} N"

    def _place(self, a: Tensor) -> tuple[int, float]:
        """The piece in which the encoders are, and how much of it is done."""
        way, done = self._way, self._done(a)
        k = min(int((way < done).sum()), len(way) - 1)
        start = float(way[k - 1]) if k else 0.0
        return k, min(max((done - start) / max(float(way[k]) - start, 1e-9), 0.0), 1.0)

    def _done(self, a: Tensor) -> float:
        """Share of the whole way, at encoders a [rad]."""
        return min(max(float((a - self._seen.a) @ self._whole), 0.0), 1.0)

    def _off_path(self, seen: Observation) -> tuple[float, Tensor]:
        """Share of the way where the picture was taken, and the twist of the object there that the path does
        not have [m, rad]."""
        a = self._encoders(seen.taken.pose)
        k, share = self._place(a)
        before = self._twists[k - 1] if k else torch.zeros_like(self._twists[0])
        planned = before + share * (self._twists[k] - before)
        return self._done(a), seen.state.minus(self._seen.state)[-6:] - planned

    def _encoders(self, time: float) -> Tensor:
        """Where they were, between two readings."""
        later = next((i for i, (at, _) in enumerate(self._frames) if at >= time), len(self._frames) - 1)
        if later == 0:
            return self._frames[0][1]
        (t0, a0), (t1, a1) = self._frames[later - 1], self._frames[later]
        return a0 + min(max((time - t0) / max(t1 - t0, 1e-9), 0.0), 1.0) * (a1 - a0)
