"""A test bench: one object in the simulated hand, one controller, trial after trial."""

from __future__ import annotations

import contextlib
import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import numpy as np
import torch

from ..control import (
    ClosedLoop,
    FocusedPose,
    HandKnowledge,
    LookAndMoveController,
    Manipulation,
    PoseTarget,
)
from ..description import ObjectDescription
from ..enhanced import EnhancedModel, GraspEncoding
from ..enhanced.grasp import SMALL_ACTION_VARIANCE
from ..exceptions import EquilibriumError, GraspError, NoContactError
from ..kinematics import GraspState
from ..model import KinematicModel
from ..plant import FramesAtRest, Plant
from ..residual import ResidualLearner
from ..simulation import DisturbedPlant, PlantChange, SimulatedHand, Tug
from .config import Setting, object_name
from .learners import DEFAULT_LEARNER, make_learner
from .records import NOT_GRASPED, Trial, TrialRecord

_DEG = math.pi / 180
_TRIES = 4  # grasps drawn for one trial before it is given up
_HOPELESS = 2  # trials without any grasp, after which the object is given up
# of the turns in which a hand is learned
_LEARNS_BY = (14.0, -8.0, 22.0)  # [deg] in this order
_MOTIONS = 30  # at least, unless turns end early
_MOST_TURNS = 12
FIRST_GRASP = 1000  # its number: never one that is tested


class Bench:
    """Grasp, turn, release, again; the learner stays from trial to trial.

    Args:
        object: name, path or description.
        controller: one of ``CONTROLLERS``.
    """

    controllers: ClassVar[type[LookAndMoveController]] = LookAndMoveController
    loops: ClassVar[type[ClosedLoop]] = ClosedLoop

    def __init__(self, setting: Setting, object: str | ObjectDescription, controller: str) -> None:
        torch.set_num_threads(1)  # small matrices: more threads only wait for each other
        self.setting, self.controller = setting, controller
        config = setting.plant_config(controller)
        self.name = object_name(object) if isinstance(object, str) else object.name
        self.hand = SimulatedHand(setting.hand, object, config, setting.parameters, engine=setting.engine)
        self.disturbed = DisturbedPlant(self.hand)
        self.plant: Plant = self.disturbed
        if setting.sensing:
            self.plant = _sensed(self.disturbed, self.hand, setting)
        else:
            self.plant = FramesAtRest(self.plant, setting.frames)
        inverse = controller == "KM+S" or (self.learns and setting.servo_inverse)
        adapts = self.learns and setting.follows
        self.knowledge = HandKnowledge.of(self.hand.hand, learns=inverse, adapts=adapts)
        """It is that of the hand, and stays when the object changes."""
        self.model = KinematicModel(self.hand.hand, self.hand.object, setting.model)
        self.learner: ResidualLearner | None = None
        self.encoding: GraspEncoding | None = None
        self.enhanced: EnhancedModel | None = None
        self.no_grasp = ""
        """Why the last grasp that failed did."""
        self.last: Manipulation | None = None
        """The last :meth:`turn` left it."""
        self._ever_held, self._failed = False, 0  # trials without a grasp

    @property
    def learns(self) -> bool:
        """The controller is an E-KM, which trains a learner after each motion."""
        return self.controller.startswith("E-KM")

    def grasp(self, seed: int, trial: int) -> GraspState | None:
        """A random grasp point, decided by ``(seed, trial)`` alone; None if no pinch holds.

        An object that no pinch held in the first two trials is given up: planning in vain takes longest.
        """
        if not self._ever_held and self._failed >= _HOPELESS:
            return None
        for attempt in range(_TRIES):
            drawn = int(np.random.SeedSequence([seed, trial, attempt]).generate_state(1)[0])
            try:
                start = self.plant.reset(drawn).state
            except (EquilibriumError, GraspError) as error:
                self.no_grasp = str(error)
                continue
            self._ever_held = True
            if self.learns and self.enhanced is None:
                with contextlib.suppress(NoContactError):  # by the model alone: the loop ends with it
                    self._prepare_learner(start)
            return start
        self._failed += 1
        return None

    def trial(
        self, seed: int, trial: int, angle_deg: float, kind: str = "turn", **options: Any
    ) -> TrialRecord:
        """Turn the object by ``angle_deg`` from a fresh grasp, with the options of :meth:`turn`."""
        start = self.grasp(seed, trial)
        about = Trial(self.name, kind, self.controller, seed, trial, angle_deg)
        if start is None:
            return TrialRecord(**vars(about), reason=NOT_GRASPED, message=self.no_grasp)
        return self.turn(about, start, **options)

    def learn_hand(self, seed: int) -> list[TrialRecord]:
        """Thirty motions with this object, in turns to and fro, for the knowledge of the hand."""
        records: list[TrialRecord] = []
        while sum(one.steps for one in records) < _MOTIONS and len(records) < _MOST_TURNS:
            k = len(records)
            records.append(self.trial(seed, FIRST_GRASP + k, _LEARNS_BY[k % len(_LEARNS_BY)], "first"))
        return records

    def turn(
        self,
        about: Trial,
        start: GraspState,
        *,
        events: Sequence[Tug | PlantChange] = (),
        poses: bool = False,
    ) -> TrialRecord:
        """Turn the object that is held.

        Args:
            start: from where, as measured.
            events: what happens on the way; ``at`` counts this trial's commands from 0.
            poses: keep the true poses, for pictures.
        """
        now = self.disturbed.count
        self.disturbed.events = tuple(dataclasses.replace(event, at=event.at + now) for event in events)
        axis = self.hand.rotation_axis
        target = PoseTarget.turned(start, axis, about.angle_deg * _DEG)
        self.last = self.closed_loop(self.plant).run(target)
        if self.last.stop.cause is not None:  # Ctrl-C, or a failure of the plant: this is no trial
            raise self.last.stop.cause
        return TrialRecord.of(about, self.last, axis, learns=self.learns, poses=poses)

    def close(self) -> None:
        """Close the plant: its simulation and rendering end; the bench is not used afterwards."""
        self.plant.close()

    def look_and_move(self, focus: FocusedPose | None = None) -> LookAndMoveController:
        """The controller of the next turn, with what is known now; by default about the hand's axis."""
        setting, focused = self.setting, self.hand.rotation_axis if focus is None else focus
        figures = {"limiting": setting.limiting, "bound": setting.bound}
        model = self.model if self.enhanced is None else self.enhanced
        return self.controllers(model, focused, setting.tasks, setting.limits, **figures)

    def closed_loop(
        self, plant: Plant, focus: FocusedPose | None = None, *, decline: bool = False
    ) -> ClosedLoop:
        """The loop of the next turn."""
        setting = self.setting
        known = {"knowledge": self.knowledge, "safety": setting.safety, "planner": setting.planner}
        return self.loops(plant, self.look_and_move(focus), **known, decline=decline)

    def _prepare_learner(self, start: GraspState) -> None:
        setting = self.setting
        if self.encoding is None:
            self.encoding = GraspEncoding.of(self.model, start)
        if self.learner is None:
            sizes = self.encoding.n_features, self.model.hand.n_a, setting.capacity
            options = dict(setting.learner_options)
            if setting.follows and setting.learner == DEFAULT_LEARNER:
                options = {"action_variance": SMALL_ACTION_VARIANCE, **options}
            self.learner = make_learner(setting.learner, *sizes, **options)
        self.enhanced = EnhancedModel.for_grasp(
            self.model, start, self.learner, self.encoding, self.knowledge.figures
        )


def new_objects(
    make: Callable[[str], Bench],
    items: Sequence[str],
    seed: int,
    *,
    angles: Sequence[float],
    kind: str = "turn",
) -> list[TrialRecord]:
    """The hand is learned with the first object; then turns of the others, which it has never held."""
    records, knowledge = [], None
    for k, item in enumerate(items):
        bench = make(item)
        bench.knowledge = knowledge = bench.knowledge if knowledge is None else knowledge
        if k:
            records += [bench.trial(seed, j, angle, kind) for j, angle in enumerate(angles)]
        elif bench.learns:
            records += bench.learn_hand(seed)
        bench.close()
    return records


def _sensed(plant: DisturbedPlant, simulated: SimulatedHand, setting: Setting) -> Plant:
    from ..sensing import ContactAligned  # OpenCV is needed only here
    from ..simulation import HallSensors, SensedPlant

    hand, stuck = simulated.hand, setting.parameters.stuck_joints
    hall = HallSensors(hand) if hand.hall_sensors else None
    sensed = SensedPlant(plant, hand, simulated.object, hall=hall)
    if hall is not None:  # after the calibration: a channel that was dead by then would be invalid
        hall.stuck = {k: math.nan for k, joint in enumerate(hall.joints) if joint in stuck}
    rested = FramesAtRest(sensed, setting.frames)
    return rested if hall is None else ContactAligned(rested, hand, simulated.object)
