"""Learners g(x) of a model's residual; nothing here knows about robots."""

from __future__ import annotations

from .action_linear import ActionLinearKernel as ActionLinearKernel
from .base import ResidualLearner as ResidualLearner
from .base import UpdateEvent as UpdateEvent
from .base import UpdateReport as UpdateReport
from .deep_kernel import DeepKernel as DeepKernel
from .deep_sogp import DeepKernelSOGP as DeepKernelSOGP
from .fleet import LearnerFleet as LearnerFleet
from .gpytorch_svgp import GPyTorchSVGP as GPyTorchSVGP
from .gpytorch_window import GPyTorchWindow as GPyTorchWindow
from .kernels import Kernel as Kernel
from .kernels import LinearKernel as LinearKernel
from .kernels import Matern32 as Matern32
from .kernels import Matern52 as Matern52
from .kernels import ProductKernel as ProductKernel
from .kernels import SquaredExponential as SquaredExponential
from .kernels import SumKernel as SumKernel
from .krls_t import KRLSTracker as KRLSTracker
from .linear import RandomFeatureRLS as RandomFeatureRLS
from .linear import RecursiveLeastSquares as RecursiveLeastSquares
from .local_gps import LocalGPs as LocalGPs
from .mixture import MixtureResidual as MixtureResidual
from .prediction import Prediction as Prediction
from .replay_mlp import ReplayMLP as ReplayMLP
from .river_residual import RiverResidual as RiverResidual
from .sogp import SparseOnlineGP as SparseOnlineGP
from .window_gp import WindowGP as WindowGP
from .zero import ZeroResidual as ZeroResidual
