"""One row of what a check says."""

from __future__ import annotations

from typing import Literal, NamedTuple

State = Literal["ok", "warning", "error"]


class Check(NamedTuple):
    """One row of the table: what was checked, its state, what was found, and the remedy."""

    name: str
    state: State
    found: str
    remedy: str = ""
