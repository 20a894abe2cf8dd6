"""torch_ekm: kinematic models of underactuated hands, corrected by online learners.

``import torch_ekm`` and all that it exports need torch and numpy only: the enhanced model f + g around any
f, the learners g and the exceptions. The packages, in the order in which data flows:
:mod:`~torch_ekm.description`, :mod:`~torch_ekm.kinematics`, :mod:`~torch_ekm.contact`,
:mod:`~torch_ekm.model`, :mod:`~torch_ekm.residual` (knows nothing of robots), :mod:`~torch_ekm.enhanced`,
:mod:`~torch_ekm.object_memory`, :mod:`~torch_ekm.plant`, :mod:`~torch_ekm.control`,
:mod:`~torch_ekm.sensing`, :mod:`~torch_ekm.simulation`, :mod:`~torch_ekm.rendering`,
:mod:`~torch_ekm.experiments`.
"""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, version

from . import exceptions as exceptions
from .enhanced import EnhancedModel as EnhancedModel
from .exceptions import EKMError as EKMError
from .exceptions import MissingExtraError as MissingExtraError
from .exceptions import NonFiniteError as NonFiniteError
from .exceptions import ParameterError as ParameterError
from .exceptions import ShapeError as ShapeError
from .exceptions import UnknownNameError as UnknownNameError
from .residual import ActionLinearKernel as ActionLinearKernel
from .residual import CalibrateNoise as CalibrateNoise
from .residual import DeepKernelSOGP as DeepKernelSOGP
from .residual import DetectChanges as DetectChanges
from .residual import ForgettingFactor as ForgettingFactor
from .residual import KRLSTracker as KRLSTracker
from .residual import LearnerFleet as LearnerFleet
from .residual import LearnHyperparameters as LearnHyperparameters
from .residual import LocalGPs as LocalGPs
from .residual import MixtureResidual as MixtureResidual
from .residual import ProcessNoise as ProcessNoise
from .residual import RandomFeatureRLS as RandomFeatureRLS
from .residual import RecursiveLeastSquares as RecursiveLeastSquares
from .residual import ReplayMLP as ReplayMLP
from .residual import ResidualLearner as ResidualLearner
from .residual import RobustWeight as RobustWeight
from .residual import SparseOnlineGP as SparseOnlineGP
from .residual import SquaredExponential as SquaredExponential
from .residual import Standardize as Standardize
from .residual import UpdateEvent as UpdateEvent
from .residual import UpdateReport as UpdateReport
from .residual import WindowGP as WindowGP
from .residual import ZeroResidual as ZeroResidual

try:
    __version__ = version("torch_ekm")
except PackageNotFoundError:  # a source tree that was never installed
    __version__ = "0+unknown"

__all__ = [
    "ActionLinearKernel", "CalibrateNoise", "DeepKernelSOGP", "DetectChanges", "EKMError", "EnhancedModel",
    "ForgettingFactor", "KRLSTracker", "LearnHyperparameters", "LearnerFleet", "LocalGPs",
    "MissingExtraError", "MixtureResidual", "NonFiniteError", "ParameterError", "ProcessNoise",
    "RandomFeatureRLS", "RecursiveLeastSquares", "ReplayMLP", "ResidualLearner", "RobustWeight", "ShapeError",
    "SparseOnlineGP", "SquaredExponential", "Standardize", "UnknownNameError", "UpdateEvent", "UpdateReport",
    "WindowGP", "ZeroResidual", "__version__", "exceptions",
]  # fmt: skip
