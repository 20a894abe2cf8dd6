"""Which readings a closed loop believes, and when it looks again, goes back, stops or gives up."""

from __future__ import annotations

from .progress import Progress
from .safety import Caution, Guards, Halt, Safety, StoppingRule
from .watch import Verdict, Watch

__all__ = ["Caution", "Guards", "Halt", "Progress", "Safety", "StoppingRule", "Verdict", "Watch"]
