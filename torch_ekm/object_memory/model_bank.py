"""Object memory: one learner per object, taken up again when its object comes back, without labels."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from typing import Any, ClassVar

import torch
from torch import nn
from torch.distributions import Normal, StudentT

from .._checks import check_count, check_finite, check_fraction
from ..exceptions import ParameterError, ShapeError
from ..residual import ResidualLearner, SparseOnlineGP, UpdateReport
from ..residual.base import SingleLearner
from ..typing import Float, Tensor
from .episode_memory import EpisodeMemory
from .signature_model import SignatureModel

_LEAST = 3  # samples without which an episode says nothing
_PRUNE = math.log(1e-4)  # hypotheses less probable than this are dropped for the rest of an episode
_SCALE_RATE = 0.02
_TRUST, _FADE = 0.1, 0.9  # what one sample says of leader and common learner, and how fast that fades
_SAMPLES = 64  # remembered of an episode
_REMEMBERED = 96  # grasps, with their signatures and samples
_NEW_PRIOR = 0.3  # nu, the weight of "new" in episodes
_COMMON_WEIGHTS = (0.1, 0.01, 0.0)  # shares of the common learner's information that a new model starts with


class ModelBank(SingleLearner):
    r"""Which of the known objects is this, or is it a new one?

    ::

        log p(m | z, y_1..t) = log p(m | z) + tau sum_i log p(y_i | x_i, y_1..i-1, m) + const
        p(new) = nu / (nu + n_episodes),    p(m) = (1 - p(new)) / n_models         without a signature z

    An *episode* is one grasp: the hand knows that it grasps again (:meth:`begin`), not what. Each
    hypothesis learns along during the first ``window`` samples, so its sum is the exact evidence of
    its model for the episode; the best one leads. Then the leader goes on alone, and when the
    episode ends it replaces the model it began as, or becomes a new one.

    What objects have in common is best known to the learner of all of them, what is special to the
    leader. The bank predicts with both, weighed by how well each predicted lately::

        g(x) = p g_leader(x) + (1 - p) g_common(x)
        logit p <- 0.9 logit p + 0.1 log(p_leader(y) / p_common(y))

    so where objects differ little it is as good as one model of all, and where they differ much about
    as good as a model of each.

    Different objects may answer alike, and then residuals do not distinguish them. With a *signature* z,
    the readings of the grasp before the first motion (:class:`GraspSignature`), recognition begins with
    ``p(m | z)`` of a mixture (:class:`SignatureModel`). The first grasps say little of how far apart objects
    are; so the grasps of the past are remembered, and whenever an episode ends they are sorted again in the
    light of all of them. Models whose grasps changed are learned again from their samples.

    "New" starts from what is common: a learner of all objects whose information is multiplied by a
    weight. It predicts the same and is less sure of it: for a familiar object it loses to the model
    that was sure and right, for an unfamiliar one it wins against all that are sure and wrong. How much
    objects have in common nobody knows beforehand, so each of three weights is a hypothesis, down
    to 0, the empty learner. No threshold decides, only the evidence.

    To a controller it is a learner like any other. Residuals have heavier tails than a Gaussian, and
    a learner's noise is rarely right: densities are Student's (4 degrees of freedom), with a scale
    per output that is learned from the chosen model's innovations.

    Args:
        factory: makes an empty learner; all hypotheses are copies of what it returns.
        models: largest number of objects. Once they are there, nothing is new any more.
        window: samples in which an object is recognised.
        temperature: tau in (0, 1]; below 1 since the samples of one grasp are not independent.
        signature_features: width of z; 0: grasps have no signature.

    Raises:
        ParameterError: a figure outside its range, or the factory's learners are a fleet.
    """

    unbounded: ClassVar[tuple[str, ...]] = ("log_prior", "log_evidence", "lead")
    """Entries of a state that may be infinite."""

    def __init__(
        self,
        factory: Callable[[], ResidualLearner],
        models: int = 8,
        *,
        window: int = 16,
        temperature: float = 0.5,
        signature_features: int = 0,
    ) -> None:
        first = factory()
        like: dict[str, Any] = {"dtype": first.dtype, "device": first.device}
        super().__init__(first.in_features, first.out_features, batch_shape=first.batch_shape, **like)
        self.models, self.window = check_count("models", models), check_count("window", window)
        check_count("signature_features", signature_features, least=0)
        self.temperature = check_fraction("temperature", temperature)
        self.common = first
        self.kept: Any = nn.ModuleList(copy.deepcopy(first) for _ in range(models))
        hypotheses = models + len(_COMMON_WEIGHTS)  # the last ones: "new"
        self.trial: Any = nn.ModuleList(copy.deepcopy(first) for _ in range(hypotheses))
        zeros = self._like.new_zeros
        self.episodes = nn.Buffer(zeros(models, dtype=torch.int64))
        self.log_prior = nn.Buffer(zeros(hypotheses, dtype=torch.float64))
        self.log_evidence = nn.Buffer(zeros(hypotheses, dtype=torch.float64))
        self.seen = nn.Buffer(zeros((), dtype=torch.int64))
        self.leader = nn.Buffer(zeros((), dtype=torch.int64))
        self.scale = nn.Buffer(self._like.new_ones(self.out_features))
        self.lead = nn.Buffer(zeros((), dtype=torch.float64))  # logit p
        self.signatures = SignatureModel()
        self.memory: EpisodeMemory | None = None
        if signature_features:
            # with fewer a model might lose the last grasp by which it is known
            grasps = max(_REMEMBERED, models + 1)
            self.memory = EpisodeMemory(first, models, signature_features, grasps, _SAMPLES)
        self.signed = nn.Buffer(zeros((), dtype=torch.bool))
        self._open(None)

    # -- episodes -----------------------------------------------------------------------------------

    @property
    def n_models(self) -> int:
        """How many models of objects there are."""
        return int((self.episodes > 0).sum())

    @property
    def posterior(self) -> Float[Tensor, " models_and_new"]:
        """Probability of each known model, and last that of a new one."""
        p = (self.log_prior + self.log_evidence).softmax(0)
        return torch.cat([p[: self.models], p[self.models :].sum(0, keepdim=True)])

    @torch.no_grad()
    def begin(self, signature: Float[Tensor, " d"] | None = None) -> int | None:
        """A new grasp: keep what the last episode learned, and ask again which object this is.

        Args:
            signature: the readings of the grasp, for a bank with ``signature_features``.

        Returns:
            The model to which the last episode went; None if it was too short to say.

        Raises:
            ParameterError, ShapeError, NonFiniteError: the signature is missing, not wanted, or cannot be
                right; nothing was changed.
        """
        self._check_signature(signature)
        kept = self._keep()
        self._open(signature)
        return kept

    @torch.no_grad()
    def end(self) -> int | None:
        """Keep what the last episode learned; the next one is yet to :meth:`begin`."""
        kept = self._keep()
        self._open(None)
        return kept

    def _check_signature(self, signature: Tensor | None) -> None:
        if self.memory is None:
            if signature is not None:
                raise ParameterError("signature", "given", "None for a bank without signature_features")
            return
        width = self.memory.signature.shape[-1]
        if signature is None:
            raise ParameterError("signature", None, f"a tensor of shape ({width},) for this bank")
        if signature.shape != (width,):
            raise ShapeError("signature", f"({width},)", signature.shape)
        check_finite("signature", signature)

    def _open(self, signature: Tensor | None) -> None:
        new, known = self.models, self.episodes > 0
        self.log_prior.fill_(-math.inf)
        self.signed.fill_(signature is not None)
        if self.memory is not None and signature is not None:
            rows = self.memory.known
            past, label = self.memory.signature[rows], self.memory.label[rows]
            self.memory.open(signature)
            p = self.signatures.log_posterior(signature.to(past), past, label, new)
            self.log_prior[:new][known] = p[known]
            free = p[~known].logsumexp(0) if not bool(known.all()) else p.new_tensor(-math.inf)
            self.log_prior[new:] = free - math.log(len(_COMMON_WEIGHTS))
        else:
            n = self.n_models
            share = _NEW_PRIOR / (_NEW_PRIOR + float(self.episodes.sum()))
            share = 1.0 if n == 0 else 0.0 if n == self.models else share
            if n:
                self.log_prior[:new][known] = math.log((1 - share) / n)
            if share:
                self.log_prior[new:] = math.log(share / len(_COMMON_WEIGHTS))
        self.log_evidence.zero_()
        self.seen.zero_()
        for i in torch.nonzero(known).flatten().tolist():
            self.trial[i].load_state_dict(self.kept[i].state_dict())
        for i, weight in enumerate(_COMMON_WEIGHTS, start=new):
            self._begin_new(self.trial[i], weight)
        self.leader.copy_(self.log_prior.argmax())

    def _begin_new(self, learner: ResidualLearner, weight: float) -> None:
        if weight > 0:
            learner.load_state_dict(self.common.state_dict())
            discount(learner, weight)
        else:
            learner.reset()

    def _keep(self) -> int | None:
        if self.seen < _LEAST or (self.memory is not None and not self.signed):
            return None
        best = slot = int(self.leader)
        if best >= self.models:
            slot = int(torch.nonzero(self.episodes == 0)[0])  # "new" has no prior when none is free
        self.kept[slot].load_state_dict(self.trial[best].state_dict())
        self.episodes[slot] += 1
        if self.memory is None:
            return slot
        evidence = self.log_evidence[: self.models].clone()
        weights = math.log(len(_COMMON_WEIGHTS))
        evidence[self.episodes == 0] = self.log_evidence[self.models :].logsumexp(0) - weights
        evidence[slot] = self.log_evidence[best]
        row = self.memory.keep(slot, evidence)
        self._sort_memory(self.memory)
        return int(self.memory.label[row])

    def _sort_memory(self, memory: EpisodeMemory) -> None:
        """See all grasps in the light of the last one, and learn again what had been confused."""
        rows = memory.known
        before = memory.label[rows].clone()
        after = self.signatures.sort(memory.signature[rows], before, self.models, memory.evidence[rows])
        moved = after != before
        memory.label[rows] = after
        for slot in set(before[moved].tolist()) | set(after[moved].tolist()):
            self.episodes[slot] += int((after == slot).sum() - (before == slot).sum())
            self._begin_new(self.kept[slot], min(_COMMON_WEIGHTS))
            memory.replay(slot, self.kept[slot])

    # -- a learner like any other ---------------------------------------------------------------------

    @property
    def working(self) -> ResidualLearner:
        """The model, known or new, with the largest evidence so far."""
        return self.trial[int(self.leader)]

    def forward(self, x: Tensor) -> Tensor:
        """Mean of the leading hypothesis and the common learner."""
        return self._mix(self.working(x), self.common(x))

    def predict(self, x: Tensor, *, observation: bool = False) -> Normal:
        """Mean and variance of the mixture of their laws."""
        ours, theirs = (g.predict(x, observation=observation) for g in (self.working, self.common))
        p = self.lead.sigmoid()
        apart = (p * (1 - p) * (ours.mean - theirs.mean).square()).to(self.dtype)
        variance = self._mix(ours.variance, theirs.variance) + apart
        return Normal(self._mix(ours.mean, theirs.mean), variance.sqrt(), validate_args=False)

    def linearize(self, x: Tensor) -> tuple[Tensor, Tensor]:
        ours, theirs = self.working.linearize(x), self.common.linearize(x)
        return self._mix(ours[0], theirs[0]), self._mix(ours[1], theirs[1])

    def _mix(self, ours: Tensor, theirs: Tensor) -> Tensor:
        return torch.lerp(theirs, ours, self.lead.sigmoid().to(ours.dtype))

    @torch.no_grad()
    def reset(self) -> None:
        """Forget the models of all objects and the signatures of all grasps."""
        for learner in (self.common, *self.kept, *self.trial):
            learner.reset()
        super().reset()
        self.scale.fill_(1.0)
        if self.memory is not None:
            self.memory.reset()
        self._open(None)

    def absorb(self, x: Tensor, y: Tensor, mask: Tensor | None) -> UpdateReport:
        leader, choosing = int(self.leader), int(self.seen) < self.window
        reports: dict[int, UpdateReport] = {}
        density = torch.zeros_like(self.log_evidence)
        followed = self._candidates() if choosing else [leader]
        for i in followed:
            hypothesis = self.trial[i]
            law = hypothesis.predict(x, observation=True)
            density[i] = self._log_density(law, y)
            if not choosing:
                # only of a model that was chosen: the errors of a wrong one say nothing of noise
                z2 = ((y - law.mean) / law.stddev).square().clamp_max(25.0)  # one slip must not widen it
                self.scale.copy_((self.scale.square().lerp(z2, _SCALE_RATE)).sqrt())
            reports[i] = hypothesis.update(x, y)
        better = density[leader] - self._log_density(self.common.predict(x, observation=True), y)
        self.lead.mul_(_FADE).add_(_TRUST * better)
        self.common.update(x, y)
        if self.memory is not None:
            self.memory.note(x, y)
        self.seen += 1
        if choosing:
            # those that are not followed keep their distance to the leader
            gone = torch.ones_like(density, dtype=torch.bool)
            gone[followed] = False
            density[gone] = float(density[leader])
            self.log_evidence += self.temperature * density
            self.leader.copy_((self.log_prior + self.log_evidence).argmax())
        return reports[leader]

    def _log_density(self, law: Normal, y: Tensor) -> Tensor:
        return StudentT(4.0, law.mean, law.stddev * self.scale).log_prob(y).sum(-1)

    def _candidates(self) -> list[int]:
        """Hypotheses worth following; one that is dropped falls behind and stays dropped."""
        log_posterior = (self.log_prior + self.log_evidence).log_softmax(0)
        dropped = log_posterior < _PRUNE
        self.log_prior[dropped] = -math.inf
        return torch.nonzero(~dropped).flatten().tolist()

    def extra_repr(self) -> str:
        return f"{super().extra_repr()}, models={self.models}, known={self.n_models}"


def discount(learner: ResidualLearner, share: float) -> None:
    """Multiply what a learner knows by ``share``: about the same mean, ``1 / share`` times the variance.

    A :class:`SparseOnlineGP` holds its knowledge as information and can be discounted exactly; any
    other learner is left as it is.
    """
    if isinstance(learner, SparseOnlineGP):
        learner.refresh()  # forgetting that is due comes first
        learner.posterior.precision.mul_(share)
        learner.posterior.information.mul_(share)
        learner.refresh()
