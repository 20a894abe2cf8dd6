"""The one place where a plant's reading is looked at: kind, shape, type, finite numbers, status, clock."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

import torch

from .._checks import check_finite, check_kind, check_shape
from ..description import HandDescription
from ..exceptions import ParameterError
from ..typing import Tensor
from .observation import Observation, PlantStatus, Stamps

_ROUNDED = 1e-6  # of the largest entry of a covariance: what rounding may leave of its symmetry and sign


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
