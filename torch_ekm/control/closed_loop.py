"""The closed loop of plant, model, learner and controller."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Generator
from dataclasses import dataclass
from typing import NamedTuple, Self

import torch

from ..plant import Observation, Plant, PlantStatus, ServoInverse
from ..residual import UpdateReport
from ..typing import Float, Tensor
from .controller import Decision, LookAndMoveController
from .focus import FocusedPose, PoseTarget
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
    ) -> None:
        self.plant, self.controller = plant, controller
        self.rule = StoppingRule() if rule is None else rule
        self.learn = learn
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
        """Tell the hand to stay where it is; a plant that fails at this, too, is not heard."""
        still = torch.zeros(self.controller.kinematic.hand.n_a, dtype=torch.float64)
        with contextlib.suppress(Exception):
            self.plant.command(still)

    def run(self, target: PoseTarget, on_step: Callable[[Step], object] | None = None) -> Manipulation:
        """Drive the object to ``target``.

        Args:
            on_step: hears of each motion when it is over, for progress.

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
        seen = self.plant.observe()
        self.controller.reset()
        start, focus = seen.state, self.controller.focus
        errors, limited, off_rotation = [focus.error(target, start)], False, 0.0
        while True:
            if seen.status is PlantStatus.LOST:
                return Stop(StopReason.OBJECT_LOST, seen)
            if off_rotation > self.rule.off_limit:
                return Stop(StopReason.OBJECT_LOST, seen, "dislocated off the focused axis")
            if self._stop.is_set():
                return Stop(StopReason.STOPPED, seen)
            if time.monotonic() - started > self.rule.max_seconds:
                return Stop(StopReason.TIME_OUT, seen)
            reason = self.rule.judge(errors, limited)
            if reason is not StopReason.RUNNING:
                return Stop(reason, seen)
            began = time.perf_counter()
            decision = self.controller.decide(seen.state, seen.a, target, seen.fingertip_force)
            seconds = time.perf_counter() - began
            if decision.status is not StopReason.RUNNING:
                return Stop(decision.status, seen, decision.message)
            after = self.plant.command(decision.delta_a)
            increment = after.state.minus(seen.state)
            began = time.perf_counter()
            report = self._learn(seen, decision, after, increment)
            seconds += time.perf_counter() - began
            yield Step(seen, decision, after, increment, report, seconds)
            off_rotation = focus.off_rotation(after.state.minus(start))
            seen, limited = after, decision.limited
            errors.append(focus.error(target, seen.state))

    def _learn(
        self, seen: Observation, decision: Decision, after: Observation, increment: Tensor
    ) -> UpdateReport | None:
        enhanced = self.controller.enhanced
        if not self.learn or enhanced is None or after.status is not PlantStatus.HELD:
            return None
        if not isinstance(self.plant, ServoInverse):
            return enhanced.update(seen.state, decision.delta_a, increment, decision.nominal)
        moved = after.a - seen.a
        nominal = None if decision.linearization is None else decision.linearization.step(moved)
        return enhanced.update(seen.state, moved, increment, nominal)
