"""Commands about recorded trials, and what is looked at in a browser."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from .._terminal import print_table, progress, say
from ._app import AN_OBJECT, Engine, Hand, Html, Port, Preset, Sensing, app, needs, parse_angles, parse_seeds

import typer  # isort: skip
from typer import Argument, Option  # isort: skip

if TYPE_CHECKING:
    from ..inspection.viewer.serve import Show


@app.command()
@needs("experiments")
def record(
    log: Annotated[Path, Argument(help="Folder of the log; one that is there goes on.")],
    object: Annotated[str, Option(help=AN_OBJECT)] = "box",
    hand: Hand = "icub_right",
    angles: Annotated[str, Option(help="Turns [deg], e.g. 10,20.")] = "10,20",
    seeds: Annotated[str, Option(help="FIRST:END; each angle is turned once for each seed.")] = "0:3",
    controller: Annotated[str, Option(help="KM, KM+I, KM+S or E-KM.")] = "KM",
    preset: Preset = "nominal",
    engine: Engine = "sapien",
    sensing: Sensing = True,
    images: Annotated[bool, Option(help="Keep the camera's images too.")] = False,
) -> None:
    """Turn an object in the simulated hand, and log all of it.

    One HDF5 file for each turn. Interrupted or killed, it goes on where it stopped, and ends with the same
    files.
    """
    from ..experiments.config import Setting
    from ..experiments.protocols.record import RecordConfig
    from ..experiments.protocols.record import record as run

    setting = Setting(hand=hand, preset=preset, engine=engine, sensing=sensing)
    config = RecordConfig(setting, object, controller, parse_angles(angles), images)
    chosen = parse_seeds(seeds)
    with progress("recording", len(chosen) * len(config.angles_deg)) as advance:
        made = run(config, chosen, log, on_trial=advance)
    ends = Counter(e.status if e.status == "not grasped" else e.reason or e.status for e in made.index)
    say(f"{made.folder.resolve()}: {', '.join(f'{n} {end}' for end, n in ends.items())}")
    if set(ends) == {"not grasped"}:
        raise typer.Exit(1)


@app.command()
@needs("experiments")
def show(
    what: Annotated[str, Argument(metavar="[HAND|LOG]", help="A hand, a URDF, or a log.")] = "icub_right",
    object: Annotated[str | None, Option(help="An object for the hand to hold.")] = None,
    seed: Annotated[int, Option(min=0, help="Which grasp of the object.")] = 0,
    reach: Annotated[bool, Option(help="How far it can be turned, and what ends it.")] = False,
    html: Html = None,
    port: Port = 8080,
) -> None:
    """Look at a hand, a grasp or a log in the browser.

    A hand has a slider for each actuator, a grasp is simulated while its actuators are moved, a log is
    played.
    """
    from ..inspection.viewer.serve import ReachShow, choose_show

    shown = choose_show(what, object, seed, reach)
    if isinstance(shown, ReachShow):
        print_table(("direction", "angle [deg]", "ends by"), shown.rows(), shown.title)
    for note in getattr(shown, "notes", ()):
        say(f"Not drawn: {note}")
    _look(shown, html, port)


@app.command()
@needs("experiments")
def replay(
    log: Annotated[Path, Argument(help="A log's folder, or the file of one trial.")],
    trial: Annotated[int | None, Option(min=0, help="Which trial; the first one by default.")] = None,
    estimates: Annotated[bool, Option(help="Show what was measured, not the truth.")] = False,
    html: Html = None,
    port: Port = 8080,
) -> None:
    """List the trials of a log, and play one in the browser."""
    from ..inspection.viewer.trial import LogShow
    from ..plant.trial_log import TrialEntry

    shown = LogShow(log, trial, estimates)
    if shown.log is not None:
        header = ["time [s]" if name == "time" else name for name in TrialEntry._fields]
        print_table(header, shown.log.index, str(log))
        for number, problem in shown.log.damaged.items():
            say(f"trial {number}: {problem}")
    _look(shown, html, port)


@app.command()
@needs("sim")
def verify(log: Annotated[Path, Argument(help="Folder of the log.")]) -> None:
    """Check every byte of a log.

    Its trials, its index, and the files of hand and object that it was made from. Ends with 1 if a file is
    wrong, with 0 if not. "torch-ekm record" makes damaged trials again.
    """
    from ..plant import verify_log
    from ..plant.verification import Finding

    found = verify_log(log)
    print_table(Finding._fields, found, str(log))
    if any(one.state == "wrong" for one in found):
        raise typer.Exit(1)


def _look(show: Show, html: Path | None, port: int) -> None:
    """Write a page, or serve until Ctrl-C."""
    from ..inspection.viewer.serve import save_page, serve

    if html is not None:
        say(f"Page:      {save_page(show, html).resolve()}")
        return
    serve(show, port=port, on_ready=lambda address: say(f"Open {address} (Ctrl-C ends)"))
