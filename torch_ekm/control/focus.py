"""The focused pose: the part of the object's pose that a task asks for."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch

from .._arrays import as_tensors, null_space
from .._checks import check_finite, check_kind, check_positive, check_shape
from ..exceptions import NonFiniteError, ParameterError, UnknownNameError
from ..kinematics.poses import A_STATE, GraspState, check_rotation
from ..kinematics.se3 import exp, log
from ..typing import Float, Tensor

A_TARGET = "a PoseTarget, e.g. PoseTarget.turned(state, axis, degrees=20)"
_SI = {"deg": math.pi / 180, "mm": 1e-3}
_USUAL = {"tolerance": {"deg": 0.25, "mm": 0.2}, "step": {"deg": 2.5, "mm": 2.0}}  # what counts alike


@dataclass(frozen=True)
class PoseTarget:
    """Where the object shall be: point ``o_r`` [m] and orientation ``R_r``, hand frame.

    Raises:
        ShapeError, NonFiniteError, ParameterError: no point, or no rotation matrix.
    """

    position: Float[Tensor, " 3"]
    rotation: Float[Tensor, "3 3"]

    def __post_init__(self) -> None:
        given = as_tensors(position=self.position, rotation=self.rotation)
        for name, value, shape in zip(("position", "rotation"), given, ((3,), (3, 3)), strict=True):
            check_shape(name, value, shape)
            check_finite(name, value)
            object.__setattr__(self, name, value.double())  # the dataclass is frozen
        check_rotation(self.rotation)

    def error(self, state: GraspState) -> Float[Tensor, " 6"]:
        """``(o_r - o_f, Log(R_r R_f^T))`` [m, rad]: the twist that would bring the object home."""
        check_kind("state", state, GraspState, A_STATE)
        position, rotation = self.position.to(state.position), self.rotation.to(state.rotation)
        return torch.cat([position - state.position, log(rotation @ state.rotation.mT)])

    @classmethod
    def turned(
        cls,
        start: GraspState | PoseTarget,
        axis: Float[Tensor, " 3"],
        angle: float | None = None,
        *,
        degrees: float | None = None,
    ) -> PoseTarget:
        """The pose of ``start`` turned by ``angle`` [rad] or ``degrees`` about ``axis`` through its point o.

        Raises:
            ParameterError: both angles are given, or none.
            NonFiniteError: the angle is NaN or infinite.
        """
        if (angle is None) == (degrees is None):
            raise ParameterError("angle, degrees", (angle, degrees), "one of the two")
        angle = math.radians(degrees) if angle is None else angle  # type: ignore[arg-type]
        if not torch.isfinite(torch.as_tensor(angle)):
            raise NonFiniteError("angle")
        axis = _unit(axis)
        return cls(start.position, exp(axis.to(start.position) * angle) @ start.rotation)

    @classmethod
    def moved(
        cls, start: GraspState | PoseTarget, axis: Float[Tensor, " 3"], *, millimetres: float
    ) -> PoseTarget:
        """The pose of ``start`` shifted along ``axis`` (hand frame); of a :meth:`turned` target: both.

        Raises:
            NonFiniteError: the distance is NaN or infinite.
        """
        if not math.isfinite(millimetres):
            raise NonFiniteError("millimetres")
        axis = _unit(axis)
        return cls(start.position + 1e-3 * millimetres * axis.to(start.position), start.rotation)


@dataclass(frozen=True, eq=False)
class Direction:
    """A direction of a focused pose: turns about an axis of the hand frame, or shifts along it.

    Raises:
        UnknownNameError: the unit is missing, or another.
        ShapeError, ParameterError: the axis is no vector with a length, or a figure is not above 0.
    """

    axis: Float[Tensor, " 3"]
    unit: str = ""
    """"deg": it turns about the axis; "mm": it shifts along it. Tolerance and step have this unit."""
    tolerance: float | None = None
    """None: 0.25 deg or 0.2 mm."""
    step: float | None = None
    """Largest of a step; None: 2.5 deg or 2 mm."""

    def __post_init__(self) -> None:
        if self.unit not in _SI:
            raise UnknownNameError("unit", self.unit, _SI)
        object.__setattr__(self, "axis", as_tensors(axis=self.axis)[0].double())  # the dataclass is frozen
        _unit(self.axis)
        for name in ("tolerance", "step"):
            if getattr(self, name) is not None:
                check_positive(name, getattr(self, name))

    @property
    def row(self) -> Float[Tensor, " 6"]:
        """Of M_c."""
        axis, none = _unit(self.axis), torch.zeros_like(self.axis)
        return torch.cat([none, axis] if self.unit == "deg" else [axis, none])

    def scale(self, figure: str) -> float:
        """Turn that counts as much as 1 rad or 1 m of this direction, by its "tolerance" or "step" [rad]."""
        usual, own = _USUAL[figure], getattr(self, figure)
        return usual["deg"] * _SI["deg"] / ((usual[self.unit] if own is None else own) * _SI[self.unit])

    def __str__(self) -> str:
        verb = "turn about" if self.unit == "deg" else "shift along"
        return f"{verb} ({', '.join(f'{x:.2g}' for x in self.axis.tolist())})"


class FocusedPose:
    """``x = M_c xi`` with ``xi`` a twist ``(v; w)`` of the object (hand axes), in one to six directions.

    ``matrix`` (M_c, ``(n_x, 6)``) selects what the controller must reach; ``off_matrix``
    spans the rest, which it should keep small; ``off_translation`` marks its translations.

    Errors in different units are compared as turns that count as much, by their tolerance or by their step::

        tolerance_scale_i = 0.25 deg / tolerance_i,    step_scale_i = 2.5 deg / step_i

    Args:
        directions: perpendicular to each other, turns to turns and shifts to shifts.

    Raises:
        ParameterError: they are not, or no Directions.
    """

    def __init__(self, directions: Sequence[Direction]) -> None:
        listed = "a list of one to six Directions"
        if not check_kind("directions", directions, Sequence, listed):
            raise ParameterError("directions", directions, listed)
        self.directions = tuple(check_kind("directions", one, Direction, listed) for one in directions)
        matrix = self.matrix = torch.stack([one.row for one in self.directions])
        if not bool(((matrix @ matrix.mT - torch.eye(len(matrix)).to(matrix)).abs() < 1e-9).all()):
            valid = "perpendicular to each other: turns to turns, shifts to shifts"
            raise ParameterError("directions", [str(one) for one in self.directions], valid)
        self.tolerance_scale = matrix.new_tensor([one.scale("tolerance") for one in self.directions])
        self.step_scale = matrix.new_tensor([one.scale("step") for one in self.directions])
        # translation and rotation rows are completed apart: they have different units
        self.off_matrix = torch.cat([_complement(matrix, slice(0, 3)), _complement(matrix, slice(3, 6))])
        self.off_translation = self.off_matrix[:, :3].abs().sum(-1) > 0

    @classmethod
    def rotation_about(cls, axis: Float[Tensor, " 3"]) -> FocusedPose:
        """The rotation about one axis (hand frame), as in all experiments of the paper.

        Raises:
            ParameterError: no axis.
        """
        return cls([Direction(axis, "deg")])

    @property
    def is_turn(self) -> bool:
        """A rotation about one axis, and nothing else."""
        return [one.unit for one in self.directions] == ["deg"]

    def error(self, target: PoseTarget, state: GraspState) -> float:
        """``|e| = max_i tolerance_scale_i |e_i|`` [rad], ``e = M_c`` times the twist from state to target."""
        return float((self.tolerance_scale * (self.matrix @ target.error(state))).abs().max())

    def off_rotation(self, increment: Float[Tensor, " n_s"]) -> float:
        """Rotation off the focus in an increment [rad]."""
        rows = self.off_matrix[~self.off_translation]
        return float(torch.linalg.vector_norm(rows @ increment[-6:]))


def _unit(axis: Float[Tensor, " 3"]) -> Float[Tensor, " 3"]:
    """The axis with length 1."""
    axis = as_tensors(axis=axis)[0]
    check_shape("axis", axis, (3,))
    length = torch.linalg.vector_norm(axis)
    if not 1e-9 < length < math.inf:
        raise ParameterError("axis", axis.tolist(), "a vector of non-zero length")
    return axis / length


def _complement(matrix: Tensor, block: slice) -> Tensor:
    """Rows of the 6-vector block that M_c leaves free: null space of its columns in that block."""
    free = null_space(matrix[:, block]).mT
    rows = torch.zeros(len(free), 6, dtype=matrix.dtype)
    rows[:, block] = free
    return rows
