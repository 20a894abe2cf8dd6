"""Commands about recorded trials, and pages to look at."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from .._terminal import print_table, say, say_next
from ._app import Page, app

import typer  # isort: skip
from typer import Argument, Option  # isort: skip

if TYPE_CHECKING:
    from ..inspection.view import View


@app.command()
def show(
    what: Annotated[str, Argument(metavar="[HAND|LOG]", help="A hand, a URDF, or a log.")] = "icub_right",
    object: Annotated[str | None, Option(help="An object for the hand to hold.")] = None,
    seed: Annotated[int, Option(min=0, help="Which grasp of the object.")] = 0,
    reach: Annotated[bool, Option(help="How far it can be turned, and what ends it.")] = False,
    html: Page = Path("view.html"),
) -> None:
    """Write a page that shows a hand, a grasp or a log in any browser.

    A hand closes and opens each actuator in turn. In a grasp each actuator is moved by 5 deg, in simulation,
    and the table shows the effect on the object. A log is played.
    """
    from ..inspection.view import view

    _show(view(what, object, seed, reach=reach), html)


@app.command()
def replay(
    log: Annotated[Path, Argument(help="A log's folder, or the file of one trial.")],
    trial: Annotated[int | None, Option(min=0, help="Which trial; the first one by default.")] = None,
    estimates: Annotated[bool, Option(help="Show what was measured, not the truth.")] = False,
    html: Page = Path("view.html"),
) -> None:
    """List the trials of a log, and play one on a page."""
    from ..inspection.view import view_log
    from ..plant import TrialLog
    from ..plant.trial_log import TrialEntry

    found = None if log.is_file() else TrialLog.open(log)
    shown = view_log(log if found is None else found, trial, estimates=estimates)
    if found is not None:
        header = ["time [s]" if name == "time" else name for name in TrialEntry._fields]
        print_table(header, found.index, str(log))
        for number, problem in found.damaged.items():
            say(f"trial {number}: {problem}")
    _show(shown, html)


@app.command()
def verify(log: Annotated[Path, Argument(help="Folder of the log.")]) -> None:
    """Check every byte of a log.

    Its trials, and the files of hand and object that it was made from. Ends with 1 if a file is
    wrong, with 0 if not.
    """
    from ..plant import verify_log
    from ..plant.trial_log import Finding

    found = verify_log(log)
    print_table(Finding._fields, found, str(log))
    if any(one.state == "wrong" for one in found):
        say_next("use your copy; trials of a simulated hand can be made again")
        raise typer.Exit(1)
    say_next(f"torch-ekm health {log}")


def _show(shown: View, page: Path) -> None:
    """The table, and where the page is."""
    from ..rendering import save_animation

    if shown.rows:
        print_table(shown.header, shown.rows, shown.captions.title)
    for note in shown.notes:
        say(f"Not drawn: {note}")
    say(f"Page:      {save_animation(shown.scene, page, shown.captions).resolve()}")
    say_next("open the page in a browser: play, step, drag to look around")
