"""Checks for authors of learners and drivers: the contract of a learner, a plant that spoils its readings.

Needs torch alone; nothing here is used by the package itself.
"""

from __future__ import annotations

from .fuzzed_plant import FuzzedPlant
from .learner_contract import check_residual_learner

__all__ = ["FuzzedPlant", "check_residual_learner"]
