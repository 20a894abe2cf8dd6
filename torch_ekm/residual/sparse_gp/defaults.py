"""The parts of a sparse online GP of which nothing is known but its sizes."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from torch import nn

from ..._checks import check_counts
from .forgetting import ProcessNoise
from .hyperparameters import LearnHyperparameters
from .monitor import CalibrateNoise, DetectChanges, RobustWeight
from .part import Part, copy_parts
from .units import Standardize


def default_parts() -> list[Part]:
    """What bears outliers, slow and abrupt changes, holds its intervals, and learns kernel and noise."""
    wandering = ProcessNoise(0.001)
    return [RobustWeight(3.0), DetectChanges(), wandering, CalibrateNoise(), LearnHyperparameters()]


def fleet_options(options: Mapping[str, Any]) -> dict[str, Any]:
    """Those of a learner's options that its kernel shares: fleet and device.

    Raises:
        ParameterError: the fleet's shape is none.
    """
    check_counts("batch_shape", options.get("batch_shape", ()))
    return {name: options[name] for name in ("batch_shape", "device") if name in options}


def chosen_parts(parts: Iterable[nn.Module] | None, standardize: bool | Standardize) -> list[Part]:
    """Copies of ``parts``, or the default ones, with units in front where they have none and shall have some.

    Raises:
        ParameterError: parts do not go together.
    """
    own = default_parts() if parts is None else copy_parts(parts)
    if standardize and not any(isinstance(part, Standardize) for part in own):
        own[:0] = copy_parts([standardize if isinstance(standardize, Standardize) else Standardize()])
    return own
