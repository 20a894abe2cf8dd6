"""Parts of pages that are made from the code; ``<!-- generated: NAME -->`` in a page stands for one."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

from .commands import commands
from .parameters import parameters, presets

MAKERS: dict[str, Callable[[], str]] = {"commands": commands, "parameters": parameters, "presets": presets}


def setup(app: Any) -> None:
    """Connect."""
    app.connect("source-read", _fill)


def _fill(app: Any, docname: str, source: list[str]) -> None:
    source[0] = re.sub(r"<!-- generated: (\w+) -->", lambda found: MAKERS[found[1]](), source[0])
