"""Learners g(x) of a model's residual; nothing here knows about robots."""

from __future__ import annotations

from .adapters.gpytorch_svgp import GPyTorchSVGP as GPyTorchSVGP
from .adapters.gpytorch_window import GPyTorchWindow as GPyTorchWindow
from .adapters.river import RiverResidual as RiverResidual
from .base import ResidualLearner as ResidualLearner
from .base import UpdateEvent as UpdateEvent
from .base import UpdateReport as UpdateReport
from .baselines.krls_t import KRLSTracker as KRLSTracker
from .baselines.linear import RandomFeatureRLS as RandomFeatureRLS
from .baselines.linear import RecursiveLeastSquares as RecursiveLeastSquares
from .baselines.local_gps import LocalGPs as LocalGPs
from .baselines.replay_mlp import ReplayMLP as ReplayMLP
from .baselines.window_gp import WindowGP as WindowGP
from .baselines.zero import ZeroResidual as ZeroResidual
from .fleet import LearnerFleet as LearnerFleet
from .kernels.action_linear import ActionLinearKernel as ActionLinearKernel
from .kernels.deep import DeepKernel as DeepKernel
from .kernels.kernel import Kernel as Kernel
from .kernels.kernel import LinearKernel as LinearKernel
from .kernels.kernel import Matern32 as Matern32
from .kernels.kernel import Matern52 as Matern52
from .kernels.kernel import ProductKernel as ProductKernel
from .kernels.kernel import SquaredExponential as SquaredExponential
from .kernels.kernel import SumKernel as SumKernel
from .mixture import MixtureResidual as MixtureResidual
from .prediction import Prediction as Prediction
from .sparse_gp.deep import DeepKernelSOGP as DeepKernelSOGP
from .sparse_gp.sparse_online_gp import SparseOnlineGP as SparseOnlineGP

__all__ = [
    "ActionLinearKernel",
    "DeepKernel",
    "DeepKernelSOGP",
    "GPyTorchSVGP",
    "GPyTorchWindow",
    "KRLSTracker",
    "Kernel",
    "LearnerFleet",
    "LinearKernel",
    "LocalGPs",
    "Matern32",
    "Matern52",
    "MixtureResidual",
    "Prediction",
    "ProductKernel",
    "RandomFeatureRLS",
    "RecursiveLeastSquares",
    "ReplayMLP",
    "ResidualLearner",
    "RiverResidual",
    "SparseOnlineGP",
    "SquaredExponential",
    "SumKernel",
    "UpdateEvent",
    "UpdateReport",
    "WindowGP",
    "ZeroResidual",
]
