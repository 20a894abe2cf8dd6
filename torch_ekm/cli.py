"""The command line: ``torch-ekm``."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

from ._extras import require
from .exceptions import EKMError, MissingExtraError

try:
    typer = require("typer")
    require("rich")
except MissingExtraError as error:
    raise SystemExit(f"torch-ekm: {error}") from None

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table as RichTable
from typer import Argument, Option

app = typer.Typer(
    help="Kinematic models of underactuated hands, corrected by online learners.",
    no_args_is_help=True,
    add_completion=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
console = Console()


def main() -> None:
    """Entry point: errors that torch_ekm raises on purpose are told in one line, without a traceback."""
    try:
        app()
    except EKMError as error:
        Console(stderr=True).print(f"[bold red]torch-ekm:[/] {error}", highlight=False)
        sys.exit(1)


@app.command()
def hands() -> None:
    """List the hands that come with the package."""
    from .description import list_hands, load_hand

    table = RichTable("hand", "joints", "actuators", "contact pads", "URDF")
    for name in list_hands():
        hand = load_hand(name)
        table.add_row(name, str(hand.n_q), str(hand.n_a), str(len(hand.pads)), hand.urdf_path.name)
    console.print(table)


@app.command()
def objects() -> None:
    """List the objects that come with the package."""
    from .description import list_objects, load_object

    table = RichTable("object", "mass [g]", "friction", "grasp width [mm]", "shapes")
    for name in list_objects():
        obj = load_object(name)
        shapes = ", ".join(shape.kind for shape in obj.shapes)
        table.add_row(
            name, f"{1e3 * obj.mass:.0f}", f"{obj.friction:g}", f"{1e3 * obj.grasp_width:.0f}", shapes
        )
    console.print(table)


@app.command()
def demo(
    object: Annotated[str, Argument(help="An object (see 'torch-ekm objects') or a path to a URDF.")] = "box",
    out: Annotated[Path, Option(help="Folder for the report.")] = Path("demo_output"),
    hand: Annotated[str, Option(help="A hand (see 'torch-ekm hands') or a path to a URDF.")] = "icub_right",
    seeds: Annotated[str, Option(help="FIRST:END, e.g. 1000:1006; each seed is one grasp.")] = "1000:1006",
    jobs: Annotated[int, Option(min=1, help="Processes at once.")] = 2,
    quick: Annotated[bool, Option(help="Two grasps, two angles: to see that it works.")] = False,
) -> None:
    """Turn a grasped object in the simulated hand, with the KM and with the E-KM, and report.

    Takes about two minutes on two cores. Interrupted, it goes on where it stopped.
    """
    from .experiments.demo import TABLE_I, DemoConfig
    from .experiments.demo_report import demo_jobs, run_demo

    angles = TABLE_I.get(object, TABLE_I["box"])
    chosen = parse_seeds(seeds)
    if quick:
        chosen, angles = chosen[:2], angles[:2]
    config = DemoConfig(hand=hand, object=object, seeds=chosen, angles_deg=angles)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console) as progress:
        task = progress.add_task("manipulating", total=len(demo_jobs(config)))
        report = run_demo(config, out, jobs, on_done=lambda _: progress.advance(task))
    for table in report.tables:
        shown = RichTable(*table.header, title=table.caption)
        for row in table.rows:
            shown.add_row(*row)
        console.print(shown)
    console.print(report.summary)
    console.print(f"Report:    {(out / 'index.html').resolve()}", soft_wrap=True)
    for figure in report.figures:
        console.print(f"           {(out / figure.path).resolve()}", soft_wrap=True)


@app.command()
def version() -> None:
    """Print the version, and those of the packages that decide the numbers."""
    from .experiments.report import versions

    for package, number in versions().items():
        console.print(f"{package} {number}", highlight=False)


def parse_seeds(text: str) -> tuple[int, ...]:
    """``"1000:1006"`` as 1000..1005; a single number as itself.

    Raises:
        ParameterError: it is neither.
    """
    from .exceptions import ParameterError

    try:
        numbers = [int(part) for part in text.split(":")]
    except ValueError:
        numbers = []
    if len(numbers) == 1:
        return (numbers[0],)
    if len(numbers) == 2 and numbers[0] < numbers[1]:
        return tuple(range(*numbers))
    raise ParameterError("seeds", text, "FIRST:END with FIRST < END, e.g. 1000:1006, or one number")
