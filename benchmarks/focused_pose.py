"""Focused poses of one to six directions: what is called reachable, and how near the object comes.

    python benchmarks/focused_pose.py --objects box,can --seeds 1000:1010

Axes of the hand frame: a, about which the pinch turns the object; b, from the thumb to the fingers; c, across
both. Every target is asked of a fresh grasp, of an E-KM that had three turns about a with the object and goes
on learning. Poses are true plus noise, the mean of eight readings at rest; the loop's tolerances are 0.15 deg
and 0.12 mm, for true errors of 0.25 deg and 0.2 mm. Finished sessions stay in ``--out``: an interrupted run
goes on where it stopped.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from command_line import study_parser

from torch_ekm._terminal import progress
from torch_ekm.control import (
    Direction,
    FocusedPose,
    PoseTarget,
    StopReason,
)
from torch_ekm.experiments.config import Setting, digest
from torch_ekm.experiments.jobs import run_jobs
from torch_ekm.experiments.records import true_state
from torch_ekm.experiments.reporting.plots import COLOURS, new_figure, save_figure
from torch_ekm.experiments.reporting.report import Cell, Column, Report, Table
from torch_ekm.experiments.runner import Bench
from torch_ekm.kinematics import GraspState
from torch_ekm.simulation import preset

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from torch_ekm.typing import Tensor

WITHIN = {"deg": 0.25, "mm": 0.2}
FRAMES = 8
STRICTER = 0.6  # than WITHIN: what the loop asks of its noisy readings
WARM_UP = (9.0, 19.0, 12.0)  # [deg]
_FIRST_WARM_UP = 1000  # number of the first training grasp: never one that is tested
_SI = {"deg": np.pi / 180, "mm": 1e-3}


#: How the message of a declined target begins -> what it was declined for.
DECLINED = {
    "the motors hold": "the motors do not hold all directions: rank or gain of the focused rows of J_m",
    "motors at": "the motors' ranges",
    "the object turns": "the object would turn more than 12 deg off the focus",
    "the model leaves": "tried on the model, it ends before the target",
}


class Part(NamedTuple):
    """What is asked of one direction."""

    unit: str
    axis: str
    size: float


def _targets() -> dict[str, dict[str, tuple[Part, ...]]]:
    """Group -> what is asked -> its directions."""
    groups: dict[str, dict[str, tuple[Part, ...]]] = {}
    for sign in (1, -1):
        for axis in "abc":
            name = f"{'+' if sign > 0 else '-'}{axis}"
            shift = Part("mm", axis, 3.0 * sign)
            one = {
                "turn 8 deg": (Part("deg", axis, 8.0 * sign),),
                "the same, no other turn": tuple(Part("deg", x, 8.0 * sign * (x == axis)) for x in "abc"),
                "shift 3 mm": (shift,),
                "the same, no other shift": tuple(Part("mm", x, 3.0 * sign * (x == axis)) for x in "abc"),
                "turn 8 deg about a, shift 3 mm": (Part("deg", "a", 8.0), shift),
                "shift 6 mm": (Part("mm", axis, 6.0 * sign),),
                "shift 12 mm": (Part("mm", axis, 12.0 * sign),),
            }
            for group, parts in one.items():
                groups.setdefault(group, {})[name] = parts
        turns = tuple(Part("deg", x, 8.0 * sign * (x == "a")) for x in "abc")
        shifts = {x: Part("mm", x, 3.0 * sign * (x == "b")) for x in "abc"}
        name = f"{'+' if sign > 0 else '-'}a, {'+' if sign > 0 else '-'}b"
        groups.setdefault("all but shifts along a", {})[name] = (*turns, shifts["b"], shifts["c"])
        groups.setdefault("all but shifts along c", {})[name] = (*turns, shifts["a"], shifts["b"])
        groups.setdefault("whole pose", {})[name] = (*turns, *shifts.values())
    return groups


TARGETS = _targets()


@dataclass(frozen=True)
class Trial:
    """A target, and what came of it."""

    group: str
    name: str
    object: str
    seed: int
    reason: str
    """Why the loop ended."""
    message: str
    errors: dict[str, float]
    """Largest true error of the turns [deg] and the shifts [mm] that were asked for."""
    motions: int
    lost: bool

    @property
    def declined(self) -> bool:
        return self.reason == StopReason.OUT_OF_REACH.value

    @property
    def size(self) -> float:
        """Largest error, in units of what is called near."""
        return max(error / WITHIN[unit] for unit, error in self.errors.items())

    @property
    def near(self) -> bool:
        return not self.declined and self.size <= 1


def _why(trial: Trial) -> str:
    """The message, or the kind of it."""
    kinds = (kind for start, kind in DECLINED.items() if trial.message.startswith(start))
    return next(kinds, trial.message)


def axes_of(bench: Bench) -> dict[str, Tensor]:
    """a, b, c of the grasp that is held (hand frame)."""
    points, a = bench.hand.plan.points, bench.hand.rotation_axis
    across = torch.as_tensor(points[1:].mean(axis=0) - points[0])
    b = across - a * (across @ a)
    b = b / torch.linalg.vector_norm(b)
    return {"a": a, "b": b, "c": torch.linalg.cross(a, b)}


def target_of(start: GraspState, parts: Sequence[Part], axes: dict[str, Tensor]) -> PoseTarget:
    """Turned first, then moved."""
    target = PoseTarget(start.position, start.rotation)
    for unit, axis, size in parts:
        if unit == "deg":
            target = PoseTarget.turned(target, axes[axis], degrees=size)
        else:
            target = PoseTarget.moved(target, axes[axis], millimetres=size)
    return target


def ask(bench: Bench, start: GraspState, parts: Sequence[Part]) -> dict[str, Any]:
    """How a loop ended that declines what is not reachable."""
    axes = axes_of(bench)
    focus = FocusedPose(
        [Direction(axes[axis], unit, tolerance=STRICTER * WITHIN[unit]) for unit, axis, _ in parts]
    )
    loop = bench.closed_loop(bench.plant, focus, decline=True)
    done = loop.run(target := target_of(start, parts, axes))
    wrong = (focus.matrix @ target.error(true_state(done.stop.final))).abs().tolist()
    errors: dict[str, float] = {}
    for (unit, *_), error in zip(parts, wrong, strict=True):
        errors[unit] = max(errors.get(unit, 0.0), error / _SI[unit])
    ended = {"reason": done.reason.value, "message": done.stop.message, "lost": done.lost}
    return {**ended, "errors": errors, "motions": len(done.steps)}


def session(setting: Setting, item: str, groups: Sequence[str], seed: int) -> list[dict[str, Any]]:
    """Warm-up, then every target from a grasp of its own."""
    bench, trials = Bench(setting.hardware_instance(seed), item, "E-KM"), []
    for k, angle in enumerate(WARM_UP):
        bench.trial(seed, _FIRST_WARM_UP + k, angle, "warm-up")
    asked = [(group, name) for group in groups for name in TARGETS[group]]
    for k, (group, name) in enumerate(asked):
        start = bench.grasp(seed, k)
        if start is not None:
            about = {"group": group, "name": name, "object": bench.name, "seed": seed}
            trials.append(asdict(Trial(**about, **ask(bench, start, TARGETS[group][name]))))
    bench.close()
    return trials


class Outcome:
    """What came of all targets."""

    def __init__(self, trials: Sequence[Trial]) -> None:
        self.trials = trials
        self.groups = list(dict.fromkeys(one.group for one in trials))

    def _of(self, group: str | None) -> list[Trial]:
        return [one for one in self.trials if group in (None, one.group)]

    @property
    def verdict(self) -> str:
        """The last line."""
        called = [one for one in self.trials if not one.declined]
        share = 100 * sum(one.near for one in called) / max(len(called), 1)
        lost = sum(one.lost for one in called)
        return (
            f"reachable {len(called)} of {len(self.trials)}; of these within {WITHIN['deg']:g} deg and"
            f" {WITHIN['mm']:g} mm {share:.0f} %; lost {lost}"
        )

    def table(self) -> Table:
        """A row for each group."""
        rows: list[list[Cell]] = []
        for group in self.groups:
            asked = self._of(group)
            called = [one for one in asked if not one.declined]
            n = len(next(iter(TARGETS[group].values())))
            errors = (
                float(np.median(found))
                if (found := [e.errors[unit] for e in called if unit in e.errors])
                else None
                for unit in ("deg", "mm")
            )
            counts = len(asked), len(called), sum(one.near for one in called)
            lost = sum(one.lost for one in called)
            rows.append([f"{group} ({n})", *counts, *errors, self._motions(called), lost])
        columns: list[str | Column] = [
            "target (directions)", "asked", "called reachable", "within", Column("turn [deg]", ".2f"),
            Column("shift [mm]", ".2f"), Column("motions", ".1f"), "lost",
        ]  # fmt: skip
        note = "Medians of the largest true error of those called reachable; mean motions of those within."
        return Table("targets", "Targets of one to six directions", columns, rows, note)

    @staticmethod
    def _motions(called: Sequence[Trial]) -> float | None:
        motions = [one.motions for one in called if one.near]
        return float(np.mean(motions)) if motions else None

    def ends(self) -> Table:
        """Why targets were declined, and how those ended that came no nearer."""
        rows: list[list[Cell]] = []
        for group in self.groups:
            ends = Counter((one.reason, _why(one)) for one in self._of(group) if not one.near)
            rows += [[group, reason, n, why] for (reason, why), n in ends.most_common()]
        columns: list[str | Column] = ["target", "end", "times", "why"]
        return Table("ends", "Declined, or not within", columns, rows)

    def picture(self) -> Figure:
        """Every target's error, and those that were declined."""
        names = [
            (group, name) for group in self.groups for name in dict.fromkeys(o.name for o in self._of(group))
        ]
        figure, (axes,) = new_figure(8.0, 0.2 * len(names) + 1.2)
        for k, item in enumerate(dict.fromkeys(one.object for one in self.trials)):
            mine = [one for one in self.trials if one.object == item]
            colour = (COLOURS["E-KM"], COLOURS["KM+I"], COLOURS["KM+S"])[k % 3]
            spread = 0.25 * (k - 0.5)
            tried = [one for one in mine if not one.declined]
            at = [names.index((one.group, one.name)) + spread for one in tried]
            axes.plot(
                [min(max(one.size, 0.05), 20) for one in tried], at, "o", ms=3, color=colour, label=item
            )
            at = [names.index((one.group, one.name)) + spread for one in mine if one.declined]
            axes.plot([30.0] * len(at), at, "x", ms=4, color=colour)
        axes.axvline(1, color=COLOURS["limit"], linewidth=1)
        axes.set_xscale("log")
        axes.set_xticks([0.1, 1, 10, 30], ["0.1", "1", "10", "declined"])
        axes.set_xlabel("true error in units of 0.25 deg and 0.2 mm, the largest of the directions")
        axes.set_yticks(range(len(names)), [f"{group}: {name}" for group, name in names], fontsize=7)
        axes.set_ylim(len(names) - 0.4, -0.6)
        axes.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=3, frameon=False, fontsize=8)
        return figure


def main(arguments: Sequence[str] | None = None) -> None:
    parser = study_parser(
        __doc__, "focused_pose", objects="box,can", seeds="1000:1010", engine="mujoco",
        quick="one object, one seed, whole poses",
    )  # fmt: skip
    parser.add_argument("--preset", default="nominal")
    given = parser.parse_args(arguments)
    objects, seeds, groups = given.objects.split(","), given.seeds, list(TARGETS)
    if given.quick:
        objects, seeds, groups = objects[:1], seeds[:1], ["shift 3 mm", "whole pose"]
    setting = Setting(preset=given.preset, plant=preset(given.preset), engine=given.engine, frames=FRAMES)
    figures = WARM_UP, STRICTER, {group: TARGETS[group] for group in groups}
    todo = {
        f"{Path(item).stem}_{digest(setting, (item,), figures)}_{seed}": (setting, item, groups, seed)
        for seed in seeds
        for item in objects
    }
    with progress("running", len(todo)) as advance:
        results = run_jobs(session, todo, given.out, given.jobs, advance)
    outcome = Outcome([Trial(**trial) for trials in results.values() for trial in trials])
    caption = "True errors of each target; crosses: declined before anything moved."
    shown = save_figure(outcome.picture(), given.out, "focused_pose", caption)
    report = Report(
        "Focused poses",
        f"{outcome.verdict[0].upper()}{outcome.verdict[1:]}.",
        [outcome.table(), outcome.ends()],
        [shown],
    )
    report.write(given.out)
    print(report.markdown())
    print(outcome.verdict)


if __name__ == "__main__":
    main()
