"""Fingers that bear too little, and fingers that fade."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from ...plant import Observation
from ..decision import Decision
from ..pace import ForceSurprise

if TYPE_CHECKING:
    from ...model import KinematicModel, Linearization
    from ...typing import Tensor

_FADES = 0.3  # [N] below the prediction, in one motion, and
_DOUBT = 1.2  # standard deviations of such predictions
_SLOWS = 2  # such motions running, after which the pace shrinks
_ALARMS = 3  # and after which the hand goes back


class GripWatch:
    """Whether each finger bears what the object needs, and keeps it.

    A finger fades where it bears less than :class:`~torch_ekm.control.NormalForceLimit` asks for, and a
    motion leaves it with less than was predicted.
    """

    def __init__(self, model: KinematicModel) -> None:
        self.model, self._least = model, model.options.forces.normal_std
        self._faded = torch.zeros(len(model.hand.pads), dtype=torch.long)

    def surprise(
        self, lin: Linearization, seen: Observation, moved: Tensor, after: Observation
    ) -> ForceSurprise | None:
        """What the pads in contact measured of a motion; None: no pad measures."""
        if seen.fingertip_force is None or after.fingertip_force is None:
            return None
        pads = self.model.hand.pad_indices(lin.contacts.finger)
        before, now = seen.fingertip_force[pads], after.fingertip_force[pads]
        touched, touches = before >= self._least, now >= self._least  # one that reads less may be dead
        surprise = now - before - lin.normal_force_sensitivity @ moved
        surprise = surprise.where(touched & touches, torch.nan)
        return ForceSurprise(tuple(pads), before, now, surprise, touched & ~touches)

    def weak(self, decision: Decision) -> str:
        """Fingers that bear less than the object needs; empty: none."""
        grip, lin = decision.grip, decision.linearization
        if grip is None or lin is None:
            return ""
        weak = [
            f"finger '{self.model.hand.pads[pad].name}' bears {force:.1f} N of {least:.1f} N"
            for pad, force, least in zip(
                self.model.hand.pad_indices(lin.contacts.finger),
                grip.force.tolist(),
                grip.least.tolist(),
                strict=True,
            )
            if force < least
        ]
        return ", ".join(weak)

    def follow(self, decision: Decision, forces: ForceSurprise | None) -> bool:
        """Remember a motion; whether a finger has faded for two motions."""
        if forces is None or decision.grip is None:
            return False
        least, std = decision.grip.least, decision.grip.std
        fades = (forces.surprise < -torch.clamp(_DOUBT * std, min=_FADES)) & (forces.after < least)
        faded, pads = torch.zeros_like(self._faded), list(forces.pads)
        silent = forces.surprise.isnan() & ~forces.gone & (self._faded[pads] > 0)  # it has let go before
        faded[pads] = torch.where(fades | forces.gone | silent, self._faded[pads] + 1, 0)
        self._faded = faded
        return bool((faded >= _SLOWS).any())

    def forget(self) -> None:
        """The hand has gone back, or begins."""
        self._faded.zero_()

    @property
    def sign(self) -> str:
        """A finger has faded for three motions; empty: none."""
        i = int(self._faded.argmax())
        if int(self._faded[i]) < _ALARMS:
            return ""
        return f"finger '{self.model.hand.pads[i].name}' loses its force"
