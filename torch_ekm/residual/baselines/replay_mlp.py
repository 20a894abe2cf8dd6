from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import torch
from torch import nn

from ..._checks import check_count, check_counts
from ...typing import Tensor
from ..adam import Adam
from ..base import SingleLearner
from ..kernels.kernel import BufferList
from ..report import UpdateReport
from .scaled import ScaledLearner

_MINIBATCH, _STEPS, _RATE = 32, 2, 3e-3  # of Adam
_PRIOR_VARIANCE = 1.0  # of g before the first sample, and start of the running noise estimate


class ReplayMLP(ScaledLearner, SingleLearner):
    """``g(x) = mean_i (net_i(x; theta_i) - net_i(x; theta_i0))``: exactly 0 before the first sample.

    Each sample brings two Adam steps on itself and a minibatch of 32 from the last ``memory`` ones.
    With ``members > 1`` the latent variance is the members' spread, each trained on minibatches of its
    own (Lakshminarayanan et al., NeurIPS 2017, with Osband's randomised priors, NeurIPS 2018); with one
    member it is the running mean of squared innovations. One model.

    Args:
        hidden: widths of the tanh layers.
        members: networks in the ensemble.
        memory: samples kept for replay (the oldest goes).
        seed: of weights and minibatches.
        options: see ScaledLearner; ``batch_shape`` must be ().
    """

    def __init__(
        self,
        in_features: int,
        out_features: int,
        *,
        hidden: Sequence[int] = (64, 64),
        members: int = 1,
        memory: int = 1000,
        seed: int = 0,
        **options: Any,
    ) -> None:
        super().__init__(in_features, out_features, **options)
        self.members, self.memory = check_count("members", members), check_count("memory", memory)
        self.hidden, self.seed = check_counts("hidden", hidden), int(seed)
        zeros = self._like.new_zeros
        self.inputs = nn.Buffer(zeros(self.memory, self.in_features))
        self.targets = nn.Buffer(zeros(self.memory, self.out_features))
        self.count = nn.Buffer(torch.zeros((), dtype=torch.int64, device=self.device))
        self.noise = nn.Buffer(zeros(self.out_features))
        self.theta = BufferList()
        widths = [self.in_features, *self.hidden, self.out_features]
        for n_in, n_out in itertools.pairwise(widths):
            self.theta.append(zeros(self.members, n_in, n_out))
            self.theta.append(zeros(self.members, 1, n_out))
        for i, p in enumerate(self.theta):
            self.register_buffer(f"start_{i}", torch.zeros_like(p))
        self.adam = Adam(self.theta)
        self._clear()

    @property
    def _start(self) -> list[Tensor]:
        """The weights theta_0 that every member began with."""
        return [self.get_buffer(f"start_{i}") for i in range(len(self.theta))]

    def _mean(self, z: Tensor) -> Tensor:
        """Mean of the members."""
        return self._members(z).mean(-2)

    def _law(self, z: Tensor, observation: bool) -> tuple[Tensor, Tensor]:
        """Spread of the members, plus the running noise on request."""
        members = self._members(z)
        mean = members.mean(-2)
        if self.members > 1:
            # before the first sample all members are 0 and so is their spread: then it is the prior
            v = members.var(-2).where(self.count > 0, _PRIOR_VARIANCE)
            v = v.clamp_min(torch.finfo(v.dtype).eps)
            return mean, v + self.noise if observation else v
        return mean, self.noise.expand_as(mean)

    def unit_draws(self, x: Tensor, n: int, generator: torch.Generator | None) -> Tensor:
        """Members' functions, mixed; one network takes each query alone."""
        if self.members == 1 or not self.count:
            return super().unit_draws(x, n, generator)
        apart = self._members(self._inputs(x))
        apart = (apart - apart.mean(-2, keepdim=True)) / apart.std(-2, keepdim=True)
        shape = n, *(1,) * (x.dim() - 1), self.members, self.out_features
        mix = torch.randn(shape, generator=generator, dtype=x.dtype, device=x.device)
        return (mix * apart.nan_to_num(0.0)).sum(-2) / (self.members - 1) ** 0.5

    def _clear(self, models: Tensor | None = None) -> None:
        """New weights from the seed, empty memory."""
        for buffer in (self.inputs, self.targets, self.count):
            buffer.zero_()
        self.adam.reset()
        generator = torch.Generator().manual_seed(self.seed)
        for i, p in enumerate(self.theta):
            if i % 2 == 0:
                draw = torch.randn(p.shape, generator=generator, dtype=torch.float64)
                p.data.copy_(draw / p.shape[-2] ** 0.5)
            else:
                p.data.zero_()
            self.get_buffer(f"start_{i}").copy_(p.data)
        self.noise.fill_(_PRIOR_VARIANCE)

    def _follow(self, change: tuple[Tensor, Tensor], change_t: tuple[Tensor, Tensor]) -> None:
        """The same functions of x: first and last layer take the change."""
        (offset, ratio), (offset_t, ratio_t) = change, change_t
        n = min(int(self.count), self.memory)
        self.inputs[:n].add_(offset).mul_(ratio)
        self.targets[:n].add_(offset_t).mul_(ratio_t)
        self.noise.mul_(ratio_t.square())
        for theta, shift in (([p.data for p in self.theta], offset_t), (self._start, 0.0)):
            theta[1].sub_(offset.unsqueeze(-2) @ theta[0])
            theta[0].div_(ratio.unsqueeze(-1))
            theta[-2].mul_(ratio_t)
            theta[-1].add_(shift).mul_(ratio_t)

    def _net(self, x: Tensor, theta: Sequence[Tensor]) -> Tensor:
        """x ``(..., members or 1, n, in)`` through all members."""
        for i in range(0, len(theta) - 2, 2):
            x = torch.tanh(x @ theta[i] + theta[i + 1])
        return x @ theta[-2] + theta[-1]

    def _members(self, x: Tensor) -> Tensor:
        x = x.unsqueeze(-2).unsqueeze(-2)
        return (self._net(x, list(self.theta)) - self._net(x, self._start)).squeeze(-2)

    def _learn(self, x: Tensor, y: Tensor, mask: Tensor | None) -> UpdateReport:
        mean, variance = self._law(x, True)
        nis = ((y - mean) / variance.sqrt()).square().mean(-1)
        n = int(self.count)
        self.noise.lerp_((y - mean).square(), max(0.02, 1.0 / (n + 2)))
        self.inputs[n % self.memory], self.targets[n % self.memory] = x, y
        self.count += 1
        # the sample's number seeds its minibatches, so that a reloaded learner draws the same
        generator = torch.Generator().manual_seed((self.seed * 1_000_003 + n) % 2**63)
        for step in range(_STEPS):
            size = (self.members, _MINIBATCH)
            index = torch.randint(min(n + 1, self.memory), size, generator=generator)
            index[:, 0] = n % self.memory
            index = index.to(self.device)
            bx, by = self.inputs[index], self.targets[index] + self._net(self.inputs[index], self._start)
            with torch.enable_grad():
                theta = [p.detach().requires_grad_(True) for p in self.theta]
                loss = (self._net(bx, theta) - by).square().sum((0, 2)).mean()
                gradients = torch.autograd.grad(loss, theta)
            rate = _RATE * self.adam.correction(n * _STEPS + step + 1)
            for i, (p, gradient) in enumerate(zip(self.theta, gradients, strict=True)):
                self.adam.move(i, p, gradient, rate)
        return UpdateReport.of(nis, mask)
