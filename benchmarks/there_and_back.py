"""Turns one after the other without a new grasp: there and back, and from target to target.

    python benchmarks/there_and_back.py --objects box,can --seeds 1000:1010 --engine mujoco --out FOLDER

With every object and hand an E-KM has three turns of warm-up. Then it turns one grasp to +15 deg and back to
0, twenty times, and another one to ten random targets within 15 deg of where it began, each from where the
last ended. The first series is made twice: what asks for the turn alone, and what also asks, on the way back,
that the object come back along the grip. Turns of the same sizes from fresh grasps stand beside them. Drift:
how far the object has moved since the grasp, each time that it is back. Poses are true plus noise. Finished
sessions stay in ``--out``: an interrupted run goes on where it stopped.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from any_hand import count_of
from command_line import study_parser
from focused_pose import axes_of

from torch_ekm._terminal import progress
from torch_ekm.control import Direction, FocusedPose
from torch_ekm.exceptions import EKMError
from torch_ekm.experiments.config import Setting, digest
from torch_ekm.experiments.jobs import run_jobs
from torch_ekm.experiments.records import Trial, TrialRecord, true_state
from torch_ekm.experiments.reporting.plots import COLOURS, new_figure, save_figure
from torch_ekm.experiments.reporting.report import Cell, Column, Report, Table
from torch_ekm.experiments.runner import Bench
from torch_ekm.kinematics import GraspState
from torch_ekm.simulation import preset

if TYPE_CHECKING:
    from matplotlib.figure import Figure

THERE = 15.0  # [deg]
TIMES = 20
TARGETS = 10  # of a random sequence
LEAST = 4.0  # [deg] of a random turn
FRESH = 5  # grasps for each sign of a turn of THERE
WARM_UP = (9.0, -9.0, 15.0)  # [deg]
_FIRST_WARM_UP = 1000  # number of the first training grasp: never one that is tested
WITHIN = 0.4  # [mm] along the grip, where that is asked for
BACK, UNDONE, RANDOM = "there and back", "there and back, shift undone", "random targets"
#: Series -> the turns of the same sizes from fresh grasps.
BESIDE = {BACK: "fresh, 15 deg", UNDONE: "fresh, 15 deg", RANDOM: "fresh, random"}


@dataclass(frozen=True)
class Turn:
    """One turn, and what came of it."""

    part: str
    object: str
    seed: int
    number: int
    """In its part, from 0."""
    size: float
    """From where it began to the target [deg]."""
    reason: str
    """Why the loop ended."""
    lost: bool
    reached: bool
    motions: int
    error: float
    """True, at the end [deg]."""
    shift: tuple[float, float, float]
    """Of the object since the grasp: along the axis, along the grip, across both [mm]."""
    slid: float = 0.0
    """Of the contacts on the object since the grasp, mean [mm]; 0 of a lost object."""

    @property
    def returned(self) -> bool:
        """It ends where the series began."""
        return self.part in (BACK, UNDONE) and self.size < 0


def random_sizes(seed: int) -> list[float]:
    """Turns of at least LEAST deg, from one target within THERE deg of the start to the next [deg]."""
    generator, at, sizes = np.random.default_rng([seed, 15]), 0.0, []
    while len(sizes) < TARGETS:
        size = float(generator.uniform(-THERE, THERE)) - at
        if LEAST <= abs(size) <= THERE:
            sizes.append(round(size, 1))
            at += sizes[-1]
    return sizes


def sizes_of(part: str, seed: int) -> list[float]:
    """The turns of a part [deg]."""
    if part in (BACK, UNDONE):
        return [THERE, -THERE] * TIMES
    return [THERE, -THERE] * FRESH if part == BESIDE[BACK] else random_sizes(seed)


def session(
    setting: Setting, item: str, part: str, sizes: Sequence[float], seed: int
) -> list[dict[str, Any]]:
    """Warm-up, then the turns of a part: a series has one grasp, and ends where the object is lost."""
    bench, turns = Bench(setting.hardware_instance(seed), item, "E-KM"), []
    for k, angle in enumerate(WARM_UP):
        bench.trial(seed, _FIRST_WARM_UP + k, angle, "warm-up")
    start, at, before = None, 0.0, None
    for k, size in enumerate(sizes):
        if start is None or part not in BESIDE:
            start, at = bench.grasp(seed, k), 0.0
            if start is None:
                continue
            before = bench.hand.observe()
        at += size
        focus = _with_place(bench) if part == UNDONE and size < 0 else None
        done = bench.turn(Trial(bench.name, part, "E-KM", seed, k, at), start, focus=focus)
        assert bench.last is not None
        assert before is not None
        states = true_state(before), true_state(bench.last.stop.final)
        turns.append(asdict(_turn(done, size, _shift(bench, *states), _slid(bench, *states))))
        if done.lost and part in BESIDE:
            break
    bench.close()
    return turns


def _with_place(bench: Bench) -> FocusedPose:
    """The turn, and where the object is along the grip."""
    axes = axes_of(bench)
    return FocusedPose([Direction(axes["a"], "deg"), Direction(axes["b"], "mm", tolerance=WITHIN)])


def _shift(bench: Bench, before: GraspState, after: GraspState) -> tuple[float, float, float]:
    moved, axes = after.position - before.position, axes_of(bench)
    a, b, c = (1e3 * float(axes[name] @ moved) for name in "abc")
    return a, b, c


def _slid(bench: Bench, before: GraspState, after: GraspState) -> float:
    """How far the contacts have moved on the object, mean of the pads that touch it both times [mm]."""
    places = []
    for state in (before, after):
        try:
            found = bench.model.contacts(state)
        except EKMError:  # no finger holds it
            return 0.0
        places.append(dict(zip(found.finger, (found.point - state.position) @ state.rotation, strict=True)))
    moved = [float((places[1][pad] - place).norm()) for pad, place in places[0].items() if pad in places[1]]
    return 1e3 * float(np.mean(moved)) if moved else 0.0


def _turn(done: TrialRecord, size: float, shift: tuple[float, float, float], slid: float) -> Turn:
    reached = not (done.lost or done.not_reached)
    about = done.kind, done.object, done.seed, done.trial, size
    slid = 0.0 if done.lost else slid
    return Turn(*about, done.reason, done.lost, reached, done.steps, done.true_error_deg, shift, slid)


class Outcome:
    """What came of all turns."""

    def __init__(self, turns: Sequence[Turn]) -> None:
        self.turns = turns
        self.objects = list(dict.fromkeys(turn.object for turn in turns))

    def of(self, part: str, item: str | None = None, sign: int = 0) -> list[Turn]:
        """Those of a part, an object and a direction, or of all."""
        return [
            turn
            for turn in self.turns
            if turn.part == part and item in (None, turn.object) and (sign == 0 or sign * turn.size > 0)
        ]

    def ratio(self, part: str) -> float | None:
        """Motions of a series over those of turns of the same sizes from fresh grasps, means over objects and
        directions."""
        pairs = [
            [_motions(self.of(one, item, sign)) for one in (part, BESIDE[part])]
            for item in self.objects
            for sign in (1, -1)
        ]
        known = [(mine, fresh) for mine, fresh in pairs if mine is not None and fresh is not None]
        return sum(mine for mine, _ in known) / sum(fresh for _, fresh in known) if known else None

    def drift(self, part: str, item: str | None = None) -> dict[int, np.ndarray]:
        """Return of a series, from 1 -> shift of the object along axis, grip, across both, and of its
        contacts [mm]; a row for each series."""
        back = [turn for turn in self.of(part, item) if turn.returned and not turn.lost]
        returns = sorted({turn.number for turn in back})
        return {
            (number + 1) // 2: np.array([(*turn.shift, turn.slid) for turn in back if turn.number == number])
            for number in returns
        }

    @property
    def verdict(self) -> str:
        """The last line."""
        series = [turn for part in BESIDE for turn in self.of(part)]
        ratios = [ratio for part in BESIDE if (ratio := self.ratio(part)) is not None]
        moved = [
            float(np.abs(drift[max(drift)][:, 1]).mean())
            for part in (BACK, UNDONE)
            if (drift := self.drift(part))
        ]
        return (
            f"lost {sum(turn.lost for turn in series)} of {len(series)}; motions {np.mean(ratios):.2f} times"
            f" those of fresh grasps; drift at the end {' mm, undone '.join(f'{mm:.1f}' for mm in moved)} mm"
        )

    def table(self) -> Table:
        """A row for each part and direction."""
        rows: list[list[Cell]] = []
        for part in dict.fromkeys((*BESIDE, *BESIDE.values())):
            for sign in (1, -1):
                if turns := self.of(part, sign=sign):
                    counts = len(turns), sum(turn.lost for turn in turns), sum(turn.reached for turn in turns)
                    error = float(np.mean([turn.error for turn in turns if not turn.lost] or [np.nan]))
                    ends = count_of(turn.reason for turn in turns if not turn.reached)
                    rows.append(
                        [f"{part}, {'+' if sign > 0 else '-'}", *counts, _motions(turns), error, ends]
                    )
        columns: list[str | Column] = [
            "turns", "made", "lost", "reached", Column("motions", ".1f"), "error [deg]", "other ends",
        ]  # fmt: skip
        ratios = [f"{part} {ratio:.2f}" for part in BESIDE if (ratio := self.ratio(part)) is not None]
        note = (
            "Mean motions of turns that reached the target, and true errors of objects that were not lost."
            f" Motions over those of fresh grasps, means over objects and directions: {', '.join(ratios)}."
        )
        return Table("turns", "Turns without a new grasp, and from fresh ones", columns, rows, note)

    def drift_table(self) -> Table:
        """Where each object is after some returns."""
        rows: list[list[Cell]] = []
        for part, item in product((BACK, UNDONE), self.objects):
            drift = self.drift(part, item)
            for number in (n for n in (1, TIMES) if n in drift):
                grip, rest = drift[number][:, 1], np.abs(drift[number][:, [0, 2, 3]]).mean(axis=0)
                largest = grip[np.abs(grip).argmax()]
                rows.append(
                    [f"{item}, {part}", number, len(grip), *map(float, (grip.mean(), largest, *rest))]
                )
        columns: list[str | Column] = [
            "object", "return", "series", "along the grip [mm]", "the largest [mm]", "along the axis [mm]",
            "across both [mm]", "contacts [mm]",
        ]  # fmt: skip
        note = (
            "Means over series; along the grip: signed, from the thumb to the fingers; the others: absolute."
        )
        return Table("drift", "Where the object is when it is back", columns, rows, note)

    def picture(self) -> Figure:
        """Drift along the grip, and motions, over the turns of each series."""
        figure, (drift, motions) = new_figure(8.5, 3.4, 2)
        colours = (COLOURS["E-KM"], COLOURS["KM+I"], COLOURS["KM+S"], COLOURS["limit"])
        for k, item in enumerate(self.objects):
            colour, label = colours[k % len(colours)], item.replace("_", " ")
            for seed in dict.fromkeys(turn.seed for turn in self.turns):
                for part, style in ((BACK, "-"), (UNDONE, ":")):
                    back = [t for t in self.of(part, item) if t.returned and not t.lost and t.seed == seed]
                    line = [0.0, *(turn.shift[1] for turn in back)]
                    at = [0, *((t.number + 1) // 2 for t in back)]
                    drift.plot(at, line, style, color=colour, label=label)
                    label = None
            by: dict[int, list[Turn]] = {}
            for turn in self.of(BACK, item):
                by.setdefault(turn.number + 1, []).append(turn)
            means = [(n, m) for n, turns in by.items() if (m := _motions(turns)) is not None]
            motions.plot(*zip(*means, strict=True), "o-", ms=3, color=colour, label=item.replace("_", " "))
            if (fresh := _motions(self.of(BESIDE[BACK], item))) is not None:
                motions.axhline(fresh, color=colour, linestyle="--", linewidth=1)
        drift.set(xlabel="return (dotted: shift undone)", ylabel="along the grip [mm]")
        motions.set(xlabel="turn of the series (dashed: fresh grasps)", ylabel="motions", ylim=(0, None))
        drift.legend(frameon=False)
        return figure


def _motions(turns: Iterable[Turn]) -> float | None:
    """Mean of those that reached the target."""
    motions = [turn.motions for turn in turns if turn.reached]
    return float(np.mean(motions)) if motions else None


def main(arguments: Sequence[str] | None = None) -> None:
    parser = study_parser(
        __doc__, "there_and_back", objects="box,can", seeds="1000:1010", engine="mujoco",
        quick="one object, one seed, two turns of each",
    )  # fmt: skip
    parser.add_argument("--preset", default="nominal")
    given = parser.parse_args(arguments)
    objects, seeds, most = given.objects.split(","), given.seeds, None
    if given.quick:
        objects, seeds, most = objects[:1], seeds[:1], 2
    setting, todo = Setting(preset=given.preset, plant=preset(given.preset), engine=given.engine), {}
    for seed in seeds:
        for item in objects:
            for part in dict.fromkeys((*BESIDE, *BESIDE.values())):
                sizes = sizes_of(part, seed)[:most]
                mark = digest(setting, (item,), WARM_UP, part, sizes)
                job = f"{Path(item).stem}_{part.replace(' ', '_').replace(',', '')}_{mark}_{seed}"
                todo[job] = setting, item, part, sizes, seed
    with progress("running", len(todo)) as advance:
        results = run_jobs(session, todo, given.out, given.jobs, advance)
    outcome = Outcome([Turn(**turn) for turns in results.values() for turn in turns])
    caption = (
        "Left: where the object is along the grip when it is back, a line for each hand. Right: motions."
    )
    shown = save_figure(outcome.picture(), given.out, "there_and_back", caption)
    verdict = outcome.verdict
    tables = [outcome.table(), outcome.drift_table()]
    report = Report("There and back", f"{verdict[0].upper()}{verdict[1:]}.", tables, [shown])
    report.write(given.out)
    print(report.markdown())
    print(verdict)


if __name__ == "__main__":
    main()
