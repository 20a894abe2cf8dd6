"""What the calibration takes of a recording: states at rest and the motors' increments between them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import torch

from ...kinematics.grasp_state import GraspState
from ...typing import Float, Tensor


@runtime_checkable
class Recording(Protocol):
    """``torch_ekm.plant.Trajectory``, or anything with observations in the order of time.

    Of each observation: ``state``, ``a`` (encoders [rad]), ``fingertip_force`` [N] (NaN, or None as a whole,
    where there is no sensor) and ``status``; what is not "held" ends a grasp.
    """

    @property
    def observations(self) -> Sequence[Any]: ...


@dataclass(frozen=True)
class Rest:
    """A state in which hand and object rest, with encoders [rad] and fingertip forces [N]."""

    state: GraspState
    a: Float[Tensor, " n_a"]
    force: Float[Tensor, " n_pads"] | None


def rests(recordings: Iterable[Recording]) -> list[list[Rest]]:
    """The states of each grasp, in order; a state in which the object is not held or not seen ends one."""
    grasps: list[list[Rest]] = []
    for recording in recordings:
        grasp: list[Rest] = []
        for seen in recording.observations:
            if getattr(seen.status, "value", seen.status) != "held":
                grasps.append(grasp)
                grasp = []
                continue
            force = None if seen.fingertip_force is None else seen.fingertip_force.double()
            if force is not None and not bool(torch.isfinite(force).any()):
                force = None
            state = GraspState(*(part.double() for part in (seen.q, seen.position, seen.rotation)))
            grasp.append(Rest(state, seen.a.double(), force))
        grasps.append(grasp)
    return [grasp for grasp in grasps if len(grasp) > 1]
