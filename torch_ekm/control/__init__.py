"""WHICH motor increment to command."""

from __future__ import annotations

from .closed_loop import ClosedLoop as ClosedLoop
from .closed_loop import Manipulation as Manipulation
from .closed_loop import Step as Step
from .closed_loop import Stop as Stop
from .controller import DEFAULT_LIMITS as DEFAULT_LIMITS
from .controller import DEFAULT_TASKS as DEFAULT_TASKS
from .controller import Decision as Decision
from .controller import LookAndMoveController as LookAndMoveController
from .focus import FocusedPose as FocusedPose
from .focus import PoseTarget as PoseTarget
from .limiting import LimitingFunction as LimitingFunction
from .limits import ActuatorLimit as ActuatorLimit
from .limits import FrictionMarginLimit as FrictionMarginLimit
from .limits import JointLimit as JointLimit
from .limits import Limit as Limit
from .limits import NormalForceLimit as NormalForceLimit
from .qp import Bounds as Bounds
from .qp import ControlProblem as ControlProblem
from .qp import ControlSolution as ControlSolution
from .qp import Equality as Equality
from .qp import Inequality as Inequality
from .qp import Squares as Squares
from .qp import build_qp as build_qp
from .situation import LinearizedModel as LinearizedModel
from .situation import Situation as Situation
from .tasks import EffortTask as EffortTask
from .tasks import FocusTask as FocusTask
from .tasks import GripForceTask as GripForceTask
from .tasks import OffAxisTask as OffAxisTask
from .tasks import Task as Task
from .tasks import UncertaintyTask as UncertaintyTask
from .termination import StoppingRule as StoppingRule
from .termination import StopReason as StopReason

__all__ = [
    "DEFAULT_LIMITS", "DEFAULT_TASKS", "ActuatorLimit", "Bounds", "ClosedLoop", "ControlProblem",
    "ControlSolution", "Decision", "EffortTask", "Equality", "FocusTask", "FocusedPose",
    "FrictionMarginLimit", "GripForceTask", "Inequality", "JointLimit", "Limit", "LimitingFunction",
    "LinearizedModel", "LookAndMoveController", "Manipulation", "NormalForceLimit", "OffAxisTask",
    "PoseTarget", "Situation", "Squares", "Step", "Stop", "StopReason", "StoppingRule", "Task",
    "UncertaintyTask", "build_qp",
]  # fmt: skip
