"""The one recursion that changes a sparse GP posterior: Csato & Opper's, without a branch on data."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from ....typing import Float, Tensor
from ...kernels.kernel import Kernel
from ...report import UpdateEvent, UpdateReport
from ..part import Part
from ..posterior import SparsePosterior

#: what losses may differ by and count as the same, relative and per output in nats: a basis that has learned
#: nothing yet must not depend on how a processor rounds
TIE, TIE_KL = 1e-9, 1e-14
#: novelty below this share of the noise says nothing; its inverse in Q would grow without end
LEAST_NOVELTY = 1e-12


def absorb(
    posterior: SparsePosterior,
    x: Float[Tensor, "*batch in"],
    y: Float[Tensor, "*batch out"],
    kernel: Kernel,
    s2: Float[Tensor, "*batch"],
    mask: Float[Tensor, "*batch"] | None,
    weighing: Sequence[Part] = (),
) -> tuple[UpdateReport, Tensor, Tensor]:
    """One sample per model, without a branch on data (a mask multiplies every change by 0)::

        e = Qk, gamma = k** - k'e, v = k** + k'Ck, i = y - mean
        novel (gamma > threshold k**):  t = 1_slot,  D = s2 + v
        else:                           t = e,       D = s2 + v - gamma
        s = Ck + t:  alpha += s i'/D,  C -= s s'/D,  Omega += t t',  h += t y'
        novel:       Q += p p'/gamma,  p = e - 1_slot

    Csato & Opper 2002, eqs. 2.12-2.14 and the appendix; the projection's D is their
    ``-1/(eta r)``. A robust weight w replaces s2 by ``(s2 + v)/w - v``.

    Args:
        s2: noise variance of the gain.
        mask: 1 where a model has a sample, 0 elsewhere.
        weighing: parts whose weights multiply on the gain.

    Returns:
        The report, the innovation and the latent variance before the update.
    """
    here = posterior.slots.eq(posterior.slot.unsqueeze(-1))
    k = kernel.vector(x, posterior.basis) * posterior.active
    prior = kernel.diagonal(x) * (1.0 + posterior.jitter)
    column = k.unsqueeze(-1)
    # C and Q are symmetric: a row times each is up to twice as fast as they times a column
    row, (C, Q) = k.unsqueeze(-2), posterior.moments[..., :2, :, :].unbind(-3)
    products = torch.cat([row @ C, row @ Q], dim=-2)
    Ck, e = products.unbind(-2)
    kCk, ke = (products @ column).squeeze(-1).unbind(-1)
    gamma, v = (prior - ke).clamp_min(0.0), prior + kCk
    innovation = y - (column.mT @ posterior.alpha).squeeze(-2)

    nis = innovation.square().mean(-1) / (s2 + v)
    weight = torch.ones_like(nis)
    for part in weighing:
        weight = weight * part.weigh(nis, mask)
    noise = (s2 + v) / weight - v if weighing else s2
    full = posterior.count == posterior.capacity
    novel = gamma > torch.maximum(posterior.novelty_threshold * prior, LEAST_NOVELTY * s2)
    dropped = gamma * ~novel  # novelty that a projection ignores
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
    _add_products(posterior.vectors, left[..., ::2, :].unsqueeze(-1), values.unsqueeze(-1))

    # The slot is free, so its contents can be written whether the sample is novel or not.
    where = posterior.slot.unsqueeze(-1)
    if mask is None:
        posterior.basis.scatter_(-2, where.unsqueeze(-1).expand_as(x.unsqueeze(-2)), x.unsqueeze(-2))
    else:  # a masked sample may hold anything
        used = (here & (mask > 0).unsqueeze(-1)).unsqueeze(-1)
        posterior.basis.copy_(torch.where(used, x.unsqueeze(-2), posterior.basis))
    posterior.active.scatter_(-1, where, novel.to(e.dtype).unsqueeze(-1))
    excess = novel & full
    grown = novel ^ excess
    posterior.count.add_(grown)
    posterior.slot.add_(grown)
    if _any(excess):
        _add_and_prune(posterior, scaled, left, excess, s2)
    else:
        _add_products(posterior.moments, scaled.unsqueeze(-1), left.unsqueeze(-1))
    event = int(UpdateEvent.ABSORBED) + novel.to(torch.int64) + excess
    if mask is not None:
        event = event * (mask > 0)
    # k** may be 0: no action, no effect
    novelty = gamma / prior.clamp_min(torch.finfo(prior.dtype).tiny)
    return UpdateReport(event, novelty, nis, weight), innovation, v


def _add_and_prune(
    posterior: SparsePosterior, scaled: Tensor, added: Tensor, excess: Tensor, s2: Tensor
) -> None:
    """Add ``scaled added'`` to (C, Q, Omega), then prune the point that loses least where ``excess``.

    Pruning is the KL projection onto the other points. Large fleets are limited by memory, so
    addition and pruning share one pass: what the pruning needs of the sum follows from vectors.
    With a, c, q its entries in alpha, C, Q, stars its remaining columns and ``e = -Q*/q``::

        alpha -= (C*+Q*) a'/(c+q),  C += Q*Q*'/q - (C*+Q*)(C*+Q*)'/(c+q),  Q -= Q*Q*'/q
        Omega <- P'Omega P,  h <- P'h,  P = [I; e']
    """
    M, m, fleet = posterior.capacity + 1, posterior.out_features, posterior.batch_shape
    diagonal = posterior.moments.diagonal(dim1=-2, dim2=-1) + scaled * added
    c_diag, q_diag, w_diag = diagonal.unbind(-2)
    loss = pruning_loss(posterior, c_diag, q_diag, w_diag / s2.unsqueeze(-1))
    loss = loss.where(posterior.active > 0, torch.inf)
    least = loss.amin(-1, keepdim=True)  # up to it and a tie losses differ by rounding: the first one goes
    i = (loss <= least + TIE * least.abs() + TIE_KL * m).to(torch.uint8).argmax(-1, keepdim=True)
    # rows, which lie together in memory, stand for columns
    columns = posterior.moments.gather(-2, i[..., None, None].expand(*fleet, 3, 1, M)).squeeze(-2)
    columns = columns + scaled * added.gather(-1, i.unsqueeze(-2).expand(*fleet, 3, 1))
    c, q, w = columns.gather(-1, i.unsqueeze(-2).expand(*fleet, 3, 1)).unbind(-2)
    C, Q, Om = (columns * posterior.slots.ne(i).unsqueeze(-2)).unbind(-2)
    on = excess.to(q.dtype).unsqueeze(-1)
    q = q.where(excess.unsqueeze(-1), 1.0)  # an empty basis has nothing to divide by
    q_inv = on / q
    cq_inv = on / _remaining(c, q)
    CQ, Qq = C + Q, Q * q_inv
    e, CQc = -Qq, CQ * -cq_inv
    u = Om * on + 0.5 * w * e
    left = torch.stack([Qq, CQc, e, torch.zeros_like(e), u, e], dim=-2).view(*fleet, 3, 2, M)
    right = torch.stack([Q, CQ, Q, Q, e, u], dim=-2).view(*fleet, 3, 2, M)
    left = torch.cat([scaled.unsqueeze(-2), left], dim=-2)
    right = torch.cat([added.unsqueeze(-2), right], dim=-2)
    _add_products(posterior.moments, left.mT, right.mT)
    rows = posterior.vectors.gather(-2, i[..., None, None].expand(*fleet, 2, 1, m))
    _add_products(posterior.vectors, torch.stack([CQc, e], dim=-2).unsqueeze(-1), rows.mT)

    # The slot becomes free: its rows and columns are 0 by definition, not by cancellation.
    free = torch.where(excess.unsqueeze(-1), i, posterior.slot.unsqueeze(-1))
    at = free[..., None, None]
    posterior.moments.scatter_(-1, at.expand(*fleet, 3, M, 1), 0.0)
    posterior.moments.scatter_(-2, at.expand(*fleet, 3, 1, M), 0.0)
    posterior.vectors.scatter_(-2, at.expand(*fleet, 2, 1, m), 0.0)
    posterior.active.scatter_(-1, free, 0.0)
    posterior.slot.copy_(free.squeeze(-1))


def pruning_loss(
    posterior: SparsePosterior,
    c: Float[Tensor, "*batch slots"],
    q: Float[Tensor, "*batch slots"],
    w: Float[Tensor, "*batch slots"],
) -> Float[Tensor, "*batch slots"]:
    """``2 KL = |a|^2/(c+q) + m (w/q + ln(1 + c/q))``: exact loss of pruning each point (Csato's thesis).

    a, c, q, w are a point's entries in alpha and on the diagonals of C, Q and W. The first term is the
    loss in the mean (Csato & Opper 2002).
    """
    rest = _remaining(c, q)
    loss = posterior.alpha.square().sum(-1) / rest
    return loss + posterior.out_features * (w / q + (rest / q).log())


def _remaining(c: Tensor, q: Tensor) -> Tensor:
    """c + q >= 0, a point's remaining uncertainty; rounding must not turn it negative."""
    return torch.maximum(c + q, 100 * torch.finfo(q.dtype).eps * q)


def _add_products(target: Tensor, left: Tensor, right: Tensor) -> None:
    """target += left right', in place, over all leading axes in one call."""
    flat = target.view(-1, *target.shape[-2:])
    flat.baddbmm_(left.reshape(-1, *left.shape[-2:]), right.reshape(-1, *right.shape[-2:]).mT)


def _any(flag: Tensor) -> bool:
    """Skip work that no model needs where looking is free: on the CPU."""
    return flag.is_cuda or bool(flag.any())
