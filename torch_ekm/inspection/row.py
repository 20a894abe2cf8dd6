"""One row of what a check says."""

from __future__ import annotations

from typing import Literal, NamedTuple

State = Literal["ok", "warning", "error"]


class Check(NamedTuple):
    """One row of the table: what was looked at, how it is, what was found, and what mends it."""

    name: str
    state: State
    found: str
    mend: str = ""
