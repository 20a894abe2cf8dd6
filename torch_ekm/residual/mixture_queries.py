"""What a mixture says: moments, laws, slopes and draws of all experts together."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast

import torch
from torch import nn
from torch.distributions import Normal

from ..exceptions import ParameterError
from ..typing import Float, Tensor
from .base import ResidualLearner
from .local_noise import LocalNoise
from .mixture_engine import CompiledMixture
from .printed import mixture
from .report import MomentsWithJacobians
from .tails import ScaleMixture, ScaleMixtureLaw


class MixtureQueries(ResidualLearner):
    """The queries of a :class:`~torch_ekm.residual.MixtureResidual`, whose docstring has the equations."""

    learners: nn.ModuleList
    tails: ScaleMixture
    noise: LocalNoise
    prior: Tensor
    evidence: Tensor
    innovation: Tensor
    level: Tensor
    gain: Tensor
    mass: Tensor
    shift: Tensor
    spread: Tensor
    offset: Tensor
    inflation: Tensor
    owner: Tensor
    _experts: Tensor
    _shares: Tensor
    _engine: CompiledMixture

    def forward(self, x: Tensor) -> Tensor:
        """Mean of all experts by their weights, ``sum_b gain_b m_b(x) + offset``."""
        found = self._engine.ask(self, x)
        if found is not None:
            return found.mean
        x = self.check_query(x)
        return self._mean(torch.stack([learner(x).to(x.dtype) for learner in self.members], dim=-1))

    def predict(self, x: Tensor, *, observation: bool = False) -> Normal:
        """Moments of the mixture, or mean and running variance of y with ``observation=True``."""
        if observation:
            mean, deviation = self._standard(x)
            return Normal(mean, deviation * self.inflation.sqrt(), validate_args=False)
        found = self._engine.ask(self, x, "deviation")
        if found is not None:
            return Normal(found.mean, found.deviation, validate_args=False)
        x = self.check_query(x)
        mean, deviation, means = self._together([one.moments(x, observation=True) for one in self.members])
        deviation = deviation * self.inflation.sqrt() * self.noise.log_factor(x).exp().to(x.dtype)
        variances = self._wide(torch.stack([one.moments(x)[1] for one in self.members], dim=-1).to(x.dtype))
        variance = self._spread(variances, self._apart(means, mean))
        # y is measured: experts that disagree by more than y scatters do not know less of g than of y
        return Normal(mean, torch.minimum(variance.sqrt(), deviation), validate_args=False)

    def predictive(self, x: Tensor) -> ScaleMixtureLaw:
        """Mixture of Student t laws about the mean: what log densities should be taken of."""
        return self.tails.law(*self._standard(x))

    def unit_draws(self, x: Tensor, n: int, generator: torch.Generator | None) -> Tensor:
        """Each draw of an output is one of a learner, by the learners' weights."""
        each = torch.stack([one.unit_draws(x, n, generator).to(x.dtype) for one in self.members], dim=-1)
        weights = self.weights.reshape(-1, each.shape[-1])
        b = torch.multinomial(weights, n, replacement=True, generator=generator)
        b = b.mT.reshape(n, *(1,) * (each.dim() - self.gain.dim() - 1), *self.gain.shape[:-1], 1)
        return each.gather(-1, b.expand(*each.shape[:-1], 1)).squeeze(-1)

    def _placed(self, x: Tensor, z: Tensor, generator: torch.Generator | None) -> Tensor:
        return self.predictive(x).placed(z, generator)

    def linearize(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """The learners' slopes, weighted; what is carried over does not depend on x."""
        found = self._engine.ask(self, x, "jacobian")
        if found is not None:
            return found.mean, found.jacobian
        x = self.check_query(x)
        pairs = [learner.linearize(x) for learner in self.members]
        means, slopes = (torch.stack(part, dim=-1).to(x.dtype) for part in zip(*pairs, strict=True))
        slope = (self.gain.unsqueeze(-2) * finite(slopes)).sum(-1)
        return self.bounded_slope(self._sum(finite(means)), slope)

    def slope_deviation(self, x: Tensor) -> Tensor:
        """``var = sum_e p_e (h_e^2 var_b + (h_e J_b - J)^2)``, within the experts' slopes and between."""
        x = self.check_query(x)
        J = finite(torch.stack([learner.linearize(x)[1].to(x.dtype) for learner in self.members], dim=-1))
        s = torch.stack([learner.slope_deviation(x).to(x.dtype) for learner in self.members], dim=-1)
        p, h = self.mass.unsqueeze(-3), self._shares
        apart = h * J.unsqueeze(-1) - (self.gain.unsqueeze(-2) * J).sum(-1)[..., None, None]
        return (p * (h.square() * s.square().unsqueeze(-1) + apart.square())).sum((-2, -1)).sqrt()

    def predict_with_jacobians(self, x: Float[Tensor, "*any in"]) -> MomentsWithJacobians:
        """Mean, variance (as :meth:`predict`) and both derivatives, from those of the learners::

            d var/dx = sum_e p_e (h_e^2 dv_e/dx + 2 h_e (mean_e - mean) dm_e/dx)

        Raises:
            ParameterError: a learner does not give its own in closed form.
        """
        found = self._engine.ask(self, x, "variance", "jacobian", "slope")
        if found is not None:
            return MomentsWithJacobians(found.mean, found.variance, found.jacobian, found.slope)
        x = self.check_query(x)
        for learner in self.members:
            if not hasattr(learner, "predict_with_jacobians"):
                valid = "learners with predict_with_jacobians, such as SparseOnlineGP"
                raise ParameterError("learners", type(learner).__name__, valid)
        each = [cast("Any", learner).predict_with_jacobians(x) for learner in self.members]
        m, v, dm, dv = (torch.stack(part, dim=-1).to(x.dtype) for part in zip(*each, strict=True))
        m, v, dm, dv = finite(m), self._wide(v), finite(dm), finite(dv)
        noisy = torch.stack([learner.moments(x, observation=True)[1] for learner in self.members], dim=-1)
        mean, jacobian = self.bounded_slope(self._sum(m), (self.gain.unsqueeze(-2) * dm).sum(-1))
        apart, p, h = self._apart(m, mean), self.mass, self._shares
        variance = self._spread(v, apart)
        of_v, of_m = p @ h.square(), 2.0 * (p * apart) @ h
        slope = (of_v.unsqueeze(-2) * dv).sum(-1) + (of_m.unsqueeze(-2) * dm).sum(-1)
        log_factor, by_x = (value.to(x.dtype) for value in self.noise.with_slope(x))
        share, local = self.weights, self.inflation * (2.0 * log_factor).exp()
        most = local * (share * self._wide(noisy.to(x.dtype))).sum(-1)
        steepest = local.unsqueeze(-1) * (share.unsqueeze(-2) * dv).sum(-1) + 2.0 * most.unsqueeze(-1) * by_x
        return MomentsWithJacobians(
            mean,
            torch.minimum(variance, most),
            jacobian,
            torch.where((variance <= most).unsqueeze(-1), slope, steepest),
        )

    @property
    def members(self) -> list[ResidualLearner]:
        """The learners b in the order in which they were given."""
        return cast("list[ResidualLearner]", list(self.learners))

    @property
    def weights(self) -> Float[Tensor, "*batch out learners"]:
        """Posterior probability of each learner, independent of its share."""
        return self.mass.sum(-1)

    @property
    def shares(self) -> Float[Tensor, " experts"]:
        """Share h of its learner's mean that each expert takes."""
        return self._experts[0]

    @property
    def beliefs(self) -> Float[Tensor, "*batch out experts"]:
        """Posterior probability p of each expert, by output."""
        return (self.prior + self.evidence).softmax(-1)

    @property
    def carried(self) -> Float[Tensor, "*batch out experts"]:
        """What each expert adds to its learner's mean: ``l - kappa w``."""
        return self.level - self._experts[1] * self.innovation

    def __repr__(self) -> str:
        return "\n  ".join([f"{type(self).__name__}({self.extra_repr()})", *mixture(self)])

    def _mean(self, means: Float[Tensor, "*any out learners"]) -> Float[Tensor, "*any out"]:
        return self.bounded(self._sum(finite(means)))

    def _sum(self, means: Float[Tensor, "*any out learners"]) -> Float[Tensor, "*any out"]:
        return (self.gain * means).sum(-1) + self.offset

    def _wide(self, variances: Float[Tensor, "*any out learners"]) -> Tensor:
        """A variance that is not finite is replaced by that of y."""
        return variances.where(variances.isfinite(), self.largest.square().unsqueeze(-1).to(variances))

    def _means(self, means: Float[Tensor, "*any out learners"]) -> Float[Tensor, "*any out experts"]:
        return self._of_learners(means) + self.carried

    def _of_learners(self, means: Float[Tensor, "*any out learners"]) -> Float[Tensor, "*any out experts"]:
        """What experts take of them."""
        return self.shares * (means @ self.owner.mT)

    def _apart(self, means: Tensor, mean: Tensor) -> Float[Tensor, "*any out learners shares"]:
        """How far the experts of each learner and share are from the mixture's mean, in their mean."""
        return self._shares * means.unsqueeze(-1) + self.shift - mean[..., None, None]

    def _spread(self, variances: Tensor, apart: Tensor) -> Float[Tensor, "*any out"]:
        """Variance of g: within the experts, and between them."""
        inside = self._shares.square() * variances.unsqueeze(-1)
        return (self.mass * (inside + apart.square()) + self.spread).sum((-2, -1))

    def _standard(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Mean, and the deviation by which innovations are standardised (the learners' own)."""
        found = self._engine.ask(self, x, "standard")
        if found is not None:
            return found.mean, found.standard
        x = self.check_query(x)
        mean, deviation, _ = self._together([one.moments(x, observation=True) for one in self.members])
        return mean, deviation * self.noise.log_factor(x).exp().to(deviation)

    def _together(self, moments: Sequence[tuple[Tensor, Tensor]]) -> tuple[Tensor, Tensor, Tensor]:
        means, variances = (torch.stack(part, dim=-1).to(self.dtype) for part in zip(*moments, strict=True))
        means = finite(means)
        return self._mean(means), (self.weights * self._wide(variances)).sum(-1).sqrt(), means


def finite(values: Tensor) -> Tensor:
    """A learner that is not finite has no say: what it says counts as 0, the model alone."""
    return values.nan_to_num(0.0, 0.0, 0.0)
