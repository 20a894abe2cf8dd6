"""What a closed loop did: its motions, one by one, and why it ended."""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass
from typing import NamedTuple

from ..plant import Observation
from ..residual import UpdateReport
from ..typing import Float, Tensor
from .decision import Decision, StopReason
from .focus import FocusedPose, PoseTarget


@dataclass(frozen=True)
class Step:
    """One motion: what was seen, what was decided, what came of it, what was learned."""

    before: Observation
    decision: Decision
    after: Observation
    increment: Float[Tensor, " n_s"]
    """ds as measured, ``after.state.minus(before.state)``."""
    pull: Float[Tensor, " n_a"]
    """What the tendons did, as far as the play of the drives is known [rad]."""
    report: UpdateReport | None
    """Of the learner; None where nothing was learned."""
    seconds: float
    """Decision and training, without the plant [s]."""
    note: str = ""
    """What a guard objects to in this motion, see :class:`~torch_ekm.control.Guards`."""


class Stop(NamedTuple):
    """Why a manipulation ended, and what was seen last."""

    reason: StopReason
    final: Observation
    message: str = ""
    cause: BaseException | None = None
    """What the plant raised, or Ctrl-C; ``raise result.stop.cause`` goes on with it."""

    def told(self, more: str) -> Stop:
        """With one more thing to say, unless it is said already."""
        if more in self.message:
            return self
        return self._replace(message="; ".join(filter(None, (self.message, more))))


@dataclass(frozen=True)
class Manipulation:
    """A finished manipulation, whatever its end."""

    target: PoseTarget
    focus: FocusedPose
    steps: tuple[Step, ...]
    stop: Stop

    def __repr__(self) -> str:
        message = f": {self.stop.message}" if self.stop.message else ""
        return f"<Manipulation: {self.reason.value} after {len(self.steps)} motions{message}>"

    @classmethod
    def of(cls, target: PoseTarget, focus: FocusedPose, motions: Generator[Step, None, Stop]) -> Manipulation:
        """All motions, one after the other, to their end."""
        steps = []
        while True:
            try:
                steps.append(next(motions))
            except StopIteration as end:
                return cls(target, focus, tuple(steps), end.value)

    @property
    def errors(self) -> list[float]:
        """``|e|`` before each motion and at the end, as measured and as a turn [rad]; the last is the
        steady-state error of a controller that came to rest."""
        seen = [*(step.before for step in self.steps), self.stop.final]
        return [self.focus.error(self.target, o.state) for o in seen]

    @property
    def reason(self) -> StopReason:
        """Why it ended."""
        return self.stop.reason

    @property
    def lost(self) -> bool:
        """The object was dropped, or turned off the focus beyond help."""
        return self.reason is StopReason.OBJECT_LOST
