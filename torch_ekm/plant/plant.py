"""A hand as a controller sees it: readings, movements, what it must do, and what is put around it."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from functools import cached_property
from typing import Any, NamedTuple, Protocol, TypeGuard, runtime_checkable

import torch

from .._checks import check_count, check_finite, check_kind, check_positive, check_shape
from ..description import HandDescription
from ..exceptions import ParameterError, ShapeError
from ..kinematics import GraspState
from ..kinematics.se3 import exp, log
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
    position, rotation, stamps = last.position, last.rotation, last.stamps
    covariance = last.q.new_full((6, 6), torch.nan)
    if shown:
        position, rotation, covariance = _mean_pose(shown)
        stamps = last.taken._replace(pose=min(o.taken.pose for o in shown))  # no newer than any of them
    forces = [o.fingertip_force for o in readings if o.fingertip_force is not None]
    info = {**last.info, "estimate": {**last.info.get("estimate", {}), "pose_covariance": covariance}}
    if "events" in readings[0].info:
        info["events"] = readings[0].info["events"]
    return replace(
        last,
        q=torch.stack([o.q for o in readings]).mean(0),
        position=position,
        rotation=rotation,
        fingertip_force=torch.stack(forces).mean(0) if forces else None,
        status=PlantStatus.HELD if shown else PlantStatus.NOT_SEEN,
        info=info,
        stamps=stamps if last.dated else None,
    )


def _mean_pose(frames: Sequence[Observation]) -> tuple[Tensor, Tensor, Tensor]:
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
        covariance = torch.stack(stated)[kept].mean(0)
    else:
        covariance = torch.diag_embed(twist[kept].var(0)) if n > 1 else twist.new_full((6, 6), torch.nan)
    return o[kept].mean(0), exp(twist[kept, 3:].mean(0)) @ centre, covariance / n


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
    seen = replace(seen, **changed) if changed else seen
    _ = seen.state  # kept by the reading; refuses what is no rotation
    return seen


def _numbers(name: str, value: Any, shape: tuple[int, ...], hand: HandDescription) -> Tensor:
    name = f"Observation.{name}"
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
    return info if covariance is stated else {**info, "estimate": {**estimate, "pose_covariance": covariance}}


_LEAST = 0.01  # [s] of a piece: no bus takes goals faster


@dataclass(frozen=True, eq=False)
class Path:
    """``a(t) = a_0 + w_k + (t - t_k) / (t_k+1 - t_k) (w_k+1 - w_k)``: straight from one waypoint to the next.

    Raises:
        ShapeError: waypoints are not ``(n, n_a)`` with n of 1 or more, or times not ``(n,)``.
        NonFiniteError: an entry is NaN or infinite.
        ParameterError: times do not increase from above 0 on.
    """

    waypoints: Float[Tensor, "n n_a"]
    """Set-points w relative to the encoders before the movement [rad]; the last is its end."""
    times: Float[Tensor, " n"]
    """When each is passed, after the start [s]. A plant whose servos are slower takes longer."""

    def __post_init__(self) -> None:
        for name in ("waypoints", "times"):
            value = torch.as_tensor(getattr(self, name)).detach().to("cpu", torch.float64)
            check_finite(name, value)
            object.__setattr__(self, name, value)
        if self.waypoints.ndim != 2 or not len(self.waypoints):
            raise ShapeError("waypoints", "(n, n_a), n of 1 or more", tuple(self.waypoints.shape))
        if self.times.shape != self.waypoints.shape[:1]:
            raise ShapeError("times", f"({len(self.waypoints)},)", tuple(self.times.shape))
        if not bool((self.durations > 0).all()):
            raise ParameterError("times", self.times.tolist(), "increasing, the first above 0 [s]")

    @classmethod
    def through(cls, waypoints: Float[Tensor, "n n_a"], speed: float) -> Path:
        """The motor that goes farthest in a piece goes at ``speed`` [rad/s]; no piece is below 0.01 s.

        Raises:
            ShapeError, NonFiniteError, ParameterError: see :class:`Path`, or the speed is not positive.
        """
        path = cls(waypoints, torch.arange(1.0, len(waypoints) + 1))
        seconds = path.pieces.abs().amax(1) / check_positive("speed", speed)
        object.__setattr__(path, "times", seconds.clamp(min=_LEAST).cumsum(0))  # looked at already
        return path

    @property
    def pieces(self) -> Float[Tensor, "n n_a"]:
        """From waypoint to waypoint, the first from where the motors are [rad]."""
        return self.waypoints.diff(dim=0, prepend=torch.zeros_like(self.waypoints[:1]))

    @property
    def durations(self) -> Float[Tensor, " n"]:
        """Of the pieces [s]."""
        return self.times.diff(prepend=self.times.new_zeros(1))


@runtime_checkable
class Plant(Protocol):
    """A hand holding an object: simulated, recorded, or real."""

    def reset(self, seed: int) -> Observation:
        """Grasp the object; the same seed gives the same grasp and the same noise."""
        ...

    def observe(self) -> Observation:
        """Read the sensors: SI units, hand frame; nothing moves."""
        ...

    def command(self, delta_a: Float[Tensor, " n_a"]) -> Observation:
        """Move the actuators by ``delta_a`` [rad] **relative to their encoders**, wait, read the sensors."""
        ...

    def close(self) -> None:
        """Release devices, windows and files; the plant is not used afterwards."""


class FollowingPlant(Plant, Protocol):
    """A plant whose motors go through waypoints, and that can be watched on the way.

    ``command(delta_a)`` is the movement with one waypoint.
    """

    def follow(self, path: Path, watch: Callable[[Observation], bool]) -> Observation:
        """Move through the waypoints, wait until the hand rests, read the sensors.

        Args:
            watch: is given the readings that come on the way, in order, at the plant's own rate; where it
                answers False, or raises, the motors are commanded to stay where they are.
        """
        ...


def can_follow(plant: Plant) -> TypeGuard[FollowingPlant]:
    """Whether a plant has :meth:`FollowingPlant.follow`; a wrapper has it where what it wraps has."""
    return hasattr(plant, "follow")


class PlantWrapper:
    """Passes everything on to ``plant``; implements :class:`Plant`.

    A subclass overrides :meth:`observation` to change what is seen, :meth:`command` to change what is
    commanded, :meth:`reset` to begin again. What a plant offers beyond the contract (``hand``, ``object``,
    ``rotation_axis`` of a simulated hand) is found on the wrapper, too. So is ``follow``, unless a subclass
    overrides :meth:`command` and not :meth:`_followed`: no motion passes it by.
    """

    def __init__(self, plant: Plant) -> None:
        self.plant = plant

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_") or name in ("plant", "follow"):  # not yet set: no endless search
            raise AttributeError(f"{type(self).__name__} has no attribute {name!r}")
        return getattr(self.plant, name)

    def reset(self, seed: int) -> Observation:
        """Grasp the object again; the observation after it, as :meth:`observation` changes it."""
        return self.observation(self.plant.reset(seed))

    def observe(self) -> Observation:
        """Read the sensors, as :meth:`observation` changes the reading."""
        return self.observation(self.plant.observe())

    def command(self, delta_a: Float[Tensor, " n_a"]) -> Observation:
        """Move the actuators by ``delta_a`` [rad], wait, read the sensors."""
        return self.observation(self.plant.command(delta_a))

    @property
    def follow(self) -> Callable[[Path, Callable[[Observation], bool]], Observation]:
        """See :class:`FollowingPlant`; there is none where ``plant`` has none."""
        own = type(self)
        passed_by = own.command is not PlantWrapper.command and own._followed is PlantWrapper._followed
        if passed_by or not can_follow(self.plant):
            raise AttributeError(f"{own.__name__} has no attribute 'follow'")
        return self._followed

    def _followed(self, path: Path, watch: Callable[[Observation], bool]) -> Observation:
        """``follow``, with all readings as :meth:`passing` and :meth:`observation` change them."""
        assert can_follow(self.plant)
        return self.observation(self.plant.follow(path, lambda seen: watch(self.passing(seen))))

    def passing(self, seen: Observation) -> Observation:
        """What is passed on of a reading on the way, which nothing may delay."""
        return self.observation(seen)

    def observation(self, seen: Observation) -> Observation:
        """What is passed on of what ``plant`` has seen."""
        return seen

    def close(self) -> None:
        """Close the wrapped plant: its devices, windows and files."""
        self.plant.close()


class FramesAtRest(PlantWrapper):
    """A plant that is read ``frames`` times after each motion; passes on the mean.

    ``o = mean o_k,  R = exp([mean log(R_k R_c^T)]x) R_c`` about the median pose ``(o_c, R_c)``, over the
    frames that show the object. One whose rotation or position is more than four times the median distance
    from the median is left out. Joint angles and fingertip forces are the mean of all readings; all else is
    of the last one.

    ``info["estimate"]["pose_covariance"]`` is that of the mean, ``sum Sigma_k / n^2``, of the error twist
    ``(v; w)`` [m, rad]: with the covariances that the plant states, or else with the frames' scatter
    (diagonal). Errors that all frames share, such as a mount's, are in neither. NaN: nothing is known.

    A camera of 20 Hz needs 0.25 s more for six frames than for one.

    Args:
        plant: draws or waits for a new reading at each ``observe()``.
        frames: how many, 1 or more; with 1 nothing is changed.

    Raises:
        ParameterError: ``frames`` is less than 1.
    """

    def __init__(self, plant: Plant, frames: int = 6) -> None:
        super().__init__(plant)
        self.frames = check_count("frames", frames)

    def passing(self, seen: Observation) -> Observation:
        """``seen``: a hand that moves shows no second frame of the same pose."""
        return seen

    def observation(self, seen: Observation) -> Observation:
        """The mean of ``seen`` and of the readings that follow; the loss of an object ends them."""
        readings = [seen]
        while len(readings) < self.frames and readings[-1].status is not PlantStatus.LOST:
            readings.append(self.plant.observe())
        if self.frames == 1 or readings[-1].status is PlantStatus.LOST:
            return readings[-1]
        return mean_reading(readings)
