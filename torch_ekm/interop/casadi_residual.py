"""A learner as a CasADi function whose basis and coefficients are inputs (extra ``interop``)."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from .._extras import require
from ..exceptions import ParameterError, StateError
from ..residual import MixtureResidual, ResidualLearner, SparseOnlineGP
from ..residual.base import FARTHEST
from ..residual.local_noise import REACH
from ..typing import Array
from .casadi_kernels import Inputs, covariance

if TYPE_CHECKING:
    import casadi as ca
else:
    ca = require("casadi")


class CasadiResidual:
    """``g(x; p)``: p holds all that learning changes, so that an optimiser built once stays valid.

    Attributes:
        function: ``casadi.Function (x, p) -> (mean, variance, mean_jacobian, variance_jacobian)`` with x
            ``(in, 1)``, mean and latent variance ``(out, 1)``, their derivatives ``(out, in)``; without the
            second and the last if ``variance`` is off.
        n_parameters: length of p.

    Args:
        learner: a SparseOnlineGP or a MixtureResidual of such, one model; its values are read whenever
            :meth:`parameters` is asked.
        variance: with the variance, whose coefficients are most of p.

    Raises:
        ParameterError: a learner or kernel of another kind.
    """

    def __init__(self, learner: ResidualLearner, *, variance: bool = True) -> None:
        if tuple(learner.batch_shape):
            raise StateError(
                f"the learner is a fleet {tuple(learner.batch_shape)}; one model can be exported"
            )
        self.learner, self._inputs = learner, Inputs()
        x = ca.SX.sym("x", learner.in_features)
        mean, spread = _build(learner, self._inputs, variance)(x)
        p = self._inputs.vector()
        self.n_parameters: int = p.shape[0]
        outputs = {"mean": mean, "mean_jacobian": ca.jacobian(mean, x)}
        if variance:
            outputs = {
                "mean": mean, "variance": ca.fmax(spread, 0.0),
                "mean_jacobian": outputs["mean_jacobian"], "variance_jacobian": ca.jacobian(spread, x),
            }  # fmt: skip
        self.function: Any = ca.Function("g", [x, p], list(outputs.values()), ["x", "p"], list(outputs))

    def parameters(self) -> Array:
        """The present p ``(n_parameters,)``, read from the learner."""
        return self._inputs.values()

    def __call__(self, x: Array) -> dict[str, Array]:
        """Everything at one x ``(in,)``, by name; means and variances ``(out,)``."""
        values = self.function(x=np.asarray(x), p=self.parameters())
        full = {name: np.array(values[name]) for name in self.function.name_out()}
        return {name: full[name][:, 0] if "jacobian" not in name else full[name] for name in full}


_Expression = Callable[["ca.SX"], tuple["ca.SX", "ca.SX"]]


def _build(learner: ResidualLearner, inputs: Inputs, variance: bool) -> _Expression:
    if isinstance(learner, MixtureResidual):
        return _mixture(learner, inputs, variance)
    if isinstance(learner, SparseOnlineGP):
        return _sparse(learner, inputs, variance)
    raise ParameterError("learner", type(learner).__name__, "a SparseOnlineGP or a MixtureResidual of such")


def _sparse(learner: SparseOnlineGP, inputs: Inputs, variance: bool) -> _Expression:
    """``mean = scale alpha'k + offset``, ``var = scale^2 (k** + k'Ck)``, in the learner's units and bound."""
    units, posterior = learner.units, learner.posterior
    own = ("shift", units.input), ("input_scale", units.input), ("output_shift", units.output), (
        "output_scale", units.output,
    )  # fmt: skip
    shift, wide, offset, scale = (
        inputs.take(name, lambda name=name, one=one: one.get_buffer(name.split("_")[-1])) for name, one in own
    )
    reach = ca.DM(units.input.reach.tolist()) if units.input.cuts else None
    bounded = _bounded(learner, inputs)
    column, diagonal = covariance(learner.kernel, lambda: posterior.basis, inputs)
    alpha = inputs.take("alpha", lambda: posterior.alpha)
    C = inputs.take("C", lambda: posterior.covariance) if variance else None

    def expression(x: ca.SX) -> tuple[ca.SX, ca.SX]:
        z = (x - shift) / wide
        z = z if reach is None else ca.fmin(ca.fmax(z, -reach), reach)
        k = column(z)
        latent = ca.SX(0) if C is None else diagonal(z) + k.T @ (C @ k)
        return bounded(scale * (alpha.T @ k) + offset), scale * scale * latent

    return expression


def _mixture(learner: MixtureResidual, inputs: Inputs, variance: bool) -> _Expression:
    """The moments of :meth:`MixtureResidual.predict`; gain, offset and weights are inputs."""
    members = [_build(one, inputs, variance) for one in learner.members]
    noisy = learner.members if variance else []
    noises = [inputs.take("noise", lambda one=one: _noise(one)) for one in noisy]
    gain = inputs.take("gain", lambda: learner.gain)
    offset = inputs.take("offset", lambda: learner.offset)
    bounded = _bounded(learner, inputs)
    if not variance:
        return lambda x: (bounded(_weighted(gain, [member(x)[0] for member in members]) + offset), ca.SX(0))
    beliefs = inputs.take("beliefs", lambda: learner.beliefs)
    carried = inputs.take("carried", lambda: learner.carried)
    share = inputs.take("weights", lambda: learner.weights)
    inflation = inputs.take("inflation", lambda: learner.inflation)
    f, s = _build(learner.noise.gp, inputs, False), inputs.take("noise share", lambda: learner.noise.share())
    h = ca.DM(learner.shares.tolist()).T
    owner = ca.DM(learner.owner.tolist()).T  # (members, experts)
    one = ca.DM.ones(1, h.shape[1])

    def expression(x: ca.SX) -> tuple[ca.SX, ca.SX]:
        each = [member(x) for member in members]
        means, variances = (ca.horzcat(*part) for part in zip(*each, strict=True))
        mean = bounded(_weighted(gain, [m for m, _ in each]) + offset)
        apart = (means @ owner) * ca.repmat(h, means.shape[0], 1) + carried - mean @ one
        inside = (variances @ owner) * ca.repmat(h * h, means.shape[0], 1)
        spread = ca.sum2(beliefs * (inside + apart * apart))
        most = inflation * _weighted(share, [v + s for (_, v), s in zip(each, noises, strict=True)])
        most = most * ca.exp(2.0 * s * ca.fmin(ca.fmax(f(x)[0], -REACH), REACH))
        return mean, ca.if_else(spread <= most, spread, most)

    return expression


def _bounded(learner: ResidualLearner, inputs: Inputs) -> Callable[[ca.SX], ca.SX]:
    """See :meth:`ResidualLearner.bounded`."""
    most = inputs.take("largest", lambda: FARTHEST * learner.largest)
    return lambda mean: ca.fmin(ca.fmax(mean, -most), most)


def _weighted(weights: ca.SX, columns: list[ca.SX]) -> ca.SX:
    return ca.sum2(weights * ca.horzcat(*columns))


def _noise(learner: ResidualLearner) -> Any:
    """Observation noise variance ``(out,)``; of a mixture in a mixture there is no such thing."""
    if not isinstance(learner, SparseOnlineGP):
        valid = "SparseOnlineGPs, where the variance is wanted"
        raise ParameterError("learners", type(learner).__name__, valid)
    return learner.noise_variance
