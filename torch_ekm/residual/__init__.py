"""Learners g(x) of a model's residual, for any model."""

from __future__ import annotations

from .base import ResidualLearner
from .baselines.linear import RandomFeatureRLS, RecursiveLeastSquares
from .baselines.replay_mlp import ReplayMLP
from .baselines.zero import ZeroResidual
from .default import default_learner
from .kernels.deep import DeepKernel
from .kernels.kernel import Kernel
from .kernels.linear import ActionLinearKernel, LinearKernel
from .kernels.stationary import Matern32, SquaredExponential
from .mixture import MixtureResidual
from .mixture_engine import warm_up
from .report import Expected, UpdateEvent, UpdateReport
from .sparse_gp.forgetting import ForgettingFactor, ProcessNoise
from .sparse_gp.hyperparameters import LearnHyperparameters
from .sparse_gp.monitor import CalibrateNoise, DetectChanges, RobustWeight
from .sparse_gp.part import Part
from .sparse_gp.sparse_online_gp import DeepKernelSOGP, SparseOnlineGP
from .sparse_gp.units import Standardize

__all__ = [
    "ActionLinearKernel",
    "CalibrateNoise",
    "DeepKernel",
    "DeepKernelSOGP",
    "DetectChanges",
    "Expected",
    "ForgettingFactor",
    "Kernel",
    "LearnHyperparameters",
    "LinearKernel",
    "Matern32",
    "MixtureResidual",
    "Part",
    "ProcessNoise",
    "RandomFeatureRLS",
    "RecursiveLeastSquares",
    "ReplayMLP",
    "ResidualLearner",
    "RobustWeight",
    "SparseOnlineGP",
    "SquaredExponential",
    "Standardize",
    "UpdateEvent",
    "UpdateReport",
    "ZeroResidual",
    "default_learner",
    "warm_up",
]
