"""Which readings a closed loop believes, and when it looks again, goes back, stops or gives up."""

from __future__ import annotations

from .safety import Caution as Caution
from .safety import Guards as Guards
from .safety import Safety as Safety
from .safety import StoppingRule as StoppingRule
