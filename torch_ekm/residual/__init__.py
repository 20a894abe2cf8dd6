"""Learners g(x) of a model's residual; nothing here knows about robots."""

from __future__ import annotations

from .action_linear import ActionLinearKernel as ActionLinearKernel
from .base import ResidualLearner as ResidualLearner
from .base import UpdateEvent as UpdateEvent
from .base import UpdateReport as UpdateReport
from .kernels import Kernel as Kernel
from .kernels import LinearKernel as LinearKernel
from .kernels import Matern32 as Matern32
from .kernels import Matern52 as Matern52
from .kernels import ProductKernel as ProductKernel
from .kernels import SquaredExponential as SquaredExponential
from .kernels import SumKernel as SumKernel
from .sogp import Prediction as Prediction
from .sogp import SparseOnlineGP as SparseOnlineGP
