"""What a controller decides and expects, what a loop made of it, and why it ended."""

from __future__ import annotations

import math
from collections.abc import Generator, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple

import torch

from .._noise import DEGREE
from ..kinematics import GraspState
from ..model import Linearization
from ..plant import Observation
from ..residual import UpdateReport
from ..typing import Float, Tensor
from .focus import FocusedPose, PoseTarget

_STOPPED = 0.9  # of a movement: what falls shorter was stopped, and servos do not explain it
_WEAK, _FIRM = 0.55, 0.75  # of the wanted grip: with which nothing is turned, and with which steps are whole


class StopReason(Enum):
    """Why a manipulation ended; ``RUNNING`` while it has not."""

    RUNNING = "running"
    REACHED = "reached"
    STALLED = "stalled"
    STEP_LIMIT = "step limit"
    ACTUATOR_LIMITS = "actuator limits"
    UNSTABLE_GRASP = "unstable grasp"
    GIVEN_UP = "given up"
    """With the object in the hand: no way on is safe, see :class:`~torch_ekm.control.Plan`."""
    WEAK_GRASP = "weak grasp"
    """A finger bears less than the object needs, and grips no better."""
    OUT_OF_REACH = "out of reach"
    """Declined before anything moved, see ``decline`` of :class:`~torch_ekm.control.ClosedLoop`."""
    OBJECT_LOST = "object lost"
    STOPPED = "stopped"
    """By :meth:`ClosedLoop.stop`, or by Ctrl-C."""
    PLANT_FAILED = "plant failed"
    """It raised ``Stop.cause``: its bus, a sensor, a reading of the wrong length."""
    COMMAND_REFUSED = "command refused"
    """By the :class:`~torch_ekm.plant.Gate` or the driver, before anything moved: see ``Stop.cause``."""
    WRONG_WAY = "wrong way"
    """This, what follows, and a weak grasp come from :class:`~torch_ekm.control.Guards`."""
    STALE_SENSOR = "stale sensor"
    BLIND = "object not seen"
    ENCODER_JUMP = "encoder jump"
    ENCODER_DRIFT = "encoder drift"
    JOINT_JUMP = "joint jump"
    POSE_JUMP = "pose jump"
    OUT_OF_RANGE = "reading out of range"
    FINGERTIP_FAULT = "fingertip fault"
    ACTUATOR_STUCK = "actuator stuck"
    FORCE_CEILING = "force ceiling"


class Grip(NamedTuple):
    """What the fingers in contact bear before a motion."""

    force: Float[Tensor, " n_c"]
    """f_n, as measured, or as estimated where a pad does not measure [N]."""
    least: Float[Tensor, " n_c"]
    """What each should bear at least, see :class:`~torch_ekm.control.NormalForceLimit` [N]."""
    wanted: float
    """Of the finger that opposes the others, see :class:`~torch_ekm.control.GripForceTask` [N]; 0: none."""

    @property
    def weak(self) -> bool:
        """Some finger bears less than it should."""
        return bool((self.force < self.least).any())

    @property
    def bears(self) -> float:
        """``clip((f/f_wanted - 0.55) / 0.2, 0, 1)``: the share of a step that it bears."""
        held = float(self.force.max()) / self.wanted if self.wanted else math.inf
        return min(max((held - _WEAK) / (_FIRM - _WEAK), 0.0), 1.0)

    @property
    def waits(self) -> str:
        """Why it cuts steps; empty: it does not."""
        most = float(self.force.max())
        why = f"turning waits for a grip of {self.wanted:.1f} N, and no finger bears more than {most:.1f} N"
        return why if self.bears < 1 else ""


@dataclass(frozen=True)
class Piece:
    """A short part of a movement, for which one linearization holds."""

    linearization: Linearization
    """The kinematic model where it begins."""
    action: Float[Tensor, " n_a"]
    """w, of the tendons [rad]."""
    nominal: Float[Tensor, " n_s"]
    """f(s, w) [rad, m, rad]."""
    increment: Float[Tensor, " n_s"]
    """(f + g)(s, w) [rad, m, rad]."""
    force: Float[Tensor, " n_pads"] | None
    """Normal forces after it [N]; None: not predicted."""
    said: Float[Tensor, " n_pads"]
    """Their change by the model alone, without what was learned of it [N]."""

    @property
    def state(self) -> GraspState:
        """Where it begins."""
        return self.linearization.state


@dataclass(frozen=True)
class Band:
    """Predictions at a waypoint with their standard deviations."""

    off: float
    """Rotation off the focus [rad]."""
    off_std: float
    twist_std: Float[Tensor, " 6"]
    """Of the object's motion until then [m, rad], hand axes."""
    force: Float[Tensor, " n_pads"] | None
    """Normal forces of the pads that touched at the start [N], NaN of the others; None: not measured."""
    force_std: Float[Tensor, " n_pads"] | None

    def __str__(self) -> str:
        text = f"{self.off / DEGREE:.1f} +- {self.off_std / DEGREE:.1f} deg off the axis"
        if self.force is None or self.force_std is None:
            return text
        pairs = zip(self.force.tolist(), self.force_std.tolist(), strict=True)
        return f"{text}, {', '.join(f'{f:.1f} +- {s:.1f} N' for f, s in pairs if not math.isnan(f))}"


@dataclass(frozen=True)
class Waypoint:
    """A piece of the path, where it leads, and how sure the model is of that."""

    piece: Piece
    state: GraspState
    band: Band


@dataclass(frozen=True)
class Decision:
    """The movement that was chosen, what is predicted of it, and with which uncertainty."""

    delta_a: Float[Tensor, " n_a"]
    """What the tendons shall do, from the first piece to the last [rad]."""
    status: StopReason
    """RUNNING, or why no increment can be given."""
    desired: Float[Tensor, " n_x"]
    """dx_d, what it shall do to the focused pose [rad, m]."""
    predicted: Float[Tensor, " n_s"]
    """By f + g."""
    nominal: Float[Tensor, " n_s"]
    """By the hand as described: what the kinematic model alone predicts."""
    pieces: tuple[Piece, ...] = ()
    """In their order."""
    limited: bool = False
    """What was asked for could not be met in full because actuators stand at their limits."""
    slack: float = 0.0
    """Largest focused error that a step leaves unmet, as a turn [rad]."""
    message: str = ""
    """Why there is no increment."""
    grip: Grip | None = None
    """None: no forces are known, or no :class:`~torch_ekm.control.NormalForceLimit` asks for any."""
    turns: bool = True
    """Else it only grips."""
    band: Band | None = None
    """How sure the model is of the end; None: it is not known."""

    @property
    def linearization(self) -> Linearization | None:
        """The kinematic model where the movement begins; None where it has none."""
        return self.pieces[0].linearization if self.pieces else None


class Expectation(NamedTuple):
    """What f + g predict of a movement that the encoders made."""

    moved: Float[Tensor, " n_a"]
    """w, of the tendons [rad]."""
    nominal: Float[Tensor, " n_s"]
    """By f [rad, m, rad]."""
    increment: Float[Tensor, " n_s"]
    """By f + g [rad, m, rad]."""
    deviation: Float[Tensor, " n_s"]
    """Standard deviation of g [rad, m, rad]; 0 where nothing is learned."""
    pieces: tuple[Piece, ...]
    """As they were made."""
    normal: Float[Tensor, " n_pads"] | None
    """Force of each pad after it [N]; NaN of one that does not touch; None: unknown."""


def shares(pieces: Sequence[Piece]) -> list[float]:
    """Of the way of the tendons, that each piece is."""
    way = torch.stack([one.action.norm() for one in pieces])
    return (way / way.sum()).tolist() if bool(way.any()) else [1 / len(pieces)] * len(pieces)


def made_of(pieces: Sequence[Piece], moved: Tensor) -> Sequence[Piece]:
    """The pieces that a movement came to before it was stopped, the last one in part."""
    ends = torch.stack([one.action for one in pieces]).cumsum(0)
    size = (ends[-1] @ ends[-1]).clamp(min=1e-12)
    done, along = float(moved @ ends[-1] / size), (ends @ ends[-1] / size).tolist()
    if done > _STOPPED or len(pieces) == 1:
        return pieces
    k = next((i for i, end in enumerate(along) if end >= done), len(pieces) - 1)
    return pieces[: k + 1]


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
