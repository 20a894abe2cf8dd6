"""How large innovations are, and how heavy their tails: a mixture of Student t laws that follows them."""

from __future__ import annotations

import itertools

import torch
from torch import nn
from torch.distributions import Categorical, MixtureSameFamily, StudentT

from ..typing import Float, Tensor

MEMORY = 0.99  #: forgetting factor of the evidence
_RATES, _FREEDOMS = (0.02, 0.06, 0.2), (2.0, 4.0, 30.0)
LARGEST = 14.0  # of the logarithm of a scale: a noise-free stream must not end in 0/0


class ScaleMixture(nn.Module):
    """Experts e on standardised innovations z, each a Student t whose scale follows the score::

        log s_e += rate_e ((nu_e + 1) r/(nu_e + r) - 1),   r = (z/s_e)^2
        p_e ~ exp(sum_i memory^i log t(z_{t-i}; nu_e, s_e))

    The score is bounded, so one outlier moves log s by at most ``nu rate`` (more among the first samples,
    whose rates are larger; Harvey, Dynamic models for volatility and heavy tails, 2013). Weights are Bayes'
    with exponential forgetting (Raftery et al., Technometrics 52, 2010). Shapes ``(*batch, out, experts)``.

    Args:
        out_features: number of outputs, each with experts of its own.
        batch_shape: shape of the fleet.
    """

    def __init__(
        self,
        out_features: int,
        *,
        batch_shape: tuple[int, ...] = (),
        dtype: torch.dtype = torch.float64,
        device: torch.device | str | None = None,
    ) -> None:
        super().__init__()
        factory = {"dtype": dtype, "device": device}
        rates, freedoms = zip(*itertools.product(_RATES, _FREEDOMS), strict=True)
        self.rates = nn.Buffer(torch.tensor(rates, **factory), persistent=False)
        self.freedoms = nn.Buffer(torch.tensor(freedoms, **factory), persistent=False)
        shape = (*batch_shape, out_features, len(rates))
        self.log_scale = nn.Buffer(torch.zeros(shape, **factory))
        self.evidence = nn.Buffer(torch.zeros(shape, **factory))

    def law(self, mean: Float[Tensor, "*any out"], deviation: Float[Tensor, "*any out"]) -> MixtureSameFamily:
        """The law of y = mean + deviation z. Its variance is infinite (some experts have nu = 2)."""
        deviation = deviation.unsqueeze(-1)
        t = StudentT(self.freedoms, mean.unsqueeze(-1), deviation * self.log_scale.exp(), validate_args=False)
        logits = self.evidence.expand(t.batch_shape)
        return MixtureSameFamily(Categorical(logits=logits, validate_args=False), t, validate_args=False)

    def typical(self) -> Float[Tensor, "*batch out"]:
        """Scale of z in which outliers have little say: geometric mean of the experts'."""
        return (self.evidence.softmax(-1) * self.log_scale).sum(-1).exp()

    def observe(
        self, z: Float[Tensor, "*batch out"], count: Float[Tensor, "*batch"], mask: Tensor | None
    ) -> None:
        """One standardised innovation; ``count`` samples were seen before (scales settle fast at first)."""
        scale = self.log_scale.exp()
        z = z.unsqueeze(-1)
        density = StudentT(self.freedoms, 0.0, scale, validate_args=False).log_prob(z)
        r = (z / scale).square()
        score = (self.freedoms + 1.0) * r / (self.freedoms + r) - 1.0
        step = torch.maximum(self.rates, (0.5 / (1.0 + count / 4.0))[..., None, None]) * score
        evidence = MEMORY * self.evidence + density
        evidence = evidence - evidence.amax(-1, keepdim=True)
        log_scale = (self.log_scale + step).clamp(-LARGEST, LARGEST)
        if mask is not None:
            on = mask[..., None, None] > 0
            log_scale = torch.where(on, log_scale, self.log_scale)
            evidence = torch.where(on, evidence, self.evidence)
        self.log_scale.copy_(log_scale)
        self.evidence.copy_(evidence)

    def reset(self) -> None:
        """Scales of 1 and equal weights for all experts."""
        self.log_scale.zero_()
        self.evidence.zero_()
