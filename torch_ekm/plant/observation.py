"""A reading of a hand, the mean of several, and the one place where a plant's reading is looked at."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from functools import cached_property
from typing import Any, NamedTuple

import torch

from .._checks import check_finite, check_kind, check_shape
from ..description import HandDescription
from ..exceptions import ParameterError
from ..kinematics import GraspState
from ..kinematics.poses import exp, log
from ..typing import Float, Tensor


class PlantStatus(Enum):
    """Whether a plant holds its object, and sees it."""

    HELD = "held"
    LOST = "lost"  # dropped, thrown, or out of the fingers
    NOT_SEEN = "not_seen"  # the camera did not find it in this frame


@dataclass(frozen=True)
class Truth:
    """The true state of a simulation, hand frame.

    For reports and for sensors that are simulated; a :class:`Trajectory` stores it. Nothing that controls,
    senses or learns may read it (held by a test).
    """

    q: Float[Tensor, " n_q"]
    """Joint angles [rad]."""
    position: Float[Tensor, " 3"]
    """Object point o [m]."""
    rotation: Float[Tensor, "3 3"]
    """Object orientation R, object frame to hand frame."""
    fingertip_force: Float[Tensor, " n_pads"] | None = None
    """Normal force of each contact pad [N]."""
    actuator_torque: Float[Tensor, " n_a"] | None = None
    """Torque of each actuator along ``+a`` [N m]."""
    pictured: GraspState | None = None
    """The state when the newest picture was taken; None: the present one."""

    @property
    def state(self) -> GraspState:
        """True joint angles [rad] and object pose in the hand frame [m]."""
        return GraspState(self.q, self.position, self.rotation)

    def arrays(self) -> dict[str, Tensor]:
        """What is known of this moment, by name."""
        return {name: value for name, value in vars(self).items() if isinstance(value, Tensor)}


class Stamps(NamedTuple):
    """When each sensor took its reading [s], by the clock of ``Observation.time``."""

    encoders: float
    joints: float
    pose: float
    """When the picture was taken; a pose that is repeated keeps its old stamp."""
    fingertips: float


@dataclass(frozen=True)
class Observation:
    """What the sensors say, in SI units and the hand frame.

    A driver that gives neither ``time`` nor ``stamps`` is undated: nobody can see that it repeats itself
    but by equal readings.

    Raises:
        NonFiniteError: any entry is NaN or infinite.
        ParameterError: one that is no tensor.
    """

    q: Float[Tensor, " n_q"]
    """Estimated joint angles [rad] (Hall sensors)."""
    a: Float[Tensor, " n_a"]
    """Actuator encoders [rad]."""
    position: Float[Tensor, " 3"]
    """Object point o [m] (markers)."""
    rotation: Float[Tensor, "3 3"]
    """Object orientation R, object frame to hand frame."""
    fingertip_force: Float[Tensor, " n_pads"] | None = None
    """Normal force of each contact pad [N], in the order of ``HandDescription.pads``; None: no sensors."""
    time: float = 0.0
    """When this was put together [s], by a clock that does not go back."""
    status: PlantStatus = PlantStatus.HELD
    info: dict[str, Any] = field(default_factory=dict)
    """Anything else, such as raw readings for a log."""
    truth: Truth | None = None
    """Of a simulation: for reports only."""
    stamps: Stamps | None = None
    """When each sensor took its reading; None: all at ``time``."""

    def __post_init__(self) -> None:
        for name in ("q", "a", "position", "rotation", "fingertip_force"):
            value = getattr(self, name)
            if value is None and name == "fingertip_force":
                continue
            name = f"Observation.{name}"
            check_finite(name, check_kind(name, value, torch.Tensor, "a torch tensor"))

    @property
    def taken(self) -> Stamps:
        """When each sensor took its reading [s]."""
        return Stamps(*(self.time,) * 4) if self.stamps is None else self.stamps

    @property
    def dated(self) -> bool:
        """Whether the driver gave ``time`` or ``stamps``."""
        return self.time != 0.0 or self.stamps is not None

    @cached_property
    def state(self) -> GraspState:
        """Joint angles and object pose, as measured."""
        return GraspState(self.q, self.position, self.rotation)


_OUTLIER = 4.0  # times the median distance from the median: 6 standard deviations of a Gaussian in space
_ROUNDED = 1e-6  # of the largest entry of a covariance: what rounding may leave of its symmetry and sign


def mean_reading(readings: Sequence[Observation]) -> Observation:
    """What several readings of a hand at rest say together, see :class:`FramesAtRest`."""
    shown = [o for o in readings if o.status is PlantStatus.HELD]
    last = readings[-1]
    position, rotation, status, stamps = last.position, last.rotation, PlantStatus.NOT_SEEN, last.stamps
    covariance = last.q.new_full((6, 6), torch.nan)
    if shown:
        status = PlantStatus.HELD
        position, rotation, covariance = _mean_pose(shown)
        stamps = last.taken._replace(pose=min(o.taken.pose for o in shown))  # no newer than any of them
    forces = [o.fingertip_force for o in readings if o.fingertip_force is not None]
    info = {**last.info, **{name: readings[0].info[name] for name in ("events",) if name in readings[0].info}}
    info["estimate"] = {**info.get("estimate", {}), "pose_covariance": covariance}
    return dataclasses.replace(
        last,
        q=torch.stack([o.q for o in readings]).mean(0),
        position=position,
        rotation=rotation,
        fingertip_force=torch.stack(forces).mean(0) if forces else None,
        status=status,
        info=info,
        stamps=stamps if last.dated else None,
    )


def _mean_pose(
    frames: Sequence[Observation],
) -> tuple[Float[Tensor, " 3"], Float[Tensor, "3 3"], Float[Tensor, "6 6"]]:
    """Robust mean of the poses, and its covariance."""
    o, R = torch.stack([f.position for f in frames]), torch.stack([f.rotation for f in frames])
    centre = R[0]
    for _ in range(2):  # an outlier may come first: its tangent space is not that of the others
        centre = exp(log(R @ centre.mT).quantile(0.5, dim=0)) @ centre
    twist = torch.cat([o - o.quantile(0.5, dim=0), log(R @ centre.mT)], dim=-1)
    away = torch.linalg.vector_norm(twist.unflatten(-1, (2, 3)), dim=-1)
    away = (away / away.quantile(0.5, dim=0).clamp_min(1e-12)).amax(-1)
    kept = away <= _OUTLIER * away.quantile(0.5).clamp_min(1.0)
    n = int(kept.sum())
    stated = [f.info.get("estimate", {}).get("pose_covariance") for f in frames]
    if all(covariance is not None for covariance in stated):
        covariance = torch.stack(stated)[kept].mean(0) / n
    else:
        covariance = torch.diag_embed(twist[kept].var(0)) if n > 1 else twist.new_full((6, 6), torch.nan)
        covariance = covariance / n
    return o[kept].mean(0), exp(twist[kept, 3:].mean(0)) @ centre, covariance


def readable(seen: Observation, hand: HandDescription) -> Observation:
    """``seen`` in float64, on the CPU and without gradients; the same object where nothing is to be changed.

    What is not checked here: whether the numbers can be true. That is for
    :class:`~torch_ekm.control.Guards`.

    Args:
        hand: gives the lengths.

    Raises:
        ShapeError: it is of another hand, or part of it is missing; or a covariance is not ``(6, 6)``.
        NonFiniteError: an entry is NaN or infinite.
        ParameterError: it is no reading, its rotation is none, its status, time, stamps or info is of
            another kind, or its covariance is none.
    """
    check_kind("the plant's reading", seen, Observation, "an Observation")
    shapes = {"q": (hand.n_q,), "a": (hand.n_a,), "position": (3,), "rotation": (3, 3)}
    if seen.fingertip_force is not None:
        shapes["fingertip_force"] = (len(hand.pads),)
    check_kind("Observation.status", seen.status, PlantStatus, "a PlantStatus, such as PlantStatus.LOST")
    right: dict[str, Any] = {name: _numbers(name, getattr(seen, name), shapes[name], hand) for name in shapes}
    right["time"] = _clock("time", seen.time)
    if seen.stamps is not None:
        check_kind("Observation.stamps", seen.stamps, tuple, "Stamps")
        if len(seen.stamps) != len(Stamps._fields):
            raise ParameterError("Observation.stamps", seen.stamps, f"{len(Stamps._fields)} times [s]")
        right["stamps"] = Stamps(*(_clock("stamps", at) for at in seen.stamps))
    right["info"] = _info(seen.info)
    changed = {name: value for name, value in right.items() if value is not getattr(seen, name)}
    seen = dataclasses.replace(seen, **changed) if changed else seen
    _ = seen.state  # kept by the reading; refuses what is no rotation
    return seen


def _numbers(name: str, value: Any, shape: tuple[int, ...], hand: HandDescription) -> Tensor:
    name = f"Observation.{name}"
    check_kind(name, value, torch.Tensor, "a torch tensor")
    check_shape(name, value, shape, f"the hand is '{hand.name}'")
    _check_real(name, value)
    if value.requires_grad:
        raise ParameterError(name, value, "free of gradients: detach() it")
    value = value.to("cpu", torch.float64)
    check_finite(name, value)
    return value


def _check_real(name: str, value: Tensor) -> None:
    if value.is_complex() or value.dtype is torch.bool or value.layout is not torch.strided:
        raise ParameterError(name, value, "real numbers in a dense tensor")


def _clock(name: str, value: Any) -> float:
    if isinstance(value, float) and math.isfinite(value):
        return value
    try:
        seconds = math.nan if isinstance(value, str | bytes | bool) else float(value)
    except (TypeError, ValueError, OverflowError):
        seconds = math.nan
    if not math.isfinite(seconds):
        raise ParameterError(f"Observation.{name}", value, "a finite number of seconds")
    return seconds


def _info(info: Any) -> dict[str, Any]:
    """With a covariance of the pose that is one: symmetric, no negative variance; NaN: nothing is known."""
    check_kind("Observation.info", info, dict)
    estimate = info.get("estimate", {})
    check_kind("Observation.info['estimate']", estimate, Mapping, "a dict")
    stated = estimate.get("pose_covariance")
    if stated is None:
        return info
    name = "Observation.info['estimate']['pose_covariance']"
    try:
        covariance = torch.as_tensor(stated)
    except (TypeError, ValueError, RuntimeError):
        raise ParameterError(name, stated, "a tensor (6, 6)") from None
    _check_real(name, covariance)
    covariance = covariance.detach().to("cpu", torch.float64)
    check_shape(name, covariance, (6, 6), "of the error twist (v; w) [m, rad]")
    if not bool(covariance.isnan().any()):
        check_finite(name, covariance)
        rounded = _ROUNDED * float(covariance.abs().max())
        if float((covariance - covariance.mT).abs().max()) > rounded:
            raise ParameterError(name, stated, "symmetric")
        if float(torch.linalg.eigvalsh(covariance)[0]) < -rounded:
            raise ParameterError(name, stated, "without negative eigenvalues")
    if covariance is stated:
        return info
    return {**info, "estimate": {**estimate, "pose_covariance": covariance}}
