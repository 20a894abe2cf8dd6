"""Look at a hand, a grasp or a log before anything is driven: ``check``, and pages of ``show``."""

from __future__ import annotations

from typing import Literal, NamedTuple

State = Literal["ok", "warning", "error"]


class Check(NamedTuple):
    """One row of the table: what was checked, its state, what was found, and the remedy."""

    name: str
    state: State
    found: str
    remedy: str = ""
