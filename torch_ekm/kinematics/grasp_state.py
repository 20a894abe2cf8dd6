"""State of a grasp and its increments.

The state is ``s = [q; p]``; its increment is ``ds = [dq; do; dphi]`` with ``dphi`` a rotation
increment in hand-frame axes. Rotation vectors are never added.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from ..exceptions import NonFiniteError, ShapeError
from ..typing import Float, Tensor
from .se3 import exp, log


@dataclass(frozen=True)
class GraspState:
    """Joint angles ``q`` [rad] and object pose: point ``o`` [m] and rotation ``R``, in the hand frame.

    Raises:
        ShapeError: the three do not belong together.
        NonFiniteError: any entry is NaN or infinite.
    """

    q: Float[Tensor, "*batch n_q"]
    position: Float[Tensor, "*batch 3"]
    rotation: Float[Tensor, "*batch 3 3"]

    def __post_init__(self) -> None:
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
