"""The state of a sparse GP posterior on a bounded basis, and the one recursion that changes it."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import torch
from torch import nn

from ...exceptions import ParameterError
from ...typing import Bool, Float, Tensor
from ..base import UpdateEvent, UpdateReport
from ..kernels.kernel import Kernel
from .natural import posterior_from_natural
from .pruning import DELETION_SCORES


class SparsePosterior(nn.Module):
    """``exp(-1/2 f'Omega f/s2 + h'f/s2) N(f; 0, K)`` on at most ``capacity`` basis points.

    Master copy is (basis, Omega, h): Omega is a sum of squares, so it stays positive, and it holds
    neither kernel nor noise. alpha, C, Q are caches with ``mean = alpha'k``, ``var = k** + k'Ck``,
    ``Q = K^-1``: :meth:`absorb` carries them along by rank-one steps, :meth:`rebuild` makes them anew.
    Always float64, see :class:`~torch_ekm.residual.SparseOnlineGP`. Arguments as there.
    """

    basis: Tensor
    active: Tensor
    age: Tensor
    count: Tensor
    slot: Tensor
    moments: Tensor
    vectors: Tensor
    _slots: Tensor

    def __init__(
        self,
        in_features: int,
        out_features: int,
        capacity: int,
        *,
        novelty_tolerance: float,
        jitter: float,
        projection: str,
        deletion: str,
        robust: float | None,
        batch_shape: tuple[int, ...] = (),
        device: torch.device | str | None = None,
    ) -> None:
        super().__init__()
        for name, value in (("novelty_tolerance", novelty_tolerance), ("jitter", jitter)):
            if not 0 <= value < 1:
                raise ParameterError(name, value, "in [0, 1)")
        if projection not in ("kl", "fitc"):
            raise ParameterError("projection", projection, "'kl' or 'fitc'")
        if deletion not in (*DELETION_SCORES, "freeze"):
            raise ParameterError("deletion", deletion, f"one of {(*DELETION_SCORES, 'freeze')}")
        self.capacity, self.batch_shape, self.out_features = capacity, batch_shape, out_features
        self.novelty_tolerance, self.jitter = novelty_tolerance, jitter
        self.projection, self.deletion, self.robust = projection, deletion, robust
        factory = {"dtype": torch.float64, "device": device}
        # One slot more than the capacity: a new point moves in before another is deleted. What a
        # free slot holds in `basis` is meaningless; its rows and columns elsewhere are 0.
        M = capacity + 1
        self.register_buffer("basis", torch.zeros(*batch_shape, M, in_features, **factory))
        self.register_buffer("active", torch.zeros(*batch_shape, M, **factory))
        self.register_buffer("age", torch.zeros(*batch_shape, M, **factory))  # sample number
        self.register_buffer("count", torch.zeros(batch_shape, dtype=torch.int64, device=device))
        self.register_buffer("slot", torch.zeros(batch_shape, dtype=torch.int64, device=device))
        # [C; Q; Omega] and [alpha; h] each in one buffer: one product, one rank update serves all.
        self.register_buffer("moments", torch.zeros(*batch_shape, 3, M, M, **factory))
        self.register_buffer("vectors", torch.zeros(*batch_shape, 2, M, out_features, **factory))
        self.register_buffer("_slots", torch.arange(M, device=device), persistent=False)

    @property
    def alpha(self) -> Float[Tensor, "*batch slots out"]:
        """Coefficients of the mean."""
        return self.vectors[..., 0, :, :]

    @property
    def information(self) -> Float[Tensor, "*batch slots out"]:
        """h, in units of y."""
        return self.vectors[..., 1, :, :]

    @property
    def covariance(self) -> Float[Tensor, "*batch slots slots"]:
        """C, the change of the covariance: negative semi-definite."""
        return self.moments[..., 0, :, :]

    @property
    def precision(self) -> Float[Tensor, "*batch slots slots"]:
        """Omega: how often, and with which weight, each direction of f was seen."""
        return self.moments[..., 2, :, :]

    @property
    def needs_age(self) -> bool:
        """Whether the deletion score asks for sample numbers (a compiled step is cheaper without)."""
        return self.deletion not in ("kl", "mean", "novelty", "freeze")

    def reset(self) -> None:
        """Back to the prior, no basis."""
        for buffer in self.buffers(recurse=False):
            if buffer is not self._slots:
                buffer.zero_()

    def place(self, z: Float[Tensor, "*batch n in"]) -> None:
        """Back to the prior, on the basis z (n at most ``capacity``). Call :meth:`rebuild` then."""
        self.reset()
        n = z.shape[-2]
        self.basis[..., :n, :] = z
        self.active[..., :n] = 1.0
        self.count.fill_(n)
        self.slot.fill_(n)

    def forget(self, models: Bool[Tensor, "*batch"]) -> None:
        """These models go back to the prior but keep their basis points."""
        keep = (~models)[..., None, None]
        for block in (self.covariance, self.precision, self.alpha, self.information):
            block.mul_(keep)

    def diffuse(self, kernel: Kernel, s2: Float[Tensor, "*batch"], kept: Float[Tensor, "*batch"]) -> None:
        """``f <- sqrt(kept) f + sqrt(1 - kept) f'``, f' from the prior; call :meth:`rebuild` then.

        The posterior covariance S becomes ``kept S + (1 - kept) K`` (Van Vaerenbergh et al., IEEE TNNLS
        23, 2012). With ``W = Omega/s2``, ``K = LL'`` and ``RR' = I + (1 - kept) L'WL`` the natural form
        follows without the inverse of K::

            W <- kept (W^-1 + (1 - kept) K)^-1 = kept (W - (1 - kept) G'G),   G = R^-1 L'W
            h <- sqrt(kept) (h - (1 - kept) G' R^-1 L'h)
        """
        kept, s2 = kept[..., None, None], s2[..., None, None]
        L = torch.linalg.cholesky_ex(self.gram(kernel))[0]
        LW = L.mT @ (self.precision / s2)
        eye = torch.eye(L.shape[-1], dtype=L.dtype, device=L.device)
        R = torch.linalg.cholesky_ex(eye + (1.0 - kept) * (LW @ L))[0]
        both = torch.cat([LW, L.mT @ self.information], dim=-1)
        G, Lh = torch.linalg.solve_triangular(R, both, upper=False).tensor_split([L.shape[-1]], dim=-1)
        self.precision.copy_(kept * (self.precision - (1.0 - kept) * s2 * (G.mT @ G)))
        self.information.copy_(kept.sqrt() * (self.information - (1.0 - kept) * (G.mT @ Lh)))

    def gram(self, kernel: Kernel) -> Float[Tensor, "*batch slots slots"]:
        """K(X, X) with the nugget; the identity at free slots."""
        return basis_gram(kernel, self.basis, self.active, self.jitter)

    def rebuild(self, kernel: Kernel, s2: Float[Tensor, "*batch"]) -> None:
        """alpha, C, Q from the natural form by Cholesky."""
        self.rebuild_from(self.gram(kernel), s2)

    def rebuild_from(self, K: Float[Tensor, "*batch slots slots"], s2: Float[Tensor, "*batch"]) -> None:
        """The same, with the kernel's matrix at hand (see :meth:`gram`)."""
        s2 = s2[..., None, None]
        on = self.active.unsqueeze(-1)
        Q, C, alpha = posterior_from_natural(K, self.precision / s2, self.information / s2)
        # a free slot has K = 1, so Q = 1 there: it must be 0 like the rest of its row
        self.covariance.copy_(C)
        self.moments[..., 1, :, :] = Q * (on * on.mT)
        self.alpha.copy_(alpha)

    def absorb(
        self,
        x: Float[Tensor, "*batch in"],
        y: Float[Tensor, "*batch out"],
        kernel: Kernel,
        s2: Float[Tensor, "*batch"],
        mask: Float[Tensor, "*batch"] | None,
        number: int,
    ) -> tuple[UpdateReport, Float[Tensor, "*batch out"], Float[Tensor, "*batch"]]:
        """One sample per model, without a branch on data (a mask multiplies every change by 0)::

            e = Qk, gamma = k** - k'e, v = k** + k'Ck, i = y - mean
            novel (gamma > tolerance k**):  t = 1_slot,  D = s2 + v
            else:                           t = e,       D = s2 + v - gamma
            s = Ck + t:  alpha += s i'/D,  C -= s s'/D,  Omega += t t',  h += t y'
            novel:       Q += p p'/gamma,  p = e - 1_slot

        Csato & Opper 2002, eqs. 2.12-2.14 and the appendix; the projection's D is their
        ``-1/(eta r)``. A robust weight w and FITC replace s2 by ``(s2 + v)/w - v``
        ``(+ gamma if projected)``.

        Returns:
            The report, the innovation and the latent variance before the update.
        """
        here = self._slots.eq(self.slot.unsqueeze(-1))
        k = kernel.vector(x, self.basis) * self.active
        prior = kernel.diagonal(x) * (1.0 + self.jitter)
        column = k.unsqueeze(-1)
        # C and Q are symmetric: a row times each is up to twice as fast as they times a column
        row, (C, Q) = k.unsqueeze(-2), self.moments[..., :2, :, :].unbind(-3)
        products = torch.cat([row @ C, row @ Q], dim=-2)
        Ck, e = products.unbind(-2)
        kCk, ke = (products @ column).squeeze(-1).unbind(-1)
        gamma, v = (prior - ke).clamp_min(0.0), prior + kCk
        innovation = y - (column.mT @ self.alpha).squeeze(-2)

        noise = s2
        surprise = innovation.square().mean(-1) / (s2 + v)
        if self.robust is None:
            weight = torch.ones_like(surprise)
        else:
            # the gain itself is weighted, v/(noise + v): where v is large, a larger s2 alone would not help
            weight = (self.robust**2 / surprise).clamp_max(1.0)
            noise = (s2 + v) / weight - v
        full = self.count == self.capacity
        novel = gamma > self.novelty_tolerance * prior
        if self.deletion == "freeze":
            novel = novel & ~full
        dropped = gamma * ~novel  # novelty that a projection ignores (KL) or counts as noise (FITC)
        if self.projection == "fitc":
            noise = noise + dropped
        gain, precision = 1.0 / (noise + v - dropped), s2 / noise
        if mask is not None:
            novel, gain, precision = novel & (mask > 0), gain * mask, precision * mask

        unit = here.to(e.dtype)
        t = torch.where(novel.unsqueeze(-1), unit, e)
        s = Ck + t
        grow = torch.where(novel, 1.0 / gamma, 0.0)
        left = torch.stack([s, e - unit, t], dim=-2)
        factor = torch.stack([-gain, grow, precision], dim=-1).unsqueeze(-1)
        scaled = left * factor
        values = torch.stack([innovation * gain.unsqueeze(-1), y * precision.unsqueeze(-1)], dim=-2)
        _add_products(self.vectors, left[..., ::2, :].unsqueeze(-1), values.unsqueeze(-1))

        # The slot is free, so its contents can be written whether the sample is novel or not.
        where = self.slot.unsqueeze(-1)
        if mask is None:
            self.basis.scatter_(-2, where.unsqueeze(-1).expand_as(x.unsqueeze(-2)), x.unsqueeze(-2))
        else:  # a masked sample may hold anything
            used = (here & (mask > 0).unsqueeze(-1)).unsqueeze(-1)
            self.basis.copy_(torch.where(used, x.unsqueeze(-2), self.basis))
        self.active.scatter_(-1, where, novel.to(e.dtype).unsqueeze(-1))
        if self.needs_age:
            self.age.scatter_(-1, where, torch.full_like(unit[..., :1], number))
        excess = novel & full
        grown = novel ^ excess
        self.count += grown
        self.slot += grown
        if self.deletion != "freeze" and _any(excess):
            self._add_and_delete(scaled, left, excess, s2)
        else:
            _add_products(self.moments, scaled.unsqueeze(-1), left.unsqueeze(-1))
        event = int(UpdateEvent.ABSORBED) + novel.to(torch.int64) + excess
        if mask is not None:
            event = event * (mask > 0)
        # k** may be 0: no action, no effect
        novelty = gamma / prior.clamp_min(torch.finfo(prior.dtype).tiny)
        return UpdateReport(event, novelty, surprise, weight), innovation, v

    def _add_and_delete(self, scaled: Tensor, added: Tensor, excess: Tensor, s2: Tensor) -> None:
        """Add ``scaled added'`` to (C, Q, Omega), then delete the lowest-scored point where ``excess``.

        The deletion is the KL projection onto the other points. Large fleets are limited by memory, so
        addition and deletion share one pass: what the deletion needs of the sum follows from vectors.
        With a, c, q its entries in alpha, C, Q, stars its remaining columns and ``e = -Q*/q``::

            alpha -= (C*+Q*) a'/(c+q),  C += Q*Q*'/q - (C*+Q*)(C*+Q*)'/(c+q),  Q -= Q*Q*'/q
            Omega <- P'Omega P,  h <- P'h,  P = [I; e']
        """
        M, m, fleet = self.capacity + 1, self.out_features, self.batch_shape
        diagonal = self.moments.diagonal(dim1=-2, dim2=-1) + scaled * added
        c_diag, q_diag, w_diag = diagonal.unbind(-2)
        score = DELETION_SCORES[self.deletion](
            self.alpha, c_diag, q_diag, w_diag / s2.unsqueeze(-1), self.age
        )
        i = score.where(self.active > 0, torch.inf).argmin(-1, keepdim=True)
        # rows, which lie together in memory, stand for columns
        columns = self.moments.gather(-2, i[..., None, None].expand(*fleet, 3, 1, M)).squeeze(-2)
        columns = columns + scaled * added.gather(-1, i.unsqueeze(-2).expand(*fleet, 3, 1))
        c, q, w = columns.gather(-1, i.unsqueeze(-2).expand(*fleet, 3, 1)).unbind(-2)
        C, Q, Om = (columns * self._slots.ne(i).unsqueeze(-2)).unbind(-2)
        on = excess.to(q.dtype).unsqueeze(-1)
        q = q.where(excess.unsqueeze(-1), 1.0)  # an empty basis has nothing to divide by
        q_inv = on / q
        # c + q >= 0 is the point's remaining uncertainty; rounding must not turn it negative.
        cq_inv = on / torch.maximum(c + q, 100 * torch.finfo(q.dtype).eps * q)
        CQ, Qq = C + Q, Q * q_inv
        e, CQc = -Qq, CQ * -cq_inv
        u = Om * on + 0.5 * w * e
        left = torch.stack([Qq, CQc, e, torch.zeros_like(e), u, e], dim=-2).view(*fleet, 3, 2, M)
        right = torch.stack([Q, CQ, Q, Q, e, u], dim=-2).view(*fleet, 3, 2, M)
        left = torch.cat([scaled.unsqueeze(-2), left], dim=-2)
        right = torch.cat([added.unsqueeze(-2), right], dim=-2)
        _add_products(self.moments, left.mT, right.mT)
        rows = self.vectors.gather(-2, i[..., None, None].expand(*fleet, 2, 1, m))
        _add_products(self.vectors, torch.stack([CQc, e], dim=-2).unsqueeze(-1), rows.mT)

        # The slot becomes free: its rows and columns are 0 by definition, not by cancellation.
        free = torch.where(excess.unsqueeze(-1), i, self.slot.unsqueeze(-1))
        at = free[..., None, None]
        self.moments.scatter_(-1, at.expand(*fleet, 3, M, 1), 0.0)
        self.moments.scatter_(-2, at.expand(*fleet, 3, 1, M), 0.0)
        self.vectors.scatter_(-2, at.expand(*fleet, 2, 1, m), 0.0)
        self.active.scatter_(-1, free, 0.0)
        self.slot.copy_(free.squeeze(-1))


def basis_gram(kernel: Kernel, basis: Tensor, active: Tensor, jitter: float) -> Tensor:
    """K(X, X) with ``jitter k**`` on the diagonal; the identity at free slots. Differentiable."""
    return as_gram(kernel(basis, basis), kernel, basis, active, jitter)


def as_gram(K: Tensor, kernel: Kernel, basis: Tensor, active: Tensor, jitter: float) -> Tensor:
    """See :func:`basis_gram`; K is the kernel between the basis and itself."""
    on = active.unsqueeze(-1)
    K = K * (on * on.mT)
    diagonal = torch.where(active > 0, kernel.diagonal_of_set(basis) * (1.0 + jitter), 1.0)
    return (0.5 * (K + K.mT)).diagonal_scatter(diagonal, dim1=-2, dim2=-1)


def _add_products(target: Tensor, left: Tensor, right: Tensor) -> None:
    """target += left right', in place, over all leading axes in one call."""
    flat = target.view(-1, *target.shape[-2:])
    flat.baddbmm_(left.reshape(-1, *left.shape[-2:]), right.reshape(-1, *right.shape[-2:]).mT)


def _any(flag: Tensor) -> bool:
    """Skip work that no model needs where looking is free: on the CPU, outside a compiled graph."""
    return flag.is_cuda or torch.compiler.is_compiling() or bool(flag.any())


@cache
def compiled_absorb(device: str) -> Callable:
    """One compiled step for all learners; kept here, since a compiled function cannot be copied.

    Args:
        device: type of device. On the CPU the calls between the kernels cost a tenth of the step when
            Python makes them: C++ does.
    """
    options: dict[str, Any] | None = {"cpp_wrapper": True} if device == "cpu" else None
    return torch.compile(SparsePosterior.absorb, dynamic=False, options=options)
