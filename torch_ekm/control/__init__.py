"""The controller: which motor increment to command, and the loop that commands it."""

from __future__ import annotations

from ..estimation.force_sensitivity import ForceSensitivity
from ..estimation.hand_figures import DescribedFigures, HandFigures
from .bands import Bands
from .closed_loop import ClosedLoop
from .controller import LookAndMoveController
from .decision import Band, Decision, Piece, StopReason, Waypoint
from .ends import Safety, StoppingRule
from .focus import Direction, FocusedPose, PoseTarget
from .journal import Journal
from .knowledge import HandKnowledge
from .limits import (
    DEFAULT_LIMITS,
    ActuatorLimit,
    JointLimit,
    Limit,
    LimitingFunction,
    NormalForceLimit,
    StepBound,
)
from .manipulation import Manipulation, Step, Stop
from .model_hand import ModelHand
from .plan import OneStep, Plan, Planner, WholeTurn
from .qp import Bounds, Equality, Inequality, Squares
from .reach import Reach
from .rehearsal import End, PathEnd
from .safety import Guards
from .situation import LinearizedModel, Situation
from .tasks import DEFAULT_TASKS, EffortTask, FocusTask, GripForceTask, OffAxisTask, Task

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
