from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import torch

from ..exceptions import ParameterError
from ..kinematics.se3 import exp, log
from ..typing import Float, Tensor
from .observation import Observation, PlantStatus
from .plant import Plant, PlantWrapper

_OUTLIER = 4.0  # times the median distance from the median: 6 standard deviations of a Gaussian in space


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
