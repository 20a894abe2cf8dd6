"""The paper's own system in the simulated hand, next to this package's.

    python benchmarks/as_printed.py --objects box,weighted_box,can,bottle,applier --seeds 1000:1010

"As printed" is the paper's system around this package's J_m (the printed formulas cannot be right): forces
from the minimal-force problem alone, no fingertip is read; least motor increments that meet the limited error
within the motors' ranges; a plain sparse online GP of [q; p; da] with commanded da. It has no servo inverse,
no grip or force limits, no plan, no bound of a step, no gates on what teaches, and no figures of the hand.
"With tasks" adds this package's tasks of grip and off-axis motion, on estimated forces; "J_m as misprinted"
takes the printed K letter by letter. Grasps, targets, hands and stopping rule are those of the other systems.
Finished sessions stay in ``--out``: an interrupted run goes on where it stopped.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from any_hand import Turns, records_by
from command_line import study_parser

from torch_ekm._terminal import progress
from torch_ekm.contact.contact_kinematics import ContactKinematics
from torch_ekm.control import (
    DEFAULT_TASKS,
    ActuatorLimit,
    EffortTask,
    FocusTask,
    Guards,
    LimitingFunction,
    LookAndMoveController,
    OneStep,
    Safety,
)
from torch_ekm.experiments.config import Setting, digest
from torch_ekm.experiments.jobs import run_jobs
from torch_ekm.experiments.protocols.generalize import TABLE_I, TABLE_II, Generalize
from torch_ekm.experiments.records import TrialRecord
from torch_ekm.experiments.reporting import statistics as stats
from torch_ekm.experiments.reporting.report import Cell, Column, Report, Table
from torch_ekm.experiments.runner import Bench
from torch_ekm.kinematics.se3 import hat
from torch_ekm.model import KinematicModel, Linearization
from torch_ekm.model.stiffness.potential import posture_stiffness
from torch_ekm.simulation import PRESETS, preset

WARM_UP = 3
CAPACITY = 60  # basis vectors; the paper gives no figure
#: Nothing is gated or watched for; readings that cannot be are still refused.
NO_GUARDS = Guards(gate=math.inf, force_ceiling=math.inf, stuck_command=math.inf, wrong_way=10**6)


class PrintedController(LookAndMoveController):
    """Contact forces of each state alone: neither pads nor the last forces speak for any."""

    def linearize(self, state: Any, a: Any, fingertip_force: Any) -> Linearization:
        return self.kinematic.linearize(state)


class PrintedBench(Bench):
    """The system as printed; its gain is this package's, for the paper gives none."""

    controllers = PrintedController


class MisprintedModel(KinematicModel):
    """``D = [[V_qq + S, 0], [T, V_pp]]``, ``T = + dG/dtheta mu``: the printed K, letter by letter.

    It is that of pinned contacts which the fingers carry, with the wrong sign of T. Grasps that it takes for
    unstable are turned all the same.
    """

    def load_stiffness(self, kin: ContactKinematics, force: Any, spin_moment: Any) -> Any:
        D, n_q, plain = 0 * super().load_stiffness(kin, force, spin_moment), self.hand.n_q, kin.point_jacobian
        D[..., :n_q, :n_q] = posture_stiffness(force, plain.mT, kin.axis, self.precedes)
        D[..., n_q + 3 :, :n_q] = -(hat(force) @ plain).sum(-3)
        return D


class MisprintedBench(PrintedBench):
    """The system as printed, with J_m by the printed K."""

    def __init__(self, setting: Setting, object: Any, controller: str, **options: Any) -> None:
        super().__init__(setting, object, controller, **options)
        flagged = replace(setting.model, on_unstable="flag", rolling=False)
        self.model = MisprintedModel(self.hand.hand, self.hand.object, flagged)


@dataclass(frozen=True)
class Printed(Generalize):
    """The paper's experiment with the paper's system."""

    bench: ClassVar[type[Bench]] = PrintedBench


@dataclass(frozen=True)
class Misprinted(Generalize):
    """The same by the printed K."""

    bench: ClassVar[type[Bench]] = MisprintedBench


def without_fingertips(setting: Setting) -> Setting:
    """The same hand, and no pad measures."""
    return setting.replace(plant=setting.parameters.replace(force_sensors=False))


def as_printed(setting: Setting) -> Setting:
    """The same hand without fingertips, and the paper's controller and learner."""
    return without_fingertips(setting).replace(
        tasks=(EffortTask(), FocusTask()),
        limits=(ActuatorLimit(step=math.inf),),
        limiting=LimitingFunction(contact_travel=None),
        bound=None,
        planner=OneStep(),
        safety=Safety(setting.safety.rule, NO_GUARDS),
        servo_inverse=False,
        adapts=False,
        learner="rbf",
        learner_options={"robust": None, "forgetting_factor": 1.0},
        capacity=CAPACITY,
    )


def with_tasks(setting: Setting) -> Setting:
    """As printed, with this package's tasks of grip and off-axis motion."""
    return as_printed(setting).replace(tasks=DEFAULT_TASKS)


#: Name -> protocol, controller, what becomes of the setting.
SYSTEMS: dict[str, tuple[type[Generalize], str, Callable[[Setting], Setting]]] = {
    "KM, as printed": (Printed, "KM", as_printed),
    "E-KM, as printed": (Printed, "E-KM", as_printed),
    "KM, with tasks": (Printed, "KM", with_tasks),
    "E-KM, with tasks": (Printed, "E-KM", with_tasks),
    "KM": (Generalize, "KM", Setting.replace),
    "E-KM": (Generalize, "E-KM", Setting.replace),
    "E-KM without fingertips": (Generalize, "E-KM", without_fingertips),
    "KM, J_m as misprinted": (Misprinted, "KM", as_printed),
    "E-KM, J_m as misprinted": (Misprinted, "E-KM", as_printed),
}
#: What is run together.
GROUPS = {
    "all": [name for name in SYSTEMS if "misprinted" not in name and "without" not in name],
    "fingertips": ["E-KM", "E-KM without fingertips"],
    "misprinted": [name for name in SYSTEMS if "printed" in name],
}
#: Each E-KM and its KM.
_BESIDE = {
    "E-KM, as printed": "KM, as printed",
    "E-KM, with tasks": "KM, with tasks",
    "E-KM": "KM",
    "E-KM, J_m as misprinted": "KM, J_m as misprinted",
}


def session(name: str, setting: Setting, item: str, angles: Any, seed: int) -> list[dict[str, Any]]:
    """Warm-up (E-KM only), then the turns of Table I with one object."""
    protocol, controller, _ = SYSTEMS[name]
    made = protocol(setting, (item,), angles, WARM_UP, 0.0, 0.0).session(item, controller, seed)
    return [one.to_json() for one in made if one.kind == "turn"]


class Systems:
    """Turns of all systems, by system, object and seed."""

    def __init__(self, turns: dict[tuple[str, str, int], list[TrialRecord]]) -> None:
        self.turns = turns
        self.objects = list(dict.fromkeys(item for _, item, _ in turns))
        self.names = [name for name in SYSTEMS if any(key[0] == name for key in turns)]

    def _pairs(self, name: str, item: str | None) -> list[list[TrialRecord]]:
        """The turns of each pair of object and seed."""
        return [one for key, one in self.turns.items() if key[0] == name and item in (None, key[1])]

    def of(self, name: str, item: str | None = None) -> Turns:
        """Those of one object, or of all."""
        return Turns(tuple(itertools.chain.from_iterable(self._pairs(name, item))))

    def errors(self, name: str, item: str | None = None) -> np.ndarray:
        """Mean steady-state error of each pair of object and seed [deg]; lost objects count with the whole
        angle."""
        return np.array([Turns(tuple(records)).error for records in self._pairs(name, item) if records])

    def summary(self) -> Table:
        """A row for each system."""
        rows: list[list[Cell]] = []
        km, ekm = (float(np.mean([pair[k] for pair in TABLE_II.values()])) for k in (0, 1))
        rows.append(["KM, in the paper", km, None, None, None, None, None])
        rows.append(["E-KM, in the paper", ekm, 100 * ekm / km, None, None, None, None])
        for name in self.names:
            turns, errors = self.of(name), self.errors(name)
            ratio = self._ratio(name)
            error = stats.bootstrap_mean(errors) if len(errors) > 1 else float(errors.mean())
            first = [one.first_step_deg for one in turns.records if one.first_step_deg is not None]
            rows.append([name, error, ratio, turns.lost, turns.reached, turns.motions, float(np.mean(first))])
        columns: list[str | Column] = [
            "system", Column("error [deg]", ".2f"), Column("E-KM:KM [%]", ".0f"), "lost", "reached",
            Column("motions", ".1f"), Column("error of the first motion [deg]", ".2f"),
        ]  # fmt: skip
        note = (
            f"Of {len(self.of(self.names[-1]).records)} turns. Mean steady-state error, with 95 % intervals"
            " over pairs of object and seed. A lost object counts with the whole angle. Motions of turns that"
            " reached the target. The paper's are means over its five objects."
        )
        return Table("systems", "The paper's system and this package's", columns, rows, note)

    def _ratio(self, name: str) -> float | None:
        if _BESIDE.get(name) not in self.names:
            return None
        return 100 * float(self.errors(name).mean() / self.errors(_BESIDE[name]).mean())

    def by_object(self) -> Table:
        """Errors of each object, the paper's and here; lost objects in brackets."""
        rows: list[list[Cell]] = [
            [
                f"{name}, in the paper",
                *(TABLE_II[item][k] if item in TABLE_II else None for item in self.objects),
            ]
            for k, name in enumerate(("KM", "E-KM"))
        ]
        for name in self.names:
            here = (
                f"{self.errors(name, item).mean():.2f} ({self.of(name, item).lost})" for item in self.objects
            )
            rows.append([name, *here])
        columns: list[str | Column] = ["system", *(Column(item, ".1f") for item in self.objects)]
        return Table("objects", "Each object", columns, rows, "Steady-state error [deg], and objects lost.")

    def ends(self) -> Table:
        """Why the turns ended."""
        reasons = sorted({one.reason for name in self.names for one in self.of(name).records})
        count = {name: [one.reason for one in self.of(name).records] for name in self.names}
        rows: list[list[Cell]] = [
            [reason, *(count[name].count(reason) for name in self.names)] for reason in reasons
        ]
        return Table("ends", "Why the turns ended", ["reason", *self.names], rows, "Turns.")

    @property
    def verdict(self) -> str:
        """The last line."""
        parts = (
            f"{name} {self.errors(name).mean():.2f} deg, lost {self.of(name).lost} of"
            f" {len(self.of(name).records)}"
            for name in self.names
        )
        ratios = {name: ratio for name in _BESIDE if (ratio := self._ratio(name)) is not None}
        beside = (
            f"{name.removeprefix('E-KM').strip(', ') or 'here'} {x:.0f} %" for name, x in ratios.items()
        )
        told = f"; E-KM:KM {', '.join(beside)}" if len(ratios) > 1 else ""
        return f"{'; '.join(parts)}{told}"


def main(arguments: Sequence[str] | None = None) -> None:
    parser = study_parser(
        __doc__, "as_printed", objects=",".join(TABLE_I), seeds="1000:1010", engine="sapien",
        quick="one object, seed and angle",
    )  # fmt: skip
    parser.add_argument("--systems", default="all", choices=GROUPS, help="what is compared")
    parser.add_argument("--preset", default="nominal", choices=list(PRESETS))
    given = parser.parse_args(arguments)
    objects, seeds, angles = given.objects.split(","), given.seeds, None
    if given.quick:
        objects, seeds, angles = objects[:1], seeds[:1], (5.0,)
    base = Setting(preset=given.preset, plant=preset(given.preset), engine=given.engine)
    names = GROUPS[given.systems]
    todo, keys = {}, {}
    for seed, item, name in itertools.product(seeds, objects, names):
        setting = SYSTEMS[name][2](base)
        job = f"{name.replace(' ', '_').replace(',', '')}_{digest(setting, (item,), angles, WARM_UP)}_{seed}"
        todo[job], keys[job] = (name, setting, item, angles, seed), (name, Path(item).stem, seed)
    with progress("running", len(todo)) as advance:
        results = run_jobs(session, todo, given.out, given.jobs, advance)
    systems = Systems(records_by(keys, results))
    report = Report(
        "The paper's system", f"{systems.verdict}.", [systems.summary(), systems.by_object(), systems.ends()]
    )
    report.write(given.out)
    print(report.markdown())
    print(systems.verdict)


if __name__ == "__main__":
    main()
