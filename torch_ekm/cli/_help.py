"""The list of all commands, by what one has."""

from __future__ import annotations

from typing import Any

from .._terminal import console  # first: needs the extra

import typer  # isort: skip
from typer.core import TyperGroup  # isort: skip

GROUPS = {
    "Try it in simulation": ("demo", "reproduce"),
    "Describe a hand": ("hands", "objects", "check", "show"),
    "Recordings of any robot": ("compare",),
    "Logs of a hand": ("replay", "verify", "health"),
    "A real hand": ("drivers", "slack", "identify-servo", "knowledge"),
    "The package": ("notebooks", "version"),
}


class Commands(TyperGroup):
    """Groups with whole sentences; the first column is as wide as the longest name."""

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write each group as a section."""
        width = max(map(len, self.commands))
        for title, names in GROUPS.items():
            heading = typer.style(title, bold=True, fg="blue") if console.is_terminal else title
            with formatter.section(heading):
                rows = [(name.ljust(width), _sentence(self.commands[name].help or "")) for name in names]
                formatter.write_dl(rows)


def _sentence(text: str) -> str:
    """The first line of a help text: a sentence."""
    return " ".join(text.strip().split("\n\n")[0].split())
