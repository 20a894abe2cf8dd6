"""The controller: which motor increment to command, and the loop that commands it."""

from __future__ import annotations

from ..estimation.force_sensitivity import ForceSensitivity
from ..estimation.hand_figures import DescribedFigures, HandFigures
from .closed_loop import ClosedLoop
from .controller import DEFAULT_LIMITS, DEFAULT_TASKS, LookAndMoveController
from .decision import Decision, StopReason
from .focus import Direction, FocusedPose, PoseTarget
from .journal import Journal
from .knowledge import HandKnowledge
from .limits import ActuatorLimit, JointLimit, Limit, NormalForceLimit
from .manipulation import Manipulation, Step, Stop
from .model_hand import ModelHand
from .pace import LimitingFunction, Pace, PaceOptions, StepBound, TrustRegion
from .qp import Bounds, Equality, Inequality, Squares
from .reach import Reach, Reachability, ReachEnd
from .safety import Caution, Guards, Safety, StoppingRule
from .situation import LinearizedModel, Situation
from .tasks import EffortTask, FocusTask, GripForceTask, OffAxisTask, Task

__all__ = [
    "DEFAULT_LIMITS",
    "DEFAULT_TASKS",
    "ActuatorLimit",
    "Bounds",
    "Caution",
    "ClosedLoop",
    "Decision",
    "Direction",
    "DescribedFigures",
    "EffortTask",
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
    "Pace",
    "PaceOptions",
    "PoseTarget",
    "Reach",
    "Reachability",
    "ReachEnd",
    "Safety",
    "Situation",
    "Squares",
    "Step",
    "StepBound",
    "Stop",
    "StopReason",
    "StoppingRule",
    "Task",
    "TrustRegion",
]
