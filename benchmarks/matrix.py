"""Trials of simulated hands as one matrix: plant x object x controller x variant, one frame, a row a trial.

    python benchmarks/matrix.py hands --objects box,bottle --seeds 1000:1010 --out FOLDER
    python benchmarks/matrix.py --list

A question names plants, objects and contenders, what a session does, and the table and picture that answer
it, which are queries of the frame. The frame is left in ``--out`` as trials.csv. Finished sessions stay
there, too: an interrupted run goes on where it stopped.
"""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np
import pandas
from contenders import Contender
from hands import CONDITIONS, hands

from torch_ekm._terminal import print_report, progress
from torch_ekm.cli._app import parse_seeds
from torch_ekm.experiments.config import Setting, digest, object_name
from torch_ekm.experiments.protocols.protocol import Protocol
from torch_ekm.experiments.records import TrialRecord
from torch_ekm.experiments.reporting.plots import COLOURS, new_figure, save_figure
from torch_ekm.experiments.reporting.report import Cell, Column, Report, Table
from torch_ekm.experiments.reporting.statistics import select
from torch_ekm.experiments.reporting.tables import pivot
from torch_ekm.experiments.reproduce import Experiment, run_trials, write_report
from torch_ekm.simulation import ENGINES

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Frame = Any  # pandas has no types
EARLY = 5  # motions with an object
_INTERVAL = 1.645  # standard deviations: 90 %
_PALETTE = ("#0072B2", "#E69F00", "#009E73", "#D55E00", "#CC79A7", "#56B4E9", "#F0E442", "#332288")


@dataclass(frozen=True)
class Question(Protocol):
    """What is asked of the matrix."""

    name: str
    title: str
    act: Callable[..., Iterable[TrialRecord]]
    """What is done with one hand, controller and seed: ``act(make, items, seed, **options)``."""
    contenders: Mapping[str, Contender]
    hands: Sequence[str] = ("nominal",)
    """Names of :func:`hands.hands`."""
    objects: Sequence[str] = ("box", "can")
    setting: Setting = field(default_factory=lambda: Setting(engine="mujoco"))
    """What hands and contenders change."""
    options: Mapping[str, Any] = field(default_factory=dict)
    """Of ``act``."""
    together: bool = False
    """A session has all objects, in their order; else one."""
    plant: Mapping[str, Any] = field(default_factory=dict)
    """Figures of every plant."""
    by: str = "contender"
    """Column of the frame: a row of the table for each."""
    columns: tuple[str, ...] = ("turns", "lost", "reached", "motions", "error [deg]")
    """Names of :data:`FIGURES`; none: the first of ``more`` is the table."""
    split: str = "plant"
    """Column of the second table, which has a row for each of its entries."""
    more: tuple[Callable[[Frame], Table], ...] = ()
    """Further tables."""
    picture: Callable[[Frame], Figure] | None = None
    """None: ends and motions of the groups of ``split``."""
    told: Callable[[Frame], str] | None = None
    """The last line; None: :func:`verdict`."""
    short: Mapping[str, Any] = field(default_factory=lambda: {"angles": (4.0,), "learns_by": ()})
    """Options that make a session short."""

    def __str__(self) -> str:
        names = [*hands(self.hands)]
        return f"Hands: {', '.join(names)}" if len(names) < 8 else f"{len(names)} hands"

    def quick(self) -> Self:
        """One hand and object, two contenders, true poses."""
        return replace(
            self,
            hands=[*hands(self.hands)][:1],
            objects=self.objects[: 2 if self.together else 1],
            contenders=dict(itertools.islice(self.contenders.items(), 2)),
            setting=self.setting.replace(sensing=False),
            options={**self.options, **self.short},
        )

    def configuration(self) -> dict[str, Any]:
        names = {name: list(getattr(self, name)) for name in ("hands", "objects", "contenders")}
        return {**names, "options": self.options, "plant_changes": self.plant, **self.setting.figures()}

    def of(self, plant: str, contender: str) -> Setting:
        """How a contender meets a plant."""
        setting = self.setting.replace(**hands([plant])[plant])
        setting = setting.replace(plant=setting.parameters.replace(**self.plant))
        return self.contenders[contender].setting(setting)

    def jobs(self, seeds: Sequence[int]) -> dict[str, tuple[str, str, tuple[str, ...], int]]:
        found = {}
        groups = [tuple(self.objects)] if self.together else [(item,) for item in self.objects]
        for plant, seed, group, name in itertools.product(hands(self.hands), seeds, groups, self.contenders):
            one, setting = self.contenders[name], self.of(plant, name)
            decides = digest(setting, group, self.options, one.bench, one.controller, self.act.__name__)
            job = "_".join([plant, *map(object_name, group), name, decides, str(seed)])
            job = "".join(c if c.isalnum() or c in "_-.+" else "_" for c in job)
            found[job] = plant, name, group, seed
        return found

    def session(self, plant: str, contender: str, items: Sequence[str], seed: int) -> Iterator[TrialRecord]:
        """Each record says of which plant and contender it is, and in which part of the session."""
        one, own = self.contenders[contender], self.of(plant, contender).hardware_instance(seed)
        made = self.act(lambda item: one.bench(own, item, one.controller), items, seed, **self.options)
        for each in made:
            case = ", ".join([contender, *filter(None, [each.more.get("part")])])
            about = {"plant": plant, "contender": contender, "case": case}
            yield replace(each, more={**each.more, **about})

    def counted(self, trials: Frame) -> Frame:
        """The turns that count."""
        return select(trials, kind="turn").reset_index(drop=True)

    def report(self, seeds: Sequence[int], trials: Frame, folder: Path) -> Report:
        """Tables, picture and verdict of the trials with a grasp."""
        turns, grasped = self.counted(trials), select(trials)
        tables = [table(turns, self.by, self.columns, self.name, self.title)] if self.columns else []
        tables += [one for make in self.more if (one := make(grasped)).rows]
        if turns[self.split].nunique() > 1 and self.split != self.by:
            tables.append(ends_table(turns, self.by, self.split))
        drawn = ends_picture(turns, self.by, self.split) if self.picture is None else self.picture(turns)
        of = "Each group of turns." if self.picture is None else f"{self.title}."
        figure = save_figure(drawn, folder, self.name, of)
        # the tables have the others
        first = turns if self.told else turns[turns[self.by].isin(turns[self.by].head(1))]
        before = grasped[(grasped["kind"] != "turn") & grasped[self.by].isin(first[self.by])]
        lost = f" Of {len(before)} turns before these {int(before['lost'].sum())} lost the object."
        return Report(self.title, f"{self.answer(first)}.{lost if len(before) else ''}", tables, [figure])

    def answer(self, turns: Frame) -> str:
        """What came of each group."""
        return verdict(turns, self.by) if self.told is None else self.told(turns)


@dataclass(frozen=True)
class Measure:
    """A figure that tables can state of some trials."""

    of: Callable[[Frame], Cell]
    spec: str = ".2f"


def _reached(turns: Frame) -> Frame:
    return turns[~turns["lost"] & ~turns["not_reached"]]


def _mean(values: Any) -> float:
    return float(pandas.Series(values, dtype=float).mean())


def _median(values: Any) -> float:
    return float(pandas.Series(values, dtype=float).median())


def early(turns: Frame, which: str) -> list[float]:
    """One-step errors of the first motions of each hand with each object [deg].

    Args:
        which: "km" or "ekm".
    """
    found: list[float] = []
    for _, mine in turns.groupby(["plant", "contender", "object", "seed"]):
        every = itertools.chain.from_iterable(mine[f"true_prediction_{which}_deg"])
        found += itertools.islice(every, EARLY)
    return found


def other_ends(turns: Frame) -> str:
    """How those ended that did not reach the target, the most frequent first."""
    missed = turns[turns["lost"] | turns["not_reached"]]["reason"].value_counts()
    return ", ".join(f"{n} {reason}" for reason, n in missed.items())


#: What tables can say of some trials.
FIGURES: dict[str, Measure] = {
    "turns": Measure(len),
    "lost": Measure(lambda t: int(t["lost"].sum())),
    "reached": Measure(lambda t: len(_reached(t))),
    "motions": Measure(lambda t: _mean(_reached(t)["motions"]), ".1f"),
    "turning movements": Measure(lambda t: _mean(_reached(t)["turning"]), ".1f"),
    "seconds": Measure(lambda t: _mean(_reached(t)["simulated_s"]), ".1f"),
    "error [deg]": Measure(lambda t: _mean(t["error_deg"])),
    "off the axis, largest [deg]": Measure(lambda t: float(t["off_rotation_deg"][~t["lost"]].max()), ".1f"),
    "first motion [deg]": Measure(lambda t: _mean(t["first_step_deg"])),
    "KM, first 5 [deg]": Measure(lambda t: _mean(early(t, "km"))),
    "E-KM, first 5 [deg]": Measure(lambda t: _mean(early(t, "ekm"))),
    "predicted by the KM [deg]": Measure(lambda t: _mean(t["true_prediction_km"])),
    "by the E-KM [deg]": Measure(lambda t: _mean(t["true_prediction_ekm"])),
    "joints off by [deg]": Measure(lambda t: _mean(t["joints"])),
    "motors off by [deg]": Measure(lambda t: _mean(t["motors"])),
    "other ends": Measure(other_ends),
    "declined": Measure(lambda t: int((t["reason"] == "out of reach").sum())),
    "within": Measure(lambda t: int((t["size"] <= 1).sum())),
    "turn [deg]": Measure(lambda t: _median(t["wrong_deg"])),
    "shift [mm]": Measure(lambda t: _median(t["wrong_mm"])),
    "farthest [deg]": Measure(lambda t: _median(t["largest"]), ".1f"),
    "predicted end off by [deg]": Measure(lambda t: _median((t["reach"] - t["largest"]).abs()), ".1f"),
    "along the grip, last [mm]": Measure(lambda t: _mean(_last(t)["shift"])),
    "contacts slid, last [mm]": Measure(lambda t: _mean(_last(t)["slid"])),
}  # fmt: skip


def _last(turns: Frame) -> Frame:
    """The last return of each series."""
    back = turns[(turns["part"] == "series") & turns["back"].eq(True)]
    return back.groupby(["plant", "contender", "object", "seed"]).tail(1)


def table(turns: Frame, by: str, columns: Sequence[str], name: str, title: str) -> Table:
    """A row for each entry of a column."""
    items = {str(key): mine for key, mine in turns.groupby(by, sort=False)}
    cells = {Column(column, FIGURES[column].spec): FIGURES[column].of for column in columns}
    return Table.of(name, title, by, items, cells)


def ends_table(turns: Frame, by: str, split: str) -> Table:
    """Lost, reached, motions: a row for each entry of ``split``, a column for each of ``by``."""

    def cell(mine: Frame) -> str:
        motions = Column("", ".1f").text(_mean(_reached(mine)["motions"]))
        return f"{int(mine['lost'].sum())}, {len(_reached(mine))}, {motions}"

    return pivot(turns, by, split, cell, "lost, reached, and motions of those that reached the target")


def ends_picture(turns: Frame, by: str, split: str) -> Figure:
    """Turns lost and not reached, and motions, for each group."""
    names, groups = list(dict.fromkeys(turns[by])), list(dict.fromkeys(turns[split]))
    figure, (ends, motions) = new_figure(8.5, 0.28 * len(groups) + 1.4, 2, 1, sharey=True)
    known = [COLOURS[name] for name in names if name in COLOURS]
    free = itertools.cycle(colour for colour in _PALETTE if colour not in known)
    for k, name in enumerate(names):
        colour = COLOURS.get(name) or next(free)
        for i, group in enumerate(groups):
            mine = turns[(turns[by] == name) & (turns[split] == group)]
            at, n = i + 0.7 * ((k + 0.5) / len(names) - 0.5), max(len(mine), 1)
            lost, missed = (100 * mine[column].sum() / n for column in ("lost", "not_reached"))
            ends.barh(at, lost, 0.6 / len(names), color=colour)
            ends.barh(at, missed, 0.6 / len(names), left=lost, color=colour, alpha=0.35)
            label = name if i == 0 else None
            motions.plot(_mean(_reached(mine)["motions"]), at, "o", ms=4, color=colour, label=label)
    ends.set_yticks(range(len(groups)), [str(group).replace("_", " ") for group in groups], fontsize=8)
    ends.set_ylim(len(groups) - 0.4, -0.6)
    ends.set(xlabel="turns lost, pale: not reached [%]", xlim=(0, 100))
    motions.set(xlabel="motions of a turn that reached the target", xlim=(0, None))
    figure.legend(loc="outside upper center", ncols=4, frameon=False, fontsize=8)
    return figure


def points(x: str, y: str, xlabel: str, ylabel: str) -> Callable[[Frame], Figure]:
    """Draws one point a turn: an expression of columns against another, in the colour of its case."""

    def draw(turns: Frame) -> Figure:
        figure, (axes,) = new_figure(6.0, 3.2)
        at = turns.assign(_x=turns.eval(x), _y=turns.eval(y)).dropna(subset=["_x", "_y"])
        for colour, (name, mine) in zip(_PALETTE, at.groupby("case", sort=False), strict=False):
            axes.plot(mine["_x"], mine["_y"], "o", ms=3, color=colour, label=name)
        axes.set(xlabel=xlabel, ylabel=ylabel)
        axes.legend(frameon=False, fontsize=8)
        return figure

    return draw


def learning_picture(turns: Frame) -> Figure:
    """One-step error against the number of motions with an object, means over hands and objects."""
    figure, (axes,) = new_figure(6.0, 3.2)
    first = turns["contender"].iloc[0]
    curves = [("KM", first, "km"), *((name, name, "ekm") for name in dict.fromkeys(turns["contender"]))]
    for k, (label, name, which) in enumerate(curves):
        mine, column = turns[turns["contender"] == name], f"true_prediction_{which}_deg"
        groups = mine.groupby(["plant", "object", "seed"])[column]
        errors = [list(itertools.chain.from_iterable(one)) for _, one in groups]
        means = [_mean([one[j] for one in errors if len(one) > j]) for j in range(25)]
        colour = COLOURS["KM"] if label == "KM" else _PALETTE[(k - 1) % len(_PALETTE)]
        axes.plot(range(1, len(means) + 1), means, "o-", ms=3, color=colour, label=label)
    axes.set(xlabel="motion with a new object", ylabel="one-step error [deg]", ylim=(0, None))
    axes.legend(frameon=False, fontsize=8)
    return figure


def bands_table(turns: Frame) -> Table:
    """How often what was measured after a planned movement is in its stated 90 % interval."""

    def held(deviations: Any) -> Cell:
        found = [abs(z) < _INTERVAL for z in deviations]
        return f"{100 * np.mean(found):.0f} % of {len(found)}" if found else None

    items = {
        str(key): found
        for key, mine in turns.groupby("contender", sort=False)
        if (found := list(itertools.chain.from_iterable(mine["bands"])))
    }
    columns: dict[Column, Callable[[list[Any]], Cell]] = {
        Column("movements"): len,
        Column("about the axis"): lambda found: held(band[1] for band in found),
        Column("off the axis"): lambda found: held(band[2] for band in found),
        Column("normal forces"): lambda found: held(z for band in found for z in band[3]),
    }
    note = "Share of what was measured after a planned movement that is in its stated 90 % interval."
    return Table.of("bands", "Bands of the plans", "contender", items, columns, note)


def verdict(turns: Frame, by: str) -> str:
    """The last line: what came of each group."""

    def told(mine: Frame) -> str:
        names = ("lost", "reached", "turning movements", "motions", "seconds")
        lost, reached, *means = (FIGURES[name].of(mine) for name in names)
        turning, motions, seconds = (Column("", ".1f").text(one) for one in means)
        counts = f"lost {lost} of {len(mine)}, reached {reached}, turning movements {turning}"
        return f"{counts}, all motions {motions}, seconds {seconds}"

    return "; ".join(f"{name} {told(mine)}" for name, mine in turns.groupby(by, sort=False))


def _split(names: str, known: Mapping[str, Any]) -> list[str]:
    """Names separated by semicolons, or by commas where none of them has any."""
    return [names] if names in known else names.split(";" if ";" in names else ",")


def ask(asked: Question, arguments: Sequence[str] | None = None) -> Report:
    """Run a question as the command line says, and print its report; the last line is the verdict."""
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=raw)
    parser.add_argument("--objects", help=f"names or paths; {','.join(asked.objects)} if left out")
    parser.add_argument("--seeds", type=parse_seeds, default=parse_seeds("1000:1010"), help="FIRST:END")
    parser.add_argument("--hands", help="see hands.py; also all, strong, losing, conditions")
    parser.add_argument("--contenders", help=f"some of {'; '.join(asked.contenders)}")
    parser.add_argument("--engine", default=asked.setting.engine, choices=ENGINES)
    parser.add_argument("--jobs", type=int, default=2, help="processes at once")
    parser.add_argument("--out", type=Path, default=Path(f"{asked.name}_output"), help="keeps what is done")
    parser.add_argument("--quick", action="store_true", help="one hand, object and seed, two contenders")
    given = parser.parse_args(arguments)
    known = asked.contenders
    names = _split(given.contenders, known) if given.contenders else list(known)
    if unknown := set(names) - set(known):
        parser.error(f"no contender {', '.join(sorted(unknown))}; there are {'; '.join(known)}")
    asked = replace(
        asked,
        contenders={name: known[name] for name in names},
        hands=_split(given.hands, CONDITIONS) if given.hands else asked.hands,
        objects=given.objects.split(",") if given.objects else asked.objects,
        setting=asked.setting.replace(engine=given.engine),
    )
    planned = Experiment(asked, given.seeds)
    if given.quick:
        planned = Experiment(asked.quick(), given.seeds[:1], quick=True)
    with progress("running", len(planned.jobs)) as advance:
        trials = run_trials(planned, given.out, given.jobs, advance)
    made = write_report(planned, trials, given.out)
    print_report(made, given.out, every=True)
    print(asked.answer(asked.counted(trials)))
    return made


def main(arguments: Sequence[str] | None = None) -> None:
    from questions import QUESTIONS

    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, add_help=False
    )
    parser.add_argument("question", nargs="?", choices=QUESTIONS)
    parser.add_argument("--list", action="store_true", help="the questions")
    given, rest = parser.parse_known_args(arguments)
    if given.list or given.question is None:
        print(*(f"{name:16} {asked.title}" for name, asked in QUESTIONS.items()), sep="\n")
        return
    ask(QUESTIONS[given.question], rest)


if __name__ == "__main__":
    main()
