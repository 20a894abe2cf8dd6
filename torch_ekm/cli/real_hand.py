"""Commands about recorded trials, and those that move a real hand or say how it is."""

from __future__ import annotations

from collections.abc import Iterator
from json import dumps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from .._terminal import console, print_table, say, say_next
from ..exceptions import ParameterError
from ._app import Page, app

import typer  # isort: skip
from typer import Argument, Option  # isort: skip

if TYPE_CHECKING:
    from ..inspection.view import View

Wired = Annotated[Path, Option("--plant", metavar="TOML", help="The hand's wiring file.")]
Learned = Annotated[
    Path | None, Option(metavar="EKM", help="File of what a closed loop has learned of the hand.")
]


@app.command()
def slack(
    plant: Wired, write: Annotated[bool, Option(help="Write the zeros into the wiring file.")] = False
) -> None:
    """Find where each tendon of a real hand is taut: its motor's zero.

    Each motor closes by 1 deg at a time until its load rises, and goes back. Begin with slack tendons and an
    empty hand.
    """
    from ..drivers import open_driver
    from ..inspection.slack import find_slack, write_zeros

    with open_driver(plant) as driver, console.status("closing") as status:
        found = find_slack(driver, status.update)
    for one in found:
        line = driver.wiring.line("motors", one.motor, "zero")
        say(f"{plant}:{line}: {one.motor}: zero = {one.zero:.6g}  # +-{one.std:.2g}")
    if write:
        write_zeros(driver.wiring, found)
        say(f"Written:   {plant.resolve()}")
    say_next(
        f"torch-ekm check --plant {plant}" if write else "write these zeros: the same command with --write"
    )


@app.command()
def drivers(
    hand: Annotated[str, Argument(help="A hand (see 'torch-ekm hands') or a path to a URDF.")],
    new: Annotated[Path, Option(metavar="TOML", help="The wiring file to write.")],
    port: Annotated[str, Option(help="Where the Dynamixel servos are.")] = "/dev/ttyUSB0",
    baud: Annotated[int, Option(help="0: the usual ones are tried.")] = 0,
) -> None:
    """Write a wiring file from a scan of a bus: ids, models, limits, and where the motors stand.

    Nothing is written to a servo. Put the hand at rest first: zeros are where the motors stand. Names are
    given in the order of ids, and signs are 1: guesses, which 'torch-ekm check --plant' tests.
    """
    from .._files import write_whole
    from ..inspection.new_wiring import BAUDS, new_wiring

    if new.exists():
        raise ParameterError("new", str(new), "a file that does not exist yet")
    with console.status("scanning"):
        text = new_wiring(port, hand, (baud,) if baud else BAUDS)
    write_whole(new, text)
    say(text)
    say(f"Written:   {new.resolve()}")
    check = f"torch-ekm check --plant {new}"
    say_next(f"correct its names, then: {check} --emulate, {check} --dry-run, {check}")


@app.command(name="identify-servo")
def identify_servo(plant: Wired, out: Learned = None) -> None:
    """Find dead zone and bias of each motor of a real hand, by motions of 0.4 to 2 deg.

    Takes some 10 s for each motor; the empty hand does best. No model of the hand is needed. With --out: for
    a closed loop to begin with.
    """
    from ..control import HandKnowledge
    from ..drivers import open_driver
    from ..inspection.identify_servo import identify_servo as identify

    with open_driver(plant) as driver, console.status("swinging the motors") as status:
        found = identify(driver, status.update)
        knowledge = HandKnowledge.of(driver.hand)
    say(found)
    if out is not None:
        knowledge.servo = found
        knowledge.save(out)
        say(f"Written:   {out.resolve()}")
        say_next(f"ClosedLoop(..., knowledge=HandKnowledge.load({str(out)!r}))")
    else:
        say_next(f"keep it: torch-ekm identify-servo --plant {plant} --out hand.ekm")


@app.command()
def health(
    logs: Annotated[list[Path], Argument(metavar="LOG...", help="Folders of logs of one hand, in order.")],
    hand: Annotated[str, Option(help="The hand; else the one that the first log names.")] = "",
    knowledge: Learned = None,
) -> None:
    """Report which actuator of a hand changed, by how much and since when.

    Read from ordinary motions in its trial logs: what tendons pass on, dead zones and biases of the servos.
    With --knowledge: also the figures that a closed loop learned. Tendons show at measured joints only. Ends
    with 1 if something changed.
    """
    from ..control import HandKnowledge
    from ..description import load_hand
    from ..inspection.health import BASELINE, HealthChange, hand_health
    from ..plant import Trajectory, TrialLog

    opened = [TrialLog.open(log) for log in logs]
    name = hand or opened[0].configuration.get("hand")
    if not isinstance(name, str) or not name:
        raise ParameterError("hand", name, "given by --hand NAME, since the log names no hand")
    motions: list[int] = []

    def trials() -> Iterator[tuple[int, Trajectory]]:  # one at a time: logs may be long
        for log in opened:
            for k in log.trials:
                trial = log.read(k)
                motions.append(len(trial.commands))
                yield k, trial

    found = hand_health(load_hand(name).counted(), trials())
    if found:
        print_table(HealthChange._fields, found, str(name))
    if knowledge is not None:
        say(HandKnowledge.load(knowledge).figures)
    if found:
        say_next(
            "mend or describe what changed; torch-ekm knowledge FILE --reset forgets what was learned of it"
        )
        raise typer.Exit(1)
    few = "" if sum(motions) > BASELINE else f" An actuator is judged after {BASELINE} motions."
    say(f"No actuator changed in {sum(motions)} motions.{few}")
    say_next("torch-ekm knowledge FILE shows what a closed loop has learned of the hand")


@app.command()
def knowledge(
    file: Annotated[Path, Argument(metavar="EKM", help="File of what a closed loop has learned of a hand.")],
    hand: Annotated[str, Option(help="The hand; else the one that it was learned of.")] = "",
    reset: Annotated[list[str], Option(help="servo, forces, figures or error: forget it; repeatable.")] = [],  # noqa: B006
    json: Annotated[bool, Option("--json", help="All figures, as JSON.")] = False,
) -> None:
    """Show the estimates of a hand, and which of them differ from its description.

    Differences are those of more than two standard errors. With --reset parts are forgotten; the file as it
    was is kept beside, with the ending .previous.
    """
    from ..control import HandKnowledge
    from ..inspection.knowledge import Estimated, about, estimates

    learned = HandKnowledge.load(file)
    for part in reset:
        learned.reset(part)  # pyright: ignore[reportArgumentType]
    if reset:
        learned.save(file)
    head, found = about(learned, file, hand), estimates(learned)
    if json:
        say(dumps({**head, "estimates": [one._asdict() for one in found]}, indent=1))
        return
    for name, value in head.items():
        say(f"{name + ':':13}{value}")
    rows = [
        (one.part, one.name, one.figure, *map(_short, (one.value, one.std, one.described)), one.note)
        for one in found
        if one.deviates
    ]
    print_table([*Estimated._fields[:3], "estimated", "+-", "described", ""], rows, str(file))
    say(f"{len(found) - len(rows)} figures are as described, or not identified (--json lists them).")
    say_next(f"torch-ekm knowledge {file} --reset servo forgets a part, after a repair say")


def _short(value: float | None) -> str:
    return "" if value is None else f"{value:.3g}"


@app.command()
def show(
    hand: Annotated[str, Argument(help="A hand (see 'torch-ekm hands') or a path to a URDF.")] = "icub_right",
    object: Annotated[str | None, Option(help="An object for the hand to hold.")] = None,
    seed: Annotated[int, Option(min=0, help="Which grasp of the object.")] = 0,
    reach: Annotated[bool, Option(help="How far it can be turned, and what ends it.")] = False,
    html: Page = Path("view.html"),
) -> None:
    """Write a page that shows a hand or a grasp in any browser.

    A hand closes and opens each actuator in turn. In a grasp each actuator is moved by 5 deg, in simulation,
    and the table shows the effect on the object.
    """
    from ..inspection.view import view

    _show(view(hand, object, seed, reach=reach), html)


@app.command()
def replay(
    log: Annotated[Path, Argument(help="A log's folder, or the file of one trial.")],
    trial: Annotated[int | None, Option(min=0, help="Which trial; the first one by default.")] = None,
    html: Page = Path("view.html"),
) -> None:
    """List the trials of a log, and play one on a page."""
    from ..inspection.view import view_log
    from ..plant import TrialLog
    from ..plant.trial_log import TrialEntry

    found = None if log.is_file() else TrialLog.open(log)
    shown = view_log(log if found is None else found, trial)
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
