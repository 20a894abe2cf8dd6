"""Run an experiment over many seeds, and leave a folder that shows what came of it."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..description import load_object
from ..exceptions import ParameterError, UnknownNameError
from .config import Setting
from .jobs import run_jobs
from .protocols.ablation import AblationConfig, ablation_jobs, ablation_session
from .protocols.object_memory import AdaptConfig, adapt_jobs, adapt_session
from .protocols.turning import (
    GeneralizeConfig,
    OnlineConfig,
    generalize_jobs,
    generalize_session,
    online_jobs,
    online_session,
)
from .reporting import reports
from .reporting.report import Report

EXPERIMENTS = ("online", "generalize", "ablation", "adapt")
#: Seeds that nobody tuned on, at least twenty for each case.
REPORTED_SEEDS = tuple(range(1000, 1020))


@dataclass(frozen=True)
class Experiment:
    """What is to be run, and what is made of the results."""

    config: Any
    seeds: tuple[int, ...]
    session: Callable[..., Any]
    jobs: Mapping[str, tuple[Any, ...]]
    build: Callable[[Mapping[str, Any], Path], Report]


def plan(
    name: str,
    seeds: tuple[int, ...] = REPORTED_SEEDS,
    *,
    setting: Setting | None = None,
    objects: Path | None = None,
    angles_deg: tuple[float, ...] | None = None,
    quick: bool = False,
) -> Experiment:
    """The jobs of an experiment, none of them run yet.

    Args:
        name: one of :data:`EXPERIMENTS`.
        seeds: each is an independent run; every controller gets the same ones.
        setting: hand, plant, learner, sensing.
        objects: a folder with URDF files to be used instead of the objects that come with the package.
        angles_deg: turns to be made instead of the experiment's own.
        quick: two seeds and a few small turns: to see that it works, not to claim anything.

    Raises:
        UnknownNameError: no such experiment; the message lists them.
        ParameterError: no seeds, no URDF file in ``objects``, or an experiment that takes no objects
            or no angles.
    """
    if name not in EXPERIMENTS:
        raise UnknownNameError("experiment", name, EXPERIMENTS)
    if not seeds:
        raise ParameterError("seeds", seeds, "at least one seed")
    found = None if objects is None else object_files(objects)
    if found is not None and name not in ("generalize", "adapt"):
        raise ParameterError("objects", str(objects), "left out: only 'generalize' and 'adapt' take objects")
    setting = Setting() if setting is None else setting
    seeds = seeds[:2] if quick else seeds
    changes: dict[str, Any] = {"setting": setting, **(_QUICK[name] if quick else {})}
    if found is not None:
        changes["objects"] = found
    if angles_deg is not None:
        if name not in ("generalize", "ablation"):
            raise ParameterError(
                "angles_deg", angles_deg, "left out: only 'generalize' and 'ablation' take angles"
            )
        changes["angles_deg"] = angles_deg
    if name == "online":
        online = OnlineConfig(**changes)
        return Experiment(
            online,
            seeds,
            online_session,
            online_jobs(online, seeds),
            lambda results, folder: reports.online_report(online, seeds, results, folder),
        )
    if name == "generalize":
        general = GeneralizeConfig(**changes)
        return Experiment(
            general,
            seeds,
            generalize_session,
            generalize_jobs(general, seeds),
            lambda results, folder: reports.generalize_report(general, seeds, results, folder),
        )
    if name == "ablation":
        ablation = AblationConfig(**changes)
        return Experiment(
            ablation,
            seeds,
            ablation_session,
            ablation_jobs(ablation, seeds),
            lambda results, folder: reports.ablation_report(ablation, seeds, results, folder),
        )
    adapt = AdaptConfig(**changes)
    seeds = seeds[:1] if quick else seeds
    return Experiment(
        adapt,
        seeds,
        adapt_session,
        adapt_jobs(adapt, seeds),
        lambda results, folder: reports.adapt_report(adapt, seeds, results, folder),
    )


def reproduce(
    experiment: Experiment,
    folder: Path,
    processes: int = 1,
    on_done: Callable[[str], None] | None = None,
    address: str | None = None,
) -> Report:
    """Run what has not been run yet, and write the report into ``folder``.

    Killed, it goes on where it stopped when it is called again, and ends with the report of an
    unbroken run: a job's result depends on nothing but its configuration and its seed.

    Args:
        processes: how many at once.
        on_done: called with each finished job's name.
        address: of a Dask or Ray cluster that does the work (``dask://HOST:PORT``, ``ray://HOST:PORT``).
    """
    jobs = dict(experiment.jobs)
    results = run_jobs(experiment.session, jobs, folder / "runs", processes, on_done, address)
    report = experiment.build(results, folder)
    config = experiment.config
    report.configuration = {
        "experiment": dataclasses.asdict(config),
        "seeds": list(experiment.seeds),
        **config.setting.figures(),
    }
    report.write(folder)
    return report


def object_files(folder: Path) -> tuple[str, ...]:
    """URDF files of a folder, sorted.

    Raises:
        ParameterError: there are none.
        DescriptionError: one is faulty; the message names file and place.
    """
    found = tuple(str(path) for path in sorted(folder.glob("*.urdf")))
    if not found:
        raise ParameterError(
            "objects", str(folder), "a folder with *.urdf files, each with its *.object.toml"
        )
    for path in found:  # what is wrong with one is said before anything runs
        load_object(path)
    return found


_QUICK: dict[str, dict[str, Any]] = {
    "online": {"trials": 4, "angles_deg": (5.0, 8.0), "dislocations": (3,), "tendons_replaced": 4},
    "generalize": {
        "objects": ("box", "can"),
        "angles_deg": (5.0, 9.0),
        "warm_up": 1,
        "long_step_deg": 3.0,
        "blind_deg": 0.0,
    },
    "ablation": {"angles_deg": (6.0,), "warm_up": 1, "groups": ("learner",)},
    "adapt": {"objects": ("box", "can", "applier"), "turns_each": 2},
}
