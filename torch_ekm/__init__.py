"""torch_ekm: kinematic models of underactuated hands, corrected by online learners.

``import torch_ekm`` and all that it exports need torch and numpy only: the enhanced model f + g around any
f, the learners g, the root of the errors, :mod:`~torch_ekm.exceptions`. In the order in which data flows:
:mod:`~torch_ekm.description`, :mod:`~torch_ekm.kinematics`, :mod:`~torch_ekm.contact`,
:mod:`~torch_ekm.model`, :mod:`~torch_ekm.residual` (of any model), :mod:`~torch_ekm.enhanced`,
:mod:`~torch_ekm.plant`, :mod:`~torch_ekm.control`, :mod:`~torch_ekm.sensing`, :mod:`~torch_ekm.simulation`,
:mod:`~torch_ekm.rendering`, :mod:`~torch_ekm.interop` (learners and files of other libraries),
:mod:`~torch_ekm.experiments`, and ``torch_ekm.inspection``, which exports nothing: it is what the
commands ``check`` and ``show`` run.
"""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, version

from . import exceptions
from .enhanced import EnhancedModel, load, save
from .exceptions import EKMError
from .residual import (
    DeepKernelSOGP,
    DetectChanges,
    ForgettingFactor,
    LearnHyperparameters,
    MixtureResidual,
    ProcessNoise,
    RecursiveLeastSquares,
    ResidualLearner,
    RobustWeight,
    SparseOnlineGP,
    Standardize,
    ZeroResidual,
    default_learner,
    warm_up,
)

try:
    #: Version of the package.
    __version__ = version("torch_ekm")
except PackageNotFoundError:  # a source tree that was never installed
    __version__ = "0+unknown"

__all__ = [
    "DeepKernelSOGP",
    "DetectChanges",
    "EKMError",
    "EnhancedModel",
    "ForgettingFactor",
    "LearnHyperparameters",
    "MixtureResidual",
    "ProcessNoise",
    "RecursiveLeastSquares",
    "ResidualLearner",
    "RobustWeight",
    "SparseOnlineGP",
    "Standardize",
    "ZeroResidual",
    "__version__",
    "default_learner",
    "exceptions",
    "load",
    "save",
    "warm_up",
]
