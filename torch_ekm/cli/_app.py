"""The application that the groups of commands add theirs to, and what their options share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from .._terminal import say  # first: needs the extra
from .._text import figure
from .._versions import versions_of
from ..exceptions import ParameterError
from ._help import Commands

import typer  # isort: skip
from typer import Option  # isort: skip

app = typer.Typer(
    cls=Commands,
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
    try:
        numbers = [int(part) for part in text.split(":")]
    except ValueError:
        numbers = []
    if len(numbers) == 1:
        numbers.append(numbers[0] + 1)
    if len(numbers) == 2 and 0 <= numbers[0] < numbers[1] <= _LARGEST_SEED:
        if numbers[1] - numbers[0] <= _MOST_SEEDS:
            return tuple(range(*numbers))
        raise ParameterError("seeds", text, f"at most {_MOST_SEEDS} seeds")
    valid = f"FIRST:END with 0 <= FIRST < END <= {_LARGEST_SEED}, e.g. 1000:1006, or one number below that"
    raise ParameterError("seeds", text, valid)


def parse_angles(text: str) -> tuple[float, ...]:
    """``"10,20"`` as (10.0, 20.0) [deg].

    Raises:
        ParameterError: no numbers.
    """
    angles = tuple(angle for word in names(text) if (angle := figure(word)) is not None)
    if not angles or len(angles) < len(names(text)):
        raise ParameterError("angles", text, "numbers separated by commas, e.g. 10,20")
    return angles


def names(text: str) -> tuple[str, ...]:
    """Names separated by commas, each once: ``"a, b, a"`` as ("a", "b")."""
    return tuple(dict.fromkeys(filter(None, map(str.strip, text.split(",")))))
