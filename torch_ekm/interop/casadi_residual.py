"""A learner's mean as a CasADi function whose basis and coefficients are inputs (extra ``interop``)."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from .._extras import require
from ..exceptions import ParameterError, StateError
from ..residual import MixtureResidual, ResidualLearner, SparseOnlineGP
from ..residual.base import FARTHEST
from ..typing import Array
from .casadi_kernels import Function, Inputs, covariance

if TYPE_CHECKING:
    import casadi as ca
else:
    ca = require("casadi")


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
    """

    def __init__(self, learner: ResidualLearner) -> None:
        if tuple(learner.batch_shape):
            raise StateError(
                f"the learner is a fleet {tuple(learner.batch_shape)}; one model can be exported"
            )
        self.learner, self._inputs = learner, Inputs()
        x = ca.SX.sym("x", learner.in_features)
        mean = _build(learner, self._inputs)(x)
        p = self._inputs.vector()
        self.n_parameters: int = p.shape[0]
        outputs = {"mean": mean, "mean_jacobian": ca.jacobian(mean, x)}
        self.function: Any = ca.Function("g", [x, p], list(outputs.values()), ["x", "p"], list(outputs))

    def parameters(self) -> Array:
        """The present p ``(n_parameters,)``, read from the learner."""
        return self._inputs.values()

    def __call__(self, x: Array) -> tuple[Array, Array]:
        """Mean ``(out,)`` and its derivatives ``(out, in)`` at one x ``(in,)``."""
        mean, jacobian = self.function(np.asarray(x), self.parameters())
        return np.array(mean)[:, 0], np.array(jacobian)


def _build(learner: ResidualLearner, inputs: Inputs) -> Function:
    """The mean, see :meth:`ResidualLearner.forward`."""
    if isinstance(learner, MixtureResidual):
        return _mixture(learner, inputs)
    if isinstance(learner, SparseOnlineGP):
        return _sparse(learner, inputs)
    raise ParameterError("learner", type(learner).__name__, "a SparseOnlineGP or a MixtureResidual of such")


def _sparse(learner: SparseOnlineGP, inputs: Inputs) -> Function:
    """``scale alpha'k + offset``, in the learner's units and bound."""
    units, posterior = learner.units, learner.posterior
    own = ("shift", units.input), ("input_scale", units.input), ("output_shift", units.output), (
        "output_scale", units.output,
    )  # fmt: skip
    shift, wide, offset, scale = (
        inputs.take(name, lambda name=name, one=one: one.get_buffer(name.split("_")[-1])) for name, one in own
    )
    reach = ca.DM(units.input.reach.tolist()) if units.input.cuts else None
    bounded = _bounded(learner, inputs)
    column = covariance(learner.kernel, lambda: posterior.basis, inputs)
    alpha = inputs.take("alpha", lambda: posterior.alpha)

    def mean(x: ca.SX) -> ca.SX:
        z = (x - shift) / wide
        z = z if reach is None else ca.fmin(ca.fmax(z, -reach), reach)
        return bounded(scale * (alpha.T @ column(z)) + offset)

    return mean


def _mixture(learner: MixtureResidual, inputs: Inputs) -> Function:
    """The weighted sum of its members'."""
    members = [_build(one, inputs) for one in learner.members]
    gain = inputs.take("gain", lambda: learner.gain)
    offset = inputs.take("offset", lambda: learner.offset)
    bounded = _bounded(learner, inputs)
    return lambda x: bounded(ca.sum2(gain * ca.horzcat(*(member(x) for member in members)))) + offset


def _bounded(learner: ResidualLearner, inputs: Inputs) -> Callable[[ca.SX], ca.SX]:
    """See :meth:`ResidualLearner.bounded`."""
    most = inputs.take("largest", lambda: FARTHEST * learner.largest)
    return lambda mean: ca.fmin(ca.fmax(mean, -most), most)
