"""The focused pose: the part of the object's pose that a task asks for."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from ..exceptions import NonFiniteError, ParameterError, ShapeError
from ..kinematics.grasp_state import GraspState
from ..kinematics.null_space import null_space
from ..kinematics.se3 import exp, log
from ..typing import Float, Tensor


@dataclass(frozen=True)
class PoseTarget:
    """Where the object shall be: point ``o_r`` [m] and orientation ``R_r``, hand frame."""

    position: Float[Tensor, " 3"]
    rotation: Float[Tensor, "3 3"]

    def error(self, state: GraspState) -> Float[Tensor, " 6"]:
        """``(o_r - o_f, Log(R_r R_f^T))`` [m, rad]: the twist that would bring the object home."""
        return torch.cat([self.position - state.position, log(self.rotation @ state.rotation.mT)])

    @classmethod
    def turned(
        cls,
        state: GraspState,
        axis: Float[Tensor, " 3"],
        angle: float | None = None,
        *,
        degrees: float | None = None,
    ) -> PoseTarget:
        """The pose of ``state`` turned by ``angle`` [rad] or ``degrees`` about ``axis`` through its point o.

        Raises:
            ParameterError: both angles are given, or none.
            NonFiniteError: the angle is NaN or infinite.
        """
        if (angle is None) == (degrees is None):
            raise ParameterError("angle, degrees", (angle, degrees), "one of the two")
        angle = math.radians(degrees) if angle is None else angle  # type: ignore[arg-type]
        if not torch.isfinite(torch.as_tensor(angle)):
            raise NonFiniteError("angle")
        axis = axis / torch.linalg.vector_norm(axis)
        return cls(state.position, exp(axis * angle) @ state.rotation)


class FocusedPose:
    """``x = M_c xi`` with ``xi`` a twist ``(v; w)`` of the object (hand axes).

    ``matrix`` (M_c, ``(n_x, 6)``) selects what the controller must reach; ``off_matrix``
    spans the rest, which it should keep small; ``off_translation`` marks its translations.

    Args:
        matrix: M_c with orthonormal rows.
    """

    def __init__(self, matrix: Float[Tensor, "n_x 6"]) -> None:
        if matrix.ndim != 2 or matrix.shape[1] != 6:
            raise ShapeError("matrix", "(n_x, 6)", matrix.shape)
        gram = matrix @ matrix.mT
        if not torch.allclose(gram, torch.eye(len(matrix), dtype=matrix.dtype), atol=1e-9):
            raise ParameterError("matrix", "M_c", "a matrix with orthonormal rows (M_c M_c^T = I)")
        self.matrix = matrix
        # translation and rotation rows are completed apart: they have different units
        self.off_matrix = torch.cat([_complement(matrix, slice(0, 3)), _complement(matrix, slice(3, 6))])
        self.off_translation = self.off_matrix[:, :3].abs().sum(-1) > 0

    @classmethod
    def rotation_about(cls, axis: Float[Tensor, " 3"]) -> FocusedPose:
        """The rotation about one axis (hand frame), as in all experiments of the paper."""
        norm = torch.linalg.vector_norm(axis)
        if not norm > 1e-9:
            raise ParameterError("axis", axis.tolist(), "a vector of non-zero length")
        return cls(torch.cat([torch.zeros(3, dtype=axis.dtype), axis / norm])[None])

    def error(self, target: PoseTarget, state: GraspState) -> float:
        """``|M_c e|``, e the twist from the state to the target [unit of the focus]."""
        return float(torch.linalg.vector_norm(self.matrix @ target.error(state)))

    def off_rotation(self, increment: Float[Tensor, " n_s"]) -> float:
        """Rotation off the focus in an increment [rad]."""
        rows = self.off_matrix[~self.off_translation]
        return float(torch.linalg.vector_norm(rows @ increment[-6:]))


def _complement(matrix: Tensor, block: slice) -> Tensor:
    """Rows of the 6-vector block that M_c leaves free: null space of its columns in that block."""
    free = null_space(matrix[:, block]).mT
    rows = torch.zeros(len(free), 6, dtype=matrix.dtype)
    rows[:, block] = free
    return rows
