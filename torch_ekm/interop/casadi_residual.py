"""A learner's mean as a CasADi function whose basis and coefficients are inputs (extra ``interop``)."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from .._extras import require
from ..exceptions import ParameterError, StateError
from ..residual import (
    ActionLinearKernel,
    DeepKernel,
    Kernel,
    LinearKernel,
    Matern32,
    MixtureResidual,
    ResidualLearner,
    SparseOnlineGP,
    SquaredExponential,
)
from ..residual.base import FARTHEST
from ..typing import Array, Tensor

if TYPE_CHECKING:
    import casadi as ca
else:
    ca = require("casadi")

_TINY = 1e-30  # below it a squared distance is rounding, and the root has no derivative at 0

Function = Callable[["ca.SX"], "ca.SX"]


class CasadiResidual:
    """``g(x; p)``: p holds all that learning changes, so that an optimiser built once stays valid.

    Attributes:
        function: ``casadi.Function (x, p) -> (mean, mean_jacobian)`` with x ``(in, 1)``, the mean
            ``(out, 1)``, its derivatives ``(out, in)``.
        n_parameters: length of p.

    Args:
        learner: a SparseOnlineGP or a MixtureResidual of such, one model; its values are read whenever
            :meth:`parameters` is asked.

    Raises:
        ParameterError: a learner or kernel of another kind.
        StateError: a fleet.
    """

    def __init__(self, learner: ResidualLearner) -> None:
        if tuple(learner.batch_shape):
            raise StateError(
                f"the learner is a fleet {tuple(learner.batch_shape)}; one model can be exported"
            )
        self.learner = learner
        self._symbols: list[ca.SX] = []  # of p, and what each stands for
        self._sources: list[Callable[[], Tensor]] = []
        x = ca.SX.sym("x", learner.in_features)
        mean = self._mean(learner)(x)
        p = ca.vertcat(*(ca.vec(symbol) for symbol in self._symbols))
        self.n_parameters: int = p.shape[0]
        outputs = {"mean": mean, "mean_jacobian": ca.jacobian(mean, x)}
        self.function: Any = ca.Function("g", [x, p], list(outputs.values()), ["x", "p"], list(outputs))

    def parameters(self) -> Array:
        """The present p ``(n_parameters,)``, read from the learner."""
        tensors = (source().detach().double().cpu().numpy() for source in self._sources)
        return np.concatenate([tensor.ravel(order="F") for tensor in tensors])  # as CasADi's matrices

    def __call__(self, x: Array) -> tuple[Array, Array]:
        """Mean ``(out,)`` and its derivatives ``(out, in)`` at one x ``(in,)``."""
        mean, jacobian = self.function(np.asarray(x), self.parameters())
        return np.array(mean)[:, 0], np.array(jacobian)

    def _take(self, name: str, source: Callable[[], Tensor]) -> ca.SX:
        """Symbols of the shape of what ``source()`` gives: a scalar, a column, or a matrix."""
        shape = tuple(source().shape) + (1,) * (2 - source().dim())
        self._symbols.append(ca.SX.sym(name, *shape))
        self._sources.append(source)
        return self._symbols[-1]

    # -- means, see ResidualLearner.forward ---------------------------------------------------------

    def _mean(self, learner: ResidualLearner) -> Function:
        if isinstance(learner, MixtureResidual):
            return self._mixture(learner)
        if isinstance(learner, SparseOnlineGP):
            return self._sparse(learner)
        valid = "a SparseOnlineGP or a MixtureResidual of such"
        raise ParameterError("learner", type(learner).__name__, valid)

    def _sparse(self, learner: SparseOnlineGP) -> Function:
        """``scale alpha'k + offset``, in the learner's units and bound."""
        units, posterior = learner.units, learner.posterior
        shift, wide, offset, scale = (
            self._take(name, lambda name=name, one=one: one.get_buffer(name))
            for one in (units.input, units.output)
            for name in ("shift", "scale")
        )
        reach = ca.DM(units.input.reach.tolist()) if units.input.cuts else None
        bounded = self._bounded(learner)
        column = self._covariance(learner.kernel, lambda: posterior.basis)
        alpha = self._take("alpha", lambda: posterior.alpha)

        def mean(x: ca.SX) -> ca.SX:
            z = (x - shift) / wide
            z = z if reach is None else ca.fmin(ca.fmax(z, -reach), reach)
            return bounded(scale * (alpha.T @ column(z)) + offset)

        return mean

    def _mixture(self, learner: MixtureResidual) -> Function:
        """The weighted sum of its members'."""
        members = [self._mean(one) for one in learner.members]
        gain = self._take("gain", lambda: learner.gain)
        offset = self._take("offset", lambda: learner.offset)
        bounded = self._bounded(learner)
        return lambda x: bounded(ca.sum2(gain * ca.horzcat(*(member(x) for member in members)))) + offset

    def _bounded(self, learner: ResidualLearner) -> Function:
        """See :meth:`ResidualLearner.bounded`."""
        most = self._take("largest", lambda: FARTHEST * learner.largest)
        return lambda mean: ca.fmin(ca.fmax(mean, -most), most)

    # -- covariances k(X, z) (M, 1) of a column z with X (M, d) -------------------------------------

    def _covariance(self, kernel: Kernel, basis: Callable[[], Tensor]) -> Function:
        if isinstance(kernel, ActionLinearKernel):
            n = kernel.state_features
            state = self._covariance(kernel.state_kernel, lambda: basis()[:, :n])
            actions = self._take("actions", lambda: basis()[:, n:])
            variance = self._take("action_variance", lambda: kernel.action_variance)
            return lambda z: state(z[:n]) * (actions @ (variance * z[n:]))
        if isinstance(kernel, LinearKernel):
            points = self._take("points", basis)
            v = self._take("variance", lambda: kernel.variance)
            slopes = self._take("slope_variance", lambda: kernel.slope_variance)
            return lambda z: v * (1.0 + points @ (slopes * z))
        return self._stationary(kernel, basis)

    def _stationary(self, kernel: Kernel, basis: Callable[[], Tensor]) -> Function:
        """With features ``[z / L, net(z)]`` where it is deep."""
        deep = kernel if isinstance(kernel, DeepKernel) else None
        base: Any = kernel if deep is None else deep.base
        if type(base) not in (SquaredExponential, Matern32):
            valid = "squared exponential, Matern, action-linear, linear or deep, and no subclass"
            raise ParameterError("kernel", type(base).__name__, valid)
        v = self._take("variance", lambda: base.log_variance.exp())
        w = self._take("inverse_lengthscale", lambda: base.log_lengthscale.neg().exp())
        if deep is None:
            points, net = self._take("points", lambda: basis() * base.log_lengthscale.neg().exp()), None
        else:
            points, net = self._take("points", lambda: deep.embed(basis())), self._net(deep)

        def column(z: ca.SX) -> ca.SX:
            features = z * w if net is None else ca.vertcat(z * w, net(z))
            away = points - ca.repmat(features.T, points.shape[0], 1)
            d2 = ca.sum2(away * away)
            if isinstance(base, SquaredExponential):
                return v * ca.exp(-0.5 * d2)
            r = math.sqrt(3.0) * ca.sqrt(ca.fmax(d2, _TINY))
            return v * (1.0 + r) * ca.exp(-r)

        return column

    def _net(self, kernel: DeepKernel) -> Function:
        weights = [self._take("weight", lambda one=one: one) for one in kernel.weights]
        biases = [self._take("bias", lambda one=one: one) for one in kernel.biases]

        def net(z: ca.SX) -> ca.SX:
            for weight, bias in zip(weights[:-1], biases, strict=True):
                z = ca.tanh(weight.T @ z + bias)
            return weights[-1].T @ z

        return net
