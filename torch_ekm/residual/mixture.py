"""Online Bayesian mixture around any learners: their weights, and noise that returns in the next sample."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Sequence
from typing import Any, cast

import torch
from torch import nn
from torch.distributions import Normal

from ..exceptions import ParameterError
from ..typing import AnyArray, Float, Tensor
from . import tails as E
from .base import ResidualLearner
from .local_noise import LocalNoise
from .mixture_engine import CompiledMixture
from .printed import mixture
from .report import Expected, MomentsWithJacobians, UpdateReport
from .returns import Returns
from .sparse_gp.monitor import DetectChanges
from .sparse_gp.part import Host
from .tails import MEMORY, ScaleMixture, ScaleMixtureLaw

_SHARES = (0.0, 0.5, 1.0)  # values of h to choose from
_CARRIES = (-0.3, 0.0, 0.2, 0.4, 0.6, 0.8)  # of kappa
_CAPS = (3.0, 30.0)  # and of c
_PRIOR = 0.8  # belief that a learner is to be taken at its word
_BEHIND = 3.0  # log evidence that the others lack where a regime is back
_SLOW = 0.2  # largest rate of a level that outlives the end of a trajectory


class MixtureResidual(ResidualLearner):
    """A weighted mean of experts e = (learner b, share h, carry kappa, level rho, trend beta, cap c)::

        mean_e = h m_b(x) - kappa w_e + l_e
        i_e = y - mean_e,   w_e <- i_e / (1 + (i_e / c s)^2)
        d_e <- .98 d_e + beta w_e,   l_e <- .995 l_e + rho w_e + d_e
        p_e ~ prior_e exp(sum_j memory^j log t_10(i_e(t-j) / s') - memory^t doubt_b)

    s is the learners' deviation times ``r(x)`` of LocalNoise and the typical scale of ScaleMixture; s' is the
    larger of s and half the running rms, at most 6 s; memory = 0.99.

    Differences of a noisy pose carry noise over: what one sample has too much, the next one lacks, so
    innovations correlate by up to -1/2 and ``kappa`` (the pose's share of the noise: the moving average
    of order one that a Kalman filter would use) takes it away. ``l`` follows a wandering offset: slowly with
    a small rho, and with rho = 1 it is what the last sample left, which on a smooth stream says a lot; d
    goes on as it went (Holt's double exponential smoothing).
    ``h`` below 1 trusts the model more than the learner, so an output on which nothing can be learned
    costs next to nothing. Which of it holds is decided by predictive evidence alone (dynamic model
    averaging, Raftery et al., Technometrics 52, 2010), for each output and model of a fleet. The
    learners learn y itself: what is carried over changes with the weights, and would be another function
    to learn each time.

    It predicts the *next* sample: a constant carry is part of the mean until another sample comes.
    Call :meth:`new_sequence` where one trajectory ends and another begins.

    Where the system changes and changes back, what the first learner that notes changes
    (:class:`DetectChanges`) knew comes back after one or two samples, see Returns; not in a fleet.

    ``predict`` gives a Normal law whose variance is the running one; :meth:`predictive` a mixture of
    Student t laws, which heavy tails need (see ScaleMixture).

    Args:
        learners: one or more of the same shapes; they belong to the mixture from now on.
        levels, trends: values of rho and beta to choose from; a trend goes with levels that are larger.
        doubts: log evidence that each learner lacks at first, forgotten as evidence is; 0 if none is given.
        on_invalid: see ResidualLearner.

    Raises:
        ParameterError: no learner, learners of different shapes, an empty or impossible choice, or doubts
            that are not one finite number >= 0 for each learner.
    """

    def __init__(
        self,
        learners: ResidualLearner | Sequence[ResidualLearner],
        *,
        levels: Sequence[float] = (0.0, 0.03, 0.1),
        trends: Sequence[float] = (0.0,),
        doubts: Sequence[float] = (),
        **options: Any,
    ) -> None:
        members = [learners] if isinstance(learners, ResidualLearner) else list(learners)
        first = _same_shapes(members)
        shape = {"batch_shape": tuple(first.batch_shape), "dtype": first.dtype, "device": first.device}
        super().__init__(first.in_features, first.out_features, **{**shape, **options})
        if self.batch_shape != shape["batch_shape"]:
            valid = f"{shape['batch_shape']}, as that of the learners"
            raise ParameterError("batch_shape", tuple(self.batch_shape), valid)
        for name, values in (("levels", levels), ("trends", trends)):
            if not values or not all(0 <= value <= 1 for value in values):
                raise ParameterError(name, values, "one or more numbers in [0, 1]")
        if doubts and not (len(doubts) == len(members) and all(0 <= doubt < math.inf for doubt in doubts)):
            valid = f"one finite number >= 0 for each of {len(members)} learners"
            raise ParameterError("doubts", doubts, valid)
        self.learners = nn.ModuleList(members)
        rises = [(rho, beta) for rho in levels for beta in trends if beta == 0 or beta < rho]
        if not rises:
            raise ParameterError("trends", trends, f"one of 0, or one below a level of {tuple(levels)}")
        experts = itertools.product(range(len(members)), _SHARES, _CARRIES, rises, _CAPS)
        flat = [(b, h, kappa, *rise, c) for b, h, kappa, rise, c in experts]
        owner, *values = zip(*flat, strict=True)
        factory = {"dtype": self.dtype, "device": self.device}
        self._experts = nn.Buffer(torch.tensor(values, **factory), persistent=False)
        members_of = torch.nn.functional.one_hot(torch.tensor(owner), len(members))
        self.owner = nn.Buffer(members_of.to(self._like), persistent=False)
        """1 where an expert takes its mean from that learner, ``(experts, learners)``."""
        # what is missing of a share of 1 is split over the others
        prior = torch.where(self.shares == 1.0, _PRIOR, (1 - _PRIOR) / (len(_SHARES) - 1)).log()
        self.prior = nn.Buffer(prior.to(self._like), persistent=False)
        wide = (*self.batch_shape, self.out_features, len(owner))
        doubted = self.owner @ torch.tensor(doubts or [0.0] * len(members), **factory)
        self.first_evidence = nn.Buffer(-doubted.expand(wide), persistent=False)
        self.evidence = nn.Buffer(self.first_evidence.clone())
        self.innovation = nn.Buffer(torch.zeros(wide, **factory))
        self.level = nn.Buffer(torch.zeros(wide, **factory))
        self.trend = nn.Buffer(torch.zeros(wide, **factory))
        # what a query needs of the weights: sum p h per learner, and sum p (l - kappa w)
        self.gain = nn.Buffer(torch.zeros(*wide[:-1], len(members), **factory))
        # of the experts of each learner and share: sum p, mean of l - kappa w, sum p (l - kappa w - mean)^2
        alike = torch.zeros(*self.gain.shape, len(_SHARES), **factory)
        self.mass, self.shift, self.spread = (nn.Buffer(alike.clone()) for _ in range(3))
        self._shares = nn.Buffer(torch.tensor(_SHARES, **factory), persistent=False)
        self.offset = nn.Buffer(torch.zeros(wide[:-1], **factory))
        self.inflation = nn.Buffer(torch.ones(wide[:-1], **factory))
        self.count = nn.Buffer(torch.zeros(self.batch_shape, **factory))
        fleet = {"batch_shape": self.batch_shape, **factory}
        self.tails = ScaleMixture(self.out_features, **fleet)
        self.noise = LocalNoise(self.in_features, self.out_features, **fleet)
        noting = (i for i, one in enumerate(members) if isinstance(one, Host) and one.part(DetectChanges))
        self.watched = -1 if self.batch_shape else next(noting, -1)
        self.returns = None if self.watched < 0 else Returns(cast("Host", members[self.watched]))
        self._engine = CompiledMixture()
        self._settle()

    # -- learning -------------------------------------------------------------------------------

    def reset(self) -> None:
        """The learners, the experts' weights and what they carry over back to the prior."""
        for learner in self.members:
            learner.reset()
        counts = self.count, self.n_refused, self.largest
        for buffer in (self.innovation, self.level, self.trend, *counts):
            buffer.zero_()
        self.evidence.copy_(self.first_evidence)
        self.inflation.fill_(1.0)
        self.tails.reset()
        self.noise.reset()
        if self.returns is not None:
            self.returns.reset()
        self._settle()

    @torch.no_grad()
    def new_sequence(self) -> None:
        """The next sample does not follow on the last one: innovation, trends and fast levels are dropped.

        Levels with rho up to 0.2 stay.
        """
        self.innovation.zero_()
        self.trend.zero_()
        self.level.mul_(self._experts[2] <= _SLOW)
        for learner in self.members:
            learner.new_sequence()
        self._settle()

    def at_once(self, x: Tensor, y: Tensor, mask: Tensor | None) -> UpdateReport | None:
        return self._engine.learn(self, x, y, mask)

    @torch.no_grad()
    def expect(self, x: Tensor) -> Expected:
        x = super().expect(x).x
        return Expected(x, ([one.moments(x, observation=True) for one in self.members], self.carried))

    @torch.no_grad()
    def absorb(
        self, x: Tensor, y: Tensor, mask: Tensor | None, sooner: tuple[list, Tensor] | None = None
    ) -> UpdateReport:
        moments = [learner.moments(x, observation=True) for learner in self.members]
        nis, *said = self._judged(x, y, mask, moments, sooner)
        reports = [learner.step(x, y, mask) for learner in self.members]
        if self.returns is not None and (mask is None or bool(mask)):
            self.note_return(x, y.cpu().numpy(), torch.stack(said).cpu().numpy(), float(nis))
        part = self.weights.mean(-2)  # of each learner, over the outputs
        novelty, weight = (
            (part * torch.stack(each, dim=-1).to(part)).sum(-1)
            for each in zip(*((one.novelty, one.weight) for one in reports), strict=True)
        )
        event = torch.stack([one.event for one in reports]).amax(0)
        return UpdateReport(event, novelty, nis, weight)

    def note_return(self, x: Tensor, y: AnyArray, said: AnyArray, nis: float) -> None:
        """After a sample of one model: a regime that is back takes its learner's place, see Returns."""
        i = self.watched
        if self.returns is None or not self.returns.observe(cast("Host", self.learners[i]), x, y, said, nis):
            return
        best = self.owner[:, i] > 0
        for experts, most in ((best, 0.0), (~best, -_BEHIND)):
            if bool(experts.any()):
                own = self.evidence[..., experts]
                self.evidence[..., experts] = (own - own.amax(-1, keepdim=True) + most).clamp_min(E.LEAST)
        self.new_sequence()

    # -- what it says ---------------------------------------------------------------------------

    def forward(self, x: Tensor) -> Tensor:
        """Mean of all experts by their weights, ``sum_b gain_b m_b(x) + offset``."""
        found = self._engine.ask(self, x)
        if found is not None:
            return found.mean
        x = self.check_query(x)
        return _only_of(x, self._mean(*self._stacked((learner(x),) for learner in self.members)))

    def predict(self, x: Tensor, *, observation: bool = False) -> Normal:
        """Moments of the mixture, or mean and running variance of y with ``observation=True``."""
        if observation:
            mean, deviation = self._standard(x)
            return Normal(mean, deviation * self.inflation.sqrt(), validate_args=False)
        found = self._engine.ask(self, x, "variance")
        if found is not None:
            return Normal(found.mean, found.variance.sqrt(), validate_args=False)
        x = self.check_query(x)
        mean, deviation, means = self._together([one.moments(x, observation=True) for one in self.members])
        deviation = deviation * self.inflation.sqrt() * self.noise.log_factor(x).exp().to(x.dtype)
        variances = self._stacked(one.moments(x) for one in self.members)[1]
        variance = self._spread(self._wide(variances), self._apart(means, mean))
        # y is measured: experts that disagree by more than y scatters do not know less of g than of y
        return Normal(_only_of(x, mean), torch.minimum(variance.sqrt(), deviation), validate_args=False)

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
        means, slopes = map(finite, self._stacked(learner.linearize(x) for learner in self.members))
        mean, slope = self.bounded_slope(self._sum(means), (self.gain.unsqueeze(-2) * slopes).sum(-1))
        return _only_of(x, mean), _only_of(x, slope)

    def slope_deviation(self, x: Tensor) -> Tensor:
        """``var = sum_e p_e (h_e^2 var_b + (h_e J_b - J)^2)``, within the experts' slopes and between."""
        x = self.check_query(x)
        J, s = self._stacked((one.linearize(x)[1], one.slope_deviation(x)) for one in self.members)
        J, p, h = finite(J), self.mass.unsqueeze(-3), self._shares
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
        m, v, dm, dv = self._stacked(cast("Any", one).predict_with_jacobians(x) for one in self.members)
        m, v, dm, dv = finite(m), self._wide(v), finite(dm), finite(dv)
        noisy = self._stacked(learner.moments(x, observation=True) for learner in self.members)[1]
        mean, jacobian = self.bounded_slope(self._sum(m), (self.gain.unsqueeze(-2) * dm).sum(-1))
        apart, p, h = self._apart(m, mean), self.mass, self._shares
        variance = self._spread(v, apart)
        of_v, of_m = p @ h.square(), 2.0 * (p * apart) @ h
        slope = (of_v.unsqueeze(-2) * dv).sum(-1) + (of_m.unsqueeze(-2) * dm).sum(-1)
        log_factor, by_x = (value.to(x.dtype) for value in self.noise.with_slope(x))
        share, local = self.weights, self.inflation * (2.0 * log_factor).exp()
        most = local * (share * self._wide(noisy)).sum(-1)
        steepest = local.unsqueeze(-1) * (share.unsqueeze(-2) * dv).sum(-1) + 2.0 * most.unsqueeze(-1) * by_x
        return MomentsWithJacobians(
            _only_of(x, mean),
            torch.minimum(variance, most),
            _only_of(x, jacobian),
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
        return _only_of(x, mean), deviation * self.noise.log_factor(x).exp().to(deviation)

    def _together(self, moments: Sequence[tuple[Tensor, Tensor]]) -> tuple[Tensor, Tensor, Tensor]:
        """Mean of all, deviation of y as the learners state it, and their means."""
        means, variances = self._stacked(moments)
        return self._mean(means), (self.weights * self._wide(variances)).sum(-1).sqrt(), finite(means)

    def _stacked(self, told: Iterable[Sequence[Tensor]]) -> list[Tensor]:
        """What each learner told, side by side in the last axis."""
        return [torch.stack(part, dim=-1).to(self.dtype) for part in zip(*told, strict=True)]

    # -- pieces ---------------------------------------------------------------------------------

    def _judged(
        self,
        x: Tensor,
        y: Tensor,
        mask: Tensor | None,
        moments: Sequence[tuple[Tensor, Tensor]],
        sooner: tuple[list, Tensor] | None,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Evidence, what is carried over, variance and tails after one sample per model.

        Args:
            moments: of the learners.
            sooner: what they and the experts said when x was expected: that is judged.

        Returns:
            The nis, and of the law before: its mean and typical deviation.
        """
        mean, deviation, means = self._together(moments)
        experts = said = self._of_learners(means) + self.carried
        if sooner is not None:
            _, deviation, then = self._together(sooner[0])
            said = self._of_learners(then) + sooner[1]
            mean = self.bounded((self.beliefs * said).sum(-1))
        deviation = deviation * self.noise.log_factor(x).exp().to(deviation)
        # what is carried over is cut by a scale in which outliers have little say; what experts are judged by
        # heeds the few large samples of a stream that mostly rests, too
        typical = self.tails.typical()
        judged_by = typical * (E.RMS_LEAST * self.inflation.sqrt() / typical).clamp(1.0, E.RMS_MOST)
        scale = (deviation * typical).unsqueeze(-1)
        far, judged_far = (_bounded((y.unsqueeze(-1) - each) / scale) for each in (experts, said))
        r = (judged_far * (typical / judged_by).unsqueeze(-1)).square()
        evidence = MEMORY * self.evidence - 0.5 * (E.FREEDOM + 1.0) * torch.log1p(r / E.FREEDOM)
        evidence = (evidence - evidence.amax(-1, keepdim=True)).clamp_min(E.LEAST)
        innovation = scale * far / (1.0 + (far / self._experts[4]).square())
        trend = E.TREND_DECAY * self.trend + self._experts[3] * innovation
        level = E.LEVEL_DECAY * self.level + self._experts[2] * innovation + trend
        sane = level.abs() <= E.FARTHEST * scale  # else it is of a time when y was another size
        trend, level = trend.where(sane, 0.0), level.where(sane, 0.0)
        z = _bounded((y - mean) / deviation)
        rate = (1.0 / (self.count - E.YOUNG + 2.0).clamp_min(1.0)).clamp_min(E.RATE).unsqueeze(-1)
        square = torch.minimum(z.square(), E.SQUARE_MOST * self.inflation)
        inflation = (self.inflation + rate * (square - self.inflation)).clamp_min(1e-12)
        news = {
            "evidence": evidence, "innovation": innovation, "level": level, "trend": trend,
            "inflation": inflation,
        }  # fmt: skip
        judged = self.count >= E.YOUNG
        if mask is not None:
            judged = judged & mask
        for name, value in news.items():
            buffer = self.get_buffer(name)
            on = judged[(..., *(None,) * (value.dim() - judged.dim()))]
            buffer.copy_(torch.where(on, value, buffer))
        nis = (z.square() / self.inflation).mean(-1)
        self.noise.observe(x, z / typical, judged)
        self.tails.observe(z, (self.count - E.YOUNG).clamp_min(0.0), judged)
        self.count += 1.0 if mask is None else mask.to(self.count.dtype)
        self._settle()
        return nis, mean, deviation * typical

    def _settle(self) -> None:
        """What queries need of the beliefs."""
        p, carried = (t.unflatten(-1, (*self.mass.shape[-2:], -1)) for t in (self.beliefs, self.carried))
        self.mass.copy_(p.sum(-1))
        self.shift.copy_((p * carried).sum(-1) / self.mass.clamp_min(torch.finfo(p.dtype).tiny))
        self.spread.copy_((p * (carried - self.shift.unsqueeze(-1)).square()).sum(-1))
        self.gain.copy_(self.mass @ self._shares)
        self.offset.copy_((self.mass * self.shift).sum((-2, -1)))


def _bounded(z: Tensor) -> Tensor:
    """Squares stay finite: larger errors add nothing."""
    return z.nan_to_num(E.FARTHEST).clamp(-E.FARTHEST, E.FARTHEST)


def _same_shapes(members: list[ResidualLearner]) -> ResidualLearner:
    if not members:
        raise ParameterError("learners", members, "at least one learner")
    if len({id(member) for member in members}) < len(members):
        raise ParameterError("learners", members, "learners of their own; the same one would learn twice")
    shapes = [(m.in_features, m.out_features, tuple(m.batch_shape)) for m in members]
    if len(set(shapes)) > 1:
        raise ParameterError("learners", shapes, "of the same (in_features, out_features, batch_shape)")
    return members[0]


def _only_of(x: Tensor, told: Tensor) -> Tensor:
    """Means or slopes, NaN where an input is: no learner is finite, and the model alone is no answer."""
    lost = x.isnan().any(-1)
    return told.where(~lost.reshape(*lost.shape, *(1,) * (told.dim() - lost.dim())), torch.nan)


def finite(values: Tensor) -> Tensor:
    """A learner that is not finite has no say: what it says counts as 0, the model alone."""
    return values.nan_to_num(0.0, 0.0, 0.0)
