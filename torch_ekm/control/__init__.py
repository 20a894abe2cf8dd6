"""The controller: which motor increment to command, and the loop that commands it."""

from __future__ import annotations

from ..estimation.filters import ForceSensitivity
from ..estimation.hand_figures import DescribedFigures, HandFigures
from ..estimation.knowledge import HandKnowledge
from .closed_loop import ClosedLoop
from .controller import LookAndMoveController
from .decision import Band, Decision, Manipulation, Piece, Step, Stop, StopReason, Waypoint
from .ends import Safety, StoppingRule
from .focus import Direction, FocusedPose, PoseTarget
from .guards import Guards
from .journal import Journal
from .model_hand import ModelHand
from .plan import OneStep, Plan, Planner, Reach, WholeTurn
from .program import Bounds, Equality, Inequality, LinearizedModel, Situation, Squares
from .rehearsal import Bands, End, PathEnd
from .tasks import (
    DEFAULT_LIMITS,
    DEFAULT_TASKS,
    ActuatorLimit,
    EffortTask,
    FocusTask,
    GripForceTask,
    JointLimit,
    Limit,
    LimitingFunction,
    NormalForceLimit,
    OffAxisTask,
    StepBound,
    Task,
)

__all__ = [
    "DEFAULT_LIMITS",
    "DEFAULT_TASKS",
    "ActuatorLimit",
    "Band",
    "Bands",
    "Bounds",
    "ClosedLoop",
    "Decision",
    "Direction",
    "DescribedFigures",
    "EffortTask",
    "End",
    "Equality",
    "FocusTask",
    "FocusedPose",
    "ForceSensitivity",
    "GripForceTask",
    "Guards",
    "HandFigures",
    "HandKnowledge",
    "Inequality",
    "JointLimit",
    "Journal",
    "Limit",
    "LimitingFunction",
    "LinearizedModel",
    "LookAndMoveController",
    "Manipulation",
    "ModelHand",
    "NormalForceLimit",
    "OffAxisTask",
    "OneStep",
    "PathEnd",
    "Piece",
    "Plan",
    "Planner",
    "PoseTarget",
    "Reach",
    "Safety",
    "Situation",
    "Squares",
    "Step",
    "StepBound",
    "Stop",
    "StopReason",
    "StoppingRule",
    "Task",
    "Waypoint",
    "WholeTurn",
]
