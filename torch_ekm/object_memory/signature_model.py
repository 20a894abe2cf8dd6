"""Which grasps were of the same thing? A Bayesian mixture over their signatures, no threshold, no label."""

from __future__ import annotations

import math

import torch

from ..typing import Float, Int, Tensor

_MOST_MOVES = 64
_AXES = 3  # principal axes along which a group is tried to be split
_ENOUGH = 1e-6


class SignatureModel:
    r"""Signatures scatter alike about each object's own mean, which nobody knows::

        z_i | k ~ N(mu_k, W),   mu_k ~ N(mu_0, B),   W ~ inverse Wishart around I,   p(partition): CRP(alpha)

        log p(Z, partition) = K log alpha + sum_k log Gamma(N_k)
            + log Gamma_d(h) - (n - K)/2 d log pi - h log|nu_0 I + S|        h = (nu_0 + d - 1 + n - K)/2
            - d/2 sum_k log N_k + sum_k log N(zbar_k; mu_0, B + W/N_k) + const

    with K groups of N_k among n signatures, zbar_k their means, S the scatter about them and
    ``W = (nu_0 I + S)/(nu_0 + n - K)``: the scatter is integrated out of S and plugged into the means;
    mu_0 and B are those of the means, B drawn towards ``spread^2 I`` with the weight of three objects.

    Everything is in units of the scatter that is expected of one object's signatures, so that I is the
    scatter's prior. W is learned from all objects together: a few grasps of each are too few for
    covariances of their own.
    """

    spread = 4.0  #: how far apart objects are thought to be, in units of that scatter
    strength = 30.0  #: nu_0, in samples: how firmly the expected scatter is believed
    concentration = 1.0  #: alpha, the weight of "new"

    def log_joint(
        self, z: Float[Tensor, "n d"], label: Int[Tensor, "*batch n"], groups: int
    ) -> Float[Tensor, "*batch"]:
        """``log p(Z, partition)`` up to a constant that depends on n only.

        Args:
            z: signatures.
            label: the group of each, 0 to ``groups`` - 1; groups may be empty.
        """
        n, d = z.shape
        member = torch.nn.functional.one_hot(label, groups).to(z.dtype)
        N = member.sum(-2)
        some = (N > 0).to(z.dtype)
        K, count = some.sum(-1), N.clamp_min(1.0)
        M = (member.mT @ z) / count[..., None]
        eye = torch.eye(d, dtype=z.dtype)
        Psi = self.strength * eye + z.mT @ z - M.mT @ (N[..., None] * M)
        W = Psi / (self.strength + n - K)[..., None, None]
        centre = (some[..., None] * M).sum(-2, keepdim=True) / K.clamp_min(1.0)[..., None, None]
        off = some[..., None] * (M - centre)
        B = (3 * self.spread**2 * eye + off.mT @ off) / (2.0 + K)[..., None, None]
        L = torch.linalg.cholesky(B[..., None, :, :] + W[..., None, :, :] / count[..., None, None])
        u = torch.linalg.solve_triangular(L, off[..., None], upper=False)
        means = -0.5 * d * math.log(2 * math.pi) - L.diagonal(dim1=-2, dim2=-1).log().sum(-1)
        means = means - 0.5 * u.square().sum((-2, -1))
        half = (self.strength + d - 1 + n - K) / 2
        return (
            K * math.log(self.concentration)
            + (some * (torch.lgamma(count) + means - 0.5 * d * count.log())).sum(-1)
            + torch.mvlgamma(half, d)
            - 0.5 * d * math.log(math.pi) * (n - K)
            - half * torch.linalg.slogdet(Psi).logabsdet
        )

    def log_posterior(
        self, new: Float[Tensor, " d"], z: Float[Tensor, "n d"], label: Int[Tensor, " n"], groups: int
    ) -> Float[Tensor, " groups"]:
        """Of a new signature belonging to each group, given the partition of the earlier ones.

        An empty group stands for "new"; of several only the first can be meant, the others have -inf.
        """
        labels = torch.cat([label.expand(groups, -1), torch.arange(groups)[:, None]], 1)
        joint = self.log_joint(torch.cat([z, new[None]]), labels, groups)
        return joint.masked_fill(~_allowed(label, groups), -math.inf).log_softmax(0)

    def sort(
        self,
        z: Float[Tensor, "n d"],
        label: Int[Tensor, " n"],
        groups: int,
        evidence: Float[Tensor, "n groups"] | None = None,
    ) -> Int[Tensor, " n"]:
        """A better partition: steepest ascent of the log joint by moving one, merging two or splitting one.

        Groups keep their numbers as far as they remain.

        Args:
            evidence: what else speaks for each signature's membership of each group, in nats.
        """

        def value(labels: Tensor) -> Tensor:
            joint = self.log_joint(z, labels, groups)
            if evidence is not None:
                rows = torch.arange(len(z)).expand_as(labels)
                joint = joint + evidence[rows, labels].sum(-1)
            return joint

        best = float(value(label[None])[0])
        for _ in range(_MOST_MOVES):
            proposed = torch.cat([_moves(label, groups), _merges(label, groups), _splits(z, label, groups)])
            if not len(proposed):
                break
            joint = value(proposed)
            i = int(joint.argmax())
            if float(joint[i]) <= best + _ENOUGH:
                break
            label, best = proposed[i], float(joint[i])
        return label


def _allowed(label: Tensor, groups: int) -> Tensor:
    """Groups that have members, and the first that has none."""
    used = torch.bincount(label, minlength=groups) > 0
    free = torch.nonzero(~used).flatten()
    if len(free):
        used[free[0]] = True
    return used


def _moves(label: Tensor, groups: int) -> Tensor:
    """One signature goes to another group, or to a new one."""
    n, targets = len(label), torch.nonzero(_allowed(label, groups)).flatten()
    proposed = label.expand(len(targets) * n, n).clone()
    rows = torch.arange(len(proposed))
    proposed[rows, rows % n] = targets[rows // n]
    return proposed[(proposed != label).any(-1)]


def _merges(label: Tensor, groups: int) -> Tensor:
    """Two groups become one, under the name of the larger."""
    size = torch.bincount(label, minlength=groups)
    used = sorted(torch.nonzero(size).flatten().tolist(), key=lambda k: (-int(size[k]), k))
    pairs = [(a, b) for i, a in enumerate(used) for b in used[i + 1 :]]
    if not pairs:
        return label.new_zeros(0, len(label))
    return torch.stack([label.masked_fill(label == b, a) for a, b in pairs])


def _splits(z: Tensor, label: Tensor, groups: int) -> Tensor:
    """One group becomes two, cut anywhere along one of its principal axes; the larger part keeps the name."""
    size = torch.bincount(label, minlength=groups)
    free = torch.nonzero(size == 0).flatten()
    proposed = []
    for k in torch.nonzero(size > 1).flatten().tolist() if len(free) else []:
        at = torch.nonzero(label == k).flatten()
        off = z[at] - z[at].mean(0)
        axes = torch.linalg.svd(off, full_matrices=False).Vh[:_AXES]
        for order in (off @ axes.mT).argsort(0).mT:
            for cut in range(1, len(at)):
                away = order[cut:] if 2 * cut >= len(at) else order[:cut]
                split = label.clone()
                split[at[away]] = free[0]
                proposed.append(split)
    return torch.stack(proposed) if proposed else label.new_zeros(0, len(label))
