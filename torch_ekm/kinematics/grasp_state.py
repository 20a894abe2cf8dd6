"""State of a grasp and its increments.

The state is ``s = [q; p]``; its increment is ``ds = [dq; do; dphi]`` with ``dphi`` a rotation
increment in hand-frame axes. Rotation vectors are never added.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from ..exceptions import NonFiniteError, ParameterError, ShapeError
from ..typing import Float, Tensor
from .se3 import exp, log
from .tensors import as_tensors

_ORTHONORMAL = 1e-4
"""Largest entry of ``R^T R - I`` of a rotation: four digits are enough, a scale or a shear is not."""


@dataclass(frozen=True)
class GraspState:
    """Joint angles ``q`` [rad] and object pose: point ``o`` [m] and rotation ``R``, in the hand frame.

    Arrays and nested lists are converted, and all three get the widest of their precisions.

    Raises:
        ShapeError: the three do not belong together.
        NonFiniteError: any entry is NaN or infinite.
        ParameterError: ``rotation`` is none (scaled, sheared, a reflection), or there are no numbers.
    """

    q: Float[Tensor, "*batch n_q"]
    position: Float[Tensor, "*batch 3"]
    rotation: Float[Tensor, "*batch 3 3"]

    def __post_init__(self) -> None:
        given = {name: getattr(self, name) for name in ("q", "position", "rotation")}
        for name, value in zip(given, as_tensors(**given), strict=True):
            object.__setattr__(self, name, value)  # the dataclass is frozen
        if self.q.dim() == 0:
            raise ShapeError("q", "(*batch, n_q)", self.q.shape)
        batch = self.q.shape[:-1]
        if self.position.shape != (*batch, 3):
            raise ShapeError("position", f"{(*batch, 3)} to go with q", self.position.shape)
        if self.rotation.shape != (*batch, 3, 3):
            raise ShapeError("rotation", f"{(*batch, 3, 3)} to go with q", self.rotation.shape)
        for name in ("q", "position", "rotation"):
            value = getattr(self, name)
            finite = torch.isfinite(value)
            if not bool(finite.all()):
                raise NonFiniteError(name, torch.nonzero(~finite)[:3].tolist())
        _check_rotation(self.rotation.detach())

    @property
    def n_s(self) -> int:
        """Size of an increment: ``n_q + 6``."""
        return self.q.shape[-1] + 6

    def plus(self, ds: Float[Tensor, "*batch n_s"]) -> GraspState:
        """Retraction: ``q + dq``, ``o + do``, ``exp([dphi]x) R``."""
        n_q = self.q.shape[-1]
        if ds.shape[-1] != n_q + 6:
            raise ShapeError("ds", f"(*batch, {n_q + 6})", ds.shape, "it is [dq; do; dphi]")
        dq, do, dphi = ds.split([n_q, 3, 3], dim=-1)
        return GraspState(self.q + dq, self.position + do, exp(dphi) @ self.rotation)

    def minus(self, earlier: GraspState) -> Float[Tensor, "*batch n_s"]:
        """``ds`` with ``earlier.plus(ds) = self``: ``[q+ - q; o+ - o; Log(R+ R^T)]``."""
        dphi = log(self.rotation @ earlier.rotation.mT)
        return torch.cat([self.q - earlier.q, self.position - earlier.position, dphi], dim=-1)

    def coordinates(self, reference: GraspState) -> Float[Tensor, "*batch n_s"]:
        """Inputs for a learner: ``[q; o - o_ref; Log(R R_ref^T)]``."""
        dphi = log(self.rotation @ reference.rotation.mT)
        return torch.cat([self.q, self.position - reference.position, dphi], dim=-1)


def _check_rotation(R: Tensor) -> None:
    """``R^T R = I`` and ``det R = 1``."""
    off = (R.mT @ R - torch.eye(3, dtype=R.dtype, device=R.device)).abs()
    reflected = torch.linalg.det(R) < 0
    if bool((off > _ORTHONORMAL).any()) or bool(reflected.any()):
        found = "a reflection, det R = -1" if bool(reflected.any()) else f"R^T R - I up to {float(off.max()):.2g}"
        valid = f"a rotation matrix, R^T R = I and det R = 1 (found {found})"
        raise ParameterError("rotation", R.tolist() if R.dim() == 2 else tuple(R.shape), valid)
