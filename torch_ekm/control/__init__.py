"""The controller: which motor increment to command, and the loop that commands it."""

from __future__ import annotations

from .caution import Caution
from .closed_loop import ClosedLoop, Manipulation, Step, Stop
from .controller import DEFAULT_LIMITS, DEFAULT_TASKS, Decision, LookAndMoveController
from .focus import FocusedPose, PoseTarget
from .guards import Guards, Halt
from .limiting import LimitingFunction
from .limits import ActuatorLimit, FrictionMarginLimit, JointLimit, Limit, NormalForceLimit
from .qp import Bounds, ControlProblem, ControlSolution, Equality, Inequality, Squares, build_qp
from .situation import LinearizedModel, Situation
from .step_bound import StepBound
from .tasks import EffortTask, FocusTask, GripForceTask, OffAxisTask, Task
from .termination import StoppingRule, StopReason

__all__ = [
    "DEFAULT_LIMITS",
    "DEFAULT_TASKS",
    "ActuatorLimit",
    "Bounds",
    "Caution",
    "ClosedLoop",
    "ControlProblem",
    "ControlSolution",
    "Decision",
    "EffortTask",
    "Equality",
    "FocusTask",
    "FocusedPose",
    "FrictionMarginLimit",
    "GripForceTask",
    "Guards",
    "Halt",
    "Inequality",
    "JointLimit",
    "Limit",
    "LimitingFunction",
    "LinearizedModel",
    "LookAndMoveController",
    "Manipulation",
    "NormalForceLimit",
    "OffAxisTask",
    "PoseTarget",
    "Situation",
    "Squares",
    "Step",
    "StepBound",
    "Stop",
    "StopReason",
    "StoppingRule",
    "Task",
    "build_qp",
]
