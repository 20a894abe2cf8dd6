"""Object memory: one learner per object, taken up again when its object comes back, without labels."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import nn
from torch.distributions import Normal, StudentT

from ..exceptions import ParameterError
from ..residual import ResidualLearner, SparseOnlineGP, UpdateEvent, UpdateReport
from ..typing import Float, Tensor

_LEAST = 3  # samples without which an episode says nothing
_PRUNE = math.log(1e-4)  # hypotheses less probable than this are dropped for the rest of an episode
_SCALE_RATE = 0.02


class ModelBank(ResidualLearner):
    r"""Which of the known objects is this, or is it a new one?

    ::

        log p(m | y_1..t) = log p(m) + tau sum_i log p(y_i | x_i, y_1..i-1, m) + const
        p(new) = nu / (nu + n_episodes),    p(m) = (1 - p(new)) / n_models

    An *episode* is one grasp: the hand knows that it grasps anew (:meth:`begin`), not what. Each
    hypothesis learns along during the first ``window`` samples, so its sum is the exact evidence of
    its model for the episode; the best one predicts. Then the best one goes on alone, and when the
    episode ends it replaces the model it began as, or becomes a new one.

    "New" starts from what is common: a learner of all objects whose information is multiplied by a
    weight. It predicts the same and is less sure of it: for a familiar object it loses to the model
    that was sure and right, for an unfamiliar one it wins against all that are sure and wrong. How much
    objects have in common nobody knows beforehand, so each of ``common_weights`` is a hypothesis, down
    to 0, the empty learner. No threshold decides, only the evidence.

    To a controller it is a learner like any other. Residuals have heavier tails than a Gaussian, and
    a learner's noise is rarely right: densities are Student's (4 degrees of freedom), with a scale
    per output that is learned from the chosen model's innovations.

    Args:
        factory: makes an empty learner; all hypotheses are copies of what it returns.
        models: largest number of objects. Once they are there, nothing is new any more.
        window: samples in which an object is recognised.
        new_prior: nu, the weight of "new" in episodes.
        temperature: tau in (0, 1]; below 1 since the samples of one grasp are not independent.
        common_weights: shares of the common learner's information that a new model may start with.
        soften: multiplies a learner's information by a share in place; :func:`discount` by default.

    Raises:
        ParameterError: a figure outside its range, or the factory's learners are a fleet.
    """

    episodes: Tensor
    log_prior: Tensor
    log_evidence: Tensor
    seen: Tensor
    leader: Tensor
    scale: Tensor

    def __init__(
        self,
        factory: Callable[[], ResidualLearner],
        models: int = 8,
        *,
        window: int = 16,
        new_prior: float = 0.3,
        temperature: float = 0.5,
        common_weights: Sequence[float] = (0.1, 0.01, 0.0),
        soften: Callable[[ResidualLearner, float], None] | None = None,
    ) -> None:
        first = factory()
        if first.batch_shape:
            raise ParameterError("factory", tuple(first.batch_shape), "learners with batch_shape ()")
        super().__init__(first.in_features, first.out_features, dtype=first.dtype, device=first.device)
        for name, value in (("models", models), ("window", window)):
            if value < 1:
                raise ParameterError(name, value, "at least 1")
        if not 0 < temperature <= 1:
            raise ParameterError("temperature", temperature, "in (0, 1]")
        if not common_weights or not all(0 <= weight <= 1 for weight in common_weights):
            raise ParameterError("common_weights", common_weights, "one or more shares in [0, 1]")
        if not new_prior > 0:
            raise ParameterError("new_prior", new_prior, "positive")
        self.models, self.window, self.new_prior = models, window, new_prior
        self.temperature, self.common_weights = temperature, tuple(common_weights)
        self._soften = discount if soften is None else soften
        self.common = first
        self.kept = nn.ModuleList(copy.deepcopy(first) for _ in range(models))
        hypotheses = models + len(self.common_weights)  # the last ones: "new"
        self.trial = nn.ModuleList(copy.deepcopy(first) for _ in range(hypotheses))
        device = self.device
        self.register_buffer("episodes", torch.zeros(models, dtype=torch.int64, device=device))
        for name in ("log_prior", "log_evidence"):
            self.register_buffer(name, torch.zeros(hypotheses, dtype=torch.float64, device=device))
        for name in ("seen", "leader"):
            self.register_buffer(name, torch.zeros((), dtype=torch.int64, device=device))
        self.register_buffer("scale", self._like.new_ones(self.out_features))
        self._open()

    # -- episodes -----------------------------------------------------------------------------------

    @property
    def n_models(self) -> int:
        """Objects known so far."""
        return int((self.episodes > 0).sum())

    @property
    def posterior(self) -> Float[Tensor, " models_and_new"]:
        """Probability of each known model, and last that of a new one."""
        p = (self.log_prior + self.log_evidence).softmax(0)
        return torch.cat([p[: self.models], p[self.models :].sum(0, keepdim=True)])

    @torch.no_grad()
    def begin(self) -> int | None:
        """A new grasp: keep what the last episode learned, and ask anew which object this is.

        Returns:
            The model to which the last episode went; None if it was too short to tell.
        """
        kept = self._keep()
        self._open()
        return kept

    def _open(self) -> None:
        new, known = self.models, self.episodes > 0
        n = self.n_models
        share = self.new_prior / (self.new_prior + float(self.episodes.sum()))
        share = 1.0 if n == 0 else 0.0 if n == self.models else share
        self.log_prior.fill_(-math.inf)
        if n:
            self.log_prior[:new][known] = math.log((1 - share) / n)
        if share:
            self.log_prior[new:] = math.log(share / len(self.common_weights))
        self.log_evidence.zero_()
        self.seen.zero_()
        for i in torch.nonzero(known).flatten().tolist():
            _copy(self.kept[i], self.trial[i])
        for i, weight in enumerate(self.common_weights, start=new):
            if weight > 0:
                _copy(self.common, self.trial[i])
                self._soften(self._trial(i), weight)
            else:
                self._trial(i).reset()
        self.leader.copy_(self.log_prior.argmax())

    def _keep(self) -> int | None:
        if self.seen < _LEAST:
            return None
        best = slot = int(self.leader)
        if best >= self.models:
            slot = int(torch.nonzero(self.episodes == 0)[0])  # "new" has no prior when none is free
        _copy(self.trial[best], self.kept[slot])
        self.episodes[slot] += 1
        return slot

    # -- a learner like any other ---------------------------------------------------------------------

    @property
    def working(self) -> ResidualLearner:
        """The hypothesis that predicts."""
        return self._trial(int(self.leader))

    def forward(self, x: Tensor) -> Tensor:
        """Mean of the leading hypothesis."""
        return self.working(x)

    def predict(self, x: Tensor, *, observation: bool = False) -> Normal:
        """Its law."""
        return self.working.predict(x, observation=observation)

    def linearize(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Its mean and slope."""
        return self.working.linearize(x)

    @torch.no_grad()
    def reset(self) -> None:
        """Forget all objects."""
        for learner in (self.common, *self.kept, *self.trial):
            _learner(learner).reset()
        self.episodes.zero_()
        self.scale.fill_(1.0)
        self.n_refused.zero_()
        self._open()

    def _absorb(self, x: Tensor, y: Tensor, mask: Tensor | None) -> UpdateReport:
        if mask is not None and not bool(mask):
            zero = torch.zeros_like(y[..., 0])
            return UpdateReport(
                torch.full_like(mask, UpdateEvent.REFUSED, dtype=torch.int64), zero, zero, zero
            )
        leader, choosing = int(self.leader), int(self.seen) < self.window
        reports: dict[int, UpdateReport] = {}
        for i in self._candidates() if choosing else [leader]:
            hypothesis = self._trial(i)
            law = hypothesis.predict(x, observation=True)
            if choosing:
                density = StudentT(4.0, law.mean, law.stddev * self.scale).log_prob(y).sum(-1)
                self.log_evidence[i] += self.temperature * density.double()
            else:  # only of a model that was chosen: the errors of a wrong one say nothing of noise
                z2 = ((y - law.mean) / law.stddev).square().clamp_max(25.0)  # one slip must not widen it
                self.scale.copy_((self.scale.square().lerp(z2, _SCALE_RATE)).sqrt())
            reports[i] = hypothesis.update(x, y)
        self.common.update(x, y)
        self.seen += 1
        if choosing:
            self.leader.copy_((self.log_prior + self.log_evidence).argmax())
        return reports[leader]

    def _candidates(self) -> list[int]:
        """Hypotheses worth following; one that is dropped falls behind and stays dropped."""
        log_posterior = (self.log_prior + self.log_evidence).log_softmax(0)
        dropped = log_posterior < _PRUNE
        self.log_prior[dropped] = -math.inf
        return torch.nonzero(~dropped).flatten().tolist()

    def _trial(self, i: int) -> ResidualLearner:
        return _learner(self.trial[i])

    def extra_repr(self) -> str:
        """One line for ``print(bank)``."""
        return f"{super().extra_repr()}, models={self.models}, known={self.n_models}"


def discount(learner: ResidualLearner, share: float) -> None:
    """Multiply what a learner knows by ``share``: about the same mean, ``1 / share`` times the variance.

    A :class:`SparseOnlineGP` holds its knowledge as information and can be discounted exactly; any
    other learner is left as it is (give :class:`ModelBank` a ``soften`` of your own).
    """
    if isinstance(learner, SparseOnlineGP):
        learner.refresh()  # forgetting that is due comes first
        learner.posterior.precision.mul_(share)
        learner.posterior.information.mul_(share)
        learner.refresh()


def _copy(source: nn.Module, target: nn.Module) -> None:
    state: dict[str, Any] = source.state_dict()
    target.load_state_dict(state)


def _learner(module: nn.Module) -> ResidualLearner:
    assert isinstance(module, ResidualLearner)
    return module
