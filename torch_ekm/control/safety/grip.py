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
        # a pad that reads so little may be dead, or has let go
        measured = torch.minimum(before, now) >= self._least
        surprise = now - before - lin.normal_force_sensitivity @ moved
        return ForceSurprise(tuple(pads), before, now, surprise.where(measured, torch.nan))

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

    def follow(self, decision: Decision, forces: ForceSurprise | None) -> None:
        """Remember a motion."""
        if forces is None or decision.grip is None:
            return
        pads = list(forces.pads)
        gone = (forces.before >= self._least) & (forces.after < self._least)
        least, std = decision.grip.least, decision.grip.std
        fades = gone | ((forces.surprise < -torch.clamp(_DOUBT * std, min=_FADES)) & (forces.after < least))
        self._faded[pads] = torch.where(fades, self._faded[pads] + 1, 0)

    def forget(self) -> None:
        """The hand has gone back."""
        self._faded.zero_()

    @property
    def slows(self) -> bool:
        """A finger has faded for two motions."""
        return bool((self._faded >= _SLOWS).any())

    @property
    def sign(self) -> str:
        """A finger has faded for three motions; empty: none."""
        i = int(self._faded.argmax())
        if int(self._faded[i]) < _ALARMS:
            return ""
        return f"finger '{self.model.hand.pads[i].name}' loses its force"
