"""The application that the groups of commands add theirs to, and what their options share."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Annotated, Any

from .._extras import versions_of
from .._terminal import console, say  # first: needs the extra
from ..exceptions import ParameterError

import typer  # isort: skip
from typer import Option  # isort: skip
from typer.core import TyperGroup  # isort: skip

GROUPS = {
    "Try it in simulation": ("demo", "reproduce"),
    "Describe a hand": ("hands", "objects", "check", "show"),
    "Recordings of any robot": ("compare",),
    "Logs of a hand": ("replay", "verify", "health"),
    "A real hand": ("drivers", "slack", "identify-servo", "knowledge"),
    "The package": ("notebooks", "version"),
}


class _Commands(TyperGroup):
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


app = typer.Typer(
    cls=_Commands,
    help="Kinematic models of underactuated hands, corrected by online learners.",
    context_settings={"help_option_names": ["-h", "--help"]},
    rich_markup_mode=None,  # rich would take "[deg]" for a style and drop it
)

Hand = Annotated[str, Option(help="A hand (see 'torch-ekm hands') or a path to a URDF.")]
Preset = Annotated[
    str, Option(help="Faults of the simulated hand: none, nominal, worn, hostile, or odd_1 to odd_5.")
]
Engine = Annotated[str, Option(help="Physics of the simulated hand: sapien or mujoco.")]
Sensing = Annotated[bool, Option(help="Camera images and Hall counts, or truth plus noise.")]
Jobs = Annotated[int, Option(min=1, help="Processes at once.")]
Page = Annotated[Path, Option(help="The page: one file, shown by any browser without a network.")]
AN_OBJECT = "An object (see 'torch-ekm objects') or a path to a URDF."

_MOST_SEEDS = 10_000
_LARGEST_SEED = 2**31


@app.callback(invoke_without_command=True)
def root(
    context: typer.Context, version: Annotated[bool, Option("--version", help="Print the version.")] = False
) -> None:
    """Kinematic models of underactuated hands, corrected by online learners."""
    if version:
        say(f"torch-ekm {versions_of(['torch_ekm'])['torch_ekm']}")
    elif context.invoked_subcommand is None:
        typer.echo(context.get_help())


def parse_seeds(text: str) -> tuple[int, ...]:
    """``"1000:1006"`` as 1000..1005; a single number as itself.

    Raises:
        ParameterError: it is neither, a seed is negative or not below 2^31, or there are more than 10,000.
    """
    first, several, end = text.partition(":")
    try:
        start, stop = int(first), int(end) if several else int(first) + 1
    except ValueError:
        start = stop = 0
    if 0 <= start < stop <= _LARGEST_SEED:
        if stop - start > _MOST_SEEDS:
            raise ParameterError("seeds", text, f"at most {_MOST_SEEDS} seeds")
        return tuple(range(start, stop))
    valid = f"FIRST:END with 0 <= FIRST < END <= {_LARGEST_SEED}, e.g. 1000:1006, or one number below that"
    raise ParameterError("seeds", text, valid)


def names(text: str) -> tuple[str, ...]:
    """Names separated by commas, each once: ``a, b, a, "c, d"`` as ("a", "b", "c, d")."""
    words = next(csv.reader([text], skipinitialspace=True), [])
    return tuple(dict.fromkeys(filter(None, map(str.strip, words))))
