"""A hand that has learned its figures with one object, and objects that it has never held.

    python benchmarks/new_object.py --first box --then can,bottle,jar --seeds 1000:1010

The hand makes thirty motions with the first object. Then it turns each of the others by 9, 19 and 27 deg,
without any warm-up on it. Poses come from camera images, joint angles from Hall counts. ``--preset`` takes
the presets, the families of any_hand.py as FAMILY:STRENGTH, and "strong" for all of them; several give a row
each. Finished sessions stay in ``--out``: an interrupted run goes on where it stopped.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from any_hand import Turns, plants, records_by

from torch_ekm._terminal import progress
from torch_ekm.cli._app import parse_seeds
from torch_ekm.experiments.config import Setting, digest, object_name
from torch_ekm.experiments.jobs import run_jobs
from torch_ekm.experiments.records import TrialRecord
from torch_ekm.experiments.reporting.plots import COLOURS, new_figure, save_figure
from torch_ekm.experiments.reporting.report import Cell, Column, Report, Table
from torch_ekm.experiments.reporting.statistics import Estimate, bootstrap_ratio
from torch_ekm.experiments.runner import Bench
from torch_ekm.simulation import ENGINES

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ANGLES = (9.0, 19.0, 27.0)
EARLY = 5  # motions with a new object
_SHOWN = 25  # of the picture
#: What an E-KM begins a new object with.
CONTENDERS: dict[str, dict[str, Any]] = {
    "empty": {"adapts": False},
    "learned hand": {},
    "learned hand, f alone": {"learner": "model alone"},
}
_COLOURS = {
    "KM": COLOURS["KM"], "empty": "#56B4E9", "learned hand": COLOURS["E-KM"],
    "learned hand, f alone": "#CC79A7",
}  # fmt: skip


def session(setting: Setting, first: str, then: Sequence[str], seed: int) -> list[dict[str, Any]]:
    """Turns of the first object, kind "first", then those of the others."""
    setting = setting.hardware_instance(seed)
    records, knowledge = [], None
    for item in (first, *then):
        bench = Bench(setting, item, "E-KM")
        bench.knowledge = knowledge = bench.knowledge if knowledge is None else knowledge
        if item == first and not records:
            records += bench.learn_hand(seed)
        else:
            records += [bench.trial(seed, k, angle) for k, angle in enumerate(ANGLES)]
        bench.close()
    return [one.to_json() for one in records]


class Comparison:
    """Turns of all sessions, by contender, seed and object in the order in which they were made."""

    def __init__(self, results: Mapping[tuple[str, Any], list[TrialRecord]]) -> None:
        self.results = results
        self.contenders = list(dict.fromkeys(name for name, _ in results))
        self.objects = list(dict.fromkeys(one.object for records in results.values() for one in records))

    def turns(self, contender: str, item: str | None = None, kind: str = "turn") -> Turns:
        """Turns of one object, or of all new ones."""
        return Turns(
            tuple(
                one
                for (name, _), records in self.results.items()
                for one in records
                if name == contender and one.kind == kind and item in (None, one.object)
            )
        )

    def errors(
        self, contender: str, which: str, item: str | None = None, kind: str = "turn"
    ) -> list[list[float]]:
        """One-step errors [deg] in the order of motions, for each seed and object.

        Args:
            which: "km" or "ekm".
        """
        found: dict[tuple[Any, str], list[float]] = defaultdict(list)
        for (name, seed), records in self.results.items():
            for one in records:
                if name == contender and one.kind == kind and item in (None, one.object):
                    found[seed, one.object] += getattr(one, f"true_prediction_{which}_deg")
        return list(found.values())

    def early(self, contender: str, which: str, item: str | None = None, kind: str = "turn") -> float:
        """Mean one-step error of the first motions with an object [deg]."""
        return _mean(
            [error for errors in self.errors(contender, which, item, kind) for error in errors[:EARLY]]
        )

    def later(self, contender: str, which: str, item: str | None = None) -> float:
        """Of the others."""
        return _mean([error for errors in self.errors(contender, which, item) for error in errors[EARLY:]])

    def first_motion(self, contender: str, which: str, item: str | None = None) -> float:
        """Of the first motion of each turn."""
        name = f"true_prediction_{which}_deg"
        firsts = (getattr(one, name) for one in self.turns(contender, item).records)
        return _mean([errors[0] for errors in firsts if errors])

    @property
    def verdict(self) -> str:
        """The last line."""
        ours, best = self.turns("learned hand"), "learned hand"
        return (
            f"first five motions KM {self.early(best, 'km'):.2f}, empty {self.early('empty', 'ekm'):.2f},"
            f" learned hand {self.early(best, 'ekm'):.2f} deg;"
            f" first motion {self.first_motion(best, 'ekm'):.2f} deg; lost {ours.lost} of {len(ours.records)}"
        )

    @property
    def ratio(self) -> Estimate:
        """One-step error with the learned hand over that with nothing, all motions of all new objects; pairs
        are a seed's."""
        both = [
            {seed: _mean([e for one in records if one.kind == "turn" for e in one.true_prediction_ekm_deg])
             for (name, seed), records in self.results.items() if name == contender}
            for contender in ("learned hand", "empty")
        ]  # fmt: skip
        seeds = sorted(both[0].keys() & both[1].keys())
        return bootstrap_ratio(*(np.array([means[seed] for seed in seeds]) for means in both))

    @property
    def cost(self) -> float:
        """Median time of a decision and of learning from its motion, over that with nothing learned."""
        ours, theirs = (
            np.median([t for one in self.turns(name).records for t in one.seconds])
            for name in ("learned hand", "empty")
        )
        return float(ours / theirs)

    def tables(self) -> list[Table]:
        """A row for each contender, then one for each object and contender."""
        _, *others = self.objects
        names = ("all_objects", "All new objects"), ("objects", "Each object")
        chosen: tuple[list[str | None], ...] = ([None], [*others])
        return [self._table(*texts, items) for texts, items in zip(names, chosen, strict=True)]

    def _table(self, key: str, caption: str, items: Sequence[str | None]) -> Table:
        rows: list[list[Cell]] = []
        first = self.objects[0]
        for item in items:
            for name in self.contenders:
                turns = self.turns(name, item)
                first_km, first_ekm = (self.first_motion(name, which, item) for which in ("km", "ekm"))
                rows.append(
                    [
                        "all" if item is None else item.replace("_", " "), name,
                        self.early(name, "km", item), self.early(name, "ekm", item),
                        self.later(name, "ekm", item),
                        f"{first_ekm:.2f} ({100 * first_ekm / first_km:.0f} %)",
                        f"{turns.lost}, {turns.reached} of {len(turns.records)}", turns.motions,
                    ]
                )  # fmt: skip
        columns = [
            "object", "begins with", Column("KM, first 5 [deg]", ".2f"),
            Column("E-KM, first 5 [deg]", ".2f"), Column("later [deg]", ".2f"),
            "first of a turn [deg] (of KM's)", "lost, reached", Column("motions", ".1f"),
        ]  # fmt: skip
        before = ", ".join(
            f"{name} {self.early(name, 'ekm', first, 'first'):.2f}" for name in self.contenders
        )
        note = (
            "One-step errors of the rotation about the axis against what really happened, predicted before"
            " the model learns from the motion; motions of turns that reached the target. First five motions"
            f" of the first object ({first}): KM {self.early(self.contenders[0], 'km', first, 'first'):.2f},"
            f" {before} deg. All motions: learned hand over empty {self.ratio:.2f}."
        )
        return Table(key, caption, columns, rows, note)

    def picture(self) -> Figure:
        """One-step error against the number of motions with a new object."""
        figure, (axes,) = new_figure(6.0, 3.2)
        curves = [("KM", "learned hand", "km"), *((name, name, "ekm") for name in self.contenders)]
        for label, name, which in curves:
            errors = self.errors(name, which)
            means = [_mean([one[k] for one in errors if len(one) > k]) for k in range(_SHOWN)]
            axes.plot(range(1, _SHOWN + 1), means, "o-", ms=3, color=_COLOURS[label], label=label)
        axes.set_xlabel("motion with a new object")
        axes.set_ylabel("one-step error [deg]")
        axes.set_ylim(0, None)
        axes.legend(frameon=False, fontsize=8)
        return figure

    def report(self, folder: Path, hands: Mapping[str, Comparison] | None = None) -> Report:
        """Tables, picture and verdict, in ``folder``; of several hands each of them, too."""
        tables, picture, name = self.tables(), self.picture(), "new_object"
        caption = "Mean one-step error about the axis, all new objects and seeds."
        if hands and len(hands) > 1:
            tables, picture, name = (
                [tables[0], hands_table(hands), *tables[1:]],
                hands_picture(hands),
                "hands",
            )
            caption = "First five motions of new objects, hand by hand."
        shown = save_figure(picture, folder, name, caption)
        report = Report("Objects that are new to the hand", f"{self.verdict}.", tables, [shown])
        report.write(folder)
        return report


def hands_table(found: Mapping[str, Comparison]) -> Table:
    """A row for each hand."""
    rows: list[list[Cell]] = []
    for name, one in found.items():
        empty, ours = (one.turns(contender) for contender in ("empty", "learned hand"))
        rows.append(
            [
                name, one.early("learned hand", "km"), one.early("empty", "ekm"),
                one.early("learned hand", "ekm"), f"{one.ratio:.2f}", f"{empty.lost}, {ours.lost}",
                f"{empty.reached}, {ours.reached} of {len(ours.records)}",
                f"{empty.motions:.1f}, {ours.motions:.1f}",
            ]
        )  # fmt: skip
    columns = [
        "hand", Column("KM, first 5 [deg]", ".2f"), Column("empty, first 5 [deg]", ".2f"),
        Column("learned hand, first 5 [deg]", ".2f"), "learned over empty, all motions", "lost", "reached",
        "motions",
    ]  # fmt: skip
    cost = float(np.median([one.cost for one in found.values() if one.turns("empty").motions > 0]))
    note = (
        "Pairs of figures: empty, learned hand. Ratios with 95 % bootstrap intervals over seeds. A decision"
        f" with learning takes {cost:.2f} times the time of empty (median of the hands)."
    )
    return Table("hands", "New objects, hand by hand", columns, rows, note)


def hands_picture(found: Mapping[str, Comparison]) -> Figure:
    """First five motions of each hand."""
    figure, (axes,) = new_figure(6.0, 0.6 + 0.24 * len(found))
    at = np.arange(len(found))[::-1]
    for label, contender, which in (
        ("KM", "learned hand", "km"), ("empty", "empty", "ekm"), ("learned hand", "learned hand", "ekm")
    ):  # fmt: skip
        values = [one.early(contender, which) for one in found.values()]
        axes.plot(values, at, "o", ms=4, color=_COLOURS[label], label=label)
    axes.set_yticks(at, list(found))
    axes.set_xlabel("one-step error, first five motions [deg]")
    axes.set_xlim(0, None)
    axes.legend(frameon=False, fontsize=8)
    return figure


def _mean(values: Sequence[float]) -> float:
    return float(np.mean(values)) if len(values) else float("nan")


def main() -> None:
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=raw)
    parser.add_argument("--first", default="box", help="name or path of the object that the hand learns with")
    parser.add_argument("--then", default="can,bottle,jar", help="names or paths")
    parser.add_argument("--seeds", type=parse_seeds, default=parse_seeds("1000:1010"), help="FIRST:END")
    parser.add_argument("--preset", default="nominal", help="hands, see above; several give a row each")
    parser.add_argument("--engine", default="sapien", choices=ENGINES)
    parser.add_argument("--jobs", type=int, default=2, help="processes at once")
    parser.add_argument("--out", type=Path, default=Path("new_object_output"), help="keeps what is finished")
    parser.add_argument("--quick", action="store_true", help="one new object, one seed, no camera")
    given = parser.parse_args()
    then, seeds = given.then.split(","), given.seeds
    if given.quick:
        then, seeds = then[:1], seeds[:1]
    hands = plants(given.preset.split(","))
    todo, where = {}, {}
    contenders = list(CONTENDERS.items())[: 3 if len(hands) == 1 else 2]
    for hand, plant in hands.items():
        for seed in seeds:
            for name, changes in contenders:  # side by side: their times are compared
                setting = Setting(plant=plant, engine=given.engine, sensing=not given.quick, **changes)
                key = f"{object_name(given.first)}_{digest(setting, (given.first, *then), ANGLES)}_{seed}"
                todo[key] = setting, given.first, then, seed
                where[key] = name, (" ".join(hand).strip(), seed)
    with progress("running", len(todo)) as advance:
        results = run_jobs(session, todo, given.out, given.jobs, advance)
    found = records_by(where, results)
    together = Comparison(found)
    by_hand = {
        hand: Comparison({key: records for key, records in found.items() if key[1][0] == hand})
        for hand in dict.fromkeys(hand for _, (hand, _) in found)
    }
    print(together.report(given.out, by_hand).markdown())
    print(together.verdict)


if __name__ == "__main__":
    main()
