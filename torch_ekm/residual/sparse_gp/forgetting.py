"""Two ways to forget: what was learned fades, or g itself wanders."""

from __future__ import annotations

import torch

from ..._checks import check_fraction, check_share
from .part import Host, Part


class ForgettingFactor(Part):
    """``Omega <- lam^n Omega``, ``h <- lam^n h`` after n samples: all information fades to the prior.

    What is visited often stays as certain as a memory of ``1 / (1 - lam)`` samples allows.

    Args:
        factor: lam in (0, 1].

    Raises:
        ParameterError: outside of that.
    """

    def __init__(self, factor: float) -> None:
        super().__init__()
        self.factor = check_fraction("factor", factor)

    def on_rebuild(self, learner: Host) -> None:
        """Fade by the samples since the last rebuild."""
        if self.factor < 1.0:
            kept = (self.factor**learner.pending)[..., None, None]
            learner.posterior.precision.mul_(kept)
            learner.posterior.information.mul_(kept)


class ProcessNoise(Part):
    """``g <- sqrt(1 - q) g + sqrt(q) new`` per sample, ``new`` drawn from the prior: g itself wanders.

    The posterior covariance S becomes ``kept S + (1 - kept) K``, ``kept = (1 - q)^n`` after n samples (the
    forgetting of KRLS-T: Van Vaerenbergh et al., IEEE TNNLS 23, 2012). Certainty is bounded everywhere, so
    it follows a change of what is visited often faster than :class:`ForgettingFactor` does. With
    ``W = Omega/s2``, ``K = LL'`` and ``RR' = I + (1 - kept) L'WL`` the natural form follows without the
    inverse of K::

        W <- kept (W^-1 + (1 - kept) K)^-1 = kept (W - (1 - kept) G'G),   G = R^-1 L'W
        h <- sqrt(kept) (h - (1 - kept) G' R^-1 L'h)

    K is that of the basis in the units of that moment: before :class:`Standardize` in the list the units up
    to then, behind it the new ones.

    Args:
        share: q, the share of the prior variance that comes back per sample, in (0, 1).

    Raises:
        ParameterError: outside of that.
    """

    def __init__(self, share: float) -> None:
        super().__init__()
        self.share = check_share("share", share)

    def on_rebuild(self, learner: Host) -> None:
        """Wander by the samples since the last rebuild."""
        if learner.engine is not None and learner.engine.wanders(learner):
            return
        posterior = learner.posterior
        kept = ((1.0 - self.share) ** learner.pending)[..., None, None]
        s2 = learner.shared_noise()[..., None, None]
        L = torch.linalg.cholesky_ex(posterior.gram(learner.kernel))[0]
        LW = L.mT @ (posterior.precision / s2)
        eye = torch.eye(L.shape[-1], dtype=L.dtype, device=L.device)
        R = torch.linalg.cholesky_ex(eye + (1.0 - kept) * (LW @ L))[0]
        both = torch.cat([LW, L.mT @ posterior.information], dim=-1)
        G, Lh = torch.linalg.solve_triangular(R, both, upper=False).tensor_split([L.shape[-1]], dim=-1)
        posterior.precision.copy_(kept * (posterior.precision - (1.0 - kept) * s2 * (G.mT @ G)))
        posterior.information.copy_(kept.sqrt() * (posterior.information - (1.0 - kept) * (G.mT @ Lh)))
