"""How unsure a learner is of what an action does: a convex quadratic, for a controller's cost."""

from __future__ import annotations

from typing import NamedTuple

import torch

from ..exceptions import ParameterError
from ..residual import ActionLinearKernel, ResidualLearner, SparseOnlineGP, action_covariance
from ..typing import Float, Tensor


class Quadratic(NamedTuple):
    """``v(a + d) ~ value + gradient . d + 1/2 d^T curvature d``, curvature positive semidefinite."""

    value: Float[Tensor, ""]
    gradient: Float[Tensor, " n_a"]
    curvature: Float[Tensor, "n_a n_a"]


def action_variance(
    learner: ResidualLearner, x: Float[Tensor, " d"], n_a: int, weight: Float[Tensor, " n_out"]
) -> Quadratic:
    """``v(a) = sum_j w_j Var[g_j([s; a])]`` about the action in ``x``, in the learner's units.

    With an :class:`ActionLinearKernel` exact for every action: ``v(a) = a^T V a``, V from
    :func:`~torch_ekm.residual.action_covariance`. For any other learner gradient and curvature by automatic
    differentiation, and of the curvature the positive semidefinite part (section 10.2 of the
    controller's derivation): where v bends down, the gradient alone pulls.

    Args:
        x: ``[s; a]``; the last ``n_a`` entries are the action.
        weight: w, not negative.

    Raises:
        ParameterError: the learner's variance does not depend on the action, or cannot be
            differentiated: it has nothing to say here.
    """
    learner = getattr(learner, "working", learner)  # of a bank: the hypothesis that leads
    if (
        isinstance(learner, SparseOnlineGP)
        and isinstance(learner.kernel, ActionLinearKernel)
        and learner.kernel.action_features == n_a
    ):
        s, a = x[:-n_a], x[-n_a:]
        V = torch.einsum("j,jab->ab", weight, action_covariance(learner, s).detach())
        V = (V + V.mT) / 2
        return Quadratic(a @ V @ a, 2 * V @ a, 2 * V)
    return _by_differentiation(learner, x, n_a, weight)


def _by_differentiation(learner: ResidualLearner, x: Tensor, n_a: int, weight: Tensor) -> Quadratic:
    s, a = x[:-n_a].detach(), x[-n_a:].detach().requires_grad_(True)
    slope: Tensor | None = None
    with torch.enable_grad():
        at = torch.cat([s, a])
        if isinstance(learner, SparseOnlineGP):  # the square of a root has no derivative at zero
            v = (weight * learner.variance(at)).sum()
        else:
            v = (weight * learner.predict(at).variance).sum()
        if v.requires_grad:
            slope = torch.autograd.grad(v, a, create_graph=True, allow_unused=True)[0]
        if slope is None:
            name = type(learner).__name__
            raise ParameterError("learner", name, "one whose variance depends on the action, differentiably")
        rows = [
            torch.autograd.grad(d, a, retain_graph=True, materialize_grads=True)[0]
            if d.requires_grad
            else torch.zeros_like(a)
            for d in slope
        ]
        H = torch.stack(rows).detach()
    value, vectors = torch.linalg.eigh(((H + H.mT) / 2).nan_to_num())
    H = (vectors * value.clamp_min(0.0)) @ vectors.mT
    return Quadratic(v.detach(), slope.detach().nan_to_num(), H)
