"""A hand as a controller sees it: what it must do, movements of its motors, and what is put around it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol, TypeGuard, runtime_checkable

import torch

from .._checks import check_finite, check_positive
from ..exceptions import ParameterError, ShapeError
from ..typing import Float, Tensor
from .observation import Observation, PlantStatus, mean_reading

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
        if frames < 1:
            raise ParameterError("frames", frames, "1 or more")
        super().__init__(plant)
        self.frames = frames

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
