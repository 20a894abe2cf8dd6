"""Run an experiment over many seeds, and leave a folder that shows what came of it."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..exceptions import ParameterError, UnknownNameError
from .config import FIRST_REPORTED
from .jobs import run_jobs
from .protocols.generalize import Generalize
from .protocols.online import Online
from .protocols.protocol import Protocol
from .records import TrialRecord
from .reporting.report import Report
from .reporting.statistics import DataFrame, trial_frame
from .reporting.tables import why

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
    name: str, seeds: tuple[int, ...] = REPORTED_SEEDS, *, quick: bool = False, **changes: Any
) -> Experiment:
    """An experiment, nothing of it run yet.

    Args:
        name: a key of :data:`PROTOCOLS`.
        seeds: each is an independent run; every controller gets the same ones.
        quick: two seeds and a few small turns: to see that it works, not to claim anything.
        changes: of the protocol's fields: ``setting``; of "generalize" also ``objects``, ``angles_deg``.

    Raises:
        UnknownNameError: no such experiment; the message lists them.
        ParameterError: no seeds, or a field that the protocol does not have.
    """
    if name not in PROTOCOLS:
        raise UnknownNameError("experiment", name, PROTOCOLS)
    if not seeds:
        raise ParameterError("seeds", seeds, "at least one seed")
    protocol = PROTOCOLS[name]()
    if unknown := [key for key in changes if not hasattr(protocol, key)]:
        raise ParameterError(unknown[0], changes[unknown[0]], f"left out: '{name}' does not take it")
    if quick:
        protocol, seeds = protocol.quick(), seeds[:2]
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
    return write_report(experiment, run_trials(experiment, folder, processes, on_done), folder)


def run_trials(
    experiment: Experiment, folder: Path, processes: int = 1, on_done: Callable[[str], None] | None = None
) -> DataFrame:
    """The trials of all sessions; finished ones stay in ``folder/runs``."""
    kept = run_jobs(experiment.protocol.run, experiment.jobs, folder / "runs", processes, on_done)
    read = TrialRecord.from_json
    return trial_frame({name: [read(figures) for figures in session] for name, session in kept.items()})


def write_report(experiment: Experiment, trials: DataFrame, folder: Path) -> Report:
    """What came of the trials, as a page and ``trials.csv``."""
    protocol, seeds = experiment.protocol, experiment.seeds
    report = protocol.report(seeds, trials, folder)
    report.empty = not (trials["motions"] > 0).any()
    if report.empty:  # errors and ratios of turns that nobody made mean nothing
        report.summary, report.figures = f"Nothing was turned. {why(trials)}", []
        report.tables = [table for table in report.tables if table.name == "by_reason"]
    report.summary += f" {protocol}."
    if experiment.quick:
        report.title += ": a quick run"
        report.summary = f"A quick run shows that it works, and claims nothing. {report.summary}"
    report.configuration = {"seeds": list(seeds), **protocol.configuration()}
    report.write(folder)
    trials.to_csv(folder / "trials.csv", index=False)
    return report
