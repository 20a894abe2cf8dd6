"""Commands that run experiments and comparisons, and leave a report."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from .._terminal import console, print_report, progress, say, say_next
from ..exceptions import ParameterError
from ._app import AN_OBJECT, Engine, Hand, Jobs, Preset, Sensing, app, names, parse_seeds

import typer  # isort: skip
from typer import Argument, Option  # isort: skip

if TYPE_CHECKING:
    from ..experiments.reproduce import Experiment

#: Seconds on one free core: of a session, else 20; of a quick one; of a learner with a row.
_SESSION, _QUICK, _LEARNER = {"online": 70}, 8, 0.006


@app.command()
def demo(
    object: Annotated[str, Argument(help=AN_OBJECT)] = "box",
    out: Annotated[Path, Option(help="Folder for the report.")] = Path("demo_output"),
    hand: Hand = "icub_right",
    seeds: Annotated[str, Option(help="FIRST:END, e.g. 1000:1008; each seed is one hand.")] = "1000:1008",
    jobs: Jobs = 2,
    quick: Annotated[bool, Option(help="Two seeds, two angles: a trial run.")] = False,
) -> None:
    """Turn an object with the KM and with the E-KM, then objects that are new to the hand, and report.

    Eight instances of the simulated hand, five turns from new grasps with each controller; then four more
    objects with the first of them: two to three minutes on two cores; half a minute with --quick.
    Interrupted, it continues where it stopped.
    """
    from ..experiments.config import Setting
    from ..experiments.protocols.demo import Demo
    from ..experiments.reproduce import Experiment

    protocol, chosen = Demo(Setting(hand=hand), (object,)), parse_seeds(seeds)
    planned = Experiment(protocol.quick(), chosen[:2], quick) if quick else Experiment(protocol, chosen)
    _run("turning", planned, out, jobs)
    say_next(
        f"open the report; another object: torch-ekm demo can --out {out}_can (torch-ekm objects lists them)"
    )


@app.command()
def reproduce(
    experiment: Annotated[str, Argument(help="generalize or online.")] = "generalize",
    seeds: Annotated[str, Option(help="FIRST:END; each seed is an independent run.")] = "1000:1020",
    jobs: Jobs = 2,
    out: Annotated[Path | None, Option(help="Folder for the report [reproduce_<experiment>].")] = None,
    quick: Annotated[bool, Option(help="Two seeds, small turns: a trial run.")] = False,
    objects: Annotated[str, Option(help="Names or URDF files, separated by commas (generalize).")] = "",
    hand: Hand = "icub_right",
    preset: Preset = "nominal",
    engine: Engine = "sapien",
    learner: Annotated[str, Option(help="action-linear, rbf, or model alone.")] = "action-linear",
    sensing: Sensing = True,
) -> None:
    """Repeat the paper's experiments.

    Every controller has the same seeds and grasps. Interrupted, it continues where it stopped, and ends with
    the same report. With 20 seeds, on two cores:

    \b
    experiment  sessions  of                                      time
    generalize       400  5 to 8 turns: 5 objects, 4 controllers  0.5 to 1.5 h
    online            80  45 turns: 4 controllers                 0.5 to 1.5 h

    Time grows with the number of seeds and objects. With --quick: one or two minutes.
    """
    from ..experiments.config import Setting
    from ..experiments.reproduce import plan

    setting = Setting(hand=hand, preset=preset, engine=engine, learner=learner, sensing=sensing)
    changes = {"objects": names(objects)} if objects else {}
    planned = plan(experiment, parse_seeds(seeds), quick=quick, setting=setting, **changes)
    _run(experiment, planned, out or Path(f"reproduce_{experiment}"), jobs)
    say_next("the whole of it: the same command without --quick" if quick else "open the report")


@app.command()
def compare(
    data: Annotated[
        list[str], Option(help="A .csv or .parquet file, a ROS bag, or a recording's name; repeatable.")
    ],
    learners: Annotated[
        str,
        Option(
            help="Names, separated by commas: default, SOGP, linear RLS, model alone, ...; an "
            "unknown name lists all. If left out: all but those of other libraries. Your own: "
            "docs/how_to/write_a_learner.md."
        ),
    ] = "",
    targets: Annotated[str, Option("--targets", "--measured", help="To predict; else y, y1, ...")] = "",
    inputs: Annotated[str, Option(help="Columns to predict from; all others if left out.")] = "",
    predicted: Annotated[
        str, Option(help="Columns with your model's predictions of these: y is the difference.")
    ] = "",
    observation: Annotated[
        str, Option(help="In place of targets: columns whose next increments are predicted, from --inputs.")
    ] = "",
    run_column: Annotated[str, Option("--run", help="Column with one number or text in each run.")] = "",
    clock: Annotated[
        str | None, Option(help="Of a ROS bag or MCAP: the topic whose messages set the rows.")
    ] = None,
    out: Annotated[Path, Option(help="Folder for tables and figures.")] = Path("compare_output"),
    limit: Annotated[
        int, Option(min=0, help="Rows of a file or recording that are used, its first; 0: all.")
    ] = 1500,
    jobs: Jobs = 2,
) -> None:
    """Compare learners on streams of samples.

    Each learner predicts every sample, is scored, and then learns it, in the order of time. A CSV file needs
    the extra 'plots' only. One learner takes seconds to a minute for 1500 rows, all of them a few minutes on
    two cores. Interrupted, it continues where it stopped.

    Recordings: simulated_hand (extra 'sim'); in the folder that TORCH_EKM_DATA names: t42 (Sintov et al.,
    GitHub avishais/t42_autonomous_system), icub_grasp (Soh et al., clear-nus/icub_grasp_dataset), sarcos
    (Kaixhin/SARCOS), kin40k and powerplant (treforevans/uci_datasets), mimo, lorenz, mackey_glass and
    santafe (steven2358/kafbox).
    """
    from ..experiments import compare as run
    from ..experiments.learner_comparison.recordings import load_recording
    from ..experiments.learners import COMPARED, learner_factory

    chosen = names(learners) if learners else COMPARED
    if not chosen:
        raise ParameterError("learners", learners, "names of learners, separated by commas")
    if jobs > 1 and find_spec("joblib") is None:
        say("One process at a time: joblib, of the extra 'experiments', is not installed.")
        jobs = 1
    for name in chosen:
        learner_factory(name)  # an unknown one is refused before anything is read
    columns = {"targets": names(targets), "inputs": names(inputs), "predicted": names(predicted)}
    columns |= {"run": run_column, "clock": clock}
    with console.status("reading"):  # simulated_hand is made, which takes a minute
        streams = [load_recording(one, limit or None, names(observation), **columns) for one in data]
    seconds = _LEARNER * sum(map(len, streams)) * len(chosen) / jobs
    with progress("comparing", len(data) * len(chosen), seconds) as advance:
        compared = run(streams, chosen, folder=out / "runs", processes=jobs, on_done=advance)
    print_report(compared.write(out), out, notes=True)
    say_next("EnhancedModel(f, learner) in your loop; the call of each name: docs/how_to/choose_a_learner.md")


def _run(what: str, planned: Experiment, folder: Path, jobs: int) -> None:
    from ..experiments.reproduce import reproduce as run

    if planned.quick:
        say("A trial run, which claims nothing.")
    n, each = len(planned.jobs), _QUICK if planned.quick else _SESSION.get(what, 20)
    with progress(what, n, n * each / jobs) as advance:
        report = run(planned, folder, jobs, advance)
    print_report(report, folder)
    if report.empty:
        raise typer.Exit(1)
