"""Kernel and noise, learned online in constant memory: the state of k samples ago predicts the last k."""

from __future__ import annotations

import copy
import math
from typing import Any, NamedTuple

import torch
from torch import nn

from ..._checks import check_count, check_positive
from ...exceptions import ParameterError
from ...typing import Bool, Float, Tensor
from ..adam import Adam
from ..kernels.kernel import Kernel
from ..recent import Recent
from .forgetting import ForgettingFactor, ProcessNoise
from .monitor import RobustWeight
from .part import Host, Part
from .posterior import SparsePosterior
from .units import Standardize

_REPLAYED = 4  # samples of the memory per sample of the window, in each step
BETAS = 0.9, 0.99  # of Adam
# Adam's first step on parameters that are no logarithms: a deep kernel's weights
NETWORK_RATE = 0.015
# the part of these that goes with each step, times the noise's share of y (and shrinking as steps do):
# features of noise do not stay (decoupled as in Loshchilov & Hutter, ICLR 2019)
NETWORK_DECAY = 0.25
LEAST, LEAST_NOISE, MOST = -7.0, -14.0, 7.0  # of logarithms: far beyond what standardised data can mean
#: of its samples after which the parts of a step end; the first is one of its own where caches are made, too
PARTS = 0.1, 0.6, 1.0
_SHORT = 8  # samples between two rebuilds from which on a step leaves the last one out


class Queries(NamedTuple):
    """What is predicted, in the units of the snapshot: the window, then what was seen before."""

    x: Float[Tensor, "*batch n in"]
    y: Float[Tensor, "*batch n out"]
    weight: Float[Tensor, "*batch n"]
    absorbed: Float[Tensor, " n"]  # 1: part of the state, to be left out of it
    age: Float[Tensor, " n"]  # samples since then


class PrequentialLoss(nn.Module):
    """A state of the past, and how well it predicts samples with other hyperparameters theta::

        loss(theta) = mean_t -log p(y_t | x_t, (Omega, h), theta)

    (Omega, h) holds neither kernel nor noise, so its prediction is an exact function of theta. Samples that
    the state has seen are each left out of it in closed form. With ``u = k'Qk`` the prior variance of the
    basis' prediction of the sample, p its posterior variance and w what is left of its weight in the state
    (Rasmussen & Williams 2006, section 5.4.2, for a sparse model)::

        residual <- c residual,  p <- c p,   c = 1 / (1 - w p/s2), at most u/p

    since without any sample p would be u. That is honest only where noise is fresh at each sample: where it
    is carried from one to the next, the neighbours in time still hold the one left out.

    Gradients need no differentiation of a factorisation: to first order in a change dK and in that of ln s2
    the caches become::

        alpha + C dK alpha - dln s2 (alpha + C K alpha),   C + C dK C - dln s2 (C + C K C),   Q - Q dK Q

    Args:
        posterior: whose copy is the state.
        forgetting_factor: on what the state holds, per sample.
        robust: c; the Gaussian density becomes a Student t with ``c^2`` degrees of freedom, whose influence
            is bounded like the robust update's. None: Gaussian.
    """

    def __init__(self, posterior: SparsePosterior, forgetting_factor: float, robust: float | None) -> None:
        super().__init__()
        self.state = copy.deepcopy(posterior)
        self.forgetting_factor, self.robust = forgetting_factor, robust

    def snapshot(self, posterior: SparsePosterior) -> None:
        """The present state becomes the past one."""
        own = self.state.buffers(recurse=False), posterior.buffers(recurse=False)
        for old, new in zip(*own, strict=True):
            old.copy_(new)

    def forward(self, kernel: Kernel, log_noise: Tensor, queries: Queries, *, anew: bool = False) -> Tensor:
        """Loss of each model ``(*batch_shape)`` [nats per sample and output], for autograd to go through.

        The derivatives are those at the values by which the old state's caches were made, or, with ``anew``,
        are made here.
        """
        state, log_s2 = self.state, log_noise.mean(-1)
        if anew:
            state.rebuild(kernel, log_s2.exp())
        gram = state.gram(kernel)
        K = gram.detach()
        alpha, (C, Q) = state.alpha, state.moments[..., :2, :, :].unbind(-3)
        dK, d, CK = gram - K, (log_s2 - log_s2.detach())[..., None, None], C @ K
        alpha, C, Q = (
            alpha + C @ (dK @ alpha) - d * (alpha + CK @ alpha),
            C + C @ dK @ C - d * (C + CK @ C),
            Q - Q @ dK @ Q,
        )
        k = kernel(state.basis, queries.x)  # rows of free slots are 0 in all of these
        kCk, u = ((A @ k * k).sum(-2) for A in (C, Q))
        v = kernel.diagonal_of_set(queries.x) + kCk
        return self._density(k.mT @ alpha, v, u + kCk, u, log_noise, queries)

    def _density(
        self, mean: Tensor, v: Tensor, p: Tensor, u: Tensor, log_noise: Tensor, queries: Queries
    ) -> Tensor:
        """The loss from the state's predictions."""
        s2, noise = log_noise.mean(-1, keepdim=True).exp(), log_noise.exp().unsqueeze(-2)
        on, tiny = queries.weight, torch.finfo(p.dtype).tiny
        # c: what residual and p of each query grow by once it is left out of the state
        held = queries.absorbed * on * self.forgetting_factor**queries.age / s2
        exact = 1.0 / (1.0 - held * p).clamp_min(torch.finfo(p.dtype).eps)
        most = (u / p.clamp_min(tiny)).clamp_min(1.0)
        c = torch.where(exact > most, most, exact)
        variance = (v + p * (c - 1.0)).clamp_min(0.0).unsqueeze(-1) + noise
        z2, robust = ((queries.y - mean) * c.unsqueeze(-1)).square() / variance, self.robust
        misfit = z2 if robust is None else (robust**2 + 1.0) * torch.log1p(z2 / robust**2)
        share = on / on.sum(-1, keepdim=True).clamp_min(tiny)
        return (0.5 * (misfit + variance.log() + math.log(2 * math.pi)).mean(-1) * share).sum(-1)


class LearnHyperparameters(Part):
    """Descends the lagged prequential loss in the kernel's and the noise's parameters theta::

        loss(theta) = mean_t -log p(y_t | x_t, (Omega, h)_{t0}, theta),   t = t0+1 .. t0+k

    before every rebuild of the caches, k = ``refresh_every``, less the last sample: of one model a step is
    made in parts, each with another sample. The k samples were not seen by the state of k
    samples ago, so the loss cannot be won by overfitting (:class:`PrequentialLoss`). Memory: one copy of the
    state and k samples. The streaming variational bound needs as much and is a worse objective: it inflates
    the noise.

    With a memory, each step predicts 4 k samples of the past too, others in each, so that a network with
    thousands of weights does not run after the last k. The state has seen them; each is left out of it in
    closed form.

    Steps shrink like ``1 / sqrt(1 + n/30)``, to a tenth at most: the state was projected with a kernel
    that every later move makes a little wrong, so late moves must earn more than early ones; a system
    that changes is still followed.

    It stands last among the parts: it asks those before it what they do with a sample.

    Args:
        rate: Adam's first step on the logarithms of the hyperparameters.
        steps: gradient steps per rebuild, spread over the samples up to it; each starts where those before
            lead.
        memory: samples of the past to learn from, too (at least 32); 0: the last k only. Not with
            :class:`ProcessNoise`: where g wanders the past is another g.

    Raises:
        ParameterError: a figure is outside its range.
    """

    stands_last = True

    def __init__(self, *, rate: float = 0.03, steps: int = 1, memory: int = 0) -> None:
        super().__init__()
        self.rate = check_positive("rate", rate)
        self.steps, self.memory = check_count("steps", steps), check_count("memory", memory, least=0)

    def bind(self, learner: Host) -> None:
        """A window, a copy of the state and of the parameters, Adam's moments and a memory."""
        if self.memory and learner.part(ProcessNoise) is not None:
            valid = "0 with ProcessNoise: the past is that of another g"
            raise ParameterError("memory of LearnHyperparameters", self.memory, valid)
        fading, weight = learner.part(ForgettingFactor), learner.part(RobustWeight)
        factor = 1.0 if fading is None else fading.factor
        posterior, like = learner.posterior, learner.posterior.basis
        fleet, self.window = posterior.batch_shape, learner.refresh_every
        self.lead = int(self.window >= _SHORT)
        self.n_steps = nn.Buffer(like.new_zeros(fleet))
        self.loss = PrequentialLoss(posterior, factor, None if weight is None else weight.threshold)
        # where steps lead to; kernel and noise follow at the next rebuild: until then the caches are theirs
        self.kernel = copy.deepcopy(learner.kernel).requires_grad_(False)
        self.log_noise = nn.Buffer(learner.log_noise_variance.detach().clone())
        self.adam = Adam(self.ahead().values(), betas=BETAS)
        # no more than what a learner remembers that forgets
        known = self.memory if factor == 1.0 else min(self.memory, math.ceil(1.0 / (1.0 - factor)))
        size = max(self.window + self.lead, known, learner.recent.capacity)
        fleet = {"batch_shape": fleet, "dtype": like.dtype, "device": like.device}
        learner.recent = Recent(learner.in_features, learner.out_features, size, **fleet)
        self._leads = False
        #: samples that the past state has seen; changes of it, and of where steps begin
        self.since = 0, 0

    def act(self, learner: Host) -> None:
        """Descend, and move the parameters, when it is time."""
        n = learner.n_samples + 1
        if self._is_due(learner, n):
            self.descend(learner)
        elif learner.engine is not None and self.lead and self.memory:
            for ahead, end in enumerate(PARTS[-2::-1], 1):  # a large step in parts
                if (ahead == 1 or self._leads) and self._is_due(learner, n + ahead):
                    learner.engine.descend(learner, self, n + ahead, end)
        if self._leads and learner.is_due(n):
            for ahead, p in self.pairs(learner):
                p.copy_(ahead)
            self._leads = False

    def _is_due(self, learner: Host, n: int) -> bool:
        """Whether there is a step after n samples."""
        place, window = (n + self.lead - learner.refresh_offset - 1) % self.window, self.window
        if place == window - 1:
            return learner.is_due(n + self.lead)
        return (place + 1) * self.steps // window > place * self.steps // window

    def after_rebuild(self, learner: Host) -> None:
        """The present state becomes the past one, which has seen all samples so far."""
        self.loss.snapshot(learner.posterior)
        units = learner.part(Standardize)  # new ones while they are rough: steps still lead where they led
        self._begin(learner.n_samples, self._leads and units is not None and units.is_rough(learner))

    def _begin(self, n_rebuilt: int, leads: bool = False) -> None:
        vars(self).update(since=(n_rebuilt, self.since[1] + 1), _leads=leads)  # see count_sample

    def forget(self, models: Bool[Tensor, "*batch"]) -> None:
        """These models face another system: the state of the old one does not count."""
        self.loss.state.forget(models)
        self._begin(self.since[0], self._leads)

    def reset(self) -> None:
        """Forget snapshot and step sizes."""
        self.n_steps.zero_()
        self.adam.reset()
        self.loss.state.reset()
        self._begin(0)

    def get_extra_state(self) -> dict[str, Any]:
        """Samples that the past state has seen, and whether steps lead away from it."""
        return {"n_rebuilt": self.since[0], "leads": self._leads}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        self._begin(int(state["n_rebuilt"]), bool(state["leads"]))

    def queries(self, learner: Host, n: int) -> Queries:
        """Of n samples those since the past state, and this turn's part of those that it has seen."""
        recent = learner.recent
        x, y, _, weight = recent.last(n, min(max(n - self.since[0], 0), self.window))
        absorbed = age = x.new_zeros(x.shape[-2])
        if self.memory:
            x_past, y_past, weight_past, age_past = recent.take(n, self.replayed())
            seen = (age_past > n - self.since[0]).to(age_past.dtype)
            x, y = torch.cat([x, x_past], dim=-2), torch.cat([y, y_past], dim=-2)
            seen = seen * (age_past < recent.capacity)  # the oldest one's place may be taken
            weight = torch.cat([weight, weight_past * seen], dim=-1)
            absorbed, age = torch.cat([absorbed, torch.ones_like(age_past)]), torch.cat([age, age_past])
        return Queries(*learner.units.of_sets(x, y), weight, absorbed, age)

    def replayed(self) -> int:
        """Samples of the memory in a step."""
        return _REPLAYED * self.window if self.memory else 0

    def theta(self, learner: Host) -> dict[str, Tensor]:
        """What is learned, by name."""
        return {**learner.kernel.hyperparameters(), "log_noise": learner.log_noise_variance}

    def ahead(self) -> dict[str, Tensor]:
        """Where steps lead to, by name."""
        return {**self.kernel.hyperparameters(), "log_noise": self.log_noise}

    def pairs(self, learner: Host) -> list[tuple[Tensor, Tensor]]:
        """Where steps lead to, and what is in use, of each parameter."""
        known = None if learner.engine is None else learner.engine.pairs(learner)
        return known or list(zip(self.ahead().values(), self.theta(learner).values(), strict=True))

    def start(self, learner: Host) -> bool:
        """Before a step: it starts where the last ones lead. Whether they lead away from the caches."""
        if not self._leads:
            for ahead, p in self.pairs(learner):
                ahead.copy_(p)
        return self._leads

    def descend(self, learner: Host) -> None:
        """A step of Adam on the loss, model by model; without samples or a finite gradient it stays."""
        n = learner.n_samples + 1
        if learner.engine is None or not learner.engine.descend(learner, self, n, PARTS[-1]):
            self._descend(learner, n)
        self._begin(self.since[0], True)

    def _descend(self, learner: Host, n: int) -> None:
        anew, queries = self.start(learner), self.queries(learner, n)
        kernel, log_noise = copy.deepcopy(self.kernel), self.log_noise.clone()
        parameters = [p.requires_grad_(True) for p in (*kernel.hyperparameters().values(), log_noise)]
        with torch.enable_grad():
            loss = self.loss(kernel, log_noise, queries, anew=anew).sum()
            gradients = torch.autograd.grad(loss, parameters, allow_unused=True)
        on = ((queries.weight * (1.0 - queries.absorbed)).sum(-1) > 0).to(self.n_steps.dtype)
        self.n_steps += on
        n_steps = self.n_steps.clamp_min(1.0)
        correction, decay = self.adam.correction(n_steps) * _shrink(n_steps), NETWORK_DECAY * _shrink(n_steps)
        decay = decay * on * self.log_noise.mean(-1).exp().clamp_max(1.0)
        for i, ((name, p), gradient) in enumerate(zip(self.ahead().items(), gradients, strict=True)):
            if gradient is None:
                continue
            logarithm = is_logarithm(name)
            good = gradient.isfinite() & (_spread(on, p) > 0)
            if not {"weights", "biases"}.isdisjoint(name.split(".")):  # of a network
                p.sub_(_spread(decay, p) * p)
            step = (self.rate if logarithm else NETWORK_RATE) * _spread(correction, p)
            self.adam.move(i, p, gradient.where(good, 0.0), step, good)
            if logarithm:
                p.clamp_(LEAST_NOISE if name == "log_noise" else LEAST, MOST)


def is_logarithm(name: str) -> bool:
    """Whether a parameter of that name is one; a network's are not."""
    return name.split(".")[-1].startswith("log_")


def _shrink(n: Tensor) -> Tensor:
    """Size of the n-th step relative to the first."""
    return (1.0 + n / 30.0).rsqrt().clamp_min(0.1)


def _spread(value: Float[Tensor, "*batch"], like: Tensor) -> Tensor:
    """A value per model against a parameter."""
    return value[(..., *(None,) * (like.dim() - value.dim()))]
