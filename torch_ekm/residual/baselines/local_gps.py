"""Many small Gaussian processes, each responsible for a region."""

from __future__ import annotations

from typing import Any

import torch
from torch import nn
from torch.distributions import Normal

from ...exceptions import ParameterError
from ...typing import Tensor
from ..base import SingleLearner
from ..checks import check_count, check_positive
from ..kernels.kernel import Kernel
from ..kernels.stationary import SquaredExponential
from ..report import UpdateEvent, UpdateReport


class LocalGPs(SingleLearner):
    """Experts with centres ``c_e`` and windows of their own; the nearest few are averaged::

        mean = sum_e w_e mean_e / sum_e w_e,   w_e = k(x, c_e)

    A sample goes to the nearest expert; where the nearest is farther than ``spread`` (in correlation)
    and an expert is left, it opens a new one (Nguyen-Tuong, Seeger & Peters, Advanced Robotics 23,
    2009; bounded like SkyGP, standing in for the tree of LoG-GP, Lederer et al., ICML 2021). The
    variance is that of the mixture. One model.

    Args:
        experts: largest number of experts.
        window: samples per expert; the oldest goes.
        neighbours: experts averaged in a prediction.
        spread: correlation with the nearest centre below which an expert is opened.
        kernel, noise_variance: of all experts.
        options: see ResidualLearner (``batch_shape`` must be (); several: ``LearnerFleet``).
    """

    def __init__(
        self,
        in_features: int,
        out_features: int,
        *,
        experts: int = 40,
        window: int = 100,
        neighbours: int = 4,
        spread: float = 0.7,
        kernel: Kernel | None = None,
        noise_variance: float = 0.01,
        **options: Any,
    ) -> None:
        super().__init__(in_features, out_features, **options)
        E, n = check_count("experts", experts), check_count("window", window)
        self.experts, self.window = E, n
        self.neighbours = min(check_count("neighbours", neighbours), E)
        if not 0 < spread < 1:
            raise ParameterError("spread", spread, "in (0, 1)")
        self.spread, self.noise_variance = float(spread), check_positive("noise_variance", noise_variance)
        factory = {"dtype": self.dtype, "device": self.device}
        self.kernel = SquaredExponential(in_features, **factory) if kernel is None else kernel.to(self._like)
        zeros = self._like.new_zeros
        self.centres = nn.Buffer(zeros(E, self.in_features))
        self.inputs = nn.Buffer(zeros(E, n, self.in_features))
        self.targets = nn.Buffer(zeros(E, n, self.out_features))
        self.count = nn.Buffer(torch.zeros(E, dtype=torch.int64, device=self.device))
        self.solution = nn.Buffer(zeros(E, n, self.out_features))
        self.inverse = nn.Buffer(zeros(E, n, n))

    def forward(self, x: Tensor) -> Tensor:
        """Mean of the nearest experts' means."""
        return self._mixture(self._check_query(x))[0]

    def predict(self, x: Tensor, *, observation: bool = False) -> Normal:
        """Moments of the mixture of the nearest experts."""
        mean, v = self._mixture(self._check_query(x))
        v = v + self.noise_variance if observation else v
        return Normal(mean, v.sqrt(), validate_args=False)

    def _mixture(self, x: Tensor) -> tuple[Tensor, Tensor]:
        near = self.kernel(x.unsqueeze(-2), self.centres).squeeze(-2) * (self.count > 0)
        w, index = near.topk(self.neighbours, dim=-1)
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

    def _absorb(self, x: Tensor, y: Tensor, mask: Tensor | None) -> UpdateReport:
        mean, v = self._mixture(x)
        v = v + self.noise_variance
        nis = ((y - mean).square() / v).mean(-1)
        one = torch.ones_like(nis)
        used = int((self.count > 0).sum())
        prior = self.kernel.diagonal(x)
        near = self.kernel.vector(x, self.centres) * (self.count > 0)
        e = int(near.argmax())
        opened = used < self.experts and (used == 0 or bool(near[e] < self.spread * prior))
        if opened:
            e = used
            self.centres[e] = x
        place = int(self.count[e]) % self.window
        self.inputs[e, place], self.targets[e, place] = x, y
        self.count[e] += 1
        n = min(int(self.count[e]), self.window)
        K = self.kernel(self.inputs[e, :n], self.inputs[e, :n]).double()
        K.diagonal().add_(self.noise_variance)
        inverse = torch.linalg.inv(torch.linalg.cholesky_ex(K)[0])
        self.inverse[e, :n, :n] = inverse.to(x.dtype)
        self.solution[e, :n] = (inverse.mT @ (inverse @ self.targets[e, :n].double())).to(x.dtype)
        event = torch.tensor(int(UpdateEvent.ADDED if opened else UpdateEvent.ABSORBED), device=self.device)
        return UpdateReport(event, 1.0 - near[e] / prior if not opened else one, nis, one)
