"""Guards of a closed loop: which readings it believes, and where it ends rather than go on."""

from __future__ import annotations

from .options import Guards, Halt
from .watch import Verdict, Watch

__all__ = ["Guards", "Halt", "Verdict", "Watch"]
