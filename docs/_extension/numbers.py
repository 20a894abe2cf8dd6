"""Numbers in cells of tables do not wrap: ``0.10 [0.08, 0.12]`` stays on one line, and the table scrolls."""

from __future__ import annotations

import re
from typing import Any

from docutils import nodes

#: Numbers with signs, brackets and units of up to three letters.
_NUMBERS = re.compile(
    r"[-+(]?\d[\de.,:;/+\-()\[\]%* ]*(?:\b(?:of|to|deg|mm|ms|us|s|N|m)\b[\de.,:;/+\-()\[\]%* ]*)*"
)


def setup(app: Any) -> None:
    """Connect."""
    app.connect("doctree-read", mark_numbers)


def mark_numbers(app: Any, doctree: nodes.document) -> None:
    """Give such cells the class "number"."""
    for cell in doctree.findall(nodes.entry):
        if _NUMBERS.fullmatch(cell.astext().strip()):
            cell["classes"].append("number")
