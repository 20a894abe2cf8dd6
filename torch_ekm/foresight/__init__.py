"""The whole turn planned on f + g: what a sequence of motions does, and which sequence to begin with."""

from __future__ import annotations

from .horizon_controller import HorizonController
from .limits import SlipLimit
from .prediction import Prediction
from .rollout import Rollout

__all__ = ["HorizonController", "Prediction", "Rollout", "SlipLimit"]
