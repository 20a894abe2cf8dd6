from __future__ import annotations

from typing import Any

import torch
from torch import nn

from ..._checks import check_count, check_positive
from ...typing import Tensor
from ..base import SingleLearner
from ..kernels.kernel import Kernel
from ..kernels.stationary import Matern32
from ..report import UpdateEvent, UpdateReport
from .scaled import ScaledLearner

_NEIGHBOURS = 4  # experts averaged in a prediction
_SPREAD = 0.7  # correlation with the nearest centre below which an expert is opened


class LocalGPs(ScaledLearner, SingleLearner):
    """Experts with centres ``c_e`` and windows of their own; the nearest few are averaged::

        mean = sum_e w_e mean_e / sum_e w_e,   w_e = k(x, c_e)

    A sample goes to the nearest expert; where its correlation with the nearest centre is below 0.7
    and an expert is left, it opens a new one (Nguyen-Tuong, Seeger & Peters, Advanced Robotics 23,
    2009; bounded like SkyGP, standing in for the tree of LoG-GP, Lederer et al., ICML 2021). The
    variance is that of the mixture. One model.

    Args:
        experts: largest number of experts.
        window: samples per expert; the oldest goes.
        kernel, noise_variance: of all experts.
        options: see ScaledLearner; ``batch_shape`` must be (): several are a ``LearnerFleet``.
    """

    def __init__(
        self,
        in_features: int,
        out_features: int,
        *,
        experts: int = 40,
        window: int = 100,
        kernel: Kernel | None = None,
        noise_variance: float = 0.1,
        **options: Any,
    ) -> None:
        super().__init__(in_features, out_features, **options)
        E, n = check_count("experts", experts), check_count("window", window)
        self.experts, self.window = E, n
        self.noise_variance = check_positive("noise_variance", noise_variance)
        factory = {"dtype": self.dtype, "device": self.device}
        self.kernel = Matern32(in_features, **factory) if kernel is None else kernel.to(self._like)
        zeros = self._like.new_zeros
        self.centres = nn.Buffer(zeros(E, self.in_features))
        self.inputs = nn.Buffer(zeros(E, n, self.in_features))
        self.targets = nn.Buffer(zeros(E, n, self.out_features))
        self.count = nn.Buffer(torch.zeros(E, dtype=torch.int64, device=self.device))
        self.solution = nn.Buffer(zeros(E, n, self.out_features))
        self.inverse = nn.Buffer(zeros(E, n, n))
        self._make_units(self.kernel.shift_invariant(self.in_features), self.dtype)

    def _mean(self, z: Tensor) -> Tensor:
        """Mean of the nearest experts' means."""
        return self._mixture(z)[0]

    def _law(self, z: Tensor, observation: bool) -> tuple[Tensor, Tensor]:
        """Moments of the mixture of the nearest experts."""
        mean, v = self._mixture(z)
        return mean, v + self.noise_variance if observation else v

    def _follow(self, change: tuple[Tensor, Tensor], change_t: tuple[Tensor, Tensor]) -> None:
        """All windows in new units, and solved again."""
        for kept, (offset, ratio) in (
            (self.centres, change), (self.inputs, change), (self.targets, change_t)
        ):  # fmt: skip
            kept.add_(offset).mul_(ratio)
        for e in range(int((self.count > 0).sum())):
            self._solve(e)

    def _mixture(self, x: Tensor) -> tuple[Tensor, Tensor]:
        near = self.kernel(x.unsqueeze(-2), self.centres).squeeze(-2) * (self.count > 0)
        w, index = near.topk(min(_NEIGHBOURS, self.experts), dim=-1)
        # far from all experts every weight underflows: the floor makes them equal, not 0/0
        w = (w + torch.finfo(x.dtype).tiny ** 0.5) * (self.count[index] > 0)
        w = w / w.sum(-1, keepdim=True).clamp_min(torch.finfo(x.dtype).tiny)
        query = x.unsqueeze(-2).unsqueeze(-2)
        k = self.kernel(query, self.inputs[index])
        means = (k @ self.solution[index]).squeeze(-2)
        u = (self.inverse[index] @ k.mT).squeeze(-1)
        prior = self.kernel.diagonal(x).unsqueeze(-1)
        v = (prior - u.square().sum(-1)).clamp_min(torch.finfo(x.dtype).eps).unsqueeze(-1)
        w = w.unsqueeze(-1)
        mean = (w * means).sum(-2)
        variance = (w * (v + (means - mean.unsqueeze(-2)).square())).sum(-2)
        return mean, torch.where(self.count.sum() > 0, variance, prior)

    def _learn(self, x: Tensor, y: Tensor, mask: Tensor | None) -> UpdateReport:
        mean, v = self._mixture(x)
        v = v + self.noise_variance
        nis = ((y - mean).square() / v).mean(-1)
        one = torch.ones_like(nis)
        used = int((self.count > 0).sum())
        prior = self.kernel.diagonal(x)
        near = self.kernel.vector(x, self.centres) * (self.count > 0)
        e = int(near.argmax())
        opened = used < self.experts and (used == 0 or bool(near[e] < _SPREAD * prior))
        if opened:
            e = used
            self.centres[e] = x
        place = int(self.count[e]) % self.window
        self.inputs[e, place], self.targets[e, place] = x, y
        self.count[e] += 1
        self._solve(e)
        event = torch.tensor(int(UpdateEvent.ADDED if opened else UpdateEvent.ABSORBED), device=self.device)
        return UpdateReport(event, 1.0 - near[e] / prior if not opened else one, nis, one)

    def _solve(self, e: int) -> None:
        n = min(int(self.count[e]), self.window)
        K = self.kernel(self.inputs[e, :n], self.inputs[e, :n]).double()
        K.diagonal().add_(self.noise_variance)
        inverse = torch.linalg.inv(torch.linalg.cholesky_ex(K)[0])
        self.inverse[e, :n, :n] = inverse.to(self.dtype)
        self.solution[e, :n] = (inverse.mT @ (inverse @ self.targets[e, :n].double())).to(self.dtype)
