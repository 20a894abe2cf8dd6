"""Rotations and twists, batched: ``hat``, ``exp``, ``log``.

Twists are ``(v; w)`` in world (= hand frame) axes about the object's reference point;
rotation increments are ``dphi = Log(R+ R^T)``, so ``R+ = exp([dphi]x) R``.
"""

from __future__ import annotations

from functools import lru_cache

import torch

from ..typing import Float, Tensor


@lru_cache
def _generators(dtype: torch.dtype, device: torch.device) -> Float[Tensor, "3 9"]:
    """Rows: the skew matrices of the three axes, row by row."""
    with torch.inference_mode(False):
        E = torch.zeros(3, 3, 3, dtype=dtype, device=device)
        for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
            E[i, k, j], E[i, j, k] = 1.0, -1.0
        return E.flatten(1)


def hat(v: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Skew matrix ``[v]x`` with ``[v]x w = v x w``."""
    return (v @ _generators(v.dtype, v.device)).unflatten(-1, (3, 3))


def exp(phi: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Rodrigues: ``exp([phi]x) = I + sin t/t [phi]x + (1 - cos t)/t^2 [phi]x^2``, ``t = |phi|`` [rad].

    Smooth at 0 (series for small angles), so it can be differentiated there.
    """
    square = (phi * phi).sum(-1)
    small = square < 1e-8
    safe = torch.where(small, torch.ones_like(square), square)
    t = safe.sqrt()
    a = torch.where(small, 1 - square / 6, torch.sin(t) / t)
    b = torch.where(small, 0.5 - square / 24, (1 - torch.cos(t)) / safe)
    skew = hat(phi)
    eye = torch.eye(3, dtype=phi.dtype, device=phi.device)
    return eye + a[..., None, None] * skew + b[..., None, None] * (skew @ skew)


def log(rotation: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3"]:
    """Inverse of :func:`exp` for angles below pi: the vector ``phi`` [rad] with ``exp([phi]x) = R``.

    At a half turn the axis is defined up to its sign; either is returned.
    """
    w = torch.stack(
        [
            rotation[..., 2, 1] - rotation[..., 1, 2],
            rotation[..., 0, 2] - rotation[..., 2, 0],
            rotation[..., 1, 0] - rotation[..., 0, 1],
        ],
        dim=-1,
    )
    sine2 = (w * w).sum(-1) / 4  # sin^2 t
    trace = rotation.diagonal(dim1=-2, dim2=-1).sum(-1)
    cosine = (trace - 1) / 2
    small = sine2 < 1e-10
    sine = torch.where(small, torch.ones_like(sine2), sine2).sqrt()
    t = torch.atan2(sine, cosine)
    factor = torch.where(small, 0.5 + sine2 / 12, t / (2 * sine))
    result = factor[..., None] * w
    half_turn = small & (cosine < 0)
    if bool(half_turn.any()):
        result = torch.where(half_turn[..., None], _log_near_half_turn(rotation), result)
    return result


def _log_near_half_turn(rotation: Tensor) -> Tensor:
    """``R + I = 2 z z^T`` at a half turn: the largest column gives the axis."""
    outer = (rotation + torch.eye(3, dtype=rotation.dtype, device=rotation.device)) / 2
    diagonal = outer.diagonal(dim1=-2, dim2=-1)
    k = diagonal.argmax(-1)
    column = torch.take_along_dim(outer, k[..., None, None].expand(*k.shape, 3, 1), -1)[..., 0]
    return torch.pi * column / torch.linalg.vector_norm(column, dim=-1, keepdim=True)
