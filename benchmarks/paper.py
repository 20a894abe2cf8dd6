"""Every figure and table of the paper, its numbers beside those found here.

    python benchmarks/paper.py --seeds 1000:1020 --out FOLDER

Numbers come from the other pages, or from folders that their runs left: ``--generalize``, ``--worn`` and
``--as-printed`` take either. Fig. 5 is made of sessions of ``torch-ekm reproduce online``: those that its
folder (``--online``) lacks are run, the E-KM's only, in a minute or two each. The paper's numbers are those
of its text and tables; its curves and pictures are not in our copy.
"""

from __future__ import annotations

import argparse
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from page import ROOT
from paper_overview import AHEAD, CAN_TRIAL_2, LAST_NEGATIVE, LAST_UPPER, NO_COPY, RATIOS, overview
from paper_pictures import (
    coupled_joints,
    draw_coupled_joints,
    draw_objects,
    draw_turn,
    largest_difference,
    turn_applier,
)
from write_pages import read_report

from torch_ekm._terminal import progress
from torch_ekm.cli._app import parse_seeds
from torch_ekm.description import load_hand
from torch_ekm.experiments.config import Setting
from torch_ekm.experiments.jobs import run_jobs
from torch_ekm.experiments.protocols.generalize import TABLE_I, TABLE_II
from torch_ekm.experiments.protocols.online import Online, prediction_curves
from torch_ekm.experiments.reporting.plots import save_figure
from torch_ekm.experiments.reporting.report import Cell, Report, Table
from torch_ekm.experiments.reporting.statistics import DataFrame, bootstrap_mean
from torch_ekm.experiments.reporting.tables import prediction_means
from torch_ekm.experiments.reporting.trials import trial_frame

PAGES = ROOT / "docs" / "benchmarks"
#: Page -> what measures it.
SOURCES = {
    "generalize": "torch-ekm reproduce generalize",
    "worn": "torch-ekm reproduce generalize --preset worn",
    "as_printed": "python benchmarks/as_printed.py",
}
OVERVIEW = (
    "The paper's numbers, from its tables and text (hatched bars, black), and those found here. Fig. 5a: "
    "median and quartiles over seeds; dotted: the object is pushed in trials 20 and 44, as in the paper, and "
    "tendons are replaced before trial 31. Fig. 5b: a line for each hand; dashed: 5 %, and no difference."
)
COUPLED = (
    "In place of Fig. 2b: links whose joints share a motor, in one colour, and these joints over the motor's "
    "position. Lines: actuation map; marks: the simulated hand, which touches nothing."
)
SIX = "In place of Fig. 3e: the six objects at one scale, with their centres of mass."
APPLIER = (
    "In place of Fig. 4: the applier, from the grasp to the largest angle about the axis that the E-KM "
    "reaches in this grasp; the target lies beyond it."
)
_TABLE_II = "The paper's Table II"
_NUMBER = re.compile(r"-?\d+(?:\.\d+)?(?:e-?\d+)?")
Tables = dict[str, list[dict[str, str]]]


def tables_of(source: Path) -> Tables:
    """Caption -> rows, each heading -> cell, of the folder of a report or of a page.

    Raises:
        SystemExit: there is neither.
    """
    if source.is_dir():
        found = {table.caption: [table.header, *table.rows] for table in read_report(source).tables}
    elif source.is_file():
        heading = r"^(?:#+ |<summary>)(.*?)(?:</summary>)?$"
        parts = re.split(heading, source.read_text(encoding="utf-8"), flags=re.MULTILINE)[1:]
        found = {}
        for caption, text in zip(parts[::2], parts[1::2], strict=True):
            found.setdefault(caption, _cells(text))  # a page's later commands may have the same captions
    else:
        raise SystemExit(f"no page and no folder of a report: {source}")
    return {
        name: [dict(zip(rows[0], row, strict=True)) for row in rows[1:]]
        for name, rows in found.items()
        if rows
    }


def _cells(text: str) -> list[list[str]]:
    """The first table of Markdown."""
    lines = [line for line in text.splitlines() if line.startswith("|")]
    rows = [[cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]] for line in lines]
    return [row for k, row in enumerate(rows) if k != 1]


def numbers(cell: str) -> list[float]:
    """Those in a cell, from left to right."""
    return [float(text) for text in _NUMBER.findall(cell)]


@dataclass(frozen=True)
class Objects:
    """What a run with several objects found."""

    tables: Tables
    command: str
    """That measures it."""

    @property
    def missing(self) -> str:
        """In place of a number that is not there."""
        return f"measured by `{self.command}`"

    def row(self, caption: str, first: str) -> dict[str, str]:
        """The row that begins so, of the table whose caption does; {}: there is none."""
        rows = [row for name, rows in self.tables.items() if name.startswith(caption) for row in rows]
        return next((row for row in rows if next(iter(row.values())).startswith(first)), {})

    def cell(self, caption: str, first: str, column: str) -> str:
        """A cell of it, or which command measures it."""
        return self.row(caption, first).get(column) or self.missing

    @property
    def errors(self) -> dict[str, tuple[float, float]]:
        """Of KM and E-KM with each object that is there [deg]."""
        rows = {item: row for item in TABLE_II if (row := self.row(_TABLE_II, item))}
        return {
            item: (numbers(row["KM, here [deg]"])[0], numbers(row["E-KM, here [deg]"])[0])
            for item, row in rows.items()
        }

    def table_ii(self, item: str) -> str:
        """Errors of KM and E-KM with an object, and their ratio."""
        row = self.row(_TABLE_II, item)
        if not row:
            return self.missing
        return f"{row['KM, here [deg]']}; {row['E-KM, here [deg]']}; {row['E-KM:KM, here [%]']} %"

    def mean(self) -> str:
        """Of the five objects, as in :meth:`table_ii`."""
        return mean_text(self.errors) if self.errors.keys() == TABLE_II.keys() else self.missing

    def ends(self) -> str:
        """Objects that the E-KM lost, and turns that did not reach the target, of Table I."""
        caption, column = "Objects lost, and turns", "E-KM lost, not reached"
        rows = [self.row(caption, item) for item in TABLE_I]
        if not all(rows):
            return self.missing
        lost, missed = np.sum([numbers(row[column]) for row in rows], axis=0).astype(int)
        return f"the same; E-KM: {lost} lost, {missed} not reached"

    def cells(self) -> list[tuple[str, float, float]]:
        """Each object, target after target, with the errors of KM and E-KM [deg]."""
        rows = {item: list(self.row("Each object and target", item).values())[1:] for item in TABLE_I}
        found = [(item, numbers(cell)) for item, row in rows.items() for cell in row if cell != "-"]
        return [(item, km, ekm) for item, (_, km, ekm, *_) in found]


def mean_text(errors: Mapping[str, tuple[float, float]]) -> str:
    """Mean errors of KM and E-KM over the objects [deg], and their ratio."""
    km, ekm = np.mean(list(errors.values()), axis=0)
    return f"{km:.2f}; {ekm:.2f}; {100 * ekm / km:.0f} %"


def online_sessions(protocol: Online, seeds: Sequence[int], folder: Path) -> DataFrame:
    """Trials of the E-KM, from the folder of a run; those that it lacks are run."""
    jobs = {name: job for name, job in protocol.jobs(seeds).items() if job[0] == "E-KM"}
    with progress("learning online", len(jobs)) as advance:
        kept = run_jobs(protocol.run, jobs, folder / "runs", on_done=advance)
    read = protocol.record.from_json
    results = {name: [read(figures) for figures in session] for name, session in kept.items()}
    return trial_frame(results, protocol.setting.safety.rule.max_steps)


def table_ii(here: dict[str, Objects]) -> Table:
    """The paper's errors object by object, beside those found here."""
    nominal, worn = here["generalize"], here["worn"]
    rows: list[list[Cell]] = [
        [
            item.replace("_", " "),
            f"{km}; {ekm}; {RATIOS[item]} %",
            nominal.table_ii(item),
            worn.table_ii(item),
        ]
        for item, (km, ekm) in TABLE_II.items()
    ]
    paper = mean_text(TABLE_II)
    rows.append(["mean of the five", paper, nominal.mean(), worn.mean()])
    rows.append(
        [
            "mean, by [the system as printed](as_printed.md) in MuJoCo, poses plus noise",
            paper,
            as_printed(here["as_printed"]),
            None,
        ]
    )
    columns = ["object", "paper", "here", "here, worn hand"]
    note = "Error [deg]: KM; E-KM; ratio. Intervals: 95 %, over pairs of object and seed."
    return Table("table_ii", "Table II", columns, rows, note)


def figures_table(
    here: dict[str, Objects], online: Table, prediction: str, pictures: dict[str, str]
) -> Table:
    """A row for each figure and table of the paper.

    Args:
        here: page -> what it has.
        online: the figures of Fig. 5.
        prediction: mean prediction errors of KM and E-KM.
        pictures: figure -> what is drawn in its place.
    """
    nominal, worn = here["generalize"], here["worn"]
    found = {str(row[0]): text for row, text in zip(online.rows, online.text(), strict=True)}

    def fig_5(first: str) -> str:
        return next(text[2] for name, text in found.items() if first in name)

    def won(first: str) -> list[Cell]:
        return [one.cell("Cells won, and p-values", first, "here") for one in (nominal, worn)]

    objects, learning, drawn = "[objects](generalize.md)", "[online](online.md)", "this page"
    loop, sensing = "[loop](../explanation/servo_inverse.md)", "[sensing](../explanation/sensing.md)"
    rows: list[list[Cell]] = [
        ["Fig. 1", "diagram of the controller", NO_COPY, "diagram", None, loop],
        ["Fig. 2a", "photograph of the hand", f"{NO_COPY}; 9 motors, 20 joints", pictures["2a"], None, drawn],
        ["Fig. 2b", "coupled joints, in equal patterns", NO_COPY, pictures["2b"], None, drawn],
        ["Fig. 3a, b", "camera, palm's marker", f"{NO_COPY}; VGA, 20 Hz", "VGA, simulated", None, sensing],
        ["Fig. 3c, d", "before and after a turn", NO_COPY, "first and last frame of Fig. 4", None, drawn],
        ["Fig. 3e", "the six objects", f"{NO_COPY}; their names", pictures["3e"], None, drawn],
        ["Table I", "25 rotations", "3 to 38 deg", nominal.ends(), worn.ends(), objects],
        ["Fig. 4", "applier, 0 to its end", f"{NO_COPY}; 28 deg (Table I: 23)", pictures["4"], None, drawn],
        ["Fig. 5a", "prediction error of 45 trials: KM; E-KM [deg]",
         f"{NO_COPY}; E-KM ahead after < {AHEAD} trials", prediction, None, learning],
        ["Fig. 5b", "last index of negative result", f"{LAST_NEGATIVE}", fig_5("last index"), None, learning],
        ["Fig. 5b", "last upper boundary [deg]", f"{LAST_UPPER}", fig_5("last upper"), None, learning],
        ["Table II", "mean error [deg]: KM; E-KM; ratio", mean_text(TABLE_II), nominal.mean(), worn.mean(),
         objects],
        ["Fig. 6", "cells that the E-KM wins", "24 of 25", *won("cells won"), objects],
        ["Fig. 6", "cells that it does not win", f"can, trial 2: both errors < {CAN_TRIAL_2} deg",
         *won("cells lost"), objects],
        ["Fig. 6", "p of two samples", "3.8e-4", *won("p of two samples"), objects],
    ]  # fmt: skip
    columns = ["in the paper", "what it shows", "paper", "here", "here, worn hand", "page"]
    note = (
        "Here: simulated iCub hands, preset nominal; worn: preset worn. Intervals: 95 %, over pairs of "
        "object and seed, or over seeds. A cell is an object with a target; in brackets the number of hands."
    )
    return Table("paper", "Figure by figure", columns, rows, note)


def as_printed(source: Objects) -> str:
    """Errors of KM and E-KM as the paper prints its system, and objects lost."""
    caption = "The paper's system and this package's"
    km, ekm = (source.row(caption, f"{name}, as printed") for name in ("KM", "E-KM"))
    if not km or not ekm:
        return source.missing
    errors = f"{km['error [deg]']}; {ekm['error [deg]']}; {ekm['E-KM:KM [%]']} %"
    return f"{errors}; objects lost: {km['lost']}; {ekm['lost']}"


def main() -> None:
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=raw)
    for name, command in SOURCES.items():
        about = f"a page, or the folder that '{command}' left"
        parser.add_argument(
            f"--{name.replace('_', '-')}", type=Path, default=PAGES / f"{name}.md", help=about
        )
    parser.add_argument("--online", type=Path, help="the folder of 'torch-ekm reproduce online' [--out]")
    parser.add_argument("--seeds", type=parse_seeds, default=parse_seeds("1000:1020"), help="FIRST:END")
    parser.add_argument("--out", type=Path, default=Path("paper_output"), help="keeps what is finished")
    parser.add_argument("--quick", action="store_true", help="small turns, two seeds: to see that it works")
    options = parser.parse_args()
    here = {name: Objects(tables_of(getattr(options, name)), command) for name, command in SOURCES.items()}
    protocol, seeds = Online(Setting(sensing=True)), options.seeds
    if options.quick:
        protocol, seeds = protocol.quick(), seeds[: protocol.quick_seeds]
    trials = online_sessions(protocol, seeds, options.online or options.out)
    ekm, km = (bootstrap_mean(errors) for errors in prediction_means(trials))
    hand = load_hand("icub_right")
    coupled = coupled_joints(hand, 3 if options.quick else 7)
    turn = turn_applier(seeds[0], options.quick)
    pictures = {
        "2a": f"a model of it; {hand.n_a} motors, {hand.n_q} joints",
        "2b": f"drawn; joints of one motor differ by at most {largest_difference(coupled):.1f} deg, free",
        "3e": "drawn from their files",
        "4": f"drawn; {turn.angles[turn.end]:.0f} deg, {turn.off[turn.end]:.0f} deg off the axis",
    }
    nominal, curves = here["generalize"], prediction_curves(trials, protocol.trials)
    errors = nominal.errors, here["worn"].errors
    shown = overview(*errors, nominal.cells(), nominal.missing, curves, protocol.events)
    drawn = {
        "overview": (shown, OVERVIEW),
        "coupled_joints": (draw_coupled_joints(hand, coupled), COUPLED),
        "six_objects": (draw_objects(), SIX),
        "applier_turn": (draw_turn(turn), APPLIER),
    }
    figures = [save_figure(figure, options.out, name, text) for name, (figure, text) in drawn.items()]
    prediction = f"{km:.2f}; {ekm:.2f}"
    every = figures_table(here, protocol.paper_table(trials), prediction, pictures)
    summary = (
        f"Mean errors of Table II [deg], KM; E-KM; ratio: paper {mean_text(TABLE_II)}, here "
        f"{nominal.mean()}. Prediction errors of Fig. 5a [deg], KM; E-KM: {prediction}, on {len(seeds)} "
        "seeds. The paper's curves and photographs are not in our copy: what its text says of them stands "
        "in their place."
    )
    report = Report("The paper's figures and tables", summary, [table_ii(here), every], figures, leading=1)
    report.write(options.out)
    print(report.markdown())


if __name__ == "__main__":
    main()
