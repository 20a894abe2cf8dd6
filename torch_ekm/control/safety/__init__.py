"""Which readings a closed loop accepts, and when it reads again or stops."""

from __future__ import annotations

from .guards import Guards as Guards
