"""Kernel and noise, learned online in constant memory: the state of k samples ago predicts the last k."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import nn

from ..._checks import check_count, check_positive
from ...exceptions import ParameterError
from ...typing import Bool, Float, Tensor
from ..adam import Adam
from ..kernels.kernel import is_shared
from ..recent import Recent
from .forgetting import ForgettingFactor, ProcessNoise
from .monitor import RobustWeight
from .part import Host, Part
from .prequential_loss import PrequentialLoss, Queries

_REPLAYED = 4  # samples of the memory per sample of the window, in each step; at least as many as points
# Adam's first step on parameters that are no logarithms: a deep kernel's weights
_NETWORK_RATE = 0.015
# the part of these that goes with each step, times the noise's share of y (and shrinking as steps do):
# features of noise do not stay (decoupled as in Loshchilov & Hutter, ICLR 2019)
_NETWORK_DECAY = 0.25


class LearnHyperparameters(Part):
    """Descends the lagged prequential loss in the kernel's and the noise's parameters theta::

        loss(theta) = mean_t -log p(y_t | x_t, (Omega, h)_{t0}, theta),   t = t0+1 .. t0+k

    at every rebuild of the caches, k = ``refresh_every``. The k samples were not seen by the state of k
    samples ago, so the loss cannot be won by overfitting (:class:`PrequentialLoss`). Memory: one copy of the
    state and k samples. The streaming variational bound needs as much and is a worse objective: it inflates
    the noise.

    With a memory, each step predicts 4 k samples of the past too (as many as basis vectors, if these are
    more), so that a network with thousands of weights does not run after the last k. The state has seen
    them; each is left out of it in closed form.

    Steps shrink like ``1 / sqrt(1 + n/30)``, to a tenth at most: the state was projected with a kernel
    that every later move makes a little wrong, so late moves must earn more than early ones; a system
    that changes is still followed.

    It stands last among the parts: it asks those before it what they do with a sample.

    Args:
        rate: Adam's first step on the logarithms of the hyperparameters.
        steps: gradient steps per rebuild, spread over the samples up to it; the last one starts where the
            others lead.
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
        """A window, a copy of the state, Adam's moments and a memory."""
        if self.memory and learner.part(ProcessNoise) is not None:
            valid = "0 with ProcessNoise: the past is that of another g"
            raise ParameterError("memory of LearnHyperparameters", self.memory, valid)
        fading, weight = learner.part(ForgettingFactor), learner.part(RobustWeight)
        factor = 1.0 if fading is None else fading.factor
        posterior, like = learner.posterior, learner.posterior.basis
        fleet, self.window = posterior.batch_shape, learner.refresh_every
        self.shared_kernel = is_shared(learner.kernel, like.shape[-1])
        self.n_steps = nn.Buffer(like.new_zeros(fleet))
        self.loss = PrequentialLoss(posterior, factor, None if weight is None else weight.threshold)
        parameters = [*learner.kernel.hyperparameters().values(), learner.log_noise_variance]
        self.adam = Adam(parameters, betas=(0.9, 0.99))
        for i, p in enumerate(parameters):
            self.register_buffer(f"move_{i}", torch.zeros_like(p.detach()))
        # no more than what a learner remembers that forgets
        known = self.memory if factor == 1.0 else min(self.memory, math.ceil(1.0 / (1.0 - factor)))
        size = max(self.window, known, learner.recent.capacity)
        fleet = {"batch_shape": fleet, "dtype": like.dtype, "device": like.device}
        learner.recent = Recent(learner.in_features, learner.out_features, size, **fleet)
        self._n_rebuilt = 0

    def act(self, learner: Host) -> None:
        """Descend, and move the parameters, when it is time."""
        place = (learner.n_samples - learner.refresh_offset) % self.window
        due = learner.is_due(learner.n_samples + 1)
        between = (place + 1) * self.steps // self.window > place * self.steps // self.window
        if due or (between and place + 1 < self.window):
            if moved := due and self.steps > 1:
                self._move(learner)
            self.descend(learner, moved=moved)
        if due:
            self._move(learner)

    def after_rebuild(self, learner: Host) -> None:
        """The present state becomes the past one, which has seen all samples so far."""
        self.loss.snapshot(learner.posterior)
        self._n_rebuilt = learner.n_samples

    def forget(self, models: Bool[Tensor, "*batch"]) -> None:
        """These models face another system: the state of the old one does not count."""
        self.loss.state.forget(models)

    def reset(self) -> None:
        """Forget snapshot and step sizes."""
        super().reset()
        self.adam.reset()
        self.loss.state.reset()
        self._n_rebuilt = 0

    def get_extra_state(self) -> dict[str, Any]:
        """Samples that the past state has seen."""
        return {"n_rebuilt": self._n_rebuilt}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        self._n_rebuilt = int(state["n_rebuilt"])

    def queries(self, learner: Host, n: int) -> Queries:
        """Of n samples those since the past state, and this turn's part of those that it has seen."""
        recent = learner.recent
        x, y, _, weight = recent.last(n, min(max(n - self._n_rebuilt, 0), self.window))
        absorbed = age = x.new_zeros(x.shape[-2])
        if self.memory:
            k = max(_REPLAYED * self.window, learner.posterior.capacity)
            x_past, y_past, weight_past, age_past = recent.take(n, k)
            seen = (age_past > n - self._n_rebuilt).to(age_past.dtype)
            x, y = torch.cat([x, x_past], dim=-2), torch.cat([y, y_past], dim=-2)
            weight = torch.cat([weight, weight_past * seen], dim=-1)
            absorbed, age = torch.cat([absorbed, torch.ones_like(age_past)]), torch.cat([age, age_past])
        return Queries(*learner.units.of_sets(x, y), weight, absorbed, age)

    def _theta(self, learner: Host) -> dict[str, Tensor]:
        return {**learner.kernel.hyperparameters(), "log_noise": learner.log_noise_variance}

    def descend(self, learner: Host, *, moved: bool = False) -> None:
        """A step of Adam on the loss, model by model; one without samples or finite gradient stays as it is.

        The parameters move at the next rebuild: until then the caches are those of the old ones. ``moved``:
        those of the past state are to be made again.
        """
        kernel, log_noise, parameters = learner.kernel, learner.log_noise_variance, self._theta(learner)
        queries = self.queries(learner, learner.n_samples + 1)
        _, gradients = self.loss.with_gradients(kernel, log_noise, queries, anew=moved)
        on = ((queries.weight * (1.0 - queries.absorbed)).sum(-1) > 0).to(self.n_steps.dtype)
        self.n_steps += on
        n = self.n_steps.clamp_min(1.0)
        correction, decay = self.adam.correction(n) * _shrink(n), _NETWORK_DECAY * _shrink(n)
        decay = decay * on * parameters["log_noise"].mean(-1).exp().clamp_max(1.0)
        alone = on.is_cpu and not on.dim() and bool(on)  # one model, which needs no masks
        if alone := alone and all(g is None or bool(g.isfinite().all()) for g in gradients):
            correction, decay = float(correction), float(decay)
        for i, ((name, p), gradient) in enumerate(zip(parameters.items(), gradients, strict=True)):
            if gradient is None:
                continue
            logarithm = name.split(".")[-1].startswith("log_")
            shared = self.shared_kernel and name != "log_noise"
            good = None if alone else gradient.isfinite() & (_spread(on, p, shared) > 0)
            rate = (self.rate if logarithm else _NETWORK_RATE) * _spread(correction, p, shared)
            move = self.get_buffer(f"move_{i}")
            if not logarithm:
                move.sub_(_spread(decay, p, shared) * p)
            self.adam.move(i, move, gradient if good is None else gradient.where(good, 0.0), rate, good)

    def _move(self, learner: Host) -> None:
        """The parameters as the steps since the last rebuild want them."""
        for i, (name, p) in enumerate(self._theta(learner).items()):
            move = self.get_buffer(f"move_{i}")
            p.add_(move)
            move.zero_()
            if name.split(".")[-1].startswith("log_"):  # far beyond what standardised data can mean
                p.clamp_(-14.0 if name == "log_noise" else -7.0, 7.0)


def _shrink(n: Tensor) -> Tensor:
    """Size of the n-th step relative to the first."""
    return (1.0 + n / 30.0).rsqrt().clamp_min(0.1)


def _spread(value: Float[Tensor, "*batch"] | float, like: Tensor, shared: bool) -> Tensor | float:
    """A value per model against a parameter; one shared by the fleet takes the mean."""
    if not isinstance(value, Tensor):
        return value
    if shared or like.shape[: value.dim()] != value.shape:
        return value.mean()
    return value[(..., *(None,) * (like.dim() - value.dim()))]
