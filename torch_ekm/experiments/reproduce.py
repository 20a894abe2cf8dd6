"""Run an experiment over many seeds, and leave a folder that shows what came of it."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..description import load_object
from ..exceptions import ParameterError, UnknownNameError
from .config import FIRST_REPORTED, Setting
from .jobs import run_jobs
from .protocols.generalize import Generalize
from .protocols.online import Online
from .protocols.protocol import Protocol
from .records import TrialRecord
from .reporting.report import Report
from .reporting.statistics import DataFrame
from .reporting.tables import why
from .reporting.trials import trial_frame

PROTOCOLS: dict[str, type[Protocol]] = {"online": Online, "generalize": Generalize}
#: Seeds that nobody tuned on, at least twenty for each case.
REPORTED_SEEDS = tuple(range(FIRST_REPORTED, FIRST_REPORTED + 20))


@dataclass(frozen=True)
class Experiment:
    """A protocol and the seeds it is run with."""

    protocol: Protocol
    seeds: tuple[int, ...]
    quick: bool = False
    """Its report says that it claims nothing."""

    @property
    def jobs(self) -> dict[str, tuple[Any, ...]]:
        """Name -> arguments of the protocol's session."""
        return self.protocol.jobs(self.seeds)


def plan(
    name: str,
    seeds: tuple[int, ...] = REPORTED_SEEDS,
    *,
    setting: Setting | None = None,
    objects: str | Path | None = None,
    angles_deg: tuple[float, ...] | None = None,
    quick: bool = False,
) -> Experiment:
    """An experiment, nothing of it run yet.

    Args:
        name: a key of :data:`PROTOCOLS`.
        seeds: each is an independent run; every controller gets the same ones.
        objects: names separated by commas, or a folder with URDF files, instead of the experiment's own.
        angles_deg: turns to be made instead of the experiment's own.
        quick: two seeds and a few small turns: to see that it works, not to claim anything.

    Raises:
        UnknownNameError: no such experiment; the message lists them.
        ParameterError: no seeds, no URDF file in ``objects``, or an experiment that takes no objects
            or no angles.
    """
    if name not in PROTOCOLS:
        raise UnknownNameError("experiment", name, PROTOCOLS)
    if not seeds:
        raise ParameterError("seeds", seeds, "at least one seed")
    protocol = PROTOCOLS[name]()
    if quick:
        protocol, seeds = protocol.quick(), seeds[: protocol.quick_seeds]
    changes: dict[str, Any] = {} if setting is None else {"setting": setting}
    if objects is not None:
        changes["objects"] = objects_of(objects)
    if angles_deg is not None:
        changes["angles_deg"] = angles_deg
    for key in changes:
        takers = [name for name, kind in PROTOCOLS.items() if hasattr(kind(), key)]
        if name not in takers:
            raise ParameterError(key, changes[key], f"left out: only {', '.join(takers)} take them")
    return Experiment(dataclasses.replace(protocol, **changes), seeds, quick)  # pyright: ignore[reportArgumentType]


def reproduce(
    experiment: Experiment, folder: Path, processes: int = 1, on_done: Callable[[str], None] | None = None
) -> Report:
    """Run what has not been run yet, and write the report into ``folder``.

    Killed, it continues where it stopped when it is called again, and ends with the report of an
    unbroken run: a job's result depends on nothing but its configuration and its seed.

    Args:
        processes, on_done: of :func:`~torch_ekm.experiments.jobs.run_jobs`.
    """
    protocol, seeds = experiment.protocol, experiment.seeds
    trials = run_trials(protocol, seeds, folder / "runs", processes, on_done)
    report = protocol.report(seeds, trials, folder)
    report.empty = not (trials["motions"] > 0).any()
    if report.empty:  # errors and ratios of turns that nobody made mean nothing
        report.summary, report.figures = f"Nothing was turned. {why(trials)}", []
        report.tables = [table for table in report.tables if table.name == "stop_reasons"]
    report.summary += f" {protocol.setting}."
    if experiment.quick:
        report.title += ": a quick run"
        report.summary = f"A quick run shows that it works, and claims nothing. {report.summary}"
    report.configuration = {
        "experiment": dataclasses.asdict(protocol),  # pyright: ignore[reportArgumentType]
        "seeds": list(seeds),
        **protocol.setting.figures(),
    }
    report.write(folder)
    trials.to_csv(folder / "trials.csv", index=False)
    return report


def run_trials(
    protocol: Protocol,
    seeds: Sequence[int],
    folder: Path,
    processes: int = 1,
    on_done: Callable[[str], None] | None = None,
) -> DataFrame:
    """The trials of all sessions; finished ones stay in ``folder``."""
    kept = run_jobs(protocol.run, protocol.jobs(seeds), folder, processes, on_done)
    read = TrialRecord.from_json
    results = {name: [read(figures) for figures in session] for name, session in kept.items()}
    return trial_frame(results)


def objects_of(names: str | Path) -> tuple[str, ...]:
    """Names, or the URDF files of a folder, sorted.

    Raises:
        UnknownNameError: no folder, and no object has such a name; the message lists them.
        ParameterError: there are no URDF files in the folder.
        DescriptionError: one is faulty; the message names file and place.
    """
    folder = Path(names)
    if not folder.is_dir() and not isinstance(names, Path):
        chosen = tuple(dict.fromkeys(part.strip() for part in names.split(",") if part.strip()))
        for name in chosen:
            load_object(name)
        return chosen
    found = tuple(str(path) for path in sorted(folder.glob("*.urdf")))
    if not found:
        valid = "a folder with *.urdf files, each with its *.object.toml"
        raise ParameterError("objects", str(folder), valid)
    for path in found:  # what is wrong with one is said before anything runs
        load_object(path)
    return found
