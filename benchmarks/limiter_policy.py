"""A policy instead of the limiting function: how long the next step shall be, learned on the KM alone.

    python benchmarks/limiter_policy.py --objects box,can --seeds 1000:1010 --out FOLDER

The paper's outlook (section VI): replace the limiting function by reinforcement learning. A policy is trained
by proximal policy optimisation (stable-baselines3) on hands that are a kinematic model with figures drawn
between those of the presets "none" and "hostile", while the controller has the description; it chooses which
share of a step of 6 deg is asked for. Then it turns objects in a simulated hand beside the paper's limiting
function and the pace that follows from evidence, around the same E-KM. Policy and finished sessions stay in
``--out``: an interrupted run goes on where it stopped.
"""

from __future__ import annotations

import hashlib
import itertools
import math
from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from any_hand import ANGLES, WARM_UP, count_of
from command_line import study_parser
from model_rig import ModelBench, drawn_plant
from step_policy import DECISIONS, LONGEST, LOST, MISSED, POLICY_FILE, ChosenPace, asked_of, policy_in, train

from torch_ekm._terminal import progress
from torch_ekm.control import LimitingFunction, Pace, PaceOptions, StepBound, StoppingRule
from torch_ekm.experiments.config import Setting, digest, object_name
from torch_ekm.experiments.jobs import run_jobs
from torch_ekm.experiments.records import TrialRecord
from torch_ekm.experiments.reporting.plots import COLOURS, new_figure, save_figure
from torch_ekm.experiments.reporting.report import Cell, Column, Report, Table
from torch_ekm.experiments.reporting.trials import trial_frame
from torch_ekm.experiments.runner import Bench
from torch_ekm.simulation import ENGINES, preset

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame

    from torch_ekm.typing import Array

_DEG = math.pi / 180
_FIRST_WARM_UP = 1000  # number of the first training grasp: never one that is tested
PAPER, LONG, PACE, POLICY = "limiting function", "limiting function, 6 deg", "pace", "policy"
#: What chooses the length of a step -> its colour.
SYSTEMS = {PAPER: "#CC79A7", LONG: COLOURS["KM+I"], PACE: COLOURS["E-KM"], POLICY: COLOURS["limit"]}
ON_MODEL = "kinematic model"
#: Errors [deg], and margins now and after a whole step [N], at which the policy is asked.
ERRORS, MARGINS = (25.0, 15.0, 8.0, 5.0, 3.0, 1.0), ((1.5, 0.5), (0.0, -1.0), (0.0, -4.0))
MODEL_SEEDS = 1  # of those that are given, on kinematic models


def bench_of(system: str, setting: Setting, item: str, model: bool, policy: Path) -> Bench:
    """The E-KM with one way to choose the length of a step.

    Args:
        model: the hand is a :class:`ModelRig`.
        policy: its file.
    """
    bench = (ModelBench if model else Bench)(setting, item, "E-KM")
    if system == POLICY:
        bench.pace = ChosenPace(policy_in(policy))
    elif system != PACE:
        size = LONGEST if system == LONG else 2.5
        limiting = LimitingFunction(step=size * _DEG, contact_travel=None)
        bench.pace = Pace(PaceOptions(limiting, StepBound(least=math.inf)), adapts=False)
    return bench


def session(
    system: str, setting: Setting, item: str, model: bool, seed: int, policy: Path
) -> list[dict[str, Any]]:
    """Warm-up, then the turns: how each ended."""
    bench = bench_of(system, setting, item, model, policy)
    for k in range(WARM_UP):
        bench.trial(seed, _FIRST_WARM_UP + k, float(np.median(ANGLES)), "warm-up")
    turns = [bench.trial(seed, k, angle).to_json() for k, angle in enumerate(ANGLES)]
    bench.close()
    return turns


class Outcome:
    """Turns by place and system, and the training.

    Args:
        trials: of :func:`trial_frame`, with the columns place and system.
        training: of :func:`train`.
    """

    def __init__(self, trials: DataFrame, training: dict[str, Any]) -> None:
        held = trials[trials["grasped"].astype(bool)].astype({"lost": bool, "not_reached": bool})
        self.trials = held.assign(reached=~(held["lost"] | held["not_reached"]))
        self.training = training
        self.places = list(dict.fromkeys(self.trials["place"]))

    def of(self, place: str, system: str) -> DataFrame:
        """The turns of a system."""
        return self.trials[(self.trials["place"] == place) & (self.trials["system"] == system)]

    def ratio(self, place: str, other: str) -> float:
        """Motions of the policy over those of another system, of the turns that both reached."""
        key = ["object", "seed", "trial"]
        mine, theirs = (
            turns[turns["reached"]].set_index(key)["motions"]
            for turns in (self.of(place, POLICY), self.of(place, other))
        )
        both = mine.index.intersection(theirs.index)
        return float(mine[both].sum() / theirs[both].sum()) if len(both) else math.nan

    def table(self, place: str, name: str, about: str) -> Table:
        """A row for each system."""
        rows: list[list[Cell]] = []
        for system in SYSTEMS:
            turns = self.of(place, system)
            if not len(turns):
                continue
            reached = turns[turns["reached"]]
            means = reached["motions"].mean(), reached["settle"].mean(), turns["error_deg"].mean()
            ends = count_of(turns[~turns["reached"]]["reason"])
            rows.append(
                [system, len(turns), int(turns["lost"].sum()), len(reached), *map(float, means), ends]
            )
        columns: list[str | Column] = [
            "steps by", "turns", "lost", "reached", Column("motions", ".1f"), Column("settled after", ".1f"),
            "error [deg]", "other ends",
        ]  # fmt: skip
        note = (
            "Means: motions, and motions until the measured error stays within 0.5 deg, of turns that"
            " reached the target; true error at the end, lost objects with the whole angle."
        )
        return Table(name, about, columns, rows, note)

    @property
    def verdict(self) -> str:
        """The last line."""
        place, parts = self.places[0], []
        for system in (POLICY, PAPER, PACE):
            turns = self.of(place, system)
            motions = turns[turns["reached"]]["motions"].mean()
            parts.append(f"{system} lost {turns['lost'].sum()} of {len(turns)}, {motions:.1f} motions")
        return "; ".join(parts)

    def picture(self) -> Figure:
        """Motions during the training, and errors and steps of the turns that are tested."""
        figure, (learning, errors, steps) = new_figure(9.5, 3.0, 3)
        turns = self.training["turns"]
        costs = [
            one["motions"] + LOST * one["lost"] + MISSED * (not (one["lost"] or one["reached"]))
            for one in turns
        ]
        for values, label, colour in (
            ([one["motions"] for one in turns], "motions", COLOURS["E-KM"]),
            (costs, "with losses and misses", COLOURS["limit"]),
        ):
            width = min(50, len(values))
            means = np.convolve(values, np.full(width, 1 / width), "valid")
            learning.plot([one["decision"] for one in turns][width - 1 :], means, color=colour, label=label)
        learning.set(xlabel="decisions of the training", ylabel="motions of a turn", ylim=(0, None))
        learning.legend(frameon=False, fontsize=8)
        shown = self.trials[self.trials["place"] == self.places[0]]
        for system, colour in SYSTEMS.items():
            mine = shown[shown["system"] == system]
            longest = mine[mine["angle_deg"] == max(ANGLES)]["errors_deg"]
            most = max(map(len, longest), default=0)
            held = [[*errors, *[errors[-1]] * (most - len(errors))] for errors in longest]
            if held:
                errors.plot(np.median(held, axis=0), color=colour, label=system)
            pairs = [pair for found in mine["errors_deg"] for pair in pairwise(found)]
            if pairs:
                before, after = np.array(pairs).T
                bins = np.arange(0, 28, 3)
                at = np.digitize(before, bins)
                made = [(bins[k - 1] + 1.5, (before - after)[at == k].mean()) for k in np.unique(at)]
                steps.plot(*zip(*made, strict=True), "o-", ms=3, color=colour)
        errors.set(xlabel=f"motions of a turn of {max(ANGLES):g} deg", ylabel="error [deg]", xlim=(0, 20))
        errors.legend(frameon=False, fontsize=8)
        steps.set(xlabel="error before a motion [deg]", ylabel="what it brings [deg]")
        return figure


def policy_table(policy: Callable[[Array], float]) -> Table:
    """What the policy asks for at some errors."""
    rows: list[list[Cell]] = [
        [error, *(asked_of(policy, error, *margins) for margins in MARGINS)] for error in ERRORS
    ]
    columns: list[str | Column] = [
        Column("error [deg]", "g"),
        *(Column(f"margins {now:g} and {after:g} N [deg]", ".2f") for now, after in MARGINS),
    ]
    note = (
        "With the required grip, after a last step as commanded; margins: the least friction margin now"
        " and after a whole step."
    )
    return Table("policy", "Step of the policy", columns, rows, note)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = study_parser(
        __doc__, "limiter_policy", objects="box,can", seeds="1000:1010", engine="sapien",
        quick="64 decisions of training, one object and seed",
    )  # fmt: skip
    given = parser.parse_args(arguments)
    objects, seeds, decisions = given.objects.split(","), given.seeds, DECISIONS
    if given.quick:
        objects, seeds, decisions = objects[:1], seeds[:1], 64
    training = train(given.out, objects, decisions)
    policy = given.out / POLICY_FILE
    own, todo, where = hashlib.sha256(policy.read_bytes()).hexdigest(), {}, {}
    tests = [(given.engine, seed) for seed in seeds] + [(ON_MODEL, seed) for seed in seeds[:MODEL_SEEDS]]
    for (place, seed), item, system in itertools.product(tests, objects, SYSTEMS):
        model = place == ON_MODEL
        plant = drawn_plant(np.random.default_rng(seed)) if model else preset("nominal")
        setting = Setting(plant=plant, engine=given.engine).hardware_instance(seed)
        mark = digest(setting, (item,), ANGLES, WARM_UP, system, own if system == POLICY else "")
        name = system.replace(" ", "_").replace(",", "")
        job = f"{object_name(item)}_{name}_{place.replace(' ', '_')}_{mark}_{seed}"
        todo[job], where[job] = (system, setting, item, model, seed, policy), (place, system)
    with progress("running", len(todo)) as advance:
        results = run_jobs(session, todo, given.out, given.jobs, advance)
    records = {job: [TrialRecord.from_json(one) for one in turns] for job, turns in results.items()}
    trials = trial_frame(records, StoppingRule().max_steps)
    trials["place"], trials["system"] = (trials["job"].map(lambda job, k=k: where[job][k]) for k in (0, 1))
    outcome = Outcome(trials, training)
    caption = (
        "Left: means over 50 turns of the training. Middle: median measured error in the simulated hand."
        " Right: by how much a motion lessens the error there, mean."
    )
    shown = save_figure(outcome.picture(), given.out, "limiter_policy", caption)
    tables = [
        outcome.table(given.engine, "simulated", f"In {ENGINES[given.engine]}, preset nominal"),
        outcome.table(ON_MODEL, "model", "On kinematic models like those of the training"),
        policy_table(policy_in(policy)),
    ]
    ended, place = training["turns"], outcome.places[0]
    ratios = (f"{outcome.ratio(place, other):.2f} of {other}" for other in SYSTEMS if other != POLICY)
    summary = (
        f"{outcome.verdict[0].upper()}{outcome.verdict[1:]}. Motions of the policy over those of turns that"
        f" both reached: {', '.join(ratios)}. Training: {training['decisions']} decisions,"
        f" {len(ended)} turns, {sum(one['lost'] for one in ended)} of them lost,"
        f" {training['minutes']:.0f} min."
    )
    report = Report("A policy for the length of a step", summary, tables, [shown])
    report.write(given.out)
    print(report.markdown())
    print(outcome.verdict)


if __name__ == "__main__":
    main()
