"""The motions of a controller on the model of its hand, piece by piece, and what ends them."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from enum import Enum
from typing import TYPE_CHECKING, NamedTuple

import torch

from .._noise import DEGREE
from ..exceptions import NoContactError, UnstableGraspError
from ..kinematics import GraspState
from ..model.softening import softened
from ..plant import Observation
from ..typing import Tensor
from .bands import lets_go
from .decision import Decision, Piece, StopReason
from .focus import PoseTarget
from .limits import LimitingFunction
from .model_hand import ModelHand

if TYPE_CHECKING:
    from ..model import Linearization
    from .controller import LookAndMoveController

_THERE = 0.1 * DEGREE  # [rad] of the error, as a turn: the path ends
_MOST = 60  # pieces
LONGEST = 60 * DEGREE  # [rad] of an actuator in one movement: what follows is planned when it is there
_BENDS = 0.25 * DEGREE  # of a piece beyond its linearization: it is chosen once more, about where it leads
_HALVES = 3  # times that a piece is tried
_GRIPPED = 0.95  # of the wanted grip
_STOP_BEARS = 0.01  # [N m] of a joint's stop that ends a turn
_SLIDES = 0.05  # of its friction, that a pad at its limit has to spare


class PathEnd(Enum):
    """What ends a turn of the object, as the model predicts it."""

    NOTHING = "nothing"
    """The target is reached."""
    LINK = "link"
    """A link without a pad bears on the object."""
    FRICTION = "friction"
    """A finger's friction margin is used up: it slides, or no forces balance the object any more."""
    JOINT_STOP = "joint stop"
    ACTUATOR = "actuator"
    STABILITY = "stability"
    """The grasp buckles."""
    CONTACT = "contact lost"
    WAY = "way"
    """Nothing: it goes on after the longest movement that is made at once."""


class End(NamedTuple):
    """Of a path."""

    kind: PathEnd = PathEnd.NOTHING
    what: tuple[str, ...] = ()
    """Names of the links, pads, joints or actuators that end it; the likeliest first."""
    message: str = ""
    """The same in a sentence."""

    def __str__(self) -> str:
        return f"{self.kind.value}: {', '.join(self.what)}" if self.what else self.kind.value


class Rehearsal:
    """Motions of a controller on a :class:`ModelHand`; nothing that they do changes the controller.

    Args:
        seen: where they begin, as measured.
        target: where the object shall be; None: it stays where it is, and is gripped as it should be.
        piece: largest step [rad].
        longest: way of an actuator [rad].
        firm: share of the wanted grip with which nothing is gripped.
        hand: which stands there already.
    """

    def __init__(
        self,
        controller: LookAndMoveController,
        seen: Observation,
        target: PoseTarget | None,
        piece: float,
        longest: float = LONGEST,
        *,
        firm: float = math.inf,
        hand: ModelHand | None = None,
    ) -> None:
        self._controller, self._target, self._longest, self._firm = controller, target, longest, firm
        self._limiting = LimitingFunction(gain=1.0, step=piece, contact_travel=None)
        model = controller.kinematic if controller.enhanced is None else controller.enhanced
        if hand is None:
            hand = ModelHand(model, seen.state, seen.a, seen.fingertip_force, controller.forces)
        self.hand = hand
        self._measures, self._idle = seen.fingertip_force is not None, set(self.hand.at_limits())
        self.first: Decision | None = None
        """The first one, with the grip before anything moves."""
        self.last: Decision | None = None
        self._too_long, self._most = False, math.inf

    @torch.no_grad()
    def pieces(self) -> Iterator[tuple[Piece, GraspState]]:
        """Each piece, and where it leads."""
        controller, hand, way = self._controller, self.hand, torch.zeros_like(self.hand.a)
        for _ in range(_MOST):
            here = hand.observe()
            if hand.failure is not None or self._there(here.state):
                return
            lin = hand.linearization
            if lin is None:
                return
            force = controller.believed(here.a, here.fingertip_force if self._measures else None)
            if self.first is None:
                self._most = self._bears(lin)
            lin = controller.corrected(lin)
            self.last = decision = self._decide(here, force, lin)
            begins, self.first = self.first is None, self.first or decision
            firm = _gripped(decision) or (begins and not is_loose(decision, self._firm))
            if decision.status is not StopReason.RUNNING or (self._target is None and firm):
                return
            way = way + decision.delta_a
            self._too_long = float(way.abs().max()) > self._longest
            if self._too_long:
                return
            hand.command(decision.delta_a)
            if hand.failure is None:
                f, after = hand.increment - hand.correction, hand.force if self._measures else None
                made = Piece(lin, decision.delta_a, f, hand.increment, after, hand.said, hand.margin)
                yield made, hand.state

    def _decide(self, here: Observation, force: Tensor | None, lin: Linearization) -> Decision:
        controller, focus = self._controller, self._controller.focus
        target = PoseTarget(here.position, here.rotation) if self._target is None else self._target
        error = target.error(here.state)
        desired = self._limiting(focus.step_scale * (focus.matrix @ error)) / focus.step_scale
        for _ in range(_HALVES):
            seen = controller.situation(lin, here.a, force, error, desired)
            if seen.grip is not None:
                seen = dataclasses.replace(seen, grip=min(seen.grip, self._most))
            decision = controller.choose(lin, seen)
            if not any(lets_go(self.hand.hand, piece) for piece in decision.pieces):
                break
            desired = desired / 2
        found = self.hand.tangent(decision.delta_a) if decision.status is StopReason.RUNNING else None
        if found is None:
            return decision
        J, rest = found
        bends = (J - lin.manipulation_jacobian) @ decision.delta_a + rest
        if float(bends[-3:].norm()) < _BENDS:
            return decision
        again = dataclasses.replace(lin, manipulation_jacobian=J)
        return controller.choose(again, dataclasses.replace(seen, bend=rest))

    def _bears(self, lin: Linearization) -> float:
        """The hardest grip [N]: the present one where its forces have made the grasp soft; with more it would
        buckle."""
        return float(lin.forces.normal.max()) if softened(self.hand.kinematic, lin) else math.inf

    def _there(self, state: GraspState) -> bool:
        return self._target is not None and self._controller.focus.error(self._target, state) <= _THERE

    @property
    def end(self) -> End:
        """What ended the path, or keeps it from coming nearer."""
        hand, failure = self.hand, self.hand.failure
        if self._target is None or self._there(hand.state):
            return End()
        if isinstance(failure, NoContactError):
            return End(PathEnd.CONTACT, (), str(failure))
        if isinstance(failure, UnstableGraspError):
            return End(PathEnd.STABILITY, (), str(failure))
        sliding = _sliding(hand)
        limits = [name for name in hand.at_limits() if name not in self._idle]
        said = str(failure or "") or (self.last.message if self.last else "")
        if failure is None and self._too_long:
            return End(PathEnd.WAY, (), "an actuator goes as far as one movement goes")
        for kind, found, verb in (
            (PathEnd.FRICTION, sliding if failure is not None else [], "is at its friction limit"),
            (PathEnd.LINK, _bearing(hand), "has no pad, and bears on the object"),
            (PathEnd.ACTUATOR, limits, "stands at the end of its range"),
            (PathEnd.JOINT_STOP, hand.at_stops(_STOP_BEARS), "stands at its stop"),
            (PathEnd.FRICTION, sliding, "slides"),
        ):
            if found:
                return End(kind, tuple(found), "; ".join(filter(None, (f"{found[0]} {verb}", said))))
        return End(PathEnd.FRICTION, (), said or "the object comes no nearer")


def _gripped(decision: Decision) -> bool:
    grip = decision.grip
    return grip is None or (float(grip.force.max()) >= _GRIPPED * grip.wanted and not grip.weak)


def is_loose(decision: Decision, firm: float) -> bool:
    """The grip before anything moves is less than that share of what is wanted, or a finger's is weak."""
    grip = decision.grip
    return grip is not None and (grip.weak or float(grip.force.max()) < firm * grip.wanted)


def _bearing(hand: ModelHand) -> list[str]:
    """Links without a pad that bear."""
    lin, pads = hand.linearization, {pad.name for pad in hand.hand.pads}
    if lin is None:
        return []
    pairs = zip(lin.contacts.finger, lin.forces.normal.tolist(), strict=True)
    return [name for name, force in pairs if name not in pads and force > 0.1]


def _sliding(hand: ModelHand) -> list[str]:
    """Contacts in the order of their margins, those that have none to spare."""
    lin = hand.linearization
    if lin is None or not lin.forces.solved:
        return []
    left = sorted(zip(lin.forces.relative_margin.tolist(), lin.contacts.finger, strict=True))
    return [name for share, name in left if share < _SLIDES]
