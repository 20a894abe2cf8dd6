"""Covariance functions as CasADi expressions whose parameters are inputs."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from .._extras import require
from ..exceptions import ParameterError
from ..residual import (
    ActionLinearKernel,
    DeepKernel,
    Kernel,
    LinearKernel,
    Matern32,
    SquaredExponential,
)
from ..typing import Array, Tensor

if TYPE_CHECKING:
    import casadi as ca
else:
    ca = require("casadi")

_TINY = 1e-30  # below it a squared distance is rounding, and the root has no derivative at 0


class Inputs:
    """Symbols that stand for a learner's tensors, in the order in which they were asked for."""

    def __init__(self) -> None:
        self.symbols: list[ca.SX] = []
        self.sources: list[Callable[[], Tensor]] = []

    def take(self, name: str, source: Callable[[], Tensor]) -> ca.SX:
        """Symbols of the shape of what ``source()`` gives: a scalar, a column, or a matrix."""
        shape = tuple(source().shape) + (1,) * (2 - source().dim())
        self.symbols.append(ca.SX.sym(name, *shape))
        self.sources.append(source)
        return self.symbols[-1]

    def vector(self) -> ca.SX:
        """All symbols as one column, in the order of :meth:`values`."""
        return ca.vertcat(*(ca.vec(symbol) for symbol in self.symbols))

    def values(self) -> Array:
        """What they stand for at present, in the same order ``(n,)``; CasADi's matrices are column-major."""
        tensors = (source().detach().double().cpu().numpy() for source in self.sources)
        return np.concatenate([tensor.ravel(order="F") for tensor in tensors])


Function = Callable[["ca.SX"], "ca.SX"]


def covariance(kernel: Kernel, basis: Callable[[], Tensor], inputs: Inputs) -> Function:
    """``k(X, z)`` ``(M, 1)``, of a column z.

    Args:
        kernel: of one model.
        basis: gives X ``(M, d)``.
        inputs: takes the parameters in.

    Raises:
        ParameterError: a kernel of another kind.
    """
    if isinstance(kernel, ActionLinearKernel):
        n = kernel.state_features
        state = covariance(kernel.state_kernel, lambda: basis()[:, :n], inputs)
        actions = inputs.take("actions", lambda: basis()[:, n:])
        variance = inputs.take("action_variance", lambda: kernel.action_variance)
        return lambda z: state(z[:n]) * (actions @ (variance * z[n:]))
    if isinstance(kernel, LinearKernel):
        points = inputs.take("points", basis)
        v = inputs.take("variance", lambda: kernel.variance)
        slopes = inputs.take("slope_variance", lambda: kernel.slope_variance)
        return lambda z: v * (1.0 + points @ (slopes * z))
    return _stationary(kernel, basis, inputs)


def _stationary(kernel: Kernel, basis: Callable[[], Tensor], inputs: Inputs) -> Function:
    base: Any = kernel.base if isinstance(kernel, DeepKernel) else kernel
    if type(base) not in (SquaredExponential, Matern32):
        valid = "squared exponential, Matern, action-linear, linear or deep, and no subclass"
        raise ParameterError("kernel", type(base).__name__, valid)
    phi = _phi(base)
    if isinstance(kernel, DeepKernel):
        points = inputs.take("embedded", lambda: kernel.embed(basis()))
        embed = _embedding(kernel, inputs)
    else:
        w = inputs.take("inverse_lengthscale", lambda: base.log_lengthscale.neg().exp())
        points = inputs.take("scaled", lambda: basis() * base.log_lengthscale.neg().exp())

        def embed(z: ca.SX, /) -> ca.SX:
            return z * w

    v = inputs.take("variance", lambda: base.log_variance.exp())

    def column(z: ca.SX) -> ca.SX:
        away = points - ca.repmat(embed(z).T, points.shape[0], 1)
        return v * phi(ca.sum2(away * away))

    return column


def _phi(kernel: Kernel) -> Function:
    """Correlation at a squared scaled distance."""
    if isinstance(kernel, SquaredExponential):
        return lambda d2: ca.exp(-0.5 * d2)

    def matern(d2: ca.SX) -> ca.SX:
        r = math.sqrt(3.0) * ca.sqrt(ca.fmax(d2, _TINY))
        return (1.0 + r) * ca.exp(-r)

    return matern


def _embedding(kernel: DeepKernel, inputs: Inputs) -> Function:
    """``[z / L, net(z)]``, weights being inputs."""
    w = inputs.take("inverse_lengthscale", lambda: kernel.base.log_lengthscale.neg().exp())
    weights = [inputs.take("weight", lambda one=one: one) for one in kernel.weights]
    biases = [inputs.take("bias", lambda one=one: one) for one in kernel.biases]

    def embed(z: ca.SX) -> ca.SX:
        hidden = z
        for weight, bias in zip(weights[:-1], biases, strict=True):
            hidden = ca.tanh(weight.T @ hidden + bias)
        return ca.vertcat(z * w, weights[-1].T @ hidden)

    return embed
