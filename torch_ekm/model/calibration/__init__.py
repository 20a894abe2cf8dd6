"""The springs, arms and stiffnesses of one's own hand, from motions that it made."""

from __future__ import annotations

from .calibrate import calibrate
from .parameters import Calibrated, Calibration
from .residuals import Recording

__all__ = ["Calibrated", "Calibration", "Recording", "calibrate"]
