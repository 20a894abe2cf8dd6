"""The closed loop of plant, model, learner and controller."""

from __future__ import annotations

import contextlib
import copy
import dataclasses
import math
import threading
import time
from collections.abc import Generator

import torch

from .._checks import check_kind
from .._extras import require
from ..estimation.hand_figures import DescribedFigures, HandFigures
from ..model import Linearization
from ..plant import Gate, Observation, Plant, PlantStatus, ServoInverse
from ..residual import UpdateReport
from ..residual.sparse_gp.engine.loading import load_loops
from ..typing import Tensor
from .controller import LookAndMoveController
from .decision import Decision, Expectation, StopReason
from .focus import PoseTarget
from .knowledge import HandKnowledge
from .learned import Learned
from .manipulation import Manipulation, Step, Stop
from .pace import SLIDES, ForceSurprise
from .reach import Reach, Reachability, follow_to_the_end, out_of_reach, reachability
from .safety import Safety
from .safety.progress import Progress
from .safety.watch import Watch

_KNOWN = 15  # motions from which the figures of a hand are learned
_GRIP_SHARE = 0.5  # of a motion that only grips: too little for the pace to grow


class ClosedLoop:
    """observe, decide, command, learn, until :class:`Safety` ends it.

    ``steps`` is a generator of motions; metrics and pictures are its consumers::

        with ClosedLoop(plant, controller) as loop:
            for step in loop.steps(target):
                print(step.increment)

    What the plant raises, and Ctrl-C, end the manipulation with a :class:`Stop` that has it as its cause: no
    step is lost. Whatever ends it early, a ``break`` too, the hand is commanded to hold its position. At the
    end of a ``with`` block the plant is closed, after it holds if the block failed.

    Commands go through a :class:`~torch_ekm.plant.ServoInverse` and a :class:`~torch_ekm.plant.Gate`, which
    lets one loop at a time through; the model learns from what the encoders did.

    Args:
        plant: with a grasped object (already reset).
        controller: its :class:`~torch_ekm.enhanced.EnhancedModel`, if it has one, learns after every motion.
        knowledge: of the hand, on which the loop goes on learning; None: nothing is known yet, and nothing is
            learned of the servos if the controller's model is no enhanced one.
        safety: when it looks again, goes back, stops and gives up.
        learn: False leaves the learner as it is.
        decline: a target out of :meth:`reachability` ends as out of reach before anything moves. So does,
            once an enhanced model has found the hand's figures in 15 motions, a turn of 25 deg or more
            that is 5 deg beyond :meth:`reach`, or another target of 4 steps that the model misses.

    Raises:
        ParameterError: no controller.
        StateError: knowledge of another hand.
    """

    def __init__(
        self,
        plant: Plant,
        controller: LookAndMoveController,
        *,
        knowledge: HandKnowledge | None = None,
        safety: Safety | None = None,
        learn: bool = True,
        decline: bool = True,
    ) -> None:
        hand = check_kind("controller", controller, LookAndMoveController).kinematic.hand
        if knowledge is None:
            knowledge = HandKnowledge.of(hand, learns=controller.enhanced is not None)
            if isinstance(followed := controller.kinematic.figures, HandFigures | DescribedFigures):
                knowledge.figures = followed
        knowledge.check(hand)
        controller.follow(knowledge.figures)
        controller.forces = None if controller.enhanced is None else knowledge.forces
        self._figures = DescribedFigures() if controller.enhanced is None else knowledge.figures
        self.controller, self.learn, self.decline = controller, learn, decline
        self.safety = Safety() if safety is None else safety
        guards = self.safety.guards
        self._gate = Gate(plant, hand, increment=guards.increment, speed=guards.speed)
        self.plant, self.knowledge = ServoInverse(self._gate, hand, knowledge.servo), knowledge
        self.learned = Learned(knowledge, controller)
        self._stop, self._rehearses = threading.Event(), False
        require("qpsolvers")  # now, not within the first motion; so with the learner's loops
        if learn and controller.enhanced is not None:
            load_loops()

    def __enter__(self) -> ClosedLoop:
        return self

    def __exit__(self, kind: type[BaseException] | None, *error: object) -> None:
        try:
            if kind is not None:
                self.hold()
        finally:
            self.plant.close()

    def stop(self) -> None:
        """End the manipulation after the motion under way; from any thread."""
        self._stop.set()

    def hold(self) -> None:
        """Command the hand to stay where it is; what the plant raises here is ignored."""
        with contextlib.suppress(Exception):
            self._gate.command(torch.zeros(self.controller.kinematic.hand.n_a), by="hold")

    def reach(self, *, sign: int = 1, limit: float = math.radians(90)) -> Reach:
        """``max |angle|`` of this loop on a :class:`ModelHand`: its programs, limits, pace and signs of a
        loss, with f + g in place of the plant, without noise. Nothing moves, and nothing is learned. ::

            reach = loop.reach()
            loop.run(PoseTarget.turned(plant.observe().state, axis, reach.safe))

        Args:
            sign: 1 or -1, which way about the controller's focus.
            limit: farthest angle that is tried [rad].

        Raises:
            ParameterError: no single rotation in focus, a sign that is none, an angle outside 0 to 170 deg.
            GraspError: the model refuses the grasp as it is.
        """
        return follow_to_the_end(self._rehearsal, self.controller, self.plant.observe(), sign, limit)

    def reachability(self, target: PoseTarget) -> Reachability:
        """Whether the motors can bring the object to ``target``: rank and conditioning of the focused rows of
        J_m, ranges of the motors, rotation off the focus. To first order: without slip and links that touch.

        Raises:
            GraspError: the model refuses the grasp as it is.
        """
        return reachability(self.controller, self.safety.caution, self.plant.observe(), target)

    def _rehearsal(self, hand: Plant, target: PoseTarget) -> Generator[Step, None, Stop]:
        """On a hand that does what was learned and has no play; the pace alone adapts."""
        controller = copy.copy(self.controller)
        controller.pace = copy.deepcopy(controller.pace)
        known = HandKnowledge.of(controller.kinematic.hand, learns=False, adapts=False)
        known.figures, known.forces = self.knowledge.figures, copy.deepcopy(self.knowledge.forces)
        loop = ClosedLoop(hand, controller, knowledge=known, safety=self.safety, learn=False, decline=False)
        loop._figures, loop._rehearses = DescribedFigures(), True
        return loop.steps(target)

    def run(self, target: PoseTarget) -> Manipulation:
        """Drive the object to ``target``.

        Raises:
            PlantInUseError: another loop, or this one in another thread, commands the plant.
            EKMError: see :meth:`LookAndMoveController.decide`, and what the plant raises before there is a
                reading.
        """
        return Manipulation.of(target, self.controller.focus, self.steps(target))

    def steps(self, target: PoseTarget) -> Generator[Step, None, Stop]:
        """The motions one by one; the generator's return value is the :class:`Stop`."""
        with self._gate.owned():
            self._stop.clear()
            self._gate.last = self._gate.failure = None
            known, guards = {} if self._rehearses else self.learned.state(), self.safety.guards
            try:
                model, servo, rule = self.controller.kinematic, self.knowledge.servo, self.safety.rule
                watch = Watch(guards, model, self._expect, rule.tolerance, servo)
                stop = yield from self._motions(target, watch)
                if watch.lie:
                    self.learned.restore(known)
                    stop = stop.told(watch.lie)
                if self.learn and self.controller.pace.adapts:
                    reached = stop.reason is StopReason.REACHED
                    self.knowledge.pace.fill_(self.controller.pace.factor * reached)
                return stop
            except (Exception, KeyboardInterrupt) as error:
                last, failure = self._gate.last, self._gate.failure
                self.hold()
                if last is None or not (error is failure or isinstance(error, KeyboardInterrupt)):
                    raise
                return Stop.failed(error, last)
            except BaseException:  # a closed generator as well: the hand must not go on
                self.hold()
                raise

    def _motions(self, target: PoseTarget, watch: Watch) -> Generator[Step, None, Stop]:
        model = self.controller.kinematic
        first = watch.first(self.plant.observe(), self.plant.observe)
        seen = first.seen
        self.controller.reset()
        self.knowledge.forces.begin()
        self._figures.begin(seen.a)
        progress = Progress(self.safety, target, self.controller.focus, seen, self._rehearses)
        progress.halt = first.halt
        known = self.controller.enhanced is not None and int(self.knowledge.figures.count) >= _KNOWN
        if self.decline and progress.halt is None and seen.status is not PlantStatus.LOST:
            rehearsal = self._rehearsal if known else None
            against = out_of_reach(rehearsal, self.controller, self.safety.caution, seen, target)
            if against:
                return Stop(StopReason.OUT_OF_REACH, seen, against)
        self.controller.pace.begin(float(self.knowledge.pace) if known and self.learn else 0.0)
        if progress.halt is None and seen.status is PlantStatus.HELD:
            seen, weak = yield from self._grip_first(seen, progress, watch)
            watch.grip.forget()
            if weak and progress.halt is None and not progress.lost(seen):
                return Stop(StopReason.WEAK_GRASP, seen, weak)
        decision = None
        while True:
            over = progress.over(seen, self._stop.is_set())
            if over is not None:
                if progress.halt is not None:
                    self.hold()
                elif over.reason is StopReason.STALLED:
                    over = over._replace(message=progress.hindrances(seen, decision, model))
                    seen = yield from self._return_to_best(seen, decision, progress, watch)
                return Stop(over.reason, seen, over.message)
            seen, decision, sign, seconds = self._decide(seen, progress, watch)
            if sign and progress.way and decision.status is not StopReason.OBJECT_LOST:
                progress.alarms += 1
                watch.forget()
                seen, clear = yield from self._go_back(seen, decision, progress, watch)
                if progress.halt is not None:
                    continue
                if progress.lost(seen):
                    return Stop(StopReason.OBJECT_LOST, seen, sign)
                if not clear or progress.alarms > self.safety.caution.retreats:
                    return Stop(StopReason.GIVEN_UP, seen, sign + progress.surprise + watch.suspects(seen))
                self.controller.tighter += self.safety.caution.tighten
                self.controller.pace.restart()
                continue
            if decision.status is not StopReason.RUNNING:
                suspects = progress.surprise + watch.suspects(seen)
                return Stop(decision.status, seen, decision.message + suspects)
            progress.halt = watch.command(decision, seen)
            if progress.halt is not None:
                continue
            step = self._move(seen, decision, progress, watch, seconds)
            progress.come(step.after, step.pull)
            yield step
            seen, progress.limited = step.after, decision.limited

    def _grip_first(
        self, seen: Observation, progress: Progress, watch: Watch
    ) -> Generator[Step, None, tuple[Observation, str]]:
        """Tighten a grip in which a finger bears less than the object needs; what still does, in words."""
        left = self.safety.caution.grips
        while not self._stop.is_set():
            here = PoseTarget(seen.position, seen.rotation)
            decision = self.controller.decide(seen.state, seen.a, here, seen.fingertip_force)
            weak = watch.grip.weak(decision) if decision.status is StopReason.RUNNING else ""
            if not weak or left == 0:  # an estimate is no reason to decline
                return seen, weak if seen.fingertip_force is not None else ""
            decision = dataclasses.replace(decision, share=_GRIP_SHARE)
            progress.halt = watch.command(decision, seen)
            if progress.halt is not None:
                return seen, weak
            step = self._move(seen, decision, progress, watch, turns=False)
            yield step
            seen, left = step.after, left - 1
            if seen.status is PlantStatus.LOST or progress.halt is not None:
                return seen, weak
        return seen, ""

    def _decide(
        self, seen: Observation, progress: Progress, watch: Watch
    ) -> tuple[Observation, Decision, str, float]:
        """A decision, and what speaks for a loss to come in this reading and in all further looks."""
        looks = self.safety.caution.looks
        while True:
            began = time.perf_counter()
            target = progress.belief.target(seen)
            decision = self.controller.decide(seen.state, seen.a, target, seen.fingertip_force)
            seconds = time.perf_counter() - began
            sign = progress.sign(seen, decision)
            if not sign or looks == 0 or seen.status is not PlantStatus.HELD:
                return seen, decision, sign or watch.slid or watch.grip.sign, seconds
            seen, looks = watch.rest(seen, self.plant.observe()), looks - 1

    def _go_back(
        self, seen: Observation, decision: Decision, progress: Progress, watch: Watch
    ) -> Generator[Step, None, tuple[Observation, bool]]:
        """Undo the last motions until nothing speaks for a loss; False: it still does."""
        for _ in range(min(self.safety.caution.way_back, len(progress.way))):
            back = -progress.way.pop()
            step = self._move(seen, self.controller.retreat(decision, back), progress, watch)
            yield step
            before, seen = seen, step.after
            if seen.status is PlantStatus.LOST or progress.halt is not None:
                break
            seen, decision, sign, _ = self._decide(seen, progress, watch)
            if not sign or progress.stays_off(before, seen):
                return seen, not sign
        return seen, False

    def _return_to_best(
        self, seen: Observation, decision: Decision | None, progress: Progress, watch: Watch
    ) -> Generator[Step, None, Observation]:
        """Undo the motions that led away from where the object was nearest to its target, if that helps."""
        began = seen
        while decision is not None and progress.strayed(seen, began) and progress.halt is None:
            back = self.controller.retreat(decision, -progress.way.pop())
            step = self._move(seen, back, progress, watch)
            yield step
            seen = step.after
        return seen

    def _move(
        self,
        seen: Observation,
        decision: Decision,
        progress: Progress,
        watch: Watch,
        seconds: float = 0.0,
        turns: bool = True,
    ) -> Step:
        """Command, observe, learn."""
        by = "grip" if not turns else "turn" if decision.share > 0 else "retreat"
        most = decision.delta_a.abs().clamp(min=self.safety.guards.increment)  # play makes no command large
        motors = self._figures.motors(decision.delta_a).clamp(-most, most)
        first = self.plant.send(motors, seen, by)
        began = time.perf_counter()
        verdict = watch.motion(seen, decision, self.plant.sent, first, self.plant.observe)
        after, progress.halt = verdict.seen, verdict.halt
        increment, moved = after.state.minus(seen.state), after.a - seen.a
        if progress.halt is not None or after.status is PlantStatus.LOST:  # nobody learns from this reading
            seconds += time.perf_counter() - began
            return Step(seen, decision, after, increment, moved, None, seconds, verdict.note)
        if not self._rehearses:
            self.knowledge.checkpoint()
        if verdict.encoders:
            self.plant.learn(after)
        progress.halt = watch.stuck(seen, decision, after, self.knowledge.servo.stuck)
        report, lin, expected = None, decision.linearization, verdict.expected
        if lin is not None and expected is not None and after.status is PlantStatus.HELD:
            felt = watch.grip.surprise(lin, seen, expected.moved, after)
            # what a guard objects to may be a faulty pad
            fades = decision.share > 0 and not verdict.note and watch.grip.follow(decision, felt)
            if verdict.teaches and progress.halt is None and (self.learn or self._rehearses):
                report = self._learn(seen, decision, lin, moved, increment, expected, felt, fades)
            if turns and decision.share > 0 and self.controller.enhanced is not None:
                # moved otherwise than predicted, it slides, or turns out of the grip
                slides = self._disagreement(lin, increment, expected) > SLIDES
                self.controller.tighter += slides * self.safety.caution.slip
        pull = self._figures.commit(moved, after.a)
        progress.belief.see(after, None if self.controller.enhanced is None else expected)
        seconds += time.perf_counter() - began
        if turns:
            progress.add(after, blind=watch.blind > 0)
            if watch.gated and expected is not None and not (watch.blind or watch.slid):
                off = torch.linalg.vector_norm((increment - expected.increment)[-3:])
                progress.leapt(float(off), verdict.note)
            if progress.halt is None:
                progress.halt = watch.way(progress.errors, decision, moved)
        return Step(seen, decision, after, increment, pull, report, seconds, verdict.note)

    def _expect(self, lin: Linearization, moved: Tensor) -> Expectation:
        """Of what the motors did, less what the play took up."""
        return self.controller.expect(lin, self._figures.pulled(moved))

    def _learn(
        self,
        seen: Observation,
        decision: Decision,
        lin: Linearization,
        moved: Tensor,
        ds: Tensor,
        expected: Expectation,
        felt: ForceSurprise | None,
        fades: bool,
    ) -> UpdateReport | None:
        if (enhanced := self.controller.enhanced) is None:
            return None
        if not self.knowledge.servo.learns:  # then the dead zones are g's to learn
            moved = decision.delta_a
            expected = self._expect(lin, moved)
        rho = math.inf if fades else self._disagreement(lin, ds, expected, felt)
        self.controller.pace.judge(rho, decision.share)
        if not self.learn:
            return None
        if felt is not None:
            self.knowledge.forces.learn(lin, expected.moved, felt)
        self._figures.learn(lin, moved, ds)
        pull = self._figures.pulled(moved)
        nominal = self.controller.kinematic.followed(lin).step(pull)  # g learns what they leave
        return enhanced.update(seen.state, pull, ds, nominal)

    def _disagreement(
        self, lin: Linearization, ds: Tensor, expected: Expectation, felt: ForceSurprise | None = None
    ) -> float:
        """rho of a motion, see :class:`~torch_ekm.control.TrustRegion`."""
        trust = self.controller.pace.options.trust
        return trust.disagreement(expected.increment[-6:], ds[-6:], float(lin.lever), felt)
