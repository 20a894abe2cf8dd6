"""Rotations, batched: ``hat``, ``exp``, ``log``.

Twists are ``(v; w)`` in hand-frame axes about the object's reference point. The state is ``s = [q; p]``; its
increment is ``ds = [dq; do; dphi]`` with ``dphi = Log(R+ R^T)``, so ``R+ = exp([dphi]x) R``: rotation vectors
are never added.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import torch

from .._arrays import is_plain, namespace
from ..typing import AnyArray, Float, Tensor

_NEXT, _LAST = [1, 2, 0], [2, 0, 1]


@lru_cache
def _generators(dtype: torch.dtype, device: torch.device) -> Float[Tensor, "3 9"]:
    """Rows: the skew matrices of the three axes, row by row."""
    with torch.inference_mode(False):
        E = torch.zeros(3, 3, 3, dtype=dtype, device=device)
        for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
            E[i, k, j], E[i, j, k] = 1.0, -1.0
        return E.flatten(1)


_ROWS = _generators(torch.float64, torch.device("cpu")).numpy()


def hat(v: Float[AnyArray, "*batch 3"]) -> Float[Any, "*batch 3 3"]:
    """Skew matrix ``[v]x`` with ``[v]x w = v x w``."""
    rows = _generators(v.dtype, v.device) if isinstance(v, Tensor) else _ROWS
    return (v @ rows).reshape(*v.shape, 3)


def cross(v: Float[AnyArray, "*#batch 3"], w: Float[AnyArray, "*#batch 3"]) -> Any:
    """``v x w``."""
    if isinstance(v, Tensor):
        return torch.linalg.cross(v, w)
    return v[..., _NEXT] * w[..., _LAST] - v[..., _LAST] * w[..., _NEXT]


def exp(phi: Float[AnyArray, "*batch 3"]) -> Float[Any, "*batch 3 3"]:
    """Rodrigues: ``exp([phi]x) = I + sin t/t [phi]x + (1 - cos t)/t^2 [phi]x^2``, ``t = |phi|`` [rad].

    Smooth at 0 (series for small angles), so it can be differentiated there.
    """
    if isinstance(phi, Tensor) and is_plain(phi):
        return torch.from_numpy(exp(phi.numpy()))
    xp = namespace(phi)
    square = (phi * phi).sum(-1)
    small = square < 1e-8
    safe = xp.where(small, 1.0, square)
    t = xp.sqrt(safe)
    a = xp.where(small, 1 - square / 6, xp.sin(t) / t)
    b = xp.where(small, 0.5 - square / 24, (1 - xp.cos(t)) / safe)
    skew = hat(phi)
    eye = xp.eye(3, dtype=phi.dtype, device=phi.device)
    return eye + a[..., None, None] * skew + b[..., None, None] * (skew @ skew)


def log(rotation: Float[AnyArray, "*batch 3 3"]) -> Float[Any, "*batch 3"]:
    """Inverse of :func:`exp` for angles below pi: the vector ``phi`` [rad] with ``exp([phi]x) = R``.

    At a half turn the axis is defined up to its sign; either is returned.
    """
    if isinstance(rotation, Tensor) and is_plain(rotation):
        return torch.from_numpy(log(rotation.numpy()))
    xp = namespace(rotation)
    pairs = (2, 1), (0, 2), (1, 0)
    w = xp.stack([rotation[..., i, j] - rotation[..., j, i] for i, j in pairs], -1)
    sine2 = (w * w).sum(-1) / 4  # sin^2 t
    trace = rotation[..., 0, 0] + rotation[..., 1, 1] + rotation[..., 2, 2]
    cosine = (trace - 1) / 2
    small = sine2 < 1e-10
    sine = xp.sqrt(xp.where(small, 1.0, sine2))
    t = xp.atan2(sine, cosine)
    factor = xp.where(small, 0.5 + sine2 / 12, t / (2 * sine))
    result = factor[..., None] * w
    half_turn = small & (cosine < 0)
    if bool(half_turn.any()):
        near = _log_near_half_turn(torch.as_tensor(rotation))
        result = xp.where(half_turn[..., None], near if xp is torch else near.numpy(), result)
    return result


def _log_near_half_turn(rotation: Tensor) -> Tensor:
    """``R + I = 2 z z^T`` at a half turn: the largest column gives the axis."""
    outer = (rotation + torch.eye(3, dtype=rotation.dtype, device=rotation.device)) / 2
    diagonal = outer.diagonal(dim1=-2, dim2=-1)
    k = diagonal.argmax(-1)
    column = torch.take_along_dim(outer, k[..., None, None].expand(*k.shape, 3, 1), -1)[..., 0]
    return torch.pi * column / torch.linalg.vector_norm(column, dim=-1, keepdim=True)
