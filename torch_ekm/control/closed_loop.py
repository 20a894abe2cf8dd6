"""The closed loop of plant, model, learner and controller."""

from __future__ import annotations

import contextlib
import copy
import math
import threading
import time
from collections.abc import Generator

import torch
from torch import nn

from .._checks import check_kind
from .._extras import require
from ..estimation.hand_figures import DescribedFigures, HandFigures
from ..estimation.knowledge import HandKnowledge
from ..exceptions import NoStateError, StateError
from ..plant import Gate, Observation, Path, Plant, PlantStatus, ServoInverse
from ..residual.sparse_gp.engine.loading import load_loops
from ..typing import Tensor
from .controller import LookAndMoveController
from .decision import Decision, Expectation, Manipulation, Step, Stop, StopReason
from .ends import Ends, Safety, failed
from .focus import PoseTarget
from .guards import Objection, gravest
from .lessons import Lessons
from .plan import OneStep, Plan, Planner, Reach, WholeTurn, reach
from .watch import OnTheWay, Watch

# of the wanted grip, with which is turned after so many movements that only grip; then no finger is weak
_FIRM = 0.75, 0.75, 1e-6, 1e-6


class ClosedLoop:
    """Look, plan, move, learn, until the target is seen to be reached, or no way on is safe.

    ``steps`` is a generator of movements; metrics and pictures are its consumers::

        with ClosedLoop(plant, controller) as loop:
            print(loop.reach(), loop.plan(target))
            for step in loop.steps(target):
                print(step.increment)

    What the plant raises, and Ctrl-C, end the manipulation with a :class:`Stop` that has it as its cause: no
    step is lost. Whatever ends it early, a ``break`` too, the hand is commanded to hold its position. At the
    end of a ``with`` block the plant is closed, after it holds if the block failed.

    Commands go through a :class:`~torch_ekm.plant.ServoInverse` and a :class:`~torch_ekm.plant.Gate`, which
    lets one loop at a time through; the model learns from what the encoders did.

    Args:
        plant: with a grasped object (already reset).
        controller: its :class:`~torch_ekm.enhanced.EnhancedModel`, if it has one, learns after each movement.
        knowledge: of the hand, on which the loop goes on learning; None: nothing is known yet, and nothing is
            learned of the servos if the controller's model is no enhanced one.
        safety: when it looks again and stops.
        planner: decides on movements; None: :class:`WholeTurn` of an enhanced model, else :class:`OneStep`.
        learn: False leaves learner, figures and forces as they are; servos are followed all the same.
        decline: a target that the motors do not reach, to first order, ends before anything moves.

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
        planner: Planner | None = None,
        learn: bool = True,
        decline: bool = True,
    ) -> None:
        hand = check_kind("controller", controller, LookAndMoveController).kinematic.hand
        if knowledge is None:
            knowledge = HandKnowledge.of(hand, learns=controller.enhanced is not None)
            if isinstance(followed := controller.kinematic.figures, HandFigures | DescribedFigures):
                knowledge.figures = followed
        knowledge.check(hand)
        controller.follow(knowledge.figures, knowledge.forces)
        self._figures = DescribedFigures() if controller.enhanced is None else knowledge.figures
        self.controller, self.learn, self.decline = controller, learn, decline
        self.planner = planner or (OneStep() if controller.enhanced is None else WholeTurn())
        self.safety = Safety() if safety is None else safety
        guards = self.safety.guards
        self._gate = Gate(plant, hand, increment=guards.increment, speed=guards.speed)
        self.plant, self.knowledge = ServoInverse(self._gate, hand, knowledge.servo), knowledge
        self.learned = nn.ModuleDict({"knowledge": knowledge})
        """All that it learns; a learner without a state is left out."""
        if controller.enhanced is not None:
            with contextlib.suppress(NoStateError):
                controller.enhanced.learner.state_dict()
                self.learned["learner"] = controller.enhanced.learner
        self._lessons = Lessons(controller, knowledge, self._figures)
        self._stop = threading.Event()
        require("qpsolvers")  # now, not within the first movement; so with the learner's loops
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

    def plan(self, target: PoseTarget) -> Plan:
        """The path to ``target`` from here, how sure the model is of it, and how far it is safe.

        Nothing moves, and nothing is learned.
        """
        check_kind("target", target, PoseTarget)
        planner = self.planner if isinstance(self.planner, WholeTurn) else WholeTurn()
        return planner.plan(self.controller, self.plant.observe(), target, self.knowledge, 0.0, whole=True)

    def reach(self, *, sign: int = 1, limit: float = math.radians(90)) -> Reach:
        """``max |angle|`` of a :meth:`plan` about the focused axis: how far the model turns the object, and
        what ends it. Nothing moves, and nothing is learned.

        Args:
            sign: 1 or -1, which way about the controller's focus.
            limit: farthest angle that is tried [rad].

        Raises:
            ParameterError: no single rotation in focus, a sign that is none, an angle outside 0 to 170 deg.
            GraspError: the model refuses the grasp as it is.
        """
        return reach(self.controller, self.knowledge, self.plant.observe(), sign, limit)

    def run(self, target: PoseTarget) -> Manipulation:
        """Drive the object to ``target``.

        Raises:
            PlantInUseError: another loop, or this one in another thread, commands the plant.
            StateError: another loop has given the controller other knowledge.
            EKMError: see :meth:`LookAndMoveController.decide`; what the plant raises before it has read.
        """
        return Manipulation.of(target, self.controller.focus, self.steps(target))

    def steps(self, target: PoseTarget) -> Generator[Step, None, Stop]:
        """The movements one by one; the generator's return value is the :class:`Stop`."""
        controller = self.controller
        if controller.enhanced is not None and controller.kinematic.figures is not self.knowledge.figures:
            raise StateError("another loop has given this controller other knowledge: make one for each loop")
        with self._gate.owned():
            self._stop.clear()
            self._gate.last = self._gate.failure = None
            known = copy.deepcopy(self.learned.state_dict())
            try:
                watch = Watch(self.safety.guards, controller.kinematic, self.knowledge)
                stop = yield from self._movements(target, watch)
                if watch.lie or stop.reason is StopReason.WRONG_WAY:
                    self.learned.load_state_dict(known)
                if self.learn and controller.enhanced is not None and watch.fingertips.times is not None:
                    self.knowledge.forces.grasped(watch.fingertips.times)  # also of pads that seem to lie
                return stop.told(watch.lie or watch.doubt)
            except BaseException as error:  # a closed generator as well: the hand must not go on
                last, failure = self._gate.last, self._gate.failure
                self.hold()
                if last is None or not (error is failure or isinstance(error, KeyboardInterrupt)):
                    raise
                return failed(error, last)

    def _movements(self, target: PoseTarget, watch: Watch) -> Generator[Step, None, Stop]:
        """Look, plan, move, learn."""
        seen, halt = watch.first(self.plant.observe(), self.plant.observe)
        self._lessons.begin(seen)
        ends = Ends(self.safety.rule, target, self.controller, seen)
        grips = turns = 0
        decision = None
        while True:
            if halt is not None:
                self.hold()
                return Stop(halt.reason, seen, halt.message)
            seen, looks = ends.look(seen, watch, self.plant.observe)
            over = ends.over(seen, looks, self._stop.is_set(), self.decline and decision is None)
            if over is not None:
                if over.reason is StopReason.OBJECT_LOST:
                    self.knowledge.error.slid(lost=True)
                if over.reason is StopReason.STALLED:
                    grip = None if decision is None else decision.grip
                    return over.told((grip and grip.waits) or self.plan(target).end.message)
                return over
            began = time.perf_counter()
            # after a movement that turned it is gripped again where a finger is weak, or the object may spin
            tried = max(grips, 2) if turns else grips
            again = tried < len(_FIRM) and (decision is None or decision.turns or not turns)
            firm = _FIRM[tried] if again else 0.0
            if self.learn:
                self._lessons.touch(seen, watch.motions.closest)
            plan = self.planner.plan(self.controller, seen, target, self.knowledge, firm)
            seconds, decision = time.perf_counter() - began, plan.decision
            if decision.status is not StopReason.RUNNING:
                said = decision.message, plan.end.message, ends.surprise, watch.suspects(seen)
                return Stop(decision.status, seen, "; ".join(dict.fromkeys(filter(None, said))))
            halt = gravest(watch.fingertips.before(decision, seen, first=decision.turns and not turns))
            if halt is None:
                step, halt = self._move(seen, decision, ends, watch, seconds)
                yield step
                seen, grips, turns = step.after, grips + (not decision.turns), turns + decision.turns

    def _move(
        self, seen: Observation, decision: Decision, ends: Ends, watch: Watch, seconds: float
    ) -> tuple[Step, Objection | None]:
        """Command, observe, learn; why the manipulation must end here, if it must."""
        controller, figures, guards, report = self.controller, self._figures, self.safety.guards, None
        ways = torch.stack([one.action for one in decision.pieces]).cumsum(0)
        path = Path.through(torch.stack([figures.motors(way) for way in ways]), guards.speed)
        on_the_way = OnTheWay(guards, seen, decision)
        first = self.plant.send_path(path, on_the_way, seen, "turn" if decision.turns else "grip")
        began = time.perf_counter()

        def expect(moved: Tensor) -> Expectation:
            return controller.expect(decision.pieces, figures.pulled(moved))

        verdict = watch.motion(seen, decision, self.plant.sent, first, expect, self.plant.observe)
        after, halt, expected = verdict.seen, verdict.halt, verdict.expected
        increment, pull = after.state.minus(seen.state), after.a - seen.a
        if halt is None and expected is not None:  # else nobody learns from this reading
            moved = pull
            self.plant.learn(after)
            halt = watch.stuck(seen, decision, after, self.knowledge.servo.stuck)
            if after.status is PlantStatus.HELD and self.learn:
                teaches = verdict.teaches and halt is None
                report = self._lessons.learn(seen, decision, after, moved, expected, teaches)
            controller.went(seen.a, decision.pieces)
            pull = figures.commit(moved, after.a)
            if decision.turns:
                ends.add(after, decision.limited)
                if watch.gated and not (watch.blind or watch.slid):
                    ends.leapt(float((increment - expected.increment)[-3:].norm()), verdict.note)
        seconds += time.perf_counter() - began
        note = "; ".join(filter(None, (on_the_way.why, verdict.note)))
        return Step(seen, decision, after, increment, pull, report, seconds, note), halt
