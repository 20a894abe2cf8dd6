"""How large innovations are, and how heavy their tails: a mixture of Student t laws that follows them."""

from __future__ import annotations

import itertools
from typing import Any

import torch
from torch import nn
from torch.distributions import Categorical, MixtureSameFamily, StudentT

from ..typing import Float, Tensor

MEMORY = 0.99  #: forgetting factor of the evidence
# by which the experts of a mixture are judged, in torch and in compiled loops
FREEDOM = 10.0  #: of the t law that judges the experts: an outlier must not decide alone
LEVEL_DECAY, TREND_DECAY = 0.995, 0.98
YOUNG = 4  #: samples that are not judged by: learners do not know their units yet
#: share of the running rms by which experts are judged, and at most so many typical scales
RMS_LEAST, RMS_MOST = 0.5, 6.0
RATE = 0.01  #: of the running variance
#: running variances that one sample counts for, at most: a single -999 must not inflate the next thousand
SQUARE_MOST = 100.0
FARTHEST = 1e6  #: standard deviations
LEAST = -50.0  #: log evidence: nobody is ruled out for good
_RATES, _FREEDOMS = (0.02, 0.06, 0.2), (2.0, 4.0, 30.0)
_BISECTIONS = 52  # of an interval: as many as a double has digits
LARGEST = 14.0  # of the logarithm of a scale: a noise-free stream must not end in 0/0


class EvenStudentT(StudentT):
    """Student's t of an even number nu of degrees of freedom, whose cdf is a sum::

    F(t) = 1/2 + s/2 sum_{k < nu/2} a_k (1 - s^2)^k,   s = t / sqrt(nu + t^2),   a_0 = 1
    a_k = a_{k-1} (2k - 1)/(2k)
    """

    def cdf(self, value: Float[Tensor, "*any"]) -> Float[Tensor, "*any"]:
        """P(y <= value)."""
        t = (value - self.loc) / self.scale
        s = t / (self.df + t.square()).sqrt()
        term, total = torch.ones_like(s), torch.zeros_like(s)
        for k in range(int(self.df.max()) // 2):
            total = total + torch.where(2 * k < self.df, term, 0.0)
            term = term * (self.df / (self.df + t.square())) * (2 * k + 1) / (2 * k + 2)
        return 0.5 + 0.5 * s * total


class ScaleMixtureLaw(MixtureSameFamily):
    """A weighted mean of Student t laws about one mean, with quantiles."""

    def icdf(self, value: Tensor | float) -> Float[Tensor, "*any"]:
        """The value that y exceeds with probability ``1 - value``, by bisection to rounding."""
        t: Any = self.component_distribution
        p = torch.as_tensor(value, dtype=t.loc.dtype, device=t.loc.device)
        # no t law of two or more degrees of freedom lies farther out than that of two
        far = (2.0 * p - 1.0).abs() / (2.0 * p * (1.0 - p)).sqrt()
        middle, width = t.loc[..., 0], far * t.scale.amax(-1)
        low, high = middle - width, middle + width
        for _ in range(_BISECTIONS):
            half = 0.5 * (low + high)
            below = self.cdf(half) < p
            low, high = torch.where(below, half, low), torch.where(below, high, half)
        return 0.5 * (low + high)

    def placed(
        self, z: Float[Tensor, "*n_and_any"], generator: torch.Generator | None
    ) -> Float[Tensor, "*n_and_any"]:
        """Draws ``mean + s z / sqrt(chi2 / nu)`` of this law, whose normal parts z are given."""
        t: Any = self.component_distribution
        shares = self.mixture_distribution.probs.expand(t.batch_shape).flatten(0, -2)
        e = torch.multinomial(shares, len(z), True, generator=generator).mT.reshape(z.shape)
        freedoms = t.df.flatten(0, -2)[0]
        shape, factory = (*z.shape, int(freedoms.max()) // 2), {"dtype": z.dtype, "device": z.device}
        uniform = torch.rand(shape, generator=generator, **factory).clamp_min(torch.finfo(z.dtype).tiny)
        chi2 = -2.0 * uniform.log().cumsum(-1)  # of 2, 4, .. freedoms
        nu, scale = freedoms[e], t.scale.expand(len(z), *t.batch_shape)
        chi2, scale = (
            one.gather(-1, place.unsqueeze(-1)).squeeze(-1)
            for one, place in ((chi2, (0.5 * nu).long() - 1), (scale, e))
        )
        return t.loc[..., 0] + scale * z * (nu / chi2).sqrt()


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

    def law(self, mean: Float[Tensor, "*any out"], deviation: Float[Tensor, "*any out"]) -> ScaleMixtureLaw:
        """The law of y = mean + deviation z. Its variance is infinite (some experts have nu = 2)."""
        deviation = deviation.unsqueeze(-1)
        t = EvenStudentT(
            self.freedoms, mean.unsqueeze(-1), deviation * self.log_scale.exp(), validate_args=False
        )
        logits = self.evidence.expand(t.batch_shape)
        return ScaleMixtureLaw(Categorical(logits=logits, validate_args=False), t, validate_args=False)

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
