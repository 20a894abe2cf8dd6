"""Which readings a closed loop accepts, and when it reads again, retreats, stops or gives up."""

from __future__ import annotations

from .safety import Caution as Caution
from .safety import Guards as Guards
from .safety import Safety as Safety
from .safety import StoppingRule as StoppingRule
