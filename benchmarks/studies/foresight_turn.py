"""What came of a turn, and what was predicted of it."""

from __future__ import annotations

from dataclasses import dataclass

from torch_ekm.experiments.records import TrialRecord


@dataclass(frozen=True)
class ForesightTurn(TrialRecord):
    """A turn, with what was predicted of it; angles [deg]."""

    contender: str = ""
    largest_deg: float = 0.0
    """Largest true angle on the way, before the object was lost."""
    reach_deg: float | None = None
    """Where the model said that it ends; None: it was not asked, or refused the grasp."""
    reach_end: str = ""
    """What it said that ends it; "nothing": it goes on beyond what was asked."""
    axis_std_deg: float | None = None
    """Standard deviation of the rotation about the axis that was stated at the end, with the camera off."""
    estimate_error_deg: float | None = None
    """Of the estimated rotation about the axis at the end, with the camera off, by the truth."""
    looks: int = 0
    """How often the camera was asked while it was off."""
