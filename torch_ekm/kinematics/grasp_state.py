"""State of a grasp and its increments.

The state is ``s = [q; p]``; its increment is ``ds = [dq; do; dphi]`` with ``dphi`` a rotation
increment in hand-frame axes. Rotation vectors are never added.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from .._arrays import is_plain
from .._checks import check_finite, check_kind, check_last, check_shape
from ..exceptions import ParameterError, ShapeError
from ..typing import Float, Tensor
from .se3 import cross, exp, log
from .tensors import as_tensors

A_STATE = "a GraspState, e.g. observation.state"
_ROUNDED = 1e-4
"""What a rotation matrix may be off by, entry by entry: four digits are enough, a scale or a shear is not."""


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
        check_shape("position", self.position, (*self.q.shape[:-1], 3), "to go with q")
        check_shape("rotation", self.rotation, (*self.q.shape[:-1], 3, 3), "to go with q")
        total = self.q.sum() + self.position.sum() + self.rotation.sum()  # an infinity or a NaN is in it
        if not math.isfinite(total):
            for name in given:
                check_finite(name, getattr(self, name))
        check_rotation(self.rotation)

    @property
    def n_s(self) -> int:
        """Size of an increment: ``n_q + 6``."""
        return self.q.shape[-1] + 6

    def plus(self, ds: Float[Tensor, "*batch n_s"]) -> GraspState:
        """Retraction: ``q + dq``, ``o + do``, ``exp([dphi]x) R``."""
        (ds,), n_q = as_tensors(ds=ds), self.q.shape[-1]
        check_last("ds", ds, n_q + 6, "it is [dq; do; dphi]")
        dq, do, dphi = ds.split([n_q, 3, 3], dim=-1)
        return GraspState(self.q + dq, self.position + do, exp(dphi) @ self.rotation)

    def minus(self, earlier: GraspState) -> Float[Tensor, "*batch n_s"]:
        """``ds`` with ``earlier.plus(ds) = self``: ``[q+ - q; o+ - o; Log(R+ R^T)]``."""
        check_kind("state", earlier, GraspState, A_STATE)
        dphi = log(self.rotation @ earlier.rotation.mT)
        return torch.cat([self.q - earlier.q, self.position - earlier.position, dphi], dim=-1)


def check_rotation(R: Tensor) -> None:
    """``cof R = R``: every column is the cross product of the other two, which holds for rotations only."""
    rows = R.detach().numpy() if is_plain(R.detach()) else R.detach()
    y_z_x, z_x_y = (rows.mT[..., order, :] for order in ([1, 2, 0], [2, 0, 1]))  # columns of R
    off = abs(cross(y_z_x, z_x_y) - rows.mT).max()
    if float(off) > _ROUNDED:
        what = "a reflection" if bool((torch.linalg.det(R) < 0).any()) else "scaled or sheared"
        valid = f"a rotation matrix, R^T R = I and det R = 1 (it is {what}, off by {float(off):.2g})"
        raise ParameterError("rotation", R.tolist() if R.dim() == 2 else tuple(R.shape), valid)
