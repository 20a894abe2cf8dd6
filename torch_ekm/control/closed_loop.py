"""The closed loop of plant, model, learner and controller."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Generator
from dataclasses import dataclass
from typing import NamedTuple, Self

import torch

from ..model import Linearization
from ..plant import Observation, Plant, PlantStatus, ServoInverse
from ..residual import UpdateReport
from ..typing import Float, Tensor
from .caution import Caution
from .controller import Decision, LookAndMoveController
from .focus import FocusedPose, PoseTarget
from .guards import Guards, Halt, Watch
from .limiting import contact_lever
from .termination import StoppingRule, StopReason


@dataclass(frozen=True)
class Step:
    """One motion: what was seen, what was decided, what came of it, what was learned."""

    before: Observation
    decision: Decision
    after: Observation
    increment: Float[Tensor, " n_s"]
    """ds as measured, ``after.state.minus(before.state)``."""
    report: UpdateReport | None
    """Of the learner; None where nothing was learned."""
    seconds: float
    """Decision and training, without the plant [s]."""
    note: str = ""
    """What a guard objects to in this motion, see :class:`~torch_ekm.control.Guards`."""

    @property
    def retreat(self) -> bool:
        """The motion undid an earlier one."""
        return self.decision.share == 0.0


class Stop(NamedTuple):
    """Why a manipulation ended, and what was seen last."""

    reason: StopReason
    final: Observation
    message: str = ""


@dataclass(frozen=True)
class Manipulation:
    """A finished manipulation, whatever its end."""

    target: PoseTarget
    focus: FocusedPose
    steps: tuple[Step, ...]
    stop: Stop

    @property
    def errors(self) -> list[float]:
        """``|e|`` before each motion and at the end, as measured [unit of the focus]; the last is the
        steady-state error of a controller that came to rest."""
        seen = [*(step.before for step in self.steps), self.stop.final]
        return [self.focus.error(self.target, o.state) for o in seen]

    @property
    def reason(self) -> StopReason:
        return self.stop.reason

    @property
    def lost(self) -> bool:
        """The object was dropped, or turned off the focus beyond help."""
        return self.reason is StopReason.OBJECT_LOST


class ClosedLoop:
    """observe, decide, command, learn, until the stopping rule ends it.

    ``steps`` is a generator of motions; metrics and pictures are its consumers::

        with ClosedLoop(plant, controller) as loop:
            for step in loop.steps(target):
                print(step.increment)

    Whatever ends the manipulation early (an exception, Ctrl-C, a ``break``), the hand is told to hold its
    position, and what was raised goes on. In a ``with`` block that is so for errors of the block, too.

    Args:
        plant: with a grasped object (already reset).
        controller: its :class:`~torch_ekm.enhanced.EnhancedModel`, if it has one, learns after every motion.
        rule: when to stop.
        learn: False leaves the learner as it is.
        caution: when to look again, to go back and to give up.
        guards: which readings may move the hand and teach, and what the hand must never do.
        decline: is asked before anything moves; a text ends the manipulation as out of reach, with the object
            in the hand (:class:`~torch_ekm.foresight.BeyondReach`). None: nothing is declined.

    An enhanced model with a ``servo`` commands through a :class:`~torch_ekm.plant.ServoInverse`, and
    it learns from what the encoders did. One without learns from the commands.
    """

    def __init__(
        self,
        plant: Plant,
        controller: LookAndMoveController,
        rule: StoppingRule | None = None,
        *,
        learn: bool = True,
        caution: Caution | None = None,
        guards: Guards | None = None,
        decline: Callable[[Observation, PoseTarget], str] | None = None,
    ) -> None:
        self.plant, self.controller = plant, controller
        self.decline = decline
        self.rule = StoppingRule() if rule is None else rule
        self.learn = learn
        self.caution = Caution() if caution is None else caution
        self.guards = Guards() if guards is None else guards
        servo = None if controller.enhanced is None else controller.enhanced.servo
        if servo is not None and not isinstance(plant, ServoInverse):
            self.plant = ServoInverse(plant, controller.kinematic.hand, servo)
        self._stop = threading.Event()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *error: object) -> None:
        if kind is not None:
            self.hold()

    def stop(self) -> None:
        """End the manipulation after the motion under way; from any thread."""
        self._stop.set()

    def hold(self) -> None:
        """Tell the hand to stay where it is; what the plant raises here is ignored."""
        still = torch.zeros(self.controller.kinematic.hand.n_a, dtype=torch.float64)
        with contextlib.suppress(Exception):
            self.plant.command(still)

    def run(self, target: PoseTarget, on_step: Callable[[Step], object] | None = None) -> Manipulation:
        """Drive the object to ``target``.

        Args:
            on_step: called with each motion when it is over.

        Raises:
            EKMError: see :meth:`LookAndMoveController.decide`, and what the plant raises.
        """
        steps: list[Step] = []
        with contextlib.closing(self.steps(target)) as motions:
            while True:
                try:
                    steps.append(next(motions))
                except StopIteration as end:
                    return Manipulation(target, self.controller.focus, tuple(steps), end.value)
                if on_step is not None:
                    on_step(steps[-1])

    def steps(self, target: PoseTarget) -> Generator[Step, None, Stop]:
        """The motions one by one; the generator's return value is the :class:`Stop`."""
        self._stop.clear()
        try:
            return (yield from self._motions(target))
        except BaseException:  # Ctrl-C and a closed generator as well: the hand must not go on
            self.hold()
            raise

    def _motions(self, target: PoseTarget) -> Generator[Step, None, Stop]:
        started = time.monotonic()
        watch = Watch(self.guards, self.controller)
        seen, _, halt, _ = watch.first(self.plant.observe(), self.plant.observe)
        self.controller.reset()
        turn = _Turn(target, self.controller.focus, seen, self.caution.off_rotation, watch, halt)
        if self.decline is not None and halt is None and seen.status is not PlantStatus.LOST:
            against = self.decline(seen, target)
            if against:
                return Stop(StopReason.OUT_OF_REACH, seen, against)
        while True:
            if turn.halt is not None:
                self.hold()
                return Stop(turn.halt.reason, seen, turn.halt.message)
            if seen.status is PlantStatus.LOST:
                return Stop(StopReason.OBJECT_LOST, seen)
            if turn.off_rotation(seen) > self.rule.off_limit:
                return Stop(StopReason.OBJECT_LOST, seen, "dislocated off the focused axis")
            if self._stop.is_set():
                return Stop(StopReason.STOPPED, seen)
            if time.monotonic() - started > self.rule.max_seconds:
                return Stop(StopReason.TIME_OUT, seen)
            reason = self.rule.judge(turn.errors, turn.limited)
            if reason is not StopReason.RUNNING:
                return Stop(reason, seen)
            seen, decision, sign, seconds = self._decide(seen, turn)
            if sign and turn.way and decision.status is not StopReason.OBJECT_LOST:
                turn.alarms += 1
                turn.off_allowed = max(turn.off_allowed, turn.off_rotation(seen) + self.caution.off_further)
                seen, clear = yield from self._go_back(seen, decision, turn)
                if turn.halt is not None:
                    continue
                if seen.status is PlantStatus.LOST or turn.off_rotation(seen) > self.rule.off_limit:
                    return Stop(StopReason.OBJECT_LOST, seen, sign)
                if not clear or turn.alarms > self.caution.retreats:
                    return Stop(StopReason.GIVEN_UP, seen, sign)
                self._be_careful()
                continue
            if decision.status is not StopReason.RUNNING:
                return Stop(decision.status, seen, decision.message)
            turn.halt = watch.command(decision, seen)
            if turn.halt is not None:
                continue
            step = self._move(seen, decision, turn, seconds)
            turn.way.append(step.after.a - seen.a)
            yield step
            seen, turn.limited = step.after, decision.limited

    def _decide(self, seen: Observation, turn: _Turn) -> tuple[Observation, Decision, str, float]:
        """A decision, and what speaks for a loss to come in this reading and in all further looks."""
        looks = self.caution.looks
        while True:
            began = time.perf_counter()
            decision = self.controller.decide(seen.state, seen.a, turn.target, seen.fingertip_force)
            seconds = time.perf_counter() - began
            sign = self._sign(turn, seen, decision)
            if not sign or looks == 0 or seen.status is not PlantStatus.HELD:
                return seen, decision, sign, seconds
            seen, looks = turn.watch.rest(seen, self.plant.observe()), looks - 1

    def _sign(self, turn: _Turn, seen: Observation, decision: Decision) -> str:
        """What speaks for a loss to come; empty: nothing."""
        if decision.status is not StopReason.RUNNING:
            return decision.message
        links = self.caution.bearing_links(decision.linearization)
        turn.bearing = links if turn.bearing is None else turn.bearing
        return self.caution.sign(turn.off_rotation(seen), turn.off_allowed, links - turn.bearing)

    def _go_back(
        self, seen: Observation, decision: Decision, turn: _Turn
    ) -> Generator[Step, None, tuple[Observation, bool]]:
        """Undo the last motions until nothing speaks for a loss; False: it still does."""
        for _ in range(min(self.caution.way_back, len(turn.way))):
            back = -turn.way.pop()
            step = self._move(seen, self.controller.retreat(decision, back), turn)
            yield step
            seen = step.after
            if seen.status is PlantStatus.LOST or turn.halt is not None:
                break
            seen, decision, sign, _ = self._decide(seen, turn)
            if not sign:
                return seen, True
        return seen, False

    def _be_careful(self) -> None:
        """Grip harder and go slower."""
        self.controller.tighter += self.caution.tighten
        enhanced = self.controller.enhanced
        if enhanced is not None and enhanced.trust is not None:
            enhanced.trust.restart()

    def _move(self, seen: Observation, decision: Decision, turn: _Turn, seconds: float = 0.0) -> Step:
        """Command, observe, learn."""
        first = self.plant.command(decision.delta_a)
        began = time.perf_counter()
        servo = self.plant if isinstance(self.plant, ServoInverse) else None
        stuck = () if servo is None else servo.stuck
        after, teaches, turn.halt, note = turn.watch.motion(seen, decision, first, self.plant.observe, stuck)
        if servo is not None and turn.halt is not None:
            if turn.halt.reason is not StopReason.ACTUATOR_STUCK:  # this one the servo model itself says
                servo.correct(None)
        elif servo is not None and after is not first:
            servo.correct(after)
        increment = after.state.minus(seen.state)
        report = self._learn(seen, decision, after, increment) if teaches else None
        seconds += time.perf_counter() - began
        error = turn.focus.error(turn.target, after.state)
        # a goal that nobody saw is not reached
        turn.errors.append(max(error, 1.001 * self.rule.tolerance) if turn.watch.blind else error)
        return Step(seen, decision, after, increment, report, seconds, note)

    def _learn(
        self, seen: Observation, decision: Decision, after: Observation, increment: Tensor
    ) -> UpdateReport | None:
        enhanced, lin = self.controller.enhanced, decision.linearization
        if not self.learn or enhanced is None or after.status is not PlantStatus.HELD or lin is None:
            return None
        servo = isinstance(self.plant, ServoInverse)
        moved = after.a - seen.a if servo else decision.delta_a
        predicted, nominal = self.controller.predict(lin, moved)
        surprise = self._force_surprise(lin, seen, moved, after)
        if enhanced.trust is not None:
            lever = contact_lever(lin.contacts.point - seen.position)
            enhanced.trust.judge(predicted[-6:], increment[-6:], lever, decision.share, surprise)
        return enhanced.update(seen.state, moved, increment, nominal)

    def _force_surprise(
        self, lin: Linearization, seen: Observation, moved: Tensor, after: Observation
    ) -> Float[Tensor, " n_c"] | None:
        """How far each contact's normal force is from what was predicted [N]; None: not all pads measure."""
        if seen.fingertip_force is None or after.fingertip_force is None:
            return None
        pads = self.controller.kinematic.hand.pad_indices(lin.contacts.finger)
        before, now = seen.fingertip_force[pads], after.fingertip_force[pads]
        if bool((torch.minimum(before, now) < self.controller.kinematic.options.forces.normal_std).any()):
            return None  # a pad that reads so little may be dead, or has let go
        return now - before - lin.normal_force_sensitivity @ moved


class _Turn:
    """How far a manipulation has come."""

    def __init__(
        self,
        target: PoseTarget,
        focus: FocusedPose,
        seen: Observation,
        off: float,
        watch: Watch,
        halt: Halt | None,
    ) -> None:
        self.target, self.focus, self.start = target, focus, seen.state
        self.watch, self.halt = watch, halt
        self.off_allowed = off
        """[rad]"""
        self.errors = [focus.error(target, seen.state)]
        self.limited = False
        self.alarms = 0
        self.way: list[Tensor] = []
        """What the encoders did [rad], motion by motion, without what was undone."""
        self.bearing: frozenset[str] | None = None
        """Links without a pad that bore on the object at the start."""

    def off_rotation(self, seen: Observation) -> float:
        """Of the object off the focus since the start [rad]."""
        return self.focus.off_rotation(seen.state.minus(self.start))
