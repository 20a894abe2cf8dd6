"""WHICH motor increment to command."""

from __future__ import annotations

from .closed_loop import ClosedLoop as ClosedLoop
from .closed_loop import Manipulation as Manipulation
from .closed_loop import Step as Step
from .closed_loop import Stop as Stop
from .controller import ControllerOptions as ControllerOptions
from .controller import Decision as Decision
from .controller import LookAndMoveController as LookAndMoveController
from .focus import FocusedPose as FocusedPose
from .focus import PoseTarget as PoseTarget
from .qp import ControlProblem as ControlProblem
from .qp import ControlSolution as ControlSolution
from .qp import build_qp as build_qp
from .qp import solve_qp as solve_qp
from .termination import StoppingRule as StoppingRule
from .termination import StopReason as StopReason

__all__ = [
    "ClosedLoop",
    "Manipulation",
    "Step",
    "Stop",
    "ControlProblem",
    "ControlSolution",
    "ControllerOptions",
    "Decision",
    "FocusedPose",
    "LookAndMoveController",
    "PoseTarget",
    "StopReason",
    "StoppingRule",
    "build_qp",
    "solve_qp",
]
