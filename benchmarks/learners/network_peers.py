"""Bayesian neural networks behind the contract of learners, to be compared with.

The network is two layers of tanh; x and y are expected in units of about 1.
"""

from __future__ import annotations

import itertools
import math
from typing import Any, NamedTuple

import torch
from peer import Peer
from torch import nn
from torch.func import functional_call, jacrev, vmap

from torch_ekm._checks import check_count
from torch_ekm.typing import Tensor

_HIDDEN = (64, 64)
_RATE = 3e-3  # of AdamW


def features(in_features: int) -> nn.Sequential:
    """Two layers of tanh."""
    widths = [in_features, *_HIDDEN]
    layers = [nn.Sequential(nn.Linear(n, m), nn.Tanh()) for n, m in itertools.pairwise(widths)]
    return nn.Sequential(*layers)


class BayesianLastLayer(Peer):
    """Variational Bayesian last layer of a network (Harrison et al., ICLR 2024; the authors' ``vbll``).

    Each sample brings a step of AdamW on itself and 31 of the last ``memory`` samples.

    Args:
        memory: samples kept to draw from.
        options: see ResidualLearner (``batch_shape`` must be ()).
    """

    def __init__(self, in_features: int, out_features: int, *, memory: int = 10_000, **options: Any) -> None:
        super().__init__(in_features, out_features, **options)
        self.memory = check_count("memory", memory)
        self.reset()

    def _begin(self) -> None:
        from vbll import Regression

        m = self.out_features
        self.body = features(self.in_features).to(self._like)
        self.head = Regression(_HIDDEN[-1], m, regularization_weight=1.0, parameterization="dense")
        nn.init.zeros_(self.head.W_mean)
        nn.init.zeros_(self.head.noise_logdiag)
        self.head.to(self._like)
        trained = [p for p in (*self.body.parameters(), *self.head.parameters()) if p.requires_grad]
        self._optimizer = torch.optim.AdamW(trained, lr=_RATE, weight_decay=1e-4)
        self._seen: list[tuple[Tensor, Tensor]] = []
        self._draws = torch.Generator().manual_seed(0)
        self._count = 0

    def _law(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        law, noise = self.head.predictive(self.body(x)), self.head.noise().scale.square()
        return law.mean, (law.variance - noise).clamp_min(1e-12), noise

    def _learn(self, x: Tensor, y: Tensor) -> None:
        self._count += 1
        self._seen = [*self._seen[-self.memory + 1 :], (x, y)]
        drawn = torch.randint(len(self._seen), (31,), generator=self._draws).tolist()
        xs, ys = (torch.stack(each) for each in zip((x, y), *(self._seen[i] for i in drawn), strict=True))
        with torch.enable_grad():
            self._optimizer.zero_grad()
            self.head.regularization_weight = 1.0 / self._count
            self.head(self.body(xs)).train_loss_fn(ys).backward()
            self._optimizer.step()


class _Weights(NamedTuple):
    """Hidden ones, flat; those of the last layer ``(m, h + 1)``."""

    hidden: Tensor
    last: Tensor


class LowRankKalman(Peer):
    """Extended Kalman filter of a network's weights, without replay (HiLoFi)::

        S = H_l P H_l' + (C H_h')' (C H_h') + R,   K_l = P H_l' S^-1,   K_h = C'C H_h' S^-1
        P <- P - K_l S K_l',   C <- first r rows of diag(s) V'
        U diag(s) V' = svd [C (I - K_h H_h)'; R^.5 K_h']

    The covariance P of the last layer is kept whole and drifts by a little at each sample, that of the hidden
    weights is C'C of rank r (Duran-Martin et al., arXiv 2506.11898). Here R follows the innovations.

    Args:
        rank: r.
        options: see ResidualLearner (``batch_shape`` must be ()).
    """

    drift = 1e-6  #: share of its prior by which the last layer's covariance grows

    def __init__(self, in_features: int, out_features: int, *, rank: int = 20, **options: Any) -> None:
        super().__init__(in_features, out_features, **options)
        self.rank = check_count("rank", rank)
        self.reset()

    def _begin(self) -> None:
        self.body = features(self.in_features).to(self._like).requires_grad_(False)
        flat = torch.cat([p.flatten() for p in self.body.parameters()])
        n, width = len(flat), _HIDDEN[-1] + 1
        last = flat.new_zeros(self.out_features, width)
        self._weights = _Weights(flat, last)
        # outputs share their features: one covariance serves them all, as if R were their mean
        self._prior = 10.0 / width
        self._last_cov = self._prior * torch.eye(width).to(self._like)
        self._factor = torch.randn(self.rank, n).to(self._like) * math.sqrt(0.1 / self.rank) * flat.std()
        self._noise = flat.new_ones(self.out_features)
        self._count = 0

    def _features(self, hidden: Tensor, x: Tensor) -> Tensor:
        """``[phi(x), 1]``."""
        names, shapes = zip(*((name, p.shape) for name, p in self.body.named_parameters()), strict=True)
        sizes = [shape.numel() for shape in shapes]
        parts = {n: p.view(s) for n, p, s in zip(names, hidden.split(sizes), shapes, strict=True)}
        phi = functional_call(self.body, parts, (x,))
        return torch.cat([phi, torch.ones_like(phi[..., :1])], -1)

    def _both(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """phi ``(w,)``, mean ``(m,)`` and its derivative by the hidden weights ``(m, n)``."""
        hidden, last = self._weights
        phi = self._features(hidden, x)
        slope = jacrev(lambda theta: last @ self._features(theta, x))(hidden)
        return phi, last @ phi, slope

    def _law(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        phi, mean, slope = vmap(self._both)(x)
        shared = (phi @ self._last_cov * phi).sum(-1, keepdim=True)
        return mean, shared + (slope @ self._factor.mT).square().sum(-1), self._noise

    def _learn(self, x: Tensor, y: Tensor) -> None:
        hidden, last = self._weights
        with torch.no_grad():
            phi, mean, slope = self._both(x)
            error, seen = y - mean, self._factor @ slope.mT  # (r, m)
            towards = self._last_cov @ phi
            shared = phi @ towards
            inner = shared * torch.eye(len(y)).to(slope) + seen.mT @ seen
            S = inner + self._noise.diag()
            gain = torch.linalg.solve(S, self._factor.mT @ seen, left=False)  # (n, m)
            pull = torch.linalg.solve(S, error)
            self._weights = _Weights(hidden + gain @ error, last + torch.outer(pull, towards))
            self._last_cov = self._last_cov - torch.outer(towards, towards) / (shared + self._noise.mean())
            self._last_cov.diagonal().add_(self.drift * self._prior)
            rows = torch.cat([self._factor - seen @ gain.mT, self._noise.sqrt().unsqueeze(-1) * gain.mT])
            _, s, V = torch.linalg.svd(rows, full_matrices=False)
            self._factor = s[: self.rank].unsqueeze(-1) * V[: self.rank]
            self._count += 1
            rate = max(1.0 / (self._count + 1), 0.005)
            left = (error.square() - inner.diagonal()).clamp_min(0.0)
            self._noise = (self._noise + rate * (left - self._noise)).clamp_min(1e-6)
