"""The paper's figures and tables, its numbers beside those found here.

    python benchmarks/paper.py --seeds 1000:1020 --out FOLDER

The paper's objects by KM and E-KM, on preset nominal and on worn (Table II, Fig. 6), and the E-KM's 45 turns
with two pushes and other tendons (Fig. 5). The paper's numbers are those of its text and tables; its curves
and pictures are not in our copy. Finished sessions stay in ``--out``: an interrupted run goes on.
"""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from torch_ekm._terminal import progress
from torch_ekm.cli._app import parse_seeds
from torch_ekm.experiments.config import Setting
from torch_ekm.experiments.protocols.generalize import TABLE_II, Generalize, paper_table, significance_table
from torch_ekm.experiments.protocols.online import Online, prediction_curves
from torch_ekm.experiments.protocols.protocol import Protocol
from torch_ekm.experiments.reporting.plots import COLOURS, new_figure, save_figure
from torch_ekm.experiments.reporting.report import Cell, Report, Table
from torch_ekm.experiments.reporting.statistics import DataFrame, estimate, select
from torch_ekm.experiments.reproduce import Experiment, run_trials

#: The last row of Table II as it is printed: E-KM:KM [%].
RATIOS = {"weighted_box": 31.5, "box": 28.5, "bottle": 38.5, "applier": 70.0, "can": 54.5}
#: Section V.A: last index of negative result, last upper boundary [deg], trials until the E-KM is ahead.
LAST_NEGATIVE, LAST_UPPER, AHEAD = 16, -0.57, 10


def mean_text(trials: DataFrame | None) -> str:
    """Mean errors of KM and E-KM over the objects, and their ratio: the paper's if there are no trials."""
    if trials is None:
        km, ekm = (float(np.mean([pair[k] for pair in TABLE_II.values()])) for k in (0, 1))
        return f"{km:.2f}; {ekm:.2f}; {100 * ekm / km:.0f} %"
    turns = trials[(trials["kind"] == "turn") & trials["grasped"].astype(bool)]
    errors = turns.groupby("controller")["error_deg"].mean()
    return f"{errors['KM']:.2f}; {errors['E-KM']:.2f}; {100 * errors['E-KM'] / errors['KM']:.0f} %"


def figures_table(here: Mapping[str, DataFrame], online: Table, prediction: str) -> Table:
    """A row for each number of the paper.

    Args:
        here: trials on "nominal" and "worn".
        online: the figures of Fig. 5.
        prediction: mean prediction errors of KM and E-KM.
    """
    found = {str(row[0]): text for row, text in zip(online.rows, online.text(), strict=True)}
    tests = [{str(row[0]): row[2] for row in significance_table(one).rows} for one in here.values()]

    def won(what: str) -> list[Cell]:
        return [next((x for key, x in own.items() if key.startswith(what)), None) for own in tests]

    def fig_5(first: str) -> str:
        return next(text[2] for name, text in found.items() if first in name)

    fig_6, five_b = "Fig. 6: ", "Fig. 5b: "
    rows: list[list[Cell]] = [
        ["Table II: mean error [deg], KM; E-KM; ratio", mean_text(None), *map(mean_text, here.values())],
        ["Fig. 5a: prediction error [deg], KM; E-KM", f"E-KM ahead after < {AHEAD} trials", prediction, None],
        [f"{five_b}last index of negative result", f"{LAST_NEGATIVE}", fig_5("last index"), None],
        [f"{five_b}last upper boundary [deg]", f"{LAST_UPPER}", fig_5("last upper"), None],
        [f"{fig_6}cells that the E-KM wins", "24 of 25", *won("cells won")],
        [f"{fig_6}cells that it does not win", "can, trial 2", *won("cells lost")],
        [f"{fig_6}p of two samples", "3.8e-4", *won("p of two samples")],
    ]
    note = "Simulated iCub hands, presets nominal and worn. A cell is an object with a target."
    columns = ["in the paper", "paper", "here", "here, worn hand"]
    return Table("numbers", "Number by number", columns, rows, note)


def overview(
    here: Mapping[str, DataFrame], curves: tuple[DataFrame, DataFrame], events: Sequence[int]
) -> Any:
    """Table II, its last row, and Fig. 5a: the paper's numbers hatched or black."""
    figure, (errors, ratios, predicted) = new_figure(11.0, 3.4, columns=3)
    items = list(TABLE_II)
    x, mean = np.arange(len(items)), {}
    for name, trials in here.items():
        turns = trials[(trials["kind"] == "turn") & trials["grasped"].astype(bool)]
        errors_of = turns.groupby(["controller", "object"])["error_deg"].mean().unstack()
        mean[name] = errors_of.reindex(columns=items)
    for k, controller in enumerate(("KM", "E-KM")):
        at, colour = x + 0.4 * k - 0.3, COLOURS[controller]
        paper = [pair[k] for pair in TABLE_II.values()]
        errors.bar(at, paper, 0.18, fill=False, edgecolor=colour, hatch="////", label=f"{controller}, paper")
        errors.bar(at + 0.2, mean["nominal"].loc[controller], 0.18, color=colour, label=f"{controller}, here")
    ratios.bar(x - 0.25, [RATIOS[item] for item in items], 0.23, fill=False, hatch="////", label="paper")
    for k, (name, one) in enumerate(mean.items()):
        colour = COLOURS["E-KM" if name == "nominal" else "limit"]
        ratio = 100 * one.loc["E-KM"] / one.loc["KM"]
        ratios.bar(x + 0.25 * k, ratio, 0.23, color=colour, label=f"here, {name}")
    for axis in (errors, ratios):
        axis.set_xticks(x, [item.replace("_", "\n") for item in items], fontsize=7)
        axis.margins(y=0.3)
        axis.legend(fontsize=7)
    errors.set(title="Table II", ylabel="steady-state error [deg]")
    ratios.set(title="Table II, E-KM:KM", ylabel="E-KM:KM [%]")
    for name, one in zip(("E-KM", "KM"), curves, strict=True):
        low, high = (one.quantile(share) for share in (0.25, 0.75))
        predicted.fill_between(one.columns, low, high, color=COLOURS[name], alpha=0.2, linewidth=0)
        predicted.plot(one.columns, one.median(), color=COLOURS[name], label=f"{name}, here")
    predicted.axvspan(1, AHEAD, color="black", alpha=0.06, label="paper: E-KM ahead by its end")
    for event in events:
        predicted.axvline(event, color=COLOURS["limit"], linewidth=0.8, linestyle=":")
    predicted.set(title="Fig. 5a", xlabel="trial", ylabel="prediction error [deg]", ylim=(0, None))
    predicted.legend(fontsize=7)
    return figure


def main(arguments: Sequence[str] | None = None) -> None:
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=raw)
    parser.add_argument("--seeds", type=parse_seeds, default=parse_seeds("1000:1020"), help="FIRST:END")
    parser.add_argument("--out", type=Path, default=Path("paper_output"), help="keeps what is finished")
    parser.add_argument("--jobs", type=int, default=2, help="processes at once")
    parser.add_argument("--quick", action="store_true", help="small turns, one seed: to see that it works")
    given = parser.parse_args(arguments)
    base, seeds = Setting(sensing=not given.quick), given.seeds
    both, online = ("KM", "E-KM"), Online(base, controllers=("E-KM",))
    objects = {name: Generalize(base.replace(preset=name), controllers=both) for name in ("nominal", "worn")}
    if given.quick:
        seeds, online = seeds[:1], online.quick()
        objects = {
            name: dataclasses.replace(one.quick(), objects=("box",), warm_up=0)
            for name, one in objects.items()
        }
    protocols: dict[str, Protocol] = {**objects, "online": online}
    todo = sum(len(one.jobs(seeds)) for one in protocols.values())
    with progress("running", todo) as advance:
        found = {
            name: run_trials(Experiment(one, seeds), given.out / name, given.jobs, advance)
            for name, one in protocols.items()
        }
    trials = found.pop("online")
    turns = select(trials, controller="E-KM", kind="turn")
    ekm, km = (estimate(turns, f"prediction_{name}") for name in ("ekm", "km"))
    table = figures_table(found, online.paper_table(trials), f"{km:.2f}; {ekm:.2f}")
    shown = overview(found, prediction_curves(trials, online.trials), online.events)
    caption = "The paper's numbers (hatched, grey) and those found here; dotted: pushes, and other tendons."
    figure = save_figure(shown, given.out, "overview", caption)
    told = f"Mean errors of Table II [deg], KM; E-KM; ratio: paper {mean_text(None)}, here "
    told += f"{mean_text(found['nominal'])}. Prediction errors of Fig. 5a [deg]: {km:.2f}; {ekm:.2f}."
    report = Report("The paper", told, [table, paper_table(found["nominal"])], [figure], leading=1)
    report.write(given.out)
    print(report.markdown())


if __name__ == "__main__":
    main()
