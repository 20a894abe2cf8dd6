"""The engine in torch: any device, dtype, kernel and transformation."""

from __future__ import annotations

from typing import Any

import torch

from ....typing import Float, Tensor
from ...report import MomentsWithJacobians, UpdateReport
from ..part import Host
from .recursion import Absorbed, absorb


class ReferenceEngine:
    """Updates and queries of a sparse online GP by the equations as they stand; the others agree to rounding.

    Queries are ``(*any, *batch_shape, in)`` in the inputs' own units, results in those of the outputs.
    """

    def mean(self, gp: Host, x: Float[Tensor, "*any in"]) -> Float[Tensor, "*all out"]:
        """Posterior mean ``alpha' k(X, x)`` in the outputs' units, differentiable in x."""
        return _mean(gp, _cross(gp, gp.units.inputs(gp.check_query(x))))

    def moments(self, gp: Host, x: Float[Tensor, "*any in"]) -> tuple[Tensor, Tensor]:
        """Mean, and latent variance ``k** + k'Ck`` of each output, differentiable in x."""
        z = gp.units.inputs(gp.check_query(x))
        k = _cross(gp, z)
        column = k.unsqueeze(-1)
        v = gp.kernel.diagonal(z) + (column.mT @ (gp.posterior.covariance @ column)).squeeze(-1).squeeze(-1)
        return _mean(gp, k), _out(gp, v.clamp_min(0.0).unsqueeze(-1), 2)

    def observed(self, gp: Host, x: Float[Tensor, "*any in"]) -> tuple[Tensor, Tensor]:
        """Mean and variance of y, noise included."""
        mean, variance = self.moments(gp, x)
        return mean, variance + gp.noise_variance.to(gp.dtype)

    def linearize(self, gp: Host, x: Float[Tensor, "*any in"]) -> tuple[Tensor, Tensor]:
        """Mean and its derivative, ``(alpha'k, alpha' dk/dx)``, in closed form."""
        # free slots need no mask here: their rows in alpha and C are 0
        z = gp.units.inputs(gp.check_query(x))
        k, dk = gp.kernel.with_gradient(z, gp.posterior.basis)
        coefficients = gp.posterior.alpha.mT
        mean, jacobian = (coefficients @ k.unsqueeze(-1)).squeeze(-1), coefficients @ dk
        return gp.bounded_slope(_out(gp, mean, 1), _out_slope(gp, jacobian, 1, z))

    def jacobians(self, gp: Host, x: Float[Tensor, "*any in"]) -> MomentsWithJacobians:
        """Both moments and ``d mean/dx = alpha' dk/dx``, ``d var/dx = dk(x,x)/dx + 2 (Ck)' dk/dx``."""
        z = gp.units.inputs(gp.check_query(x))
        k, dk = gp.kernel.with_gradient(z, gp.posterior.basis)
        column = k.unsqueeze(-1)
        Ck = gp.posterior.covariance @ column
        alpha = gp.posterior.alpha
        # alpha and Ck side by side share one pass over k and one over dk
        left = torch.cat([alpha.expand(*Ck.shape[:-1], alpha.shape[-1]), Ck], dim=-1).mT
        values, slopes = (left @ column).squeeze(-1), left @ dk
        v = (gp.kernel.diagonal(z) + values[..., -1]).clamp_min(0.0).unsqueeze(-1)
        dv = gp.kernel.diagonal_gradient(z).unsqueeze(-2) + 2.0 * slopes[..., -1:, :]
        mean, slope = gp.bounded_slope(
            _out(gp, values[..., :-1], 1), _out_slope(gp, slopes[..., :-1, :], 1, z)
        )
        return MomentsWithJacobians(mean, _out(gp, v, 2), slope, _out_slope(gp, dv, 2, z))

    def slope_deviation(self, gp: Host, x: Float[Tensor, "*any in"]) -> Tensor:
        """Root of ``d2k(x, z)/dx dz + (dk/dx)' C dk/dx`` at ``z = x``, by column, ``(*all, out, in)``."""
        z = gp.units.inputs(gp.check_query(x))
        _, dk = gp.kernel.with_gradient(z, gp.posterior.basis)
        v = gp.kernel.derivative_variance(z) + (dk * (gp.posterior.covariance @ dk)).sum(-2)
        # where z is cut g is flat, but what is known of it does not grow
        return _out_slope(gp, v.clamp_min(0.0).sqrt().unsqueeze(-2), 1, torch.zeros_like(z))

    def learn(self, gp: Any, x: Tensor, y: Tensor, mask: Tensor | None) -> UpdateReport | None:
        """All that an update does; None: not one good sample for each model, or torch must do it."""
        return None

    def absorb(self, gp: Host, x: Tensor, y: Tensor, on: Tensor | None) -> Absorbed:
        """One checked sample per model where ``on`` is 1, see :func:`~.recursion.absorb`."""
        z, t = gp.units.inputs(x), gp.units.targets(y)
        return absorb(gp.posterior, z, t, gp.kernel, gp.shared_noise(), on, gp.weighing)


def _cross(gp: Host, z: Tensor) -> Tensor:
    """k(X, z) of the slots in use."""
    return gp.kernel.vector(z, gp.posterior.basis) * gp.posterior.active


def _mean(gp: Host, k: Tensor) -> Tensor:
    return gp.bounded(_out(gp, (k.unsqueeze(-2) @ gp.posterior.alpha).squeeze(-2), 1))


def _out(gp: Host, value: Tensor, power: int) -> Tensor:
    """``(*any, out or 1)`` in output units (squared if power is 2), in the interface's dtype."""
    value = gp.units.value(value, power)
    return value.expand(*value.shape[:-1], gp.out_features).to(gp.dtype)


def _out_slope(gp: Host, slope: Tensor, power: int, z: Tensor) -> Tensor:
    """Derivative by x of what is ``(*any, out or 1)`` in the learner's units."""
    slope = gp.units.slope(slope, power, z)
    return slope.expand(*slope.shape[:-2], gp.out_features, slope.shape[-1]).to(gp.dtype)
