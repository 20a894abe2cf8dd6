"""Learners g(x) of a model's residual; nothing here knows about robots."""

from __future__ import annotations

from .adapters.gpytorch_svgp import GPyTorchSVGP as GPyTorchSVGP
from .adapters.gpytorch_window import GPyTorchWindow as GPyTorchWindow
from .adapters.river import RiverResidual as RiverResidual
from .base import ResidualLearner as ResidualLearner
from .baselines.krls_t import KRLSTracker as KRLSTracker
from .baselines.linear import RandomFeatureRLS as RandomFeatureRLS
from .baselines.linear import RecursiveLeastSquares as RecursiveLeastSquares
from .baselines.local_gps import LocalGPs as LocalGPs
from .baselines.replay_mlp import ReplayMLP as ReplayMLP
from .baselines.window_gp import WindowGP as WindowGP
from .baselines.zero import ZeroResidual as ZeroResidual
from .fleet import LearnerFleet as LearnerFleet
from .kernels.action_linear import ActionLinearKernel as ActionLinearKernel
from .kernels.action_linear import action_covariance as action_covariance
from .kernels.action_linear import action_jacobian as action_jacobian
from .kernels.deep import DeepKernel as DeepKernel
from .kernels.kernel import Kernel as Kernel
from .kernels.kernel import ProductKernel as ProductKernel
from .kernels.kernel import SumKernel as SumKernel
from .kernels.linear import LinearKernel as LinearKernel
from .kernels.stationary import Matern32 as Matern32
from .kernels.stationary import Matern52 as Matern52
from .kernels.stationary import SquaredExponential as SquaredExponential
from .mixture import MixtureResidual as MixtureResidual
from .report import UpdateEvent as UpdateEvent
from .report import UpdateReport as UpdateReport
from .sparse_gp.deep import DeepKernelSOGP as DeepKernelSOGP
from .sparse_gp.forgetting import ForgettingFactor as ForgettingFactor
from .sparse_gp.forgetting import ProcessNoise as ProcessNoise
from .sparse_gp.hyperparameters import LearnHyperparameters as LearnHyperparameters
from .sparse_gp.monitor import CalibrateNoise as CalibrateNoise
from .sparse_gp.monitor import DetectChanges as DetectChanges
from .sparse_gp.part import Part as Part
from .sparse_gp.robust_weight import RobustWeight as RobustWeight
from .sparse_gp.sparse_online_gp import Prediction as Prediction
from .sparse_gp.sparse_online_gp import SparseOnlineGP as SparseOnlineGP
from .sparse_gp.units import Standardize as Standardize

__all__ = [
    "ActionLinearKernel", "CalibrateNoise", "DeepKernel", "DeepKernelSOGP", "DetectChanges",
    "ForgettingFactor", "GPyTorchSVGP", "GPyTorchWindow", "KRLSTracker", "Kernel", "LearnHyperparameters",
    "LearnerFleet", "LinearKernel", "LocalGPs", "Matern32", "Matern52", "MixtureResidual", "Part",
    "Prediction", "ProcessNoise", "ProductKernel", "RandomFeatureRLS", "RecursiveLeastSquares", "ReplayMLP",
    "ResidualLearner", "RiverResidual", "RobustWeight", "SparseOnlineGP", "SquaredExponential", "Standardize",
    "SumKernel", "UpdateEvent", "UpdateReport", "WindowGP", "ZeroResidual", "action_covariance",
    "action_jacobian",
]  # fmt: skip
