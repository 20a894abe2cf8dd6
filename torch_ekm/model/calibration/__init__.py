"""The springs, arms and stiffnesses of one's own hand, from motions that it made."""

from __future__ import annotations

from .calibrate import calibrate
from .parameters import Calibrated, Calibration

__all__ = ["Calibrated", "Calibration", "calibrate"]
