"""Which readings a closed loop accepts, and when it reads again or stops."""

from __future__ import annotations

from .safety import Guards as Guards
from .safety import Safety as Safety
from .safety import StoppingRule as StoppingRule
