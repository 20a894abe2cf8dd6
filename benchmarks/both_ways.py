"""How far one grasp turns an object in all: forth to the end that is foreseen as safe, then back to another.

    python benchmarks/both_ways.py --objects can,box --seeds 1000:1010 --out FOLDER

With every object and hand an E-KM has three turns of warm-up. Then the model is asked how far a new grasp
turns forth, the hand goes there, and the same back, from where the first turn ended. Poses are true plus
noise. Finished sessions stay in ``--out``: an interrupted run goes on where it stopped.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from any_hand import count_of
from command_line import study_parser

from torch_ekm._terminal import progress
from torch_ekm.exceptions import GraspError
from torch_ekm.experiments.config import Setting, digest
from torch_ekm.experiments.jobs import run_jobs
from torch_ekm.experiments.records import Trial, true_state
from torch_ekm.experiments.reporting.plots import COLOURS, new_figure, save_figure
from torch_ekm.experiments.reporting.report import Cell, Column, Report, Table
from torch_ekm.experiments.runner import Bench

if TYPE_CHECKING:
    from matplotlib.figure import Figure

GOAL = 60.0  # [deg] in all
WARM_UP = (15.0, -9.0, 15.0)  # [deg]
ORDER = (1, -1)  # signs of the turns: a box that was turned forth turns farther back
_FIRST_WARM_UP, _GRASP = 1000, 3000  # numbers of the grasps
_DEG = math.pi / 180


@dataclass(frozen=True)
class Way:
    """A turn to the end that is foreseen as safe; angles from where the grasp began [deg]."""

    object: str
    seed: int
    sign: int
    foreseen: float
    """Where the model says that the grasp's turn ends."""
    ends_by: str
    asked: float
    """The safe end."""
    reached: float
    """True, where the turn ended; of a lost object where it was last held."""
    reason: str
    lost: bool
    motions: int


def session(setting: Setting, item: str, seed: int, limit: float) -> list[dict[str, Any]]:
    """Warm-up, then one grasp back and forth; up to ``limit`` [deg]."""
    bench, ways = Bench(setting.hardware_instance(seed), item, "E-KM"), []
    for k, angle in enumerate(WARM_UP):
        bench.trial(seed, _FIRST_WARM_UP + k, angle, "warm-up")
    start = bench.grasp(seed, _GRASP)
    if start is not None:
        begun, axis = true_state(bench.hand.observe()), bench.hand.rotation_axis
        for sign in ORDER:
            here = float(axis @ bench.plant.observe().state.minus(start)[-3:]) / _DEG
            try:
                loop, farthest = bench.closed_loop(bench.plant), (limit - sign * here) * _DEG
                reach = loop.reach(sign=sign, limit=farthest)
            except GraspError:  # the model refuses the grasp
                break
            asked = here + reach.safe / _DEG
            done = bench.turn(Trial(bench.name, "both ways", "E-KM", seed, _GRASP, asked), start)
            assert bench.last is not None
            seen = [*(step.before for step in bench.last.steps), bench.last.stop.final]
            held = seen[-2] if done.lost and len(seen) > 1 else seen[-1]
            end = float(axis @ true_state(held).minus(begun)[-3:]) / _DEG
            foreseen = here + reach.angle / _DEG
            foretold = foreseen, reach.ends_by, asked
            way = Way(bench.name, seed, sign, *foretold, end, done.reason, done.lost, done.steps)
            ways.append(asdict(way))
            if done.lost:
                break
    bench.close()
    return ways


class Ranges:
    """What came of all grasps."""

    def __init__(self, ways: Sequence[Way]) -> None:
        self.ways = ways
        self.objects = list(dict.fromkeys(way.object for way in ways))

    def grasps(self, item: str | None = None) -> list[list[Way]]:
        """The ways of each grasp."""
        by: dict[tuple[str, int], list[Way]] = {}
        for way in self.ways:
            if item in (None, way.object):
                by.setdefault((way.object, way.seed), []).append(way)
        return list(by.values())

    @staticmethod
    def range(grasp: Sequence[Way]) -> float:
        """Between the ends that were reached with the object held [deg]."""
        ends = [0.0, *(way.reached for way in grasp)]
        return max(ends) - min(ends)

    @property
    def verdict(self) -> str:
        """The last line."""
        grasps = self.grasps()
        far = sum(self.range(one) >= GOAL and not any(way.lost for way in one) for one in grasps)
        lost = sum(way.lost for way in self.ways)
        middle = float(np.median([self.range(one) for one in grasps])) if grasps else math.nan
        return f"{middle:.0f} deg in all (median); {GOAL:g} deg in {far} of {len(grasps)} grasps; lost {lost}"

    def table(self) -> Table:
        """A row for each object."""
        rows: list[list[Cell]] = []
        for item in [*self.objects, *([None] if len(self.objects) > 1 else [])]:
            grasps = self.grasps(item)
            ways = [way for grasp in grasps for way in grasp]
            ranges = [self.range(one) for one in grasps]
            back, forth = (
                float(np.median([way.reached for way in ways if way.sign == sign] or [np.nan]))
                for sign in (-1, 1)
            )
            rows.append(
                [
                    item or "all", len(grasps), sum(way.lost for way in ways), back, forth,
                    f"{np.median(ranges):.0f} ({min(ranges):.0f} to {max(ranges):.0f})",
                    sum(angle >= GOAL for angle in ranges),
                    count_of(way.reason for way in ways if way.reason != "reached"),
                ]
            )  # fmt: skip
        columns: list[str | Column] = [
            "object", "grasps", "lost", Column("back [deg]", ".0f"), Column("forth [deg]", ".0f"),
            "in all [deg]", f"at least {GOAL:g} deg", "ends before the target",
        ]  # fmt: skip
        note = (
            "Medians over grasps of the true angles, from where the grasp began; in all: between both ends,"
            " with the least and the most. Targets are the ends that the model calls safe."
        )
        return Table("ranges", "One grasp, both ways", columns, rows, note)

    def picture(self) -> Figure:
        """A bar for each grasp, from end to end, with the ends that were foreseen."""
        grasps = sorted(self.grasps(), key=lambda one: (self.objects.index(one[0].object), self.range(one)))
        figure, (axes,) = new_figure(6.5, 0.8 + 0.17 * len(grasps))
        colours = (COLOURS["E-KM"], COLOURS["KM+I"], COLOURS["KM+S"], COLOURS["limit"])
        for k, grasp in enumerate(grasps):
            ends = [0.0, *(way.reached for way in grasp)]
            colour = colours[self.objects.index(grasp[0].object) % len(colours)]
            axes.barh(k, max(ends) - min(ends), left=min(ends), color=colour, height=0.7)
            axes.plot([way.foreseen for way in grasp], [k] * len(grasp), "|", color="black", ms=6)
        names = [grasp[0].object.replace("_", " ") for grasp in grasps]
        first = {name: names.index(name) for name in dict.fromkeys(names)}
        axes.set_yticks([at + (names.count(name) - 1) / 2 for name, at in first.items()], list(first))
        axes.axvline(0.0, color="0.4", linewidth=0.8)
        axes.set_xlabel("rotation from where the grasp began [deg]")
        return figure


def main(arguments: Sequence[str] | None = None) -> None:
    parser = study_parser(
        __doc__, "both_ways", objects="can,box", seeds="1000:1010", engine="sapien",
        quick="one object, one seed, 5 deg either way",
    )  # fmt: skip
    given = parser.parse_args(arguments)
    objects, seeds, limit = given.objects.split(","), given.seeds, 90.0
    if given.quick:
        objects, seeds, limit = objects[:1], seeds[:1], 5.0
    setting = Setting(engine=given.engine)
    figures = WARM_UP, ORDER, limit
    todo = {
        f"{Path(item).stem}_{digest(setting, (item,), *figures)}_{seed}": (setting, item, seed, limit)
        for seed in seeds
        for item in objects
    }
    with progress("running", len(todo)) as advance:
        results = run_jobs(session, todo, given.out, given.jobs, advance)
    ranges = Ranges([Way(**way) for ways in results.values() for way in ways])
    caption = "From end to end, a bar for each grasp; marks: the predicted ends."
    shown = save_figure(ranges.picture(), given.out, "both_ways", caption)
    report = Report("One grasp, both ways", f"{ranges.verdict}.", [ranges.table()], [shown])
    report.write(given.out)
    print(report.markdown())
    print(ranges.verdict)


if __name__ == "__main__":
    main()
