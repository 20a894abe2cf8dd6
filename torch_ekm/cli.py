"""The command line: ``torch-ekm``."""

from __future__ import annotations

import math
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from ._terminal import print_report, print_table, progress, say, say_error  # first: needs the extra
from .exceptions import EKMError, ParameterError

import typer  # isort: skip
from typer import Argument, Option  # isort: skip

if TYPE_CHECKING:
    from .experiments.reporting.report import Report
    from .experiments.reproduce import Experiment
    from .experiments.viewer.serve import Show

app = typer.Typer(
    help="Kinematic models of underactuated hands, corrected by online learners.",
    no_args_is_help=True,
    add_completion=False,
    context_settings={"help_option_names": ["-h", "--help"]},
    rich_markup_mode=None,  # rich would take "[deg]" for a style and drop it
)

Hand = Annotated[str, Option(help="A hand (see 'torch-ekm hands') or a path to a URDF.")]
Preset = Annotated[str, Option(help="none, nominal, worn or hostile.")]
Sensing = Annotated[bool, Option(help="Camera images and Hall counts, or truth plus noise.")]
Jobs = Annotated[int, Option(min=1, help="Processes at once.")]
Html = Annotated[Path | None, Option(help="Write a stand-alone page instead of serving.")]
Port = Annotated[int, Option(help="To serve at; the next free one if it is taken.")]
_AN_OBJECT = "An object (see 'torch-ekm objects') or a path to a URDF."


def main() -> None:
    """Entry point: what torch_ekm refuses on purpose, and what the system refuses (a full disk, say), is told
    in one line, without a traceback."""
    try:
        app()
    except (EKMError, OSError) as error:
        say_error(error)
        sys.exit(1)


@app.command()
def hands() -> None:
    """List the hands that come with the package."""
    from .description import list_hands, load_hand

    found = [load_hand(name) for name in list_hands()]
    rows = [(hand.name, hand.n_q, hand.n_a, len(hand.pads), hand.urdf_path.name) for hand in found]
    print_table(("hand", "joints", "actuators", "contact pads", "URDF"), rows)


@app.command()
def objects() -> None:
    """List the objects that come with the package."""
    from .description import list_cylinders, list_objects, load_object

    rows = []
    for name in (*list_objects(), *list_cylinders()):
        obj = load_object(name)
        figures = f"{1e3 * obj.mass:.0f}", f"{obj.friction:g}", f"{1e3 * obj.grasp_width:.0f}"
        rows.append((name, *figures, ", ".join(shape.kind for shape in obj.shapes)))
    print_table(("object", "mass [g]", "friction", "grasp width [mm]", "shapes"), rows)


@app.command()
def check(
    hand: Annotated[str, Argument(help="A hand (see 'torch-ekm hands') or a path to a URDF.")],
    object: Annotated[str, Argument(help=_AN_OBJECT)] = "box",
    picture: Annotated[Path, Option(help="Picture of pads and contact frames.")] = Path("check.png"),
) -> None:
    """Check a hand: files, pads, axes, limits, tendons, and a pinch of the object in simulation and model.

    Each row says what was found and what to mend. Ends with 1 if there is an error, with 0 if not.
    """
    from .experiments.check import Check, check_hand

    rows = check_hand(hand, object, picture)
    print_table(Check._fields, rows, hand)
    if any(row.state == "error" for row in rows):
        raise typer.Exit(1)


@app.command()
def demo(
    object: Annotated[str, Argument(help=_AN_OBJECT)] = "box",
    out: Annotated[Path, Option(help="Folder for the report.")] = Path("demo_output"),
    hand: Hand = "icub_right",
    seeds: Annotated[str, Option(help="FIRST:END, e.g. 1000:1008; each seed is one grasp.")] = "1000:1008",
    jobs: Jobs = 2,
    quick: Annotated[bool, Option(help="Two grasps, two angles: to see that it works.")] = False,
) -> None:
    """Turn a grasped object in the simulated hand, with the KM and with the E-KM, and report.

    Takes about two minutes on two cores. Interrupted, it goes on where it stopped.
    """
    from .experiments.config import Setting
    from .experiments.protocols.demo import Demo
    from .experiments.reproduce import Experiment

    protocol, chosen = Demo(Setting(hand=hand), (object,)), parse_seeds(seeds)
    planned = Experiment(protocol.quick(), chosen[:2]) if quick else Experiment(protocol, chosen)
    for figure in _run("manipulating", planned, out, jobs).figures:
        say(f"           {(out / figure.path).resolve()}")


@app.command()
def reproduce(
    experiment: Annotated[
        str, Argument(help="online, generalize, ablation, adapt or foresight.")
    ] = "generalize",
    seeds: Annotated[str, Option(help="FIRST:END; each seed is an independent run.")] = "1000:1020",
    jobs: Jobs = 2,
    out: Annotated[Path | None, Option(help="Folder for the report [reproduce_<experiment>].")] = None,
    quick: Annotated[bool, Option(help="Two seeds, small turns: to see that it works.")] = False,
    objects: Annotated[
        str,
        Option(
            help="Names separated by commas, or a folder with URDF files of your own (generalize, adapt)."
        ),
    ] = "",
    hand: Hand = "icub_right",
    preset: Preset = "nominal",
    learner: Annotated[str, Option(help="action-linear, rbf, linear RLS, SOGP deep, ...")] = "action-linear",
    sensing: Sensing = True,
    angles: Annotated[
        str, Option(help="Turns [deg], e.g. 5,10,15; Table I if left out (generalize, ablation).")
    ] = "",
    step: Annotated[
        float | None,
        Option(help="Largest turn of one motion [deg]; 2.5 if left out (less where a contact goes 1.2 mm)."),
    ] = None,
    address: Annotated[
        str | None, Option(help="A Dask cluster instead of processes here: dask://HOST:PORT.")
    ] = None,
) -> None:
    """Repeat the paper's experiments, and more, with every controller on the same seeds and grasps.

    Interrupted, it goes on where it stopped, and ends with the same report.
    """
    from .experiments.config import Setting
    from .experiments.reproduce import plan

    control = {} if step is None else {"LimitingFunction.step": math.radians(step)}
    setting = Setting(hand=hand, preset=preset, learner=learner, sensing=sensing, control=control)
    turns = _numbers("angles", angles) if angles else None
    planned = plan(
        experiment,
        parse_seeds(seeds),
        setting=setting,
        objects=objects or None,
        angles_deg=turns,
        quick=quick,
    )
    _run(experiment, planned, out or Path(f"reproduce_{experiment}"), jobs, address)


@app.command()
def compare(
    data: Annotated[
        list[str], Option(help="A .csv or .parquet file, or the name of a recording; repeatable.")
    ],
    learners: Annotated[str, Option(help="Names, separated by commas; all without peers by default.")] = "",
    targets: Annotated[str, Option(help="Columns to predict; y, y1, y2, ... or the last by default.")] = "",
    out: Annotated[Path, Option(help="Folder for tables and figures.")] = Path("compare_output"),
    limit: Annotated[int, Option(min=0, help="Samples of a recording that are used; 0: all.")] = 1500,
    jobs: Jobs = 2,
) -> None:
    """Compare residual learners on streams: predict, score, update, in the order of time.

    Recordings: simulated_hand; in the folder that TORCH_EKM_DATA names: t42 (Sintov et al., GitHub
    avishais/t42_autonomous_system), icub_grasp (Soh et al., clear-nus/icub_grasp_dataset), sarcos
    (Kaixhin/SARCOS), kin40k and powerplant (treforevans/uci_datasets), mimo, lorenz, mackey_glass and
    santafe (steven2358/kafbox).
    """
    from .experiments import compare as run
    from .experiments.learners import COMPARED

    chosen = _names(learners) or COMPARED
    with progress("comparing", len(data) * len(chosen)) as advance:
        compared = run(
            data,
            chosen,
            targets=_names(targets),
            limit=limit or None,
            folder=out / "runs",
            processes=jobs,
            on_done=advance,
        )
    print_report(compared.write(out), out, notes=True)


@app.command()
def recorded_hand(
    data: Annotated[
        Path | None, Option(help="t42_testpaths.npz or its folder; a small synthetic one if left out.")
    ] = None,
    learners: Annotated[str, Option(help="Names, separated by commas.")] = "SOGP mixture",
    out: Annotated[Path, Option(help="Folder for the report.")] = Path("recorded_hand_output"),
    jobs: Jobs = 2,
    quick: Annotated[bool, Option(help="Two paths of four objects: to see that it works.")] = False,
) -> None:
    """Predict the recorded motions of a Yale T42 with its kinematic model, with and without learners.

    The recordings (Sintov et al., GitHub avishais/t42_autonomous_system) are read in place; the documentation
    tells how to save them as npz. Interrupted, it goes on where it stopped.
    """
    from .experiments.recorded_hand.benchmark import count_jobs, predict_recorded_hand
    from .experiments.recorded_hand.report import write_report

    chosen = _names(learners)
    with progress("predicting", count_jobs(data, len(chosen), quick=quick)) as advance:
        result = predict_recorded_hand(
            data, learners=chosen, folder=out / "runs", processes=jobs, quick=quick, on_done=advance
        )
    print_report(write_report(result, out), out, notes=True)


@app.command()
def record(
    log: Annotated[Path, Argument(help="Folder of the log; one that is there goes on.")],
    object: Annotated[str, Option(help=_AN_OBJECT)] = "box",
    hand: Hand = "icub_right",
    angles: Annotated[str, Option(help="Turns [deg], e.g. 10,20.")] = "10,20",
    seeds: Annotated[str, Option(help="FIRST:END; each angle is turned once for each seed.")] = "0:3",
    controller: Annotated[str, Option(help="KM, KM+I, KM+S or E-KM.")] = "KM",
    preset: Preset = "nominal",
    sensing: Sensing = True,
    images: Annotated[bool, Option(help="Keep the camera's images too.")] = False,
) -> None:
    """Turn an object in the simulated hand and log all of it, one HDF5 file for each turn.

    Interrupted or killed, it goes on where it stopped, and ends with the same files.
    """
    from .experiments.config import Setting
    from .experiments.protocols.record import RecordConfig
    from .experiments.protocols.record import record as run

    setting = Setting(hand=hand, preset=preset, sensing=sensing)
    config = RecordConfig(setting, object, controller, _numbers("angles", angles), images)
    chosen = parse_seeds(seeds)
    with progress("recording", len(chosen) * len(config.angles_deg)) as advance:
        made = run(config, chosen, log, on_trial=advance)
    say(f"{len(made)} trials in {made.folder.resolve()}")


@app.command()
def show(
    what: Annotated[str, Argument(metavar="[HAND|LOG]", help="A hand, a URDF, or a log.")] = "icub_right",
    object: Annotated[str | None, Option(help="An object for the hand to hold.")] = None,
    seed: Annotated[int, Option(help="Which grasp of the object.")] = 0,
    reach: Annotated[bool, Option(help="How far it can be turned, and what ends it.")] = False,
    html: Html = None,
    port: Port = 8080,
) -> None:
    """Turn and zoom a hand, a grasp or a log in the browser.

    A hand has a slider for each actuator, a grasp is simulated while its actuators are moved, a log is
    played.
    """
    from .experiments.viewer.serve import ReachShow, choose_show

    shown = choose_show(what, object, seed, reach)
    if isinstance(shown, ReachShow):
        print_table(("direction", "angle [deg]", "ends by"), shown.rows(), shown.title)
    _look(shown, html, port)


@app.command()
def replay(
    log: Annotated[Path, Argument(help="A log's folder, or the file of one trial.")],
    trial: Annotated[int | None, Option(help="Which trial; the first one by default.")] = None,
    estimates: Annotated[bool, Option(help="Show what was measured, not the truth.")] = False,
    html: Html = None,
    port: Port = 8080,
) -> None:
    """List the trials of a log, and play one in the browser."""
    from .experiments.viewer.trial import LogShow
    from .plant import TrialEntry

    shown = LogShow(log, trial, estimates)
    if shown.log is not None:
        print_table(TrialEntry._fields, shown.log.index, str(log))
        for number, problem in shown.log.damaged.items():
            say(f"trial {number}: {problem}")
    _look(shown, html, port)


@app.command()
def verify(log: Annotated[Path, Argument(help="Folder of the log.")]) -> None:
    """Check every byte of a log, its index, and the files of hand and object that it was made from.

    Ends with 1 if a file is wrong, with 0 if not. "torch-ekm record" makes damaged trials again.
    """
    from .plant import Finding, verify_log

    found = verify_log(log)
    print_table(Finding._fields, found, str(log))
    if any(one.state == "wrong" for one in found):
        raise typer.Exit(1)


@app.command()
def notebooks(
    copy: Annotated[Path | None, Option(help="Copy them into this folder.")] = None,
    overwrite: Annotated[bool, Option(help="Also over files that are there.")] = False,
) -> None:
    """List the notebooks that come with the package, or copy them to where you can run them."""
    from .experiments.reporting.notebook import copy_notebooks, notebook_folder

    found = sorted(notebook_folder().glob("[0-9]*.ipynb"))
    for path in found if copy is None else copy_notebooks(copy, overwrite=overwrite):
        say(str(path))


@app.command()
def version() -> None:
    """Print the version, and those of the packages that decide the numbers."""
    from .experiments.reporting.report import versions

    for package, number in versions().items():
        say(f"{package} {number}")


def _run(what: str, planned: Experiment, folder: Path, jobs: int, address: str | None = None) -> Report:
    from .experiments.reproduce import reproduce as run

    with progress(what, len(planned.jobs)) as advance:
        report = run(planned, folder, jobs, advance, address)
    print_report(report, folder)
    return report


def _look(show: Show, html: Path | None, port: int) -> None:
    """Write a page, or serve until Ctrl-C."""
    from .experiments.viewer.serve import save_page, serve

    if html is not None:
        say(f"Page:      {save_page(show, html).resolve()}")
        return
    serve(show, port=port, on_ready=lambda address: say(f"Open {address} (Ctrl-C ends)"))


def _numbers(name: str, text: str) -> tuple[float, ...]:
    try:
        return tuple(map(float, _names(text)))
    except ValueError:
        raise ParameterError(name, text, "numbers separated by commas, e.g. 10,20") from None


def _names(text: str) -> tuple[str, ...]:
    return tuple(filter(None, map(str.strip, text.split(","))))


def parse_seeds(text: str) -> tuple[int, ...]:
    """``"1000:1006"`` as 1000..1005; a single number as itself.

    Raises:
        ParameterError: it is neither.
    """
    try:
        numbers = [int(part) for part in text.split(":")]
    except ValueError:
        numbers = []
    if len(numbers) == 1:
        return (numbers[0],)
    if len(numbers) == 2 and numbers[0] < numbers[1]:
        return tuple(range(*numbers))
    raise ParameterError("seeds", text, "FIRST:END with FIRST < END, e.g. 1000:1006, or one number")
